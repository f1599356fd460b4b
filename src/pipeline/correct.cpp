// correct.cpp - what a capture was given wrongly by a little, found before the long work, and said in plain words.
#include <algorithm>
#include <cmath>
#include <optional>

#include "pipeline/clocks.h"
#include "pipeline/decide.h"
#include "pipeline/judge_capture.h"
#include "pipeline/lost_frames.h"
#include "pipeline/mistakes.h"
#include "pipeline/stages.h"

namespace chainsplat::pipeline {

namespace {

using capture::Finding;

// Of a readout and all else in turn. The first round leaves a tenth or two of it, half where outlines of a strongly bent
// rope tell it.
constexpr int kClockRounds = 6;

// Half a pixel is the only correction.
void correct_half_pixel(const silhouette::CorrectionFit& fit, const silhouette::CorrectionOptions& options,
                        Corrected& out) {
  const auto which =
      std::min_element(fit.evidence_after.begin(), fit.evidence_after.end()) - fit.evidence_after.begin();
  for (capture::Correction& correction : out.corrections)
    if (const auto* const turn = capture::find(options.mistakes[which], correction.subject, correction.quantity->name))
      correction.value = turn->value;
  out.verdict.push_back(
      {"half-pixel", "cameras", kHalfPixels[which], 0.0, "px", true, true, false, -1,
       text("the cameras' cx and cy are half a pixel too %s%s: corrected", kHalfPixels[which] > 0.0 ? "small" : "large",
            kHalfPixels[which] > 0.0 ? " (they count pixel centers from 0, 0; here from 0.5, 0.5)" : "")});
}

// Adds how the cameras' colors differ to the corrections and mends it in `capture`, whose cameras are corrected
// already.
void correct_colors(const silhouette::CorrectionFit& fit, const std::vector<std::string>& fixed,
                    capture::Capture& capture, Corrected& out) {
  const bool varied = capture.cameras.size() > 1 && !is_fixed(fixed, "colors");
  silhouette::CameraColors colors;
  if (varied) colors = silhouette::fit_camera_colors(fit.chain, capture, {fit.time, fit.theta, {}, {}});
  bool differ = false;
  for (Eigen::Index c = 0; c < colors.gain.cols(); ++c)
    for (int i = 0; i < 3; ++i) {
      const double gain = std::abs(colors.gain(i, c) - 1.0), bias = std::abs(colors.bias(i, c));
      differ = differ || gain > kCertain * colors.gain_deviation(i, c) || bias > kCertain * colors.bias_deviation(i, c);
    }
  capture::Corrections found;
  for (std::size_t c = 0; c < capture.cameras.size(); ++c)
    for (const char* const name : {"gain", "bias"}) {
      capture::Correction correction;
      correction.quantity = &capture::corrected_quantity("camera", name);
      correction.subject = capture.cameras[c].name;
      correction.value = correction.deviation = math::Vector3::Zero();
      correction.calibration = capture::find(out.corrections, correction.subject, "rotation")->calibration;
      if (varied) {
        const bool gain = name == std::string("gain");
        correction.state = capture::CorrectionState::free;
        correction.deviation = (gain ? colors.gain_deviation : colors.bias_deviation).col(c);
        if (differ) correction.value = gain ? math::Vector3(colors.gain.col(c).array() - 1.0) : colors.bias.col(c);
      }
      found.push_back(std::move(correction));
    }
  capture::apply(found, capture);
  if (differ) judge_colors(colors, capture, out.verdict);
  out.corrections.insert(out.corrections.end(), found.begin(), found.end());
}

}  // namespace

FirstFit first_fit(const capture::Capture& capture, int joints) {
  const auto chain_of = [&](chain::Bending kind) {
    return chain::make_chain(capture.length, capture.diameter, capture.direction, capture.bending_axis, joints, kind,
                             false);
  };
  FirstFit out;
  out.chain = chain_of(capture.tabletop ? chain::Bending::planar : chain::Bending::spatial);
  out.chain.lift = silhouette::lying_down(out.chain, silhouette::height_by_table(capture));
  out.sequence = silhouette::fit_sequence(out.chain, capture);
  // one camera does not see depth, into which a chain that bends in space would fold
  if (!capture.tabletop && silhouette::seen_by_one(capture) &&
      silhouette::choose_bending(out.chain, capture, out.sequence).bending == chain::Bending::planar) {
    out.chain = chain_of(chain::Bending::planar);
    out.sequence = silhouette::fit_sequence(out.chain, capture);
  }
  return out;
}

namespace {

// What is left to correct of a capture whose rows were read at once.
Corrected correct_all_but_clocks(capture::Capture& capture, const std::vector<std::string>& fixed,
                                 FirstFit&& fit_by_now) {
  Corrected out;
  auto& [chain, sequence] = fit_by_now;
  if (std::none_of(sequence.frames.begin(), sequence.frames.end(),
                   [](const auto& f) { return f.residual_pixels > 0.0; })) {
    out.verdict.push_back({"unseen", "base", 0.0, 0.0, "share", false, false, true, -1,
                           "no camera sees the rope where the base's motion and the grasp put it: the base and the "
                           "cameras are not in one world, or not all in meters"});
    return out;
  }
  capture::Corrections lost;
  if (!is_fixed(fixed, "time")) lost = restore_lost_frames(chain, capture, sequence, out.verdict);
  silhouette::CorrectionOptions options;
  options.lying = silhouette::lying_on_table(capture);
  options.held = fixed;
  for (const double pixels : kHalfPixels) options.mistakes.push_back(shifted_images(capture, pixels));
  std::optional<Decision> decision = decide(capture, chain, sequence, options);
  if (!decision) {
    out.verdict.push_back(held_high(std::abs(options.lying->height)));
    out.corrections = std::move(lost);
    return out;
  }
  auto& [fit, corrected, half_pixel, doubt, shift] = *decision;
  tell_fit("correct", fit.summary);
  out.corrections = std::move(fit.corrections);
  if (corrected || doubt > 0.0) out.covariance = (corrected ? 1.0 : doubt) * fit.covariance;
  if (!corrected)
    for (capture::Correction& correction : out.corrections) correction.value.setZero();
  if (half_pixel) correct_half_pixel(fit, options, out);
  if (shift)
    for (capture::Correction& correction : out.corrections)
      if (correction.subject == shift->subject && correction.quantity == shift->quantity) correction.value += shift->value;
  judge_base_clock(out.corrections, out.verdict);
  judge_camera_clocks(out.corrections, capture, out.verdict);
  if (!half_pixel) judge_cameras(out.corrections, capture, out.verdict);
  judge_rope(out.corrections, capture, out.verdict);
  judge_outlines(fit, capture, out.verdict);
  judge_folds(fit, out.verdict);
  capture::apply(out.corrections, capture);
  // where the grasp is to be taken as given
  if (capture::find(out.corrections, "grasp", "translation")->state == capture::CorrectionState::held)
    if (const std::optional<double> above = given_above_table(capture)) judge_height(*above, out.verdict);
  correct_colors(fit, fixed, capture, out);
  out.corrections.insert(out.corrections.end(), lost.begin(), lost.end());
  return out;
}

bool impossible(const Corrected& found) {
  return std::any_of(found.verdict.begin(), found.verdict.end(), [](const Finding& f) { return f.impossible; });
}

void add(Corrected found, Corrected& out) {
  out.corrections = std::move(found.corrections);
  out.covariance = std::move(found.covariance);
  out.verdict.insert(out.verdict.end(), found.verdict.begin(), found.verdict.end());
}

bool any_but_colors(const capture::Corrections& corrections) {
  return std::any_of(corrections.begin(), corrections.end(), [](const capture::Correction& c) {
    return c.quantity->group != std::string("colors") && !c.value.isZero(0.0);
  });
}

// Adds clocks that were found beside what else was, or may be wrong.
void add_clocks(const Clocks& clocks, Corrected& out) {
  if (clocks.readout == 0.0 && clocks.late == 0.0 && clocks.doubt.isZero(0.0)) return;
  Eigen::Index numbers = 0;
  std::vector<Eigen::Index> of_base, of_rows;
  for (capture::Correction& correction : out.corrections) {
    // of which the covariance says nothing
    if (correction.quantity->group == std::string("colors") || correction.quantity == &capture::lost_frames()) continue;
    if (correction.quantity == &capture::corrected_quantity("base", "time")) {
      of_base.push_back(numbers);
      // what outlines leave open counts where they told it, too
      const double by_outlines = clocks.late != 0.0 && correction.value[0] == 0.0 ? 0.0 : correction.deviation[0];
      correction.value.array() += clocks.late;
      correction.deviation.setConstant(
          std::hypot(by_outlines, clocks.late_deviation, std::sqrt(clocks.doubt(0, 0))));
      if (clocks.late != 0.0) correction.state = capture::CorrectionState::free;
    }
    if (correction.quantity == &capture::corrected_quantity("camera", "readout")) {
      of_rows.push_back(numbers);
      correction.value.setConstant(clocks.readout);
      correction.deviation.setConstant(std::hypot(clocks.readout_deviation, std::sqrt(clocks.doubt(1, 1))));
      correction.state = capture::CorrectionState::free;
    }
    numbers += correction.value.size();
  }
  if (of_rows.empty()) return;
  if (out.covariance.size() == 0) out.covariance = math::MatrixX::Zero(numbers, numbers);
  const double own = clocks.readout == 0.0 ? 0.0 : clocks.readout_deviation * clocks.readout_deviation;
  const auto add = [&](const std::vector<Eigen::Index>& rows, const std::vector<Eigen::Index>& columns, double value) {
    for (const Eigen::Index a : rows)
      for (const Eigen::Index b : columns) out.covariance(a, b) += value;
  };
  add(of_base, of_base, clocks.doubt(0, 0) + clocks.late_deviation * clocks.late_deviation);
  add(of_base, of_rows, clocks.doubt(0, 1));
  add(of_rows, of_base, clocks.doubt(1, 0));
  add(of_rows, of_rows, clocks.doubt(1, 1) + own);
  if (clocks.readout == 0.0) return;
  judge_readout(clocks.readout, std::hypot(clocks.readout_deviation, std::sqrt(clocks.doubt(1, 1))), out.verdict);
}

}  // namespace

Corrected correct(capture::Capture& capture, const std::vector<std::string>& fixed, bool anyway) {
  Corrected out;
  out.verdict = find_mistakes(capture);
  judge_mass(capture, out.verdict);
  if (!out.verdict.empty() && !anyway) return out;
  judge_repeated(capture, out.verdict);
  if (!clocks_are_open(capture, fixed)) {
    add(correct_all_but_clocks(capture, fixed, first_fit(capture)), out);
    return out;
  }
  const capture::Capture given = capture;
  Clocks clocks;
  Corrected found;
  const auto correct_the_rest = [&] {
    capture = clocks.readout == 0.0 && clocks.late == 0.0 ? given : with_clocks(given, clocks);
    found = correct_all_but_clocks(capture, fixed, first_fit(capture));
  };
  const auto more_clocks = [&]() -> std::optional<Clocks> {
    if (impossible(found)) return std::nullopt;
    const bool clock_was_late = capture::value_of(found.corrections, "base", "time") != 0.0;
    if (!capture.tabletop) return more_by_motion(capture, clock_was_late);
    if (clocks.readout == 0.0 && !any_but_colors(found.corrections)) return std::nullopt;
    return more_by_outlines(clocks.readout == 0.0 ? given : with_clocks(given, clocks), fixed,
                            found.corrections);
  };
  const double longest = longest_readout(given);
  correct_the_rest();
  for (int round = 0; round < kClockRounds; ++round) {
    const std::optional<Clocks> more = more_clocks();
    if (more) clocks.doubt = more->doubt;
    if (!more || (more->readout == 0.0 && more->late == 0.0)) break;
    clocks.readout += more->readout;
    clocks.late += more->late;
    const bool ends = round + 1 == kClockRounds;  // before nothing more was found
    clocks.readout_deviation = std::hypot(more->readout_deviation, ends ? more->readout : 0.0);
    clocks.late_deviation = std::max(clocks.late_deviation, more->late_deviation);
    const bool possible = std::abs(clocks.readout) <= longest;
    if (!possible) clocks = {};  // something else is wrong, and its first rounds were taken for a readout, too
    correct_the_rest();
    if (!possible) break;
  }
  if (clocks.readout != 0.0)
    core::say_more(text("correct: the rows are read in %.1f ms", kSeconds * clocks.readout));
  add(std::move(found), out);
  add_clocks(clocks, out);
  if (clocks.late != 0.0) {
    core::say_more(text("correct: by the rope's motion the base is %.1f ms late", kSeconds * clocks.late));
    std::erase_if(out.verdict, [](const Finding& one) { return one.code == "base-time"; });
    judge_base_clock(out.corrections, out.verdict);
  }
  if (clocks.readout == 0.0) return out;
  capture.views = given.views;
  for (capture::PackedView& view : capture.views) view.time = capture.times[view.camera][view.frame];
  read_at_once(capture);
  return out;
}

std::vector<Finding> contradictions(capture::Capture capture, const std::vector<std::string>& fixed) {
  const bool all = is_fixed(fixed, "all");
  std::vector<Finding> out;
  for (Finding& found : correct(capture, {}, false).verdict) {
    const std::string group = group_of(found);
    if (found.impossible && all)
      out.push_back(std::move(found));
    else if (found.corrected && !group.empty() && (all || is_fixed(fixed, group.c_str())))
      out.push_back(not_corrected(std::move(found)));
  }
  return out;
}

Examination examine(const Path& path, const core::Listener& listener) {
  const core::ListenerScope scope(listener);
  capture::Capture capture = capture::load(path);
  read_at_once(capture);
  Corrected found = correct(capture, {}, false);
  return {std::move(found.corrections), std::move(found.verdict)};
}

}  // namespace chainsplat::pipeline
