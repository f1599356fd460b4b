// src/trajectory/smoothing_spline.h - quintic B-spline curves in R^3, fitted with a penalty on the third derivative.
//
// The minimizer of  sum_k |f(t_k) - y_k|^2 + lambda integral |f'''|^2 dt  over all functions is a quintic spline with
// its knots at the samples: C^4, so acceleration and jerk are continuous. lambda is chosen by generalized cross
// validation (Craven & Wahba 1979), from the data alone.
#pragma once
#include <vector>
#include "chainsplat/math.h"

namespace chainsplat::trajectory {

using Points = Eigen::Matrix<double, Eigen::Dynamic, 3, Eigen::RowMajor>;

struct Spline {
  std::vector<double> knots;  // s; clamped: six times the first and the last
  Points coefficients;        // one row a basis function

  struct Value {
    math::Vector3 position, velocity, acceleration;
  };
  // The end polynomials continue outside the knots.
  Value at(double time) const;
};

struct SplineFit {
  Spline spline;
  double noise = 0.0;             // standard deviation of one coordinate of a sample
  double degrees_of_freedom = 0;  // trace of the hat matrix, 3 (a parabola) .. samples
};

// `times` strictly increasing, at least 3; one row of `values` a sample.
SplineFit fit_spline(const std::vector<double>& times, const Points& values);

}  // namespace chainsplat::trajectory
