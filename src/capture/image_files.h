// src/capture/image_files.h - single images through OpenImageIO's ImageInput, without its cache.
#pragma once
#include <cstdint>
#include <vector>
#include "chainsplat/capture.h"

namespace chainsplat::capture {

// The first channel, 8 bit. Throws InputError when missing, unreadable or of another size than expected.
std::vector<std::uint8_t> read_mask(const Path& file, int width, int height);
// Red, green, blue (gray is repeated, alpha dropped), 8 bit.
std::vector<std::uint8_t> read_rgb(const Path& file, int width, int height);
// 16-bit values times `scale`, m; 0 = none.
std::vector<float> read_depth(const Path& file, int width, int height, double scale);

}  // namespace chainsplat::capture
