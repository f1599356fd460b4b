#include "chainsplat/trajectory.h"

#include <algorithm>
#include <cmath>
#include <numbers>

#include "smoothing_spline.h"

namespace chainsplat::trajectory {

using math::Matrix3;
using math::Vector3;

namespace {

constexpr double kLongest = 86400.0;  // s; a rope may be followed for hours (the integration has a bound of its own)
constexpr double kFarthest = 1e6;     // m from the origin; the remaining digits still resolve a rope's motion
constexpr double kSeriesAngle = 0.1;  // rad; below it the series of the right Jacobian are exact to rounding

// For R = R_0 exp([r]), computes the body angular velocity w = J_r(r) r' and its derivative, with the right Jacobian
//   J_r = I - b W + c W^2,  W = [r],  b = (1 - cos x)/x^2,  c = (x - sin x)/x^3,  x = |r|,
//   J_r' = -b' W - b W' + c' W^2 + c (W' W + W W'),  b' = b_1 (r . r'),  c' = c_1 (r . r'),
//   b_1 = (db/dx)/x = (sin x / x - 2 b)/x^2,  c_1 = (dc/dx)/x = (b - 3 c)/x^2.
void body_rotation(const Vector3& r, const Vector3& rate, const Vector3& rate_derivative, Vector3& velocity,
                   Vector3& acceleration) {
  const double x = r.norm(), x2 = x * x;
  double b, c, b1, c1;
  if (x < kSeriesAngle) {
    b = 1.0 / 2 + x2 * (-1.0 / 24 + x2 * (1.0 / 720 + x2 * (-1.0 / 40320 + x2 / 3628800)));
    c = 1.0 / 6 + x2 * (-1.0 / 120 + x2 * (1.0 / 5040 + x2 * (-1.0 / 362880 + x2 / 39916800)));
    b1 = -1.0 / 12 + x2 * (1.0 / 180 + x2 * (-1.0 / 6720 + x2 / 453600));
    c1 = -1.0 / 60 + x2 * (1.0 / 1260 + x2 * (-1.0 / 60480 + x2 / 4989600));
  } else {
    const double half = std::sin(0.5 * x);
    b = 2.0 * half * half / x2;
    c = (x - std::sin(x)) / (x2 * x);
    b1 = (std::sin(x) / x - 2.0 * b) / x2;
    c1 = (b - 3.0 * c) / x2;
  }
  const double product = r.dot(rate);
  const Matrix3 w = math::hat(r), w_rate = math::hat(rate);
  const Matrix3 jacobian = Matrix3::Identity() - b * w + c * w * w;
  const Matrix3 jacobian_rate = -b1 * product * w - b * w_rate + c1 * product * w * w + c * (w_rate * w + w * w_rate);
  velocity = jacobian * rate;
  acceleration = jacobian * rate_derivative + jacobian_rate * rate;
}

// Returns the rotation vector nearest to `previous` among those of the same rotation, r (1 + 2 pi m / |r|).
Vector3 nearest_turn(const Vector3& r, const Vector3& previous) {
  const double angle = r.norm();
  // at a whole turn the axis is arbitrary: keep the previous one
  constexpr double kWholeTurn = 1e-9;  // rad
  if (angle < kWholeTurn && previous.norm() < std::numbers::pi) return r;
  const Vector3 axis = angle < kWholeTurn ? previous.normalized() : Vector3(r / angle);
  const double turns = std::round((previous.dot(axis) - angle) / (2.0 * std::numbers::pi));
  return (angle + 2.0 * std::numbers::pi * turns) * axis;
}

}  // namespace

struct Trajectory::Data {
  std::vector<Sample> samples;
  bool at_rest = true;  // a single sample, without splines
  Matrix3 reference = Matrix3::Identity();
  Spline position, rotation;
  double slack = 0.0;  // s, half the median sample interval
  double noise = 0.0;
};

Trajectory fit(std::vector<Sample> samples, const std::string& where) {
  // check what was read
  if (samples.empty()) throw InputError(where, "no pose in it", "give at least one");
  for (std::size_t k = 0; k < samples.size(); ++k) {
    const Sample& sample = samples[k];
    const std::string which = where + ": pose " + std::to_string(k + 1);
    if (!std::isfinite(sample.time) || !sample.pose.rotation.allFinite() || !sample.pose.translation.allFinite())
      throw InputError(which, "a number is not finite", "remove the pose or fill it from its neighbors");
    if (sample.pose.translation.cwiseAbs().maxCoeff() > kFarthest)
      throw InputError(which,
                       "lies more than " + std::to_string(static_cast<int>(kFarthest)) +
                           " m from the origin, too far for exact numbers",
                       "write meters from an origin near the rope");
    if (k > 0 && !(sample.time > samples[k - 1].time))
      throw InputError(
          which,
          "its time " + core::exact(sample.time) + " s does not come after " + core::exact(samples[k - 1].time) + " s",
          "sort the poses by time and remove doubles");
    if (sample.time - samples.front().time > kLongest)
      throw InputError(which,
                       "comes " + core::exact(sample.time - samples.front().time) +
                           " s after the first and a motion lasts at most " + core::exact(kLongest) + " s",
                       "write times in seconds, or split the recording");
  }

  // coordinates to fit: positions, and rotation vectors from the first rotation continued beyond half a turn
  auto data = std::make_shared<Trajectory::Data>();
  data->samples = std::move(samples);
  const std::vector<Sample>& poses = data->samples;
  data->reference = poses.front().pose.rotation;
  const int count = static_cast<int>(poses.size());
  if (count > 1) {
    data->at_rest = false;
    std::vector<double> times;
    Points positions(count, 3), rotations(count, 3);
    for (int k = 0; k < count; ++k) {
      times.push_back(poses[k].time);
      positions.row(k) = poses[k].pose.translation.transpose();
      const Vector3 r = math::log_so3(data->reference.transpose() * poses[k].pose.rotation);
      rotations.row(k) = (k == 0 ? r : nearest_turn(r, rotations.row(k - 1).transpose())).transpose();
      if (k > 0 && (rotations.row(k) - rotations.row(k - 1)).norm() > std::numbers::pi)
        throw InputError(where + ": pose " + std::to_string(k + 1),
                         "the base turns by more than half a turn since the pose before, or by more than a whole turn "
                         "about a changing axis since the first",
                         "sample it more densely or split the recording");
    }
    if (count == 2) {  // the midpoint makes the fit unique: two points do not fix a parabola, which has no penalty
      times.insert(times.begin() + 1, 0.5 * (times[0] + times[1]));
      for (Points* points : {&positions, &rotations}) {
        const Points two = *points;
        points->resize(3, 3);
        *points << two.row(0), 0.5 * (two.row(0) + two.row(1)), two.row(1);
      }
    }
    // fit, and take half the median interval as the slack at the ends
    SplineFit position = fit_spline(times, positions), rotation = fit_spline(times, rotations);
    data->position = std::move(position.spline);
    data->rotation = std::move(rotation.spline);
    data->noise = position.noise;
    std::vector<double> intervals;
    for (int k = 1; k < count; ++k) intervals.push_back(poses[k].time - poses[k - 1].time);
    data->slack = 0.5 * math::median(intervals);
  }
  return Trajectory(std::move(data));
}

BaseMotion Trajectory::at(double time) const {
  CHAINSPLAT_CHECK(data_ != nullptr, "a trajectory that was never fitted");
  BaseMotion motion;
  if (data_->at_rest) {
    motion.pose = data_->samples.front().pose;
    return motion;
  }
  const double inside = std::clamp(time, start() - data_->slack, end() + data_->slack);
  const Spline::Value position = data_->position.at(inside), rotation = data_->rotation.at(inside);
  motion.pose = {data_->reference * math::exp_so3(rotation.position), position.position};
  if (inside != time) return motion;
  // world velocities to the body twist; the derivative of R^T p' is R^T p'' - w x v
  Vector3 w, w_rate;
  body_rotation(rotation.position, rotation.velocity, rotation.acceleration, w, w_rate);
  const Matrix3 to_base = motion.pose.rotation.transpose();
  const Vector3 v = to_base * position.velocity;
  motion.velocity << w, v;
  motion.acceleration << w_rate, to_base * position.acceleration - w.cross(v);
  return motion;
}

std::vector<Sample> continued(const Trajectory& trajectory, double first, double last) {
  std::vector<Sample> samples = trajectory.samples();
  if (samples.size() < 2) return samples;
  const double interval = (trajectory.end() - trajectory.start()) / static_cast<double>(samples.size() - 1);
  const auto beyond = [&](double needed, double from, double direction) {
    std::vector<Sample> out;
    const BaseMotion motion = trajectory.at(from);
    const int count = static_cast<int>(std::ceil(std::min(needed, kLongestContinuation) / interval));
    for (int i = 1; i <= count; ++i) {
      const double t = direction * i * interval;
      const math::Vector6 twist = t * motion.velocity + 0.5 * t * t * motion.acceleration;
      out.push_back({from + t, motion.pose * math::exp_se3(twist)});
    }
    return out;
  };
  const std::vector<Sample> after = beyond(last - trajectory.end(), trajectory.end(), 1.0);
  std::vector<Sample> before = beyond(trajectory.start() - first, trajectory.start(), -1.0);
  std::reverse(before.begin(), before.end());
  samples.insert(samples.end(), after.begin(), after.end());
  samples.insert(samples.begin(), before.begin(), before.end());
  return samples;
}

math::Pose Trajectory::pose(double time) const { return at(time).pose; }
double Trajectory::start() const { return data_ ? data_->samples.front().time : 0.0; }
double Trajectory::end() const { return data_ ? data_->samples.back().time : 0.0; }
double Trajectory::noise() const { return data_ ? data_->noise : 0.0; }

const std::vector<Sample>& Trajectory::samples() const {
  static const std::vector<Sample> none;
  return data_ ? data_->samples : none;
}

}  // namespace chainsplat::trajectory
