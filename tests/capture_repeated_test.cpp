// Pictures that stand a second time in the place of later ones.
#include <doctest/doctest.h>

#include <cmath>
#include <functional>
#include <set>

#include "chainsplat/capture.h"
#include "src/capture/repeated.h"

using namespace chainsplat;

namespace {

constexpr double kRate = 30.0;
constexpr int kFrames = 40, kStart = 8, kEnd = 32;  // the base rests before and after

double sideways(double frame) {  // m
  const double since = std::clamp(frame - kStart, 0.0, static_cast<double>(kEnd - kStart));
  return 0.01 * since;
}

// One camera 1 m before a base that goes sideways, 5 px per frame, and a rod that hangs from it: frame k shows it where
// it was at the time of frame shown(k), `speckles` pixels of noise beside it.
capture::Capture recording(const std::function<double(int)>& shown, int speckles = 0) {
  capture::Capture capture;
  capture.diameter = 0.016;
  capture::Camera camera;
  camera.width = 400, camera.height = 300;
  camera.fx = camera.fy = 500.0, camera.cx = 100.0, camera.cy = 50.0;
  capture.cameras = {camera};
  std::vector<trajectory::Sample> samples;
  for (int i = 0; i <= 4 * kFrames; ++i)
    samples.push_back({0.25 * i / kRate, {math::Matrix3::Identity(), {sideways(0.25 * i), 0.0, 1.0}}});
  capture.base = trajectory::fit(std::move(samples), "the test's base");
  for (int k = 0; k < kFrames; ++k) {
    capture::View view;
    view.frame = k, view.time = k / kRate, view.x0 = 10 + k % 3, view.y0 = 50, view.width = 300, view.height = 120;
    view.rgba.assign(std::size_t{4} * view.width * view.height, 0);
    const int left = static_cast<int>(std::lround(camera.cx + camera.fx * sideways(shown(k)))) - 4 - view.x0;
    const auto paint = [&](int x, int y) {
      for (int i = 0; i < 4; ++i) view.rgba[4 * (static_cast<std::size_t>(y) * view.width + x) + i] = 255;
    };
    for (int y = 0; y < 100; ++y)
      for (int x = left; x < left + 8; ++x) paint(x, y);
    for (int i = 0; i < speckles; ++i) paint(left + 8, (37 * k + 11 * i) % 100);
    capture.views.push_back(capture::packed(view));
  }
  return capture;
}

std::set<int> found_in(capture::Capture capture) {
  const std::vector<capture::PackedView> given = capture.views;
  std::set<int> out;
  for (const capture::ViewPlace& view : capture::empty_repeated(capture, capture.views)) out.insert(view.frame);
  for (int k = 0; k < kFrames; ++k) {
    const capture::PackedView& view = capture.views[k];
    CHECK(view.frame == k);
    CHECK(view.time == given[k].time);
    CHECK(capture::shows_object(view) == !out.contains(k));
    if (!out.contains(k)) CHECK(view.rgba == given[k].rgba);
  }
  return out;
}

using Set = std::set<int>;

}  // namespace

TEST_CASE("pictures that stand for later ones are left out") {
  const auto repeats = [](const Set& again) {
    return [=](int frame) {
      while (again.contains(frame)) --frame;
      return static_cast<double>(frame);
    };
  };
  for (const int speckles : {0, 4}) {  // noise of a tenth of a percent of the picture
    CAPTURE(speckles);
    CHECK(found_in(recording(repeats({}), speckles)) == Set{});
    CHECK(found_in(recording(repeats({15}), speckles)) == Set{15});
    CHECK(found_in(recording(repeats({14, 15, 20}), speckles)) == Set{14, 15, 20});
  }
}

TEST_CASE("a rope that rests, another clock and a picture that stands still are not taken for it") {
  const auto early = [](int frame) { return frame - 2.0; };  // the base's clock, by two frames
  CHECK(found_in(recording(early)) == Set{});
  const auto frozen = [](int frame) { return frame < 14 || frame >= 20 ? 1.0 * frame : 14.0; };
  CHECK(found_in(recording(frozen)) == Set{});
}
