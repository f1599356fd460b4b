#include "parts.h"

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

}  // namespace chainsplat::exports
