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

// The points of a depth image in the camera frame, by the pixels of a camera without distortion that show them: those
// of cell k are [first[k], first[k + 1]).
struct PixelCloud {
  int x0 = 0, y0 = 0, width = 0, height = 0;  // of the cells, px
  std::vector<int> first{0};
  std::vector<Vector3> points;
  std::vector<Vector2> pixels;  // where that camera would show them

  PixelCloud(const DepthImage& image, const capture::Camera& camera) {
    std::vector<Vector3> found;
    std::vector<Vector2> at;
    Vector2 low = Vector2::Constant(std::numeric_limits<double>::infinity()), high = -low;
    for (std::size_t k = 0; k < image.depth.size(); ++k) {
      const double z = image.depth[k];
      if (!(z > 0.0)) continue;
      const int column = static_cast<int>(k) % image.width, row = static_cast<int>(k) / image.width;
      Vector2 pixel(image.x0 + column + 0.5, image.y0 + row + 0.5);
      if (camera.distorted()) pixel = capture::undistort(camera, pixel);
      at.push_back(pixel);
      found.push_back({(pixel.x() - camera.cx) / camera.fx * z, (pixel.y() - camera.cy) / camera.fy * z, z});
      low = low.cwiseMin(pixel), high = high.cwiseMax(pixel);
    }
    if (found.empty()) return;
    x0 = static_cast<int>(std::floor(low.x())), y0 = static_cast<int>(std::floor(low.y()));
    width = static_cast<int>(std::floor(high.x())) + 1 - x0, height = static_cast<int>(std::floor(high.y())) + 1 - y0;
    const auto cell = [&](const Vector2& pixel) {
      return static_cast<std::size_t>(width) * (static_cast<int>(std::floor(pixel.y())) - y0) +
             (static_cast<int>(std::floor(pixel.x())) - x0);
    };
    first.assign(static_cast<std::size_t>(width) * height + 1, 0);
    for (const Vector2& pixel : at) ++first[cell(pixel) + 1];
    std::partial_sum(first.begin(), first.end(), first.begin());
    std::vector<int> next(first.begin(), first.end() - 1);
    points.resize(found.size()), pixels.resize(found.size());
    for (std::size_t i = 0; i < found.size(); ++i) {
      const int place = next[cell(at[i])]++;
      points[place] = found[i], pixels[place] = at[i];
    }
  }
  MatrixX columns() const {
    MatrixX out(3, static_cast<Eigen::Index>(points.size()));
    for (std::size_t i = 0; i < points.size(); ++i) out.col(static_cast<Eigen::Index>(i)) = points[i];
    return out;
  }
};

// The nearest point usually lies on the ray of a nearby pixel: the search visits cells in growing rings, until no ray
// farther out can come closer than the best point so far.
double mean_distance(const PixelCloud& from, const PixelCloud& to, const capture::Camera& camera) {
  std::optional<Tree> tree;
  int hint = 0;
  const auto by_tree = [&](const Vector3& x) {
    if (!tree) tree.emplace(to.columns());
    return tree->nearest(x, hint);
  };
  // squared distance from x to the planes through all rays that are this many columns or rows away
  const auto beyond = [&](const Vector3& x, double columns, double rows) {
    const double u = columns / camera.fx, v = rows / camera.fy;
    const double far_u = std::abs(x.x()) / x.z() + u, far_v = std::abs(x.y()) / x.z() + v;
    return x.z() * x.z() * std::min(u * u / (1.0 + far_u * far_u), v * v / (1.0 + far_v * far_v));
  };
  const auto to_border = [](double at) { return std::min(at - std::floor(at), std::floor(at) + 1.0 - at); };
  double sum = 0.0;
  for (std::size_t i = 0; i < from.points.size(); ++i) {
    const Vector3& x = from.points[i];
    const Vector2& pixel = from.pixels[i];
    const int px = static_cast<int>(std::floor(pixel.x())) - to.x0,
              py = static_cast<int>(std::floor(pixel.y())) - to.y0;
    const double border_x = to_border(pixel.x()), border_y = to_border(pixel.y());
    double best = std::numeric_limits<double>::infinity();
    const auto nearer_than = [&](int ring) {  // what lies in this ring or farther out
      return ring > 0 && best <= beyond(x, ring - 1 + border_x, ring - 1 + border_y);
    };
    int ring = 0;
    for (; ring < kFarRings && !nearer_than(ring); ++ring) {
      for (int y = std::max(0, py - ring); y <= std::min(to.height - 1, py + ring); ++y) {
        const bool whole_row = std::abs(y - py) == ring;
        for (int column = px - ring; column <= px + ring; column += whole_row || ring == 0 ? 1 : 2 * ring) {
          if (column < 0 || column >= to.width) continue;
          const std::size_t cell = static_cast<std::size_t>(y) * to.width + column;
          for (int k = to.first[cell]; k < to.first[cell + 1]; ++k)
            best = std::min(best, (to.points[k] - x).squaredNorm());
        }
      }
    }
    if (ring == kFarRings && !nearer_than(ring)) best = by_tree(x);
    sum += std::sqrt(best);
  }
  return sum / static_cast<double>(from.points.size());
}

}  // namespace

double chamfer(const DepthImage& p, const DepthImage& q, const capture::Camera& camera) {
  const PixelCloud a(p, camera), b(q, camera);
  if (a.points.empty() || b.points.empty()) return std::numeric_limits<double>::quiet_NaN();
  return 0.5 * (mean_distance(a, b, camera) + mean_distance(b, a, camera));
}

double chamfer(const MatrixX& p, const MatrixX& q) {
  if (p.cols() == 0 || q.cols() == 0) return std::numeric_limits<double>::quiet_NaN();
  return 0.5 * (mean_distance(p, Tree(q)) + mean_distance(q, Tree(p)));
}

}  // namespace chainsplat::eval
