// splat_blend_backward.comp - laid out as splat_blend.comp: the gradient of each
// entry by the pixels of the tile (mathematics.md 2.8). It walks front to back: the color behind entry k is that of the
// whole pixel minus that up to k, and only its product with the pixel's gradient is carried along. Each cluster of
// kSubgroup lanes stores its sum in a slot of its own (no atomics), in the order of the list: stores that are scattered
// wait for the caches longer than the loads of splat_project_backward.comp do. A subgroup is one cluster, or several
// where it turns out wider than the least size that the device guarantees.
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_shuffle : require
#include "shared/splat.h"
layout(local_size_x_id = 0) in;
layout(constant_id = 1) const uint kTileWidth = 8u;
layout(constant_id = 2) const uint kTileHeight = 8u;
layout(constant_id = 3) const uint kPixels = 8u;
layout(constant_id = 4) const uint kCutoffs = 1u;
layout(constant_id = 5) const uint kSubgroup = 8u;  // lanes per cluster; no subgroup has fewer
layout(constant_id = 6) const uint kShare = 1u;     // as in splat_blend.comp
layout(push_constant) uniform Push { SplatPush p; };
layout(std430) readonly buffer Tiles { SplatTile tiles[]; };
layout(std430) readonly buffer Views { SplatView views[]; };
layout(std430) readonly buffer TilePrefix { uint tile_prefix[]; };
layout(std430) readonly buffer TileBlock { uint tile_block[]; };
layout(std430) readonly buffer TileCount { uint tile_count[]; };
layout(std430) readonly buffer Sorted { uint sorted[]; };
layout(std430) readonly buffer Splats { vec4 splats[]; };
layout(std430) readonly buffer Counters { uint counters[]; };
layout(std430) readonly buffer Image { vec4 image[]; };
layout(std430) readonly buffer TileUsed { uint tile_used[]; };
layout(std430) readonly buffer Target { uint target[]; };
layout(std430) readonly buffer PixelGradient { vec4 pixel_gradient[]; };  // of D-SSIM, by color and alpha
layout(std430) writeonly buffer Partials { float partials[]; };  // kPartial per slot

const uint kLanes = kTileWidth * kTileHeight / kPixels;  // per tile

#include "inc/group_tile.glsl"
#include "inc/share.glsl"
#include "inc/alpha.glsl"
#include "inc/background.glsl"
#include "inc/subgroup_sum.glsl"

