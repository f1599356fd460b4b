#include <algorithm>
#include <cmath>
#include <cstdlib>

#include "chainsplat/eval.h"
#include "chainsplat/image_model.h"

namespace chainsplat::eval {

using namespace image_model;

namespace {

constexpr int kMoments = 5;  // filtered quantities: x, y, x^2, y^2, x y

struct Span {
  int first = 0, last = 0;  // [first, last); empty when first >= last
};

Span joined(const Span& a, const Span& b) {
  if (a.first >= a.last) return b;
  if (b.first >= b.last) return a;
  return {std::min(a.first, b.first), std::max(a.last, b.last)};
}

}  // namespace

double ssim(const std::vector<float>& a_rgb, const std::vector<float>& b_rgb, int width, int height,
            double full_pixels) {
  const std::size_t pixels = static_cast<std::size_t>(width) * height;
  CHAINSPLAT_CHECK(a_rgb.size() == 3 * pixels && b_rgb.size() == 3 * pixels, std::to_string(a_rgb.size()));

  // columns per row whose window contains anything but black; elsewhere S = 1
  std::vector<Span> row_span(height), span(height);
  for (int y = 0; y < height; ++y) {
    const std::size_t row = 3u * static_cast<std::size_t>(width) * y;
    const auto black = [&](int x) {
      for (std::size_t k = row + 3u * x; k < row + 3u * (x + 1); ++k)
        if (a_rgb[k] != 0.0f || b_rgb[k] != 0.0f) return false;
      return true;
    };
    int first = 0, last = width;
    while (first < width && black(first)) ++first;
    while (last > first && black(last - 1)) --last;
    if (first < last) row_span[y] = {std::max(0, first - kSsimReach), std::min(width, last + kSsimReach)};
  }
  for (int y = 0; y < height; ++y)
    for (int t = std::max(0, y - kSsimReach); t < std::min(height, y + kSsimReach + 1); ++t)
      span[y] = joined(span[y], row_span[t]);

  // filter along rows, then along columns, and sum 1 - S
  std::vector<double> filtered(kMoments * pixels, 0.0);  // along rows; 0 outside the spans in every channel
  std::vector<double> line(kMoments * (width + 2u * kSsimReach)), sum(kMoments * static_cast<std::size_t>(width));
  const std::size_t padded = width + 2u * kSsimReach;
  double deficit = 0.0;  // sum of 1 - S over pixels and channels
  for (int channel = 0; channel < 3; ++channel) {
    for (int y = 0; y < height; ++y) {
      const Span s = row_span[y];
      if (s.first >= s.last) continue;
      std::fill(line.begin(), line.end(), 0.0);
      for (int x = std::max(0, s.first - kSsimReach); x < std::min(width, s.last + kSsimReach); ++x) {
        const std::size_t k = 3 * (static_cast<std::size_t>(width) * y + x) + channel;
        const double a = a_rgb[k], b = b_rgb[k];
        double* const at = &line[x + kSsimReach];
        at[0] = a;
        at[padded] = b;
        at[2 * padded] = a * a;
        at[3 * padded] = b * b;
        at[4 * padded] = a * b;
      }
      for (int m = 0; m < kMoments; ++m) {
        double* const out = &filtered[m * pixels + static_cast<std::size_t>(width) * y];
        std::fill(out + s.first, out + s.last, 0.0);
        for (int t = 0; t <= 2 * kSsimReach; ++t) {
          const double* const in = &line[m * padded + t];
          const double weight = kSsimWindow[std::abs(t - kSsimReach)];
          for (int x = s.first; x < s.last; ++x) out[x] += weight * in[x];
        }
      }
    }
    for (int y = 0; y < height; ++y) {
      const Span s = span[y];
      if (s.first >= s.last) continue;
      for (int m = 0; m < kMoments; ++m) {
        double* const out = &sum[static_cast<std::size_t>(width) * m];
        std::fill(out + s.first, out + s.last, 0.0);
        for (int t = std::max(0, y - kSsimReach); t < std::min(height, y + kSsimReach + 1); ++t) {
          const double* const in = &filtered[m * pixels + static_cast<std::size_t>(width) * t];
          const double weight = kSsimWindow[std::abs(t - y)];
          for (int x = s.first; x < s.last; ++x) out[x] += weight * in[x];
        }
      }
      for (int x = s.first; x < s.last; ++x) {
        const double mx = sum[x], my = sum[width + x];
        const double xx = sum[2 * width + x] - mx * mx, yy = sum[3 * width + x] - my * my,
                     xy = sum[4 * width + x] - mx * my;
        deficit +=
            1.0 - (2 * mx * my + kSsimC1) * (2 * xy + kSsimC2) / ((mx * mx + my * my + kSsimC1) * (xx + yy + kSsimC2));
      }
    }
  }
  return 1.0 - deficit / (3.0 * full_pixels);
}

}  // namespace chainsplat::eval
