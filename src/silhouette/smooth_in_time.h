// The angles of a recording's frames together, each with what its masks say of it.
#pragma once
#include <cstddef>
#include <vector>

#include "src/silhouette/frame.h"

namespace chainsplat::silhouette {

// Unknowns of one system of equations, whose factor takes some 24 bytes times the angles for each. 24 angles at 30 Hz
// are a minute and a half.
constexpr std::size_t kMostSmoothed = 1 << 16;

// Most likely angles for every frame's quadratic and random accelerations. Frames not `seen` follow from the others.
// Longer recordings are smoothed in stretches that overlap; what lies near an end of one is taken from its neighbor.
std::vector<math::VectorX> smoothed(const std::vector<double>& times, const std::vector<FrameSolution>& solutions,
                                    const std::vector<char>& seen, std::size_t most_unknowns = kMostSmoothed);

}  // namespace chainsplat::silhouette
