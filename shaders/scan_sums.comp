// scan_sums.comp - one work group: turns block sums into block offsets (exclusive prefix sums). The total goes to a
// counter, is compared with its capacity, and sizes the dispatches that depend on it.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/splat.h"
layout(local_size_x = 64) in;
layout(push_constant) uniform Push { SplatPush p; };
layout(std430) buffer BlockSum { uint block_sum[]; };
layout(std430) buffer Counters { uint counters[]; };

shared uint lane_sum[64];

void main() {
  uint length = p.scan_per_live > 0u ? p.scan_per_live * counters[kCounterLive] : p.scan_length;
  uint blocks = (length + kScanBlock - 1u) / kScanBlock;
  uint each = (blocks + 63u) / 64u;
  uint lane = gl_LocalInvocationID.x;
  uint first = min(lane * each, blocks), last = min(first + each, blocks);
  uint sum = 0u;
  for (uint b = first; b < last; ++b) sum += block_sum[b];
  lane_sum[lane] = sum;
  barrier();
  uint before = 0u;
  for (uint k = 0u; k < lane; ++k) before += lane_sum[k];
  for (uint b = first; b < last; ++b) {
    uint value = block_sum[b];
    block_sum[b] = before;
    before += value;
  }
  if (lane == 63u) {
    uint total = before;
    if (p.scan_counter == kCounterLive) {
      counters[kCounterWantLive] = total;
      if (total > p.live_capacity) {
        counters[kCounterOverflow] = 1u;
        total = p.live_capacity;
      }
      counters[kCounterDispatch] = (total + kGroup - 1u) / kGroup;
    } else {
      counters[kCounterWantInstances] = max(counters[kCounterWantInstances], total);
      if (total > p.instance_capacity) counters[kCounterOverflow] = 1u;
    }
    counters[p.scan_counter] = total;
  }
}
