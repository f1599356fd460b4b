#include "chainsplat/render.h"

#include <doctest/doctest.h>

#include "small_twin.h"

using namespace chainsplat;
using math::Vector2;
using math::Vector3;

namespace {

splat::Engine& engine() {
  static const gpu::DevicePtr device = gpu::open_device();
  static splat::Engine engine(*device);
  return engine;
}

// A camera in front of the rope of small_twin() that looks along world +y, z up.
capture::Camera front_camera(bool distorted) {
  capture::Camera camera;
  camera.name = "front";
  camera.width = 200;
  camera.height = 150;
  camera.fx = 190;
  camera.fy = 185;
  camera.cx = 103;
  camera.cy = 70;
  camera.world_from_camera.rotation << 1, 0, 0, 0, 0, 1, 0, -1, 0;
  camera.world_from_camera.translation = {0.02, -0.6, 0.4};
  if (distorted) camera.distortion = {-0.25, 0.08, 0.002, -0.003, 0.01};
  return camera;
}

// A rigid "rope" of one joint with one small opaque white ball on its base link.
struct Ball {
  chain::Chain chain = chain::make_chain(0.3, 0.02, {0, 0, -1}, {0, 1, 0}, 1, chain::Bending::planar, false, 0.2);
  splat::Gaussians gaussians;
  chain::States states;
  trajectory::Trajectory base;

  Ball(const Vector3& place, double sigma) {
    gaussians.resize(1, 2, 0);
    gaussians.log_scale.assign(3, static_cast<float>(std::log(sigma)));
    gaussians.opacity_logit = {6.0f};
    gaussians.sh.assign(3, 1.5f);
    gaussians.link_logits = {20.0f, 0.0f};
    states.time = {0.0};
    states.theta = {math::VectorX::Zero(1)};
    base = trajectory::fit({{0.0, {math::Matrix3::Identity(), place}}}, "ball");
  }
};

Vector2 centroid(const render::Frame& frame) {
  Vector2 sum = Vector2::Zero();
  double weight = 0.0;
  for (int y = 0; y < frame.picture.height; ++y)
    for (int x = 0; x < frame.picture.width; ++x) {
      const double alpha = frame.picture.rgba[4 * (static_cast<std::size_t>(y) * frame.picture.width + x) + 3];
      sum += alpha * Vector2(frame.x0 + x + 0.5, frame.y0 + y + 0.5);
      weight += alpha;
    }
  return sum / weight;
}

}  // namespace

TEST_CASE("a ball appears in the recorded pixel where its center projects") {
  for (const bool distorted : {false, true}) {
    const capture::Camera camera = front_camera(distorted);
    for (const Vector3& place : {Vector3(0.02, 0.1, 0.4), Vector3(-0.2, 0.05, 0.5), Vector3(0.25, 0.0, 0.25)}) {
      const Ball ball(place, 0.006);
      const Vector2 straight = capture::project(camera, camera.world_from_camera.inverse() * place);
      const Vector2 expected = capture::distort(camera, straight);
      if (distorted && place.x() != 0.02) CHECK((expected - straight).norm() > 1.5);  // the lens matters here
      render::Options options;
      options.depth = true;
      const auto frames =
          render::frames(engine(), ball.gaussians, ball.chain, ball.states, ball.base, camera, 3, {0.0}, options);
      REQUIRE(frames.size() == 1);
      CHECK(frames[0].camera == 3);
      CHECK((centroid(frames[0]) - expected).norm() < 0.1);
      options.undistorted = true;
      const auto plain =
          render::frames(engine(), ball.gaussians, ball.chain, ball.states, ball.base, camera, 0, {0.0}, options);
      CHECK((centroid(plain.at(0)) - straight).norm() < 0.1);

      // in the whole images the mask is a disk with the depth of the ball's center
      const capture::Image8 mask = render::mask_image(frames[0], camera),
                            color = render::color_image(frames[0], camera);
      const std::vector<float> depth = render::depth_image(frames[0], camera);
      const double z = (camera.world_from_camera.inverse() * place).z();
      const auto at = [&](const Vector2& p) {
        return static_cast<std::size_t>(p.y()) * camera.width + static_cast<std::size_t>(p.x());
      };
      CHECK(mask.pixels[at(expected)] == 255);
      CHECK(depth[at(expected)] == doctest::Approx(z).epsilon(1e-5));
      CHECK(color.pixels[3 * at(expected)] > 150);
      CHECK(mask.pixels[at(expected + Vector2(12, 0))] == 0);
      CHECK(depth[at(expected + Vector2(0, 12))] == 0.0f);
      int solid = 0;
      for (const std::uint8_t value : mask.pixels) solid += value == 255;
      // sigma G >= 1/2 inside a circle with r^2 = 2 ln(2 sigma) (projected variance + 0.3)
      const double variance = std::pow(camera.fx * 0.006 / z, 2) + 0.3, opacity = 1.0 / (1.0 + std::exp(-6.0));
      if (!distorted) CHECK(solid == doctest::Approx(M_PI * 2 * std::log(2 * opacity) * variance).epsilon(0.35));
    }
  }
}

