#include "chainsplat/dynamics/rolling.h"

#include <algorithm>
#include <cmath>

#include "chainsplat/core.h"
#include "src/math/tridiagonal.h"

namespace chainsplat::dynamics {

namespace {

constexpr double kLeastSpeed = 1e-6;   // m/s; its square must not vanish
constexpr double kLeastPivot = 1e-15;  // N m s: a rope without stiffness and friction stays as it is

}  // namespace

// Of the rates: the gradient, and the positive parts of the second derivative.
struct Roller::System {
  VectorX gradient;
  math::Tridiagonal curvature;
};

Roller::Roller(const Model& model, const Rolling& rolling)
    : chain_(model.chain), parameters_(model.parameters), speed_(std::max(rolling.speed, kLeastSpeed)) {
  const int joints = chain_.links() - 1;
  CHAINSPLAT_CHECK(parameters_.table_normal && chain_.angles() == joints, std::to_string(chain_.angles()));
  CHAINSPLAT_CHECK(static_cast<int>(rolling.set.size()) == joints, std::to_string(rolling.set.size()));
  CHAINSPLAT_CHECK(static_cast<int>(rolling.texture.size()) == joints + 1, std::to_string(rolling.texture.size()));
  texture_ = Eigen::Map<const VectorX>(rolling.texture.data(), joints + 1);
  const double weight = std::abs(parameters_.table_normal->dot(parameters_.gravity));
  double bending = 0.0, retardation = 0.0;  // EI, N m^2, and s; means over the joints
  for (int k = 0; k < joints; ++k) {
    const double stiffness = parameters_.stiffness[k];
    bending += stiffness * chain::bent_length(chain_, k + 1) / joints;
    if (stiffness > 0.0) retardation += parameters_.damping[k] / stiffness / joints;
    friction_.push_back(rolling.friction * parameters_.coulomb_friction[k] * parameters_.link_mass[k] * weight);
  }
  for (int k = 0; k < joints; ++k) {
    const double length = chain::bent_length(chain_, k + 1);
    torsion_.push_back(rolling.torsion * bending / length);
    torsion_damping_.push_back(torsion_.back() * retardation);
    set_.push_back(rolling.set[k] * length);
  }
  roll_ = rate_ = VectorX::Zero(joints);
}

Roller::Place Roller::place_of(double time, const math::Pose& base, const VectorX& theta) const {
  const std::vector<math::Pose> motions = chain::link_motions(chain_, theta, base);
  Place out{time, theta, {}, {}};
  for (int link = 1; link < chain_.links(); ++link) {
    const double middle = 0.5 * (chain_.link_start(link) + chain_.link_end(link));
    out.middle.push_back(motions[link] * Vector3(middle * chain_.direction));
    out.side.push_back(parameters_.table_normal->cross(motions[link].rotation * chain_.direction));
  }
  return out;
}

// What a step of these rates would cost: the power of friction and dampers, and the elastic energy at its end over the
// step's length.
double Roller::potential(const VectorX& rate, double step, System* system) const {
  const Parameters& p = parameters_;
  const Eigen::Index count = rate.size();
  double sum = 0.0;
  if (system) *system = {VectorX::Zero(count), {kLeastPivot, VectorX::Zero(count), VectorX::Zero(count)}};
  for (Eigen::Index i = 0; i < count; ++i) {
    // friction at the underside
    const Vector3 slip = velocity_[i] + p.radius * rate[i] * side_[i];
    const double across = slip.dot(side_[i]), size = std::sqrt(slip.squaredNorm() + speed_ * speed_);
    sum += friction_[i] * size;
    // the joint before this link: its twist, and the mean roll of what it bends
    const double rate_before = i > 0 ? rate[i - 1] : 0.0, roll_before = i > 0 ? roll_[i - 1] + step * rate_before : 0.0;
    const double roll = roll_[i] + step * rate[i], twist = roll - roll_before, twist_rate = rate[i] - rate_before;
    const double mean = 0.5 * (roll + roll_before), mean_rate = 0.5 * (rate[i] + rate_before);
    const double in_plane = p.rest_angle[i] * std::cos(mean) + set_[i] * std::sin(mean);
    const double out_of_plane = set_[i] * std::cos(mean) - p.rest_angle[i] * std::sin(mean);
    const double moment = p.stiffness[i] * bend_[i], drag = p.damping[i] * bend_[i] * bend_[i];
    sum += 0.5 * torsion_[i] * twist * twist / step + 0.5 * torsion_damping_[i] * twist_rate * twist_rate +
           0.5 * drag * mean_rate * mean_rate - moment * in_plane / step;
    if (!system) continue;
    const double stiff = torsion_[i] * step + torsion_damping_[i];
    const double turning = torsion_[i] * twist + torsion_damping_[i] * twist_rate;
    const double half = 0.5 * (drag * mean_rate - moment * out_of_plane);
    const double curved = 0.25 * (drag + std::max(0.0, moment * in_plane * step));
    system->gradient[i] += friction_[i] * p.radius * across / size + turning + half;
    system->curvature.diagonal[i] +=
        friction_[i] * p.radius * p.radius * (1.0 - across * across / (size * size)) / size + stiff + curved;
    if (i == 0) continue;
    system->gradient[i - 1] += half - turning;
    system->curvature.diagonal[i - 1] += stiff + curved;
    system->curvature.beside[i] = curved - stiff;
  }
  return sum;
}

// From the share `from` of the way to a place to the share `until`: Newton's method on the rates.
void Roller::step(const Place& to, double from, double until) {
  constexpr int kIterations = 30, kHalvings = 12;
  constexpr double kEnough = 1e-4;  // rad/s
  const Eigen::Index count = rate_.size();
  const double interval = to.time - last_->time, middle = 0.5 * (from + until), step = (until - from) * interval;
  velocity_.clear(), side_.clear();
  for (Eigen::Index i = 0; i < count; ++i) {
    velocity_.push_back((to.middle[i] - last_->middle[i]) / interval);
    side_.push_back(((1.0 - middle) * last_->side[i] + middle * to.side[i]).normalized());
  }
  bend_ = (1.0 - middle) * last_->theta + middle * to.theta;
  System system;
  for (int iteration = 0; iteration < kIterations; ++iteration) {
    const double now = potential(rate_, step, &system);
    system.curvature.factor();
    VectorX move = -system.gradient;
    system.curvature.solve(move);
    double share = 1.0;
    for (int halving = 0; halving < kHalvings && !(potential(rate_ + share * move, step, nullptr) <= now); ++halving)
      share *= 0.5;
    rate_ += share * move;
    if (share * move.cwiseAbs().maxCoeff() < kEnough) break;
  }
  roll_ += step * rate_;
}

VectorX Roller::advance(double time, const math::Pose& base, const VectorX& theta) {
  constexpr double kLongestStep = 1.0 / 60.0;  // s
  constexpr double kMostSteps = 600.0;         // after a gap
  Place place = place_of(time, base, theta);
  if (last_) {
    CHAINSPLAT_CHECK(time > last_->time, std::to_string(time));
    const int steps =
        static_cast<int>(std::clamp(std::ceil((time - last_->time) / kLongestStep - 1e-6), 1.0, kMostSteps));
    for (int i = 0; i < steps; ++i) step(place, static_cast<double>(i) / steps, static_cast<double>(i + 1) / steps);
  }
  last_ = std::move(place);
  VectorX out = -texture_;
  out.tail(roll_.size()) += roll_;
  return out;
}

std::vector<VectorX> rolls_along(const Model& model, const Rolling& rolling, const trajectory::Trajectory& base,
                                 const chain::States& states) {
  Roller roller(model, rolling);
  std::vector<VectorX> out;
  for (std::size_t k = 0; k < states.time.size(); ++k)
    out.push_back(roller.advance(states.time[k], base.pose(states.time[k]), states.theta[k]));
  return out;
}

}  // namespace chainsplat::dynamics
