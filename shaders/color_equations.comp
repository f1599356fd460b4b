// color_equations.comp - one work group, which is one subgroup, per (link, slice of a view's tiles): the normal
// equations of the colors of the link's pixels, with the residual r = gain drawn + bias - observed (chainsplat/splat.h,
// ColorSums). A pixel that shows the surface point x moves with its link: dr/d(twist) = -grad . d(pixel)/dx . (motion
// of x), where grad is the mean of the drawn and the observed image gradients (second order in the step: Malis' ESM).
// Gain and bias are solved for first, from the sums of color_pixels.comp.
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_shuffle : require
#include "shared/splat.h"
#include "shared/color.h"
layout(local_size_x_id = 0) in;
layout(constant_id = 1) const uint kTileWidth = 8u;
layout(constant_id = 2) const uint kTileHeight = 8u;
layout(constant_id = 3) const uint kSubgroup = 8u;  // lanes per work group
layout(push_constant) uniform Push { ColorPush p; };
layout(std430) readonly buffer Tiles { SplatTile tiles[]; };
layout(std430) readonly buffer Views { SplatView views[]; };
layout(std430) readonly buffer ColorViews { ColorView color_views[]; };
layout(std430) readonly buffer Segments { vec4 segments[]; };
layout(std430) readonly buffer Image { vec4 image[]; };
layout(std430) readonly buffer DepthImage { float depth_image[]; };
layout(std430) readonly buffer Target { uint target[]; };
layout(std430) readonly buffer TilePixels { uint tile_pixels[]; };
layout(std430) readonly buffer TileSummary { uvec2 tile_summary[]; };
layout(std430) readonly buffer PixelSums { vec4 pixel_sums[]; };
layout(std430) writeonly buffer LinkSums { float link_sums[]; };  // 4 kColorRows per (view, link, slice)

#include "inc/subgroup_sum.glsl"

// Gain and bias after one step of robust least squares from 1 and 0; every work group computes the same bits.
vec2 exposure(uint v, uint lane) {
  float sums[5];
  [[unroll]] for (uint k = 0u; k < 5u; ++k) sums[k] = 0.0;
  for (uint s = lane; s < p.pixel_slices; s += kSubgroup) {
    uint row = kColorPixelRows * (v * p.pixel_slices + s);
    vec4 a = pixel_sums[row];
    sums[0] += a.x;
    sums[1] += a.y;
    sums[2] += a.z;
    sums[3] += a.w;
    sums[4] += pixel_sums[row + 1u].x;
  }
  [[unroll]] for (uint k = 0u; k < 5u; ++k) sums[k] = subgroup_sum(sums[k]);
  float gain2 = sums[0] + kColorGainWeight, bias2 = sums[2] + kColorBiasWeight;
  float determinant = gain2 * bias2 - sums[1] * sums[1];
  return vec2(1.0, 0.0) - vec2(bias2 * sums[3] - sums[1] * sums[4], gain2 * sums[4] - sums[1] * sums[3]) / determinant;
}

bool shows(uint tile, uint link) { return (tile_summary[tile].y >> (link & 31u) & 1u) != 0u; }

vec3 observed_at(uint at) { return unpackUnorm4x8(target[at]).xyz; }

