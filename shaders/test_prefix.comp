// test_prefix.comp - one work group: inclusive prefix sums of `count` elements, with shuffles inside each subgroup and
// shared memory between them, for any subgroup size. size[0] returns gl_SubgroupSize.
#version 460
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_shuffle : require
layout(local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint count; };
layout(std430) readonly buffer Values { uint values[]; };
layout(std430) writeonly buffer Prefix { uint prefix[]; };
layout(std430) writeonly buffer Size { uint size[]; };

shared uint subgroup_total[gl_WorkGroupSize.x];  // enough even for subgroups of one lane
shared uint block_total;

void main() {
  uint lane = gl_LocalInvocationID.x;
  if (lane == 0u) size[0] = gl_SubgroupSize;
  uint carry = 0u;
  for (uint first = 0u; first < count; first += gl_WorkGroupSize.x) {
    uint i = first + lane;
    uint sum = i < count ? values[i] : 0u;
    for (uint d = 1u; d < gl_SubgroupSize; d *= 2u) {
      uint before = subgroupShuffle(sum, gl_SubgroupInvocationID - min(d, gl_SubgroupInvocationID));
      if (gl_SubgroupInvocationID >= d) sum += before;
    }
    if (gl_SubgroupInvocationID == gl_SubgroupSize - 1u) subgroup_total[gl_SubgroupID] = sum;
    barrier();
    for (uint s = 0u; s < gl_SubgroupID; ++s) sum += subgroup_total[s];
    if (lane == gl_WorkGroupSize.x - 1u) block_total = sum;
    barrier();
    if (i < count) prefix[i] = carry + sum;
    carry += block_total;
    barrier();  // the next block overwrites the totals
  }
}
