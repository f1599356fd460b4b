// splat_sort.comp - one group an active tile: its entries by (depth, replica). Short lists by rank in shared memory (two
// barriers in all); longer ones by a bitonic network in place.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/splat.h"
layout(local_size_x_id = 0) in;
layout(constant_id = 1) const uint kRankLimit = 256u;  // longest list that is sorted by rank
layout(push_constant) uniform Push { SplatPush p; };
layout(std430, binding = 0) readonly buffer TilePrefix { uint tile_prefix[]; };
layout(std430, binding = 1) readonly buffer TileBlock { uint tile_block[]; };
layout(std430, binding = 2) readonly buffer TileCount { uint tile_count[]; };
layout(std430, binding = 3) coherent buffer Entries { uvec4 entries[]; };
layout(std430, binding = 4) writeonly buffer Sorted { uvec2 sorted[]; };  // splat, instance
layout(std430, binding = 5) buffer Counters { uint counters[]; };

// lavapipe ends all loops of an invocation after 65535 iterations in sum: fewer, longer ones
const uint kUnrolled = 16u;

const uint kStep = 8u;  // keys compared in one turn of the loop, whose control costs more than a compare
shared uint depth_key[kRankLimit + kStep];
shared uint replica_key[kRankLimit];

bool before(uvec2 a, uvec2 b) { return a.x < b.x || (a.x == b.x && a.y < b.y); }

void main() {
  uint tile = gl_WorkGroupID.x, lane = gl_LocalInvocationID.x, lanes = gl_WorkGroupSize.x;
  uint start = tile_prefix[tile] + tile_block[tile / kScanBlock];
  uint n = counters[kCounterOverflow] != 0u ? 0u : tile_count[tile];
  if (n > kLongestList) {
    if (lane == 0u) counters[kCounterTooLong] = 1u;
    n = 0u;
  }
  if (n <= kRankLimit) {
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
        for (uint m = 0u; m < kStep; ++m) {
          nearer += depth_key[first + m] < depth ? 1u : 0u;
          equal += depth_key[first + m] == depth ? 1u : 0u;
        }
      }
      // equal depths are rare: only then is the replica's number looked at
      uint replica = replica_key[k], ties = equal > 1u ? n : 0u;
      for (uint m = 0u; m < ties; ++m) nearer += depth_key[m] == depth && replica_key[m] < replica ? 1u : 0u;
      sorted[start + nearer] = entries[start + k].zw;
    }
  } else {
    // every compare puts the smaller one first, so that places beyond n act as infinity and need no memory
    uint width = 2u;
    while (width < 2u * n) {
      for (uint stride = width; stride > 1u; stride /= 2u) {
        bool mirror = stride == width;
        for (uint first = lane; first < n; first += kUnrolled * lanes) {
          for (uint m = 0u; m < kUnrolled; ++m) {
            uint k = first + m * lanes;
            uint partner = mirror ? k ^ (width - 1u) : k ^ (stride / 2u);
            if (partner > k && partner < n) {
              uvec4 a = entries[start + k], b = entries[start + partner];
              if (before(b.xy, a.xy)) {
                entries[start + k] = b;
                entries[start + partner] = a;
              }
            }
          }
        }
        memoryBarrierBuffer();
        barrier();
      }
      width *= 2u;
    }
    for (uint k = lane; k < n; k += lanes) sorted[start + k] = entries[start + k].zw;
  }
}
