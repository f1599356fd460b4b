// group_tile.glsl - which tile a lane works for. A work group of `tiles` x `lanes` lanes works for so many tiles
// (TileLanes::tiles in src/splat/engine.h). Lanes are counted by subgroups, so that none has lanes of two tiles. Needs
// SplatPush p, GL_KHR_shader_subgroup_basic.

uint number_in_group() { return gl_SubgroupID * gl_SubgroupSize + gl_SubgroupInvocationID; }

// 0 to lanes - 1, among those of its tile.
uint lane_in_tile(uint lanes) { return number_in_group() % lanes; }

// kNoTile for what the last work group has too many.
uint tile_of_lane(uint lanes) {
  uint place = gl_WorkGroupID.x * (gl_WorkGroupSize.x / lanes) + number_in_group() / lanes;
  return place < p.tiles ? place * p.tile_stride % p.tiles : kNoTile;
}
