// ssim_columns_backward.comp - one invocation a pixel: the window along y, and the gradient of the D-SSIM term added to the
// pixel's gradient: w*P + 2x (w*Q) + y (w*R) (SPEC 2.7).
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
layout(std430, binding = 3) readonly buffer Image { vec4 image[]; };
layout(std430, binding = 4) readonly buffer Target { uint target[]; };
layout(std430, binding = 5) buffer PixelGradient { vec4 pixel_gradient[]; };

void main() {
  SplatTile t = tiles[gl_WorkGroupID.x];
  SplatView view = views[t.view];
  for (uint k = gl_LocalInvocationID.x; k < kTileWidth * kTileHeight; k += gl_WorkGroupSize.x) {
    uint x = t.x * kTileWidth + k % kTileWidth, y = t.y * kTileHeight + k / kTileWidth;
    if (x < view.width && y < view.height) {
      vec4 s0 = vec4(0.0), s1 = vec4(0.0);
      float s2 = 0.0;
      for (int m = -kReach; m <= kReach; ++m) {
        int at = int(y) + m;
        if (at >= 0 && at < int(view.height)) {
          uint row = 4u * (view.pixel + uint(at) * view.width + x);
          float w = kWindow[m + kReach];
          s0 += w * rows[row];
          s1 += w * rows[row + 1u];
          s2 += w * rows[row + 2u].x;
        }
      }
      uint offset = y * view.width + x;
      vec3 shown = image[view.pixel + offset].xyz, wanted = unpackUnorm4x8(target[view.target + offset]).xyz;
      vec3 g = s0.xyz + 2.0 * shown * vec3(s0.w, s1.xy) + wanted * vec3(s1.zw, s2);
      pixel_gradient[view.pixel + offset] += vec4(g, 0.0);
    }
  }
}
