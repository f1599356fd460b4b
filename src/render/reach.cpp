// EWA projection (mathematics.md 2.5), out to where alpha falls to 1/255 (2.6).
#include "src/render/reach.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "chainsplat/image_model.h"
#include "chainsplat/render.h"

namespace chainsplat::render {

using namespace image_model;
using math::Matrix3;
using math::Vector2;
using math::Vector3;

namespace {

constexpr double kFar = 1e6;      // px; keeps very large bounds in the range of int
constexpr double kSlack = 0.999;  // of the least alpha; allows for the device's float arithmetic

}  // namespace

std::vector<Replica> visible_replicas(const splat::Gaussians& g) {
  std::vector<Replica> out;
  std::vector<double> rho(g.links);
  for (int i = 0; i < g.count; ++i) {
    const float* const logits = &g.link_logits[static_cast<std::size_t>(g.links) * i];
    const float largest = *std::max_element(logits, logits + g.links);
    double sum = 0.0;
    for (int j = 0; j < g.links; ++j) sum += rho[j] = std::exp(static_cast<double>(logits[j] - largest));
    const double opacity = 1.0 / (1.0 + std::exp(-static_cast<double>(g.opacity_logit[i])));
    const float* const q = &g.rotation[4 * i];
    Matrix3 half_axes = Eigen::Quaterniond(q[0], q[1], q[2], q[3]).normalized().toRotationMatrix();
    for (int c = 0; c < 3; ++c) half_axes.col(c) *= std::exp(static_cast<double>(g.log_scale[3 * i + c]));
    for (int j = 0; j < g.links; ++j) {
      const double alpha = opacity * rho[j] / sum;
      if (alpha < kSlack * kLeastAlpha) continue;
      out.push_back({j, Vector3(g.mean[3 * i], g.mean[3 * i + 1], g.mean[3 * i + 2]), half_axes,
                     std::sqrt(std::max(0.0, 2.0 * std::log(alpha / (kSlack * kLeastAlpha))))});
    }
  }
  return out;
}

math::Rectangle reach(const std::vector<Replica>& replicas, double pixel_footprint,
                      const std::vector<math::Pose>& motions, const capture::Camera& camera) {
  const math::Pose camera_from_world = camera.world_from_camera.inverse();
  std::vector<math::Pose> camera_from_home;
  for (const math::Pose& motion : motions) camera_from_home.push_back(camera_from_world * motion);
  const double limit_x = kClampMargin * 0.5 * camera.width / camera.fx;
  const double limit_y = kClampMargin * 0.5 * camera.height / camera.fy;
  const double focal[2] = {camera.fx, camera.fy}, center[2] = {camera.cx, camera.cy};
  constexpr double kInfinity = std::numeric_limits<double>::infinity();
  Vector2 low(kInfinity, kInfinity), high(-kInfinity, -kInfinity);
  for (const Replica& replica : replicas) {
    const math::Pose& pose = camera_from_home.at(replica.link);
    const Vector3 x = pose * replica.mean;
    if (!(x.z() >= kNear)) continue;
    const Matrix3 axes = pose.rotation * replica.half_axes;
    const double slope[2] = {std::clamp(x.x() / x.z(), -limit_x, limit_x),
                             std::clamp(x.y() / x.z(), -limit_y, limit_y)};
    for (int c = 0; c < 2; ++c) {
      const double scale = focal[c] / x.z(),
                   footprint = pixel_footprint > 0.0 ? std::max(kLeastFootprint, scale * pixel_footprint) : 1.0;
      const double variance =
          (scale * (axes.row(c) - slope[c] * axes.row(2))).squaredNorm() + kLowPass * footprint * footprint;
      const double middle = focal[c] * x[c] / x.z() + center[c], half = replica.reach * std::sqrt(variance);
      low[c] = std::min(low[c], middle - half);
      high[c] = std::max(high[c], middle + half);
    }
  }
  if (!(low.x() <= high.x())) return {};
  const auto pixel = [](double value) { return static_cast<int>(std::clamp(value, -kFar, kFar)); };
  // a pixel is drawn if its center is inside
  return {pixel(std::floor(low.x())), pixel(std::floor(low.y())), pixel(std::ceil(high.x())),
          pixel(std::ceil(high.y()))};
}

math::Rectangle reach(const splat::Gaussians& gaussians, const std::vector<math::Pose>& motions,
                      const capture::Camera& camera) {
  CHAINSPLAT_CHECK(static_cast<int>(motions.size()) == gaussians.links, std::to_string(motions.size()));
  return reach(visible_replicas(gaussians), gaussians.pixel_footprint, motions, camera);
}

}  // namespace chainsplat::render
