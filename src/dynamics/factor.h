// Private to dynamics: the linear systems of implicit steps.
#pragma once
#include <cmath>
#include <utility>
#include <vector>

#include "chainsplat/dynamics.h"

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
  // The same of every column, with the same bits: many at a time, row by row.
  template <class Columns>
  void solve_columns(Columns&& x) const {
    const int n = static_cast<int>(matrix.rows());
    if (x.cols() == 1) return solve(x.col(0));
    rows_ = x;
    for (int j = 0; j < n; ++j)
      if (pivot_[j] != j) rows_.row(j).swap(rows_.row(pivot_[j]));
    for (int j = 0; j < n; ++j)
      for (int i = j + 1; i < n; ++i) rows_.row(i) -= matrix(i, j) * rows_.row(j);
    for (int j = n - 1; j >= 0; --j) {
      rows_.row(j) *= inverse_[j];
      for (int i = 0; i < j; ++i) rows_.row(i) -= matrix(i, j) * rows_.row(j);
    }
    x = rows_;
  }

 private:
  mutable Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor> rows_;  // of solve_columns
  std::vector<int> pivot_;
  std::vector<double> inverse_;  // of the pivots
};

}  // namespace chainsplat::dynamics
