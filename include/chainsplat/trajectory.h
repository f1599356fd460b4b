// chainsplat/trajectory.h - the grasped end's motion on SE(3): a smoothing spline with analytic twist (SPEC 1, 4).
//
// Double differences of sampled poses are not accelerations (late by half a sample, noise times 4/h^2): a C^3 smoothing
// quintic B-spline is fitted to each world coordinate of the position and to the rotation vector relative to a
// reference rotation, with the noise level estimated from the residual, and T_b, V_b and dV_b/dt are evaluated
// analytically.
#pragma once
#include <memory>
#include <span>
#include <string>
#include <vector>
#include "chainsplat/core.h"
#include "chainsplat/math.h"

namespace chainsplat::trajectory {

// The base at one instant. V_b = (T_b^-1 dT_b/dt)^vee and its component-wise derivative, both in the base frame.
struct BaseMotion {
  math::Pose pose;                                     // T_sb
  math::Vector6 velocity = math::Vector6::Zero();      // V_b, rad/s and m/s
  math::Vector6 acceleration = math::Vector6::Zero();  // dV_b/dt, without gravity
};

struct Sample {
  double time = 0.0;
  math::Pose pose;
};

// A fitted trajectory; cheap to copy. It goes on for half a sample interval beyond [start, end] (times in files are
// rounded) and rests outside that.
class Trajectory {
 public:
  Trajectory() = default;
  BaseMotion at(double time) const;
  math::Pose pose(double time) const;
  double start() const;
  double end() const;
  double noise() const;  // estimated standard deviation of the position samples, m
  const std::vector<Sample>& samples() const;
  struct Data;
  explicit Trajectory(std::shared_ptr<const Data> data) : data_(std::move(data)) {}

 private:
  std::shared_ptr<const Data> data_;
};

// Fits samples (times strictly increasing, at least one; one sample means at rest): the minimizer of the squared
// residuals plus lambda times the integrated square of the third derivative (a C^4 spline), lambda by generalized cross
// validation, once for the position and once for the rotation vector r of R = R_0 exp([r]), R_0 the first sample's
// rotation, r continued beyond half a turn. Body twists are J_r(r) dr/dt and its derivative, J_r the right Jacobian of
// exp. Throws InputError with `where` named (non-finite numbers, times out of order, more than half a turn between
// samples, more than a whole turn from the first sample about a changing axis: r has no smooth continuation there).
Trajectory fit(std::vector<Sample> samples, const std::string& where);
// 'timestamp tx ty tz qx qy qz qw' a line, '#' comments. Throws InputError with file and line.
std::vector<Sample> read_tum(const Path& file);
std::string write_tum(const std::vector<Sample>& samples);

}  // namespace chainsplat::trajectory
