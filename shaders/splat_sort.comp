// splat_sort.comp - one group an active tile: its entries by (depth, replica), where they are few: by rank, every key compared
// with every other. Longer lists are left to splat_sort_long.comp, which a software device would otherwise step through here.
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#include "shared/splat.h"
layout(local_size_x_id = 0) in;
layout(constant_id = 1) const uint kRankLimit = 256u;  // longest list that is sorted by rank
layout(push_constant) uniform Push { SplatPush p; };
layout(std430, binding = 0) readonly buffer TilePrefix { uint tile_prefix[]; };
layout(std430, binding = 1) readonly buffer TileBlock { uint tile_block[]; };
layout(std430, binding = 2) readonly buffer TileCount { uint tile_count[]; };
layout(std430, binding = 3) readonly buffer Entries { uvec4 entries[]; };  // depth's bits, replica, splat, instance
layout(std430, binding = 4) writeonly buffer LongTiles { uint long_tiles[]; };
layout(std430, binding = 5) writeonly buffer Sorted { uvec2 sorted[]; };   // splat, instance
layout(std430, binding = 6) buffer Counters { uint counters[]; };

const uint kStep = 8u;  // keys compared in one turn of the loop, whose control costs more than a compare

shared uint depth_key[kRankLimit + kStep];
shared uint replica_key[kRankLimit];

void main() {
  uint tile = gl_WorkGroupID.x, lane = gl_LocalInvocationID.x, lanes = gl_WorkGroupSize.x;
  uint start = tile_prefix[tile] + tile_block[tile / kScanBlock];
  uint n = counters[kCounterOverflow] != 0u ? 0u : tile_count[tile];
  if (n > kRankLimit) {
    if (lane == 0u) {
      if (n > kLongestList) {
        counters[kCounterTooLong] = 1u;
      } else {
        long_tiles[atomicAdd(counters[kCounterLongTiles], 1u)] = tile;
      }
    }
    n = 0u;
  }
  for (uint k = lane; k < n; k += lanes) {
    uvec2 key = entries[start + k].xy;
    depth_key[k] = key.x;
    replica_key[k] = key.y;
  }
  for (uint k = lane; k < kStep; k += lanes) depth_key[n + k] = 0xffffffffu;  // behind everything
  barrier();
  for (uint k = lane; k < n; k += lanes) {
    uint depth = depth_key[k], nearer = 0u, equal = 0u;
    for (uint first = 0u; first < n; first += kStep) {
      [[unroll]] for (uint m = 0u; m < kStep; ++m) {
        uint other = depth_key[first + m];
        nearer += other < depth ? 1u : 0u;
        equal += other == depth ? 1u : 0u;
      }
    }
    // equal depths are rare: only then is the replica's number looked at
    uint replica = replica_key[k], ties = equal > 1u ? n : 0u;
    for (uint m = 0u; m < ties; ++m) nearer += depth_key[m] == depth && replica_key[m] < replica ? 1u : 0u;
    sorted[start + nearer] = entries[start + k].zw;
  }
}
