// chainsplat/trajectory.h - the motion of the grasped end (the base) on SE(3): poses from a file in, pose, twist and
// acceleration at any time out, for cameras, dynamics and filter (mathematics.md 1, 4).
//
// Second differences of sampled poses are no usable accelerations (they are late by half a sample and amplify noise by
// 4/h^2). A smoothing quintic B-spline is fitted instead to each world coordinate of the position and to the rotation
// vector relative to the first rotation, with the noise level estimated from the residual; T_b, V_b and dV_b/dt are its
// analytic derivatives. Poses are T_sb (base to world); twists are body twists, in the base frame, rad/s and m/s.
#pragma once
#include <memory>
#include <span>
#include <string>
#include <vector>
#include "chainsplat/core.h"
#include "chainsplat/math.h"

namespace chainsplat::trajectory {

// The base at one instant: its pose, V_b = (T_b^-1 dT_b/dt)^vee and the component-wise derivative of V_b, both in the
// base frame.
struct BaseMotion {
  math::Pose pose;                                     // T_sb
  math::Vector6 velocity = math::Vector6::Zero();      // V_b, rad/s and m/s
  math::Vector6 acceleration = math::Vector6::Zero();  // dV_b/dt, without gravity, rad/s^2 and m/s^2
};

struct Sample {
  double time = 0.0;  // s
  math::Pose pose;    // T_sb
};

// A fitted trajectory, cheap to copy. It continues for half the median sample interval beyond [start, end], because
// times in files are rounded, and rests outside that.
class Trajectory {
 public:
  Trajectory() = default;
  BaseMotion at(double time) const;
  math::Pose pose(double time) const;
  double start() const;
  double end() const;
  double noise() const;  // estimated standard deviation of a coordinate of the position samples, m
  const std::vector<Sample>& samples() const;
  struct Data;
  explicit Trajectory(std::shared_ptr<const Data> data) : data_(std::move(data)) {}

 private:
  std::shared_ptr<const Data> data_;
};

// Fits samples with strictly increasing times; a single sample means a base at rest. The fit minimizes the squared
// residuals plus lambda times the integrated square of the third derivative (which gives a C^4 spline), with lambda
// from generalized cross validation, once for the position and once for the rotation vector r of R = R_0 exp([r]),
// where R_0 is the first sample's rotation and r continues beyond half a turn. The angular velocity is J_r(r) dr/dt,
// J_r the right Jacobian of exp. Throws InputError that names `where` for no sample, non-finite numbers, times out of
// order, places or durations beyond all bounds, more than half a turn between samples, and more than a whole turn from
// the first sample about a changing axis (r has no smooth continuation there).
Trajectory fit(std::vector<Sample> samples, const std::string& where);
// The trajectory with samples beyond its own, one mean interval apart, so that it covers [first, last], but at most
// kLongestContinuation s at either end: there it goes on with its last velocity and acceleration. A base at rest stays.
constexpr double kLongestContinuation = 0.2;  // s
std::vector<Sample> continued(const Trajectory& trajectory, double first, double last);
// Reads one pose per line, 'timestamp tx ty tz qx qy qz qw' in s and m, with '#' comments. Throws InputError that names
// file and line.
std::vector<Sample> read_tum(const Path& file);
std::string write_tum(const std::vector<Sample>& samples);

}  // namespace chainsplat::trajectory
