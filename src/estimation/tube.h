// tube.h - the tube around the chain in the image, beside the masks.
#pragma once
#include "src/estimation/state.h"

namespace chainsplat::estimation {

// The masks' area over that of the tube at theta, in the view where it is most: a rope may point at one camera or cross
// itself there, but not in all views. `edge_offset`: px, by which the masks are wider than the tube on each side.
double shown_share(const State& state, std::span<const capture::View* const> views, const math::VectorX& theta,
                   double edge_offset);

}  // namespace chainsplat::estimation
