// alpha.glsl - what one splat does to one pixel, the same forward and backward (SPEC 2.6). Needs kCutoffs.

const float kAlphaCap = kCutoffs != 0u ? 0.99 : 2.0;
const float kAlphaLeast = kCutoffs != 0u ? 1.0 / 255.0 : -1.0;
const float kTransmittanceLeast = kCutoffs != 0u ? 1e-4 : -1.0;

// exp(-1/2 delta^T Q delta), Q = [x y; y z]
float gaussian_falloff(vec3 conic, float dx, float dy) {
  return exp(-0.5 * (conic.x * dx * dx + conic.z * dy * dy) - conic.y * dx * dy);
}
