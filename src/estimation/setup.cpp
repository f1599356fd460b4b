#include "src/estimation/setup.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <functional>
#include <numbers>

#include "src/math/decompositions.h"

namespace chainsplat::estimation {

using math::MatrixX;
using math::Pose;
using math::Vector3;
using math::VectorX;
using silhouette::SetupEquations;

namespace {

// Standard deviations before anything was seen.
constexpr double kClock = 1.0 / 30.0;   // s: stamps are often off by a frame
constexpr double kCameraTurn = 0.0044;  // rad, a quarter of a degree: what calibrations by hand reach
constexpr double kCameraShift = 0.003;  // m
constexpr double kGraspTurn = 0.02;     // rad: how differently a hand lays a rope into a gripper twice

// Frames that count, as many as are taken of a recording (silhouette::CorrectionOptions): they share the model's
// errors, and what they say is slowly forgotten for what later ones say.
constexpr int kFrames = 75;
constexpr double kWidth = 2.0;         // px, deviation of how wide one camera's masks are from all cameras'
constexpr double kLatestClock = 0.15;  // s
constexpr double kMoving = 0.03;       // m/s, speed of the base from which its clock is learned
// A rope that seems to go faster than this from frame to frame, only because the setup is believed to be another, is
// not known to move as it is said to for the time that accelerations are told from.
constexpr double kSettled = 0.01;      // m/s, RMS along the rope
constexpr double kSettlingTime = 0.1;  // s
// While the clock's deviation is larger than this, the base may begin to move so many deviations before or after its
// stamps say so.
constexpr double kKnownClock = 0.005;        // s
constexpr double kSureOfClock = 2.0;         // deviations
constexpr double kBeforeFirst = 1.0 / 30.0;  // s, to the first frame from what was believed before

void add_table(const Given& given, Setup& setup) {
  if (!given.table_normal || chain::bends_in_space(given.model.chain)) return;
  const Vector3 normal = given.base(given.base_start).pose.rotation.transpose() * *given.table_normal;
  const silhouette::TiltEquations tilt = silhouette::tilt_equations(given.model.chain.bending_axis, normal);
  setup.information.block<3, 3>(SetupEquations::kGrasp, SetupEquations::kGrasp) += tilt.information;
  setup.right.segment<3>(SetupEquations::kGrasp) -= tilt.gradient;
}

// Of the base's clock, s.
double clock_deviation(const State& state) {
  return 1.0 / std::sqrt(state.setup.information(SetupEquations::kClock, SetupEquations::kClock));
}

// The base's motion, and its velocity over the time in which it may be as its clock is known, if that is larger: a base
// that rests may have begun to move.
trajectory::BaseMotion base_as_timed(const State& state, double time) {
  const double deviation = clock_deviation(state);
  trajectory::BaseMotion out = base_at(state, time);
  const Pose before = base_at(state, time - deviation).pose, after = base_at(state, time + deviation).pose;
  math::Vector6 mean;
  mean << math::log_so3(before.rotation.transpose() * after.rotation),
      out.pose.rotation.transpose() * (after.translation - before.translation);
  mean /= 2.0 * deviation;
  if (mean.tail<3>().norm() > out.velocity.tail<3>().norm()) out.velocity = mean;
  return out;
}

// m, RMS over the rope, by which a change of the angles moves it.
double displacement(const chain::Chain& chain, const VectorX& theta, const VectorX& change) {
  const std::vector<MatrixX> jacobians = chain::link_end_jacobians(chain, theta, Pose{});
  return std::sqrt(change.dot(chain::displacement_metric(jacobians) * change) / static_cast<double>(jacobians.size()));
}

// Nothing is said of these numbers.
void leave_out(SetupEquations& frame, int at, int size) {
  frame.information.middleRows(at, size).setZero();
  frame.information.middleCols(at, size).setZero();
  frame.gradient.segment(at, size).setZero();
}

void move_cameras(State& state) {
  int at = SetupEquations::kCameras;
  for (std::size_t c = 0; c < state.cameras.size(); ++c) {
    if (!state.setup.posed[c]) continue;
    state.cameras[c].world_from_camera = capture::moved(
        state.given.cameras[c].world_from_camera, state.setup.mean.segment<3>(at), state.setup.mean.segment<3>(at + 3));
    at += SetupEquations::kPerCamera;
  }
}

}  // namespace

Setup first_setup(const Given& given, const std::vector<char>& unverified) {
  Setup setup;
  setup.posed = unverified;
  setup.posed.resize(given.cameras.size(), 0);
  const auto size = SetupEquations::kCameras +
                    SetupEquations::kPerCamera * std::count_if(setup.posed.begin(), setup.posed.end(), std::identity{});
  VectorX deviation(size);
  deviation[SetupEquations::kClock] = kClock;
  deviation.segment<3>(SetupEquations::kGrasp).setConstant(kGraspTurn);
  for (auto at = SetupEquations::kCameras; at < size; at += SetupEquations::kPerCamera) {
    deviation.segment<3>(at).setConstant(kCameraTurn);
    deviation.segment<3>(at + 3).setConstant(kCameraShift);
  }
  setup.right = VectorX::Zero(size);
  setup.information = deviation.cwiseAbs2().cwiseInverse().asDiagonal();
  add_table(given, setup);
  setup.mean = setup.information.ldlt().solve(setup.right);
  setup.first_information = setup.information;
  setup.first_right = setup.right;
  return setup;
}

MatrixX covariance(const Setup& setup) {
  return setup.information.ldlt().solve(MatrixX::Identity(setup.mean.size(), setup.mean.size()));
}

double late_deviation(const Setup& setup) {
  const VectorX clock = VectorX::Unit(setup.mean.size(), SetupEquations::kClock);
  return std::sqrt(setup.information.ldlt().solve(clock)[SetupEquations::kClock]);
}

BaseCorrection base_correction(const VectorX& mean) {
  return {mean[SetupEquations::kClock], {math::exp_so3(mean.segment<3>(SetupEquations::kGrasp)), Vector3::Zero()}};
}

std::vector<MatrixX> rope_twists(const State& state, double time) {
  const auto turned = [](const Pose& frame, const Vector3& axis) {
    return math::transform_twist(frame, (math::Vector6() << axis, Vector3::Zero()).finished());
  };
  const trajectory::BaseMotion base = base_at(state, time);
  MatrixX shared = MatrixX::Zero(6, state.setup.mean.size());
  shared.col(SetupEquations::kClock) = math::transform_twist(base.pose, base.velocity);
  for (int i = 0; !chain::bends_in_space(state.given.model.chain) && i < 3; ++i)
    shared.col(SetupEquations::kGrasp + i) = turned(base.pose, Vector3::Unit(i));
  std::vector<MatrixX> out(state.cameras.size(), shared);
  int at = SetupEquations::kCameras;
  for (std::size_t c = 0; c < state.cameras.size(); ++c) {
    if (!state.setup.posed[c]) continue;
    for (int i = 0; i < 3; ++i) {
      out[c].col(at + i) = -turned(state.cameras[c].world_from_camera, Vector3::Unit(i));
      out[c](3 + i, at + 3 + i) = -1.0;
    }
    at += SetupEquations::kPerCamera;
  }
  return out;
}

bool may_go_otherwise(const State& state, double time) {
  const double reach = kSureOfClock * clock_deviation(state);
  if (!state.given.identified || reach < kSureOfClock * kKnownClock) return false;
  const auto velocity = [&](double at) {
    const trajectory::BaseMotion base = base_at(state, at);
    return Vector3(base.pose.rotation * base.velocity.tail<3>());
  };
  return (velocity(time + reach) - velocity(time - reach)).norm() > kSettled;
}

std::vector<capture::Finding> findings(const State& state) {
  constexpr double kSure = 3.0;          // standard deviations
  constexpr double kLeastClock = 0.002;  // s; less does no harm
  constexpr double kLeastTurn = 0.001;   // rad
  constexpr double kLeastShift = 0.001;  // m
  constexpr double kDegrees = 180.0 / std::numbers::pi;
  const Setup& setup = state.setup;
  const MatrixX known = covariance(setup);
  std::vector<capture::Finding> out;
  char text[200];
  const double late = setup.mean[SetupEquations::kClock];
  const double clock = std::sqrt(known(SetupEquations::kClock, SetupEquations::kClock));
  if (std::abs(late) > std::max(kLeastClock, kSure * clock)) {
    std::snprintf(text, sizeof text, "the base's stamps are %.1f +- %.1f ms %s: followed with the time that fits",
                  1e3 * std::abs(late), 1e3 * clock, late > 0.0 ? "late" : "early");
    out.push_back({"base-time", "base", 1e3 * late, 1e3 * clock, "ms", true, true, false, -1, text});
  }
  int at = SetupEquations::kCameras;
  for (std::size_t c = 0; c < state.given.cameras.size(); ++c) {
    if (!setup.posed[c]) continue;
    // of the size of a vector: of its component along itself
    const auto size = [&](int first, double* deviation) {
      const Vector3 value = setup.mean.segment<3>(first);
      const Vector3 along = value.norm() > 0.0 ? value.normalized() : Vector3::UnitX();
      *deviation = std::sqrt(along.dot(known.block<3, 3>(first, first) * along));
      return value.norm();
    };
    double turn_deviation, shift_deviation;
    const double turn = size(at, &turn_deviation), shift = size(at + 3, &shift_deviation);
    at += SetupEquations::kPerCamera;
    if (turn <= std::max(kLeastTurn, kSure * turn_deviation) && shift <= std::max(kLeastShift, kSure * shift_deviation))
      continue;
    const std::string& name = state.given.cameras[c].name;
    std::snprintf(text, sizeof text,
                  "%.2f +- %.2f degrees and %.1f +- %.1f mm from where its calibration puts it: followed as it stands; "
                  "calibrate it again",
                  kDegrees * turn, kDegrees * turn_deviation, 1e3 * shift, 1e3 * shift_deviation);
    out.push_back({"camera-pose", name, kDegrees * turn, kDegrees * turn_deviation, "deg", true, true, false, -1,
                   name + " stands " + text});
  }
  return out;
}

std::optional<SetupEquations> look_at_setup(const State& state, std::span<const capture::View* const> views,
                                            const Belief& predicted, const VectorX& theta) {
  const chain::Chain& chain = state.given.model.chain;
  const int n = chain.angles();
  const Eigen::LLT<MatrixX> factor(MatrixX(predicted.covariance.topLeftCorner(n, n)));
  if (!math::is_positive(factor)) return {};
  silhouette::Options options = state.options.silhouette;
  options.prior.mean = predicted.mean.head(n);
  options.prior.information = factor.solve(MatrixX::Identity(n, n)) / state.options.new_share;  // as measure() does
  options.edge_offset = state.edge_offset;
  options.edge_offset_deviation = kWidth;
  SetupEquations frame = silhouette::setup_equations(
      chain, [&](double time) { return base_as_timed(state, time); }, views, state.cameras, state.setup.posed, theta,
      predicted.by_setup.topRows(n), options);
  if (!frame.information.allFinite() || !frame.gradient.allFinite() || !frame.angles.allFinite()) return {};
  if (chain::bends_in_space(chain)) {
    leave_out(frame, SetupEquations::kGrasp, 3);
    frame.angles.middleCols<3>(SetupEquations::kGrasp).setZero();
  }
  return frame;
}

void learn_setup(State& state, SetupEquations frame, const Belief& predicted) {
  Setup& setup = state.setup;
  const chain::Chain& chain = state.given.model.chain;
  const int n = chain.angles();
  // without dynamics nothing tells a rope that follows late from a base that is stamped late
  const bool moving = base_as_timed(state, predicted.time).velocity.tail<3>().norm() >= kMoving;
  if (!state.given.identified || !moving) leave_out(frame, SetupEquations::kClock, 1);

  if (setup.frames < kFrames) {
    ++setup.frames;
  } else if (moving) {
    setup.information -= (setup.information - setup.first_information) / kFrames;
    setup.right -= (setup.right - setup.first_right) / kFrames;
  } else {  // what rests says the same again
    frame.information.setZero();
    frame.gradient.setZero();
  }
  setup.information += frame.information;
  setup.right += frame.information * setup.mean - frame.gradient;
  VectorX mean = setup.information.ldlt().solve(setup.right);
  mean[SetupEquations::kClock] = std::clamp(mean[SetupEquations::kClock], -kLatestClock, kLatestClock);
  const VectorX change = mean - setup.mean;
  setup.mean = std::move(mean);
  move_cameras(state);
  if (!state.belief) return;
  const VectorX moved = state.belief->by_setup * change;
  const VectorX theta = state.belief->mean.head(n);
  state.belief->mean += moved;
  const double interval = setup.last == kNever ? kBeforeFirst : predicted.time - setup.last;
  if (displacement(chain, theta, moved.head(n)) > kSettled * interval)
    setup.settling_until = predicted.time + kSettlingTime;
}

}  // namespace chainsplat::estimation
