#include <algorithm>
#include <array>

#include "chainsplat/eval.h"
#include "chainsplat/image_model.h"

namespace chainsplat::eval {

using namespace image_model;

namespace {

// Filtered quantities. Of x^2 and y^2 only the sum is asked for.
enum Moment { kX, kY, kSquares, kProduct, kMoments };
constexpr int kTaps = 2 * kSsimReach + 1;

struct Span {
  int first = 0, last = 0;  // [first, last); empty when first >= last
};

Span joined(const Span& a, const Span& b) {
  if (a.first >= a.last) return b;
  if (b.first >= b.last) return a;
  return {std::min(a.first, b.first), std::max(a.last, b.last)};
}

using Taps = std::array<const float*, kTaps>;

// out[i] = sum of the window's weights times in[t][i] for i in [first, last). Single precision changes
// the mean over an image by 1e-7. The taps are written out so that the compiler vectorizes over i.
void filter(const Taps& in, float* out, int first, int last) {
  static_assert(kSsimReach == 5);
  std::array<float, kSsimReach + 1> w{};
  for (int t = 0; t <= kSsimReach; ++t) w[t] = static_cast<float>(kSsimWindow[t]);
  const auto [a, b, c, d, e, middle, f, g, h, i, j] = in;
  for (int x = first; x < last; ++x)
    out[x] = w[0] * middle[x] + w[1] * (e[x] + f[x]) + w[2] * (d[x] + g[x]) + w[3] * (c[x] + h[x]) +
             w[4] * (b[x] + i[x]) + w[5] * (a[x] + j[x]);
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

  // Rows are filtered along x as they come, colors interleaved, and the last kTaps of them, 0 outside of their spans,
  // along y: what is in use fits the cache.
  const int samples = 3 * width, margin = 3 * kSsimReach;
  std::vector<float> line(static_cast<std::size_t>(kMoments) * (samples + 2 * margin));
  std::vector<float> rows(static_cast<std::size_t>(kTaps) * kMoments * samples), column(kMoments * samples);
  const auto filtered = [&](int y, int m) {  // no element is named: of a picture without a pixel there is none
    return rows.data() + (static_cast<std::size_t>((y + kTaps) % kTaps) * kMoments + m) * samples;
  };
  const auto filter_row = [&](int y) {
    for (int m = 0; m < kMoments; ++m) std::fill_n(filtered(y, m), samples, 0.0f);
    if (y >= height || row_span[y].first >= row_span[y].last) return;
    const int first = 3 * row_span[y].first, last = 3 * row_span[y].last;
    const std::size_t padded = samples + 2u * margin;
    std::fill(line.begin(), line.end(), 0.0f);
    const float *const a = &a_rgb[static_cast<std::size_t>(samples) * y],
                       *const b = &b_rgb[static_cast<std::size_t>(samples) * y];
    float* const at = &line[margin];
    for (int i = std::max(0, first - margin); i < std::min(samples, last + margin); ++i) {
      at[kX * padded + i] = a[i];
      at[kY * padded + i] = b[i];
      at[kSquares * padded + i] = a[i] * a[i] + b[i] * b[i];
      at[kProduct * padded + i] = a[i] * b[i];
    }
    for (int m = 0; m < kMoments; ++m) {
      Taps in;
      for (int t = 0; t < kTaps; ++t) in[t] = &line[m * padded + 3u * t];
      filter(in, filtered(y, m), first, last);
    }
  };
  for (int y = 0; y < kSsimReach; ++y) filter_row(y);
  double deficit = 0.0;  // sum of 1 - S over pixels and channels
  std::vector<float> missing(samples);
  for (int y = 0; y < height; ++y) {
    filter_row(y + kSsimReach);
    if (span[y].first >= span[y].last) continue;
    const int first = 3 * span[y].first, last = 3 * span[y].last;
    for (int m = 0; m < kMoments; ++m) {
      Taps in;
      for (int t = 0; t < kTaps; ++t) in[t] = filtered(y + t - kSsimReach, m);
      filter(in, &column[m * samples], first, last);
    }
    const float *const mx = &column[kX * samples], *const my = &column[kY * samples],
                       *const squares = &column[kSquares * samples], *const product = &column[kProduct * samples];
    constexpr float c1 = static_cast<float>(kSsimC1), c2 = static_cast<float>(kSsimC2);
    for (int i = first; i < last; ++i) {
      const float means = mx[i] * mx[i] + my[i] * my[i], mean_product = mx[i] * my[i];
      missing[i] = 1.0f - (2.0f * mean_product + c1) * (2.0f * (product[i] - mean_product) + c2) /
                              ((means + c1) * (squares[i] - means + c2));
    }
    for (int i = first; i < last; ++i) deficit += missing[i];
  }
  return 1.0 - deficit / (3.0 * full_pixels);
}

}  // namespace chainsplat::eval
