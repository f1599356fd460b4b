// The mask of one picture, where the look of the rope and of its surroundings is known.
#pragma once
#include "src/masking/look.h"

namespace chainsplat::masking {

// Returns the labels, 0 or 255, of the pixels of a box, row by row, that cost least. A pixel outside costs its log
// odds, where these are positive, and one inside costs them where they are negative. A contour between two of eight
// neighbors costs kContour exp(-d / (2 m)), with their squared difference d and the box's mean one m; 1/sqrt(2) of that
// between diagonal ones. `odds`: log odds per pixel, NaN where the pixel is certainly outside and no part of this.
constexpr double kContour = 2.0;  // cost per pixel of a contour through a plain area
std::vector<std::uint8_t> least_cut(const Picture& picture, const math::Rectangle& box, const std::vector<float>& odds);

// Where cut() looks for a chain that is expected at these angles to within about half a diameter. `doubt` multiplies
// that.
Tube expected_tube(const chain::Chain& chain, const math::Pose& base, const math::VectorX& theta,
                   const capture::Camera& camera, double doubt);

// Returns the mask of one picture, 0 or 255, as a crop with the picture's RGB inside the mask; an empty view (width 0)
// when nothing is found. `place`: the expected_tube(), with the same doubt; without it, colors and background alone
// decide, as far as the rope can reach.
capture::View cut(const Look& appearance, const Picture& picture, const capture::Camera& camera,
                  const chain::Chain& chain, const math::Pose& base, const Tube* place, double doubt);
// The same with the expected_tube() of these angles.
capture::View cut(const Look& appearance, const Picture& picture, const capture::Camera& camera,
                  const chain::Chain& chain, const math::Pose& base, const math::VectorX& theta, double doubt = 1.0);

}  // namespace chainsplat::masking
