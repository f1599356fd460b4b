// splat_gather.comp - one invocation per Gaussian: sums the gradient records of its live replicas over the views of the
// chunk, in a fixed order, and completes the chain rule to opacity logit, link logits and SH coefficients
// (mathematics.md 2.8).
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#include "shared/splat.h"
#include "inc/gaussian.glsl"
layout(local_size_x = 64) in;
layout(constant_id = 0) const uint kAccumulate = 1u;  // 1: adds to the gradient of the chunks before
layout(push_constant) uniform Push { SplatPush p; };
layout(std430) readonly buffer Parameters { float parameters[]; };
layout(std430) readonly buffer ReplicaShare { float replica_share[]; };
layout(std430) readonly buffer LiveFlag { uint live_flag[]; };
layout(std430) readonly buffer LivePrefix { uint live_prefix[]; };
layout(std430) readonly buffer LiveBlock { uint live_block[]; };
layout(std430) readonly buffer Counters { uint counters[]; };
layout(std430) readonly buffer Records { vec4 records[]; };
layout(std430) buffer Gradient { float gradient[]; };
layout(std430) buffer ReplicaGradient { float replica_gradient[]; };  // d/d(opacity of the replica)

void put(uint at, float value) {
  gradient[at] = kAccumulate != 0u ? gradient[at] + value : value;
}

void main() {
  uint i = gl_GlobalInvocationID.x, n = p.gaussians;
  if (i >= n) return;
  uint live_count = counters[kCounterLive];
  uint sh = at_sh(n, p.coefficients, i);
  vec3 grad_mean = vec3(0.0), grad_scale = vec3(0.0), grad_dc = vec3(0.0);
  vec4 grad_rotation = vec4(0.0);
  // SH of degree 1 in registers, of higher ones in place
  vec3 grad_linear[kLinear];
  [[unroll]] for (uint l = 1u; l < kLinear; ++l) grad_linear[l] = vec3(0.0);
  if (kAccumulate == 0u) {
    for (uint l = 3u * kLinear; l < 3u * p.coefficients; ++l) gradient[sh + l] = 0.0;
  }
  float opacity = opacity_of(parameters[at_opacity(n, i)]);
  float mean_gradient = 0.0;  // sum over links of rho_j d/d(sigma rho_j)
  bool held_links = (p.flags & kFlagHeldLinks) != 0u;

  // sum over replicas and views; the loop jumps from one live replica to the next, because most Gaussians have one and
  // a software device executes the body of a branch even if no lane takes it
  for (uint j = 0u;; ++j) {
    while (j < p.links && live_flag[j * n + i] == 0u) {
      if (!held_links) replica_gradient[j * n + i] = 0.0;
      ++j;
    }
    if (j >= p.links) break;
    uint e = j * n + i, r = live_prefix[e] + live_block[e / kScanBlock];
    float grad_opacity = 0.0;
    for (uint v = 0u; v < (r < live_count ? p.views : 0u); ++v) {
      uint record = kGradientRows * (v * live_count + r);
      vec4 a = records[record], b = records[record + 2u], c = records[record + 3u];
      grad_mean += a.xyz;
      grad_opacity += a.w;
      grad_rotation += records[record + 1u];
      grad_scale += b.xyz;
      grad_dc += c.xyz;
      if (p.coefficients > 1u) {
        vec3 direction = unpacked(vec2(b.w, c.w));
        [[unroll]] for (uint l = 1u; l < kLinear; ++l) grad_linear[l] += sh_basis(l, direction) * c.xyz;
        for (uint l = kLinear; l < p.coefficients; ++l) {
          vec3 g = sh_basis(l, direction) * c.xyz;
          gradient[sh + 3u * l] += g.x;
          gradient[sh + 3u * l + 1u] += g.y;
          gradient[sh + 3u * l + 2u] += g.z;
        }
      }
    }
    mean_gradient += replica_share[e] * grad_opacity;
    if (!held_links) replica_gradient[e] = grad_opacity;
  }

  // write the gradient by section
  for (uint k = 0u; k < 3u; ++k) {
    put(at_mean(n, i) + k, grad_mean[k]);
    put(at_log_scale(n, i) + k, grad_scale[k]);
    put(sh + k, sh_basis(0u, vec3(0.0)) * grad_dc[k]);
    if (p.coefficients > 1u) {
      [[unroll]] for (uint l = 1u; l < kLinear; ++l) put(sh + 3u * l + k, grad_linear[l][k]);
    }
  }
  for (uint k = 0u; k < 4u; ++k) put(at_rotation(n, i) + k, grad_rotation[k]);
  // the replica's opacity is sigma rho_j: with w_j = d/d(sigma rho_j) this gives d/dsigma = sum rho_j w_j and
  // d/dlambda_j = sigma rho_j (w_j - sum rho_j w_j)
  put(at_opacity(n, i), opacity * (1.0 - opacity) * mean_gradient);
  if (held_links) return;
  uint logits = at_link(n, p.coefficients, p.links, i);
  for (uint j = 0u; j < p.links; ++j) {
    put(logits + j, opacity * replica_share[j * n + i] * (replica_gradient[j * n + i] - mean_gradient));
  }
}
