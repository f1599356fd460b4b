// tridiagonal.h - symmetric matrices whose entries lie on the diagonal and beside it: what neighbors along a rope
// share.
#pragma once
#include <algorithm>

#include "chainsplat/math.h"

namespace chainsplat::math {

struct Tridiagonal {
  double least = 0.0;   // pivot: smaller ones are raised to it, and the matrix with them
  VectorX diagonal;     // n
  VectorX beside = {};  // n: entry j is (j, j - 1); the first one is not read
  VectorX pivot = {};   // n, by factor()

  void factor() {
    pivot.resize(diagonal.size());
    for (Eigen::Index j = 0; j < diagonal.size(); ++j) {
      const double own = j > 0 ? diagonal[j] - beside[j] * beside[j] / pivot[j - 1] : diagonal[j];
      pivot[j] = std::max(own, least);
    }
  }
  // The inverse times the columns of x, in place.
  template <class X>
  void solve(X&& x) const {
    const Eigen::Index count = x.rows();
    for (Eigen::Index j = 1; j < count; ++j) x.row(j) -= (beside[j] / pivot[j - 1]) * x.row(j - 1);
    for (Eigen::Index j = count - 1; j >= 0; --j) {
      if (j + 1 < count) x.row(j) -= beside[j + 1] * x.row(j + 1);
      x.row(j) /= pivot[j];
    }
  }
};

}  // namespace chainsplat::math
