// Private to planning: what a stretch of base motion is worth, with gradient and Gauss-Newton matrix.
#pragma once
#include "sensitivities.h"

namespace chainsplat::planning {

// One stretch whose last piece is being planned.
struct Task {
  std::vector<const dynamics::Model*> models;  // one, or the samples
  bool tabletop = false;
  Part part = Part::tip;
  Motion motion;  // the last piece's numbers do not count
  Grid grid;
  dynamics::InitialState initial;
  Vector3 target = Vector3::Zero();           // at `target_time`, at the rope's height
  Vector3 target_velocity = Vector3::Zero();  // m/s
  double target_time = 0.0;
  const Options* options = nullptr;
  std::vector<bool> held;     // unknowns that keep their value
  bool exact = true;          // derivatives of the discrete map
  double limit_weight = 1.0;  // of limits and obstacles, against the usual
  int first_link = 1;         // on a table, of the whole rope: only points from this link on are drawn to the target

  Vector3 target_at(double time) const { return target + (time - target_time) * target_velocity; }
};

struct Sharpness {
  double soft_minimum = 1e5;  // nu, m^-2
  double smoothness = 1e-7;   // alpha, beta of mathematics.md 8, of the mean squared acceleration, s^4
  double clearance = 0.004;   // m from obstacles, below which they cost: they are looked at every 20 ms only
};

// A point of rope or gripper near an obstacle: `weight` times the square of `residual` counts where that is positive,
// and is a part of the gradient and curvature then.
struct Near {
  double residual = 0.0;  // m
  double weight = 0.0;
  VectorX slope;  // of the residual
};

struct Evaluation {
  bool good = false;       // the motion stayed finite
  double value = 0.0;      // m^2
  double miss = 0.0;       // m, hard minimum over the nodes, mean (or worst) of the samples
  double violation = 0.0;  // m^2, the part of limits, obstacles and, on a table, speed left in the end
  VectorX gradient;
  MatrixX curvature;       // Gauss-Newton, positive semidefinite
  std::vector<Near> near;  // with derivatives: what a step may run into, or leave
};
Evaluation evaluate(const Task& task, const VectorX& unknowns, const Sharpness& sharpness, bool derivatives);

// What of the rope counts where nothing is asked for.
Part part_of(const Options& options, bool tabletop);

// Point of the rope nearest to `target` among the candidates of mathematics.md 8.
struct Nearest {
  int link = 0;
  Vector3 point = Vector3::Zero();
  double squared = 0.0;
  double arclength = 0.0;  // m
};
Nearest nearest(const chain::Chain& chain, const std::vector<math::Pose>& motions, Part part, const Vector3& target);

// Hard minimum over a rollout, between its nodes too.
Hit measure(const Task& task, const dynamics::Model& model, const Rollout& rollout);

// Smallest distance of rope and gripper to what must be kept clear, along a rollout, m; infinity without obstacles.
double clearance(const Task& task, const dynamics::Model& model, const Rollout& rollout);

}  // namespace chainsplat::planning
