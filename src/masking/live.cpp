// Masks of a stream: the same log odds, learned as the frames arrive.
#include <algorithm>
#include <cmath>
#include <opencv2/core.hpp>
#include <opencv2/imgproc.hpp>

#include "src/masking/grow.h"
#include "src/masking/look.h"

namespace chainsplat::masking {

namespace {

constexpr double kForget = 0.02;          // share of the background forgotten per frame: some two seconds at 30 Hz
constexpr int kLeastSeen = 8;             // number of frames before a background pixel is believed
constexpr double kFirstNoise = 4.0;       // gray levels, assumed in the first frame
constexpr double kGivenPixels = 3e4;      // weight of the colors passed to start(): the pixels of some ten frames
constexpr double kLeastGiven = 0.1;       // share of that weight that is never forgotten
constexpr double kAboutPixels = 24.0;     // px around the tube whose colors count as the rope's surroundings
constexpr double kDoubt = 2.0;            // for a prediction; with less, masks followed wrong ones of pushed ropes
constexpr double kLeastEvidence = 0.1;    // nats per sample, below which nothing is a rope
constexpr double kPredictedMargin = 0.7;  // px, by which the tube at a prediction may be off
constexpr int kColorEvery = 5;            // frames between two updates of the colors
constexpr double kForgetColors = 0.1;     // share of the counted colors forgotten per update

// Computes once, for cv::remap, from where every pixel without lens distortion comes.
void map_straight(Live& live) {
  const capture::Camera& camera = live.camera;
  cv::Mat wanted(camera.height, camera.width, CV_32FC2);
  for (int y = 0; y < camera.height; ++y)
    for (int x = 0; x < camera.width; ++x) {
      const math::Vector2 p = capture::distort(camera, math::Vector2(x + 0.5, y + 0.5)) - math::Vector2(0.5, 0.5);
      wanted.at<cv::Vec2f>(y, x) = {static_cast<float>(p.x()), static_cast<float>(p.y())};
    }
  const std::size_t pixels = static_cast<std::size_t>(camera.width) * camera.height;
  live.from.resize(2 * pixels);
  live.part.resize(pixels);
  cv::Mat from(camera.height, camera.width, CV_16SC2, live.from.data());
  cv::Mat part(camera.height, camera.width, CV_16UC1, live.part.data());
  cv::convertMaps(wanted, cv::noArray(), from, part, CV_16SC2);
}

// Removes the lens distortion of a recorded frame inside the box.
void straighten(const capture::Image8& image, const Box& box, Live& live) {
  live.straight.resize(image.pixels.size());
  const cv::Rect rect(box.x0, box.y0, box.width(), box.height());
  const int width = live.camera.width, height = live.camera.height;
  const cv::Mat recorded(height, width, CV_8UC3, const_cast<std::uint8_t*>(image.pixels.data()));
  cv::Mat out(height, width, CV_8UC3, live.straight.data());
  const cv::Mat from(height, width, CV_16SC2, live.from.data()), part(height, width, CV_16UC1, live.part.data());
  cv::Mat in_box = out(rect);
  cv::remap(recorded, in_box, from(rect), part(rect), cv::INTER_LINEAR, cv::BORDER_REPLICATE);
}

}  // namespace

Live start(const capture::Camera& camera, const chain::Chain& chain, const std::vector<std::uint8_t>& object_rgb) {
  Live live;
  live.camera = camera;
  live.chain = chain;
  live.given.assign(kColorBins, 0.0);
  const std::size_t samples = object_rgb.size() / 3;
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
  if (camera.distorted()) map_straight(live);
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
  // the undistorted picture, as far as the rope can reach
  capture::Camera camera = live.camera;
  camera.distortion = {};
  const Reach where = reach(live.chain, base, camera);
  if (where.box.empty()) return {};
  const std::vector<std::uint8_t>* pixels = &recorded.pixels;
  if (live.camera.distorted()) {
    straighten(recorded, where.box, live);
    pixels = &live.straight;
  }
  const Picture picture{pixels->data(), camera.width, camera.height, 3};
  if (live.frames == 0) {  // the first frame's colors count as surroundings, since the rope covers little of them
    for (int y = where.box.y0; y < where.box.y1; ++y)
      for (int x = where.box.x0; x < where.box.x1; ++x)
        live.look.near.surroundings[color_bin(pixel(picture, x, y))] += 1.0;
    live.look.far.surroundings = live.look.near.surroundings;
    settle(live.look);
  }
  // where the rope is expected, or else where a chain grown in this picture lies
  std::optional<math::VectorX> place = theta;
  const int joints = live.chain.links() - 1;
  if (!theta && (live.chain.angles() == joints || live.chain.angles() == 2 * joints)) {  // without twist joints
    const Shot shot{picture, &camera, camera.world_from_camera.inverse() * base, {}, {}};
    const Grown grown = grow(live.chain, {&shot, 1}, {});
    if (grown.evidence > kLeastEvidence) place = grown.theta;
  }
  capture::View view = cut(live.look, picture, camera, live.chain, base, place, kDoubt);
  ++live.frames;
  if (!theta) return view;

  // learn the background where the tube is not
  const Tube around = tube(live.chain, base, *theta, camera, 0.0, live.chain.length, kAboutPixels);
  Background& background = live.look.background;
  for (int y = where.box.y0; y < where.box.y1; ++y)
    for (int x = where.box.x0; x < where.box.x1; ++x) {
      if (around.at(x, y) < around.radius) continue;
      const std::size_t at = static_cast<std::size_t>(y) * camera.width + x;
      std::uint16_t& times_visible = live.seen[at];
      if (times_visible < UINT16_MAX) ++times_visible;
      const float share = static_cast<float>(std::max(kForget, 1.0 / times_visible));
      float square = 0.0f;
      for (int c = 0; c < 3; ++c) {
        float& mean = live.mean[3 * at + c];
        const float d = pixel(picture, x, y)[c] - mean;
        mean += share * d;
        square += d * d / 3.0f;
        background.rgb[3 * at + c] = static_cast<std::uint8_t>(mean + 0.5f);
      }
      float& variance = live.variance[at];
      if (times_visible == 1) square = static_cast<float>(kFirstNoise * kFirstNoise);
      variance += share * (square - variance);
      if (times_visible >= kLeastSeen) background.noise[at] = noise_level(std::sqrt(variance));
    }
  // learn the colors on either side of the tube's outline
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
