// ssim_rows_backward.comp - one invocation a pixel: the window along x over the gradient factors P, Q, R.
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
layout(std430, binding = 2) readonly buffer Factors { vec4 factors[]; };
layout(std430, binding = 3) writeonly buffer Rows { vec4 rows[]; };

void main() {
  SplatTile t = tiles[gl_WorkGroupID.x];
  SplatView view = views[t.view];
  for (uint k = gl_LocalInvocationID.x; k < kTileWidth * kTileHeight; k += gl_WorkGroupSize.x) {
    uint x = t.x * kTileWidth + k % kTileWidth, y = t.y * kTileHeight + k / kTileWidth;
    if (x < view.width && y < view.height) {
      vec3 s0 = vec3(0.0), s1 = vec3(0.0), s2 = vec3(0.0);
      for (int m = -kReach; m <= kReach; ++m) {
        int at = int(x) + m;
        if (at >= 0 && at < int(view.width)) {
          uint row = 3u * (view.pixel + y * view.width + uint(at));
          float w = kWindow[m + kReach];
          s0 += w * factors[row].xyz;
          s1 += w * factors[row + 1u].xyz;
          s2 += w * factors[row + 2u].xyz;
        }
      }
      uint out_row = 4u * (view.pixel + y * view.width + x);
      rows[out_row] = vec4(s0, s1.x);
      rows[out_row + 1u] = vec4(s1.yz, s2.xy);
      rows[out_row + 2u] = vec4(s2.z, 0.0, 0.0, 0.0);
    }
  }
}
