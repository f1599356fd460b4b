// Masks of a stream: the same log odds, learned as the frames arrive.
#include <algorithm>
#include <array>
#include <cmath>
#include <future>
#include <opencv2/core.hpp>
#include <opencv2/imgproc.hpp>

#include "chainsplat/masking.h"
#include "src/masking/cut.h"
#include "src/masking/grow.h"

namespace chainsplat::masking {

namespace {

// Once it is known, a row of the background is learned in every fourth frame: it changes slowly, and learning it is
// most of what the frames teach.
constexpr int kRowsEvery = 4;
constexpr double kForget = 0.08;          // share of it forgotten each time: some two seconds at 30 Hz
constexpr int kMostSeen = 13;             // times that a pixel was seen; after so many only kForget counts
constexpr int kAllRows = 16;              // first frames that teach every row
constexpr double kFirstNoise = 4.0;       // gray levels, assumed in the first frame
constexpr double kGivenPixels = 3e4;      // weight of the colors that are given: the pixels of some ten frames
constexpr double kLeastGiven = 0.1;       // share of that weight that is never forgotten
constexpr double kAboutPixels = 24.0;     // px around the tube whose colors count as the rope's surroundings
constexpr double kDoubt = 2.0;            // for a prediction; with less, masks followed wrong ones of pushed ropes
constexpr double kLeastEvidence = 0.1;    // nats per sample, below which nothing is a rope
constexpr double kPredictedMargin = 0.7;  // px, by which the tube at a prediction may be off
constexpr int kColorEvery = 5;            // frames between two updates of the colors,
constexpr int kColorFirst = 3;            // from this one on, not in those in which callers learn marks
constexpr double kForgetColors = 0.1;     // share of the counted colors forgotten per update

double most_radius(const Axis& line) {
  double most = 0.0;
  for (const AxisPoint& point : line.points) most = std::max(most, point.radius);
  return most;
}

}  // namespace

struct LiveMasks::State {
  // Where the next mask is looked for, if that was known before its picture.
  struct Ahead {
    math::Pose base;
    math::VectorX theta;
    Tube tube;
    bool is(const math::Pose& pose, const math::VectorX& angles) const {
      constexpr double kSame = 1e-9;  // m and rad: the times of the two were rounded differently
      return (base.rotation - pose.rotation).cwiseAbs().maxCoeff() < kSame &&
             (base.translation - pose.translation).cwiseAbs().maxCoeff() < kSame && theta.size() == angles.size() &&
             (theta - angles).cwiseAbs().maxCoeff() < kSame;
    }
  };

  State(const capture::Camera& recorded, const chain::Chain& rope, const std::vector<std::uint8_t>& object_rgb);

  capture::Camera camera;   // as recorded, with its lens distortion
  capture::Camera pinhole;  // the same without it, of undistorted pixels
  chain::Chain chain;
  Look look;
  std::vector<float> mean, variance;   // of the background, per channel and per pixel
  std::vector<std::uint16_t> seen;     // number of frames in which the background was visible, per pixel
  std::vector<double> given;           // counts of the rope's colors that were given
  std::vector<std::uint8_t> straight;  // the last frame without its lens distortion
  std::vector<std::int16_t> from;      // its source for cv::remap, per pixel: column and row of the recorded frame,
  std::vector<std::uint16_t> part;     // and the interpolation's index into OpenCV's table of weights
  int frames = 0;
  std::optional<Ahead> ahead;
  // What the last frame teaches, beside what is done with its mask: the filter waits for the device, and the next frame
  // for the camera. Declared last: it ends before what it works on.
  std::future<void> learning;

