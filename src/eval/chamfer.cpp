#include <algorithm>
#include <limits>
#include <numeric>

#include "chainsplat/eval.h"

namespace chainsplat::eval {

using math::MatrixX;
using math::Vector3;

namespace {

constexpr int kLeaf = 8;  // points below which searching all is as fast

// Points sorted so that every half of a range lies on its side of the middle one along the range's widest axis.
class Tree {
 public:
  explicit Tree(const MatrixX& points) : points_(points.cols()), axis_(points.cols(), 0) {
    for (Eigen::Index i = 0; i < points.cols(); ++i) points_[i] = points.col(i);
    build(0, static_cast<int>(points_.size()));
  }

  // Squared distance from x to the nearest point. `near` is any point's index before, the nearest one's after:
  // neighbors in an image have neighbors in the cloud, and a good first guess prunes most of the tree.
  double nearest(const Vector3& x, int& near) const {
    double best = (points_[near] - x).squaredNorm();
    search(x, 0, static_cast<int>(points_.size()), best, near);
    return best;
  }

 private:
  void build(int first, int last) {
    if (last - first <= kLeaf) return;
    Vector3 low = points_[first], high = low;
    for (int i = first + 1; i < last; ++i) {
      low = low.cwiseMin(points_[i]);
      high = high.cwiseMax(points_[i]);
    }
    int axis = 0;
    (high - low).maxCoeff(&axis);
    const int middle = first + (last - first) / 2;
    std::nth_element(points_.begin() + first, points_.begin() + middle, points_.begin() + last,
                     [axis](const Vector3& a, const Vector3& b) { return a[axis] < b[axis]; });
    axis_[middle] = axis;
    build(first, middle);
    build(middle + 1, last);
  }

  void consider(const Vector3& x, int i, double& best, int& near) const {
    const double square = (points_[i] - x).squaredNorm();
    if (square >= best) return;
    best = square;
    near = i;
  }

  void search(const Vector3& x, int first, int last, double& best, int& near) const {
    if (last - first <= kLeaf) {
      for (int i = first; i < last; ++i) consider(x, i, best, near);
      return;
    }
    const int middle = first + (last - first) / 2;
    const double beyond = x[axis_[middle]] - points_[middle][axis_[middle]];
    consider(x, middle, best, near);
    const bool left = beyond < 0.0;
    search(x, left ? first : middle + 1, left ? middle : last, best, near);
    if (beyond * beyond < best) search(x, left ? middle + 1 : first, left ? last : middle, best, near);
  }

  std::vector<Vector3> points_;
  std::vector<int> axis_;
};

double mean_distance(const MatrixX& from, const Tree& to) {
  double sum = 0.0;
  int near = 0;
  for (Eigen::Index i = 0; i < from.cols(); ++i) sum += std::sqrt(to.nearest(from.col(i), near));
  return sum / static_cast<double>(from.cols());
}

}  // namespace

double chamfer(const MatrixX& p, const MatrixX& q) {
  if (p.cols() == 0 || q.cols() == 0) return std::numeric_limits<double>::quiet_NaN();
  return 0.5 * (mean_distance(p, Tree(q)) + mean_distance(q, Tree(p)));
}

}  // namespace chainsplat::eval
