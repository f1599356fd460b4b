// usual.h - which of many values are not unusually large.
#pragma once
#include <algorithm>
#include <span>
#include <vector>

namespace chainsplat::math {

// Returns the numbers of the values that are at most `more` above what the lowest fifth of them stays under, in order;
// all numbers where those are fewer than 0.3 of them: what most have is not unusual.
inline std::vector<int> usual_ones(std::span<const double> values, double more) {
  constexpr double kLow = 0.2, kLeastShare = 0.3;
  std::vector<int> all, usual;
  if (values.empty()) return all;
  std::vector<double> sorted(values.begin(), values.end());
  std::sort(sorted.begin(), sorted.end());
  const double most = sorted[static_cast<std::size_t>(kLow * static_cast<double>(sorted.size()))] + more;
  for (int i = 0; i < static_cast<int>(values.size()); ++i) {
    all.push_back(i);
    if (values[i] <= most) usual.push_back(i);
  }
  return static_cast<double>(usual.size()) < kLeastShare * static_cast<double>(all.size()) ? all : usual;
}

}  // namespace chainsplat::math
