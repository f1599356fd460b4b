// ssim.glsl - the separable window of SSIM (mathematics.md 2.7) and the addressing that its four passes share. A lane
// filters a strip of kPixels pixels, so that one load serves all of them. Between the passes values are stored tile by
// tile; tiles without a D-SSIM term count as zero. Needs splat.h, Push p, tile_map[], kTileWidth, kTileHeight.
#include "chainsplat/image_model.h"

float window(int offset) {  // a switch, because a table indexed by a variable becomes loads from memory
  switch (abs(offset)) {
    case 0: return kSsimWindow[0];
    case 1: return kSsimWindow[1];
    case 2: return kSsimWindow[2];
    case 3: return kSsimWindow[3];
    case 4: return kSsimWindow[4];
    case 5: return kSsimWindow[5];
    default: return 0.0;
  }
}

// The active tile at a cell of the view's grid, or kNoTile.
uint active_tile(SplatView view, int x, int y) {
  if (x < 0 || y < 0 || x >= int(view.tiles_x) || y >= int(view.tiles_y)) return kNoTile;
  return tile_map[view.tile_map + uint(y) * view.tiles_x + uint(x)];
}

// The same, but only a tile with a D-SSIM term.
uint ssim_tile(SplatView view, int x, int y) {
  uint tile = active_tile(view, x, y);
  return tile < p.near_tiles ? tile : kNoTile;
}

// Index of a tile's pixel in the buffers between the passes.
uint ssim_place(uint tile, uint column, uint row) { return tile * kTileWidth * kTileHeight + row * kTileWidth + column; }
