#include <algorithm>
#include <limits>
#include <numeric>
#include <optional>

#include "chainsplat/eval.h"
#include "src/eval/depth_image.h"

namespace chainsplat::eval {

using math::MatrixX;
using math::Vector2;
using math::Vector3;

namespace {

constexpr int kLeaf = 8;  // points; testing so few one by one is as fast as going deeper

// A k-d tree without nodes: points sorted so that each half of a range lies on its side of the middle point along the
// range's widest axis.
class Tree {
 public:
  explicit Tree(const MatrixX& points) : points_(points.cols()), axis_(points.cols(), 0) {
    for (Eigen::Index i = 0; i < points.cols(); ++i) points_[i] = points.col(i);
    build(0, static_cast<int>(points_.size()));
  }

  // Squared distance from x to the nearest point. `near` is the index of any point on entry and of the nearest one on
  // return: neighbors in an image have near neighbors in the cloud, and a good first guess prunes most of the tree.
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

constexpr int kFarRings = 12;  // px; if the nearest point is farther away in the image, the tree finds it sooner

// The points of a depth image, in the camera frame.
struct PixelCloud {
  int width = 0, height = 0;
  std::vector<Vector3> points;  // one per pixel; z = 0: none
  MatrixX columns;              // those with a depth

  PixelCloud(const DepthImage& image, const capture::Camera& camera)
      : width(image.width), height(image.height), points(image.depth.size(), Vector3::Zero()) {
    const auto there = std::count_if(image.depth.begin(), image.depth.end(), [](float z) { return z > 0.0f; });
    columns.resize(3, there);
    Eigen::Index next = 0;
    for (std::size_t k = 0; k < image.depth.size(); ++k) {
      const double z = image.depth[k];
      if (!(z > 0.0)) continue;
      const int column = static_cast<int>(k) % width, row = static_cast<int>(k) / width;
      Vector2 pixel(image.x0 + column + 0.5, image.y0 + row + 0.5);
      if (camera.distorted()) pixel = capture::undistort(camera, pixel);
      points[k] = {(pixel.x() - camera.cx) / camera.fx * z, (pixel.y() - camera.cy) / camera.fy * z, z};
      columns.col(next++) = points[k];
    }
  }
};

// The nearest point usually lies on the ray of a nearby pixel: the search visits pixels in growing rings, until no ray
// farther out can come closer than the best point so far. This is exact for a camera without distortion; the rays of a
// distorted one form no regular grid, and the tree is used.
double mean_distance(const PixelCloud& from, const PixelCloud& to, const capture::Camera& camera) {
  std::optional<Tree> tree;
  int hint = 0;
  const auto by_tree = [&](const Vector3& x) {
    if (!tree) tree.emplace(to.columns);
    return tree->nearest(x, hint);
  };
  // squared lower bound of the distance from x to the rays of pixels at least `ring` columns or rows away: the distance
  // to the planes through the nearest of these columns and rows
  const auto beyond = [&](const Vector3& x, int ring) {
    const double u = ring / camera.fx, v = ring / camera.fy;
    const double far_u = std::abs(x.x()) / x.z() + u, far_v = std::abs(x.y()) / x.z() + v;
    return x.z() * x.z() * std::min(u * u / (1.0 + far_u * far_u), v * v / (1.0 + far_v * far_v));
  };
  double sum = 0.0;
  for (int py = 0; py < from.height; ++py) {
    for (int px = 0; px < from.width; ++px) {
      const Vector3& x = from.points[static_cast<std::size_t>(py) * from.width + px];
      if (!(x.z() > 0.0)) continue;
      double best = std::numeric_limits<double>::infinity();
      int ring = camera.distorted() ? kFarRings : 0;
      for (; ring < kFarRings && best > beyond(x, ring); ++ring) {
        for (int y = std::max(0, py - ring); y <= std::min(to.height - 1, py + ring); ++y) {
          const bool whole_row = std::abs(y - py) == ring;
          for (int column = px - ring; column <= px + ring; column += whole_row || ring == 0 ? 1 : 2 * ring) {
            if (column < 0 || column >= to.width) continue;
            const Vector3& candidate = to.points[static_cast<std::size_t>(y) * to.width + column];
            if (candidate.z() > 0.0) best = std::min(best, (candidate - x).squaredNorm());
          }
        }
      }
      if (ring == kFarRings && best > beyond(x, ring)) best = by_tree(x);
      sum += std::sqrt(best);
    }
  }
  return sum / static_cast<double>(from.columns.cols());
}

}  // namespace

double chamfer(const DepthImage& p, const DepthImage& q, const capture::Camera& camera) {
  const PixelCloud a(p, camera), b(q, camera);
  if (a.columns.cols() == 0 || b.columns.cols() == 0) return std::numeric_limits<double>::quiet_NaN();
  return 0.5 * (mean_distance(a, b, camera) + mean_distance(b, a, camera));
}

double chamfer(const MatrixX& p, const MatrixX& q) {
  if (p.cols() == 0 || q.cols() == 0) return std::numeric_limits<double>::quiet_NaN();
  return 0.5 * (mean_distance(p, Tree(q)) + mean_distance(q, Tree(p)));
}

}  // namespace chainsplat::eval
