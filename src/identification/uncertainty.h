// Private to identification: how sure a fit is, where residuals of neighboring frames are alike.
#pragma once
#include "rollouts.h"

namespace chainsplat::identification {

// Sandwich covariance of the estimate in the position metric ([P] included); recordings are independent. NaN, with a
// warning, where the data leave none.
MatrixX covariance_of(const Problem& problem, const MatrixX& hessian, const Rollouts& rollouts, double limit);

// Eigenvectors of the information about the shared unknowns, those of the initial states eliminated, in units of the
// priors' deviations; the roots of its eigenvalues are the singular values of the weighted, scaled sensitivities.
std::vector<dynamics::Estimates::Weak> weak_directions(const Problem& problem, solve::ArrowEquations data);

}  // namespace chainsplat::identification
