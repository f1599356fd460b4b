// parts.h - what several formats take from a twin.
#pragma once
#include <vector>

#include "chainsplat/chain.h"
#include "chainsplat/splat.h"

namespace chainsplat::exports {

// Poses of all link frames (mathematics.md 2.2) at one time, each in its parent's frame; of link 0 in the world.
std::vector<math::Pose> local_poses(const chain::Chain& chain, const math::VectorX& theta, const math::Pose& base);

}  // namespace chainsplat::exports
