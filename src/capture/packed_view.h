// src/capture/packed_view.h - making views that hold the pixels of their masks only, and going through them.
#pragma once
#include "chainsplat/capture.h"

namespace chainsplat::capture {

// Sets the runs of a view whose crop is known to the pixels for which inside(x, y) is true, and makes room for their
// colors, all 0.
template <class Inside>
void set_runs(PackedView& view, const Inside& inside) {
  constexpr std::size_t kMost = 0xffff;  // pixels in one number of `runs`; more take several
  std::size_t black = 0, shown = 0, all = 0;
  view.runs.clear();
  const auto end_run = [&] {
    for (; black > kMost; black -= kMost) view.runs.insert(view.runs.end(), {std::uint16_t{kMost}, std::uint16_t{0}});
    for (; shown > kMost; shown -= kMost, black = 0)
      view.runs.insert(view.runs.end(), {static_cast<std::uint16_t>(black), std::uint16_t{kMost}});
    view.runs.insert(view.runs.end(), {static_cast<std::uint16_t>(black), static_cast<std::uint16_t>(shown)});
    black = shown = 0;
  };
  for (int y = 0; y < view.height; ++y)
    for (int x = 0; x < view.width; ++x) {
      if (inside(x, y)) {
        ++shown, ++all;
        continue;
      }
      if (shown > 0) end_run();
      ++black;
    }
  if (shown > 0) end_run();  // what is black at the end needs no run
  view.runs.shrink_to_fit();
  view.rgba.assign(4 * all, 0);
}

// Calls visit(first, count) for every run of pixels that are not black, by their numbers in the crop.
template <class Visit>
void each_run(const PackedView& view, const Visit& visit) {
  std::size_t at = 0;
  for (std::size_t i = 0; i + 1 < view.runs.size(); i += 2) {
    at += view.runs[i];
    if (view.runs[i + 1] > 0) visit(at, static_cast<std::size_t>(view.runs[i + 1]));
    at += view.runs[i + 1];
  }
}

// Calls visit(x, y) for every pixel that is not black, in the order of `rgba`.
template <class Visit>
void each_pixel(const PackedView& view, const Visit& visit) {
  each_run(view, [&](std::size_t first, std::size_t count) {
    int x = static_cast<int>(first % view.width), y = static_cast<int>(first / view.width);
    for (std::size_t k = 0; k < count; ++k) {
      visit(x, y);
      if (++x == view.width) x = 0, ++y;
    }
  });
}

}  // namespace chainsplat::capture
