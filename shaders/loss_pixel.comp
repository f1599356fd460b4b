// loss_pixel.comp - one work group per active tile: the tile's sums of absolute color and mask errors (mathematics.md
// 2.7), and the squared color error and the number of pixels inside the object. splat_blend_backward.comp has the
// gradient.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/splat.h"
#include "chainsplat/image_model.h"
layout(local_size_x_id = 0) in;
layout(constant_id = 1) const uint kTileWidth = 8u;
layout(constant_id = 2) const uint kTileHeight = 8u;
layout(push_constant) uniform Push { SplatPush p; };
layout(std430) readonly buffer Tiles { SplatTile tiles[]; };
layout(std430) readonly buffer Views { SplatView views[]; };
layout(std430) readonly buffer Image { vec4 image[]; };
layout(std430) readonly buffer Target { uint target[]; };
layout(std430) writeonly buffer TileLoss { vec4 tile_loss[]; };

#include "inc/background.glsl"

shared vec4 lane_sum[gl_WorkGroupSize.x];

void main() {
  uint tile = gl_WorkGroupID.x, lane = gl_LocalInvocationID.x;
  SplatTile t = tiles[tile];
  SplatView view = views[t.view];
  vec4 sum = vec4(0.0);
  for (uint k = lane; k < kTileWidth * kTileHeight; k += gl_WorkGroupSize.x) {
    uint x = t.x * kTileWidth + k % kTileWidth, y = t.y * kTileHeight + k / kTileWidth;
    if (x < view.width && y < view.height) {
      uint pixel = view.pixel + y * view.width + x;
      vec4 wanted = unpackUnorm4x8(target[view.target + y * view.width + x]);
      vec3 shown = clamp(image[pixel].xyz, 0.0, 1.0) - wanted.xyz;
      float object = wanted.w >= float(kObjectMask) / 255.0 ? 1.0 : 0.0;
      vec3 off = on_background(image[pixel]) - on_background(wanted);
      sum += vec4(dot(abs(off), vec3(1.0)), abs(image[pixel].w - wanted.w), object * dot(shown, shown), object);
    }
  }
  lane_sum[lane] = sum;
  barrier();
  if (lane == 0u) {
    for (uint k = 1u; k < gl_WorkGroupSize.x; ++k) sum += lane_sum[k];
    tile_loss[2u * tile] = sum;
    tile_loss[2u * tile + 1u] = vec4(0.0);
  }
}
