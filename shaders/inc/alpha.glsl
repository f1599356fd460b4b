// alpha.glsl - the alpha of one splat in a column of pixels, shared by the forward and the backward pass so that both
// agree (mathematics.md 2.6). Needs kCutoffs, kPixels, share.glsl.
#include "chainsplat/image_model.h"

const float kAlphaCap = kCutoffs != 0u ? kMostAlpha : 2.0;
const float kAlphaLeast = kCutoffs != 0u ? kLeastAlpha : -1.0;
const float kTransmittanceLeast = kCutoffs != 0u ? kLeastTransmittance : -1.0;

// The exponent log2(e) (-1/2 delta^T Q delta), Q = [x y; y z], with the square completed in y: in a column of pixels at
// dx to the right of the splat's center it is along dx^2 + fall dy^2, where dy counts from the column's peak, which
// lies slope dx above the center.
struct Falloff {
  float slope, along, fall;
  float change;  // 2^(2 fall)
};

Falloff falloff_of(vec3 conic) {
  const float kHalfLog2e = 0.72134752;
  Falloff f;
  f.slope = conic.z > 0.0 ? conic.y / conic.z : 0.0;
  f.along = -kHalfLog2e * (conic.x - conic.y * f.slope);
  f.fall = -kHalfLog2e * conic.z;
  f.change = exp2(2.0 * f.fall);
  return f;
}

Falloff shared_by(Falloff f, uint turn) {
  return Falloff(shared_by(f.slope, turn), shared_by(f.along, turn), shared_by(f.fall, turn), shared_by(f.change, turn));
}

// `opacity` times the falloff at kPixels pixels of a column, the first of them dy below the column's peak. From one row
// to the next the value changes by a factor that itself changes by a constant factor: this takes three exponentials
// instead of kPixels. It proceeds from the middle outward: sigma is at least half a pixel, so no value that matters is
// lost to underflow on the way.
void alphas_of(Falloff f, float opacity, float dx, float dy, out float alpha[kPixels]) {
  const uint kMiddle = kPixels / 2u;
  const float kLargest = 100.0;  // beyond it the middle is 0 already, and the factor must stay finite
  float middle = dy + float(kMiddle);
  alpha[kMiddle] = opacity * exp2(f.along * dx * dx + f.fall * middle * middle);
  float factor = exp2(min(f.fall * (1.0 + 2.0 * middle), kLargest));
  [[unroll]] for (uint k = kMiddle + 1u; k < kPixels; ++k) {
    alpha[k] = alpha[k - 1u] * factor;
    factor *= f.change;
  }
  factor = exp2(min(f.fall * (1.0 - 2.0 * middle), kLargest));
  [[unroll]] for (uint k = 0u; k < kMiddle; ++k) {
    alpha[kMiddle - 1u - k] = alpha[kMiddle - k] * factor;
    factor *= f.change;
  }
}

// Front-to-back blending of one splat into one pixel. Returns the splat's weight, 0 if it does not contribute. The
// first splat that would take the transmittance below the least closes the pixel: `transmittance` keeps its size and
// becomes negative, and neither that splat nor any behind it contributes.
float blend_weight(float alpha, inout float transmittance, out bool contributes) {
  float after = transmittance * (1.0 - alpha);
  bool reaches = alpha >= kAlphaLeast, stays_open = after >= kTransmittanceLeast;
  contributes = reaches && stays_open;
  float weight = contributes ? alpha * transmittance : 0.0;
  transmittance = reaches ? (stays_open ? after : -abs(transmittance)) : transmittance;
  return weight;
}