void main() {
  uint link = gl_WorkGroupID.x, slice = gl_WorkGroupID.y, v = gl_WorkGroupID.z, lane = gl_SubgroupInvocationID;
  SplatView view = views[v];
  ColorView color_view = color_views[v];
  vec2 gain_bias = exposure(v, lane);
  float gain = gain_bias.x, bias = gain_bias.y;
  vec3 start = segments[2u * (color_view.first_segment + link)].xyz;
  float sums[4u * kColorRows];
  [[unroll]] for (uint k = 0u; k < 4u * kColorRows; ++k) sums[k] = 0.0;
  uint t = slice;
  for (;;) {
    // jump to the next tile that shows the link: a software device executes a branch's body even if no lane takes it
    while (t < color_view.tiles && !shows(color_view.first_tile + t, link)) t += p.equation_slices;
    if (t >= color_view.tiles) break;
    uint tile = color_view.first_tile + t, count = tile_summary[tile].x, first = tile * kTileWidth * kTileHeight;
    uvec2 corner = uvec2(tiles[tile].x * kTileWidth, tiles[tile].y * kTileHeight);
    for (uint k = lane; k < count; k += kSubgroup) {
      uint entry = tile_pixels[first + k], place = entry & 0xffu;
      if (entry >> 8u != link) continue;
      uvec2 pixel = corner + uvec2(place % kTileWidth, place / kTileWidth);
      uint offset = pixel.y * view.width + pixel.x, shown = view.pixel + offset, looked = view.target + offset;
      // image gradients, residual and its weight
      vec3 drawn = image[shown].xyz;
      vec3 across = 0.25 * (gain * (image[shown + 1u].xyz - image[shown - 1u].xyz) +
                            observed_at(looked + 1u) - observed_at(looked - 1u));
      vec3 down = 0.25 * (gain * (image[shown + view.width].xyz - image[shown - view.width].xyz) +
                          observed_at(looked + view.width) - observed_at(looked - view.width));
      vec3 residual = gain * drawn + bias - observed_at(looked);
      vec3 weight = min(vec3(1.0), kColorNoise / max(abs(residual), vec3(1e-6)));

      // -d(pixel)/d(twist): u and w by translation, u_moment and w_moment by rotation about the link's start
      float z = depth_image[shown];
      vec2 slope = (vec2(pixel) + 0.5 - view.intrinsics.zw) / view.intrinsics.xy, focal = -view.intrinsics.xy / z;
      vec3 from = vec3(slope, 1.0) * z - start;
      vec3 u = vec3(focal.x, 0.0, -focal.x * slope.x), w = vec3(0.0, focal.y, -focal.y * slope.y);
      vec3 u_moment = cross(from, u), w_moment = cross(from, w);
      float by_u[6] = {u_moment.x, u_moment.y, u_moment.z, u.x, u.y, u.z};
      float by_w[6] = {w_moment.x, w_moment.y, w_moment.z, w.x, w.y, w.z};

      // sum over the channels first: they share the pixel's motion
      vec3 weighted_across = weight * across, weighted_down = weight * down;
      float aa = dot(weighted_across, across), ad = dot(weighted_across, down), dd = dot(weighted_down, down);
      vec2 by_gain = vec2(dot(weighted_across, drawn), dot(weighted_down, drawn));
      vec2 by_bias = vec2(dot(weighted_across, vec3(1.0)), dot(weighted_down, vec3(1.0)));
      vec2 right = vec2(dot(weighted_across, residual), dot(weighted_down, residual));
      uint at = kColorTwist;
      [[unroll]] for (uint i = 0u; i < 6u; ++i) {
        float row_u = aa * by_u[i] + ad * by_w[i], row_w = ad * by_u[i] + dd * by_w[i];
        [[unroll]] for (uint j = i; j < 6u; ++j) sums[at + j - i] += row_u * by_u[j] + row_w * by_w[j];
        at += 6u - i;
        sums[kColorByGain + i] += by_gain.x * by_u[i] + by_gain.y * by_w[i];
        sums[kColorByBias + i] += by_bias.x * by_u[i] + by_bias.y * by_w[i];
        sums[kColorRight + i] += right.x * by_u[i] + right.y * by_w[i];
      }
      vec3 weighted = weight * residual;
      sums[kColorGain2] += dot(weight, drawn * drawn);
      sums[kColorGain2 + 1u] += dot(weight, drawn);
      sums[kColorGain2 + 2u] += dot(weight, vec3(1.0));
      sums[kColorGain2 + 3u] += dot(weighted, drawn);
      sums[kColorGain2 + 4u] += dot(weighted, vec3(1.0));
      sums[kColorGain2 + 5u] += dot(weighted, residual);
    }
    t += p.equation_slices;
  }
  if (lane == 0u) {
    sums[kColorExposure] = gain;
    sums[kColorExposure + 1u] = bias;
  }

  uint out_row = 4u * kColorRows * ((v * p.links + link) * p.equation_slices + slice);
  [[unroll]] for (uint first = 0u; first < 4u * kColorRows; first += 8u) {
    float eight[8];
    [[unroll]] for (uint k = 0u; k < 8u; ++k) eight[k] = sums[first + k];
    if (kSubgroup >= 8u) {
      float sum = subgroup_sums(eight);
      if (lane < 8u) link_sums[out_row + first + lane] = sum;
    } else {
      [[unroll]] for (uint k = 0u; k < 8u; ++k) eight[k] = subgroup_sum(eight[k]);
      if (lane == 0u) {
        [[unroll]] for (uint k = 0u; k < 8u; ++k) link_sums[out_row + first + k] = eight[k];
      }
    }
  }
}
