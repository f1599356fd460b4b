#include "chainsplat/dynamics/rod.h"

#include <algorithm>
#include <cmath>

namespace chainsplat::dynamics {
namespace {

// Of sqrt(EI/T): beside it, a link that is as short as this is as good as without tension, and the formulas only lose
// digits.
constexpr double kShort = 1e-4;
// Of sqrt(EI/T): what a base link leaves of it at least. One that is longer than sqrt(EI/T) would leave nothing.
constexpr double kLeastLeft = 0.02;

double stiffness_of(const chain::Chain& chain, int joint, double bending_stiffness, double tension) {
  const double straight = bending_stiffness / chain::bent_length(chain, joint);
  if (joint > 1 || !(tension > 0.0) || !(bending_stiffness > 0.0)) return straight;
  const double decay = std::sqrt(bending_stiffness / tension);  // m
  const double own = chain.link_end(1) - chain.link_start(1);
  const double before = chain.link_end(0) - chain.link_start(0);
  if (own / decay < kShort) return straight;
  // the slopes of a chain's links fall by a factor of 1 - lost from link to link
  const double lost = -std::expm1(-2.0 * std::asinh(0.5 * own / decay));
  // the slope of the first link, over that of the clamp, with which the rope below hangs where the rod's would
  const double slope = std::max(decay - before, kLeastLeft * decay) / own * lost;
  return tension * own / lost * slope / (1.0 - slope);
}

}  // namespace

Vector3 first_direction(const chain::Chain& chain, const VectorX& theta, const math::Pose& base) {
  return chain::link_motions(chain, theta, base)[1].rotation * chain.direction;
}

double grasp_tension(const Parameters& parameters, const Vector3& direction) {
  if (parameters.table_normal) return 0.0;
  return std::max(0.0, total_mass(parameters) * parameters.gravity.dot(direction.normalized()));
}

RodJoint rod_joint(const chain::Chain& chain, int joint, double bending_stiffness, double tension) {
  if (joint > 1 || !(tension > 0.0)) {
    const double stiffness = stiffness_of(chain, joint, bending_stiffness, 0.0);
    return {stiffness, stiffness};
  }
  constexpr double kStep = 1e-4;  // of log EI: central differences are exact to 1e-8
  const auto at = [&](double by) { return stiffness_of(chain, joint, bending_stiffness * std::exp(by), tension); };
  return {at(0.0), (at(kStep) - at(-kStep)) / (2.0 * kStep)};
}

double rod_stiffness(const chain::Chain& chain, int joint, double stiffness, double tension) {
  if (!(stiffness > 0.0)) return 0.0;
  // It grows with the rod's: bisection of its logarithm, from the rod that it is without tension.
  constexpr double kWidest = 40.0;  // of a logarithm: under a tension that no such joint can stand the rod is limp
  constexpr int kHalvings = 50;     // of an interval of length 1 and more, to the last digits
  const auto softer = [&](double logarithm) {
    return stiffness_of(chain, joint, std::exp(logarithm), tension) < stiffness;
  };
  const double start = std::log(stiffness * chain::bent_length(chain, joint));
  double low = start, high = start;
  while (softer(high) && high < start + kWidest) high += 1.0;
  while (!softer(low) && low > start - kWidest) low -= 1.0;
  for (int i = 0; i < kHalvings; ++i) {
    const double middle = 0.5 * (low + high);
    (softer(middle) ? low : high) = middle;
  }
  return std::exp(0.5 * (low + high));
}

}  // namespace chainsplat::dynamics