TEST_CASE("a rope is as wide from near and from far as from where it was fitted") {
  twin::Twin twin = test::small_twin();
  const std::vector<math::Pose> motions = chain::link_motions(twin.chain, math::VectorX::Zero(twin.chain.angles()), {});
  const math::Vector3 middle = motions[0] * math::Vector3(0.5 * twin.chain.length * twin.chain.direction);
  constexpr double kFocal = 760.0;
  // m^2 of the rope's outline as it is drawn from a distance
  const auto area = [&](double distance) {
    capture::Camera camera = front_camera(false);
    camera.world_from_camera.translation =
        middle - distance * (camera.world_from_camera.rotation * math::Vector3::UnitZ());
    camera.width = 800, camera.height = 600, camera.fx = camera.fy = kFocal, camera.cx = 400, camera.cy = 300;
    const splat::ViewSpec view{&camera, 0, 0, camera.width, camera.height, motions};
    const splat::Picture picture = engine().draw(twin.gaussians, {&view, 1})[0];
    double pixels = 0.0;
    for (std::size_t k = 3; k < picture.rgba.size(); k += 4) pixels += picture.rgba[k] >= 0.5f ? 1.0 : 0.0;
    return pixels * distance * distance / (kFocal * kFocal);
  };
  constexpr double kFitted = 1.6, kNear = 0.8, kFar = 2.4;
  const double fitted = area(kFitted);
  CHECK(area(kNear) < 0.97 * fitted);
  CHECK(area(kFar) > 1.03 * fitted);
  twin.gaussians.pixel_footprint = kFitted / kFocal;
  CHECK(area(kFitted) == doctest::Approx(fitted).epsilon(1e-3));
  CHECK(area(kNear) == doctest::Approx(fitted).epsilon(0.01));
  CHECK(area(kFar) == doctest::Approx(fitted).epsilon(0.015));
}

TEST_CASE("the crop holds all of the full image") {
  twin::Twin twin = test::small_twin();
  twin.gaussians.pixel_footprint = 0.004;  // larger than a pixel's here
  const trajectory::Trajectory base = test::moving_base(1.0);
  const capture::Camera camera = front_camera(false);
  const std::vector<double> times{0.0, 0.4, 0.77};
  render::Options options;
  options.margin = 0;
  const auto frames =
      render::frames(engine(), twin.gaussians, twin.chain, twin.states, base, camera, 0, times, options);
  REQUIRE(frames.size() == 3);
  for (std::size_t k = 0; k < 3; ++k) {
    const splat::ViewSpec whole{
        &camera,
        0,
        0,
        camera.width,
        camera.height,
        chain::link_motions(twin.chain, chain::interpolate(twin.states, times[k]), base.pose(times[k]))};
    const splat::Picture picture = engine().draw(twin.gaussians, {&whole, 1})[0];
    const render::Frame& frame = frames[k];
    CHECK(frame.picture.width < camera.width / 2);
    double largest = 0.0, painted = 0.0;
    for (int y = 0; y < camera.height; ++y)
      for (int x = 0; x < camera.width; ++x)
        for (int c = 0; c < 4; ++c) {
          const int cx = x - frame.x0, cy = y - frame.y0;
          const bool inside = cx >= 0 && cy >= 0 && cx < frame.picture.width && cy < frame.picture.height;
          const double cropped =
              inside ? frame.picture.rgba[4 * (static_cast<std::size_t>(cy) * frame.picture.width + cx) + c] : 0.0;
          const double full = picture.rgba[4 * (static_cast<std::size_t>(y) * camera.width + x) + c];
          largest = std::max(largest, std::abs(cropped - full));
          painted += full;
        }
    CHECK(painted > 500);
    CHECK(largest < 2e-5);
  }
}

