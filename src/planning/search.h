// Private to planning: finding the weights of one stretch.
#pragma once
#include "objective.h"

namespace chainsplat::planning {

// What all stretches of a problem share: the chain's models, the vertical, checks of the request.
std::vector<Axis> default_axes(const chain::Chain& chain);
Motion empty_motion(const Problem& problem, const Options& options);
// Appends a piece of rest from `start` on.
void append_piece(Motion& motion, double start, double duration);
// Grid, initial state and target of the last piece of `motion`. `substeps` a 1/30 s.
Task make_task(const Problem& problem, const Options& options, const std::vector<const dynamics::Model*>& models,
               const Motion& motion, const dynamics::InitialState& initial, const Vector3& target, int substeps);
// The target at the height of the rope on a table.
Vector3 at_rope_height(const Problem& problem, const Vector3& target);

void set_unknowns(Motion& motion, const VectorX& unknowns);  // of the last piece
VectorX unknowns_of(const Motion& motion);

inline constexpr double kFirstDamping = 1e-2;  // of the curvature's trace
// Damped Gauss-Newton; ends after `iterations` evaluations, of which the last is one without derivatives, or when nothing
// changes any more. Returns those it took. `first_damping` is small near a solution. `enough`: ends where the miss is
// smaller, m, with limits and obstacles kept and, on a table, the rope at rest.
int minimize(const Task& task, VectorX& unknowns, const Sharpness& sharpness, int iterations,
             double first_damping = kFirstDamping, double enough = 0.0);

// A random motion whose largest peak is `fraction` of its limit.
VectorX random_unknowns(const Task& task, core::Random& random, double fraction);
// The largest peak as a part of its limit, over the grid's nodes.
double load(const Task& task, const VectorX& unknowns);

}  // namespace chainsplat::planning
