// chainsplat/dynamics/rod.h - the bending stiffness of a rod, and of the joints that stand for it (mathematics.md 3.2).
//
// A rod under tension T bends within sqrt(EI/T) of where it is held, which can be less than a link. Joints as stiff as
// the rod's curvature alone asks for (EI over the length that they stand for) are then too soft; these are such that
// the chain settles as the rod does.
#pragma once
#include <vector>

#include "chainsplat/dynamics.h"

namespace chainsplat::dynamics {

// How much links 1.. hang: the cosine of their angle with gravity, 0 where they are level or point up.
std::vector<double> hanging_shares(const chain::Chain& chain, const VectorX& theta, const math::Pose& base,
                                   const Vector3& gravity);
// Tension, N, in every joint j = 1.. of a rope at rest: the weight of the links and the tip from there on, as much as
// link j hangs; 0 on a table. Per kilogram of rope where the masses are.
std::vector<double> hanging_tension(const Parameters& parameters, const std::vector<double>& shares);

struct RodJoint {
  double stiffness = 0.0;  // N m/rad
  // d stiffness / d log EI, N m/rad: times the rod's retardation time the joint's damping, since a material that bends
  // with EI (1 + retardation d/dt) makes every number that depends on EI do so.
  double slope = 0.0;
};
// Joint j = 1.. of a rod of this bending stiffness (N m^2, not negative) under this tension (N, not negative).
RodJoint rod_joint(const chain::Chain& chain, int joint, double bending_stiffness, double tension);

// The inverse: the bending stiffness, N m^2, of a rod whose joint j has this stiffness, N m/rad, not negative.
double rod_stiffness(const chain::Chain& chain, int joint, double stiffness, double tension);

}  // namespace chainsplat::dynamics
