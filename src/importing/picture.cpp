#include "picture.h"

#include <algorithm>
#include <array>
#include <cmath>

namespace chainsplat::importing {

using math::Vector2;
using math::Vector3;

namespace {

using Color = std::array<std::uint8_t, 3>;
constexpr Color kRed{255, 60, 60}, kGreen{60, 220, 60}, kBlue{80, 120, 255}, kYellow{255, 220, 0},
    kWhite{230, 230, 230};
constexpr int kSamples = 200;        // of a line, since lens distortion bends it
constexpr double kNear = 0.01;       // m in front of the camera
constexpr int kTableLines = 8;       // along each side of the grid
constexpr double kAxis = 0.25;       // of the rope's length
constexpr int kPicturePixels = 480;  // of image width for each pixel of line width

struct Canvas {
  capture::Image8 image;
  const capture::Camera& camera;
  math::Pose camera_from_world;
  int radius = 0;  // px, of lines

  void dot(const Vector2& at, int size, const Color& color) {
    if (!at.allFinite() || at.cwiseAbs().maxCoeff() > 1e6) return;
    const int x = static_cast<int>(std::floor(at.x())), y = static_cast<int>(std::floor(at.y()));
    for (int v = std::max(0, y - size); v <= std::min(image.height - 1, y + size); ++v)
      for (int u = std::max(0, x - size); u <= std::min(image.width - 1, x + size); ++u)
        if ((u - x) * (u - x) + (v - y) * (v - y) <= size * size + 1)
          std::copy(color.begin(), color.end(), &image.pixels[3 * (static_cast<std::size_t>(v) * image.width + u)]);
  }
  std::optional<Vector2> pixel(const Vector3& world) const {
    const Vector3 p = camera_from_world * world;
    // far outside the image a lens model may lead back into it
    if (p.z() < kNear || p.head<2>().norm() > 3.0 * p.z()) return std::nullopt;
    return capture::distort(camera, capture::project(camera, p));
  }
  void line(const Vector3& from, const Vector3& to, int size, const Color& color) {
    Vector2 last(0.0, 0.0);
    bool seen = false;  // `last`
    for (int i = 0; i <= kSamples; ++i) {
      const auto at = pixel(from + (to - from) * (double(i) / kSamples));
      if (at && seen && (*at - last).norm() < 2.0 * image.width)
        for (int k = 0, n = 1 + static_cast<int>((*at - last).norm()); k <= n; ++k)
          dot(last + (*at - last) * (double(k) / n), size, color);
      seen = at.has_value();
      if (seen) last = *at;
    }
  }
};

}  // namespace

capture::Image8 picture(const capture::Image8& frame, const capture::Camera& camera, const Scene& scene) {
  Canvas canvas{{frame.width, frame.height, 3, {}}, camera, camera.world_from_camera.inverse(), 0};
  canvas.radius = frame.width / kPicturePixels;
  canvas.image.pixels.resize(static_cast<std::size_t>(3) * frame.width * frame.height);
  for (std::size_t i = 0; i < canvas.image.pixels.size() / 3; ++i)
    for (int c = 0; c < 3; ++c)
      canvas.image.pixels[3 * i + c] = frame.pixels[i * frame.channels + (frame.channels >= 3 ? c : 0)];
  const Vector3 grasp = scene.world_from_base.translation;
  if (scene.table) {
    const Vector3 normal = scene.table->normal;
    const Vector3 foot = grasp - normal.dot(grasp - scene.table->point) * normal;
    const Vector3 side = normal.unitOrthogonal(), other = normal.cross(side);
    for (int i = -kTableLines; i <= kTableLines; ++i) {
      const double s = scene.length * i / kTableLines;
      canvas.line(foot + s * side - scene.length * other, foot + s * side + scene.length * other, 0, kWhite);
      canvas.line(foot + s * other - scene.length * side, foot + s * other + scene.length * side, 0, kWhite);
    }
  }
  const Vector3 along = scene.world_from_base.rotation * scene.direction * scene.length;
  canvas.line(grasp, grasp + along, canvas.radius, kYellow);
  for (int quarter = 1; quarter <= 4; ++quarter)
    if (const auto at = canvas.pixel(grasp + 0.25 * quarter * along)) canvas.dot(*at, canvas.radius + 2, kYellow);
  const Color colors[] = {kRed, kGreen, kBlue};
  for (int axis = 0; axis < 3; ++axis)
    canvas.line(grasp, grasp + kAxis * scene.length * scene.world_from_base.rotation.col(axis), canvas.radius,
                colors[axis]);
  return canvas.image;
}

}  // namespace chainsplat::importing
