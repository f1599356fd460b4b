// splat_project.comp - one invocation per (live replica, view): its 2-D splat, the tiles that it touches, and how many
// of them are active. A splat extends to where its alpha falls to 1/255, not to three sigma. Where the tiles' lists
// have fixed places (tile_capacity) the pass also enters the splat into them, which is faster than prefix sums and
// splat_bin.comp where there is room for the longest list in every tile.
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_shuffle : require
#include "shared/splat.h"
#include "inc/gaussian.glsl"
layout(local_size_x = 64) in;
layout(constant_id = 0) const uint kCutoffs = 1u;
layout(constant_id = 1) const uint kTileWidth = 8u;
layout(constant_id = 2) const uint kTileHeight = 8u;
layout(constant_id = 3) const uint kShare = 1u;  // as in splat_blend.comp
layout(push_constant) uniform Push { SplatPush p; };
layout(std430) readonly buffer Parameters { float parameters[]; };
layout(std430) readonly buffer ReplicaShare { float replica_share[]; };
layout(std430) readonly buffer Live { uint live[]; };
layout(std430) readonly buffer Views { vec4 views[]; };
layout(std430) readonly buffer Motions { vec4 motions[]; };
layout(std430) readonly buffer TileMap { uint tile_map[]; };
layout(std430) buffer Counters { uint counters[]; };
layout(std430) writeonly buffer Splats { vec4 splats[]; };
layout(std430) writeonly buffer InstanceCount { uint instance_count[]; };
layout(std430) buffer TileCount { uint tile_count[]; };
layout(std430) writeonly buffer TileHits { uint tile_hits[]; };
layout(std430) writeonly buffer Entries { uvec4 entries[]; };  // depth bits, replica number, splat, instance

#include "inc/project.glsl"
#include "inc/share.glsl"
#include "inc/view.glsl"

// -exponent at which a Gaussian is about 0 in float: the extent when there is no 1/255 cut
const float kFullReach = 80.0;

// Least delta^T Q delta over the rectangle [low, high] of pixel centers, relative to the splat's center. If the center
// lies outside, the minimum is on one of the two edges that face it.
float least_in(vec3 conic, vec2 low, vec2 high) {
  vec2 facing = clamp(vec2(0.0), low, high);
  vec2 a = vec2(facing.x, clamp(-conic.y / conic.z * facing.x, low.y, high.y));
  vec2 b = vec2(clamp(-conic.y / conic.x * facing.y, low.x, high.x), facing.y);
  return min(conic.x * a.x * a.x + 2.0 * conic.y * a.x * a.y + conic.z * a.y * a.y,
             conic.x * b.x * b.x + 2.0 * conic.y * b.x * b.y + conic.z * b.y * b.y);
}

void main() {
  uint r = gl_GlobalInvocationID.x, v = gl_WorkGroupID.y;
  SplatView view = view_at(v);  // here, where all lanes are still active
  uint live_count = counters[kCounterLive];
  if (r >= live_count) return;
  uint e = live[r], n = p.gaussians, i = e % n, link = e / n;
  uint replica = i * p.links + link;  // number of replica (i, j) of mathematics.md 2.4, which breaks ties of depth
  uint out_index = v * live_count + r;

  // project the replica
  Projection a = project(view, n, i, link);
  float opacity = opacity_of(parameters[at_opacity(n, i)]) * replica_share[e];
  float determinant = a.cov.x * a.cov.z - a.cov.y * a.cov.y;
  vec2 u = view.intrinsics.xy * a.x.xy / a.x.z + view.intrinsics.zw;

  // half widths of the box where alpha can reach the cut
  float reach = kCutoffs != 0u ? 2.0 * log(1.0 / kLeastAlpha * opacity) : 2.0 * kFullReach;
  bool visible = a.x.z >= kNear && reach > 0.0 && determinant > 0.0;
  vec2 half_width = sqrt(max(reach, 0.0) * a.cov.xz);
  // pixel centers are at + 0.5: pixel k is inside the box when u - h <= k + 0.5 <= u + h
  vec2 low = clamp(u - half_width - 0.5, vec2(-1.0), vec2(view.width, view.height) + 1.0);
  vec2 high = clamp(u + half_width - 0.5, vec2(-1.0), vec2(view.width, view.height) + 1.0);
  ivec2 first = max(ivec2(ceil(low)), ivec2(0));
  ivec2 last = min(ivec2(floor(high)), ivec2(view.width, view.height) - 1);
  visible = visible && all(lessThanEqual(first, last));
  uvec2 t0 = uvec2(max(first, ivec2(0))) / uvec2(kTileWidth, kTileHeight);
  uvec2 t1 = uvec2(max(last, ivec2(0))) / uvec2(kTileWidth, kTileHeight) + 1u;
  if (!visible) t1 = t0;

  // count the active tiles that it touches
  float inverse = 1.0 / determinant;
  vec3 conic = vec3(a.cov.z, -a.cov.y, a.cov.x) * inverse;
  const float kSlack = 1.001;  // rounding must not drop a tile with a pixel that the splat reaches
  vec2 size = vec2(kTileWidth, kTileHeight);
  uint count = 0u, hits = 0u;
  // one loop over the rectangle instead of one per row: lanes with smaller rectangles then wait for the largest area
  // only, not for the largest number of rows times that of columns
  uint places = (t1.x - t0.x) * (t1.y - t0.y);
  uvec2 t = t0;
  for (uint place = 0u; place < places; ++place) {
    uint tile = tile_map[view.tile_map + t.y * view.tiles_x + t.x];
    vec2 low = vec2(t) * size + 0.5 - u;
    bool hit = place >= kTileHits || !(least_in(conic, low, low + size - 1.0) > kSlack * reach);
    if (tile != kNoTile && hit) {
      uint entry = atomicAdd(tile_count[tile], 1u);
      uint instance = out_index * p.splat_capacity + min(count, p.splat_capacity - 1u);
      ++count;
      if (entry < p.tile_capacity)
        entries[tile * p.tile_capacity + entry] = uvec4(floatBitsToUint(a.x.z), replica, out_index, instance);
    }
    hits |= hit && place < kTileHits ? 1u << place : 0u;
    t = t.x + 1u < t1.x ? uvec2(t.x + 1u, t.y) : uvec2(t0.x, t.y + 1u);
  }
  if (p.tile_capacity > 0u && (p.flags & kFlagGradients) != 0u && count > p.splat_capacity) {
    counters[kCounterOverflow] = 1u;
    atomicMax(counters[kCounterWantSplat], count);
  }
  tile_hits[out_index] = hits;
  instance_count[out_index] = count;
  if (count == 0u) t1 = t0;

  // color in the view direction, which in the home frame is R^T r
  vec3 direction = normalize(a.x) * a.link;
  vec3 color = vec3(0.5);
  uint sh = at_sh(n, p.coefficients, i);
  for (uint l = 0u; l < p.coefficients; ++l) color += sh_basis(l, direction) * coefficient(sh, l);
  color *= side_of(view, a.mean, a.link).brightness;
  splats[kSplatRows * out_index] = vec4(u, opacity, a.x.z);
  splats[kSplatRows * out_index + 1u] =
      vec4(conic, uintBitsToFloat(t0.x | t1.x << 16u));
  color = clamp(color * view.gain.xyz + view.bias.xyz, vec3(0.0), vec3(view.gain.w));
  splats[kSplatRows * out_index + 2u] = vec4(color, uintBitsToFloat(t0.y | t1.y << 16u));
}
