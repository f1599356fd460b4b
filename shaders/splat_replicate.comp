// splat_replicate.comp - one invocation per Gaussian: the opacity of each of its replicas, which is its own times the
// link probability (mathematics.md 2.4), and whether that replica can be visible at all (live). The order is
// link-major, so that a link's live replicas are contiguous.
// reads parameters; writes replica_opacity[link * gaussians + i], live_flag[link * gaussians + i].
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/splat.h"
#include "inc/gaussian.glsl"
layout(local_size_x = 64) in;
layout(constant_id = 0) const uint kCutoffs = 1u;  // 0: every replica is live (finite-difference tests)
layout(push_constant) uniform Push { SplatPush p; };
layout(std430) readonly buffer Parameters { float parameters[]; };
layout(std430) writeonly buffer ReplicaOpacity { float replica_opacity[]; };
layout(std430) writeonly buffer LiveFlag { uint live_flag[]; };

void main() {
  uint i = gl_GlobalInvocationID.x;
  if (i >= p.gaussians) return;
  float opacity = 1.0 / (1.0 + exp(-parameters[at_opacity(p.gaussians, i)]));
  uint logits = at_link(p.gaussians, p.coefficients, p.links, i);
  float largest = parameters[logits];
  for (uint j = 1u; j < p.links; ++j) largest = max(largest, parameters[logits + j]);
  float sum = 0.0;
  for (uint j = 0u; j < p.links; ++j) sum += exp(parameters[logits + j] - largest);
  float least = kCutoffs != 0u ? kLeastAlpha : 0.0;
  for (uint j = 0u; j < p.links; ++j) {
    float value = opacity * exp(parameters[logits + j] - largest) / sum;
    replica_opacity[j * p.gaussians + i] = value;
    live_flag[j * p.gaussians + i] = value > least ? 1u : 0u;
  }
}
