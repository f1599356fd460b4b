// rolls.h - how far a rope's material has turned about its own axis in each frame.
#pragma once
#include <vector>

#include "chainsplat/capture.h"
#include "chainsplat/chain.h"
#include "src/recognition/frames.h"

namespace chainsplat::recognition {

// A rope that is pushed over a table rolls, and carries its texture along; the chain's links do not. This finds every
// frame's turn of the material about each link's axis, rad, links() values, from the colors of the surface: what the
// cameras show of it is laid out flat, by arclength and angle about the axis, and moved around until it fits what the
// other frames show. `states` need angles only, as outlines give them. The mean over time is taken off, since no
// picture tells it from a twisted texture. Empty where turns explain too little of the colors to be believed.
// Mathematics.md 2.9.
std::vector<math::VectorX> rolls_in(const chain::Chain& chain, const capture::Capture& capture,
                                    const std::vector<FrameViews>& frames, const chain::States& states);

}  // namespace chainsplat::recognition
