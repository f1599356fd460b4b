// gaussian.glsl - small functions of a Gaussian's parameters.
#include "shared/gaussian.h"

const uint kLinear = 4u;  // SH basis functions up to degree 1

float opacity_of(float logit) { return 1.0 / (1.0 + exp(-logit)); }

// A direction as two numbers, and back: the octahedron's faces laid into a square (Cigolle et al. 2014).
vec2 signs_of(vec2 x) { return vec2(x.x < 0.0 ? -1.0 : 1.0, x.y < 0.0 ? -1.0 : 1.0); }
vec2 packed(vec3 direction) {
  vec3 p = direction / (abs(direction.x) + abs(direction.y) + abs(direction.z));
  return p.z < 0.0 ? (1.0 - abs(p.yx)) * signs_of(p.xy) : p.xy;
}
vec3 unpacked(vec2 p) {
  float z = 1.0 - abs(p.x) - abs(p.y);
  return normalize(vec3(z < 0.0 ? (1.0 - abs(p.yx)) * signs_of(p) : p, z));
}

// Rotation matrix of a unit quaternion q = (w, x, y, z).
mat3 rotation_matrix(vec4 q) {
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),   // first column
              2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
              2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

// d/dq of sum_ij G_ij R(q/|q|)_ij; `columns` holds G by columns, `q` is the unit quaternion, `size` = |q| before
// normalization.
vec4 rotation_matrix_backward(vec4 q, float size, mat3 columns) {
  float w = q.x, x = q.y, y = q.z, z = q.w;
  float g00 = columns[0][0], g10 = columns[0][1], g20 = columns[0][2];
  float g01 = columns[1][0], g11 = columns[1][1], g21 = columns[1][2];
  float g02 = columns[2][0], g12 = columns[2][1], g22 = columns[2][2];
  vec4 d = 2.0 * vec4(z * (g10 - g01) + y * (g02 - g20) + x * (g21 - g12),
                      y * (g01 + g10) + z * (g02 + g20) + w * (g21 - g12) - 2.0 * x * (g11 + g22),
                      x * (g01 + g10) + z * (g12 + g21) + w * (g02 - g20) - 2.0 * y * (g00 + g22),
                      x * (g02 + g20) + y * (g12 + g21) + w * (g10 - g01) - 2.0 * z * (g00 + g11));
  return (d - q * dot(q, d)) / size;
}

// Gradient of sh_basis() by the direction.
vec3 sh_basis_gradient(uint l, vec3 r) {
  float x = r.x, y = r.y, z = r.z;
  switch (l) {
    case 0u: return vec3(0.0);
    case 1u: return vec3(0.0, -0.4886025119029199, 0.0);
    case 2u: return vec3(0.0, 0.0, 0.4886025119029199);
    case 3u: return vec3(-0.4886025119029199, 0.0, 0.0);
    case 4u: return 1.0925484305920792 * vec3(y, x, 0.0);
    case 5u: return -1.0925484305920792 * vec3(0.0, z, y);
    case 6u: return 0.31539156525252005 * vec3(-2.0 * x, -2.0 * y, 4.0 * z);
    case 7u: return -1.0925484305920792 * vec3(z, 0.0, x);
    case 8u: return 0.5462742152960396 * vec3(2.0 * x, -2.0 * y, 0.0);
    case 9u: return -0.5900435899266435 * vec3(6.0 * x * y, 3.0 * x * x - 3.0 * y * y, 0.0);
    case 10u: return 2.890611442640554 * vec3(y * z, x * z, x * y);
    case 11u: return -0.4570457994644658 * vec3(-2.0 * x * y, 4.0 * z * z - x * x - 3.0 * y * y, 8.0 * y * z);
    case 12u: return 0.3731763325901154 * vec3(-6.0 * x * z, -6.0 * y * z, 6.0 * z * z - 3.0 * x * x - 3.0 * y * y);
    case 13u: return -0.4570457994644658 * vec3(4.0 * z * z - 3.0 * x * x - y * y, -2.0 * x * y, 8.0 * x * z);
    case 14u: return 1.445305721320277 * vec3(2.0 * x * z, -2.0 * y * z, x * x - y * y);
    default: return -0.5900435899266435 * vec3(3.0 * x * x - 3.0 * y * y, -6.0 * x * y, 0.0);
  }
}
