// tests/straight_rope.h - pictures of a straight rope with a known texture, each pixel's ray met with its cylinder.
#pragma once
#include <algorithm>
#include <cmath>
#include <functional>
#include <numbers>

#include "chainsplat/capture.h"
#include "chainsplat/chain.h"

namespace chainsplat::test {

// Red, white and blue bands that wind about the rope, m of arclength per radian; 0: rings.
inline math::Vector3 texture(double arclength, double angle, double slope) {
  const double phase = 2.0 * std::numbers::pi * (arclength - slope * angle) / 0.045;
  const double third = 2.0 * std::numbers::pi / 3.0;
  return {0.5 + 0.3 * std::cos(phase), 0.5 + 0.3 * std::cos(phase - third), 0.5 + 0.3 * std::cos(phase + third)};
}

// Out of the rope at home, at an angle about its axis from the bending axis on.
inline math::Vector3 side_of(const chain::Chain& chain, double at) {
  return std::cos(at) * chain.bending_axis + std::sin(at) * chain.direction.cross(chain.bending_axis);
}

// 1 m beside the middle of the rope at home, which is as high as its picture; 2 cm are 30 pixels.
inline capture::Camera camera_beside(const chain::Chain& chain, double at) {
  capture::Camera camera;
  camera.width = 64, camera.height = 512;
  camera.fx = camera.fy = 1500.0, camera.cx = 0.5 * camera.width, camera.cy = 0.5 * camera.height;
  const math::Vector3 out = side_of(chain, at);
  camera.world_from_camera.rotation = (math::Matrix3() << out.cross(chain.direction), chain.direction, -out).finished();
  camera.world_from_camera.translation = out + 0.5 * chain.length * chain.direction;
  return camera;
}

// The rope at home under a base at the origin; the mask is whole.
inline capture::View picture_of_straight_rope(
    const chain::Chain& chain, const capture::Camera& camera,
    const std::function<math::Vector3(double arclength, double angle)>& color) {
  capture::View picture;
  picture.width = camera.width, picture.height = camera.height;
  picture.rgba.assign(std::size_t{4} * camera.width * camera.height, 255);
  const math::Vector3 x = camera.world_from_camera.rotation.col(0), out = -camera.world_from_camera.rotation.col(2);
  for (int v = 0; v < camera.height; ++v)
    for (int u = 0; u < camera.width; ++u) {
      // where the ray (right, down, 1) from (0, 0, -1) meets the circle: |(right t, t - 1)| = radius
      const double right = (u + 0.5 - camera.cx) / camera.fx, down = (v + 0.5 - camera.cy) / camera.fy;
      const double a = right * right + 1.0, c = 1.0 - 0.25 * chain.diameter * chain.diameter;
      if (1.0 < a * c) continue;
      const double depth = (1.0 - std::sqrt(1.0 - a * c)) / a;
      const math::Vector3 point = depth * right * x + (1.0 - depth) * out;
      const double angle =
          std::atan2(point.dot(side_of(chain, 0.5 * std::numbers::pi)), point.dot(side_of(chain, 0.0)));
      const math::Vector3 rgb = color(0.5 * chain.length + depth * down, angle);
      for (int k = 0; k < 3; ++k)
        picture.rgba[4 * (static_cast<std::size_t>(v) * camera.width + u) + k] =
            static_cast<std::uint8_t>(std::lround(255.0 * std::clamp(rgb[k], 0.0, 1.0)));
    }
  return picture;
}

}  // namespace chainsplat::test
