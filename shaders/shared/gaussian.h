// shaders/shared/gaussian.h - where the parameters of Gaussians stand in the device's buffer, and the spherical
// harmonics of their colors (mathematics.md 2.4); for C++ and GLSL.
#include "chainsplat/image_model.h"
#ifdef __cplusplus
#pragma once
#include <glm/glm.hpp>
namespace chainsplat::shared {
using image_model::kSh0;
using uint = unsigned;
using real = double;
using real3 = glm::dvec3;
#define FUNCTION inline
#else
#define real float
#define real3 vec3
#define FUNCTION
#endif

// First float of Gaussian i of n. The sections follow one another, each [Gaussian][component]: mean 3, rotation 4, log
// scale 3, opacity logit 1, SH 3 x coefficients (RGB of one after the other), link logits.
FUNCTION uint at_mean(uint, uint i) { return 3u * i; }
FUNCTION uint at_rotation(uint n, uint i) { return 3u * n + 4u * i; }
FUNCTION uint at_log_scale(uint n, uint i) { return 7u * n + 3u * i; }
FUNCTION uint at_opacity(uint n, uint i) { return 10u * n + i; }
FUNCTION uint at_sh(uint n, uint coefficients, uint i) { return 11u * n + 3u * coefficients * i; }
FUNCTION uint at_link(uint n, uint coefficients, uint links, uint i) {
  return (11u + 3u * coefficients) * n + links * i;
}

// Real spherical harmonics in the order and signs of 3DGS: basis function l of a unit direction.
FUNCTION real sh_basis(uint l, real3 r) {
  real x = r.x, y = r.y, z = r.z;
  switch (l) {
    case 0u: return kSh0;
    case 1u: return -0.4886025119029199 * y;
    case 2u: return 0.4886025119029199 * z;
    case 3u: return -0.4886025119029199 * x;
    case 4u: return 1.0925484305920792 * x * y;
    case 5u: return -1.0925484305920792 * y * z;
    case 6u: return 0.31539156525252005 * (2.0 * z * z - x * x - y * y);
    case 7u: return -1.0925484305920792 * x * z;
    case 8u: return 0.5462742152960396 * (x * x - y * y);
    case 9u: return -0.5900435899266435 * y * (3.0 * x * x - y * y);
    case 10u: return 2.890611442640554 * x * y * z;
    case 11u: return -0.4570457994644658 * y * (4.0 * z * z - x * x - y * y);
    case 12u: return 0.3731763325901154 * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y);
    case 13u: return -0.4570457994644658 * x * (4.0 * z * z - x * x - y * y);
    case 14u: return 1.445305721320277 * z * (x * x - y * y);
    default: return -0.5900435899266435 * x * (x * x - 3.0 * y * y);
  }
}

#ifdef __cplusplus
#undef FUNCTION
}  // namespace chainsplat::shared
#endif
