// shaders/shared/color.h - structs and constants that src/splat, src/estimation and shaders/color_*.comp share: the
// normal equations of the colors inside a mask (chainsplat/splat.h, ColorSums).
#ifdef __cplusplus
#pragma once
#include <glm/glm.hpp>
namespace chainsplat::shared {
using glm::vec4;
using uint = unsigned;
#endif

// One view, in addition to its SplatView. A segment is a link's axis in the camera frame, 2 vec4: start and length (m);
// unit direction and an unused number.
struct ColorView {
  uint first_tile, tiles;  // its active tiles, which are contiguous
  uint first_segment;      // in units of one segment
  uint padding;
};

struct ColorPush {
  uint links;
  uint pixel_slices, equation_slices;  // of the tiles of a view; a work group has one slice (and one link)
  uint padding;
};

const uint kColorEdge = 2u;  // px from the mask's outline within which colors are mixed with the background's
const float kColorOpaque = 0.95f;  // least drawn alpha of a pixel that counts
const float kColorNoise = 0.05f;  // intensity; Huber's threshold: larger residuals come from stains, shadows, occluders
const float kColorGainWeight = 10.0f;  // weight of the prior that the gain is 1; keeps a rope of one gray solvable
const float kColorBiasWeight = 40.0f;  // weight of the prior that the bias is 0

// A later link replaces an earlier one as the nearest only if its squared distance is less than this times the other's.
// On the outer side of a bend both distances are equal, to the joint, and rounding must not decide.
const float kColorNearer = 0.999f;

// Sums over one slice of pixels at gain 1 and bias 0, over pixels and channels: 4 vec4. s drawn, t observed, w robust
// weight; s' = s - 1/2 and t' = t - 1/2, because their variance then loses fewer digits.
//   0: w s^2, w s, w, w (s - t) s   1: w (s - t), pixels, s' t', s'^2   2: s' red, green, blue, t'^2
//   3: t' red, green, blue, -
const uint kColorPixelRows = 4u;
// Sums over one slice of a link's pixels: 12 vec4. The offsets below are in floats. A row of the Jacobian is moment and
// force about the segment's start (camera frame), gain, bias.
const uint kColorRows = 12u;
const uint kColorTwist = 0u;    // 21: moment and force twice, the upper triangle of 6 x 6 by rows
const uint kColorByGain = 21u;  // 6: moment and force, gain
const uint kColorByBias = 27u;  // 6: moment and force, bias
const uint kColorRight = 33u;   // 6: moment and force, residual
const uint kColorGain2 = 39u;   // 6: gain twice; gain, bias; bias twice; gain, residual; bias, residual; residual twice
const uint kColorExposure = 45u;  // 2: the gain and the bias at which the sums were formed

#ifdef __cplusplus
static_assert(sizeof(ColorView) == 16 && sizeof(ColorPush) == 16);
}  // namespace chainsplat::shared
#endif
