// The mask of one picture, where the look of the rope and of its surroundings is known.
#pragma once
#include <optional>

#include "src/masking/look.h"

namespace chainsplat::masking {

// Returns the mask of one picture, 0 or 255, as a crop with the picture's RGB inside the mask; an empty view (width 0)
// when nothing is found. With `theta` the chain is expected there to within about half a diameter; without it, colors
// and background alone decide, as far as the rope can reach. `doubt` multiplies the usual uncertainty of the place.
capture::View cut(const Look& appearance, const Picture& picture, const capture::Camera& camera,
                  const chain::Chain& chain, const math::Pose& base, const std::optional<math::VectorX>& theta,
                  double doubt = 1.0);

}  // namespace chainsplat::masking
