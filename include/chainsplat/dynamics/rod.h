// chainsplat/dynamics/rod.h - the bending stiffness of a rod, and of the joints that stand for it (mathematics.md 3.2).
//
// A joint has EI over the length that it stands for. Not so the one at the grasp of a rope that hangs: its tension T
// straightens it within sqrt(EI/T) of the grasp, which can be less than a link, and a joint of EI over a length would
// be too soft. It is made such that the rope hangs where the rod would, with the same moment at the grasp.
#pragma once

#include "chainsplat/dynamics.h"

namespace chainsplat::dynamics {

// Where the first link goes from the grasp: a unit vector, world axes.
Vector3 first_direction(const chain::Chain& chain, const VectorX& theta, const math::Pose& base);
// Tension, N, at the grasp of a rope at rest whose first link goes in this direction (of any length): its weight times
// the cosine between that and gravity; 0 where it is level or points up, and on a table. Per kilogram of rope where the
// masses are.
double grasp_tension(const Parameters& parameters, const Vector3& direction);

struct RodJoint {
  double stiffness = 0.0;  // N m/rad
  // d stiffness / d log EI, N m/rad: times the rod's retardation time the joint's damping, since a material that bends
  // with EI (1 + retardation d/dt) makes every number that depends on EI do so.
  double slope = 0.0;
};
// Joint j = 1.. of a rod of this bending stiffness (N m^2, not negative) under this tension (N, not negative) at the
// grasp.
RodJoint rod_joint(const chain::Chain& chain, int joint, double bending_stiffness, double tension);

// The inverse: the bending stiffness, N m^2, of a rod whose joint j has this stiffness, N m/rad, not negative.
double rod_stiffness(const chain::Chain& chain, int joint, double stiffness, double tension);

}  // namespace chainsplat::dynamics