void main() {
  uint tile = tile_of_lane(kLanes), lane = lane_in_tile(kLanes);
  if (tile == kNoTile) return;
  SplatTile t = tiles[tile];
  SplatView view = views[t.view];
  uint column = t.x * kTileWidth + lane % kTileWidth;
  uint row = t.y * kTileHeight + lane / kTileWidth * kPixels;
  float px = float(column) + 0.5, py = float(row) + 0.5;
  uint start = tile_prefix[tile] + tile_block[tile / kScanBlock];
  uint n = counters[kCounterOverflow] != 0u ? 0u : tile_count[tile];
  uint used = min(tile_used[tile], n);

  uint cluster_lane = lane % kSubgroup, cluster_slot = kPartial * (lane / kSubgroup);

  // gradient of the loss by the pixels
  bool dssim = p.weight_dssim > 0.0 && tile < p.near_tiles;
  vec4 gamma[kPixels];                            // gradient of the loss (mathematics.md 2.7) by color and alpha
  float transmittance[kPixels], behind[kPixels];  // behind: gamma . (color and alpha behind the entries so far)
  [[unroll]] for (uint k = 0u; k < kPixels; ++k) {
    bool inside = column < view.width && row + k < view.height;
    uint offset = (row + k) * view.width + column;
    gamma[k] = vec4(0.0);
    behind[k] = 0.0;
    if (inside) {
      vec4 shown = image[view.pixel + offset], wanted = unpackUnorm4x8(target[view.target + offset]);
      vec3 by_color = p.weight_l1 * sign(on_background(shown) - on_background(wanted));
      gamma[k] = vec4(by_color, p.weight_mask * sign(shown.w - wanted.w) - p.background * dot(by_color, vec3(1.0)));
      if (dssim) gamma[k] += pixel_gradient[view.pixel + offset];
      behind[k] = dot(gamma[k], shown);
    }
    transmittance[k] = 1.0;
  }

  // entries front to back: the gradient by color, opacity, center and covariance
  for (uint begin = 0u; begin < used; begin += kShare) {
    uint turns = kShare > 1u ? min(kShare, used - begin) : 1u, own_turn = gl_SubgroupInvocationID % kShare;
    uint own_place = start + begin + min(own_turn, turns - 1u), s = kSplatRows * sorted[own_place];
    uint own_slot = kPartial * p.slots * own_place;
    vec4 own_a = splats[s], own_b = splats[s + 1u], own_c = splats[s + 2u];
    float own_inverse = own_a.z > 1e-30 ? 1.0 / own_a.z : 0.0, own_blue = 0.0;
    Falloff own_falloff = falloff_of(own_b.xyz);
    for (uint turn = 0u; turn < turns; ++turn) {
      vec4 c = vec4(shared_by(own_c.xyz, turn), 1.0);
      Falloff falloff = shared_by(own_falloff, turn);
      float dx = px - shared_by(own_a.x, turn), dy = py - shared_by(own_a.y, turn) + falloff.slope * dx;
      float uncapped[kPixels];
      alphas_of(falloff, shared_by(own_a.z, turn), dx, dy, uncapped);
      vec3 grad_color = vec3(0.0), moments = vec3(0.0);  // moments: of dL/d(exponent), by powers of dy
      [[unroll]] for (uint k = 0u; k < kPixels; ++k) {
        float alpha = min(uncapped[k], kAlphaCap), before = transmittance[k];
        bool contributes;
        float weight = blend_weight(alpha, transmittance[k], contributes);
        float gamma_color = dot(gamma[k], c);
        behind[k] -= weight * gamma_color;
        grad_color += weight * gamma[k].xyz;
        float grad_alpha = before * gamma_color - behind[k] / max(1.0 - alpha, 1e-6);
        float g = contributes && uncapped[k] <= kAlphaCap ? uncapped[k] * grad_alpha : 0.0;
        float g_dy = g * (dy + float(k));
        moments += vec3(g, g_dy, g_dy * (dy + float(k)));
      }
      // from the moments in the column's dx and dy to those of Q delta (mathematics.md 2.8)
      const float kMinus2Ln2 = -1.3862944;
      float across = kMinus2Ln2 * falloff.fall, along = kMinus2Ln2 * falloff.along * dx;
      float grad_v = across * moments.y, grad_u = falloff.slope * grad_v + along * moments.x;
      float yy = across * across * moments.z, mixed = along * grad_v, xy = falloff.slope * yy + mixed;
      float xx = falloff.slope * (xy + mixed) + along * along * moments.x;
      float blue = subgroup_sum(grad_color.z);
      own_blue = turn == own_turn ? blue : own_blue;
      float sums[8] = {grad_u, grad_v, shared_by(own_inverse, turn) * moments.x, grad_color.x, xx, xy, yy, grad_color.y};
      uint slot = shared_by(own_slot, turn) + cluster_slot;
      if (kSubgroup >= 8u) {
        float sum = subgroup_sums(sums);
        if (cluster_lane < 8u) partials[slot + cluster_lane] = sum;
      } else {
        [[unroll]] for (uint k = 0u; k < 8u; ++k) sums[k] = subgroup_sum(sums[k]);
        if (cluster_lane == 0u) {
          [[unroll]] for (uint k = 0u; k < 8u; ++k) partials[slot + k] = sums[k];
        }
      }
    }
    if (cluster_lane < turns) partials[own_slot + cluster_slot + 8u] = own_blue;
  }
  // entries behind the last one that a pixel used have no gradient
  for (uint k = used + lane; k < n; k += kLanes) {
    uint slot = kPartial * p.slots * (start + k);
    for (uint m = 0u; m < kPartial * p.slots; ++m) partials[slot + m] = 0.0;
  }
}
