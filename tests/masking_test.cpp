// Tests of masks made without prompts against the exact masks of the demo capture, and of the parts they are made of
// against geometry done by hand.
#include "chainsplat/masking.h"

#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <random>

#include "chainsplat/silhouette.h"
#include "src/masking/cut.h"
#include "src/masking/grow.h"
#include "src/masking/look.h"
#include "src/masking/one_rope.h"
#include "src/masking/ribbon.h"

namespace {

using namespace chainsplat;
using math::Vector3;
using math::VectorX;

const Path kDemo = Path(CHAINSPLAT_SOURCE_DIR) / "assets/demo_free_30";

capture::Camera front_camera() {  // at the origin, looking along the world's z
  capture::Camera camera;
  camera.name = "front";
  camera.width = 200, camera.height = 150;
  camera.fx = camera.fy = 200.0;
  camera.cx = 100.0, camera.cy = 75.0;
  return camera;
}

double iou(const capture::Image8& a, const capture::Image8& b) {
  double both = 0, either = 0;
  for (std::size_t i = 0; i < a.pixels.size(); ++i) {
    both += a.pixels[i] >= 128 && b.pixels[i] >= 128;
    either += a.pixels[i] >= 128 || b.pixels[i] >= 128;
  }
  return either > 0 ? both / either : 1.0;
}

capture::Image8 given_mask(int camera, int frame) {
  char name[64];
  std::snprintf(name, sizeof name, "masks/cam%d/%06d.png", camera, frame);
  return capture::read_image8(kDemo / name);
}

TEST_CASE("no labels of a box cost less than the least cut's") {
  constexpr int kSide = 4, kPixels = kSide * kSide;
  std::mt19937 random(7);
  std::uniform_int_distribution<int> gray(0, 60);
  for (const double size : {0.3, 3.0, 9.0, 30.0}) {  // of the log odds: nearly none decides its pixel, nearly all do
    std::normal_distribution<float> odds_of(0.0f, static_cast<float>(size));
    for (int round = 0; round < 5; ++round) {
      std::vector<std::uint8_t> rgb(3 * kPixels);
      for (std::uint8_t& value : rgb) value = static_cast<std::uint8_t>(gray(random));
      std::vector<float> odds(kPixels);
      for (float& value : odds) value = odds_of(random);
      const int out = round == 0 ? -1 : 3 * round;  // a pixel that takes no part
      if (out >= 0) odds[out] = std::nanf("");

      // contours between neighbors, by the definition
      struct Pair {
        int a, b;
        double cost;
      };
      std::vector<Pair> pairs;
      double sum = 0.0;
      for (int a = 0; a < kPixels; ++a)
        for (int b = a + 1; b < kPixels; ++b) {
          const int x = std::abs(a % kSide - b % kSide), y = std::abs(a / kSide - b / kSide);
          if (x > 1 || y > 1 || a == out || b == out) continue;
          double difference = 0.0;
          for (int c = 0; c < 3; ++c) difference += std::pow(rgb[3 * a + c] - rgb[3 * b + c], 2);
          sum += difference;
          pairs.push_back({a, b, x + y == 2 ? -difference : difference});  // a diagonal one is marked by its sign
        }
      const double mean = sum / static_cast<double>(pairs.size());
      for (Pair& pair : pairs)
        pair.cost = masking::kContour * std::exp(-std::abs(pair.cost) / (2.0 * mean)) *
                    (std::signbit(pair.cost) ? std::sqrt(0.5) : 1.0);
      const auto cost = [&](unsigned labels) {
        double total = 0.0;
        for (int i = 0; i < kPixels; ++i)
          if (i != out) total += std::max(0.0f, (labels >> i & 1u) != 0u ? -odds[i] : odds[i]);
        for (const Pair& pair : pairs)
          if ((labels >> pair.a & 1u) != (labels >> pair.b & 1u)) total += pair.cost;
        return total;
      };

      const masking::Picture picture{rgb.data(), kSide, kSide, 3};
      const std::vector<std::uint8_t> found = masking::least_cut(picture, {0, 0, kSide, kSide}, odds);
      unsigned labels = 0;
      for (int i = 0; i < kPixels; ++i) labels |= found[i] != 0 ? 1u << i : 0u;
      if (out >= 0) CHECK(found[out] == 0);
      double least = cost(0);
      for (unsigned other = 1; other < 1u << kPixels; ++other)
        if (out < 0 || (other >> out & 1u) == 0u) least = std::min(least, cost(other));
      CHECK(cost(labels) == doctest::Approx(least).epsilon(1e-9));
    }
  }
}

TEST_CASE("the tube of a straight rope is a rectangle with the right sides") {
  // 0.2 m long along +x, 0.02 m thick, 1 m away: 40 px by 4 px, from column 80 to 120, about row 75
  const chain::Chain rope =
      chain::make_chain(0.2, 0.02, Vector3::UnitX(), Vector3::UnitY(), 4, chain::Bending::planar, false);
  math::Pose base;
  base.translation = Vector3(-0.1, 0.0, 1.0);
  const masking::Tube tube = masking::tube(rope, base, VectorX::Zero(4), front_camera(), 0.0, rope.length, 6.0);
  CHECK(tube.radius == doctest::Approx(2.0));
  CHECK(tube.at(100, 74) == doctest::Approx(0.5 - 2.0).epsilon(0.01));  // its center is half a pixel above the axis
  CHECK(tube.at(100, 79) == doctest::Approx(4.5 - 2.0).epsilon(0.01));  // and 4.5 px below the axis
  // the free end's disc is seen at an angle of 0.1 rad: an ellipse that reaches sin(0.1) 2 px beyond its center
  const double disc = 2.0 * std::sin(std::atan(0.1)) * std::sqrt(1.0 - 0.25 * 0.25);
  CHECK(tube.at(122, 74) == doctest::Approx(122.5 - 120 - disc).epsilon(0.01));  // beyond the free end
  CHECK(tube.at(119, 74) == doctest::Approx(-0.5 - disc).epsilon(0.01));         // just before it
  CHECK(tube.at(100, 90) == masking::Tube::kFar);
  CHECK(tube.arclength(100, 74) == doctest::Approx(0.1 + 0.5 / 200).epsilon(0.01));
}

TEST_CASE("colors that only the rope has speak for it, others against it, unknown ones hardly") {
  masking::Colors colors;
  colors.object.assign(masking::kColorBins, 0.0);
  colors.surroundings.assign(masking::kColorBins, 0.0);
  const std::uint8_t red[] = {200, 30, 30}, gray[] = {120, 120, 120}, green[] = {30, 200, 30};
  colors.object[masking::color_bin(red)] = 900;
  colors.object[masking::color_bin(gray)] = 100;
  colors.surroundings[masking::color_bin(gray)] = 1000;
  masking::settle(colors);
  CHECK(masking::color_odds(colors, red) > 2.0);
  CHECK(masking::color_odds(colors, gray) == doctest::Approx(std::log(0.1)).epsilon(0.05));
  CHECK(std::abs(masking::color_odds(colors, green)) < 0.1);
}

TEST_CASE("a shadow is background, another color is not") {
  masking::Background background;
  background.rgb = {160, 120, 80, 160, 120, 80, 160, 120, 80};
  background.noise = {2, 2, 0};
  const std::uint8_t now[] = {80, 60, 40, 60, 60, 160, 0, 0, 0};
  const masking::Picture picture{now, 3, 1, 3};
  CHECK(masking::difference_odds(background, picture, 0, 0) < 0.0);
  CHECK(masking::difference_odds(background, picture, 1, 0) > 0.0);
  CHECK(masking::difference_odds(background, picture, 2, 0) == 0.0);  // the background is unknown there
}

TEST_CASE("what hides the rope has not its marks, though its colors are thought to be the rope's") {
  // a striped rope of 160 px by 16 px on gray, from column 20 to 180, about row 75, with a finger that reaches over its
  // middle from above
  const chain::Chain rope =
      chain::make_chain(0.2, 0.02, Vector3::UnitX(), Vector3::UnitY(), 4, chain::Bending::planar, false);
  math::Pose base;
  base.translation = Vector3(-0.1, 0.0, 0.25);
  const VectorX straight = VectorX::Zero(4);
  const capture::Camera camera = front_camera();
  const std::uint8_t red[] = {160, 40, 40}, white[] = {200, 200, 200}, gray[] = {80, 80, 80}, skin[] = {160, 120, 96};
  const auto is_rope = [](int x, int y) { return x >= 20 && x < 180 && y >= 67 && y < 83; };
  const auto is_finger = [](int x, int y) { return x >= 90 && x < 115 && y < 90; };
  std::vector<std::uint8_t> clean, hidden;
  masking::Look appearance;
  for (masking::Colors* const colors : {&appearance.near, &appearance.far}) {
    colors->object.assign(masking::kColorBins, 0.0);
    colors->surroundings.assign(masking::kColorBins, 0.0);
    for (const std::uint8_t* const color : {red, white, skin}) colors->object[masking::color_bin(color)] = 500;
    colors->surroundings[masking::color_bin(gray)] = 1000;
    colors->surroundings[masking::color_bin(skin)] = 300;
    masking::settle(*colors);
  }
  for (int y = 0; y < camera.height; ++y)
    for (int x = 0; x < camera.width; ++x) {
      const std::uint8_t* const color = !is_rope(x, y) ? gray : (x / 10) % 2 ? red : white;
      for (int c = 0; c < 3; ++c) clean.push_back(static_cast<std::uint8_t>(color[c] * 10 / 8));  // in more light
      const std::uint8_t* const in_front = is_finger(x, y) ? skin : color;
      hidden.insert(hidden.end(), in_front, in_front + 3);
    }
  const masking::Picture before{clean.data(), 200, 150, 3}, now{hidden.data(), 200, 150, 3};
  // the shares that count as rope: of the finger over the rope, and of the rest of the rope
  const auto finger_share = [&] {
    const capture::View mask = masking::cut(appearance, now, camera, rope, base, straight);
    double finger = 0.0, fingers = 0.0, masked_rest = 0.0, rest = 0.0;
    for (int y = 70; y < 80; ++y)
      for (int x = 25; x < 175; ++x) {
        const int u = x - mask.x0, v = y - mask.y0;
        const bool inside =
            u >= 0 && v >= 0 && u < mask.width && v < mask.height && mask.rgba[4 * (v * mask.width + u) + 3];
        (is_finger(x, y) ? finger : masked_rest) += inside, (is_finger(x, y) ? fingers : rest) += 1.0;
      }
    return std::pair(finger / fingers, masked_rest / rest);
  };
  CHECK(finger_share().first > 0.8);
  const masking::Tube tube = masking::tube(rope, base, straight, camera, 0.0, rope.length, 8.0);
  CHECK(tube.is_left(100, 70) != tube.is_left(100, 80));
  appearance.marks = masking::marks({&before, 1}, {&tube, 1}, rope);
  CHECK(finger_share().first < 0.2);
  CHECK(finger_share().second > 0.9);
}

// All of the masking over a whole recording: of the suite "whole".
TEST_CASE("masks of the demo capture without a prompt" * doctest::test_suite("whole")) {
  double sum = 0.0, least = 1.0;
  int frames = 0, poor = 0;
  const masking::Summary summary =
      masking::make(kDemo, {}, {}, [&](int camera, int frame, const capture::Image8& mask, double score) {
        CHECK(mask.channels == 1);
        poor += score < masking::kDoubtful;
        const double one = iou(mask, given_mask(camera, frame));
        sum += one;
        least = std::min(least, one);
        ++frames;
      });
  CHECK(frames == 180);
  CHECK(summary.frames == 180);
  CHECK(summary.empty == 0);
  CHECK(summary.inside > 0.9);
  CHECK(poor <= 9);  // of masks that are all right
  MESSAGE("IoU mean ", sum / frames, ", least ", least);
  // the rope is 7 px wide here, so that half a pixel too much on either side gives 0.87
  CHECK(sum / frames > 0.88);
  CHECK(least > 0.8);
}

// All of the masking over a whole recording: of the suite "whole".
TEST_CASE("masks while the base rests: nothing that moves is needed" * doctest::test_suite("whole")) {
  double sum = 0.0;
  const capture::FrameRange pause{22, 28};  // the gripper turns around
  const masking::Summary summary = masking::make(
      kDemo, pause, {},
      [&](int camera, int frame, const capture::Image8& mask, double) { sum += iou(mask, given_mask(camera, frame)); });
  CHECK(summary.frames == 18);
  CHECK(summary.inside > 0.9);
  CHECK(sum / 18 > 0.85);
}

TEST_CASE("a rope grown in one moment is where the rope is") {
  capture::LoadOptions facts;
  facts.images = false;
  const capture::Capture scene = capture::load(kDemo, facts);
  REQUIRE(scene.cameras.size() == 3);
  std::vector<capture::Frame> frames;
  for (const capture::Camera& camera : scene.cameras)
    frames.push_back(*capture::FrameReader(kDemo, camera.name, {30, 31}, capture::Pixels::undistorted).next());
  std::vector<masking::Shot> shots;
  for (std::size_t c = 0; c < frames.size(); ++c)
    shots.push_back({{frames[c].picture.pixels.data(), frames[c].picture.width, frames[c].picture.height, 3},
                     &scene.cameras[c],
                     scene.cameras[c].world_from_camera.inverse() * scene.base.pose(frames[c].time),
                     {},
                     {}});
  const chain::Chain rope = chain::make_chain(scene.length, scene.diameter, scene.direction, scene.bending_axis, 10,
                                              chain::Bending::spatial, false);
  const masking::Grown grown = masking::grow(rope, shots, {});
  CHECK(grown.evidence > 0.25);
  const auto truth = capture::load_true_centerline(kDemo);
  REQUIRE(truth);
  const math::MatrixX line =
      chain::centerline(rope, chain::link_motions(rope, grown.theta, scene.base.pose(frames[0].time)),
                        chain::equal_arclengths(rope, static_cast<int>(truth->points[30].cols())));
  const double rms = std::sqrt((line - truth->points[30]).colwise().squaredNorm().mean());
  MESSAGE("grown: ", 1e3 * rms, " mm");
  CHECK(rms < 0.005);

  // beside the rope there is little evidence
  for (masking::Shot& shot : shots) shot.camera_from_base.translation += Vector3(0.12, 0.0, 0.0);
  CHECK(masking::grow(rope, shots, {}).evidence < 0.5 * grown.evidence);
}

// A gray wall, dark from column 130 on, in front of which a dark cable of 6 px hangs at column `at` from row 20 to 250,
// with a connector of 14 px in its last 30 rows. 1 px is 1 mm at the cable's distance of 0.2 m.
std::vector<std::uint8_t> wall_with_cable(double at, bool cable = true) {
  std::vector<std::uint8_t> out;
  for (int y = 0; y < 300; ++y)
    for (int x = 0; x < 200; ++x) {
      double half = y < 20 || y >= 250 || !cable ? 0.0 : y < 220 ? 3.0 : 7.0;
      double covered = 0.0;  // by the cable, of the pixel
      for (int k = 0; k < 8; ++k) covered += (std::abs(x + (k + 0.5) / 8 - at) < half) / 8.0;
      const double wall = x >= 130 ? 30.0 : 200.0, grain = 2.0 * ((x * 7 + y * 13) % 5 - 2);
      for (int c = 0; c < 3; ++c)
        out.push_back(static_cast<std::uint8_t>(wall + covered * (50.0 - wall) + grain + 8.0));
    }
  return out;
}
capture::Camera wall_camera() {
  capture::Camera camera = front_camera();
  camera.width = 200, camera.height = 300, camera.cx = 100.0, camera.cy = 20.0;
  return camera;
}

TEST_CASE("a ribbon finds outlines, connector and end; what has one side only, or changes its color, scores low") {
  const std::vector<std::uint8_t> pixels = wall_with_cable(100.3);
  const masking::Picture picture{pixels.data(), 200, 300, 3};
  masking::Axis rough;  // 1.8 px beside the cable, and 5 px too short
  for (int i = 0; i <= 75; ++i) rough.points.push_back({{102.1, 20.0 + 3.0 * i}, 3.0, 3e-3 * i});
  const masking::Ribbon ribbon = masking::find_ribbon({}, picture, rough, 0.225);
  REQUIRE(ribbon.axis.points.size() > 20);
  CHECK(ribbon.width == doctest::Approx(1.0).epsilon(0.15));
  for (const masking::AxisPoint& p : ribbon.axis.points) {
    CAPTURE(p.arclength);
    if (p.at.y() < 212 || p.at.y() > 227) CHECK(p.at.x() == doctest::Approx(100.3).epsilon(0.008));
    if (p.at.y() < 212) CHECK(p.radius == doctest::Approx(3.0).epsilon(0.25));
    if (p.at.y() > 230 && p.at.y() < 245) CHECK(p.radius == doctest::Approx(7.0).epsilon(0.2));
  }
  CHECK(ribbon.axis.points.back().at.y() == doctest::Approx(250).epsilon(0.015));
  CHECK(masking::score(masking::evidence(picture, ribbon.axis)) > masking::kDoubtful);
  const auto straight = [](double x) {
    masking::Axis axis;
    for (int i = 0; i <= 75; ++i) axis.points.push_back({{x, 20.0 + 3.0 * i}, 3.0, 3e-3 * i});
    return axis;
  };
  CHECK(masking::score(masking::evidence(picture, straight(127.0))) < 0.2);  // the window's edge
  CHECK(masking::score(masking::evidence(picture, straight(60.0))) < 0.2);   // nothing
  masking::Axis leaving = straight(100.3);
  for (std::size_t i = 45; i < leaving.points.size(); ++i) leaving.points[i].at.x() -= 1.5 * (i - 45.0);
  CHECK(masking::score(masking::evidence(picture, leaving)) < masking::kDoubtful);
  // another cable from a third of the length on, of colors that differ more than marks of this one would
  std::vector<std::uint8_t> other = pixels;
  for (int y = 100; y < 300; ++y)
    for (int x = 90; x < 111; ++x)
      for (int c = 0; c < 3; ++c) {
        std::uint8_t& value = other[3 * (y * 200 + x) + c];
        if (value < 150) value = static_cast<std::uint8_t>(value + 50 + (y - 100) / 2);
      }
  const masking::Picture over{other.data(), 200, 300, 3};
  CHECK(masking::score(masking::evidence(over, ribbon.axis)) < masking::kDoubtful);
  // a place beside the cable, of which the user says that it lies on the rope
  masking::RibbonOptions pointed;
  pointed.through = {{107.0, 120.5}};
  const masking::Ribbon through = masking::find_ribbon({}, picture, rough, 0.225, pointed);
  const auto beside = [](const masking::Ribbon& of) {  // px, by which the place is outside
    const auto& points = of.axis.points;
    const auto nearest = std::min_element(points.begin(), points.end(), [](const auto& a, const auto& b) {
      return std::abs(a.at.y() - 120.5) < std::abs(b.at.y() - 120.5);
    });
    return 107.0 - nearest->at.x() - nearest->radius;
  };
  CHECK(beside(ribbon) > 3.0);
  CHECK(beside(through) < 1.0);
}

TEST_CASE("the blur of a step is no thin rope") {
  // a wall that is dark from column 100 on, blurred over 3 px, and a cable of 2.5 px at column 60
  std::vector<std::uint8_t> pixels;
  for (int y = 0; y < 300; ++y)
    for (int x = 0; x < 200; ++x) {
      const double dark = std::clamp((x + 0.5 - 98.5) / 3.0, 0.0, 1.0);
      const double cable = std::clamp(1.75 - std::abs(x + 0.5 - 60.0), 0.0, 1.0);
      const double value = 200.0 - 160.0 * dark - 100.0 * cable;
      for (int c = 0; c < 3; ++c) pixels.push_back(static_cast<std::uint8_t>(value + (x * 7 + y * 13) % 5 - 2));
    }
  const masking::Picture picture{pixels.data(), 200, 300, 3};
  const auto score_at = [&](double x) {
    masking::Axis axis;
    for (int i = 0; i <= 75; ++i) axis.points.push_back({{x, 20.0 + 3.0 * i}, 1.25, 3e-3 * i});
    return masking::score(masking::evidence(picture, axis));
  };
  CHECK(score_at(100.0) < 0.3);
  CHECK(score_at(60.0) > masking::kDoubtful);
}

// A wall with a straight tube of one color from row 20 to 250, its axis at column `at`, `radius` px wide, lit from the
// front and a quarter of a right angle to its left. Sampled eight times per pixel and blurred by a lens of 0.9 px.
std::vector<std::uint8_t> wall_with_tube(double at, double radius) {
  constexpr double kAmbient = 0.45, kTurn = M_PI / 8, kBlur = 0.9;
  constexpr int kSamples = 8, kWidth = 200;
  const std::array<double, 3> rope{210, 90, 160}, wall{120, 140, 100};
  std::vector<std::array<double, 3>> fine(static_cast<std::size_t>(kSamples * kWidth));
  for (std::size_t i = 0; i < fine.size(); ++i) {
    const double across = ((static_cast<double>(i) + 0.5) / kSamples - at) / radius;
    const double normal_to_light =
        std::abs(across) < 1.0 ? std::cos(kTurn) * std::sqrt(1.0 - across * across) - std::sin(kTurn) * across : 0.0;
    for (int c = 0; c < 3; ++c)
      fine[i][c] =
          std::abs(across) < 1.0 ? rope[c] * (kAmbient + (1.0 - kAmbient) * std::max(0.0, normal_to_light)) : wall[c];
  }
  std::vector<std::uint8_t> out;
  for (int y = 0; y < 300; ++y)
    for (int x = 0; x < kWidth; ++x)
      for (int c = 0; c < 3; ++c) {
        double sum = 0.0, all = 0.0;
        for (int i = std::max(0, (x - 3) * kSamples); i < std::min(kWidth, x + 4) * kSamples; ++i) {
          const double off = ((i + 0.5) / kSamples - (x + 0.5)) / kBlur, weight = std::exp(-0.5 * off * off);
          sum += weight * (y >= 20 && y < 250 ? fine[i][c] : wall[c]), all += weight;
        }
        out.push_back(static_cast<std::uint8_t>(std::lround(sum / all) + (x * 7 + y * 13) % 5 - 2));
      }
  return out;
}

TEST_CASE("the rims of a tube are its outlines, where color changes most is inside") {
  double steepest = 0.0, rims = 0.0;  // px, mean errors of the radius
  for (const double radius : {3.2, 4.7, 8.3})
    for (const double at : {100.0, 100.3, 100.7}) {
      CAPTURE(radius);
      CAPTURE(at);
      const std::vector<std::uint8_t> pixels = wall_with_tube(at, radius);
      const masking::Picture picture{pixels.data(), 200, 300, 3};
      masking::Axis rough;  // beside the tube and a tenth too thin
      for (int i = 0; i <= 76; ++i) rough.points.push_back({{101.6, 20.0 + 3.0 * i}, 0.9 * radius, 3e-3 * i});
      const auto error = [&](bool by_rims) {
        masking::RibbonOptions options;
        options.rims = by_rims;
        const masking::Ribbon ribbon = masking::find_ribbon({}, picture, rough, 0.23, options);
        std::vector<double> radii, places;
        for (const masking::AxisPoint& p : ribbon.axis.points)
          if (p.at.y() < 210) radii.push_back(p.radius), places.push_back(p.at.x());
        REQUIRE(radii.size() > 20);
        if (by_rims) CHECK(std::abs(math::median(places) - at) < 0.25);
        return std::abs(math::median(radii) - radius);
      };
      steepest += error(false) / 9, rims += error(true) / 9;
      CHECK(error(true) < 0.25);
    }
  MESSAGE("radius off by ", steepest, " px where color changes most, by ", rims, " px with rims");
  CHECK(rims < 0.12);
  CHECK(rims < 0.5 * steepest);
}

// A board of this color on which a rope lies from row 20 to 250, its axis at column 100.3 and 6 px wide on either side,
// striped in these colors and lit from the left. On its right is its shadow, 4 px wide.
std::vector<std::uint8_t> board_with_rope(const std::array<double, 3>& board,
                                          const std::vector<std::array<double, 3>>& stripes) {
  constexpr double kAt = 100.3, kRadius = 6.0, kShadow = 4.0, kInShadow = 0.4;
  constexpr int kSamples = 8, kStripe = 12;
  std::vector<std::uint8_t> out;
  for (int y = 0; y < 300; ++y)
    for (int x = 0; x < 200; ++x)
      for (int c = 0; c < 3; ++c) {
        double sum = 0.0;
        for (int i = 0; i < kSamples; ++i) {
          const double across = (x + (i + 0.5) / kSamples - kAt) / kRadius;
          const bool there = y >= 20 && y < 250;
          const double light = 0.25 + 0.75 * std::max(0.0, std::cos(0.9 + std::asin(std::clamp(across, -1.0, 1.0))));
          if (there && std::abs(across) < 1.0)
            sum += light * stripes[(y / kStripe) % stripes.size()][c];
          else
            sum += board[c] * (there && across >= 1.0 && across < 1.0 + kShadow / kRadius ? kInShadow : 1.0);
        }
        out.push_back(static_cast<std::uint8_t>(std::lround(sum / kSamples) + (x * 7 + y * 13 + c * 3) % 5 - 2));
      }
  return out;
}

TEST_CASE("a rope's shadow on what it lies on is not a part of it; where hues do not tell, nothing changes") {
  masking::Axis rough;  // beside the rope
  for (int i = 0; i <= 76; ++i) rough.points.push_back({{101.8, 20.0 + 3.0 * i}, 6.0, 3e-3 * i});
  const auto outlines = [&](const std::vector<std::uint8_t>& pixels, bool shadow) {  // medians, px: left, right
    masking::RibbonOptions options;
    options.shadow = shadow, options.width_deviation = 0.4, options.rims = true;
    const masking::Ribbon ribbon = masking::find_ribbon({}, {pixels.data(), 200, 300, 3}, rough, 0.23, options);
    std::vector<double> left, right;
    for (const masking::AxisPoint& p : ribbon.axis.points) {
      if (p.at.y() < 40 || p.at.y() > 210) continue;
      left.push_back(p.at.x() - p.radius), right.push_back(p.at.x() + p.radius);
    }
    REQUIRE(left.size() > 20);
    return std::array{math::median(left), math::median(right)};
  };
  const std::array<double, 3> wood{200, 160, 118}, gray{170, 170, 170};
  const std::vector<std::uint8_t> striped = board_with_rope(wood, {{40, 110, 170}, {210, 70, 50}, {230, 230, 230}});
  const auto with = outlines(striped, true), without = outlines(striped, false);
  MESSAGE("right outline off by ", with[1] - 106.3, " px, as part of the rope ", without[1] - 106.3, " px");
  CHECK(with[0] == doctest::Approx(94.3).epsilon(0.006));
  CHECK(with[1] == doctest::Approx(106.3).epsilon(0.006));
  CHECK(without[1] > 107.5);
  // a rope of the board's hue: there is no telling
  const std::vector<std::uint8_t> alike = board_with_rope(gray, {{235, 235, 235}, {90, 90, 90}});
  const auto told = outlines(alike, true), untold = outlines(alike, false);
  CHECK(told[0] == doctest::Approx(untold[0]).epsilon(0.005));
  CHECK(told[1] == doctest::Approx(untold[1]).epsilon(0.005));
}

TEST_CASE("outlines of several pictures make one rope, and one that is none of the rope's hardly counts") {
  // a rope of 12 mm along the ground, three cameras at 0.8 m that look down at it
  const chain::Chain rope =
      chain::make_chain(0.3, 0.012, Vector3::UnitX(), Vector3::UnitZ(), 8, chain::Bending::planar, false);
  math::Pose base;
  VectorX theta(rope.angles());
  for (int k = 0; k < rope.angles(); ++k) theta[k] = 0.15 * std::cos(0.8 * k);
  const Vector3 shift(0.002, -0.004, 0.001);
  const double width = 1.1;
  std::vector<capture::Camera> cameras(3, front_camera());
  std::vector<masking::Ribbon> ribbons;
  math::Pose shifted = base;
  shifted.translation = shift;
  for (int c = 0; c < 3; ++c) {
    capture::Camera& camera = cameras[c];
    camera.width = 640, camera.height = 480, camera.fx = camera.fy = 600.0, camera.cx = 320.0, camera.cy = 240.0;
    const double azimuth = 2.1 * c + 0.4;
    const Vector3 middle(0.15, 0.03, 0.0), from(0.55 * std::cos(azimuth), 0.55 * std::sin(azimuth), 0.6);
    const Vector3 z = -from.normalized(), x = z.cross(Vector3::UnitZ()).normalized();
    camera.world_from_camera.translation = middle + from;
    camera.world_from_camera.rotation << x, z.cross(x), z;
    masking::Ribbon ribbon;
    ribbon.axis = masking::axis(rope, shifted, theta, camera, 0.0, rope.length);
    for (masking::AxisPoint& p : ribbon.axis.points) p.radius *= width;
    ribbons.push_back(ribbon);
  }
  for (std::size_t i = 5; i < ribbons[1].axis.points.size() / 2; ++i) {  // a shadow, for half the length
    masking::AxisPoint& p = ribbons[1].axis.points[i];
    const math::Vector2 along = ribbons[1].axis.points[i + 1].at - p.at;
    p.at += math::Vector2(-along.y(), along.x()).normalized() * 1.5;
    p.radius += 1.5;
  }
  std::vector<masking::Outlined> seen;
  for (int c = 0; c < 3; ++c) seen.push_back({&cameras[c], base, &ribbons[c]});
  masking::OneRope start{theta, Vector3::Zero(), 1.0};
  for (int k = 0; k < rope.angles(); ++k) start.theta[k] += k % 2 ? 0.03 : -0.03;
  const masking::OneRope fit = masking::fit_one_rope(rope, seen, start);
  const auto line = [&](const VectorX& angles, const Vector3& moved) {
    math::Pose at = base;
    at.translation = moved;
    return chain::centerline(rope, chain::link_motions(rope, angles, at), chain::equal_arclengths(rope, 31));
  };
  const double rms = 1e3 * std::sqrt((line(fit.theta, fit.shift) - line(theta, shift)).colwise().squaredNorm().mean());
  MESSAGE("one rope: ", rms, " mm, width ", fit.width);
  CHECK(rms < 0.4);
  CHECK(fit.width == doctest::Approx(width).epsilon(0.01));
}

TEST_CASE("growth: an edge is no rope, the grasp is found 12 mm away, a rope at rest does not turn up") {
  const chain::Chain rope =
      chain::make_chain(0.23, 0.006, Vector3::UnitY(), Vector3::UnitZ(), 10, chain::Bending::planar, false);
  const capture::Camera camera = wall_camera();
  math::Pose base;
  base.translation = Vector3(0.0, 0.0, 0.2);
  const auto grown_in = [&](const std::vector<std::uint8_t>& pixels, double grasp_x, const masking::Clues& clues) {
    base.translation.x() = grasp_x;
    const masking::Shot shot{{pixels.data(), 200, 300, 3}, &camera, base, {}, {}};
    return masking::grow(rope, {&shot, 1}, {}, clues);
  };
  const std::vector<std::uint8_t> with = wall_with_cable(100.0), without = wall_with_cable(100.0, false);
  const double found = grown_in(with, 0.0, {}).evidence;
  CHECK(found > 0.2);
  CHECK(grown_in(without, 0.030, {}).evidence < 0.1 * found);  // along the edge
  masking::Clues clues;
  clues.grasp_deviation = 0.006;
  const masking::Grown off = grown_in(with, 0.012, clues);
  CHECK(off.evidence > 0.9 * found);
  CHECK(off.shift.x() == doctest::Approx(-0.012).epsilon(0.15));
  // a horizontal band of the cable's color and width that leaves the cable at half its length, and hides the rest
  std::vector<std::uint8_t> bend = with;
  for (int y = 0; y < 300; ++y)
    for (int x = 0; x < 200; ++x)
      for (int c = 0; c < 3; ++c) {
        std::uint8_t& value = bend[3 * (y * 200 + x) + c];
        if (y >= 132) value = static_cast<std::uint8_t>(200 + (x * 7 + y * 13) % 5);
        if (y >= 129 && y < 135 && x >= 97) value = 55;
      }
  clues.grasp_deviation = 0.0;
  const auto highest = [&](const masking::Clues& given) {  // share of the last link that points sideways
    const masking::Grown grown = grown_in(bend, 0.0, given);
    return std::abs(std::sin(grown.theta.sum()));
  };
  CHECK(highest(clues) > 0.8);
  clues.down = Vector3::UnitY();
  CHECK(highest(clues) < 0.6);
}

TEST_CASE("growth runs through the user's points, whatever the picture shows") {
  const chain::Chain rope =
      chain::make_chain(0.23, 0.006, Vector3::UnitY(), Vector3::UnitZ(), 10, chain::Bending::planar, false);
  const capture::Camera camera = wall_camera();
  math::Pose base;
  base.translation = Vector3(0.0, 0.0, 0.2);
  const std::vector<std::uint8_t> pixels = wall_with_cable(100.0);
  const math::Vector2 place(60.0, 160.0);                               // on the bare wall
  const auto nearest = [&](const std::vector<math::Vector2>& points) {  // radii from the place
    const masking::Shot shot{{pixels.data(), 200, 300, 3}, &camera, base, points, {}};
    masking::Clues clues;
    clues.bend_change = 0.1;
    const masking::Grown grown = masking::grow(rope, {&shot, 1}, {}, clues);
    double least = 1e9;
    for (const masking::AxisPoint& p : masking::axis(rope, base, grown.theta, camera, 0.0, rope.length).points)
      least = std::min(least, (p.at - place).norm() / p.radius);
    return least;
  };
  CHECK(nearest({}) > 4.0);  // it follows the cable
  CHECK(nearest({place}) < 2.0);
}

TEST_CASE("thin and thick ropes take no more memory and time than others") {
  // a red rope on gray, 2 m or 2,000 diameters long and a third of a pixel wide
  constexpr int kWidth = 640, kHeight = 120;
  capture::Camera camera = front_camera();
  camera.width = kWidth, camera.height = kHeight, camera.fx = camera.fy = 300.0, camera.cx = 10.0, camera.cy = 60.0;
  std::vector<std::uint8_t> pixels(3 * kWidth * kHeight, 90);
  for (int x = 10; x < 610; ++x) pixels[3 * (60 * kWidth + x)] = 220;
  math::Pose base;
  base.translation = Vector3(0.0, 0.0, 1.0);
  const masking::Picture picture{pixels.data(), kWidth, kHeight, 3};
  const masking::Shot shot{picture, &camera, camera.world_from_camera.inverse() * base, {}, {}};
  const auto rope = [&](double length, double diameter) {
    return chain::make_chain(length, diameter, Vector3::UnitX(), Vector3::UnitY(), 16, chain::Bending::spatial, false);
  };
  const masking::Grown thin = masking::grow(rope(2.0, 0.001), {&shot, 1}, {});
  CHECK(thin.evidence >= 0.0);
  CHECK(thin.evidence < std::log(2.0));
  // the tallies count the samples
  for (const masking::Tally& tally : thin.tallies) CHECK(tally.inside_sum + tally.beside_sum < 4000);

  masking::Look appearance;
  const VectorX straight = VectorX::Zero(32);
  for (const auto& [length, diameter] : {std::pair{2.0, 1e-8}, {1e4, 0.02}, {0.5, 0.49}}) {
    const chain::Chain other = rope(length, diameter);
    const masking::Tube tube = masking::tube(other, base, straight, camera, 0.0, length, 8.0);
    appearance.marks = masking::marks({&picture, 1}, {&tube, 1}, other);
    CHECK(appearance.marks.along <= 4096);
    masking::cut(appearance, picture, camera, other, base, straight);
  }
}

TEST_CASE("live masks of one camera") {
  capture::LoadOptions first;
  first.last = 40;
  const capture::Capture masked = capture::load(kDemo, first);
  const chain::Chain rope = chain::make_chain(masked.length, masked.diameter, masked.direction, masked.bending_axis, 8,
                                              chain::Bending::spatial, false);
  const silhouette::SequenceFit fit = silhouette::fit_sequence(rope, masked);
  std::vector<std::uint8_t> colors;  // the rope's, from the first masked view
  for (std::size_t i = 0; i + 3 < masked.views[0].rgba.size(); i += 4)
    if (masked.views[0].rgba[i + 3])
      colors.insert(colors.end(), &masked.views[0].rgba[i], &masked.views[0].rgba[i + 3]);
  masking::LiveMasks live(masked.cameras[0], rope, colors);
  capture::VideoReader video(kDemo / "cam0.mp4");
  capture::Image8 picture;
  double sum = 0.0;
  for (int k = 0; k < 40; ++k) {
    REQUIRE(video.next(picture));
    const double time = masked.times[0][k];
    // extrapolate the last two frames at constant velocity, a prediction without dynamics
    const VectorX last = chain::interpolate(fit.states, masked.times[0][std::max(0, k - 1)]);
    const VectorX expected = 2.0 * last - chain::interpolate(fit.states, masked.times[0][std::max(0, k - 2)]);
    const capture::View view = live.mask(picture, masked.base.pose(time), expected);
    capture::Image8 whole{320, 240, 1, std::vector<std::uint8_t>(320 * 240, 0)};
    for (int y = 0; y < view.height; ++y)
      for (int x = 0; x < view.width; ++x)
        whole.pixels[(view.y0 + y) * 320 + view.x0 + x] = view.rgba[4 * (y * view.width + x) + 3];
    sum += iou(whole, given_mask(0, k));
  }
  MESSAGE("live IoU mean ", sum / 40);
  CHECK(sum / 40 > 0.8);
}

TEST_CASE("what cannot be masked is said") {
  CHECK_THROWS_WITH_AS(masking::make(kDemo, {500, 510}, {}, [](int, int, const capture::Image8&, double) {}),
                       doctest::Contains("no frame"), InputError);
}

}  // namespace
