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
// The grasp at the height of the free end: a rope that is held above the table lies lower than in its grasp.
Vector3 where_it_lies(const Problem& problem);
// The target at that height, if the rope is on a table.
Vector3 at_rope_height(const Problem& problem, const Vector3& target);

void set_unknowns(Motion& motion, const VectorX& unknowns);  // of the last piece
VectorX unknowns_of(const Motion& motion);

// What one call of minimize() may cost. Damping is a part of the curvature's trace.
struct Effort {
  int steps = 10, evaluations = 80;  // steps taken at most, and rollouts for them
  double damping = 1e-2;             // of the first step; small near a solution
  double more_damping = 6.0;         // times, after a step that did not help
  double longest = 1e300;            // m, of a step's weights
  bool hopeful = true;               // evaluate the derivatives with a step's first trial
  double enough = 0.0;  // m; ends where the miss is smaller, limits and obstacles kept, the rope at rest (table)
};
// Damped Gauss-Newton; ends where nothing changes any more. Costs m^2, steps m (norm of the weights). The evaluations are
// one more than its iterations.
solve::Summary minimize(const Task& task, VectorX& unknowns, const Sharpness& sharpness, const Effort& effort);

// A random motion whose largest peak is `fraction` of its limit.
VectorX random_unknowns(const Task& task, core::Random& random, double fraction);
// Motions that carry a point of the rope as it lies at first to the target, as far as the limits allow.
std::vector<VectorX> carried(const Task& task);
inline constexpr double kLeastLoad = 0.25, kMostLoad = 0.95;  // of the limits, of motions to start from
// The largest peak as a part of its limit, over the grid's nodes.
double load(const Task& task, const VectorX& unknowns);

}  // namespace chainsplat::planning
