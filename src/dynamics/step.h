// Private to dynamics: one step of the integrators (SPEC 4) and the factorization that its parts share. No allocation
// after construction.
#pragma once
#include <cmath>
#include <vector>

#include "planar.h"

namespace chainsplat::dynamics {

// LU with partial pivoting in place, for a few dozen unknowns.
class Factor {
 public:
  explicit Factor(int n) : pivot_(n), inverse_(n) { matrix.resize(n, n); }
  MatrixX matrix;  // set it, then factor()

  bool factor() {
    const int n = static_cast<int>(matrix.rows());
    for (int j = 0; j < n; ++j) {
      int best = j;
      for (int i = j + 1; i < n; ++i)
        if (std::abs(matrix(i, j)) > std::abs(matrix(best, j))) best = i;
      pivot_[j] = best;
      if (!(std::abs(matrix(best, j)) > 0.0)) return false;
      if (best != j) matrix.row(j).swap(matrix.row(best));
      const double scale = inverse_[j] = 1.0 / matrix(j, j);
      for (int i = j + 1; i < n; ++i) matrix(i, j) *= scale;
      for (int k = j + 1; k < n; ++k) {
        const double factor = matrix(j, k);
        for (int i = j + 1; i < n; ++i) matrix(i, k) -= factor * matrix(i, j);
      }
    }
    return true;
  }
  template <class Column>
  void solve(Column&& x) const {
    const int n = static_cast<int>(matrix.rows());
    for (int j = 0; j < n; ++j)
      if (pivot_[j] != j) std::swap(x[j], x[pivot_[j]]);
    for (int j = 0; j < n; ++j) {
      const double value = x[j];
      for (int i = j + 1; i < n; ++i) x[i] -= value * matrix(i, j);
    }
    for (int j = n - 1; j >= 0; --j) {
      const double value = x[j] *= inverse_[j];
      for (int i = 0; i < j; ++i) x[i] -= value * matrix(i, j);
    }
  }

 private:
  std::vector<int> pivot_;
  std::vector<double> inverse_;  // of the pivots
};

class Step {
  std::unique_ptr<Engine> engine_, stage_;

 public:
  explicit Step(const Model& model);
  // Linearizes at the node and factors M + G C (+ G^2 K). With the last node's step of 0 there is no factor.
  bool linearize(const BaseGrid::Node& now, const VectorX& theta, const VectorX& thetadot);
  // From the linearized node to the next.
  bool advance(double h, const trajectory::BaseMotion& next, VectorX& theta, VectorX& thetadot);

  Engine& engine;  // at the node
  Factor factor;   // M + G C + G^2 K (Euler: M + h C)
  // After a failure: the first angle beyond all bounds, or without inertia.
  int bad_angle = 0;
  bool singular = false;

  // False, and bad_angle set, where a number is beyond all bounds or NaN.
  bool bounded(const VectorX& theta, const VectorX& thetadot);

 private:
  bool factor_mass(Engine& at);
  bool evaluate(const trajectory::BaseMotion& motion);
  void solve_stage(int i, double g);

  bool rodas_;
  VectorX right_theta_, stage_theta_, stage_thetadot_, stage_acceleration_, work_;
  VectorX k_theta_[4], k_rate_[4];
};

}  // namespace chainsplat::dynamics
