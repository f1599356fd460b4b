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

constexpr int kMostLost = 30;            // frames of all cameras
constexpr Eigen::Index kSurelyLost = 1;  // of one camera: where it lost more, some are missed or a few frames off

constexpr double kLeastReadout = 0.0015;  // s, one that is less is nothing
constexpr double kLeastChange = 0.0005;   // s, of one that is known by then
constexpr double kTriedReadout = 0.004;   // s, by which the slope is found: the motion it adds is a few millimeters
// What is left of them has so many independent parts at least, of its hundreds of frames and joints: what any of them
// can pretend is that much less than all together.
constexpr double kIndependent = 10.0;
constexpr int kFewJoints = 8;              // identified in half a second; more explain no more of a readout
constexpr std::size_t kLeastMoments = 30;  // of fewer, parameters explain any motion

}  // namespace

capture::Corrections restore_lost_frames(const chain::Chain& chain, capture::Capture& capture,
                                         silhouette::SequenceFit& sequence, std::vector<Finding>& verdict) {
  std::vector<std::vector<double>> lost(capture.cameras.size());
  if (capture.cameras.size() < 2) return {};
  const std::vector<std::vector<double>> given = capture.times;
  for (int count = 0; count < kMostLost; ++count) {
    const auto one = silhouette::first_lost_frame(chain, capture, sequence);
    if (!one) break;
    lost[one->camera].push_back(one->frame);
    capture::restore_lost(math::VectorX::Constant(1, one->frame), one->camera, capture);
    sequence = silhouette::fit_sequence(chain, capture);
  }
  // all at once, as apply() does it later: the same stamps to the bit
  capture.times = given;
  for (capture::PackedView& view : capture.views) view.time = given[view.camera][view.frame];
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
    const bool sure = count <= kSurelyLost;
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

// What is left of the distances of nodes, m, between the motion that outlines show and one that a rope of the best
// parameters makes. `states`: of `chain`; `uniform`: with the same stiffness all along, which is quick.
VectorX left_by_motion(const chain::Chain& chain, const capture::Capture& capture, const chain::States& states,
                       bool uniform = true) {
  identification::Options options = identification_options(twin_in_scene(capture), false, 0);
  if (uniform) options.per_joint = options.ask_for_more = false;
  const chain::States moved = identification::identify(chain, capture.base, states, options).rollout;
  const auto nodes = [&](const VectorX& theta) { return chain::nodes(chain, chain::link_motions(chain, theta, {})); };
  std::vector<double> out;
  for (std::size_t k = 0; k < states.theta.size(); ++k) {
    const MatrixX apart = nodes(states.theta[k]) - nodes(moved.theta[k]);
    out.insert(out.end(), apart.reshaped().begin(), apart.reshaped().end());
  }
  return Eigen::Map<VectorX>(out.data(), static_cast<Eigen::Index>(out.size()));
}

}  // namespace

MotionReadout readout_by_motion(const capture::Capture& capture) try {
  MotionReadout out;
  if (capture.tabletop) return out;
  const FirstFit fit = first_fit(capture, kFewJoints);
  if (fit.sequence.states.time.size() < kLeastMoments) return out;
  const std::vector<VectorX> slopes = silhouette::readout_slopes(fit.chain, capture, fit.sequence);
  chain::States seen = fit.sequence.states;
  for (const silhouette::FrameFit& frame : fit.sequence.frames) seen.covariance.push_back(frame.covariance);
  const auto left = [&](double readout) {
    chain::States states = seen;
    for (std::size_t k = 0; k < states.theta.size(); ++k) states.theta[k] += readout * slopes[k];
    return left_by_motion(fit.chain, capture, states);
  };
  const VectorX before = left(0.0), slope = (left(kTriedReadout) - before) / kTriedReadout;
  const double value = -before.dot(slope) / slope.squaredNorm();
  out.before = out.left = before.squaredNorm();
  const bool known = silhouette::has_rolling_shutter(capture.cameras);  // then every gain is one
  if (!(std::abs(value) >= (known ? kLeastChange : kLeastReadout))) return out;
  const double after = left(value).squaredNorm();
  if (!(after < (known ? 1.0 : 1.0 - kLeastExplained) * out.left)) return out;
  // neither may a payload, friction in bending or stiffness that varies explain it
  if (!known && !(after < (1.0 - kLeastExplained) * left_by_motion(fit.chain, capture, seen, false).squaredNorm()))
    return out;
  out.left = after;
  out.more = Readout{value, std::sqrt(after / (kIndependent * slope.squaredNorm()))};
  return out;
} catch (const WorkError&) {
  return {};  // no parameters move the rope at all: identification, which follows, says so
}

}  // namespace chainsplat::pipeline
