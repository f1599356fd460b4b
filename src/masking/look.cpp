#include "src/masking/look.h"

#include <algorithm>
#include <cmath>

namespace chainsplat::masking {

using math::Vector2;
using math::Vector3;

namespace {

constexpr double kReachSlack = 1.1;   // times the length, because cameras and lengths are not exact
constexpr double kNearerShare = 0.5;  // of the length, by which the free end may be nearer to the camera than the grasp
// the colors' log odds
constexpr double kUnheardOf = 0.003;  // prior share of either side's colors that is spread evenly over all colors
// log odds, the most that a color counts for and against the rope: colors that the rope never shows outweigh the place
constexpr double kSurest = 3.0, kSurestNot = 9.0;
// the difference from the background
constexpr double kTexture = 0.04;  // share of its brightness by which a background pixel may differ after lossy coding
// the share of light that a shadow leaves, and the excess that automatic exposure adds
constexpr double kDarkest = 0.25, kBrightest = 1.08;
constexpr double kSameDifference = 8.0;  // sum over the channels of squared difference / variance that decides nothing
constexpr double kOddsPerDifference = 0.25;
// log odds; a different pixel may be a shadow or a hand, but an unchanged one is hardly the rope
constexpr double kSurelySame = -2.0, kSurelyOther = 0.5;

// the rope's marks
constexpr double kMarkStep = 0.25;  // diameters per cell along the rope,
constexpr int kMostAlong = 4096;    // but no more cells than this, which are far smaller than a pixel of a thin rope
constexpr int kMarksAcross = 6;
constexpr double kLeastLight = 0.6, kMostLight = 1.3;  // times the usual: shading moves with the rope, a hand shades it
constexpr double kUsual = 16.0;  // gray levels, RMS over the channels, less than from a beige stripe to a hand's skin

// Smooths the counts by [1 2 1] / 4 along each of the three color axes.
void blur(std::vector<double>& counts) {
  for (const int stride : {1, 32, 32 * 32}) {
    const std::vector<double> old = counts;
    for (int i = 0; i < kColorBins; ++i) {
      const int at = i / stride % 32;
      const double before = at > 0 ? old[i - stride] : old[i], after = at < 31 ? old[i + stride] : old[i];
      counts[i] = 0.25 * before + 0.5 * old[i] + 0.25 * after;
    }
  }
}

template <class T>
T median(std::vector<T>& values) {
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

}  // namespace

void settle(Colors& colors) {
  // smooth the counts
  colors.log_odds.clear();
  if (colors.object.empty() || colors.surroundings.empty()) return;
  std::vector<double> object = colors.object, surroundings = colors.surroundings;
  double object_sum = 0.0, surroundings_sum = 0.0;
  for (int i = 0; i < kColorBins; ++i) object_sum += object[i], surroundings_sum += surroundings[i];
  if (object_sum <= 0.0 || surroundings_sum <= 0.0) return;
  blur(object);
  blur(surroundings);
  // log ratio of the two shares, then its mean on either side
  colors.log_odds.assign(kColorBins, 0.0f);
  const double floor = kUnheardOf / kColorBins;
  colors.usual = colors.separation = 0.0;
  for (int i = 0; i < kColorBins; ++i)
    if (object[i] > 0.0 || surroundings[i] > 0.0)  // few are; of the others both shares are `floor`
      colors.log_odds[i] = static_cast<float>(
          std::clamp(std::log((object[i] / object_sum + floor) / (surroundings[i] / surroundings_sum + floor)),
                     -kSurestNot, kSurest));
  for (int i = 0; i < kColorBins; ++i) {
    colors.usual += colors.log_odds[i] * colors.object[i] / object_sum;
    colors.separation -= colors.log_odds[i] * colors.surroundings[i] / surroundings_sum;
  }
  colors.separation += colors.usual;
}

Reach reach(const chain::Chain& chain, const math::Pose& base, const capture::Camera& camera) {
  Reach out;
  const math::Pose camera_from_world = camera.world_from_camera.inverse();
  const Vector3 grasp = camera_from_world * base.translation;
  const double nearest = grasp.z() - kNearerShare * chain.length;
  if (nearest <= 0.0) return out;
  out.grasp = capture::project(camera, grasp);
  out.radius = kReachSlack * chain.length * camera.fx / nearest;
  const Vector3 ahead = camera_from_world * (base * Vector3(chain.diameter * chain.direction));
  const Vector2 step = capture::project(camera, ahead) - out.grasp;
  const double diameter = chain.diameter * camera.fx / grasp.z();
  // for a rope that points at the camera no side is behind the grasp
  out.along = step.norm() > 0.3 * diameter ? step.normalized() : Vector2::Zero();
  out.behind = step.norm() > 0.3 * diameter ? 0.0 : 1.0;
  const auto whole = [](double value, int size) { return static_cast<int>(std::clamp(value, 0.0, 1.0 * size)); };
  out.box = {whole(out.grasp.x() - out.radius, camera.width), whole(out.grasp.y() - out.radius, camera.height),
             whole(out.grasp.x() + out.radius + 1, camera.width), whole(out.grasp.y() + out.radius + 1, camera.height)};
  return out;
}

// The index of the marks' cell at a pixel inside the tube.
int cell(const Marks& marks, const Tube& tube, int x, int y) {
  const int row = std::clamp(static_cast<int>(tube.arclength(x, y) / marks.step), 0, marks.along - 1);
  // 0 at the left outline, 1 at the right one
  const double half = std::clamp(0.5 * (-tube.at(x, y) / tube.radius), 0.0, 0.5);
  const double side = tube.is_left(x, y) ? half : 1.0 - half;
  return row * marks.across + std::min(marks.across - 1, static_cast<int>(side * marks.across));
}

bool usual(const Marks& marks, const Tube& tube, const Picture& picture, int x, int y) {
  if (marks.along == 0) return true;
  const int at = cell(marks, tube, x, y);
  if (!marks.known[at]) return true;
  // the difference that remains after the light is fitted
  const std::uint8_t *const now = pixel(picture, x, y), *const then = &marks.rgb[3 * at];
  double product = 0.0, square = 1.0, difference = 0.0;
  for (int c = 0; c < 3; ++c) product += now[c] * then[c], square += then[c] * then[c];
  const double light = std::clamp(product / square, kLeastLight, kMostLight);
  for (int c = 0; c < 3; ++c) difference += (now[c] - light * then[c]) * (now[c] - light * then[c]);
  return difference <= 3.0 * kUsual * kUsual;
}

namespace {

// Collects the colors per cell of the marks.
struct Cells {
  explicit Cells(const chain::Chain& chain) {
    marks.step = std::max(kMarkStep * chain.diameter, chain.length / kMostAlong);
    marks.along = static_cast<int>(std::ceil(chain.length / marks.step));
    marks.across = kMarksAcross;
    values.resize(static_cast<std::size_t>(3) * marks.along * marks.across);
  }
  void add(const Tube& tube, int x, int y, const std::uint8_t* rgb) {
    if (tube.at(x, y) >= 0.0f) return;
    const int at = cell(marks, tube, x, y);
    for (int c = 0; c < 3; ++c) values[3 * at + c].push_back(rgb[c]);
  }
  Marks medians() {
    marks.rgb.assign(values.size(), 0);
    marks.known.assign(values.size() / 3, 0);
    for (std::size_t i = 0; i < values.size(); ++i) {
      if (values[i].empty()) continue;
      marks.rgb[i] = median(values[i]);
      marks.known[i / 3] = 1;
    }
    return marks;
  }
  Marks marks;
  std::vector<std::vector<std::uint8_t>> values;
};

}  // namespace

Marks marks(std::span<const Picture> frames, std::span<const Tube> tubes, const chain::Chain& chain) {
  Cells cells(chain);
  for (std::size_t i = 0; i < frames.size(); ++i) {
    const math::Rectangle& box = tubes[i].box;
    for (int y = box.y0; y < box.y1; ++y)
      for (int x = box.x0; x < box.x1; ++x) cells.add(tubes[i], x, y, pixel(frames[i], x, y));
  }
  return cells.medians();
}

Marks marks(const capture::View& drawn, const Tube& tube, const chain::Chain& chain) {
  constexpr std::uint8_t kOpaque = 242;  // alpha of 0.95
  Cells cells(chain);
  for (int y = 0; y < drawn.height; ++y)
    for (int x = 0; x < drawn.width; ++x) {
      const std::uint8_t* const rgba = &drawn.rgba[4 * (static_cast<std::size_t>(y) * drawn.width + x)];
      if (rgba[3] >= kOpaque) cells.add(tube, drawn.x0 + x, drawn.y0 + y, rgba);
    }
  return cells.medians();
}

void count_colors(Look& appearance, const Picture& picture, const Tube& tube, const Reach& where,
                  const chain::Chain& chain, double margin, const capture::View* mask) {
  const auto masked = [&](int x, int y) {
    x -= mask->x0, y -= mask->y0;
    return x >= 0 && y >= 0 && x < mask->width && y < mask->height &&
           mask->rgba[4 * (static_cast<std::size_t>(y) * mask->width + x) + 3] != 0;
  };
  for (Colors* const colors : {&appearance.near, &appearance.far}) {
    if (colors->object.empty()) colors->object.assign(kColorBins, 0.0);
    if (colors->surroundings.empty()) colors->surroundings.assign(kColorBins, 0.0);
  }
  for (int y = where.box.y0; y < where.box.y1; ++y)
    for (int x = where.box.x0; x < where.box.x1; ++x) {
      const float outside = tube.at(x, y);
      const int bin = color_bin(pixel(picture, x, y));
      if (outside < -margin) {
        const double s = tube.arclength(x, y);
        if (s > chain.diameter && (!mask || masked(x, y)) && usual(appearance.marks, tube, picture, x, y))
          (s < 0.5 * chain.length ? appearance.near : appearance.far).object[bin] += 1.0;
      } else if (outside > margin && outside < Tube::kFar) {
        appearance.near.surroundings[bin] += 1.0;
        appearance.far.surroundings[bin] += 1.0;
      }
    }
}

Background median_background(std::span<const Picture> frames, std::span<const Tube> covered, int least) {
  Background out;
  if (frames.empty()) return out;
  const int width = frames[0].width, height = frames[0].height;
  out.rgb.assign(static_cast<std::size_t>(3) * width * height, 0);
  out.noise.assign(static_cast<std::size_t>(width) * height, 0);
  core::parallel_for(height, [&](std::int64_t row) {
    const int y = static_cast<int>(row);
    std::vector<std::uint8_t> values[3], away;
    for (int x = 0; x < width; ++x) {
      for (auto& channel : values) channel.clear();
      away.clear();
      for (std::size_t i = 0; i < frames.size(); ++i) {
        // a margin of one radius leaves out the rope's contact shadow and its soft outline
        if (i < covered.size() && covered[i].at(x, y) < covered[i].radius) continue;
        for (int c = 0; c < 3; ++c) values[c].push_back(pixel(frames[i], x, y)[c]);
      }
      if (static_cast<int>(values[0].size()) < least) continue;
      // median color, and noise from the median absolute deviation
      const std::size_t at = static_cast<std::size_t>(y) * width + x;
      for (int c = 0; c < 3; ++c) {
        const std::uint8_t middle = median(values[c]);
        out.rgb[3 * at + c] = middle;
        for (const std::uint8_t value : values[c])
          away.push_back(static_cast<std::uint8_t>(std::abs(static_cast<int>(value) - middle)));
      }
      constexpr double kDeviationOfMedian = 1.4826;  // standard over median absolute deviation of Gaussian noise
      out.noise[at] = noise_level(kDeviationOfMedian * median(away));
    }
  });
  return out;
}

Background empty_scene(const capture::Image8& empty, const Picture& now) {
  constexpr double kNoise = 4.0;  // gray levels, of one picture
  Background out;
  const std::size_t pixels = static_cast<std::size_t>(empty.width) * empty.height;
  const int step = empty.channels >= 3 ? 1 : 0;
  out.rgb.resize(3 * pixels);
  for (int c = 0; c < 3; ++c) {
    // the median of the brightness of all places that are neither dark nor overexposed; the rope covers few of them
    constexpr int kDark = 16, kBright = 250;
    constexpr std::size_t kEvery = 7;
    std::vector<double> ratios;
    for (std::size_t i = 0; i < pixels; i += kEvery) {
      const int before = empty.pixels[empty.channels * i + static_cast<std::size_t>(step * c)];
      const int after = now.pixels[now.channels * i + static_cast<std::size_t>(c)];
      if (before > kDark && before < kBright && after < kBright) ratios.push_back(static_cast<double>(after) / before);
    }
    const double exposure = ratios.empty() ? 1.0 : math::median(ratios);
    for (std::size_t i = 0; i < pixels; ++i)
      out.rgb[3 * i + c] = static_cast<std::uint8_t>(
          std::min(255.0, exposure * empty.pixels[empty.channels * i + static_cast<std::size_t>(step * c)] + 0.5));
  }
  out.noise.assign(pixels, noise_level(kNoise));
  return out;
}

capture::Image8 difference(const capture::Image8& empty, const Picture& now) {
  constexpr int kMagnified = 4;  // noise stays within one coarse color, a rope that is hardly seen does not
  const Background background = empty_scene(empty, now);
  capture::Image8 out{empty.width, empty.height, 3, std::vector<std::uint8_t>(background.rgb.size())};
  for (std::size_t i = 0; i < background.noise.size(); ++i)
    for (std::size_t c = 0; c < 3; ++c)
      out.pixels[3 * i + c] = static_cast<std::uint8_t>(
          std::min(255, kMagnified * std::abs(now.pixels[now.channels * i + c] - background.rgb[3 * i + c])));
  return out;
}

double difference_odds(const Background& background, const Picture& picture, int x, int y) {
  if (background.noise.empty()) return 0.0;
  const std::size_t at = static_cast<std::size_t>(y) * picture.width + x;
  if (background.noise[at] == 0) return 0.0;
  const std::uint8_t* const now = pixel(picture, x, y);
  const std::uint8_t* const then = &background.rgb[3 * at];
  double product = 0.0, square = 1.0;
  for (int c = 0; c < 3; ++c) product += now[c] * then[c], square += then[c] * then[c];
  // a shadow has the background's color with less light
  const double light = std::clamp(product / square, kDarkest, kBrightest);
  const double noise = background.noise[at];
  double difference = 0.0;
  for (int c = 0; c < 3; ++c) {
    const double d = now[c] - light * then[c], texture = kTexture * then[c];
    difference += d * d / (noise * noise + texture * texture);
  }
  return std::clamp(kOddsPerDifference * (difference - kSameDifference), kSurelySame, kSurelyOther);
}

void settle(Look& appearance) {
  settle(appearance.near);
  settle(appearance.far);
}

double color_odds(const Colors& colors, const std::uint8_t* rgb) {
  return colors.log_odds.empty() ? 0.0 : colors.log_odds[color_bin(rgb)];
}

}  // namespace chainsplat::masking
