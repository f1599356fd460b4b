// scan_block.comp - one work group per aligned block of kScanBlock elements: exclusive prefix sums inside the block,
// and its total. reads values[]; writes prefix[], block_sum[]. scan_sums.comp turns block sums into block offsets.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/splat.h"
layout(local_size_x = 64) in;
layout(push_constant) uniform Push { SplatPush p; };
layout(std430) readonly buffer Values { uint values[]; };
layout(std430) writeonly buffer Prefix { uint prefix[]; };
layout(std430) writeonly buffer BlockSum { uint block_sum[]; };
layout(std430) readonly buffer Counters { uint counters[]; };

shared uint lane_sum[64];

void main() {
  // scan_per_live elements per live replica, whose number only the device knows
  uint length = p.scan_per_live > 0u ? p.scan_per_live * counters[kCounterLive] : p.scan_length;
  uint block = gl_WorkGroupID.x + gl_WorkGroupID.y * gl_NumWorkGroups.x;
  uint lane = gl_LocalInvocationID.x;
  const uint kEach = kScanBlock / 64u;
  uint first = block * kScanBlock + lane * kEach;
  uint sum = 0u;
  for (uint k = 0u; k < kEach; ++k) {
    uint i = first + k;
    if (i < length) sum += values[i];
  }
  lane_sum[lane] = sum;
  barrier();
  uint before = 0u;
  for (uint k = 0u; k < lane; ++k) before += lane_sum[k];
  if (lane == 63u && block * kScanBlock < length) block_sum[block] = before + sum;
  for (uint k = 0u; k < kEach; ++k) {
    uint i = first + k;
    if (i < length) {
      prefix[i] = before;
      before += values[i];
    }
  }
}
