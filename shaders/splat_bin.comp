// splat_bin.comp - one invocation per (live replica, view): enters it into the list of every active tile that it
// touches. Integer atomics assign the places in any order; splat_sort.comp then brings them into an order that is
// unique.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/splat.h"
layout(local_size_x = 64) in;
layout(push_constant) uniform Push { SplatPush p; };
layout(std430) readonly buffer Live { uint live[]; };
layout(std430) readonly buffer Views { SplatView views[]; };
layout(std430) readonly buffer TileMap { uint tile_map[]; };
layout(std430) readonly buffer Counters { uint counters[]; };
layout(std430) readonly buffer Splats { vec4 splats[]; };
layout(std430) readonly buffer InstancePrefix { uint instance_prefix[]; };
layout(std430) readonly buffer InstanceBlock { uint instance_block[]; };
layout(std430) readonly buffer TilePrefix { uint tile_prefix[]; };
layout(std430) readonly buffer TileBlock { uint tile_block[]; };
layout(std430) buffer TileCursor { uint tile_cursor[]; };
layout(std430) readonly buffer TileHits { uint tile_hits[]; };
layout(std430) writeonly buffer Entries { uvec4 entries[]; };  // depth bits, replica, splat, instance

void main() {
  uint r = gl_GlobalInvocationID.x, v = gl_GlobalInvocationID.y;
  uint live_count = counters[kCounterLive];
  if (r >= live_count || counters[kCounterOverflow] != 0u) return;
  uint e = live[r];
  uint replica = (e % p.gaussians) * p.links + e / p.gaussians;  // breaks ties of depth (splat_project.comp)
  uint s = v * live_count + r;
  uint columns = floatBitsToUint(splats[kSplatRows * s + 1u].w), rows = floatBitsToUint(splats[kSplatRows * s + 2u].w);
  uint depth = floatBitsToUint(splats[kSplatRows * s].w);  // positive floats sort like their bits
  uint instance = instance_prefix[s] + instance_block[s / kScanBlock];
  SplatView view = views[v];
  uint hits = tile_hits[s];
  uvec2 t0 = uvec2(columns, rows) & 0xffffu, t1 = uvec2(columns, rows) >> 16u, t = t0;
  uint places = (t1.x - t0.x) * (t1.y - t0.y);  // for one loop over the rectangle (splat_project.comp)
  for (uint k = 0u; k < places; ++k) {
    uint tile = tile_map[view.tile_map + t.y * view.tiles_x + t.x];
    bool hit = k >= kTileHits || (hits >> k & 1u) != 0u;
    if (tile != kNoTile && hit) {
      uint place = tile_prefix[tile] + tile_block[tile / kScanBlock] + atomicAdd(tile_cursor[tile], 1u);
      entries[place] = uvec4(depth, replica, s, instance);
      ++instance;
    }
    t = t.x + 1u < t1.x ? uvec2(t.x + 1u, t.y) : uvec2(t0.x, t.y + 1u);
  }
}
