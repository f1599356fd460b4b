// setup.h - what is learned of the base's clock, the grasp and the cameras while a rope is followed
// (mathematics.md 6.8).
#pragma once
#include "chainsplat/correction_fit.h"
#include "src/estimation/state.h"

namespace chainsplat::estimation {

// What is known before the first frame. `given`: with its model, cameras, base and table. `unverified`: by camera
// whether no training has compared its pose with the rope; empty: none.
Setup first_setup(const Given& given, const std::vector<char>& unverified);

// What the base's motion is corrected by, from the setup's mean.
BaseCorrection base_correction(const math::VectorX& mean);
// The covariance of it, m x m, and the standard deviation of how late the base's stamps are, s.
math::MatrixX covariance(const Setup& setup);
double late_deviation(const Setup& setup);
// How the rope moves relative to each camera with each of the setup's numbers, if no angle changes: one twist per
// number (world frame, angular part first), 6 x m per camera. A camera whose pose is not learned has no columns of its
// own.
std::vector<math::MatrixX> rope_twists(const State& state, double time);

// What a frame that is explained says of the setup, and how its angles follow it. The belief before it was `predicted`,
// and its masks found the angles `theta`. None where it says nothing.
std::optional<silhouette::SetupEquations> look_at_setup(const State& state, std::span<const capture::View* const> views,
                                                        const Belief& predicted, const math::VectorX& theta);
// Takes what it says. The state's cameras and its belief, if it has one, move with the setup.
void learn_setup(State& state, silhouette::SetupEquations frame, const Belief& predicted);

// Whether the base's velocity at this time, s, may be clearly another than its stamps say, because its clock is not
// known well enough yet. A rope that follows such a base seems to be pushed.
bool may_go_otherwise(const State& state, double time);

// As Filter::findings().
std::vector<capture::Finding> findings(const State& state);

}  // namespace chainsplat::estimation
