// subgroup_sum.glsl - sums over the lanes of a subgroup in a fixed order, so that the bits never vary. Needs kSubgroup
// (number of lanes, a power of two, at most 128), GL_KHR_shader_subgroup_shuffle.

// Every lane gets the sum, with the same bits. There is no loop, because lavapipe silently ends the loops of an
// invocation after 65535 iterations in all.
float subgroup_sum(float x) {
  if (kSubgroup > 64u) x += subgroupShuffleXor(x, 64u);
  if (kSubgroup > 32u) x += subgroupShuffleXor(x, 32u);
  if (kSubgroup > 16u) x += subgroupShuffleXor(x, 16u);
  if (kSubgroup > 8u) x += subgroupShuffleXor(x, 8u);
  if (kSubgroup > 4u) x += subgroupShuffleXor(x, 4u);
  if (kSubgroup > 2u) x += subgroupShuffleXor(x, 2u);
  if (kSubgroup > 1u) x += subgroupShuffleXor(x, 1u);
  return x;
}

// Sums eight values over a subgroup of at least eight lanes; lane l gets the sum of value l % 8. Each of the first
// exchanges halves the number of values that a lane holds, so that eight lanes need 7 exchanges instead of 24.
float subgroup_sums(float v[8]) {
  uint lane = gl_SubgroupInvocationID;
  bool upper = (lane & 4u) != 0u;
  float four[4], two[2];
  [[unroll]] for (uint k = 0u; k < 4u; ++k)
    four[k] = (upper ? v[k + 4u] : v[k]) + subgroupShuffleXor(upper ? v[k] : v[k + 4u], 4u);
  upper = (lane & 2u) != 0u;
  [[unroll]] for (uint k = 0u; k < 2u; ++k)
    two[k] = (upper ? four[k + 2u] : four[k]) + subgroupShuffleXor(upper ? four[k] : four[k + 2u], 2u);
  upper = (lane & 1u) != 0u;
  float one = (upper ? two[1] : two[0]) + subgroupShuffleXor(upper ? two[0] : two[1], 1u);
  if (kSubgroup > 8u) one += subgroupShuffleXor(one, 8u);
  if (kSubgroup > 16u) one += subgroupShuffleXor(one, 16u);
  if (kSubgroup > 32u) one += subgroupShuffleXor(one, 32u);
  if (kSubgroup > 64u) one += subgroupShuffleXor(one, 64u);
  return one;
}
