// src/capture/image_files.h - reading of single images of a capture.
//
// All readers throw InputError when the image is missing, unreadable or of another size than expected.
#pragma once
#include <cstdint>
#include <vector>
#include "chainsplat/capture.h"

namespace chainsplat::capture {

// Returns the first channel in 8 bits.
std::vector<std::uint8_t> read_mask(const Path& file, int width, int height);
// Returns red, green and blue in 8 bits each; gray is repeated and alpha dropped.
std::vector<std::uint8_t> read_rgb(const Path& file, int width, int height);
// Returns the 16-bit values times `scale`, in m; 0 stands for none. Only the first `rows` of the `height` are needed:
// below them may be anything.
std::vector<float> read_depth(const Path& file, int width, int height, int rows, double scale);

}  // namespace chainsplat::capture
