// kernels.h - kernels of shaders/ as C++: class templates over their specialization constants (glsl_to_cpp.sed,
// lanes.h).
#pragma once
#include "lanes.h"
// after lanes.h, which configures GLM
#include "chainsplat/image_model.h"
#include "shaders/shared/color.h"
#include "shaders/shared/splat.h"

namespace chainsplat::emulation::kernels {

#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wshadow"
#pragma GCC diagnostic ignored "-Wunused-variable"
#pragma GCC diagnostic ignored "-Wparentheses"

using namespace glm;
using namespace chainsplat::image_model;
using namespace chainsplat::shared;
using uint = std::uint32_t;

// --- what GLSL has built in ---------------------------------------------------------------------------------------

#define gl_LocalInvocationID (running->now->invocation)
#define gl_WorkGroupID (running->group)
#define gl_NumWorkGroups (running->groups)
#define gl_SubgroupSize (running->width)
#define gl_SubgroupID (running->now->subgroup)
#define gl_SubgroupInvocationID (running->now->place)
#define gl_NumSubgroups (running->subgroups)

using Where = std::source_location;

inline void barrier(Where where = Where::current()) { running->wait(Waits::at_group, "barrier", where.line()); }
inline void memoryBarrierBuffer() {}
inline void subgroupBarrier(Where where = Where::current()) {
  running->wait(Waits::at_subgroup, "subgroupBarrier", where.line());
}

template <class T>
T subgroupShuffle(T x, uint from, Where where = Where::current()) {
  static_assert(sizeof(T) == sizeof(uint));
  Group& group = *running;
  std::memcpy(&group.now->offered, &x, sizeof x);
  group.wait(Waits::at_subgroup, "subgroupShuffle", where.line());
  const std::size_t at = group.now->subgroup * static_cast<std::size_t>(group.width) + from;
  if (from >= group.width || !group.there[at]) fail("a lane reads from lane " + std::to_string(from) + ", which is not there");
  std::memcpy(&x, &group.offers[at], sizeof x);
  return x;
}
template <class T>
T subgroupShuffleXor(T x, uint mask, Where where = Where::current()) {
  return subgroupShuffle(x, running->now->place ^ mask, where);
}
// Over the lanes that take part in it, the calling one included.
inline bool subgroupAny(bool x, Where where = Where::current()) {
  Group& group = *running;
  group.now->offered = x ? 1 : 0;
  group.wait(Waits::at_subgroup, "subgroupAny", where.line());
  bool any = false;
  for (uint k = 0; k < group.width; ++k) {
    const std::size_t at = group.now->subgroup * static_cast<std::size_t>(group.width) + k;
    any = any || (group.there[at] && group.offers[at] != 0);
  }
  return any;
}
inline bool subgroupElect(Where where = Where::current()) {
  Group& group = *running;
  group.wait(Waits::at_subgroup, "subgroupElect", where.line());
  for (uint k = 0; k < group.now->place; ++k)
    if (group.there[group.now->subgroup * static_cast<std::size_t>(group.width) + k]) return false;
  return true;
}

inline uint atomicAdd(uint& to, uint x) { return std::exchange(to, to + x); }
inline uint atomicMax(uint& to, uint x) { return std::exchange(to, std::max(to, x)); }
inline uint atomicMin(uint& to, uint x) { return std::exchange(to, std::min(to, x)); }

// --- the kernels --------------------------------------------------------------------------------------------------

template <uint... kConstants>
struct TestPrefix {
#include "test_prefix.comp"
};
template <uint... kConstants>
struct SplatSort {
#include "splat_sort.comp"
};
template <uint... kConstants>
struct SplatSortLong {
#include "splat_sort_long.comp"
};
template <uint... kConstants>
struct SplatBlend {
#include "splat_blend.comp"
};
template <uint... kConstants>
struct SplatBlendBackward {
#include "splat_blend_backward.comp"
};
template <uint... kConstants>
struct ColorPixels {
#include "color_pixels.comp"
};
template <uint... kConstants>
struct ColorEquations {
#include "color_equations.comp"
};

#pragma GCC diagnostic pop

}  // namespace chainsplat::emulation::kernels
