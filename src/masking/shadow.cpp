#include "src/masking/shadow.h"

#include <algorithm>
#include <cmath>

namespace chainsplat::masking {

namespace {

constexpr double kCore = 0.7, kClear = 1.8;  // radii from the axis: surely the rope, and clear of narrow shadows
constexpr double kDarkestHue = 0.25;         // share of the light beside, below which a color has no hue
constexpr double kLightestShade = 1.15;      // and above which it is in no shadow
constexpr double kGrain = 2.0;               // gray levels, the noise of a color
constexpr double kLittleKnown = 20.0;        // samples, as which an even distribution counts
constexpr double kMostShadowOdds = 2.5;      // of one sample
constexpr double kShadow = -0.7;             // log odds: it is twice as likely a shadow as the rope
// The light is told in shares of that beside the rope, what does not fit a shadow in gray levels up to these.
constexpr std::array kLights = {0.15, 0.25, 0.4, 0.6, 0.8, 1.0};
constexpr std::array kRemainders = {2.5, 3.5, 5.0, 7.0, 10.0, 14.0, 20.0, 30.0};

// A color as a shadow on a lit surface: the share of the light that is left, and what remains, gray levels.
struct Shaded {
  double light = 0.0, remainder = 0.0;
};

Shaded shaded(const Color& color, const Color& lit) {
  double both = 0.0, all = 1e-9, left = 0.0;
  for (int c = 0; c < 3; ++c)
    both += static_cast<double>(color[c]) * lit[c], all += static_cast<double>(lit[c]) * lit[c];
  const double light = both / all;
  for (int c = 0; c < 3; ++c) left += (color[c] - light * lit[c]) * (color[c] - light * lit[c]) / 3.0;
  return {light, std::sqrt(left)};
}

// Calls body(station) for those within `about` of one.
template <class Body>
void each_near(const Strip& strip, int station, const Body& body) {
  const int last = std::min(strip.stations() - 1, station + strip.about);
  for (int i = std::max(0, station - strip.about); i <= last; ++i) body(i);
}

double mean_along(const Strip& strip, const std::vector<double>& values, int station, int column) {
  double sum = 0.0;
  int n = 0;
  each_near(strip, station, [&](int i) { sum += values[strip.at(i, column)], ++n; });
  return sum / n;
}

// The mean color clear of the rope on one side, by station.
std::vector<Color> lit_beside(const Strip& strip, bool right) {
  std::vector<Color> out(strip.stations(), Color{});
  for (int i = 0; i < strip.stations(); ++i) {
    float n = 0.0f;
    each_near(strip, i, [&](int j) {
      for (std::size_t k = 0; k < strip.across.size(); ++k) {
        if ((right ? strip.across[k] : -strip.across[k]) < kClear) continue;
        for (int c = 0; c < 3; ++c) out[i][c] += strip.colors[strip.at(j, static_cast<int>(k))][c];
        ++n;
      }
    });
    for (float& value : out[i]) value /= std::max(1.0f, n);
  }
  return out;
}

// How often a color has these remainders where it is darkened to each of kLights.
struct Darkened {
  std::array<std::array<double, kRemainders.size() + 1>, kLights.size()> counts{};
  double samples = kLittleKnown;
  Darkened() {
    for (auto& row : counts) row.fill(kLittleKnown / static_cast<double>(row.size()));
  }
  static std::size_t bin(double remainder) {
    const double grainy = std::hypot(remainder, kGrain);
    return std::lower_bound(kRemainders.begin(), kRemainders.end(), grainy) - kRemainders.begin();
  }
  void add(const Shaded& one) {
    ++samples;
    for (std::size_t l = 0; l < kLights.size(); ++l) ++counts[l][bin(one.remainder * kLights[l] / one.light)];
  }
  double share(const Shaded& one) const {
    std::size_t l = 0;
    while (l + 1 < kLights.size() && 0.5 * (kLights[l] + kLights[l + 1]) < one.light) ++l;
    return counts[l][bin(one.remainder)] / samples;
  }
};

}  // namespace

Shadowless without_shadow(const Strip& strip) {
  const int stations = strip.stations(), columns = static_cast<int>(strip.across.size());
  const std::vector<Color> lit[2] = {lit_beside(strip, false), lit_beside(strip, true)};
  std::vector<Shaded> pixels(strip.colors.size());
  Darkened rope, beside;  // the rope's dark side has the hue of its lit one
  for (int i = 0; i < stations; ++i)
    for (int k = 0; k < columns; ++k) {
      const Shaded one = pixels[strip.at(i, k)] = shaded(strip.colors[strip.at(i, k)], lit[strip.across[k] > 0.0][i]);
      if (i < strip.begin || i >= strip.end || one.light < kDarkestHue) continue;
      if (std::abs(strip.across[k]) < kCore) rope.add(one);
      if (std::abs(strip.across[k]) > kClear) beside.add(one);
    }

  Shadowless out{std::vector<double>(pixels.size(), 0.0), strip.colors};
  std::vector<double> light(pixels.size());
  for (std::size_t at = 0; at < pixels.size(); ++at) {
    light[at] = pixels[at].light;
    if (light[at] < kLightestShade)
      out.odds[at] = std::clamp(std::log(rope.share(pixels[at]) / beside.share(pixels[at])), -kMostShadowOdds, 0.0);
  }
  for (int i = 0; i < stations; ++i)
    for (const bool right : {false, true}) {
      const int inward = right ? -1 : 1, outermost = right ? columns - 1 : 0;
      int meets = outermost;  // the rope; the innermost column up to which there is nothing else
      for (int k = outermost; k >= 0 && k < columns && (right ? strip.across[k] : -strip.across[k]) > 0.0;
           k += inward) {
        if (std::abs(strip.across[k]) < kClear && mean_along(strip, out.odds, i, k) > kShadow) break;
        meets = k;
      }
      const double dark = mean_along(strip, light, i, meets);
      for (int k = outermost; k != meets + inward; k += inward) {
        const std::size_t at = strip.at(i, k);
        const auto darker = static_cast<float>(std::clamp(dark / std::max(kLights[0], light[at]), 0.0, 1.0));
        for (float& value : out.colors[at]) value *= darker;
      }
    }
  return out;
}

}  // namespace chainsplat::masking
