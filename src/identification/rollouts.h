// Private to identification: rollouts of all recordings, how far they are from what was recognized, and the normal
// equations of that.
#pragma once
#include "chainsplat/solve.h"
#include "problem.h"

namespace chainsplat::identification {

// All recordings up to a horizon.
struct Rollouts {
  std::vector<dynamics::BaseGrid> grids;
  std::vector<chain::States> states;
  std::vector<dynamics::Sensitivities> slopes;
  std::vector<std::vector<MatrixX>> values;  // whitened residuals per recording and frame

  Rollouts(const Problem& problem, double horizon, bool fine);
  // False where a motion leaves all bounds.
  bool run(const Problem& problem, const VectorX& p, bool with_slopes);
  // With the prior. `limit`: as in loss_of().
  double cost(const Problem& problem, const VectorX& p, double limit) const;
};

// Of the groups' root mean squares. A group is all angles of a frame, or a marker.
double median_rms(const std::vector<std::vector<MatrixX>>& values);

// Whitened residuals of a frame and, where asked for, their derivatives by the unknowns, with the roots of Huber's
// weights.
struct Rows {
  VectorX right;
  MatrixX slopes;  // residuals x unknowns
};
// Of frame k. `limit`: root mean square of a group from where on Huber's loss grows linearly.
void weighted_rows(const Part& part, const chain::States& states, const dynamics::Sensitivities* slopes,
                   const std::vector<MatrixX>& values, double limit, std::size_t k, Rows& out);

// Of all recordings, without the prior: an initial state is a local block.
solve::ArrowEquations normal_equations(const Problem& problem, const Rollouts& rollouts, double limit);

// Adds the prior at p. It links the shared unknowns with no initial state.
void add_prior(const Problem& problem, const VectorX& p, solve::ArrowEquations& equations);

// Residuals of a fit: their root mean square in units of what one alone is expected to be off, and how many there are.
struct Misfit {
  double scale = kInfinity;
  double count = 0.0;
};
Misfit misfit_of(const Rollouts& rollouts);

}  // namespace chainsplat::identification
