// ssim_columns.comp - filters the output of ssim_rows.comp by the window along y, one strip of a column per lane, and
// computes each tile's sum of 1 - SSIM and the three factors P, Q, R of its gradient (mathematics.md 2.7). Three vec4
// per pixel, of which nine floats are used:   0: P.rgb, Q.r   1: Q.gb, R.rg   2: R.b
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
layout(std430) readonly buffer SsimRowSums { vec4 ssim_row_sums[]; };
layout(std430) writeonly buffer SsimFactors { vec4 ssim_factors[]; };
layout(std430) buffer TileLoss { vec4 tile_loss[]; };
#include "inc/ssim.glsl"

shared float lane_sum[gl_WorkGroupSize.x];

void main() {
  uint tile = gl_WorkGroupID.x, lane = gl_LocalInvocationID.x;
  SplatTile t = tiles[tile];
  SplatView view = views[t.view];
  uint column = lane % kTileWidth, first = kPixels == kTileHeight ? 0u : lane / kTileWidth * kPixels;
  uint above = ssim_tile(view, int(t.x), int(t.y) - 1), below = ssim_tile(view, int(t.x), int(t.y) + 1);
  vec4 s0[kPixels], s1[kPixels], s2[kPixels];
  [[unroll]] for (uint k = 0u; k < kPixels; ++k) s0[k] = s1[k] = s2[k] = vec4(0.0);
  [[unroll]] for (int m = -kSsimReach; m < int(kPixels) + kSsimReach; ++m) {
    int row = int(first) + m;  // in the tile
    uint from = row < 0 ? above : row < int(kTileHeight) ? tile : below;
    bool there = from != kNoTile;
    uint at = 3u * ssim_place(there ? from : tile, column, uint(row + int(kTileHeight)) % kTileHeight);
    vec4 v0 = there ? ssim_row_sums[at] : vec4(0.0), v1 = there ? ssim_row_sums[at + 1u] : vec4(0.0);
    vec4 v2 = there ? ssim_row_sums[at + 2u] : vec4(0.0);
    [[unroll]] for (int k = 0; k < int(kPixels); ++k) {
      if (abs(m - k) > kSsimReach) continue;
      float w = window(m - k);
      s0[k] += w * v0;
      s1[k] += w * v1;
      s2[k] += w * v2;
    }
  }

  // the similarity and the factors of its gradient
  float sum = 0.0;
  bool inside = t.x * kTileWidth + column < view.width;
  [[unroll]] for (uint k = 0u; k < kPixels; ++k) {
    vec3 mx = s0[k].xyz, my = vec3(s0[k].w, s1[k].xy);
    vec3 a1 = 2.0 * mx * my + kSsimC1, a2 = 2.0 * (s2[k].yzw - mx * my) + kSsimC2;
    vec3 b1 = mx * mx + my * my + kSsimC1, b2 = vec3(s1[k].zw, s2[k].x) - mx * mx - my * my + kSsimC2;
    vec3 similarity = a1 * a2 / (b1 * b2);
    // the loss is weight * (1 - S), so the gradient by S is -weight for every pixel of the image
    bool counts = inside && t.y * kTileHeight + first + k < view.height;
    float g = counts ? -p.weight_dssim : 0.0;
    sum += counts ? dot(1.0 - similarity, vec3(1.0)) : 0.0;
    vec3 mean = g * (2.0 * my * (a2 - a1) / (b1 * b2) - 2.0 * mx * similarity * (1.0 / b1 - 1.0 / b2));
    vec3 square = -g * similarity / b2, product = 2.0 * g * a1 / (b1 * b2);
    uint at = 3u * ssim_place(tile, column, first + k);
    ssim_factors[at] = vec4(mean, square.x);
    ssim_factors[at + 1u] = vec4(square.yz, product.xy);
    ssim_factors[at + 2u].x = product.z;
  }
  lane_sum[lane] = sum;
  barrier();
  if (lane == 0u) {
    for (uint k = 1u; k < gl_WorkGroupSize.x; ++k) sum += lane_sum[k];
    tile_loss[2u * tile + 1u].x = sum;
  }
}
