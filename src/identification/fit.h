// Private to identification: the fits, of the rollout to what was recognized and of angles as in the paper.
#pragma once
#include <functional>

#include "rollouts.h"

namespace chainsplat::identification {

struct Fit {
  VectorX p;
  double cost = kInfinity;
  double limit = kInfinity;  // Huber's, of the root mean square of a whitened group
  solve::Summary summary;    // of the last horizon
};

// Levenberg-Marquardt over the first `horizon` seconds of every recording, from fit.p on.
void improve(const Problem& problem, double horizon, bool fine, int iterations, Fit& fit);

// Best of several starts: stiffness and damping scaled together, then random ones where all fit poorly. `follow` puts
// the problem about the rod of a fit, on the way to the whole recording: else it would be fitted again and again.
Fit fit_centerline(Problem& problem, const Options& options, const std::function<bool(Problem&, VectorX&)>& follow);

// [P]: Adam on half the squared angle differences, gradients by differences of rollouts.
Fit fit_angles(const Problem& problem, const Options& options);

}  // namespace chainsplat::identification
