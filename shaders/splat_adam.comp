// splat_adam.comp - one invocation per four parameters: Adam (Kingma & Ba 2015). After an overflow it does nothing. A
// gradient that is not finite is counted, and its parameter and moments stay as they are.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/splat.h"
#include "shared/adam.h"
#include "shared/gaussian.h"
layout(local_size_x = 64) in;
layout(push_constant) uniform Push { AdamPush p; };
layout(std430) buffer Parameters { vec4 parameters[]; };
layout(std430) readonly buffer Gradient { vec4 gradient[]; };
layout(std430) buffer FirstMoment { vec4 first_moment[]; };
layout(std430) buffer SecondMoment { vec4 second_moment[]; };
layout(std430) buffer Counters { uint counters[]; };

float rate_of(uint i) {
  uint n = p.gaussians, c = p.coefficients, sh = at_sh(n, c, 0u);
  return i < at_rotation(n, 0u) ? p.mean : i < at_log_scale(n, 0u) ? p.rotation : i < at_opacity(n, 0u) ? p.log_scale
         : i < sh ? p.opacity : i < at_link(n, c, p.links, 0u) ? ((i - sh) % (3u * c) < 3u ? p.sh0 : p.sh_rest)
         : p.link_logits;
}

void main() {
  uint four = gl_GlobalInvocationID.x + gl_GlobalInvocationID.y * gl_NumWorkGroups.x * gl_WorkGroupSize.x, i = 4u * four;
  if (i >= p.total || counters[kCounterOverflow] != 0u) return;
  vec4 g = gradient[four], old_m = first_moment[four], old_s = second_moment[four];
  bvec4 bad = bvec4(uvec4(isnan(g)) | uvec4(isinf(g))), there = lessThan(uvec4(i, i + 1u, i + 2u, i + 3u), uvec4(p.total));
  vec4 m = p.beta1 * old_m + (1.0 - p.beta1) * g, s = p.beta2 * old_s + (1.0 - p.beta2) * g * g;
  vec4 rate = vec4(rate_of(i), rate_of(i + 1u), rate_of(i + 2u), rate_of(i + 3u));
  vec4 step = rate * m * p.correction1 / (sqrt(s * p.correction2) + p.epsilon);
  first_moment[four] = mix(m, old_m, bad);
  second_moment[four] = mix(s, old_s, bad);
  parameters[four] -= mix(step, vec4(0.0), bad);
  uvec4 counted = uvec4(bad) * uvec4(there);
  uint count = counted.x + counted.y + counted.z + counted.w;
  if (count > 0u) atomicAdd(counters[kCounterNotFinite], count);
}
