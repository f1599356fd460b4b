// Masks of a stream: the same votes, learned as the frames come.
#include <algorithm>
#include <cmath>

#include "src/masking/grow.h"
#include "src/masking/look.h"

namespace chainsplat::masking {

namespace {

constexpr double kForget = 0.02;          // of the background a frame: some two seconds at 30 Hz
constexpr int kLeastSeen = 8;             // frames, before a background pixel is believed
constexpr double kFirstNoise = 4.0;       // gray levels
constexpr double kGivenPixels = 3e4;      // the given colors count as so many pixels: some ten frames of a rope
constexpr double kLeastGiven = 0.1;       // share of them that is never forgotten
constexpr double kAboutPixels = 24.0;     // px about the tube that are told apart from what is far
constexpr double kDoubt = 2.0;            // a prediction is not as sure as a fit
constexpr double kLeastEvidence = 0.1;    // nats a sample: less is no rope
constexpr double kPredictedMargin = 0.7;  // px, by which the tube at a prediction may be off
constexpr int kColorEvery = 5;            // frames between two lessons in color
constexpr double kForgetColors = 0.1;     // of the counted colors a lesson

// The recorded frame without its lens distortion, in the box; elsewhere black.
void straighten(const capture::Image8& image, const capture::Camera& camera, const Box& box,
                std::vector<std::uint8_t>& out) {
  out.assign(image.pixels.size(), 0);
  for (int y = box.y0; y < box.y1; ++y)
    for (int x = box.x0; x < box.x1; ++x) {
      const math::Vector2 p = capture::distort(camera, math::Vector2(x + 0.5, y + 0.5)) - math::Vector2(0.5, 0.5);
      const double column = std::clamp(p.x(), 0.0, camera.width - 1.0),
                   row = std::clamp(p.y(), 0.0, camera.height - 1.0);
      const int u = static_cast<int>(column), v = static_cast<int>(row);
      const int right = std::min(u + 1, camera.width - 1), below = std::min(v + 1, camera.height - 1);
      const double a = column - u, b = row - v;
      const auto at = [&](int i, int j, int c) {
        return static_cast<double>(image.pixels[3 * (static_cast<std::size_t>(j) * camera.width + i) + c]);
      };
      for (int c = 0; c < 3; ++c)
        out[3 * (static_cast<std::size_t>(y) * camera.width + x) + c] =
            static_cast<std::uint8_t>(std::lround((1 - b) * ((1 - a) * at(u, v, c) + a * at(right, v, c)) +
                                                  b * ((1 - a) * at(u, below, c) + a * at(right, below, c))));
    }
}

}  // namespace

Live start(const capture::Camera& camera, const chain::Chain& chain, const std::vector<std::uint8_t>& object_rgb) {
  Live live;
  live.camera = camera;
  live.chain = chain;
  live.given.assign(kColorBins, 0.0);
  const double samples = static_cast<double>(object_rgb.size() / 3);
  for (std::size_t i = 0; i + 2 < object_rgb.size(); i += 3)
    live.given[color_bin(&object_rgb[i])] += kGivenPixels / samples;
  for (Colors* const colors : {&live.look.near, &live.look.far}) {
    colors->object = live.given;
    colors->surroundings.assign(kColorBins, 0.0);
  }
  const std::size_t pixels = static_cast<std::size_t>(camera.width) * camera.height;
  live.look.background.rgb.assign(3 * pixels, 0);
  live.look.background.noise.assign(pixels, 0);
  live.mean.assign(3 * pixels, 0.0f);
  live.variance.assign(pixels, 0.0f);
  live.seen.assign(pixels, 0);
  return live;
}

void learn_marks(Live& live, const capture::View& drawn, const math::Pose& base, const math::VectorX& theta) {
  capture::Camera camera = live.camera;
  camera.distortion = {};
  const Tube place = tube(live.chain, base, theta, camera, 0.0, live.chain.length, 0.0);
  live.look.marks = marks(drawn, place, live.chain);
}

capture::View mask(Live& live, const capture::Image8& recorded, const math::Pose& base,
                   const std::optional<math::VectorX>& theta) {
  capture::Camera camera = live.camera;
  camera.distortion = {};
  const Reach where = reach(live.chain, base, camera);
  if (where.box.empty()) return {};
  const std::vector<std::uint8_t>* pixels = &recorded.pixels;
  if (live.camera.distorted()) {
    straighten(recorded, live.camera, where.box, live.straight);
    pixels = &live.straight;
  }
  const Picture picture{pixels->data(), camera.width, camera.height, 3};
  if (live.frames == 0) {  // all that the rope can reach: mostly surroundings
    for (int y = where.box.y0; y < where.box.y1; ++y)
      for (int x = where.box.x0; x < where.box.x1; ++x)
        live.look.near.surroundings[color_bin(pixel(picture, x, y))] += 1.0;
    live.look.far.surroundings = live.look.near.surroundings;
    settle(live.look);
  }
  // where the rope is expected, or where it seems to be
  std::optional<math::VectorX> place = theta;
  const int joints = live.chain.links() - 1;
  if (!theta && (live.chain.angles() == joints || live.chain.angles() == 2 * joints)) {  // no twist
    const Shot shot{picture, &camera, camera.world_from_camera.inverse() * base};
    const Grown grown = grow(live.chain, {&shot, 1}, {});
    if (grown.evidence > kLeastEvidence) place = grown.theta;
  }
  capture::View view = cut(live.look, picture, camera, live.chain, base, place, kDoubt);
  ++live.frames;
  if (!theta) return view;

  // learn: background where the tube is not, colors on either side of its outline
  const Tube around = tube(live.chain, base, *theta, camera, 0.0, live.chain.length, kAboutPixels);
  Background& background = live.look.background;
  for (int y = where.box.y0; y < where.box.y1; ++y)
    for (int x = where.box.x0; x < where.box.x1; ++x) {
      if (around.at(x, y) < around.radius) continue;
      const std::size_t at = static_cast<std::size_t>(y) * camera.width + x;
      std::uint16_t& seen = live.seen[at];
      if (seen < UINT16_MAX) ++seen;
      const float share = static_cast<float>(std::max(kForget, 1.0 / seen));
      float square = 0.0f;
      for (int c = 0; c < 3; ++c) {
        float& mean = live.mean[3 * at + c];
        const float d = pixel(picture, x, y)[c] - mean;
        mean += share * d;
        square += d * d / 3.0f;
        background.rgb[3 * at + c] = static_cast<std::uint8_t>(std::lround(mean));
      }
      float& variance = live.variance[at];
      if (seen == 1) square = static_cast<float>(kFirstNoise * kFirstNoise);
      variance += share * (square - variance);
      if (seen >= kLeastSeen) background.noise[at] = noise_level(std::sqrt(variance));
    }
  if (live.frames % kColorEvery == 1) {
    for (Colors* const colors : {&live.look.near, &live.look.far})
      for (int i = 0; i < kColorBins; ++i) {
        colors->object[i] = std::max((1.0 - kForgetColors) * colors->object[i], kLeastGiven * live.given[i]);
        colors->surroundings[i] *= 1.0 - kForgetColors;
      }
    count_colors(live.look, picture, around, where, live.chain, kPredictedMargin, &view);
    settle(live.look);
  }
  return view;
}

}  // namespace chainsplat::masking
