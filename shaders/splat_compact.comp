// splat_compact.comp - one invocation per replica: writes the live ones to live[], in their order.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/splat.h"
layout(local_size_x = 64) in;
layout(push_constant) uniform Push { SplatPush p; };
layout(std430) readonly buffer LiveFlag { uint live_flag[]; };
layout(std430) readonly buffer LivePrefix { uint live_prefix[]; };
layout(std430) readonly buffer LiveBlock { uint live_block[]; };
layout(std430) writeonly buffer Live { uint live[]; };

void main() {
  uint e = gl_GlobalInvocationID.x + gl_GlobalInvocationID.y * gl_NumWorkGroups.x * gl_WorkGroupSize.x;
  if (e >= p.gaussians * p.links || live_flag[e] == 0u) return;
  uint r = live_prefix[e] + live_block[e / kScanBlock];
  if (r < p.live_capacity) live[r] = e;
}
