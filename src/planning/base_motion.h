// Private to planning: the basis functions of a stretch of base motion.
#pragma once
#include "chainsplat/planning.h"

namespace chainsplat::planning {

inline constexpr int kPerAxis = kBasisCount + 1;   // unknowns an axis: the weights, then the terminal offset
using Basis = Eigen::Matrix<double, kPerAxis, 4>;  // an unknown's value and first three time derivatives

// At `time` of a stretch; clamped to its ends, where the derivatives are 0.
Basis basis(Window window, double start, double duration, double time);

// The base and the component-wise derivative of its acceleration from coordinates.
trajectory::BaseMotion base_from(const Motion& motion, const Coordinates& c, math::Vector6* jerk = nullptr);

}  // namespace chainsplat::planning
