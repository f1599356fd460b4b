// splat_blend.comp - one group an active tile, kPixels pixels a lane (a column of them): front-to-back blending (SPEC 2.6).
// A splat loaded once serves all pixels of the lane: what makes it fast where loads cost most (DESIGN).
// writes image (premultiplied color, alpha), depth where asked, and how many entries of the tile any pixel used.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/splat.h"
layout(local_size_x_id = 0) in;  // kTileWidth * kTileHeight / kPixels
layout(constant_id = 1) const uint kTileWidth = 8u;
layout(constant_id = 2) const uint kTileHeight = 8u;
layout(constant_id = 3) const uint kPixels = 8u;
layout(constant_id = 4) const uint kCutoffs = 1u;
layout(constant_id = 5) const uint kDepth = 0u;
layout(push_constant) uniform Push { SplatPush p; };
layout(std430, binding = 0) readonly buffer Tiles { SplatTile tiles[]; };
layout(std430, binding = 1) readonly buffer Views { SplatView views[]; };
layout(std430, binding = 2) readonly buffer TilePrefix { uint tile_prefix[]; };
layout(std430, binding = 3) readonly buffer TileBlock { uint tile_block[]; };
layout(std430, binding = 4) readonly buffer TileCount { uint tile_count[]; };
layout(std430, binding = 5) readonly buffer Sorted { uvec2 sorted[]; };
layout(std430, binding = 6) readonly buffer Splats { vec4 splats[]; };
layout(std430, binding = 7) readonly buffer Counters { uint counters[]; };
layout(std430, binding = 8) writeonly buffer Image { vec4 image[]; };
layout(std430, binding = 9) buffer TileUsed { uint tile_used[]; };
layout(std430, binding = 10) writeonly buffer DepthImage { float depth_image[]; };

#include "inc/alpha.glsl"

void main() {
  uint tile = gl_WorkGroupID.x, lane = gl_LocalInvocationID.x;
  SplatTile t = tiles[tile];
  SplatView view = views[t.view];
  uint column = t.x * kTileWidth + lane % kTileWidth;
  uint row = t.y * kTileHeight + lane / kTileWidth * kPixels;
  float px = float(column) + 0.5, py = float(row) + 0.5;
  uint start = tile_prefix[tile] + tile_block[tile / kScanBlock];
  uint n = counters[kCounterOverflow] != 0u ? 0u : tile_count[tile];

  vec3 color[kPixels];
  float transmittance[kPixels], depth[kPixels];
  bool open[kPixels];
  for (uint k = 0u; k < kPixels; ++k) {
    color[k] = vec3(0.0);
    transmittance[k] = 1.0;
    depth[k] = 0.0;
    open[k] = true;
  }
  uint entry = 0u;
  for (; entry < n; ++entry) {
    uint s = kSplatRows * sorted[start + entry].x;
    vec4 a = splats[s], b = splats[s + 1u], c = splats[s + 2u];
    float dx = px - a.x;
    bool any_open = false;
    for (uint k = 0u; k < kPixels; ++k) {
      float dy = py + float(k) - a.y;
      float alpha = min(gaussian_falloff(b.xyz, dx, dy) * a.z, kAlphaCap);
      float after = transmittance[k] * (1.0 - alpha);
      bool seen = alpha >= kAlphaLeast && open[k];
      open[k] = open[k] && (!seen || after >= kTransmittanceLeast);
      seen = seen && open[k];
      float weight = seen ? alpha * transmittance[k] : 0.0;
      color[k] += weight * c.xyz;
      if (kDepth != 0u) depth[k] += weight * a.w;
      transmittance[k] = seen ? after : transmittance[k];
      any_open = any_open || open[k];
    }
    if (!any_open) break;
  }
  atomicMax(tile_used[tile], min(entry + 1u, n));
  for (uint k = 0u; k < kPixels; ++k) {
    if (column < view.width && row + k < view.height) {
      uint pixel = view.pixel + (row + k) * view.width + column;
      float alpha = 1.0 - transmittance[k];
      image[pixel] = vec4(color[k], alpha);
      if (kDepth != 0u) depth_image[pixel] = alpha > 0.5 ? depth[k] / alpha : 0.0;
    }
  }
}
