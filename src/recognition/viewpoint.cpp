#include "src/recognition/viewpoint.h"

#include <algorithm>
#include <cmath>

#include "chainsplat/core.h"
#include "chainsplat/image_model.h"

namespace chainsplat::recognition {

using math::Vector3;

const std::uint8_t* pixel_of(const capture::Camera& camera, const capture::View& view, const Vector3& world) {
  const Vector3 point = camera.world_from_camera.inverse() * world;
  if (point.z() < image_model::kNear) return nullptr;
  const math::Vector2 pixel = capture::project(camera, point);
  const int x = static_cast<int>(std::floor(pixel.x())) - view.x0,
            y = static_cast<int>(std::floor(pixel.y())) - view.y0;
  if (x < 0 || y < 0 || x >= view.width || y >= view.height) return nullptr;
  const std::uint8_t* rgba = &view.rgba[4 * (static_cast<std::size_t>(y) * view.width + x)];
  return rgba[3] >= image_model::kObjectMask ? rgba : nullptr;
}

std::vector<char> shown(const chain::Chain& chain, const capture::Camera& camera, const capture::View& view,
                        std::span<const math::Pose> motions, std::span<const double> arclengths) {
  std::vector<char> out;
  for (const double s : arclengths)
    out.push_back(pixel_of(camera, view, motions[chain::link_at(chain, s)] * Vector3(s * chain.direction)) != nullptr);
  return out;
}

double pixel_footprint(const chain::Chain& chain, std::span<const Viewpoint> views) {
  constexpr double kNearest = 0.05;  // share of the pictures and links that may be nearer: single ones do not decide
  std::vector<double> all;
  for (const Viewpoint& from : views) {
    const math::Pose camera_from_world = from.camera->world_from_camera.inverse();
    for (int j = 0; j < chain.links(); ++j) {
      const double z = (camera_from_world * (from.motions[j] * Vector3(chain.link_start(j) * chain.direction))).z();
      if (z > image_model::kNear) all.push_back(z / std::sqrt(from.camera->fx * from.camera->fy));
    }
  }
  if (all.empty()) return 0.0;
  const auto at = all.begin() + static_cast<std::ptrdiff_t>(kNearest * static_cast<double>(all.size() - 1));
  std::nth_element(all.begin(), at, all.end());
  return *at;
}

double Radii::at(double arclength) const {
  const int nearest = static_cast<int>(std::floor(arclength / spacing)), last = static_cast<int>(radius.size()) - 1;
  double most = 0.0;
  for (int row = nearest - 1; row <= nearest + 1; ++row) most = std::max(most, radius[std::clamp(row, 0, last)]);
  return most;
}

Radii radii_in(const chain::Chain& chain, std::span<const Viewpoint> views) {
  constexpr double kRow = 0.25;      // diameters of arclength
  constexpr double kStep = 0.05;     // diameters, between places that are looked at
  constexpr double kMost = 1.5;      // diameters: beyond, another part of the rope may lie beside
  constexpr double kSideways = 0.5;  // least sine between the rope and the ray to it
  const int rows = std::max(1, static_cast<int>(std::ceil(chain.length / (kRow * chain.diameter))));
  Radii radii{chain.length / rows, std::vector<double>(rows, 0.5 * chain.diameter)};
  std::vector<std::vector<double>> seen(rows);
  for (const Viewpoint& from : views) {
    const capture::View view = capture::unpacked(*from.view);
    core::parallel_for(rows, [&](std::int64_t row) {
      const double s = (static_cast<double>(row) + 0.5) * radii.spacing;
      const math::Pose& motion = from.motions[chain::link_at(chain, s)];
      const Vector3 middle = motion * Vector3(s * chain.direction);
      const Vector3 ray = (middle - from.camera->world_from_camera.translation).normalized();
      const Vector3 across = (motion.rotation * chain.direction).cross(ray);
      if (across.norm() < kSideways || !pixel_of(*from.camera, view, middle)) return;
      for (const double side : {-1.0, 1.0}) {
        double reach = kStep;
        while (reach < kMost &&
               pixel_of(*from.camera, view, middle + side * reach * chain.diameter * across.normalized()))
          reach += kStep;
        if (reach < kMost) seen[row].push_back((reach - 0.5 * kStep) * chain.diameter);
      }
    });
  }
  for (int row = 0; row < rows; ++row)
    if (!seen[row].empty()) radii.radius[row] = std::max(radii.radius[row], math::median(seen[row]));
  return radii;
}

}  // namespace chainsplat::recognition
