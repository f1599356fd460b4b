// start.h - the belief about the rope before the first frame.
#pragma once
#include "chainsplat/estimation.h"

namespace chainsplat::estimation {

// Returns a wide belief around the motion from rest that the twin predicts.
Belief first_belief(const Filter& filter, double time);

constexpr double kLostShare = 0.5;  // share of the mask explained, below which the rope is lost (mathematics.md 6)

}  // namespace chainsplat::estimation
