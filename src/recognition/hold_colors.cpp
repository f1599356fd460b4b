#include "src/recognition/hold_colors.h"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <optional>
#include <vector>

#include "shaders/shared/gaussian.h"
#include "src/math/sphere.h"
#include "src/recognition/unseen.h"

namespace chainsplat::recognition {

namespace {

using math::Vector3;

constexpr int kDegree = 2, kCoefficients = 9;
constexpr int kLinear = 4;        // coefficients up to degree 1
constexpr int kDirections = 300;  // over the sphere
// Least cosine between surface normal and view ray of a view that counts; below 0, as Gaussians reach around the limb.
constexpr double kSeenFrom = -0.1;
constexpr double kSeeable = 0.1;                          // least cosine of the directions for which colors are held
constexpr double kLeastShare = 0.1;                       // of the views, that must have seen it
constexpr double kSeenWeight = 50.0;                      // of all colors that were seen, to all that are held
constexpr double kRidge = 1e-6;                           // toward the old coefficients
constexpr double kFar = 30.0 * std::numbers::pi / 180.0;  // rad from the nearest view; nearer than that it has a say
constexpr double kInside = 0.4;                           // of the radius: what is closer to the axis has no side

using Basis = Eigen::Matrix<double, kCoefficients, 1>;
Basis basis(const Vector3& r) {
  Basis out;
  for (unsigned l = 0; l < kCoefficients; ++l) out[l] = shared::sh_basis(l, {r.x(), r.y(), r.z()});
  return out;
}

// Where the surface faces at a Gaussian's place, home frame; zero near the axis. The tip is a half sphere.
Vector3 normal_at(const chain::Chain& chain, const Vector3& mean) {
  const double radius = 0.5 * chain.diameter;
  const double along = std::clamp(mean.dot(chain.direction), 0.0, std::max(0.0, chain.length - radius));
  const Vector3 off = mean - along * chain.direction;
  return off.norm() < kInside * radius ? Vector3::Zero() : Vector3(off.normalized());
}

}  // namespace

void hold_colors(const chain::Chain& chain, std::span<const Viewpoint> views, splat::Gaussians& gaussians) {
  CHAINSPLAT_CHECK(gaussians.degree <= 1, std::to_string(gaussians.degree));
  gaussians.resize(gaussians.count, gaussians.links, kDegree);
  const std::vector<Vector3> sphere = math::directions(kDirections);
  const std::vector<std::optional<TextureColor>> textures = texture_colors(chain, views, gaussians);
  core::parallel_for(gaussians.count, [&](std::int64_t index) {
    const int i = static_cast<int>(index);
    const Vector3 mean(gaussians.mean[3 * i], gaussians.mean[3 * i + 1], gaussians.mean[3 * i + 2]);
    const Vector3 normal = normal_at(chain, mean);
    if (gaussians.guessed[i] != 0 || normal.isZero(0.0)) return;
    const int link = splat::surest_link(gaussians, i);
    std::vector<Vector3> seen;  // from camera to Gaussian, home frame
    for (const Viewpoint& view : views) {
      const math::Pose& motion = view.motions[link];
      const Vector3 ray = motion * mean - view.camera->world_from_camera.translation;
      const Vector3 direction = motion.rotation.transpose() * ray.normalized();
      if (-direction.dot(normal) > kSeenFrom) seen.push_back(direction);
    }
    if (static_cast<double>(seen.size()) < kLeastShare * static_cast<double>(views.size()) || seen.empty()) return;

    Eigen::Map<Eigen::Matrix<float, 3, kCoefficients>> sh(&gaussians.sh[3 * kCoefficients * index]);
    const Eigen::Matrix<double, 3, kLinear> linear = sh.leftCols<kLinear>().cast<double>();
    Eigen::Matrix<double, kCoefficients, kCoefficients> matrix =
        kRidge * Eigen::Matrix<double, kCoefficients, kCoefficients>::Identity();
    Eigen::Matrix<double, kCoefficients, 3> right = kRidge * sh.cast<double>().transpose();
    const auto add = [&](const Vector3& at, const Vector3& color, double weight) {
      const Basis row = basis(at);
      matrix += weight * row * row.transpose();
      right += weight * row * color.transpose();
    };
    const auto linear_color = [&](const Vector3& from) { return Vector3(linear * basis(from).head<kLinear>()); };
    for (const Vector3& direction : seen)
      add(direction, linear_color(direction), kSeenWeight / static_cast<double>(seen.size()));
    const std::optional<TextureColor>& around = textures[i];
    const auto held_color = [&](const Vector3& direction) -> Vector3 {
      const auto nearest = std::max_element(seen.begin(), seen.end(), [&](const Vector3& a, const Vector3& b) {
        return a.dot(direction) < b.dot(direction);
      });
      const Vector3 color = linear_color(*nearest);
      if (!around) return color;
      const double apart = std::acos(std::clamp(nearest->dot(direction), -1.0, 1.0));
      const double facing = std::max(0.0, around->facing);
      const double texture = (1.0 - facing * facing) * std::min(1.0, apart / kFar);
      return (1.0 - texture) * color + texture * (around->color - Vector3::Constant(0.5));
    };
    const auto seeable = [&](const Vector3& direction) { return -direction.dot(normal) > kSeeable; };
    const double held = 1.0 / static_cast<double>(std::count_if(sphere.begin(), sphere.end(), seeable));
    for (const Vector3& direction : sphere)
      if (seeable(direction)) add(direction, held_color(direction), held);
    sh = matrix.ldlt().solve(right).transpose().cast<float>();
  });
}

}  // namespace chainsplat::recognition
