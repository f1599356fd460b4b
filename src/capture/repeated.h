// src/capture/repeated.h - pictures that a camera, its driver or a converter gave twice.
#pragma once
#include <vector>

#include "chainsplat/capture.h"

namespace chainsplat::capture {

// Empties the masks of views that show the rope where the view before shows it, although the base moved on between
// their times (mathematics.md 6.16): such a picture stands in the place of a later one, and says nothing of its own
// moment. A rope that rests and a base whose clock is off by a few frames change nothing, nor does a picture that
// stands for long, which is another fault. `capture`: its cameras and base. Returns the views, in their order.
std::vector<ViewPlace> empty_repeated(const Capture& capture, std::vector<PackedView>& views);

}  // namespace chainsplat::capture
