// chainsplat/layout.h - the twin drawn on what its camera recorded, to be looked at.
//
//   side_by_side  the recorded frame, and beside it the twin alone
//   overlay       the recorded frame without color, half as bright, and the twin on it
//   wipe          the overlay left of a line that goes over the picture once, the recorded frame right of it
//   outline       the recorded frame, and the edge of the drawn rope on it
//   error         the recorded frame without color, half as bright; where the twin is drawn, how far its colors are off
#pragma once
#include <string>
#include <vector>

#include "chainsplat/render.h"

namespace chainsplat::render {

enum class Layout { drawn, side_by_side, overlay, wipe, outline, error };

// "drawn", "side-by-side", ...
const std::vector<std::string>& layout_names();
Layout read_layout(const std::string& name);  // throws InputError that lists them

// The picture of one frame. `recorded`: RGB of the camera's size; empty: nothing was recorded at this time, and it is
// black. `share`: of the way, 0 to 1, that a wipe's line has gone. Twice as wide for side_by_side.
capture::Image8 laid_out(Layout layout, const Frame& frame, const capture::Camera& camera,
                         const capture::Image8& recorded, double share);

}  // namespace chainsplat::render
