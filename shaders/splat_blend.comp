// splat_blend.comp - kLanes lanes per active tile, a column of kPixels pixels each: front-to-back blending
// (mathematics.md 2.6). One loaded splat serves all pixels of the lane, which makes the pass fast where loads dominate
// the cost (design.md, 'The size of the work'). For the same reason kShare lanes load one splat each and exchange them,
// on devices where all lanes loading one splat costs as much as each loading another.
// writes image (premultiplied color, alpha), depth if asked for, and the number of entries of the tile that were used.
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_vote : require
#extension GL_KHR_shader_subgroup_shuffle : require
#include "shared/splat.h"
layout(local_size_x_id = 0) in;  // a multiple of kLanes
layout(constant_id = 1) const uint kTileWidth = 8u;
layout(constant_id = 2) const uint kTileHeight = 8u;
layout(constant_id = 3) const uint kPixels = 8u;
layout(constant_id = 4) const uint kCutoffs = 1u;
layout(constant_id = 5) const uint kDepth = 0u;
layout(constant_id = 6) const uint kShare = 1u;  // lanes that load one splat each and exchange; 1: every lane loads all
layout(push_constant) uniform Push { SplatPush p; };
layout(std430) readonly buffer Tiles { SplatTile tiles[]; };
layout(std430) readonly buffer Views { SplatView views[]; };
layout(std430) readonly buffer TilePrefix { uint tile_prefix[]; };
layout(std430) readonly buffer TileBlock { uint tile_block[]; };
layout(std430) readonly buffer TileCount { uint tile_count[]; };
layout(std430) readonly buffer Sorted { uint sorted[]; };
layout(std430) readonly buffer Splats { vec4 splats[]; };
layout(std430) readonly buffer Counters { uint counters[]; };
layout(std430) writeonly buffer Image { vec4 image[]; };
layout(std430) buffer TileUsed { uint tile_used[]; };
layout(std430) writeonly buffer DepthImage { float depth_image[]; };

// entries per iteration: the values that a loop carries from one iteration to the next cost a fifth of an entry's time
const uint kTurns = kShare > 1u ? 2u : 1u;

const uint kLanes = kTileWidth * kTileHeight / kPixels;  // per tile

#include "inc/group_tile.glsl"
#include "inc/share.glsl"
#include "inc/alpha.glsl"

void main() {
  uint tile = tile_of_lane(kLanes), lane = lane_in_tile(kLanes);
  if (tile == kNoTile) return;
  SplatTile t = tiles[tile];
  SplatView view = views[t.view];
  uint column = t.x * kTileWidth + lane % kTileWidth;
  uint row = t.y * kTileHeight + lane / kTileWidth * kPixels;
  float px = float(column) + 0.5, py = float(row) + 0.5;
  uint start = tile_prefix[tile] + tile_block[tile / kScanBlock];
  uint n = counters[kCounterOverflow] != 0u ? 0u : tile_count[tile];

  // blend until the list ends or all pixels are closed
  vec3 color[kPixels];
  float transmittance[kPixels], depth[kPixels];
  [[unroll]] for (uint k = 0u; k < kPixels; ++k) {
    color[k] = vec3(0.0);
    transmittance[k] = 1.0;
    depth[k] = 0.0;
  }
  uint used = 0u;
  bool any_open = true;
  while (used < n && any_open) {
    // load one splat per sharing lane, then blend them in turn
    uint turns = kShare > 1u ? min(kShare, n - used) : 1u, own_turn = gl_SubgroupInvocationID % kShare;
    uint own = kSplatRows * sorted[start + used + min(own_turn, turns - 1u)];
    vec4 own_a = splats[own], own_b = splats[own + 1u], own_c = splats[own + 2u];
    Falloff own_falloff = falloff_of(own_b.xyz);
    if (own_turn >= turns) own_a.z = 0.0;
    for (uint first = 0u; first < turns; first += kTurns) {
      [[unroll]] for (uint m = 0u; m < kTurns; ++m) {
        uint turn = first + m;
        vec3 splat_color = shared_by(own_c.xyz, turn);
        float splat_depth = kDepth != 0u ? shared_by(own_a.w, turn) : 0.0;
        Falloff falloff = shared_by(own_falloff, turn);
        float dx = px - shared_by(own_a.x, turn), dy = py - shared_by(own_a.y, turn) + falloff.slope * dx;
        float alpha[kPixels];
        alphas_of(falloff, shared_by(own_a.z, turn), dx, dy, alpha);
        [[unroll]] for (uint k = 0u; k < kPixels; ++k) {
          bool contributes;
          float weight = blend_weight(min(alpha[k], kAlphaCap), transmittance[k], contributes);
          color[k] += weight * splat_color;
          if (kDepth != 0u) depth[k] += weight * splat_depth;
        }
      }
    }
    used += turns;
    any_open = false;
    [[unroll]] for (uint k = 0u; k < kPixels; ++k) any_open = any_open || transmittance[k] >= 0.0;
    if (kShare > 1u) any_open = subgroupAny(any_open);  // a lane whose pixels are closed still loads for the others
  }

  // write the pixels
  atomicMax(tile_used[tile], used);
  [[unroll]] for (uint k = 0u; k < kPixels; ++k) {
    if (column < view.width && row + k < view.height) {
      uint pixel = view.pixel + (row + k) * view.width + column;
      float alpha = 1.0 - abs(transmittance[k]);
      image[pixel] = vec4(color[k], alpha);
      if (kDepth != 0u) depth_image[pixel] = alpha > 0.5 ? depth[k] / alpha : 0.0;
    }
  }
}
