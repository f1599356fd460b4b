// shaders/shared/splat.h - structs that src/splat and shaders/splat_*.comp, loss_*.comp share. Only vec4, float, uint.
#ifdef __cplusplus
#pragma once
#include <glm/glm.hpp>
namespace chainsplat::shared {
using glm::vec4;
using uint = unsigned;
#endif

// One view of the batch. Camera frame: OpenCV axes, origin at the camera center. Crop pixels.
struct SplatView {
  vec4 intrinsics;   // fx, fy, cx - x0, cy - y0 (px)
  vec4 limits;       // x, y: largest |x/z|, |y/z| in the projection's Jacobian (SPEC 2.5); z, w unused
  vec4 moment_point; // xyz: base origin in the camera frame (m), about which link moments are summed; w unused
  uint width, height;            // px of the crop
  uint tiles_x, tiles_y;
  uint tile_map;                 // first entry in the tile map (grid cell -> active tile or kNoTile)
  uint pixel;                    // first pixel in the image buffers
  uint target;                   // first pixel in the target buffer
  uint motion;                   // first link pose, in units of one pose (3 vec4 rows of camera_from_home)
};

// One active tile: a tile of a view that is blended and charged.
struct SplatTile {
  uint view, x, y, padding;      // x, y in tiles
};

struct SplatPush {
  uint gaussians, links, coefficients, views;
  uint live_capacity, instance_capacity, tiles, slots;
  float weight_l1, weight_dssim, weight_mask;  // already divided by what means are taken over
  uint near_tiles;                             // the first so many active tiles have a D-SSIM term
  uint scan_length, scan_per_live, scan_counter, flags;
  uint tile_stride;                            // group g of a pass over all active tiles takes tile g * tile_stride % tiles
  uint tile_capacity;                          // entries that each tile's list has room for, which project then fills; 0: the
                                               // lists lie side by side, found by prefix sums
  uint padding0, padding1;
};

const uint kNoTile = 0xffffffffu;
const uint kScanBlock = 1024u;      // elements one group scans
const uint kGroup = 64u;            // invocations of the passes that run one invocation an item

// counters[]: filled by scan_sums. The first kCounterKept stay as long as the Gaussians do.
const uint kCounterLive = 0u;       // live replicas R
const uint kCounterWantLive = 1u;   // what their capacity would have to be
const uint kCounterDispatch = 2u;   // 3 uints: groups of the passes over (replica, view); the host sets the last two
const uint kCounterKept = 3u;
const uint kCounterInstances = 5u;  // (view, replica, tile) triples
const uint kCounterTiles = 6u;      // the same sum, counted by tile
const uint kCounterWantInstances = 7u;
const uint kCounterOverflow = 8u;   // not 0: a capacity was exceeded; nothing of this batch may be used
const uint kCounterTooLong = 9u;    // not 0: a tile's list is longer than kLongestList
const uint kCounterLongTiles = 10u; // 3 uints: groups of splat_sort_long; the host sets the last two
const uint kCounterNotFinite = 13u; // gradients that Adam left alone
const uint kCounterWantTile = 14u;  // what the tile capacity would have to be
const uint kCounters = 16u;
const uint kLongestList = 32768u;   // entries of a tile that sorting and blending get through on every device

const uint kFlagAccumulate = 1u;    // gradients of this chunk of views are added to those before
const uint kFlagHeldLinks = 2u;     // the gradient by link logits is not asked for

// splat record: 3 vec4
//   0: u (px), opacity, depth (m)   1: conic xx, xy, yy, tile rectangle x0 | x1 << 16   2: color, rectangle y0 | y1 << 16
const uint kSplatRows = 3u;
const uint kTileHits = 32u;         // tiles of the rectangle, row by row, of which a bit says whether the splat touches them;
                                    // those behind them count as touched
// gradient record of one (replica, view): 6 vec4
//   0: mean (home), opacity   1: rotation   2: log scale   3: color   4: link moment   5: link force (camera frame)
const uint kGradientRows = 6u;
// partial gradient of one (instance, subgroup): 3 vec4
//   0: u, opacity, red   1: H'xx, H'xy, H'yy (of dL/dSigma' without the 1/2), green   2: blue, -, -, -
const uint kPartialRows = 3u;

#ifdef __cplusplus
static_assert(sizeof(SplatView) == 80 && sizeof(SplatTile) == 16 && sizeof(SplatPush) == 80);
}  // namespace chainsplat::shared
#endif
