// ssim_columns.comp - one invocation a pixel: the window along y, the SSIM map's sum by tile, and the three factors P, Q, R of
// its gradient (SPEC 2.7), three vec4 a pixel.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/splat.h"
#include "inc/ssim.glsl"
layout(local_size_x_id = 0) in;
layout(constant_id = 1) const uint kTileWidth = 8u;
layout(constant_id = 2) const uint kTileHeight = 8u;
layout(push_constant) uniform Push { SplatPush p; };
layout(std430, binding = 0) readonly buffer Tiles { SplatTile tiles[]; };
layout(std430, binding = 1) readonly buffer Views { SplatView views[]; };
layout(std430, binding = 2) readonly buffer Rows { vec4 rows[]; };
layout(std430, binding = 3) writeonly buffer Factors { vec4 factors[]; };
layout(std430, binding = 4) buffer TileLoss { vec4 tile_loss[]; };

shared float lane_sum[gl_WorkGroupSize.x];

void main() {
  uint lane = gl_LocalInvocationID.x;
  SplatTile t = tiles[gl_WorkGroupID.x];
  SplatView view = views[t.view];
  float sum = 0.0;
  for (uint k = lane; k < kTileWidth * kTileHeight; k += gl_WorkGroupSize.x) {
    uint x = t.x * kTileWidth + k % kTileWidth, y = t.y * kTileHeight + k / kTileWidth;
    if (x < view.width && y < view.height) {
      vec4 s0 = vec4(0.0), s1 = vec4(0.0), s2 = vec4(0.0), s3 = vec4(0.0);
      for (int m = -kReach; m <= kReach; ++m) {
        int at = int(y) + m;
        if (at >= 0 && at < int(view.height)) {
          uint row = 4u * (view.pixel + uint(at) * view.width + x);
          float w = kWindow[m + kReach];
          s0 += w * rows[row];
          s1 += w * rows[row + 1u];
          s2 += w * rows[row + 2u];
          s3 += w * rows[row + 3u];
        }
      }
      vec3 mx = s0.xyz, my = vec3(s0.w, s1.xy);
      vec3 a1 = 2.0 * mx * my + kC1, a2 = 2.0 * (s3.xyz - mx * my) + kC2;
      vec3 b1 = mx * mx + my * my + kC1, b2 = vec3(s1.zw, s2.x) - mx * mx + s2.yzw - my * my + kC2;
      vec3 similarity = a1 * a2 / (b1 * b2);
      sum += dot(1.0 - similarity, vec3(1.0));
      // the loss is weight * (1 - S): every pixel's factor is -weight
      float g = -p.weight_dssim;
      uint out_row = 3u * (view.pixel + y * view.width + x);
      factors[out_row] = vec4(g * (2.0 * my * (a2 - a1) / (b1 * b2) - 2.0 * mx * similarity * (1.0 / b1 - 1.0 / b2)), 0.0);
      factors[out_row + 1u] = vec4(-g * similarity / b2, 0.0);
      factors[out_row + 2u] = vec4(2.0 * g * a1 / (b1 * b2), 0.0);
    }
  }
  lane_sum[lane] = sum;
  barrier();
  if (lane == 0u) {
    for (uint k = 1u; k < gl_WorkGroupSize.x; ++k) sum += lane_sum[k];
    tile_loss[2u * gl_WorkGroupID.x + 1u].x = sum;
  }
}
