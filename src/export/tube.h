// tube.h - the rope as a skinned mesh, for viewers that know no splats.
#pragma once
#include <cstdint>
#include <vector>

#include "chainsplat/chain.h"
#include "chainsplat/splat.h"

namespace chainsplat::exports {

// Home configuration, base frame. A vertex rides on two neighboring links, near a joint on both.
struct Tube {
  std::vector<float> position, normal;   // 3 a vertex, m and unit
  std::vector<float> color;              // 4 a vertex, linear, opaque
  std::vector<std::uint16_t> link;       // 4 a vertex, as glTF wants them
  std::vector<float> weight;             // 4 a vertex, of sum 1
  std::vector<std::uint16_t> triangles;  // 3 each, counterclockwise seen from outside
};
Tube make_tube(const splat::Gaussians& gaussians, const chain::Chain& chain);

}  // namespace chainsplat::exports
