// start.h - what is believed of the rope before the first frame.
#pragma once
#include "chainsplat/estimation.h"

namespace chainsplat::estimation {

// The motion from rest that the twin expects, roughly.
Belief first_belief(const Filter& filter, double time);

constexpr double kLostShare = 0.5;  // of the mask explained, under which the rope is lost (SPEC 6)

}  // namespace chainsplat::estimation
