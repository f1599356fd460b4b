// color_pixels.comp - one work group, which is one subgroup, per slice of a view's tiles: finds the pixels whose color
// counts, the link that each of them shows (the one whose axis is nearest to the drawn surface), and the sums for the
// exposure and for the correlation of drawn and observed colors. A pixel counts if it lies inside the mask, away from
// its edge, and the rope is drawn opaque there.
// writes tile_pixels, tile by tile: place in the tile | link << 8; tile_summary: their number, a bit per link % 32.
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_shuffle : require
#include "shared/splat.h"
#include "shared/color.h"
#include "chainsplat/image_model.h"
layout(local_size_x_id = 0) in;
layout(constant_id = 1) const uint kTileWidth = 8u;
layout(constant_id = 2) const uint kTileHeight = 8u;
layout(constant_id = 3) const uint kSubgroup = 8u;  // lanes per work group, at most the pixels of a tile
layout(constant_id = 4) const uint kColumns = 1u;   // columns of a tile that a lane covers
layout(constant_id = 5) const uint kRows = 8u;      // pixels of each of these columns that it covers
layout(push_constant) uniform Push { ColorPush p; };
layout(std430) readonly buffer Tiles { SplatTile tiles[]; };
layout(std430) readonly buffer Views { SplatView views[]; };
layout(std430) readonly buffer ColorViews { ColorView color_views[]; };
layout(std430) readonly buffer Segments { vec4 segments[]; };
layout(std430) readonly buffer Image { vec4 image[]; };
layout(std430) readonly buffer DepthImage { float depth_image[]; };
layout(std430) readonly buffer Target { uint target[]; };
layout(std430) writeonly buffer TilePixels { uint tile_pixels[]; };
layout(std430) writeonly buffer TileSummary { uvec2 tile_summary[]; };
layout(std430) writeonly buffer PixelSums { vec4 pixel_sums[]; };

const uint kReach = 2u * kColorEdge;
const uint kNone = 0xffffffu;
const float kFar = 1e30;

// per column of the tile and of the margin beside it: bit r says whether rows r .. r + kReach are inside the mask
shared uint column_inside[kTileWidth + kReach];

#include "inc/subgroup_sum.glsl"

// Inclusive prefix sum over the lanes.
uint subgroup_prefix(uint x) {
  uint lane = gl_SubgroupInvocationID;
  [[unroll]] for (uint step = 1u; step < kSubgroup; step *= 2u) {
    uint other = subgroupShuffle(x, max(lane, step) - step);
    x += lane >= step ? other : 0u;
  }
  return x;
}

uint subgroup_or(uint x) {
  [[unroll]] for (uint step = 1u; step < kSubgroup; step *= 2u) x |= subgroupShuffleXor(x, step);
  return x;
}

uint inside_below(SplatView view, int x, int y) {
  uint bits = 0u;
  bool column = x >= 0 && x < int(view.width);
  [[unroll]] for (int r = 0; r < int(kTileHeight + kReach); ++r) {
    bool there = column && y + r >= 0 && y + r < int(view.height);
    uint alpha = there ? target[view.target + uint(y + r) * view.width + uint(x)] >> 24u : 0u;
    bits |= alpha >= uint(kObjectMask) ? 1u << r : 0u;
  }
  uint all = bits;
  [[unroll]] for (uint r = 1u; r <= kReach; ++r) all &= bits >> r;
  return all;
}

