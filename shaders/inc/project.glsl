// project.glsl - the projection of one replica into one view (mathematics.md 2.5), shared by the forward and the
// backward pass so that both agree. Needs SplatView, inc/gaussian.glsl, parameters[], motions[].

#include "chainsplat/image_model.h"

const float kLeastRadius = 1e-5;  // m; what lies nearer to the axis has no side

struct Projection {
  vec3 mean;         // home frame, m
  vec3 x;            // camera frame, m
  mat3 link;         // rotation of camera_from_home
  vec4 q;            // unit quaternion
  float q_size;
  mat3 local;        // link * R(q): columns are the ellipsoid's axes in the camera frame
  vec3 scale;        // m
  mat3 m;            // local * diag(scale)
  vec3 j0, j1;       // rows of the projection's Jacobian
  bvec2 clamped;
  vec3 t0, t1;       // rows of J m
  vec2 low_pass;     // px^2, along x and y,
  bvec2 by_depth;    // and whether it depends on the depth
  vec3 cov;          // xx, xy, yy of Sigma', px^2
};

// SH coefficient l, RGB, of those that begin at parameter `sh`.
vec3 coefficient(uint sh, uint l) {
  return vec3(parameters[sh + 3u * l], parameters[sh + 3u * l + 1u], parameters[sh + 3u * l + 2u]);
}

// The side of the rope that a Gaussian is on, and the light there (mathematics.md 2.4).
struct Side {
  vec3 normal;      // from the rope's axis to the Gaussian, camera frame
  float radius;     // m from the axis
  float brightness;
  vec3 around;      // unit; the way in which the normal turns as the Gaussian goes around the rope
  vec3 slope;       // of the brightness by the normal; 0 where it is cut
};

Side side_of(SplatView view, vec3 mean, mat3 link) {
  Side side = Side(vec3(0.0), 1.0, 1.0, vec3(0.0), vec3(0.0));
  if (view.axis.w == 0.0) return side;
  vec3 off = mean - dot(mean, view.axis.xyz) * view.axis.xyz;
  side.radius = max(length(off), kLeastRadius);
  side.normal = link * off / side.radius;
  vec3 p = view.light_products.xyz;
  vec3 half_slope = mat3(view.light_squares.x, p.x, p.y, p.x, view.light_squares.y, p.z, p.y, p.z,
                         view.light_squares.z) * side.normal;
  float uncut = view.light.w + dot(view.light.xyz + half_slope, side.normal);
  side.brightness = max(uncut, kLeastBrightness);
  side.around = cross(link * view.axis.xyz, side.normal);
  if (uncut > kLeastBrightness) side.slope = view.light.xyz + 2.0 * half_slope;
  return side;
}

// Gaussian i of n on a link.
Projection project(SplatView view, uint n, uint i, uint of_link) {
  uint motion = 3u * (view.motion + of_link), at = at_mean(n, i), aq = at_rotation(n, i), as = at_log_scale(n, i);
  vec4 row0 = motions[motion], row1 = motions[motion + 1u], row2 = motions[motion + 2u];
  vec3 mean = vec3(parameters[at], parameters[at + 1u], parameters[at + 2u]);
  vec4 rotation = vec4(parameters[aq], parameters[aq + 1u], parameters[aq + 2u], parameters[aq + 3u]);
  vec3 log_scale = vec3(parameters[as], parameters[as + 1u], parameters[as + 2u]);
  Projection a;
  a.mean = mean;
  a.link = transpose(mat3(row0.xyz, row1.xyz, row2.xyz));
  a.x = vec3(dot(row0.xyz, mean) + row0.w, dot(row1.xyz, mean) + row1.w, dot(row2.xyz, mean) + row2.w);
  a.q_size = length(rotation);
  a.q = rotation / a.q_size;
  a.local = a.link * rotation_matrix(a.q);
  a.scale = exp(log_scale);
  a.m = mat3(a.local[0] * a.scale.x, a.local[1] * a.scale.y, a.local[2] * a.scale.z);
  float inverse_z = 1.0 / a.x.z;
  vec2 slope = a.x.xy * inverse_z;
  vec2 limited = clamp(slope, -view.limits.xy, view.limits.xy);
  a.clamped = notEqual(slope, limited);
  a.j0 = vec3(view.intrinsics.x * inverse_z, 0.0, -view.intrinsics.x * limited.x * inverse_z);
  a.j1 = vec3(0.0, view.intrinsics.y * inverse_z, -view.intrinsics.y * limited.y * inverse_z);
  a.t0 = a.j0 * a.m;
  a.t1 = a.j1 * a.m;
  vec2 footprint = view.limits.z * inverse_z * view.intrinsics.xy;
  float least = view.limits.z > 0.0 ? kLeastFootprint : 1.0;
  a.by_depth = greaterThan(footprint, vec2(least));
  footprint = max(vec2(least), footprint);
  a.low_pass = kLowPass * footprint * footprint;
  a.cov = vec3(dot(a.t0, a.t0) + a.low_pass.x, dot(a.t0, a.t1), dot(a.t1, a.t1) + a.low_pass.y);
  return a;
}
