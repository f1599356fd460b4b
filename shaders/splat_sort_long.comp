// splat_sort_long.comp - one work group per tile that splat_sort.comp left: sorts its list by (depth, replica), with a
// radix sort of the bits in which the depths of the tile differ.
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#include "shared/splat.h"
layout(local_size_x_id = 0) in;
layout(push_constant) uniform Push { SplatPush p; };
layout(std430) readonly buffer TilePrefix { uint tile_prefix[]; };
layout(std430) readonly buffer TileBlock { uint tile_block[]; };
layout(std430) readonly buffer TileCount { uint tile_count[]; };
layout(std430) readonly buffer Entries { uvec4 entries[]; };  // depth bits, replica, splat, instance
layout(std430) readonly buffer LongTiles { uint long_tiles[]; };
layout(std430) coherent buffer SortScratch { uvec2 sort_scratch[]; };  // two per entry: key, number in the list
layout(std430) writeonly buffer Sorted { uint sorted[]; };     // splat
layout(std430) writeonly buffer InstancePlace { uint instance_place[]; };  // as in splat_sort.comp

const uint kDigitBits = 5u, kDigits = 1u << kDigitBits;
const uint kLongRun = 8u;  // more equal depths in a row than this are sorted by radix, not one against the other
// Turns per iteration: fewer, longer ones, because lavapipe ends an invocation's loops after 65535 of them in all, but not
// all kDigits at once, which took it four seconds to compile.
const uint kUnroll = 4u;

shared uint place[kDigits * gl_WorkGroupSize.x];  // [digit][lane]: number of keys, then place of the next one
shared uint lane_total[gl_WorkGroupSize.x];
shared uint least, most, long_run;

void put(uvec4 entry, uint at) {
  sorted[at] = entry.z;
  if ((p.flags & kFlagGradients) != 0u) instance_place[entry.w] = at;
}

void everyone_sees() {
  memoryBarrierBuffer();
  barrier();
}

// The contiguous part of the tile's list that a lane counts and places: equal keys keep their order.
struct Stretch {
  uint from, to;
};

// Sorts scratch[ping ..] by key, least significant digit first, and returns where the result starts. All lanes must
// call it.
uint sort_by_key(uint ping, uint pong, Stretch s, uint lane, uint lanes) {
  // range of the keys: only bits in which they differ are sorted by
  uint low = 0xffffffffu, high = 0u;
  for (uint first = s.from; first < s.to; first += kUnroll) {
    [[unroll]] for (uint m = 0u; m < kUnroll; ++m) {
      uint key = sort_scratch[ping + min(first + m, s.to - 1u)].x;
      low = min(low, key);
      high = max(high, key);
    }
  }
  if (lane == 0u) {
    least = 0xffffffffu;
    most = 0u;
  }
  barrier();
  atomicMin(least, low);
  atomicMax(most, high);
  barrier();
  low = least;
  uint bits = most > low ? uint(findMSB(most - low)) + 1u : 0u;
  for (uint shift = 0u; shift < bits; shift += kDigitBits) {
    // count the keys of each digit
    [[dont_unroll]] for (uint first = 0u; first < kDigits; first += kUnroll) {
      [[unroll]] for (uint d = first; d < first + kUnroll; ++d) place[d * lanes + lane] = 0u;
    }
    for (uint first = s.from; first < s.to; first += kUnroll) {
      [[unroll]] for (uint m = 0u; m < kUnroll; ++m) {
        uint k = first + m;
        if (k < s.to) place[((sort_scratch[ping + k].x - low) >> shift) % kDigits * lanes + lane] += 1u;
      }
    }
    barrier();
    // exclusive prefix sums over [digit][lane], kDigits consecutive ones per lane
    uint total = 0u;
    [[dont_unroll]] for (uint first = 0u; first < kDigits; first += kUnroll) {
      [[unroll]] for (uint d = first; d < first + kUnroll; ++d) {
        uint count = place[lane * kDigits + d];
        place[lane * kDigits + d] = total;
        total += count;
      }
    }
    lane_total[lane] = total;
    barrier();
    uint before = 0u;
    for (uint l = 0u; l < lane; ++l) before += lane_total[l];
    [[dont_unroll]] for (uint first = 0u; first < kDigits; first += kUnroll) {
      [[unroll]] for (uint d = first; d < first + kUnroll; ++d) place[lane * kDigits + d] += before;
    }
    barrier();
    // move each item to its place
    for (uint first = s.from; first < s.to; first += kUnroll) {
      [[unroll]] for (uint m = 0u; m < kUnroll; ++m) {
        uint k = first + m;
        if (k < s.to) {
          uvec2 item = sort_scratch[ping + k];
          uint counter = ((item.x - low) >> shift) % kDigits * lanes + lane;
          uint at = place[counter];
          place[counter] = at + 1u;
          sort_scratch[pong + at] = item;
        }
      }
    }
    everyone_sees();
    uint swap = ping;
    ping = pong;
    pong = swap;
  }
  return ping;
}

void main() {
  uint tile = long_tiles[gl_WorkGroupID.x], lane = gl_LocalInvocationID.x, lanes = gl_WorkGroupSize.x;
  uint start = tile_prefix[tile] + tile_block[tile / kScanBlock], n = tile_count[tile];
  uint each = (n + lanes - 1u) / lanes;
  Stretch s = Stretch(min(n, lane * each), min(n, (lane + 1u) * each));
  uint begin = 2u * start, middle = begin + n;  // the tile's two halves of the scratch buffer

  // sort by depth
  for (uint k = s.from; k < s.to; ++k) sort_scratch[begin + k] = uvec2(entries[start + k].x, k);
  if (lane == 0u) long_run = 0u;
  everyone_sees();
  uint at = sort_by_key(begin, middle, s, lane, lanes);

  // with a long run of equal depths, sort by replica first and then, keeping that order, by depth
  for (uint k = s.from; k < s.to; ++k) {
    if (k + kLongRun < n && sort_scratch[at + k].x == sort_scratch[at + k + kLongRun].x) long_run = 1u;
  }
  barrier();
  bool many_equal = long_run != 0u;
  if (many_equal) {
    for (uint k = s.from; k < s.to; ++k) sort_scratch[begin + k] = uvec2(entries[start + k].y, k);
    everyone_sees();
    at = sort_by_key(begin, middle, s, lane, lanes);
    for (uint k = s.from; k < s.to; ++k) sort_scratch[at + k].x = entries[start + sort_scratch[at + k].y].x;
    everyone_sees();
    at = sort_by_key(at, at == begin ? middle : begin, s, lane, lanes);
  }

  // write the result, short runs of equal depths by the rank of their replicas
  for (uint k = s.from; k < s.to; ++k) {
    uvec2 item = sort_scratch[at + k];
    bool equal_before = k > 0u && sort_scratch[at + k - 1u].x == item.x;
    bool equal_after = k + 1u < n && sort_scratch[at + k + 1u].x == item.x;
    if (many_equal || (!equal_before && !equal_after)) {
      put(entries[start + item.y], start + k);
    } else if (!equal_before) {  // this lane has the first of the run and writes all of it
      uint end = k + 1u;
      while (end < n && sort_scratch[at + end].x == item.x) ++end;
      for (uint m = k; m < end; ++m) {
        uint index = sort_scratch[at + m].y, replica = entries[start + index].y, rank = k;
        for (uint o = k; o < end; ++o) rank += entries[start + sort_scratch[at + o].y].y < replica ? 1u : 0u;
        put(entries[start + index], start + rank);
      }
    }
  }
}
