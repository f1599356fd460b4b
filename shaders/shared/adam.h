// shaders/shared/adam.h - Adam's step sizes for each section of the parameter buffer (shared/gaussian.h).
#ifdef __cplusplus
#pragma once
namespace chainsplat::shared {
using uint = unsigned;
#endif
struct AdamPush {
  uint gaussians, links, coefficients, total;
  float mean, rotation, log_scale, opacity;
  float sh0, sh_rest, link_logits, epsilon;
  float beta1, beta2, correction1, correction2;  // correction = 1 / (1 - beta^t)
};
#ifdef __cplusplus
static_assert(sizeof(AdamPush) == 64);
}  // namespace chainsplat::shared
#endif
