// splat_sort.comp - kLanes lanes per active tile: sorts a short list by (depth, replica). It sorts by rank: every key
// is compared with every other. Longer lists are left to splat_sort_long.comp, a kernel of its own because a software
// device also steps through code that a branch skips.
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_shuffle : require
#include "shared/splat.h"
layout(local_size_x_id = 0) in;  // a multiple of kLanes
layout(constant_id = 1) const uint kRankLimit = 256u;  // longest list that is sorted by rank
layout(constant_id = 2) const uint kShare = 8u;        // lanes that load one key each and exchange them
layout(constant_id = 3) const uint kLanes = 8u;        // per tile
layout(push_constant) uniform Push { SplatPush p; };
layout(std430) readonly buffer TilePrefix { uint tile_prefix[]; };
layout(std430) readonly buffer TileBlock { uint tile_block[]; };
layout(std430) readonly buffer TileCount { uint tile_count[]; };
layout(std430) readonly buffer Entries { uvec4 entries[]; };  // depth bits, replica, splat, instance
layout(std430) writeonly buffer LongTiles { uint long_tiles[]; };
layout(std430) writeonly buffer Sorted { uint sorted[]; };    // splat
// where each instance stands in sorted[]; only for gradients
layout(std430) writeonly buffer InstancePlace { uint instance_place[]; };
layout(std430) buffer Counters { uint counters[]; };

#include "inc/group_tile.glsl"

void main() {
  uint tile = tile_of_lane(kLanes), lane = lane_in_tile(kLanes);
  if (tile == kNoTile) return;
  uint start = tile_prefix[tile] + tile_block[tile / kScanBlock];
  bool own_places = p.tile_capacity > 0u, gradients = (p.flags & kFlagGradients) != 0u;
  uint n = !own_places && counters[kCounterOverflow] != 0u ? 0u : tile_count[tile];
  bool no_place = own_places && n > p.tile_capacity;  // some of its entries were dropped
  if (n > kRankLimit || no_place) {
    if (lane == 0u) {
      if (no_place) {
        counters[kCounterOverflow] = 1u;
        atomicMax(counters[kCounterWantTile], n);
      } else if (n > kLongestList) {
        counters[kCounterTooLong] = 1u;
      } else {
        long_tiles[atomicAdd(counters[kCounterLongTiles], 1u)] = tile;
      }
    }
    n = 0u;
  }
  uint shared_lane = gl_SubgroupInvocationID % kShare;
  // a lane computes the ranks of two entries at a time, so that one loaded key serves both
  for (uint first = 0u; first < n; first += 2u * kLanes) {
    uvec2 k = uvec2(first + lane, first + kLanes + lane);
    uvec4 a = entries[start + min(k.x, n - 1u)], b = entries[start + min(k.y, n - 1u)];
    ivec2 depth = ivec2(a.x, b.x), nearer = ivec2(0), same = ivec2(0);  // positive floats sort like their bits
    // kShare lanes load one key each and exchange them
    for (uint others = 0u; others < n; others += kShare) {
      uint other = others + shared_lane;
      int own_key = other < n ? int(entries[start + other].x) : 0x7fffffff;  // behind everything
      [[unroll]] for (uint m = 0u; m < kShare; ++m) {
        ivec2 key = ivec2(subgroupShuffle(own_key, m));
        nearer += ivec2(lessThan(key, depth));
        same += ivec2(equal(key, depth));
      }
    }
    // only equal depths, which are rare, need the replicas' numbers
    uint ties = same.x > 1 || same.y > 1 ? n : 0u;
    for (uint m = 0u; m < ties; ++m) {
      uvec2 other = entries[start + m].xy;
      nearer += ivec2(other.x == a.x && other.y < a.y, other.x == b.x && other.y < b.y);
    }
    uvec2 place = start + uvec2(nearer);
    if (k.x < n) sorted[place.x] = a.z;
    if (k.y < n) sorted[place.y] = b.z;
    if (k.x < n && gradients) instance_place[a.w] = place.x;
    if (k.y < n && gradients) instance_place[b.w] = place.y;
  }
}
