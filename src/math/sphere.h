// sphere.h - directions evenly over the sphere.
#pragma once
#include <cmath>
#include <numbers>
#include <vector>

#include "chainsplat/math.h"

namespace chainsplat::math {

// `count` unit vectors along a spiral.
inline std::vector<Vector3> directions(int count) {
  std::vector<Vector3> out;
  for (int i = 0; i < count; ++i) {
    const double z = 1.0 - (2.0 * i + 1.0) / count, turn = std::numbers::pi * (1.0 + std::sqrt(5.0)) * i;
    const double reach = std::sqrt(1.0 - z * z);
    out.push_back({reach * std::cos(turn), reach * std::sin(turn), z});
  }
  return out;
}

}  // namespace chainsplat::math
