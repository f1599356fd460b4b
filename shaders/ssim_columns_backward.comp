// ssim_columns_backward.comp - filters the output of ssim_rows_backward.comp by the window along y, one strip of a
// column per lane, and forms the gradient of the D-SSIM term by the pixel's color, w*P + 2x (w*Q) + y (w*R), and through
// the background by its alpha (mathematics.md 2.7).
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
layout(std430) readonly buffer Image { vec4 image[]; };
layout(std430) readonly buffer Target { uint target[]; };
layout(std430) writeonly buffer PixelGradient { vec4 pixel_gradient[]; };
#include "inc/background.glsl"
#include "inc/ssim.glsl"

void main() {
  uint tile = gl_WorkGroupID.x, lane = gl_LocalInvocationID.x;
  SplatTile t = tiles[tile];
  SplatView view = views[t.view];
  uint column = lane % kTileWidth, first = kPixels == kTileHeight ? 0u : lane / kTileWidth * kPixels;
  uint above = ssim_tile(view, int(t.x), int(t.y) - 1), below = ssim_tile(view, int(t.x), int(t.y) + 1);
  vec4 s0[kPixels], s1[kPixels];
  float s2[kPixels];
  [[unroll]] for (uint k = 0u; k < kPixels; ++k) {
    s0[k] = s1[k] = vec4(0.0);
    s2[k] = 0.0;
  }
  [[unroll]] for (int m = -kSsimReach; m < int(kPixels) + kSsimReach; ++m) {
    int row = int(first) + m;  // in the tile
    uint from = row < 0 ? above : row < int(kTileHeight) ? tile : below;
    bool there = from != kNoTile;
    uint at = 3u * ssim_place(there ? from : tile, column, uint(row + int(kTileHeight)) % kTileHeight);
    vec4 v0 = there ? ssim_row_sums[at] : vec4(0.0), v1 = there ? ssim_row_sums[at + 1u] : vec4(0.0);
    float v2 = there ? ssim_row_sums[at + 2u].x : 0.0;
    [[unroll]] for (int k = 0; k < int(kPixels); ++k) {
      if (abs(m - k) > kSsimReach) continue;
      float w = window(m - k);
      s0[k] += w * v0;
      s1[k] += w * v1;
      s2[k] += w * v2;
    }
  }
  uint x = t.x * kTileWidth + column;
  [[unroll]] for (uint k = 0u; k < kPixels; ++k) {
    uint y = t.y * kTileHeight + first + k;
    if (x < view.width && y < view.height) {
      uint offset = y * view.width + x;
      vec3 shown = on_background(image[view.pixel + offset]);
      vec3 wanted = on_background(unpackUnorm4x8(target[view.target + offset]));
      vec3 mean = s0[k].xyz, square = vec3(s0[k].w, s1[k].xy), product = vec3(s1[k].zw, s2[k]);
      vec3 by_color = mean + 2.0 * shown * square + wanted * product;
      pixel_gradient[view.pixel + offset] = vec4(by_color, -p.background * dot(by_color, vec3(1.0)));
    }
  }
}
