#include "parts.h"

#include "chainsplat/image_model.h"

namespace chainsplat::exports {

std::vector<math::Pose> local_poses(const chain::Chain& chain, const math::VectorX& theta, const math::Pose& base) {
  const std::vector<math::Pose> motions = chain::link_motions(chain, theta, base);
  std::vector<math::Pose> world, local;
  for (int j = 0; j < chain.links(); ++j) {
    const math::Pose home{math::Matrix3::Identity(), chain.link_start(j) * chain.direction};
    world.push_back(motions[j] * home);
    local.push_back(j == 0 ? world[0] : world[j - 1].inverse() * world[j]);
  }
  return local;
}

math::Vector3 color_of(const splat::Gaussians& gaussians, int i) {
  const float* const sh = &gaussians.sh[3 * static_cast<std::size_t>(gaussians.sh_coefficients()) * i];
  return (math::Vector3::Constant(0.5) + image_model::kSh0 * math::Vector3(sh[0], sh[1], sh[2]))
      .cwiseMax(0.0)
      .cwiseMin(1.0);
}

}  // namespace chainsplat::exports
