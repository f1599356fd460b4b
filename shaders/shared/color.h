// shaders/shared/color.h - what src/splat, src/estimation and shaders/color_*.comp share: the normal equations of the
// colors inside a mask (chainsplat/splat.h, ColorSums).
#ifdef __cplusplus
#pragma once
#include <glm/glm.hpp>
namespace chainsplat::shared {
using glm::vec4;
using uint = unsigned;
#endif

// Of one view, beside its SplatView. A segment is a link's axis in the camera frame, 2 vec4: start (m) and length (m);
// direction (unit) and nothing.
struct ColorView {
  uint first_tile, tiles;  // its active tiles, which lie side by side
  uint first_segment;      // in units of one segment
  uint padding;
};

struct ColorPush {
  uint links;
  uint pixel_slices, equation_slices;  // into which the work on a view's tiles is cut, a group each (a link)
  uint padding;
};

const uint kColorEdge = 2u;  // px from the mask's outline within which a color is mixed with the background's
const float kColorOpaque = 0.95f;  // drawn coverage of a pixel that counts
const float kColorNoise = 0.05f;  // intensity, Huber's cut: beyond it stains, shadows, what hides the rope
const float kColorGainWeight = 10.0f;  // pixels' worth of belief that the gain is 1 (keeps a gray rope's solvable),
const float kColorBiasWeight = 40.0f;  // and that the bias is 0

// Of two links the later one counts where the square of its distance is less by so much: at the outer side of a bend their
// distances are the same, that to the joint.
const float kColorNearer = 0.999f;

// sums of one slice of pixels at gain 1, bias 0; s drawn, t seen, w robust weight, over pixels and channels: 4 vec4
//   0: w s^2, w s, w, w (s - t) s   1: w (s - t), pixels, s' t', s'^2   2: s' red, green, blue, t'^2
//   3: t' red, green, blue, -       s' = s - 1/2, t' = t - 1/2: what is left of their variance has more digits
const uint kColorPixelRows = 4u;
// sums of one slice of a link's pixels: 12 vec4, here by floats. Row of the Jacobian: moment and force about the
// segment's start (camera frame), gain, bias.
const uint kColorRows = 12u;
const uint kColorTwist = 0u;    // 21: upper triangle of 6 x 6, by rows
const uint kColorByGain = 21u;  // 6
const uint kColorByBias = 27u;  // 6
const uint kColorRight = 33u;   // 6
const uint kColorGain2 = 39u;   // by gain twice, gain and bias, bias twice, right of the gain's and of the bias' row,
                                // squared residuals: 6
const uint kColorExposure = 45u;  // the gain and the bias at which the sums were formed: 2

#ifdef __cplusplus
static_assert(sizeof(ColorView) == 16 && sizeof(ColorPush) == 16);
}  // namespace chainsplat::shared
#endif
