// ssim_rows.comp - one invocation a pixel: the window along x over image, target and their products, four vec4 a pixel:
//   0: x.rgb, y.r   1: y.gb, xx.rg   2: xx.b, yy.rgb   3: xy.rgb, -
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
layout(std430, binding = 2) readonly buffer Image { vec4 image[]; };
layout(std430, binding = 3) readonly buffer Target { uint target[]; };
layout(std430, binding = 4) writeonly buffer Rows { vec4 rows[]; };

void main() {
  SplatTile t = tiles[gl_WorkGroupID.x];
  SplatView view = views[t.view];
  for (uint k = gl_LocalInvocationID.x; k < kTileWidth * kTileHeight; k += gl_WorkGroupSize.x) {
    uint x = t.x * kTileWidth + k % kTileWidth, y = t.y * kTileHeight + k / kTileWidth;
    if (x < view.width && y < view.height) {
      vec3 a = vec3(0.0), b = vec3(0.0), aa = vec3(0.0), bb = vec3(0.0), ab = vec3(0.0);
      for (int m = -kReach; m <= kReach; ++m) {
        int at = int(x) + m;
        if (at >= 0 && at < int(view.width)) {
          uint offset = y * view.width + uint(at);
          vec3 shown = image[view.pixel + offset].xyz;
          vec3 wanted = unpackUnorm4x8(target[view.target + offset]).xyz;
          float w = kWindow[m + kReach];
          a += w * shown;
          b += w * wanted;
          aa += w * shown * shown;
          bb += w * wanted * wanted;
          ab += w * shown * wanted;
        }
      }
      uint row = 4u * (view.pixel + y * view.width + x);
      rows[row] = vec4(a, b.x);
      rows[row + 1u] = vec4(b.yz, aa.xy);
      rows[row + 2u] = vec4(aa.z, bb);
      rows[row + 3u] = vec4(ab, 0.0);
    }
  }
}
