// setup.h - what is learned of the base's clock, the grasp and the cameras while a rope is followed
// (mathematics.md 6.8).
#pragma once
#include "chainsplat/estimation.h"

namespace chainsplat::estimation {

// What is known before the first frame. `filter`: with its model, cameras, base and table. `unverified`: by camera
// whether no training has compared its pose with the rope; empty: none.
Setup first_setup(const Filter& filter, const std::vector<char>& unverified);

// What of it the base is mended by: nothing before the setup is made.
BaseCorrection base_correction(const Setup& setup);

// Takes what a frame that is explained says of the setup. The belief before it was `predicted`, and its masks found the
// angles `theta`. The filter's cameras and its belief, if it has one, move with the setup.
void learn_setup(Filter& filter, std::span<const capture::View* const> views, const Belief& predicted,
                 const math::VectorX& theta);

}  // namespace chainsplat::estimation
