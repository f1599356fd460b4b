// chainsplat/frame_pattern.h - names of image files, one a frame, with the frame's number as printf writes it:
// masks/cam0/%06d.png.
#pragma once
#include <optional>
#include <string>

namespace chainsplat::capture {

struct FramePattern {
  std::string before, after;  // of the number
  int digits = 0;             // the least number of them, filled with leading zeros
  std::string file(int frame) const;
};
// Returns none where the text is no such pattern: %d or %06d once.
std::optional<FramePattern> read_frame_pattern(const std::string& text);

}  // namespace chainsplat::capture
