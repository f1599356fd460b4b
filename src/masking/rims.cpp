#include "src/masking/rims.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace chainsplat::masking {

namespace {

// what is looked at
constexpr double kBin = 0.25;                         // px
constexpr double kOutside = 1.0, kMoreOutside = 0.3;  // beside the rope: px, and radii
constexpr double kInside = 3.0;  // px into it; what is deeper says more of the light than of the outline
// what is tried
constexpr double kLeastBlur = 0.3, kMostBlur = 2.3, kNextBlur = 1.2;  // px, and from one to the next
constexpr double kMostDim = 1.0, kNextDim = 0.125;
constexpr double kMostBeyond = 0.8, kNextBeyond = 0.05;  // px, of all parts, and of one from that of all
// what counts
constexpr double kUsualDim = 0.3, kDimDeviation = 0.1;  // where the picture does not tell
constexpr double kBeyondDeviation = 0.2;                // px, of all parts
constexpr double kBeyondScatter = 0.2;                  // px, of one part
constexpr double kNoise = 2.0;  // gray levels, beyond which a piece is one that the model does not fit

double squared(double x) { return x * x; }

double outside_of(double radius) { return kOutside + kMoreOutside * radius; }

// How much of the rope's and of the other color each bin has.
struct Shares {
  std::vector<double> rope, beside;
};

// `beyond`: px by which the rope is wider than the rough outline.
Shares shares(double radius, double blur, double dim, double beyond) {
  constexpr int kTaps = 8;
  constexpr double kTapStep = 0.3;  // deviations of the blur
  Shares out;
  for (int bin = 0; bin < rim_bins(radius); ++bin) {
    const double at = (bin + 0.5) * kBin - outside_of(radius) + beyond;
    double all = 0.0, covered = 0.0, lit = 0.0;
    for (int tap = -kTaps; tap <= kTaps; ++tap) {
      const double inside = at + tap * kTapStep * blur, weight = std::exp(-0.5 * squared(tap * kTapStep));
      all += weight;
      if (inside <= 0.0) continue;
      const double across = std::max(0.0, 1.0 - inside / (radius + beyond));
      covered += weight, lit += weight * (1.0 - dim + dim * std::sqrt(1.0 - squared(across)));
    }
    out.rope.push_back(lit / all), out.beside.push_back(1.0 - covered / all);
  }
  return out;
}

// What speaks against the shares, with the best two colors. A piece that does not fit counts as its logarithm.
double cost(const Rim& rim, const Shares& shares) {
  constexpr double kLittle = 1e-6;  // keeps the equations solvable
  double left = 0.0;
  int count = 0;
  for (int c = 0; c < 3; ++c) {
    double rr = kLittle, rb = 0.0, bb = kLittle, ry = 0.0, by = 0.0, yy = 0.0;
    for (std::size_t bin = 0; bin < rim.colors.size(); ++bin) {
      const double y = rim.colors[bin][c], r = shares.rope[bin], b = shares.beside[bin];
      if (std::isnan(y)) continue;
      ++count;
      rr += r * r, rb += r * b, bb += b * b, ry += r * y, by += b * y, yy += y * y;
    }
    left += std::max(0.0, yy - ((bb * ry - rb * by) * ry + (rr * by - rb * ry) * by) / (rr * bb - rb * rb));
  }
  return 0.5 * kBin * count * std::log1p(left / (std::max(1, count) * squared(kNoise)));
}

}  // namespace

int rim_bins(double radius) { return static_cast<int>((outside_of(radius) + std::min(radius, kInside)) / kBin); }
int rim_bin(double radius, double inside) { return static_cast<int>(std::floor((inside + outside_of(radius)) / kBin)); }

std::vector<double> fit_rims(const std::vector<Rim>& rims, int parts, double radius) {
  // light and blur of the picture, and how much wider the rope is in the mean
  double blur = 0.0, dim = 0.0, common = 0.0, least = std::numeric_limits<double>::max();
  const int most = static_cast<int>(std::lround(kMostBeyond / kNextBeyond));
  for (double b = kLeastBlur; b <= kMostBlur; b *= kNextBlur)
    for (double d = 0.0; d <= kMostDim; d += kNextDim)
      for (int n = -most; n <= most; ++n) {
        const double beyond = n * kNextBeyond;
        const Shares tried = shares(radius, b, d, beyond);
        double sum = 0.5 * squared(beyond / kBeyondDeviation) + 0.5 * squared((d - kUsualDim) / kDimDeviation);
        for (const Rim& rim : rims) sum += cost(rim, tried);
        if (sum < least) least = sum, blur = b, dim = d, common = beyond;
      }
  // each part by itself
  std::vector<double> out(parts, common), best(parts, std::numeric_limits<double>::max());
  for (int n = -most; n <= most; ++n) {
    const double beyond = common + n * kNextBeyond;
    const Shares tried = shares(radius, blur, dim, beyond);
    std::vector<double> sums(parts, 0.5 * squared((beyond - common) / kBeyondScatter));
    for (const Rim& rim : rims) sums[rim.part] += cost(rim, tried);
    for (int part = 0; part < parts; ++part)
      if (sums[part] < best[part]) best[part] = sums[part], out[part] = beyond;
  }
  return out;
}

}  // namespace chainsplat::masking
