#include "src/capture/ycbcr.h"

#include <algorithm>

namespace chainsplat::capture {

namespace {

constexpr int kBits = 16;  // of the fraction of fixed-point numbers: errors stay below a hundredth of a level

// What a level of luma or chroma adds, by BT.601: E'R = E'Y + 1.402 E'Cr and so on.
struct Weights {
  int luma, red, green_cb, green_cr, blue;
};
constexpr int fixed(double value) { return static_cast<int>(value * (1 << kBits) + 0.5); }
constexpr Weights weights(double luma, double chroma) {
  return {fixed(luma), fixed(1.402 * chroma), fixed(0.344136 * chroma), fixed(0.714136 * chroma),
          fixed(1.772 * chroma)};
}
constexpr Weights kFull = weights(1.0, 1.0), kLimited = weights(255.0 / 219.0, 255.0 / 224.0);

std::uint8_t level(int value) { return static_cast<std::uint8_t>(std::clamp(value >> kBits, 0, 255)); }

}  // namespace

void to_rgb(YCbCr from, int width, int height, Image8& rgb) {
  rgb.width = width, rgb.height = height, rgb.channels = 3;
  rgb.pixels.resize(static_cast<std::size_t>(width) * height * 3);
  const Weights weight = from.full ? kFull : kLimited;
  const int black = from.full ? 0 : 16;
  constexpr int kHalf = 1 << (kBits - 1);  // rounds
  std::uint8_t* out = rgb.pixels.data();
  for (int y = 0; y < height; ++y) {
    const std::uint8_t* const luma = from.luma + y * from.luma_row;
    if (!from.cb) {
      for (int x = 0; x < width; ++x, out += 3) out[0] = out[1] = out[2] = luma[x * from.luma_step];
      continue;
    }
    const std::size_t chroma = (y >> from.down) * from.chroma_row;
    const std::uint8_t *const cb = from.cb + chroma, *const cr = from.cr + chroma;
    for (int x = 0; x < width; ++x, out += 3) {
      const int at = (x >> from.across) * from.chroma_step;
      const int gray = weight.luma * (luma[x * from.luma_step] - black) + kHalf, u = cb[at] - 128, v = cr[at] - 128;
      out[0] = level(gray + weight.red * v);
      out[1] = level(gray - weight.green_cb * u - weight.green_cr * v);
      out[2] = level(gray + weight.blue * u);
    }
  }
}

}  // namespace chainsplat::capture
