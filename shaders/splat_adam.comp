// splat_adam.comp - one invocation a parameter: Adam (Kingma & Ba 2015). Nothing happens after an overflow, and a gradient
// that is not finite leaves its parameter and moments alone and is counted.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/splat.h"
#include "shared/adam.h"
layout(local_size_x = 64) in;
layout(push_constant) uniform Push { AdamPush p; };
layout(std430, binding = 0) buffer Parameters { float parameters[]; };
layout(std430, binding = 1) readonly buffer Gradient { float gradient[]; };
layout(std430, binding = 2) buffer First { float first_moment[]; };
layout(std430, binding = 3) buffer Second { float second_moment[]; };
layout(std430, binding = 4) buffer Counters { uint counters[]; };

void main() {
  uint i = gl_GlobalInvocationID.x + gl_GlobalInvocationID.y * gl_NumWorkGroups.x * gl_WorkGroupSize.x;
  if (i >= p.total || counters[kCounterOverflow] != 0u) return;
  float g = gradient[i];
  if (isnan(g) || isinf(g)) {
    atomicAdd(counters[kCounterNotFinite], 1u);
    return;
  }
  uint n = p.gaussians, row = 3u * p.coefficients;
  float rate = i < 3u * n ? p.mean : i < 7u * n ? p.rotation : i < 10u * n ? p.log_scale : i < 11u * n ? p.opacity
               : i < (11u + row) * n ? ((i - 11u * n) % row < 3u ? p.sh0 : p.sh_rest) : p.link_logits;
  float m = p.beta1 * first_moment[i] + (1.0 - p.beta1) * g;
  float s = p.beta2 * second_moment[i] + (1.0 - p.beta2) * g * g;
  first_moment[i] = m;
  second_moment[i] = s;
  parameters[i] -= rate * m * p.correction1 / (sqrt(s * p.correction2) + p.epsilon);
}
