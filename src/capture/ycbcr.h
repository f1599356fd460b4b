// src/capture/ycbcr.h - pictures of luma and chroma, as cameras and Y4M streams hold them, to RGB.
//
// The matrix is BT.601's, which both have. Pixels that share a chroma sample get it as it is, as libswscale's fast path
// does, so that a twin sees the colors of a video and of a live camera alike.
#pragma once
#include <cstddef>
#include <cstdint>

#include "chainsplat/capture.h"

namespace chainsplat::capture {

// Where the samples of a picture lie. Rows and steps are in bytes.
struct YCbCr {
  const std::uint8_t* luma = nullptr;
  const std::uint8_t* cb = nullptr;  // null: a gray picture, whose luma are its levels
  const std::uint8_t* cr = nullptr;
  std::size_t luma_row = 0, chroma_row = 0;
  int luma_step = 1, chroma_step = 1;
  int across = 0, down = 0;  // 2^across times 2^down pixels share a chroma sample
  bool full = false;         // range 0..255; else luma is 16..235 and chroma 16..240
};

// Sets the picture's size and pixels.
void to_rgb(YCbCr from, int width, int height, Image8& rgb);

}  // namespace chainsplat::capture
