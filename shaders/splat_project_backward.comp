// splat_project_backward.comp - one invocation per (live replica, view): sums the partial gradients of its instances in
// their order and propagates them through the projection (mathematics.md 2.8) to the Gaussian's parameters and to the
// link's twist. The link's moment is about the view's moment point, in the camera frame; the host transforms it to the
// world frame.
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_shuffle : require
#include "shared/splat.h"
#include "inc/gaussian.glsl"
layout(local_size_x = 64) in;
layout(constant_id = 0) const uint kShare = 1u;  // as in splat_blend.comp
layout(push_constant) uniform Push { SplatPush p; };
layout(std430) readonly buffer Parameters { float parameters[]; };
layout(std430) readonly buffer Live { uint live[]; };
layout(std430) readonly buffer Views { vec4 views[]; };
layout(std430) readonly buffer Motions { vec4 motions[]; };
layout(std430) readonly buffer Counters { uint counters[]; };
layout(std430) readonly buffer Splats { vec4 splats[]; };
layout(std430) readonly buffer InstanceCount { uint instance_count[]; };
layout(std430) readonly buffer InstancePrefix { uint instance_prefix[]; };
layout(std430) readonly buffer InstanceBlock { uint instance_block[]; };
layout(std430) readonly buffer InstancePlace { uint instance_place[]; };
layout(std430) readonly buffer Partials { float partials[]; };
layout(std430) writeonly buffer Records { vec4 records[]; };

#include "inc/project.glsl"
#include "inc/share.glsl"
#include "inc/view.glsl"

void main() {
  uint r = gl_GlobalInvocationID.x, v = gl_WorkGroupID.y;
  SplatView view = view_at(v);  // here, where all lanes are still active
  uint live_count = counters[kCounterLive];
  if (r >= live_count) return;
  uint s = v * live_count + r;
  uint record = kGradientRows * s;
  uint count = counters[kCounterOverflow] != 0u ? 0u : instance_count[s];
  vec4 sum0 = vec4(0.0), sum1 = vec4(0.0);
  float blue = 0.0;
  uint first = p.tile_capacity > 0u ? s * p.splat_capacity : instance_prefix[s] + instance_block[s / kScanBlock];
  for (uint k = 0u; k < count; ++k) {
    uint partial = kPartial * p.slots * instance_place[first + k];
    for (uint slot = 0u; slot < p.slots; ++slot) {
      sum0 += vec4(partials[partial], partials[partial + 1u], partials[partial + 2u], partials[partial + 3u]);
      sum1 += vec4(partials[partial + 4u], partials[partial + 5u], partials[partial + 6u], partials[partial + 7u]);
      blue += partials[partial + 8u];
      partial += kPartial;
    }
  }
  if (count == 0u) {
    for (uint k = 0u; k < kGradientRows; ++k) records[record + k] = vec4(0.0);
    return;
  }
  uint e = live[r], n = p.gaussians, i = e % n, link = e / n;
  Projection a = project(view, n, i, link);

  // color: no gradient where the camera cuts it off
  vec3 splat_color = splats[kSplatRows * s + 2u].xyz;
  vec3 grad_lit = vec3(sum0.w, sum1.w, blue) * view.gain.xyz * vec3(greaterThan(splat_color, vec3(0.0))) *
                  vec3(lessThan(splat_color, vec3(view.gain.w)));
  // in the light of the side that it is on, which changes where the Gaussian goes around the rope and as the link turns
  Side side = side_of(view, a.mean, a.link);
  vec3 grad_color = grad_lit * side.brightness;
  vec3 unlit = (splat_color - view.bias.xyz) / (view.gain.xyz * side.brightness);
  vec3 grad_normal = side.slope * dot(grad_lit, unlit);
  // Sigma' = T T^T, T = J M
  vec3 h = 0.5 * sum1.xyz;  // dL/dSigma': xx, xy, yy
  vec3 grad_t0 = 2.0 * (h.x * a.t0 + h.y * a.t1);
  vec3 grad_t1 = 2.0 * (h.y * a.t0 + h.z * a.t1);
  mat3 grad_m = outerProduct(a.j0, grad_t0) + outerProduct(a.j1, grad_t1);
  vec3 grad_j0 = a.m * grad_t0, grad_j1 = a.m * grad_t1;
  // position in the camera frame
  float inverse_z = 1.0 / a.x.z, fx = view.intrinsics.x * inverse_z, fy = view.intrinsics.y * inverse_z;
  vec3 grad_x = vec3(fx * sum0.x, fy * sum0.y, -(fx * a.x.x * sum0.x + fy * a.x.y * sum0.y) * inverse_z);
  grad_x.z -= inverse_z * (fx * grad_j0.x + fy * grad_j1.y);
  grad_x.x -= a.clamped.x ? 0.0 : fx * inverse_z * grad_j0.z;
  grad_x.y -= a.clamped.y ? 0.0 : fy * inverse_z * grad_j1.z;
  grad_x.z -= inverse_z * ((a.clamped.x ? 1.0 : 2.0) * a.j0.z * grad_j0.z + (a.clamped.y ? 1.0 : 2.0) * a.j1.z * grad_j1.z);
  grad_x.z -= 2.0 * inverse_z * dot(h.xz, a.low_pass * vec2(a.by_depth));
  // view direction of the spherical harmonics: by position, and as the link turns
  vec3 turn = vec3(0.0);
  vec2 packed_direction = vec2(0.0);
  if (p.coefficients > 1u) {
    float distance = length(a.x);
    vec3 camera_direction = a.x / distance;
    vec3 direction = camera_direction * a.link;
    packed_direction = packed(direction);
    vec3 grad_direction = vec3(0.0);
    uint sh = at_sh(n, p.coefficients, i);
    for (uint l = 1u; l < p.coefficients; ++l)
      grad_direction += dot(coefficient(sh, l), grad_color) * sh_basis_gradient(l, direction);
    vec3 grad_camera_direction = a.link * grad_direction;
    grad_x += (grad_camera_direction - camera_direction * dot(camera_direction, grad_camera_direction)) / distance;
    turn = -cross(camera_direction, grad_camera_direction);
  }
  // scale and rotation; then the moment that the position and the covariance exert on the link
  vec3 grad_scale = vec3(dot(a.local[0], grad_m[0]), dot(a.local[1], grad_m[1]), dot(a.local[2], grad_m[2])) * a.scale;
  mat3 grad_r = transpose(a.link) * mat3(grad_m[0] * a.scale.x, grad_m[1] * a.scale.y, grad_m[2] * a.scale.z);
  records[record] = vec4((grad_x + side.around * (dot(side.around, grad_normal) / side.radius)) * a.link, sum0.z);
  records[record + 1u] = rotation_matrix_backward(a.q, a.q_size, grad_r);
  records[record + 2u] = vec4(grad_scale, packed_direction.x);
  records[record + 3u] = vec4(grad_color, packed_direction.y);
  vec3 moment = cross(a.x - view.moment_point.xyz, grad_x) + turn + cross(a.m[0], grad_m[0]) +
                cross(a.m[1], grad_m[1]) + cross(a.m[2], grad_m[2]) + cross(side.normal, grad_normal);
  records[record + 4u] = vec4(moment, 0.0);
  records[record + 5u] = vec4(grad_x, 0.0);
}
