// src/trajectory/smoothing_spline.h - quintic B-spline curves in R^3, fitted with a penalty on the third derivative.
//
// The minimizer of  sum_k |f(t_k) - y_k|^2 + lambda integral |f'''|^2 dt  over all functions is a quintic spline with
// its knots at the samples. It is C^4, so acceleration and jerk are continuous. lambda is chosen from the data alone,
// by generalized cross validation (Craven & Wahba 1979); few samples, or samples far apart, are met instead.
#pragma once
#include <vector>
#include "chainsplat/math.h"

namespace chainsplat::trajectory {

using Points = Eigen::Matrix<double, Eigen::Dynamic, 3, Eigen::RowMajor>;

struct Spline {
  std::vector<double> knots;  // s; clamped: the first and the last are repeated six times
  Points coefficients;        // one row per basis function

  struct Value {
    math::Vector3 position, velocity, acceleration;
  };
  // Evaluates the curve; outside the knots the end polynomials continue.
  Value at(double time) const;
};

struct SplineFit {
  Spline spline;
  double noise = 0.0;             // standard deviation of one coordinate of a sample, in the unit of the values
  double degrees_of_freedom = 0;  // trace of the hat matrix, from 3 (a parabola) to the number of samples
};

// Fits at least 3 samples with strictly increasing `times`; `values` has one row per sample.
SplineFit fit_spline(const std::vector<double>& times, const Points& values);

}  // namespace chainsplat::trajectory
