// chainsplat/dynamics/base_wrench.h - what the gripper must exert to move the rope (mathematics.md 3.12).
#pragma once
#include <vector>

#include "chainsplat/dynamics.h"

namespace chainsplat::dynamics {

// The wrench of the gripper on the rope in free motion: moment about the grasp (the base's origin), N m, then force, N;
// world axes. Per kilogram of rope where the model's masses are relative. A table that carries the weight
// (Parameters::table_carries_weight) takes what acts across its plane: force along the normal and moments in the plane
// are then those of a rope without weight. `friction_state` as in InitialState. Throws InputError, with the joint,
// where the mass matrix is singular.
Vector6 base_wrench(const Model& model, const trajectory::BaseMotion& base, const VectorX& theta,
                    const VectorX& thetadot, const VectorX& friction_state = {});
// At every state of a rollout; `states` need rates.
std::vector<Vector6> base_wrenches(const Model& model, const trajectory::Trajectory& base, const chain::States& states);

}  // namespace chainsplat::dynamics
