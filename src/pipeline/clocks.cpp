#include "pipeline/clocks.h"

#include <algorithm>
#include <cmath>
#include <cstdio>

#include "chainsplat/identification.h"
#include "chainsplat/run_folder.h"
#include "chainsplat/shutter.h"

namespace chainsplat::pipeline {

using capture::Finding;
using math::MatrixX;
using math::VectorX;

namespace {

constexpr int kMostLost = 30;         // frames of all cameras
constexpr std::ptrdiff_t kTried = 3;  // places where one may be lost, before it is taken that none is
// Where the outlines' mean square over all frames is more than so many times that of the median frame, some lost frame
// was missed or restored in the wrong place.
constexpr double kAllFound = 3.0;
constexpr Eigen::Index kSurelyLost = 1;  // of one camera: where it lost more, some are missed or a few frames off

// Of what identification leaves, in units of what is expected: right recordings leave 0.2, a readout of 15 ms 2.2,
// and 1.1 where most of it was taken for the base's clock.
constexpr double kExplained = 0.4;
// What a readout must explain of that, since no model is right.
constexpr double kLeastExplained = 0.3;
constexpr double kLeastReadout = 0.0015;  // s, one that is less is nothing
constexpr double kLeastChange = 0.0005;   // s, of one that is known by then
constexpr double kTriedReadout = 0.004;   // s, by which the slope is found: the motion it adds is a few millimeters
// What is left of them has so many independent parts at least, of its hundreds of frames and joints: what any of them
// can pretend is that much less than all together.
constexpr double kIndependent = 10.0;
constexpr int kFewJoints = 8;              // identified in half a second; more explain no more of a readout
constexpr std::size_t kLeastMoments = 30;  // of fewer, parameters explain any motion

// Frames that cameras lost, and what outlines show where these alone are restored.
struct Restored {
  std::vector<silhouette::LostFrame> lost;
  silhouette::SequenceFit sequence;
  silhouette::LostFrames found;
};
Restored restored(const chain::Chain& chain, capture::Capture capture, std::vector<silhouette::LostFrame> lost) {
  for (const silhouette::LostFrame& one : lost)
    capture::restore_lost(VectorX::Constant(1, one.frame), one.camera, capture);
  silhouette::SequenceFit sequence = silhouette::fit_sequence(chain, capture);
  silhouette::LostFrames found = silhouette::find_lost_frames(chain, capture, sequence);
  return {std::move(lost), std::move(sequence), std::move(found)};
}

// Takes it where the outlines fit better.
bool improve(Restored& now, Restored other) {
  if (!(other.found.misfit < now.found.misfit)) return false;
  now = std::move(other);
  return true;
}

// One more, the likeliest that makes the outlines fit better.
bool add_lost_frame(const chain::Chain& chain, const capture::Capture& capture, Restored& now) {
  const std::vector<silhouette::LostFrame> likely = now.found.likely;
  const auto last = likely.begin() + std::min<std::ptrdiff_t>(kTried, std::ssize(likely));
  return std::any_of(likely.begin(), last, [&](const silhouette::LostFrame& one) {
    std::vector<silhouette::LostFrame> lost = now.lost;
    lost.push_back(one);
    return improve(now, restored(chain, capture, std::move(lost)));
  });
}

// Moves each to where the outlines show it once the others are restored: before, they hid it.
void move_lost_frames(const chain::Chain& chain, const capture::Capture& capture, Restored& now) {
  for (std::size_t i = 0; i < now.lost.size(); ++i) {
    std::vector<silhouette::LostFrame> others = now.lost;
    others.erase(others.begin() + static_cast<std::ptrdiff_t>(i));
    const Restored without = restored(chain, capture, others);
    std::ptrdiff_t tried = 0;
    for (const silhouette::LostFrame& one : without.found.likely) {
      if (one.camera != now.lost[i].camera || one.frame == now.lost[i].frame) continue;
      std::vector<silhouette::LostFrame> lost = others;
      lost.insert(lost.begin() + static_cast<std::ptrdiff_t>(i), one);
      if (improve(now, restored(chain, capture, std::move(lost))) || ++tried == kTried) break;
    }
  }
}

// Mean square distance of the outlines of a frame, px^2, in the median.
double usual_misfit(const silhouette::SequenceFit& sequence) {
  std::vector<double> squares;
  for (const silhouette::FrameFit& frame : sequence.frames)
    if (frame.residual_pixels > 0.0) squares.push_back(frame.residual_pixels * frame.residual_pixels);
  return squares.empty() ? 0.0 : math::median(squares);
}

}  // namespace

capture::Corrections restore_lost_frames(const chain::Chain& chain, capture::Capture& capture,
                                         silhouette::SequenceFit& sequence, std::vector<Finding>& verdict) {
  if (capture.cameras.size() < 2) return {};
  silhouette::LostFrames found = silhouette::find_lost_frames(chain, capture, sequence);
  Restored now{{}, std::move(sequence), std::move(found)};
  for (int count = 0; count < kMostLost && add_lost_frame(chain, capture, now); ++count) continue;
  move_lost_frames(chain, capture, now);
  sequence = std::move(now.sequence);
  const bool all_found = now.found.misfit <= kAllFound * usual_misfit(sequence);
  std::vector<std::vector<double>> lost(capture.cameras.size());
  for (const silhouette::LostFrame& one : now.lost) lost[one.camera].push_back(one.frame);
  capture::Corrections out;
  for (std::size_t c = 0; c < lost.size(); ++c) {
    if (lost[c].empty()) continue;
    std::sort(lost[c].begin(), lost[c].end());
    capture::Correction correction;
    correction.quantity = &capture::lost_frames();
    correction.subject = capture.cameras[c].name;
    correction.value = Eigen::Map<math::VectorX>(lost[c].data(), static_cast<Eigen::Index>(lost[c].size()));
    correction.deviation = math::VectorX::Zero(correction.value.size());
    correction.calibration = capture::recording_text(capture);
    capture::restore_lost(correction.value, static_cast<int>(c), capture);
    const auto count = correction.value.size();
    const int first = static_cast<int>(lost[c].front());
    const bool sure = count <= kSurelyLost && all_found;
    char many[32] = "a frame", text[240];
    if (count > 1) std::snprintf(many, sizeof many, "%d frames, one", static_cast<int>(count));
    std::snprintf(
        text, sizeof text,
        "%s lost %s before frame %d, so that its stamps are early from there on: corrected; give the stamps of "
        "its frames (`timestamps`)%s",
        correction.subject.c_str(), many, first, sure ? "" : "; some may be missed, do not trust it");
    verdict.push_back(
        {"lost-frames", correction.subject, static_cast<double>(count), 0.0, "frames", true, sure, false, first, text});
    out.push_back(std::move(correction));
  }
  return out;
}

void read_at_once(capture::Capture& capture) {
  constexpr int kRounds = 2;  // the first motion is off by what rows read late add to it, a few millimeters
  if (!silhouette::has_rolling_shutter(capture.cameras)) return;
  const std::vector<capture::PackedView> views = capture.views;
  for (int round = 0; round < kRounds; ++round) {
    const FirstFit fit = first_fit(capture);
    capture.views = views;
    silhouette::read_at_once(capture, fit.chain, fit.sequence.states);
  }
}

capture::Capture with_readout(const capture::Capture& capture, double readout) {
  capture::Corrections corrections;
  for (const capture::Camera& camera : capture.cameras) {
    capture::Correction& correction = corrections.emplace_back();
    correction.quantity = &capture::corrected_quantity("camera", "readout");
    correction.subject = camera.name;
    correction.value = VectorX::Constant(1, readout);
  }
  capture::Capture out = capture;
  capture::apply(corrections, out);
  read_at_once(out);
  return out;
}

bool readout_is_open(const capture::Capture& capture, const std::vector<std::string>& fixed) {
  if (std::find(fixed.begin(), fixed.end(), "time") != fixed.end() || capture.base.samples().size() < 2) return false;
  for (std::size_t c = 0; c < capture.cameras.size(); ++c)
    if (capture::prior_deviation(capture, static_cast<int>(c), capture::corrected_quantity("camera", "readout")) == 0.0)
      return false;
  return true;
}

namespace {

struct Unexplained {
  VectorX apart;        // m, of nodes, between the motion that outlines show and the one that a rope makes
  double misfit = 0.0;  // identification::Estimates::misfit
};

// What a rope of the best parameters leaves. `states`: of `chain`; `uniform`: with the same stiffness all along, which
// is quick.
Unexplained left_by_motion(const chain::Chain& chain, const capture::Capture& capture, const chain::States& states,
                           bool uniform = true) {
  identification::Options options = identification_options(twin_in_scene(capture), false, 0);
  if (uniform) options.per_joint = options.ask_for_more = false;
  const identification::Result found = identification::identify(chain, capture.base, states, options);
  const auto nodes = [&](const VectorX& theta) { return chain::nodes(chain, chain::link_motions(chain, theta, {})); };
  std::vector<double> out;
  for (std::size_t k = 0; k < states.theta.size(); ++k) {
    const MatrixX apart = nodes(states.theta[k]) - nodes(found.rollout.theta[k]);
    out.insert(out.end(), apart.reshaped().begin(), apart.reshaped().end());
  }
  return {Eigen::Map<VectorX>(out.data(), static_cast<Eigen::Index>(out.size())), found.estimates.misfit};
}

void shift_base(double late, capture::Capture& capture) {
  std::vector<trajectory::Sample> samples = capture.base.samples();
  for (trajectory::Sample& sample : samples) sample.time -= late;
  capture.base = trajectory::fit(std::move(samples), "the base");
}

}  // namespace

std::optional<Readout> more_by_motion(const capture::Capture& capture, bool clock_was_late) try {
  const FirstFit fit = first_fit(capture, kFewJoints);
  if (fit.sequence.states.time.size() < kLeastMoments) return std::nullopt;
  const auto seen_by = [](const FirstFit& of) {
    chain::States out = of.sequence.states;
    for (const silhouette::FrameFit& frame : of.sequence.frames) out.covariance.push_back(frame.covariance);
    return out;
  };
  const chain::States seen = seen_by(fit);
  const Unexplained given = left_by_motion(fit.chain, capture, seen);
  const bool known = silhouette::has_rolling_shutter(capture.cameras);  // then every gain is one
  if (given.misfit < kExplained) return std::nullopt;
  const std::vector<VectorX> slopes = silhouette::readout_slopes(fit.chain, capture, fit.sequence);
  const auto left = [&](double readout, double base_late) {
    capture::Capture with_clock = capture;
    if (base_late != 0.0) shift_base(base_late, with_clock);
    chain::States states = base_late != 0.0 ? seen_by(first_fit(with_clock, kFewJoints)) : seen;
    for (std::size_t k = 0; k < states.theta.size(); ++k) states.theta[k] += readout * slopes[k];
    return left_by_motion(fit.chain, with_clock, states).apart;
  };
  // a base's clock that was found as if there were no readout is as late as the grasp's rows: both vary then
  const VectorX& before = given.apart;
  MatrixX slope(before.size(), clock_was_late ? 2 : 1);
  slope.col(0) = (left(kTriedReadout, 0.0) - before) / kTriedReadout;
  if (clock_was_late) slope.col(1) = (left(0.0, kTriedReadout) - before) / kTriedReadout;
  const MatrixX information = slope.transpose() * slope, inverse = information.inverse();
  const VectorX clocks = -inverse * (slope.transpose() * before);
  const auto left_by = [&](const VectorX& c) { return left(c[0], clock_was_late ? c[1] : 0.0); };
  const double size = std::abs(clocks[0]);
  if (!(size >= (known ? kLeastChange : kLeastReadout) && size <= capture::kLongestReadout)) return std::nullopt;
  const double most = known ? 1.0 : 1.0 - kLeastExplained;
  VectorX now = left_by(clocks);
  if (!(now.squaredNorm() < most * before.squaredNorm())) return std::nullopt;
  if (!known) {  // as it is then; by now the rows were read a few milliseconds later
    capture::Capture mended = capture;
    if (clock_was_late) shift_base(clocks[1], mended);
    mended = with_readout(mended, clocks[0]);
    const FirstFit again = first_fit(mended, kFewJoints);
    const auto left_then = [&](bool uniform) {
      return left_by_motion(again.chain, mended, seen_by(again), uniform).apart;
    };
    now = left_then(true);
    // neither may a payload, friction in bending or stiffness that varies explain it
    constexpr bool kUniform = false;
    const double otherwise = left_by_motion(fit.chain, capture, seen, kUniform).apart.squaredNorm();
    if (!(now.squaredNorm() < most * otherwise || left_then(kUniform).squaredNorm() < most * otherwise))
      return std::nullopt;
  }
  const double after = now.squaredNorm();
  return Readout{clocks[0], std::sqrt(after / kIndependent * inverse(0, 0))};
} catch (const WorkError&) {
  return std::nullopt;  // no parameters move the rope at all: identification, which follows, says so
}

namespace {

// One way in which clocks may be wrong: that of the base, and the rows of all cameras.
struct Clocks {
  math::Vector2 late = math::Vector2::Zero();  // s, the base's clock and the readout
  double deviation = 0.0;                      // s, of the readout
  double surprise = 0.0;                       // -ln of how likely it is, but for a constant
};

}  // namespace

Readout more_by_outlines(const capture::Capture& given, const std::vector<std::string>& fixed,
                         capture::Corrections found) {
  constexpr double kUnlikely = 0.02;  // share of one of them, below which it is left out
  for (capture::Correction& correction : found)
    if (correction.subject == "base") correction.value.setZero();
  capture::Capture by_given_clocks = given;
  capture::apply(found, by_given_clocks);
  const FirstFit fit = first_fit(by_given_clocks);
  silhouette::CorrectionOptions options;
  options.held = fixed;
  options.lying = silhouette::lying_on_table(by_given_clocks);
  options.prior_weight = silhouette::kAsRecognized;
  options.readout = true;
  const std::string& camera = given.cameras[0].name;
  const bool known = silhouette::has_rolling_shutter(given.cameras);
  std::vector<Clocks> ways;
  for (const char* const only : {"base.time", "readout", "base.time and readout"}) {
    options.only = only;
    const silhouette::CorrectionFit of = silhouette::fit_corrections(fit.chain, by_given_clocks, fit.sequence, options);
    const capture::Correction& readout = *capture::find(of.corrections, camera, "readout");
    const double least = known ? readout.deviation[0] : kLeastReadout;
    const double value = std::abs(readout.value[0]) < least ? 0.0 : readout.value[0];
    if (std::abs(value) > capture::kLongestReadout) continue;
    ways.push_back({{capture::value_of(of.corrections, "base", "time"), value},
                    readout.deviation[0],
                    of.unexplained + of.surprise});
  }
  const Clocks best = *std::min_element(ways.begin(), ways.end(),
                                        [](const Clocks& a, const Clocks& b) { return a.surprise < b.surprise; });
  double all = 0.0;
  for (const Clocks& way : ways) all += std::exp(best.surprise - way.surprise);
  Readout out{best.late[1], best.deviation};
  for (const Clocks& way : ways) {
    const double share = std::exp(best.surprise - way.surprise) / all;
    const math::Vector2 apart = way.late - best.late;
    if (share >= kUnlikely) out.doubt += share * apart * apart.transpose();
  }
  return out;
}

}  // namespace chainsplat::pipeline