  Tube expected(const math::Pose& base, const math::VectorX& theta) const {
    return expected_tube(chain, base, theta, pinhole, kDoubt);
  }
  void map_straight();
  Picture straightened(const capture::Image8& recorded, const math::Rectangle& box);
  void end_learning() {
    if (learning.valid()) learning.get();
  }
  void learn_first_frame(const Picture& picture, const math::Rectangle& box);
  std::optional<Grown> found_in(const Picture& picture, const math::Pose& base, const LiveStart& start) const;
  void learn_background(const Picture& picture, const math::Rectangle& box, const Tube& around);
  void learn_colors(const Picture& picture, const Reach& where, const Tube& around, const capture::View& mask);
};

LiveMasks::State::State(const capture::Camera& recorded, const chain::Chain& rope,
                        const std::vector<std::uint8_t>& object_rgb)
    : camera(recorded), pinhole(recorded), chain(rope) {
  pinhole.distortion = {};
  given.assign(kColorBins, 0.0);
  const std::size_t samples = object_rgb.size() / 3;
  for (std::size_t i = 0; i + 2 < object_rgb.size(); i += 3) given[color_bin(&object_rgb[i])] += kGivenPixels / samples;
  for (Colors* const colors : {&look.near, &look.far}) {
    colors->object = given;
    colors->surroundings.assign(kColorBins, 0.0);
  }
  const std::size_t pixels = static_cast<std::size_t>(camera.width) * camera.height;
  look.background.rgb.assign(3 * pixels, 0);
  look.background.noise.assign(pixels, 0);
  mean.assign(3 * pixels, 0.0f);
  variance.assign(pixels, 0.0f);
  seen.assign(pixels, 0);
  if (camera.distorted()) map_straight();
}

// Computes once, for cv::remap, from where every pixel without lens distortion comes.
void LiveMasks::State::map_straight() {
  cv::Mat wanted(camera.height, camera.width, CV_32FC2);
  for (int y = 0; y < camera.height; ++y)
    for (int x = 0; x < camera.width; ++x) {
      const math::Vector2 p = capture::distort(camera, math::Vector2(x + 0.5, y + 0.5)) - math::Vector2(0.5, 0.5);
      wanted.at<cv::Vec2f>(y, x) = {static_cast<float>(p.x()), static_cast<float>(p.y())};
    }
  from.resize(2 * seen.size());
  part.resize(seen.size());
  cv::Mat whole(camera.height, camera.width, CV_16SC2, from.data());
  cv::Mat rest(camera.height, camera.width, CV_16UC1, part.data());
  cv::convertMaps(wanted, cv::noArray(), whole, rest, CV_16SC2);
}

// A copy of the frame without its lens distortion, inside the box. It is seen until the next one.
Picture LiveMasks::State::straightened(const capture::Image8& recorded, const math::Rectangle& box) {
  const int width = camera.width, height = camera.height;
  straight.resize(recorded.pixels.size());
  if (!camera.distorted()) {
    for (int y = box.y0; y < box.y1; ++y) {
      const std::size_t first = 3 * (static_cast<std::size_t>(y) * width + box.x0);
      std::copy_n(&recorded.pixels[first], 3 * box.width(), &straight[first]);
    }
    return {straight.data(), width, height, 3};
  }
  const cv::Rect rect(box.x0, box.y0, box.width(), box.height());
  const cv::Mat image(height, width, CV_8UC3, const_cast<std::uint8_t*>(recorded.pixels.data()));
  cv::Mat out(height, width, CV_8UC3, straight.data());
  const cv::Mat whole(height, width, CV_16SC2, from.data()), rest(height, width, CV_16UC1, part.data());
  cv::Mat in_box = out(rect);
  cv::remap(image, in_box, whole(rect), rest(rect), cv::INTER_LINEAR, cv::BORDER_REPLICATE);
  return {straight.data(), width, height, 3};
}

// The first frame's colors count as surroundings, since the rope covers little of them.
void LiveMasks::State::learn_first_frame(const Picture& picture, const math::Rectangle& box) {
  for (int y = box.y0; y < box.y1; ++y)
    for (int x = box.x0; x < box.x1; ++x) look.near.surroundings[color_bin(pixel(picture, x, y))] += 1.0;
  look.far.surroundings = look.near.surroundings;
  settle(look);
}

// The rope in this picture; none where nothing is a rope, and for chains with twist joints.
std::optional<Grown> LiveMasks::State::found_in(const Picture& picture, const math::Pose& base,
                                                const LiveStart& start) const {
  const int joints = chain.links() - 1;
  if (chain.angles() != joints && chain.angles() != 2 * joints) return {};
  const Shot shot{picture, &pinhole, pinhole.world_from_camera.inverse() * base, {}, {}};
  Clues clues;
  clues.shape = start.resting;
  clues.grasp_deviation = start.grasp_deviation;
  Grown grown = grow(chain, {&shot, 1}, {}, clues);
  return grown.evidence > kLeastEvidence ? std::optional(std::move(grown)) : std::nullopt;
}

// Learns the background in the box where the tube is not.
void LiveMasks::State::learn_background(const Picture& picture, const math::Rectangle& box, const Tube& around) {
  static const std::array<float, kMostSeen + 1> share = [] {
    std::array<float, kMostSeen + 1> of{};
    for (int i = 1; i <= kMostSeen; ++i) of[i] = static_cast<float>(std::max(kForget, 1.0 / i));
    return of;
  }();
  Background& background = look.background;
  const auto learn = [&](int y, int x0, int x1) {
    for (int x = x0; x < x1; ++x) {
      const std::size_t at = static_cast<std::size_t>(y) * picture.width + x;
      if (seen[at] < kMostSeen) ++seen[at];
      const float weight = share[seen[at]];
      const std::uint8_t* const now = picture.pixels + 3 * at;
      float square = 0.0f;
      for (int c = 0; c < 3; ++c) {
        float& channel = mean[3 * at + c];
        const float d = now[c] - channel;
        channel += weight * d;
        square += d * d / 3.0f;
        background.rgb[3 * at + c] = static_cast<std::uint8_t>(channel + 0.5f);
      }
      if (seen[at] == 1) square = static_cast<float>(kFirstNoise * kFirstNoise);
      variance[at] += weight * (square - variance[at]);
      if (seen[at] >= kBackgroundFrames) background.noise[at] = noise_level(std::sqrt(variance[at]));
    }
  };
  const math::Rectangle tube = intersection(box, around.box);
  for (int y = box.y0; y < box.y1; ++y) {
    if (frames > kAllRows && (y + frames) % kRowsEvery != 0) continue;
    if (tube.empty() || y < tube.y0 || y >= tube.y1) {
      learn(y, box.x0, box.x1);
      continue;
    }
    learn(y, box.x0, tube.x0);
    for (int x = tube.x0; x < tube.x1; ++x)
      if (!(around.at(x, y) < around.radius)) learn(y, x, x + 1);
    learn(y, tube.x1, box.x1);
  }
}

// Learns the colors on either side of the tube's outline.
void LiveMasks::State::learn_colors(const Picture& picture, const Reach& where, const Tube& around,
                                    const capture::View& mask) {
  for (Colors* const colors : {&look.near, &look.far})
    for (int i = 0; i < kColorBins; ++i) {
      colors->object[i] = std::max((1.0 - kForgetColors) * colors->object[i], kLeastGiven * given[i]);
      colors->surroundings[i] *= 1.0 - kForgetColors;
    }
  count_colors(look, picture, around, where, chain, kPredictedMargin, &mask);
  settle(look);
}

LiveMasks::LiveMasks(const capture::Camera& camera, const chain::Chain& chain,
                     const std::vector<std::uint8_t>& object_rgb)
    : state_(std::make_unique<State>(camera, chain, object_rgb)) {}
LiveMasks::~LiveMasks() = default;

void LiveMasks::learn_marks(const capture::View& drawn, const math::Pose& base, const math::VectorX& theta) {
  State& s = *state_;
  s.end_learning();
  s.look.marks = marks(drawn, tube(s.chain, base, theta, s.pinhole, 0.0, s.chain.length, 0.0), s.chain);
}

void LiveMasks::see_from(const math::Pose& world_from_camera) {
  State& s = *state_;
  if (world_from_camera.rotation == s.pinhole.world_from_camera.rotation &&
      world_from_camera.translation == s.pinhole.world_from_camera.translation)
    return;
  s.end_learning();
  s.camera.world_from_camera = s.pinhole.world_from_camera = world_from_camera;
  s.ahead.reset();
}

void LiveMasks::expect(const math::Pose& base, const math::VectorX& theta) {
  state_->ahead = State::Ahead{base, theta, state_->expected(base, theta)};
}

capture::View LiveMasks::mask(const capture::Image8& recorded, const math::Pose& given,
                              const std::optional<math::VectorX>& theta, const LiveStart& start) {
  State& s = *state_;
  s.end_learning();
  math::Pose base = given;
  const Reach where = reach(s.chain, base, s.pinhole);
  if (where.box.empty()) return {};
  const Picture picture = s.straightened(recorded, where.box);
  if (s.frames == 0) s.learn_first_frame(picture, where.box);
  std::optional<math::VectorX> place = theta;
  if (!theta)
    if (std::optional<Grown> found = s.found_in(picture, base, start)) {
      place = std::move(found->theta);
      base.translation += base.rotation * found->shift;
    }
  Tube tube;
  if (place) tube = s.ahead && s.ahead->is(base, *place) ? std::move(s.ahead->tube) : s.expected(base, *place);
  s.ahead.reset();
  capture::View view = cut(s.look, picture, s.pinhole, s.chain, base, place ? &tube : nullptr, kDoubt);
  ++s.frames;
  if (!theta) return view;
  const bool colors = s.frames % kColorEvery == kColorFirst;
  s.learning = std::async(std::launch::async, [&s, picture, where, base, angles = *theta,
                                               mask = colors ? view : capture::View{}, colors] {
    // the background begins a radius beside the rope; colors are compared farther from it
    const Axis line = axis(s.chain, base, angles, s.pinhole, 0.0, s.chain.length);
    const Tube around = masking::tube(line, s.camera.width, s.camera.height, colors ? kAboutPixels : most_radius(line));
    s.learn_background(picture, where.box, around);
    if (colors) s.learn_colors(picture, where, around, mask);
  });
  return view;
}

int LiveMasks::frames() const { return state_->frames; }

}  // namespace chainsplat::masking
