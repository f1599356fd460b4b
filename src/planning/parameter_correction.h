// Private to planning: the model is corrected by what the rope did since the last look (feedback without offset).
//
// An extended Kalman filter on the logarithms of common factors of stiffness, damping, table friction and air drag. The
// state itself is seen; what the model predicted for it from the state before tells how wrong the factors are.
#pragma once
#include "chainsplat/dynamics/parametrization.h"
#include "chainsplat/planning.h"

namespace chainsplat::planning {

struct ParameterCorrection {
  dynamics::Model nominal, model;           // as identified, and corrected
  std::vector<dynamics::Unknown> unknowns;  // those of the four that the nominal parameters have
  VectorX change;                           // of the unknowns from the nominal parameters to the model's: logarithms
  MatrixX covariance;                       // of `change`
};
ParameterCorrection start_correction(const dynamics::Model& model);
// `after` was seen where `before` was seen earlier and the base moved by `base` between them. `arclengths`: the points
// of the rope in whose displacements the prediction's error is weighed.
void correct(ParameterCorrection& correction, const dynamics::BaseFunction& base, const dynamics::InitialState& before,
             const dynamics::InitialState& after, const std::vector<double>& arclengths);

}  // namespace chainsplat::planning
