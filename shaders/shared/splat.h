// shaders/shared/splat.h - structs and constants that src/splat and the shaders share. Only vec4, float and uint, which
// have the same layout in C++ and GLSL.
#ifdef __cplusplus
#pragma once
#include <glm/glm.hpp>
namespace chainsplat::shared {
using glm::vec4;
using uint = unsigned;
#endif

// One view of the batch. The camera frame has OpenCV axes and its origin at the camera center; pixels are the crop's.
struct SplatView {
  vec4 intrinsics;   // fx, fy, cx - x0, cy - y0 (px)
  vec4 limits;       // x, y: largest |x/z|, |y/z| in the projection's Jacobian (mathematics.md 2.5)
                     // z: Gaussians::pixel_footprint, m; w unused
  vec4 moment_point; // xyz: base origin in the camera frame (m), about which link moments are summed; w unused
  vec4 gain;         // xyz: recorded = gain * color + bias; w: recorded white, what is brighter is cut off
  vec4 bias;         // xyz; w unused
  vec4 axis;         // xyz: the rope's at home; w: 0 if every side of it has the brightness 1
  vec4 light;        // xyz: the linear part in camera axes; w: the constant one
  vec4 light_squares, light_products;  // xx, yy, zz and xy, xz, yz of the quadratic part in camera axes; w unused
  uint width, height;            // px of the crop
  uint tiles_x, tiles_y;
  uint tile_map;                 // first entry in the tile map (grid cell -> active tile or kNoTile)
  uint pixel;                    // first pixel in the image buffers
  uint target;                   // first pixel in the target buffer
  uint motion;                   // first link pose, in units of one pose (3 vec4 rows of camera_from_home)
};

const uint kViewRows = 11u;      // vec4 of a SplatView

// One active tile: a tile of a view that is blended and contributes to the loss.
struct SplatTile {
  uint view, x, y, padding;      // x, y in tiles
};

struct SplatPush {
  uint gaussians, links, coefficients, views;
  uint live_capacity, instance_capacity, tiles, slots;
  float weight_l1, weight_dssim, weight_mask;  // already divided by the number of summands of each mean
  uint near_tiles;                             // the first near_tiles active tiles have a D-SSIM term
  uint scan_length, scan_per_live, scan_counter, flags;
  uint tile_stride;    // passes over all active tiles visit tile k * tile_stride % tiles as the k-th
  uint tile_capacity;  // entries of each list at its fixed place, which splat_project.comp fills; 0: the lists are
                       // contiguous, laid out by prefix sums and filled by splat_bin.comp
  float background;    // gray, 0..1, that the loss lays drawn and wanted colors over
  uint splat_capacity; // with lists at fixed places: of instances of each splat, which have fixed numbers then
};

const uint kNoTile = 0xffffffffu;
const uint kScanBlock = 1024u;      // elements that one work group scans
const uint kGroup = 64u;            // invocations per work group of the passes that run one invocation per item

// Places in counters[], which scan_sums.comp and others fill. The first kCounterKept keep their values for as long as
// the Gaussians do not change.
const uint kCounterLive = 0u;       // number of live replicas
const uint kCounterWantLive = 1u;   // the capacity for live replicas that was needed
const uint kCounterDispatch = 2u;   // 3 uints: work groups of the passes over pairs; the host sets the last two
const uint kCounterKept = 3u;
const uint kCounterInstances = 5u;  // number of (view, replica, tile) triples
const uint kCounterTiles = 6u;      // the same number, summed by tile
const uint kCounterWantInstances = 7u;
const uint kCounterOverflow = 8u;   // not 0: a capacity was exceeded, and no result of this submission may be used
const uint kCounterTooLong = 9u;    // not 0: a tile's list is longer than kLongestList
const uint kCounterLongTiles = 10u; // 3 uints: work groups of splat_sort_long.comp; the host sets the last two
const uint kCounterNotFinite = 13u; // number of gradients that Adam skipped
const uint kCounterWantTile = 14u;  // the tile capacity that was needed
const uint kCounterWantSplat = 15u; // the splat capacity that was needed
const uint kCounters = 16u;
const uint kLongestList = 32768u;   // entries of a tile; lavapipe ends an invocation's loops after 65535 iterations

const uint kFlagHeldLinks = 1u;     // link logits have no gradient, and replicas are live whatever their opacity
const uint kFlagGradients = 2u;     // instance_place[] is needed

// splat record: 3 vec4
//   0: u (px), opacity, depth (m)   1: conic xx, xy, yy, tiles x0 | x1 << 16   2: color, tiles y0 | y1 << 16
const uint kSplatRows = 3u;
const uint kTileHits = 32u;         // first tiles of the rectangle, by rows, with a bit that says whether the splat
                                    // touches them; later tiles count as touched
// gradient record of one (replica, view): 6 vec4
//   0: mean (home), opacity   1: rotation   2: log scale, direction   3: color, direction (home, packed)
//   4: link moment   5: link force (camera frame)
const uint kGradientRows = 6u;
// partial gradient of one (instance, cluster of lanes), in the order of the lists: 9 floats without padding, because
// the caches do not hold all of them and waiting for memory is what costs most
//   u x 2, opacity, red   xx, xy, yy of 2 dL/dSigma', green   blue
const uint kPartial = 9u;

#ifdef __cplusplus
static_assert(sizeof(SplatView) == kViewRows * sizeof(vec4) && sizeof(SplatTile) == 16 && sizeof(SplatPush) == 80);
}  // namespace chainsplat::shared
#endif
