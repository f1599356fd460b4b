// The mask's outline as observations of the posed chain: which point of the rope each piece of outline shows, and how
// far it is from where the tube's outline should be (mathematics.md 6).
#pragma once
#include <algorithm>
#include <cmath>
#include <optional>

#include "src/silhouette/observations.h"

namespace chainsplat::silhouette {

using math::Vector3;

constexpr double kAligned = 0.7;   // least cosine between outline and tube normals
constexpr double kLeastArm = 1.0;  // px, from a joint, to tell a direction from it
constexpr double kEndReach = 2.0;  // half widths from an end of the rope within which an outline may be the end's

struct Nearest {  // place on the projected centerline nearest to a pixel, of what is not hidden
  int segment = -1;
  double t = 0.0;  // along the segment in the image, 0 to 1
  double distance2 = 1e300;
};

inline Vector2 image_of(const capture::Camera& camera, const Vector3& x) {
  return {camera.fx * x.x() / x.z() + camera.cx, camera.fy * x.y() / x.z() + camera.cy};
}

// d(m . u)/dx of a camera-frame point.
inline Vector3 projected_gradient(const capture::Camera& camera, const Vector3& x, const Vector2& m) {
  const double gx = camera.fx * m.x() / x.z(), gy = camera.fy * m.y() / x.z();
  return {gx, gy, -(gx * x.x() + gy * x.y()) / x.z()};
}

inline Nearest nearest_on(const Segment& s, const Vector2& pixel) {
  const Vector2 offset = pixel - s.from;
  const double t = std::clamp(offset.dot(s.step) * s.per_length2, 0.0, 1.0);
  return {-1, t, (offset - t * s.step).squaredNorm()};
}

inline Nearest nearest(const std::vector<Segment>& segments, const Vector2& pixel) {
  Nearest best;
  for (int i = 0; i < static_cast<int>(segments.size()); ++i) {
    if (segments[i].hidden) continue;
    const Nearest here = nearest_on(segments[i], pixel);
    if (here.distance2 < best.distance2) best = {i, here.t, here.distance2};
  }
  return best;
}

// Camera-frame point of image position t along a segment.
inline Vector3 point_at(const Segment& s, double t) {
  const double from = t * s.a.z(), to = (1.0 - t) * s.b.z();
  return s.a + from / (from + to) * (s.b - s.a);
}

inline bool past_end(const ViewWork& work, const Nearest& at) {
  return at.segment + 1 == static_cast<int>(work.segments.size()) && at.t >= 1.0;
}

inline double tukey_weight(double residual, double cut) {
  const double u = residual / cut;
  return std::abs(u) >= 1.0 ? 0.0 : (1.0 - u * u) * (1.0 - u * u);
}

// One piece of outline and the point of the rope that it shows.
struct OutlinePoint {
  const Segment* segment = nullptr;
  Vector3 x;          // the point on the centerline, camera frame, m
  Vector3 gradient;   // of the tube's outline along `outward` by x, px/m
  Vector2 outward;    // unit, image: the direction in which the distance is measured
  double distance;    // px, from the tube's outline to the mask's, positive where the mask is wider
  double length;      // px of outline that it stands for
  double half_width;  // px, of the tube there
  enum class Part { side, end, start, before_grasp };
  Part part;  // the tube's side, the free end's disk, where the mask begins, or nearest to the grasp and beyond it
};

// Where the rope's ends are sought in a mask.
struct Ends {
  double reach = kEndReach;          // half widths from where they should be
  std::optional<double> mask_start;  // m along the rope from the grasp, where the mask should begin; none: not sought
};

// An end of the rope is a flat disk, seen as an ellipse.
struct EndDisk {
  Vector3 x;             // its center, camera frame, m
  Vector2 center;        // px
  Vector2 along;         // unit, image: out of the rope
  double radius, depth;  // px, half axes of the ellipse across and along the rope
};

inline EndDisk end_disk(const capture::Camera& camera, const Segment& s, const Vector3& x, double sign, double radius) {
  EndDisk out{x, image_of(camera, x), sign * s.tangent, 0.0, 0.0};
  out.radius = radius * projected_gradient(camera, x, s.normal).norm();
  out.depth = out.radius * std::abs((s.b - s.a).normalized().dot(x.normalized()));
  return out;
}

// Calls each(edge) for every piece of outline of the active blobs, and then visit(point) where it shows the rope.
template <typename Each, typename Visit>
void for_each_outline_point(const chain::Chain& chain, const ViewWork& work, const Each& each, const Visit& visit,
                            const Ends& ends = {}) {
  const capture::Camera& camera = *work.view->camera;
  const MaskPoints& mask = *work.view->mask;
  const double radius = 0.5 * chain.diameter;
  if (work.segments.empty()) return;
  const Segment &first = work.segments.front(), &last = work.segments.back();
  std::optional<EndDisk> end, start;
  if (last.link + 1 == chain.links() && !last.hidden) end = end_disk(camera, last, last.b, 1.0, radius);
  const Segment* begins = &first;  // where the mask should begin, which may be beyond the first segment
  if (ends.mask_start && chain.link_start(first.link) <= 0.0) {
    const auto along = [&] { return Vector3(begins->b - begins->a); };
    double beyond = *ends.mask_start;  // m, from the segment's own beginning
    for (; begins != &last && beyond > along().norm(); ++begins) beyond -= along().norm();
    if (!begins->hidden) start = end_disk(camera, *begins, begins->a + beyond * along().normalized(), -1.0, radius);
  }
  // whether a piece of outline shows the disk; visits it
  const auto shows = [&](const Edge& edge, const EndDisk& disk, const Segment& segment, OutlinePoint::Part part) {
    const Vector2 from_disk = edge.point - disk.center;
    if (from_disk.norm() >= ends.reach * disk.radius || edge.outward.dot(disk.along) <= kAligned) return false;
    const double side = segment.normal.dot(from_disk) / disk.radius;
    const double bulge = disk.depth * std::sqrt(std::max(0.0, 1.0 - side * side));
    visit(OutlinePoint{&segment, disk.x, projected_gradient(camera, disk.x, disk.along), disk.along,
                       disk.along.dot(from_disk) - bulge, edge.weight, bulge, part});
    return true;
  };
  for (std::size_t b = 0; b < mask.blobs.size(); ++b) {
    if (!work.active[b]) continue;
    for (int i = mask.blobs[b].first_edge; i < mask.blobs[b].last_edge; ++i) {
      const Edge& edge = mask.edges[i];
      each(edge);
      if (end && shows(edge, *end, last, OutlinePoint::Part::end)) continue;
      if (start && shows(edge, *start, *begins, OutlinePoint::Part::start)) continue;
      const Nearest at = nearest(work.segments, edge.point);
      if (past_end(work, at)) continue;
      const Segment& s = work.segments[at.segment];
      const Vector2 from_center = edge.point - (s.from + at.t * s.step);
      // the side of the tube is the one the outline faces; about a bend's outer corner the tube is round
      Vector2 m = s.normal.dot(edge.outward) < 0 ? Vector2(-s.normal) : s.normal;
      const double distance = std::sqrt(at.distance2);
      if ((at.t <= 0.0 || at.t >= 1.0) && distance > kLeastArm && from_center.dot(edge.outward) > 0.0)
        m = from_center / distance;
      if (m.dot(edge.outward) < kAligned) continue;  // an occluder's outline, or a corner
      const Vector3 x = point_at(s, at.t);
      Vector3 g = projected_gradient(camera, x, m);
      const double half_width = radius * g.norm();
      g.z() -= half_width / x.z();  // farther is thinner
      visit(OutlinePoint{&s, x, g, m, m.dot(from_center) - half_width, edge.weight, half_width,
                         at.segment == 0 && at.t <= 0.0 ? OutlinePoint::Part::before_grasp : OutlinePoint::Part::side});
    }
  }
}

}  // namespace chainsplat::silhouette
