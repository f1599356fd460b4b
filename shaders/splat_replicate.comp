// splat_replicate.comp - one invocation per Gaussian: the share of each of its replicas, which is the link probability
// (mathematics.md 2.4), and whether that replica can be visible at all (live): whether its opacity, the Gaussian's times
// its share, can be drawn, and where links are held, so that this pass need not run again after every step, whether any
// opacity could. The order is link-major, so that a link's live replicas are contiguous.
// reads parameters; writes replica_share[link * gaussians + i], live_flag[link * gaussians + i].
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/splat.h"
#include "inc/gaussian.glsl"
layout(local_size_x = 64) in;
layout(constant_id = 0) const uint kCutoffs = 1u;  // 0: every replica is live (finite-difference tests)
layout(push_constant) uniform Push { SplatPush p; };
layout(std430) readonly buffer Parameters { float parameters[]; };
layout(std430) writeonly buffer ReplicaShare { float replica_share[]; };
layout(std430) writeonly buffer LiveFlag { uint live_flag[]; };

void main() {
  uint i = gl_GlobalInvocationID.x;
  if (i >= p.gaussians) return;
  bool held_links = (p.flags & kFlagHeldLinks) != 0u;
  float opacity = held_links ? 1.0 : opacity_of(parameters[at_opacity(p.gaussians, i)]);
  uint logits = at_link(p.gaussians, p.coefficients, p.links, i);
  float largest = parameters[logits];
  for (uint j = 1u; j < p.links; ++j) largest = max(largest, parameters[logits + j]);
  float sum = 0.0;
  for (uint j = 0u; j < p.links; ++j) sum += exp(parameters[logits + j] - largest);
  float least = kCutoffs != 0u ? kLeastAlpha : 0.0;
  for (uint j = 0u; j < p.links; ++j) {
    float share = exp(parameters[logits + j] - largest) / sum;
    replica_share[j * p.gaussians + i] = share;
    live_flag[j * p.gaussians + i] = opacity * share > least ? 1u : 0u;
  }
}
