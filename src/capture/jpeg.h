// src/capture/jpeg.h - JPEG frames of cameras, with libjpeg. Writing is jpeg() of encode.h.
#pragma once
#include <cstdint>
#include <span>

#include "chainsplat/capture.h"

namespace chainsplat::capture {

// Decodes a picture of this size into RGB. Returns false where it is damaged or of another size.
bool read_jpeg(std::span<const std::uint8_t> bytes, int width, int height, Image8& rgb);

}  // namespace chainsplat::capture
