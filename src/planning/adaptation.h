// Private to planning: the model is corrected by what the rope did since the last look (feedback without offset).
//
// An extended Kalman filter on the logarithms of common factors of stiffness, damping, table friction and air drag. The
// state itself is seen; what the model predicted for it from the state before tells how wrong the factors are.
#pragma once
#include "chainsplat/planning.h"

namespace chainsplat::planning {

struct Adaptation {
  dynamics::Model nominal, model;         // as identified, and with the factors
  std::vector<dynamics::Tangent> groups;  // of the nominal parameters, one a factor: the derivative by its logarithm
  VectorX factors;                        // logarithms
  MatrixX covariance;
};
Adaptation start_adaptation(const dynamics::Model& model);
// `after` was seen where `before` was seen earlier and the base moved by `base` between them. `arclengths`: the points
// of the rope in whose displacements the prediction's error is weighed.
void adapt(Adaptation& adaptation, const dynamics::BaseFunction& base, const dynamics::InitialState& before,
           const dynamics::InitialState& after, const std::vector<double>& arclengths);

}  // namespace chainsplat::planning
