// Other viewers know nothing of the light that stays where it is while a rope swings and rolls under it. But from a
// camera that stands still a link that turns is seen from another side, so that colors that depend on the direction can
// hold what the light does in the motion that is exported.
#include <algorithm>

#include "chainsplat/export.h"
#include "chainsplat/image_model.h"
#include "shaders/shared/gaussian.h"
#include "src/math/sphere.h"

namespace chainsplat::exports {

using math::Vector3;

namespace {

constexpr int kDegree = 2, kTerms = 9;
constexpr std::size_t kMostMoments = 60;  // evenly over the motion
constexpr int kDirections = 60;           // over the sphere, from which a Gaussian is to have its mean light
constexpr double kFacing = -0.1;  // least cosine between surface normal and view ray: Gaussians reach around the limb
constexpr double kSeen = 50.0;    // weight of all that cameras see to all that is held

using Basis = Eigen::Matrix<double, kTerms, 1>;
Basis basis(const Vector3& r) {
  Basis out;
  for (unsigned l = 0; l < kTerms; ++l) out[l] = shared::sh_basis(l, {r.x(), r.y(), r.z()});
  return out;
}

// The links' motions at moments of the motion.
using Moments = std::vector<std::vector<math::Pose>>;

Moments moments_of(const chain::Chain& chain, const chain::States& motion, const trajectory::Trajectory& base) {
  if (motion.time.empty()) return {chain::link_motions(chain, math::VectorX::Zero(chain.angles()), math::Pose())};
  Moments out;
  const std::size_t every = (motion.time.size() + kMostMoments - 1) / kMostMoments;
  for (std::size_t k = 0; k < motion.time.size(); k += every) {
    const math::Pose at = base.samples().empty() ? math::Pose() : base.pose(motion.time[k]);
    out.push_back(chain::material_motions(chain, motion, motion.time[k], at));
  }
  return out;
}

}  // namespace

splat::Gaussians with_baked_light(const splat::Gaussians& gaussians, const chain::Chain& chain,
                                  const chain::States& motion, const trajectory::Trajectory& base,
                                  const std::vector<capture::Camera>& cameras) {
  if (!gaussians.light.known()) return gaussians;
  const Moments moments = moments_of(chain, motion, base);
  splat::Gaussians out = gaussians;
  out.light = {};
  out.resize(out.count, out.links, std::max(out.degree, kDegree));
  const std::vector<Vector3> sphere = math::directions(kDirections);
  core::parallel_for(gaussians.count, [&](std::int64_t index) {
    const int i = static_cast<int>(index), link = splat::surest_link(gaussians, i);
    const Vector3 mean(gaussians.mean[3 * i], gaussians.mean[3 * i + 1], gaussians.mean[3 * i + 2]);
    const Vector3 normal = (mean - mean.dot(chain.direction) * chain.direction).normalized();
    struct Seen {
      Vector3 direction, color;
    };
    std::vector<Seen> seen;
    double brightness = 0.0;
    for (const std::vector<math::Pose>& motions : moments) {
      const math::Pose& pose = motions[link];
      const double now = splat::brightness(gaussians, i, pose.rotation);
      brightness += now / static_cast<double>(moments.size());
      for (const capture::Camera& camera : cameras) {
        const Vector3 ray = pose * mean - camera.world_from_camera.translation;
        const Vector3 direction = pose.rotation.transpose() * ray.normalized();
        if (-direction.dot(normal) > kFacing)
          seen.push_back({direction, now * splat::sh_color(gaussians, i, direction)});
      }
    }
    using Matrix = Eigen::Matrix<double, kTerms, kTerms>;
    Matrix matrix = Matrix::Zero();
    Eigen::Matrix<double, kTerms, 3> right = Eigen::Matrix<double, kTerms, 3>::Zero();
    const auto add = [&](const Vector3& direction, const Vector3& color, double weight) {
      const Basis row = basis(direction);
      matrix += weight * row * row.transpose();
      right += weight * row * (color - Vector3::Constant(0.5)).transpose();
    };
    for (const Seen& each : seen) add(each.direction, each.color, kSeen / static_cast<double>(seen.size()));
    for (const Vector3& direction : sphere)
      add(direction, brightness * splat::sh_color(gaussians, i, direction), 1.0 / kDirections);
    const Eigen::Matrix<double, kTerms, 3> found = matrix.ldlt().solve(right);
    const std::size_t first = 3 * static_cast<std::size_t>(out.sh_coefficients()) * index;
    for (int l = 0; l < out.sh_coefficients(); ++l)
      for (int c = 0; c < 3; ++c) out.sh[first + 3 * l + c] = l < kTerms ? static_cast<float>(found(l, c)) : 0.0f;
  });
  return out;
}

}  // namespace chainsplat::exports
