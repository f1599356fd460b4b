// parts.h - what several formats take from a twin.
#pragma once
#include <vector>

#include "chainsplat/chain.h"
#include "chainsplat/splat.h"

namespace chainsplat::exports {

// Poses of all link frames (mathematics.md 2.2) at one time, each in its parent's frame; of link 0 in the world.
std::vector<math::Pose> local_poses(const chain::Chain& chain, const math::VectorX& theta, const math::Pose& base);

// The color of Gaussian `i` without what depends on the direction, sRGB, 0..1.
math::Vector3 color_of(const splat::Gaussians& gaussians, int i);

}  // namespace chainsplat::exports
