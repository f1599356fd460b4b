#include "src/estimation/tube.h"

#include <algorithm>
#include <cmath>

#include "chainsplat/image_model.h"

namespace chainsplat::estimation {

using math::MatrixX;
using math::Pose;
using math::Vector2;
using math::Vector3;
using math::VectorX;

namespace {

// Image area of the tube, px, every link by itself: where the chain lies on itself it counts twice. `wider`: px on each
// side.
double tube_area(const chain::Chain& chain, const Pose& base, const VectorX& theta, const capture::Camera& camera,
                 double wider) {
  const MatrixX nodes = chain::nodes(chain, chain::link_motions(chain, theta, base));
  const Pose camera_from_world = camera.world_from_camera.inverse();
  double area = 0.0;
  for (Eigen::Index i = 0; i + 1 < nodes.cols(); ++i) {
    const Vector3 a = camera_from_world * Vector3(nodes.col(i)), b = camera_from_world * Vector3(nodes.col(i + 1));
    if (std::min(a.z(), b.z()) < image_model::kNear) continue;
    const double width = chain.diameter * (camera.fx + camera.fy) / (a.z() + b.z()) + 2.0 * wider;
    area += width * (capture::project(camera, b) - capture::project(camera, a)).norm();
  }
  return area;
}

}  // namespace

double shown_share(const State& state, std::span<const capture::View* const> views, const VectorX& theta,
                   double edge_offset) {
  double most = 0.0;
  for (const capture::View* const view : views) {
    int pixels = 0;
    for (std::size_t i = 3; i < view->rgba.size(); i += 4) pixels += view->rgba[i] >= image_model::kObjectMask;
    const double tube = tube_area(state.given.model.chain, base_at(state, view->time).pose, theta,
                                  state.cameras.at(view->camera), edge_offset);
    if (tube > 0.0) most = std::max(most, pixels / tube);
  }
  return most;
}

bool has_mask(const capture::View& view) {
  for (std::size_t i = 3; i < view.rgba.size(); i += 4)
    if (view.rgba[i] >= image_model::kObjectMask) return true;
  return false;
}

double tube_iou(const chain::Chain& chain, const Pose& base, const VectorX& theta, const capture::View& view,
                const capture::Camera& camera) {
  // project the nodes, and bound the tube and the mask
  const MatrixX nodes = chain::nodes(chain, chain::link_motions(chain, theta, base));
  const Pose camera_from_world = camera.world_from_camera.inverse();
  const double focal = 0.5 * (camera.fx + camera.fy);
  struct Point {
    Vector2 pixel;
    double radius;  // px
  };
  std::vector<Point> points;
  double x0 = view.x0, y0 = view.y0, x1 = view.x0 + view.width, y1 = view.y0 + view.height;
  for (int i = 0; i < nodes.cols(); ++i) {
    const Vector3 x = camera_from_world * Vector3(nodes.col(i));
    if (x.z() < image_model::kNear) return 0.0;
    points.push_back({capture::project(camera, x), 0.5 * chain.diameter * focal / x.z()});
    x0 = std::min(x0, points.back().pixel.x() - points.back().radius);
    y0 = std::min(y0, points.back().pixel.y() - points.back().radius);
    x1 = std::max(x1, points.back().pixel.x() + points.back().radius);
    y1 = std::max(y1, points.back().pixel.y() + points.back().radius);
  }
  const int left = std::max(0, static_cast<int>(std::floor(x0))), top = std::max(0, static_cast<int>(std::floor(y0)));
  const int right = std::min(camera.width, static_cast<int>(std::ceil(x1)));
  const int bottom = std::min(camera.height, static_cast<int>(std::ceil(y1)));
  if (right <= left || bottom <= top) return 0.0;
  const int width = right - left, height = bottom - top;
  // mark the pixels within each segment's radius; joints are round
  std::vector<char> tube(static_cast<std::size_t>(width) * height, 0);
  for (std::size_t i = 0; i + 1 < points.size(); ++i) {
    const Point &a = points[i], &b = points[i + 1];
    const Vector2 step = b.pixel - a.pixel;
    const double length2 = step.squaredNorm();
    if (length2 <= 0.0) continue;
    const bool last = i + 2 == points.size();  // its end, the free end, is flat
    const double reach = std::max(a.radius, b.radius);
    const int ax = std::max(left, static_cast<int>(std::min(a.pixel.x(), b.pixel.x()) - reach));
    const int bx = std::min(right - 1, static_cast<int>(std::max(a.pixel.x(), b.pixel.x()) + reach));
    const int ay = std::max(top, static_cast<int>(std::min(a.pixel.y(), b.pixel.y()) - reach));
    const int by = std::min(bottom - 1, static_cast<int>(std::max(a.pixel.y(), b.pixel.y()) + reach));
    for (int y = ay; y <= by; ++y)
      for (int x = ax; x <= bx; ++x) {
        const Vector2 p(x + 0.5, y + 0.5);
        double t = (p - a.pixel).dot(step) / length2;
        if ((last && t > 1.0) || (i == 0 && t < 0.0)) continue;
        t = std::clamp(t, 0.0, 1.0);
        const double radius = a.radius + t * (b.radius - a.radius);
        if ((p - a.pixel - t * step).squaredNorm() <= radius * radius)
          tube[static_cast<std::size_t>(y - top) * width + x - left] = 1;
      }
  }
  // compare with the mask
  long both = 0, either = 0;
  for (int y = top; y < bottom; ++y)
    for (int x = left; x < right; ++x) {
      const int u = x - view.x0, v = y - view.y0;
      const bool in_mask =
          u >= 0 && v >= 0 && u < view.width && v < view.height &&
          view.rgba[4 * (static_cast<std::size_t>(v) * view.width + u) + 3] >= image_model::kObjectMask;
      const bool in_tube = tube[static_cast<std::size_t>(y - top) * width + x - left] != 0;
      both += in_mask && in_tube;
      either += in_mask || in_tube;
    }
  return either > 0 ? static_cast<double>(both) / either : 0.0;
}

}  // namespace chainsplat::estimation
