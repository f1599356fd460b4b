// splat_link_twist.comp - one work group per (link, view): the gradient by the link's twist, summed over its live
// replicas in a fixed order.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/splat.h"
layout(local_size_x = 64) in;
layout(push_constant) uniform Push { SplatPush p; };
layout(std430) readonly buffer LivePrefix { uint live_prefix[]; };
layout(std430) readonly buffer LiveBlock { uint live_block[]; };
layout(std430) readonly buffer Counters { uint counters[]; };
layout(std430) readonly buffer Records { vec4 records[]; };
layout(std430) writeonly buffer LinkTwists { vec4 link_twists[]; };  // per (view, link): moment, force

shared vec4 moments[64];
shared vec4 forces[64];

void main() {
  uint link = gl_WorkGroupID.x, v = gl_WorkGroupID.y, lane = gl_LocalInvocationID.x;
  uint live_count = counters[kCounterLive];
  uint e = link * p.gaussians;
  uint first = min(live_prefix[e] + live_block[e / kScanBlock], live_count);
  uint last = live_count;
  if (link + 1u < p.links) {
    e += p.gaussians;
    last = min(live_prefix[e] + live_block[e / kScanBlock], live_count);
  }
  vec4 moment = vec4(0.0), force = vec4(0.0);
  for (uint r = first + lane; r < last; r += 64u) {
    moment += records[kGradientRows * (v * live_count + r) + 4u];
    force += records[kGradientRows * (v * live_count + r) + 5u];
  }
  moments[lane] = moment;
  forces[lane] = force;
  barrier();
  if (lane == 0u) {
    for (uint k = 1u; k < 64u; ++k) {
      moment += moments[k];
      force += forces[k];
    }
    link_twists[2u * (v * p.links + link)] = moment;
    link_twists[2u * (v * p.links + link) + 1u] = force;
  }
}
