// color_model.h - how the color of a pixel tells of the link that it shows, on the host in double: what recognition's
// refinement of angles minimizes, and what the device's color_*.comp are compared with (mathematics.md 2.10, 6.6).
#pragma once
#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "chainsplat/capture.h"
#include "chainsplat/chain.h"
#include "shaders/shared/color.h"

namespace chainsplat::splat {

// Huber's weight of a residual, in units of intensity: 1 for noise, less for stains, shadows and occluders.
inline double color_weight(double residual) {
  return std::min(1.0, shared::kColorNoise / std::max(std::abs(residual), 1e-6));
}
// Its loss, whose derivative is weight times residual.
inline double color_loss(double residual) {
  const double size = std::abs(residual), noise = shared::kColorNoise;
  return size <= noise ? 0.5 * size * size : noise * (size - 0.5 * noise);
}

// The links' axes, from which a point of the surface has its link.
struct LinkAxes {
  std::vector<math::Vector3> start, along;  // m, unit; the frame of the motions
  std::vector<double> length;               // m
};
inline LinkAxes link_axes(const chain::Chain& chain, const std::vector<math::Pose>& motions) {
  LinkAxes out;
  for (int j = 0; j < chain.links(); ++j) {
    out.start.push_back(motions[j] * (chain.link_start(j) * chain.direction));
    out.along.push_back(motions[j].rotation * chain.direction);
    out.length.push_back(chain.link_end(j) - chain.link_start(j));
  }
  return out;
}
inline int nearest_link(const LinkAxes& axes, const math::Vector3& point) {
  int link = 0;
  double least = std::numeric_limits<double>::infinity();
  for (int j = 0; j < static_cast<int>(axes.start.size()); ++j) {
    const math::Vector3 from = point - axes.start[j];
    const double s = std::clamp(from.dot(axes.along[j]), 0.0, axes.length[j]);
    const double distance = (from - s * axes.along[j]).squaredNorm();
    if (distance >= shared::kColorNearer * least) continue;
    least = distance;
    link = j;
  }
  return link;
}

// The surface point, camera frame, m, that the pixel with this center shows at this depth.
inline math::Vector3 surface_point(const capture::Camera& camera, double u, double v, double depth) {
  return {(u - camera.cx) / camera.fx * depth, (v - camera.cy) / camera.fy * depth, depth};
}
// px by which that point moves in the picture with the twist of its link: world frame, about its origin, angular part
// first. d(color)/d(twist) is minus the image gradient times this.
inline Eigen::Matrix<double, 2, 6> pixel_motion(const capture::Camera& camera, const math::Vector3& point) {
  const double z = point.z();
  Eigen::Matrix<double, 2, 3> projection;
  projection << camera.fx / z, 0, -camera.fx * point.x() / (z * z), 0, camera.fy / z, -camera.fy * point.y() / (z * z);
  const Eigen::Matrix<double, 2, 3> by_point = projection * camera.world_from_camera.rotation.transpose();
  Eigen::Matrix<double, 2, 6> out;
  out << -by_point * math::hat(camera.world_from_camera * point), by_point;
  return out;
}

}  // namespace chainsplat::splat
