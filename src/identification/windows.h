// Private to identification: of a recording that is too long for all of its angles, only windows are fitted.
#pragma once
#include <vector>

#include "chainsplat/chain.h"

namespace chainsplat::identification {

inline constexpr int kMostWindows = 4;  // shorter ones would see less than a swing

// The frames of each window, in order and `most` or fewer in all: one window of everything where that is within `most`,
// else up to kMostWindows. The first window begins with the recording, the others are where the rope moves most.
std::vector<std::vector<std::size_t>> windows_of(const chain::States& states, std::size_t most);

}  // namespace chainsplat::identification