TEST_CASE("the recorded crop of a distorting camera holds what the lens brings in from outside the straight image") {
  // barrel distortion: a point right of the straight image's border is recorded inside the image
  const capture::Camera camera = front_camera(true);
  const Vector2 recorded(camera.width - 4.0, camera.height - 10.0), straight = capture::undistort(camera, recorded);
  REQUIRE(straight.x() > camera.width + 3);
  const double z = 0.6;
  const Vector3 place = camera.world_from_camera * Vector3((straight.x() - camera.cx) / camera.fx * z,
                                                           (straight.y() - camera.cy) / camera.fy * z, z);
  const Ball ball(place, 0.004);
  const auto frames = render::frames(engine(), ball.gaussians, ball.chain, ball.states, ball.base, camera, 0, {0.0});
  const capture::Image8 mask = render::mask_image(frames.at(0), camera);
  CHECK(mask.pixels[static_cast<std::size_t>(recorded.y()) * camera.width + static_cast<std::size_t>(recorded.x())] ==
        255);
}

TEST_CASE("frames are those that the states cover, at their own times") {
  twin::Twin twin = test::small_twin(chain::Bending::planar, 40);
  const trajectory::Trajectory base = test::moving_base(1.0);
  const capture::Camera camera = front_camera(false);
  // states from 0.1 to 0.6 s; camera at 20 Hz, shifted: half a frame is 25 ms
  twin.states = test::swing(twin.chain, 0.5, 0.1);
  std::vector<double> times;
  for (int k = 0; k < 16; ++k) times.push_back(0.03 + 0.05 * k);
  const auto frames = render::frames(engine(), twin.gaussians, twin.chain, twin.states, base, camera, 0, times);
  // 0.08 is 20 ms before the first state, 0.63 30 ms after the last
  REQUIRE(frames.size() == 11);
  for (std::size_t k = 0; k < frames.size(); ++k) {
    CHECK(frames[k].frame == static_cast<int>(k) + 1);
    CHECK(frames[k].time == times[k + 1]);
  }
  CHECK(render::covered(twin.states, 0.075, 0.05));
  CHECK(!render::covered(twin.states, 0.074, 0.05));
  CHECK(!render::covered({}, 0.0, 1.0));
}

TEST_CASE("what is not seen is black, not an error") {
  const twin::Twin twin = test::small_twin(chain::Bending::planar, 40);
  capture::Camera camera = front_camera(false);
  camera.world_from_camera.rotation = camera.world_from_camera.rotation * math::exp_so3({0, M_PI, 0});
  const trajectory::Trajectory base = test::moving_base(1.0);
  const auto away = render::frames(engine(), twin.gaussians, twin.chain, twin.states, base, camera, 0, {0.2});
  REQUIRE(away.size() == 1);
  CHECK(away[0].picture.width == 0);
  for (const std::uint8_t value : render::color_image(away[0], camera).pixels) CHECK(value == 0);
  splat::Gaussians none;
  none.resize(0, twin.chain.links(), 0);
  const auto empty = render::frames(engine(), none, twin.chain, twin.states, base, front_camera(true), 0, {0.2});
  CHECK(empty.at(0).picture.width == 0);
}
