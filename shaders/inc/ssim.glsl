// ssim.glsl - the separable 11-tap window of SSIM (mathematics.md 2.7): Gaussian, sigma 1.5, weights normalized to sum
// 1; and the addressing that its four passes share. A lane filters a strip of kPixels pixels, so that one load serves
// all of them. Between the passes values are stored tile by tile; tiles without a D-SSIM term count as zero.
// Needs splat.h, Push p, tile_map[], kTileWidth, kTileHeight.
const int kReach = 5;
float window(int offset) {
  switch (abs(offset)) {
    case 0: return 0.266011725;
    case 1: return 0.213005538;
    case 2: return 0.10936069;
    case 3: return 0.0360007721;
    case 4: return 0.00759875814;
    case 5: return 0.00102838008;
    default: return 0.0;
  }
}
const float kC1 = 0.01 * 0.01, kC2 = 0.03 * 0.03;

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
