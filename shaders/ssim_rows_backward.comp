// ssim_rows_backward.comp - filters the gradient factors P, Q, R by the window along x, one strip of a row per lane; in
// the layout of ssim_columns.comp.
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#include "shared/splat.h"
layout(local_size_x_id = 0) in;  // kTileWidth * kTileHeight / kPixels
layout(constant_id = 1) const uint kTileWidth = 8u;
layout(constant_id = 2) const uint kTileHeight = 8u;
layout(constant_id = 3) const uint kPixels = 8u;
layout(push_constant) uniform Push { SplatPush p; };
layout(std430) readonly buffer Tiles { SplatTile tiles[]; };
layout(std430) readonly buffer Views { SplatView views[]; };
layout(std430) readonly buffer TileMap { uint tile_map[]; };
layout(std430) readonly buffer SsimFactors { vec4 ssim_factors[]; };
layout(std430) writeonly buffer SsimRowSums { vec4 ssim_row_sums[]; };
#include "inc/ssim.glsl"

void main() {
  uint tile = gl_WorkGroupID.x, lane = gl_LocalInvocationID.x;
  SplatTile t = tiles[tile];
  SplatView view = views[t.view];
  uint row = lane % kTileHeight, first = kPixels == kTileWidth ? 0u : lane / kTileHeight * kPixels;
  uint left = ssim_tile(view, int(t.x) - 1, int(t.y)), right = ssim_tile(view, int(t.x) + 1, int(t.y));
  vec4 s0[kPixels], s1[kPixels];
  float s2[kPixels];
  [[unroll]] for (uint k = 0u; k < kPixels; ++k) {
    s0[k] = s1[k] = vec4(0.0);
    s2[k] = 0.0;
  }
  [[unroll]] for (int m = -kSsimReach; m < int(kPixels) + kSsimReach; ++m) {
    int column = int(first) + m;  // in the tile
    uint from = column < 0 ? left : column < int(kTileWidth) ? tile : right;
    bool there = from != kNoTile;
    uint at = 3u * ssim_place(there ? from : tile, uint(column + int(kTileWidth)) % kTileWidth, row);
    vec4 v0 = there ? ssim_factors[at] : vec4(0.0), v1 = there ? ssim_factors[at + 1u] : vec4(0.0);
    float v2 = there ? ssim_factors[at + 2u].x : 0.0;
    [[unroll]] for (int k = 0; k < int(kPixels); ++k) {
      if (abs(m - k) > kSsimReach) continue;
      float w = window(m - k);
      s0[k] += w * v0;
      s1[k] += w * v1;
      s2[k] += w * v2;
    }
  }
  [[unroll]] for (uint k = 0u; k < kPixels; ++k) {
    uint at = 3u * ssim_place(tile, first + k, row);
    ssim_row_sums[at] = s0[k];
    ssim_row_sums[at + 1u] = s1[k];
    ssim_row_sums[at + 2u].x = s2[k];
  }
}
