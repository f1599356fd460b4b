#include "windows.h"

#include <algorithm>
#include <cmath>
#include <numeric>

namespace chainsplat::identification {

namespace {

constexpr double kLeastWindow = 3.0;  // s: a swing of three meters of rope
constexpr double kRate = 30.0;        // frames a second: of faster recordings some frames are left out

// Of the angles between neighboring frames, up to whole turns.
double motion_to(const chain::States& states, std::size_t from, std::size_t to) {
  return (1.0 - (states.theta[to] - states.theta[from]).array().cos()).sum();
}

}  // namespace

std::vector<std::vector<std::size_t>> windows_of(const chain::States& states, std::size_t most) {
  const std::size_t all = states.time.size();
  std::vector<std::size_t> frames(all);
  std::iota(frames.begin(), frames.end(), std::size_t{0});
  if (all <= most) return {frames};
  const double seconds = states.time.back() - states.time.front();
  if (!(seconds > 0.0) || states.theta.size() != all) return {frames};  // nothing to choose by, and it will be refused
  const auto rate = static_cast<double>(all - 1) / seconds;
  const auto every = std::clamp<std::size_t>(static_cast<std::size_t>(rate / kRate + 1e-6), 1, (all + most - 1) / most);
  for (std::size_t k = 0; k * every < all; ++k) frames[k] = k * every;
  frames.resize((all + every - 1) / every);
  if (frames.size() <= most) return {frames};
  const double fitted = seconds * static_cast<double>(most) / static_cast<double>(frames.size());
  const auto count = static_cast<std::size_t>(std::clamp(std::floor(fitted / kLeastWindow), 1.0, 1.0 * kMostWindows));
  const std::size_t length = most / count;

  std::vector<double> motion(frames.size(), 0.0);  // up to a frame
  for (std::size_t k = 1; k < frames.size(); ++k)
    motion[k] = motion[k - 1] + motion_to(states, frames[k - 1], frames[k]);
  std::vector<std::size_t> begins;
  for (std::size_t k = length; k + length <= frames.size(); k += length) begins.push_back(k);
  std::stable_sort(begins.begin(), begins.end(), [&](std::size_t a, std::size_t b) {
    return motion[a + length - 1] - motion[a] > motion[b + length - 1] - motion[b];
  });
  begins.resize(std::min(begins.size(), count - 1));
  begins.push_back(0);
  std::sort(begins.begin(), begins.end());
  std::vector<std::vector<std::size_t>> windows;
  for (const std::size_t begin : begins)
    windows.emplace_back(frames.begin() + static_cast<std::ptrdiff_t>(begin),
                         frames.begin() + static_cast<std::ptrdiff_t>(begin + length));
  return windows;
}

}  // namespace chainsplat::identification
