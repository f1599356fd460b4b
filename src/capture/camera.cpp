#include <cmath>

#include "chainsplat/capture.h"

namespace chainsplat::capture {

using math::Vector2;
using math::Vector3;

namespace {

constexpr int kMostIterations = 200;  // of the fixed-point inverse, of which mild lenses need about ten
constexpr double kConverged = 1e-13;  // normalized coordinates: under 1e-9 px for any image size

Vector2 normalized(const Camera& camera, const Vector2& pixel) {
  return {(pixel.x() - camera.cx) / camera.fx, (pixel.y() - camera.cy) / camera.fy};
}

Vector2 pixel(const Camera& camera, const Vector2& point) {
  return {camera.fx * point.x() + camera.cx, camera.fy * point.y() + camera.cy};
}

// The radial factor and the tangential offset of OpenCV's lens model at a normalized point.
double radial(const Camera& camera, const Vector2& p) {
  const auto& [k1, k2, p1, p2, k3] = camera.distortion;
  const double r2 = p.squaredNorm();
  return 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
}

Vector2 tangential(const Camera& camera, const Vector2& p) {
  const auto& [k1, k2, p1, p2, k3] = camera.distortion;
  const double r2 = p.squaredNorm(), xy = p.x() * p.y();
  return {2.0 * p1 * xy + p2 * (r2 + 2.0 * p.x() * p.x()), p1 * (r2 + 2.0 * p.y() * p.y()) + 2.0 * p2 * xy};
}

}  // namespace

bool Camera::distorted() const {
  for (const double coefficient : distortion)
    if (coefficient != 0.0) return true;
  return false;
}

Vector2 project(const Camera& camera, const Vector3& camera_point) {
  return {camera.fx * camera_point.x() / camera_point.z() + camera.cx,
          camera.fy * camera_point.y() / camera_point.z() + camera.cy};
}

Vector2 distort(const Camera& camera, const Vector2& undistorted_pixel) {
  const Vector2 p = normalized(camera, undistorted_pixel);
  return pixel(camera, radial(camera, p) * p + tangential(camera, p));
}

Vector2 undistort(const Camera& camera, const Vector2& recorded_pixel) {
  const Vector2 recorded = normalized(camera, recorded_pixel);
  Vector2 p = recorded;
  for (int i = 0; i < kMostIterations; ++i) {
    const Vector2 next = (recorded - tangential(camera, p)) / radial(camera, p);
    const double change = (next - p).norm();
    p = next;
    if (!(change > kConverged)) break;
  }
  return pixel(camera, p);
}

}  // namespace chainsplat::capture
