#include "pipeline/decide.h"

#include <algorithm>
#include <cmath>
#include <span>

#include "chainsplat/core.h"

namespace chainsplat::pipeline {

namespace {

// Share by which the outlines' square residuals must be larger with what was given before anything is changed. Straight
// links alone leave up to 0.1 on right recordings. Correcting all that may be wrong costs up to a millimeter on a
// table, and an end that is round, or a readout that is not known yet, looks like some of it: more must be wrong there.
constexpr double kNothingWrong = 0.15, kNothingWrongOnTable = 0.7;
// The same of a rope that is held straight by its prior: right recordings of ropes on tables have up to 0.8.
constexpr double kNothingWrongHeldStraight = 1.0;
// Below it no cause is looked for alone, and nothing is doubted; from kNothingWrong on it is sure that something is
// wrong. Right recordings have up to 0.064.
constexpr double kLeastEvidence = 0.08;
// But a clock alone explains at most 0.0019 of right recordings on tables: from this on it is looked for there. Of
// those that are wrong in other things it explains more (0.09 of 7 where the grasp is turned), but never most of it.
// Where a rope hangs, its motion tells a clock far better (clocks.h).
constexpr double kLeastByClock = 0.007;
// How likely it is, at least, that something is wrong: a base that is 2 ms off on a table has no more evidence than a
// right recording has, and as many recordings of a careful laboratory may be off by so little.
constexpr double kAlwaysDoubted = 0.1;
constexpr double kLeftOfHalfPixel = 0.2;  // of the evidence, at most, with half a pixel taken back
// Any other thing alone is corrected if it leaves at most kLeftOfOne of the evidence, but for kAsRight, which is there
// when nothing is wrong. Each of its numbers adds kPerNumber, since many numbers explain a part of anything. What it
// leaves must be less than kRight, from which on more would be wrong; a round end leaves 0.25 on a table.
constexpr double kLeftOfOne = 0.25, kPerNumber = 0.03;
constexpr double kRight = kNothingWrong, kRightOnTable = 0.3;
// Evidence of right recordings, and by which explanations of them differ, since links are straight.
constexpr double kAsRight = 0.06;
constexpr double kAboveTable = 0.001;  // m, from which on a rope is said to be held above its table

// A rope that is held straight by its prior misses the outlines more than one that is as free as in recognition: by 1.0
// to 1.2 times, and by 3 where it goes around the gripper (measured on tables). There the corrections of one that hangs
// would make up for the bends that the prior does not allow.
constexpr double kBentMore = 1.5;

// Mean square residual of the outlines, px^2, with those that are cut off at the cut.
double mean_square(const silhouette::CorrectionFit& fit) {
  constexpr double kCut = 2.5;  // px, the least that outlines are cut off at (mathematics.md 6.10, 'Weights')
  double out = 0.0;
  for (const silhouette::OutlineMisfit& of : fit.misfits) out += of.rms * of.rms + of.cut * kCut * kCut;
  return out;
}

bool is_half_pixel(const silhouette::CorrectionFit& fit) {
  const auto least = std::min_element(fit.evidence_after.begin(), fit.evidence_after.end());
  return fit.evidence > kNothingWrong && *least < kLeftOfHalfPixel * fit.evidence;
}

// Whether there is so much evidence that this cause, if it explains it, is likelier than nothing.
bool is_looked_for(const silhouette::Cause& cause, double evidence, bool tabletop) {
  if (tabletop && cause.name.ends_with(".time") && evidence - cause.evidence >= kLeastByClock) return true;
  return evidence >= kLeastEvidence;
}

// m above where it lies on the table, from which on corrections make up for how a rope is assumed to come down: held 15
// mm above it, cameras were found to be off by 10 degrees. Faults of base and grasp alone are less.
double high(const capture::Capture& capture) { return std::max(0.25 * capture.diameter, 0.005); }

// Whether a rope that is not known to hang lies on its table, as far as table and grasp tell, with these corrections.
bool lies(capture::Capture capture, const capture::Corrections& corrections) {
  capture::apply(corrections, capture);
  return std::abs(silhouette::height_by_table(capture)) <= kAboveTable;
}

// Whether two fits of the same unknowns found about the same.
bool alike(const silhouette::CorrectionFit& a, const silhouette::CorrectionFit& b) {
  for (std::size_t i = 0; i < a.corrections.size(); ++i) {
    const math::VectorX apart = (a.corrections[i].value - b.corrections[i].value).cwiseAbs();
    if ((apart.array() > a.corrections[i].deviation.cwiseMax(b.corrections[i].deviation).array()).any()) return false;
  }
  return true;
}

// Fits that may each be the right one: `cause` alone; and, beginning with each of the causes that look alike (a grasp
// off along the rope, another length), all of them together. The last may end at different places, because it is not
// known which cameras' masks begin at the grasp.
std::vector<silhouette::CorrectionFit> ways_of(const chain::Chain& chain, const capture::Capture& capture,
                                               const silhouette::SequenceFit& sequence, const silhouette::Cause& cause,
                                               const std::vector<silhouette::Cause>& causes,
                                               silhouette::CorrectionOptions options) {
  std::vector<silhouette::CorrectionFit> out;
  const auto add = [&](const std::string& only, const std::string& then) {
    options.only = only;
    options.then = then;
    silhouette::CorrectionFit fit = silhouette::fit_corrections(chain, capture, sequence, options);
    if (std::none_of(out.begin(), out.end(), [&](const auto& other) { return alike(fit, other); }))
      out.push_back(std::move(fit));
  };
  add(cause.name, {});
  if (cause.in_doubt != cause.name) add(cause.name, cause.in_doubt);
  for (const silhouette::Cause& other : causes)
    if (other.in_doubt == cause.in_doubt && other.name != cause.name && other.name != cause.in_doubt)
      add(other.name, cause.in_doubt);
  return out;
}

math::VectorX numbers_of(const silhouette::CorrectionFit& fit) {
  math::VectorX out(fit.covariance.rows());
  Eigen::Index at = 0;
  for (const capture::Correction& correction : fit.corrections) {
    out.segment(at, correction.value.size()) = correction.value;
    at += correction.value.size();
  }
  return out;
}

// It is off by `apart` with this probability.
void add_doubt(const math::VectorX& apart, double probability, silhouette::CorrectionFit& fit) {
  fit.covariance += probability * apart * apart.transpose();
  Eigen::Index at = 0;
  for (capture::Correction& correction : fit.corrections) {
    const Eigen::Index size = correction.value.size();
    correction.deviation =
        (correction.deviation.cwiseAbs2() + probability * apart.segment(at, size).cwiseAbs2()).cwiseSqrt();
    at += size;
  }
}

// How likely it is that something is wrong which nothing corrects, by the evidence that is left.
double doubt_of(double evidence) {
  return std::clamp((evidence - kLeastEvidence) / (kNothingWrong - kLeastEvidence), kAlwaysDoubted, 1.0);
}

// The likeliest of these fits. Its deviations count how far each other one is from it, by its probability.
silhouette::CorrectionFit fit_alone(const chain::Chain& chain, const capture::Capture& capture,
                                    const silhouette::SequenceFit& sequence, const silhouette::Cause& cause,
                                    const std::vector<silhouette::Cause>& causes,
                                    const silhouette::CorrectionOptions& options) {
  std::vector<silhouette::CorrectionFit> ways = ways_of(chain, capture, sequence, cause, causes, options);
  std::iter_swap(ways.begin(), std::min_element(ways.begin(), ways.end(),
                                                [](const auto& a, const auto& b) { return a.surprise < b.surprise; }));
  silhouette::CorrectionFit& one = ways.front();
  for (const silhouette::CorrectionFit& other : ways)
    for (std::size_t i = 0; i < one.corrections.size(); ++i) {
      capture::Correction& correction = one.corrections[i];
      if (correction.state != capture::CorrectionState::held) continue;
      correction.value.setZero();
      correction.state = other.corrections[i].state;
    }
  double all = 0.0;
  for (const silhouette::CorrectionFit& way : ways) all += std::exp(one.surprise - way.surprise);
  const math::VectorX taken = numbers_of(one);
  for (const silhouette::CorrectionFit& way : ways)
    add_doubt(numbers_of(way) - taken, std::exp(one.surprise - way.surprise) / all, one);
  return std::move(one);
}

// What is corrected when one thing explains all: `alone` was fitted with that one free, `all` with all. The deviations
// of the others say what the recording tells of them.
void keep_given(silhouette::CorrectionFit& alone, const silhouette::CorrectionFit& all) {
  for (std::size_t i = 0; i < alone.corrections.size(); ++i) {
    capture::Correction& correction = alone.corrections[i];
    if (correction.state != capture::CorrectionState::held) continue;
    correction.value.setZero();
    correction.deviation = all.corrections[i].deviation;
    correction.state = all.corrections[i].state;
  }
}

capture::Capture with(const capture::Correction& correction, const capture::Capture& given) {
  capture::Capture out = given;
  capture::apply({correction}, out);
  return out;
}

capture::Correction shift_of(const char* subject, const char* name, const math::VectorX& value) {
  capture::Correction shift;
  shift.quantity = &capture::corrected_quantity(subject, name);
  shift.subject = subject;
  shift.value = value;
  return shift;
}

// How the rope and its table may be, and all corrections where they are so.
struct Hypothesis {
  std::optional<capture::Correction> shift;  // of table or grasp, where one of them was given wrong by much
  silhouette::CorrectionFit fit;
};

Hypothesis supposing(const capture::Capture& given, const chain::Chain& chain,
                     const silhouette::CorrectionOptions& options, std::optional<capture::Correction> shift) {
  const capture::Capture capture = shift ? with(*shift, given) : given;
  silhouette::CorrectionFit fit =
      silhouette::fit_corrections(chain, capture, silhouette::fit_sequence(chain, capture), options);
  return {std::move(shift), std::move(fit)};
}

// A rope that lies far beside the plane of its grasp, by table and grasp, is held so, or one of the two was given wrong
// by as much. Outlines tell: where the table was, the rope is flat and in that plane; where the grasp was, it is flat
// beside it; else it comes down as a rod of some stiffness does. They are judged by what is left with all corrections,
// since wrong cameras hide the difference. None: it is held so, or may be. `sequence` is fitted to `chain`.
constexpr std::array kReaches = {0.3, 0.5, 0.8, 1.25, 2.0};  // of ropes from 1 % to 16 times as stiff as usual
constexpr double kClearly =
    0.6;  // of the cost that is left with the rope held so; found: 0.26 to 0.42, or 0.88 and more
std::optional<Hypothesis> misplaced(const capture::Capture& capture, const chain::Chain& chain,
                                    const silhouette::SequenceFit& sequence,
                                    const silhouette::CorrectionOptions& options) {
  if (silhouette::seen_by_one(capture)) return std::nullopt;  // one sees it as turns of the joints
  const double height = options.lying->height, up = chain.bending_axis.dot(options.lying->normal);
  chain::Chain held = chain;
  silhouette::CorrectionOptions as_held = options;
  as_held.lying.reset();  // its lift stays as it is
  double cost = INFINITY;
  for (const double reach : kReaches) {
    held.lift = silhouette::lying_down(chain, height, reach);
    cost = std::min(cost, supposing(capture, held, as_held, std::nullopt).fit.summary.final_cost);
  }

  chain::Chain flat = chain;
  silhouette::CorrectionOptions as_flat = options;
  std::optional<Hypothesis> best;
  const auto consider = [&](const capture::Correction& shift) {
    flat.lift = silhouette::lying_down(chain, as_flat.lying->height);
    Hypothesis other = supposing(capture, flat, as_flat, shift);
    if (other.fit.summary.final_cost < (best ? best->fit.summary.final_cost : kClearly * cost)) best = std::move(other);
  };
  if (!is_fixed(options.held, "table")) {
    as_flat.lying->height = silhouette::fit_height(chain, capture, sequence, 0.0);
    consider(shift_of("table", "height", math::VectorX::Constant(1, up * (as_flat.lying->height - height))));
  }
  if (!is_fixed(options.held, "grasp")) {
    as_flat.lying->height = 0.0;
    consider(shift_of("grasp", "translation", up * height * options.lying->normal));
  }
  return best;
}

}  // namespace

bool is_fixed(const std::vector<std::string>& fixed, const char* group) {
  return std::find(fixed.begin(), fixed.end(), group) != fixed.end();
}

// Turns of all cameras that shift their images by `shift` px to the right and down, as a larger cx and cy would.
capture::Corrections shifted_images(const capture::Capture& given, double shift) {
  capture::Corrections out;
  for (const capture::Camera& camera : given.cameras) {
    capture::Correction turn;
    turn.quantity = &capture::corrected_quantity("camera", "rotation");
    turn.subject = camera.name;
    turn.value = math::Vector3(shift / camera.fy, -shift / camera.fx, 0.0);
    out.push_back(std::move(turn));
  }
  return out;
}

std::optional<double> given_above_table(const capture::Capture& capture) {
  const double above = std::abs(silhouette::height_by_table(capture));
  if (above < kAboveTable || above > high(capture)) return std::nullopt;
  return above;
}

const silhouette::Cause* single_cause(const silhouette::CorrectionFit& fit, bool tabletop) {
  const silhouette::Cause* best = nullptr;
  double least = INFINITY;
  for (const silhouette::Cause& cause : fit.causes) {
    if (!is_looked_for(cause, fit.evidence, tabletop)) continue;
    const double left = std::max(0.0, cause.evidence - kAsRight) + kPerNumber * cause.numbers * fit.evidence;
    if (left >= kLeftOfOne * (fit.evidence - std::min(kAsRight, cause.evidence))) continue;
    if (cause.evidence >= (tabletop ? kRightOnTable : kRight) || left >= least) continue;
    best = &cause;
    least = left;
  }
  if (!best) return nullptr;
  const double as_well = best->evidence + kAsRight;
  for (const silhouette::Cause& cause : fit.causes)
    if (cause.in_doubt == best->in_doubt && cause.evidence <= as_well && cause.surprise < best->surprise) best = &cause;
  return best;
}

std::optional<Decision> decide(const capture::Capture& capture, const chain::Chain& chain,
                               const silhouette::SequenceFit& sequence, const silhouette::CorrectionOptions& options) {
  silhouette::CorrectionOptions judging = options;
  judging.prior_weight = silhouette::kAsRecognized;
  Decision out;
  out.fit = silhouette::fit_corrections(chain, capture, sequence, judging);
  out.half_pixel = is_half_pixel(out.fit);
  if (out.half_pixel) return out;

  // one thing alone
  if (const silhouette::Cause* const cause = single_cause(out.fit, capture.tabletop)) {
    silhouette::CorrectionFit alone = fit_alone(chain, capture, sequence, *cause, out.fit.causes, judging);
    // where a rope is held above its table, how it comes down is assumed, which other faults would make up for
    if (lies(capture, alone.corrections)) {
      core::say_more("correct: " + cause->name + " alone explains what is wrong");
      const math::VectorX apart = numbers_of(out.fit) - numbers_of(alone);
      keep_given(alone, out.fit);
      add_doubt(apart, doubt_of(cause->evidence), alone);
      out.fit = std::move(alone);
      out.corrected = true;
      return out;
    }
  }

  // table or grasp by much, and others
  if (options.lying && std::abs(options.lying->height) > high(capture)) {
    std::optional<Hypothesis> found = misplaced(capture, chain, sequence, options);
    if (!found) return std::nullopt;
    out.fit = std::move(found->fit);
    out.shift = std::move(found->shift);
    out.corrected = out.shift->subject == "grasp" || out.fit.evidence >= kNothingWrongHeldStraight;
    return out;
  }

  // all that may be wrong
  out.corrected = out.fit.evidence >= (capture.tabletop ? kNothingWrongOnTable : kNothingWrong);
  // one camera takes depth from the rope's width, so that what is wrong by a little is never seen
  const bool by_width = silhouette::seen_by_one(capture) && chain::bends_in_space(chain);
  if (!out.corrected) out.doubt = by_width ? 1.0 : doubt_of(out.fit.evidence);
  if (out.doubt > 0.0) add_doubt(numbers_of(out.fit), 1.0, out.fit);
  // friction holds whatever bends a rope on a table was laid in
  if (!out.corrected || capture.tabletop) return out;
  silhouette::CorrectionFit straight = silhouette::fit_corrections(chain, capture, sequence, options);
  if (mean_square(straight) <= kBentMore * mean_square(out.fit))
    out.fit = std::move(straight);
  else
    core::say_more("correct: the rope bends more than ropes usually do");
  return out;
}

}  // namespace chainsplat::pipeline
