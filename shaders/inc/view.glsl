// view.glsl - loads the view that all lanes of a subgroup work for: kShare of them load rows of it and exchange them.
// Needs SplatView, views[] as vec4, share.glsl, GL_EXT_control_flow_attributes, GL_KHR_shader_subgroup_basic.

SplatView view_at(uint v) {
  const uint kEach = (kViewRows + kShare - 1u) / kShare;  // rows that a lane loads
  vec4 own[kEach], row[kViewRows];
  uint lane = gl_SubgroupInvocationID % kShare;
  [[unroll]] for (uint k = 0u; k < kEach; ++k) own[k] = views[kViewRows * v + min(k * kShare + lane, kViewRows - 1u)];
  [[unroll]] for (uint k = 0u; k < kViewRows; ++k) row[k] = shared_by(own[k / kShare], k % kShare);
  uvec4 size = floatBitsToUint(row[9]), first = floatBitsToUint(row[10]);
  return SplatView(row[0], row[1], row[2], row[3], row[4], row[5], row[6], row[7], row[8], size.x, size.y, size.z,
                   size.w, first.x, first.y, first.z, first.w);
}
