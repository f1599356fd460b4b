// How far a rope has rolled, from pictures of a cylinder whose texture turns in a known way.
#include <doctest/doctest.h>

#include <cmath>
#include <functional>
#include <numbers>
#include <vector>

#include "src/recognition/light.h"
#include "src/recognition/rolls.h"
#include "tests/straight_rope.h"

using namespace chainsplat;

namespace {

constexpr double kSlope = 0.045 / (2.0 * std::numbers::pi);  // m per radian: one turn moves the bands by one
constexpr int kFrames = 40;

double roll_at(double arclength, double time) {  // rad, at the tip up to 0.9 to either side
  return 4.0 * arclength * std::sin(2.0 * std::numbers::pi * 0.8 * time) * std::cos(3.0 * arclength);
}

// Two cameras at 20 and 100 degrees about the bending axis, which is lit from above.
struct Recording {
  chain::Chain chain =
      chain::make_chain(0.3, 0.02, math::Vector3::UnitX(), math::Vector3::UnitZ(), 8, chain::Bending::planar, false);
  capture::Capture capture;
  std::vector<recognition::FrameViews> frames;
  chain::States states;

  explicit Recording(const std::function<math::Vector3(double arclength, double angle, double time)>& looks) {
    capture.length = chain.length, capture.diameter = chain.diameter;
    capture.base = trajectory::fit({{0.0, {}}}, "test");
    for (const double degrees : {20.0, 100.0})
      capture.cameras.push_back(test::camera_beside(chain, degrees * std::numbers::pi / 180.0));
    for (int k = 0; k < kFrames; ++k) {
      const double time = k / 30.0;
      frames.push_back({time, {}});
      states.time.push_back(time);
      states.theta.push_back(math::VectorX::Zero(chain.angles()));
      for (int c = 0; c < 2; ++c) {
        capture::View picture = test::picture_of_straight_rope(chain, capture.cameras[c], [&](double s, double at) {
          return math::Vector3((1.0 + 0.3 * std::cos(at)) * looks(s, at, time));
        });
        picture.camera = c, picture.frame = k, picture.time = time;
        frames.back().views.push_back(static_cast<int>(capture.views.size()));
        capture.views.push_back(capture::packed(picture));
      }
    }
  }
  std::vector<math::VectorX> found() const { return recognition::rolls_in(chain, capture, frames, states); }
};

}  // namespace

TEST_CASE("rolls are found from the colors of the surface, about their mean over time") {
  const Recording recording(
      [](double s, double at, double time) { return test::texture(s, at - roll_at(s, time), kSlope); });
  const std::vector<math::VectorX> found = recording.found();
  REQUIRE(found.size() == std::size_t{kFrames});
  const chain::Chain& chain = recording.chain;
  math::MatrixX wanted(chain.links(), kFrames), errors(chain.links(), kFrames);
  for (int k = 0; k < kFrames; ++k)
    for (int link = 0; link < chain.links(); ++link) {
      const double middle = 0.5 * (chain.link_start(link) + chain.link_end(link));
      wanted(link, k) = roll_at(middle, recording.states.time[k]);
      REQUIRE(found[k].size() == chain.links());
      errors(link, k) = found[k][link];
    }
  wanted.colwise() -= wanted.rowwise().mean().eval();
  errors -= wanted;
  const double size = std::sqrt(wanted.squaredNorm() / static_cast<double>(wanted.size()));
  const double left = std::sqrt(errors.squaredNorm() / static_cast<double>(errors.size()));
  CHECK(size > 0.3);
  CHECK(left < 0.06);  // rad; links are stiff, and a link's ends differ by up to 0.1
  CHECK(found[0][0] == doctest::Approx(0.0).epsilon(1e-3));
}

TEST_CASE("the light is told from the texture that turns in it") {
  const auto looks = [](double s, double at, double time) { return test::texture(s, at - roll_at(s, time), kSlope); };
  Recording recording(looks);
  const chain::Chain& chain = recording.chain;
  for (const double time : recording.states.time) {
    math::VectorX roll(chain.links());
    for (int link = 0; link < chain.links(); ++link)
      roll[link] = roll_at(0.5 * (chain.link_start(link) + chain.link_end(link)), time);
    recording.states.roll.push_back(roll);
  }
  const splat::Light light = recognition::light_on(chain, recording.capture, recording.frames, recording.states);
  REQUIRE(light.known());
  CHECK(light.axis == chain.direction);
  for (int degrees = -40; degrees <= 160; degrees += 10) {  // that a camera sees
    const double at = degrees * std::numbers::pi / 180.0;
    const math::Vector3 normal =
        std::cos(at) * chain.bending_axis + std::sin(at) * chain.direction.cross(chain.bending_axis);
    CAPTURE(degrees);
    CHECK(splat::brightness(light, normal) == doctest::Approx((1.0 + 0.3 * std::cos(at)) / 1.3).epsilon(0.03));
  }

  // nothing is lit where the texture alone explains what is seen
  Recording even([](double s, double at, double time) {
    return math::Vector3(test::texture(s, at - roll_at(s, time), kSlope) / (1.0 + 0.3 * std::cos(at)));
  });
  even.states.roll = recording.states.roll;
  CHECK_FALSE(recognition::light_on(chain, even.capture, even.frames, even.states).known());
}

TEST_CASE("a rope that does not roll, and one without marks, get no rolls") {
  CHECK(Recording([](double s, double at, double) { return test::texture(s, at, kSlope); }).found().empty());
  CHECK(Recording([](double, double, double) { return math::Vector3(0.3, 0.3, 0.35); }).found().empty());
}
