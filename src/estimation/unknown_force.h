// unknown_force.h - the force on the rope that its model does not contain, as shifts of the rest angles: how likely it
// is, where it acts, and how long a contact lasts (mathematics.md 6.5).
#pragma once
#include "src/estimation/state.h"

namespace chainsplat::estimation {

constexpr double kContactMemory = 0.5;  // s, for which a contact is assumed to go on

// Returns the covariance of the shifts of the rest angles that stand for a random force of `deviation` N on the rope,
// which acts at the links' ends with the shares `place`.
math::MatrixX shift_covariance(const dynamics::Model& model, const math::Pose& base, const math::VectorX& theta,
                               double deviation, const math::VectorX& place);

// Returns, per link, the shift of the rest angles that stands for a blow which stops the link's end in the world: a
// force against the end's velocity throughout the step. `rate_by_shift`: n x n, derivative of the predicted rates.
std::vector<math::VectorX> stopping_shifts(const dynamics::Model& model, const trajectory::BaseMotion& base,
                                           const math::VectorX& theta, const math::VectorX& thetadot,
                                           const math::MatrixX& rate_by_shift);

// After a frame, learns where the unknown force acts and whether the contact continues.
void learn_force(State& state, double time);

}  // namespace chainsplat::estimation