void main() {
  uint slice = gl_WorkGroupID.x, v = gl_WorkGroupID.y, lane = gl_SubgroupInvocationID;
  SplatView view = views[v];
  ColorView color_view = color_views[v];
  uint column = lane % kTileWidth, row = lane / kTileWidth * kRows;
  float sums[15];
  [[unroll]] for (uint k = 0u; k < 15u; ++k) sums[k] = 0.0;
  for (uint t = slice; t < color_view.tiles; t += p.pixel_slices) {
    uint tile = color_view.first_tile + t;
    uvec2 corner = uvec2(tiles[tile].x * kTileWidth, tiles[tile].y * kTileHeight);

    // mask, eroded by kColorEdge
    subgroupBarrier();
    for (uint c = lane; c < kTileWidth + kReach; c += kSubgroup)
      column_inside[c] = inside_below(view, int(corner.x + c) - int(kColorEdge), int(corner.y) - int(kColorEdge));
    subgroupBarrier();

    // points of the drawn surface at the pixels that count
    vec3 point[kColumns * kRows];  // camera frame
    float least[kColumns * kRows];
    uint link[kColumns * kRows];
    uint count = 0u;
    [[unroll]] for (uint c = 0u; c < kColumns; ++c) {
      uint x = column + c * kSubgroup, inside = column_inside[x];
      [[unroll]] for (uint m = 1u; m <= kReach; ++m) inside &= column_inside[x + m];
      [[unroll]] for (uint r = 0u; r < kRows; ++r) {
        uint k = c * kRows + r;
        float z = 0.0;
        if ((inside >> (row + r) & 1u) != 0u) {
          uint at = view.pixel + (corner.y + row + r) * view.width + corner.x + x;
          z = image[at].w >= kColorOpaque ? depth_image[at] : 0.0;
        }
        count += z > 0.0 ? 1u : 0u;
        vec2 pixel = vec2(corner.x + x, corner.y + row + r) + 0.5;
        point[k] = vec3((pixel - view.intrinsics.zw) / view.intrinsics.xy, 1.0) * z;
        least[k] = z > 0.0 ? kFar : -1.0;
        link[k] = kNone;
      }
    }
    uint inclusive = subgroup_prefix(count), total = subgroupShuffle(inclusive, kSubgroup - 1u);

    // nearest link of each point; lanes load one segment each and exchange them
    for (uint first = 0u; first < (total > 0u ? p.links : 0u); first += kSubgroup) {
      uint own = 2u * (color_view.first_segment + min(first + lane, p.links - 1u));
      vec4 own_start = segments[own];
      vec3 own_along = segments[own + 1u].xyz;
      for (uint turn = 0u; turn < min(kSubgroup, p.links - first); ++turn) {
        vec3 start = vec3(subgroupShuffle(own_start.x, turn), subgroupShuffle(own_start.y, turn),
                          subgroupShuffle(own_start.z, turn));
        vec3 along = vec3(subgroupShuffle(own_along.x, turn), subgroupShuffle(own_along.y, turn),
                          subgroupShuffle(own_along.z, turn));
        float reach = subgroupShuffle(own_start.w, turn);
        [[unroll]] for (uint k = 0u; k < kColumns * kRows; ++k) {
          vec3 from = point[k] - start;
          from -= clamp(dot(from, along), 0.0, reach) * along;
          float distance2 = dot(from, from);
          bool nearer = distance2 < kColorNearer * least[k];
          least[k] = nearer ? distance2 : least[k];
          link[k] = nearer ? first + turn : link[k];
        }
      }
    }

    // list of the pixels, and the sums at gain 1 and bias 0 (shared/color.h)
    uint place = tile * kTileWidth * kTileHeight + inclusive - count, links_there = 0u;
    [[unroll]] for (uint c = 0u; c < kColumns; ++c) {
      [[unroll]] for (uint r = 0u; r < kRows; ++r) {
        uint k = c * kRows + r, x = column + c * kSubgroup, y = row + r;
        if (link[k] != kNone) {
          links_there |= 1u << (link[k] & 31u);
          tile_pixels[place] = y * kTileWidth + x | link[k] << 8u;
          ++place;
          uint offset = (corner.y + y) * view.width + corner.x + x;
          vec3 drawn = image[view.pixel + offset].xyz, observed = unpackUnorm4x8(target[view.target + offset]).xyz;
          vec3 residual = drawn - observed;
          vec3 weight = min(vec3(1.0), kColorNoise / max(abs(residual), vec3(1e-6)));
          vec3 drawn0 = drawn - 0.5, observed0 = observed - 0.5;
          sums[0] += dot(weight, drawn * drawn);
          sums[1] += dot(weight, drawn);
          sums[2] += dot(weight, vec3(1.0));
          sums[3] += dot(weight * residual, drawn);
          sums[4] += dot(weight, residual);
          sums[5] += 1.0;
          sums[6] += dot(drawn0, observed0);
          sums[7] += dot(drawn0, drawn0);
          sums[8] += drawn0.x;
          sums[9] += drawn0.y;
          sums[10] += drawn0.z;
          sums[11] += dot(observed0, observed0);
          sums[12] += observed0.x;
          sums[13] += observed0.y;
          sums[14] += observed0.z;
        }
      }
    }
    links_there = subgroup_or(links_there);
    if (lane == 0u) tile_summary[tile] = uvec2(total, links_there);
  }
  [[unroll]] for (uint k = 0u; k < 15u; ++k) sums[k] = subgroup_sum(sums[k]);
  uint out_row = kColorPixelRows * (v * p.pixel_slices + slice);
  if (lane == 0u) {
    pixel_sums[out_row] = vec4(sums[0], sums[1], sums[2], sums[3]);
    pixel_sums[out_row + 1u] = vec4(sums[4], sums[5], sums[6], sums[7]);
    pixel_sums[out_row + 2u] = vec4(sums[8], sums[9], sums[10], sums[11]);
    pixel_sums[out_row + 3u] = vec4(sums[12], sums[13], sums[14], 0.0);
  }
}
