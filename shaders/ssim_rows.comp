// ssim_rows.comp - filters image x, target y, the sum of their squares and their product by the window along x; one
// strip of a row per lane. Three vec4 per pixel:   0: x.rgb, y.r   1: y.gb, (xx + yy).rg   2: (xx + yy).b, xy.rgb
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
layout(std430) readonly buffer Image { vec4 image[]; };
layout(std430) readonly buffer Target { uint target[]; };
layout(std430) writeonly buffer SsimRowSums { vec4 ssim_row_sums[]; };
#include "inc/background.glsl"
#include "inc/ssim.glsl"

void main() {
  uint tile = gl_WorkGroupID.x, lane = gl_LocalInvocationID.x;
  SplatTile t = tiles[tile];
  SplatView view = views[t.view];
  uint row = lane % kTileHeight, first = kPixels == kTileWidth ? 0u : lane / kTileHeight * kPixels;
  uint y = t.y * kTileHeight + row;
  bool inside = y < view.height;
  bool left = active_tile(view, int(t.x) - 1, int(t.y)) != kNoTile;
  bool right = active_tile(view, int(t.x) + 1, int(t.y)) != kNoTile;
  vec3 a[kPixels], b[kPixels], squares[kPixels], ab[kPixels];
  [[unroll]] for (uint k = 0u; k < kPixels; ++k) a[k] = b[k] = squares[k] = ab[k] = vec3(0.0);
  [[unroll]] for (int m = -kSsimReach; m < int(kPixels) + kSsimReach; ++m) {
    int column = int(first) + m;  // in the tile
    int x = int(t.x * kTileWidth) + column;
    bool there = inside && x >= 0 && x < int(view.width);
    bool drawn = there && (column < 0 ? left : column < int(kTileWidth) || right);
    uint offset = there ? y * view.width + uint(x) : 0u;
    vec3 shown = drawn ? on_background(image[view.pixel + offset]) : vec3(there ? p.background : 0.0);
    vec3 wanted = there ? on_background(unpackUnorm4x8(target[view.target + offset])) : vec3(0.0);
    vec3 square = shown * shown + wanted * wanted, product = shown * wanted;
    [[unroll]] for (int k = 0; k < int(kPixels); ++k) {
      if (abs(m - k) > kSsimReach) continue;
      float w = window(m - k);
      a[k] += w * shown;
      b[k] += w * wanted;
      squares[k] += w * square;
      ab[k] += w * product;
    }
  }
  [[unroll]] for (uint k = 0u; k < kPixels; ++k) {
    uint at = 3u * ssim_place(tile, first + k, row);
    ssim_row_sums[at] = vec4(a[k], b[k].x);
    ssim_row_sums[at + 1u] = vec4(b[k].yz, squares[k].xy);
    ssim_row_sums[at + 2u] = vec4(squares[k].z, ab[k]);
  }
}
