// Cameras of another exposure and white balance, made of the demo capture by hand.
#include "chainsplat/camera_colors.h"

#include <doctest/doctest.h>

#include <algorithm>
#include <array>
#include <cmath>

#include "chainsplat/silhouette.h"

namespace {

using namespace chainsplat;
using math::Vector3;

struct Recording {
  capture::Capture capture;
  chain::Chain chain;
  chain::States states;
};

const Recording& demo_recording() {
  static const Recording recording = [] {
    Recording out;
    out.capture = capture::load(Path(CHAINSPLAT_SOURCE_DIR) / "assets/demo_free_30");
    const capture::Capture& c = out.capture;
    constexpr int kJoints = 16;
    out.chain =
        chain::make_chain(c.length, c.diameter, c.direction, c.bending_axis, kJoints, chain::Bending::spatial, false);
    out.states = silhouette::fit_sequence(out.chain, c).states;
    return out;
  }();
  return recording;
}

// Whole numbers, cut off at 0 and 255, as a camera's are.
void expose(capture::Capture& capture, int camera, const Vector3& gain, const Vector3& bias) {
  for (capture::PackedView& view : capture.views) {
    if (view.camera != camera) continue;
    for (std::size_t i = 0; i < view.rgba.size(); i += 4)
      for (int c = 0; c < 3; ++c)
        view.rgba[i + c] =
            static_cast<std::uint8_t>(std::clamp(std::round(gain[c] * view.rgba[i + c] + 255.0 * bias[c]), 0.0, 255.0));
  }
}

TEST_CASE("cameras that see alike are found to") {
  const silhouette::CameraColors found =
      silhouette::fit_camera_colors(demo_recording().chain, demo_recording().capture, demo_recording().states);
  CHECK(found.patches > 500);
  for (int c = 0; c < 3; ++c)
    for (int i = 0; i < 3; ++i) {
      // lamp at the camera, highlights: not the cameras'
      CHECK(std::abs(found.gain(i, c) - 1.0) < 0.03);
      CHECK(std::abs(found.bias(i, c)) < 0.015);
      CHECK(found.gain_deviation(i, c) < 0.05);
    }
}

TEST_CASE("gain and bias that were put in are what is found beyond the cameras' own difference") {
  const silhouette::CameraColors own =
      silhouette::fit_camera_colors(demo_recording().chain, demo_recording().capture, demo_recording().states);
  const std::array<Vector3, 3> gain = {Vector3(0.8, 0.8, 0.8), Vector3(1.1, 1.0, 0.9), Vector3(1.0, 1.0, 1.0)};
  const std::array<Vector3, 3> bias = {Vector3(0, 0, 0), Vector3(0.03, 0.03, 0.03), Vector3(0, 0, 0)};
  capture::Capture capture = demo_recording().capture;
  for (int c = 0; c < 3; ++c) expose(capture, c, gain[c], bias[c]);
  const silhouette::CameraColors found =
      silhouette::fit_camera_colors(demo_recording().chain, capture, demo_recording().states);
  // what two cameras make of one color, whatever is common to all
  constexpr double kColor = 0.3;
  const auto seen = [&](const silhouette::CameraColors& colors, int camera, int channel) {
    return colors.gain(channel, camera) * kColor + colors.bias(channel, camera);
  };
  for (int i = 0; i < 3; ++i) {
    for (int c = 0; c < 2; ++c) {
      const double wanted = (gain[c][i] * seen(own, c, i) + bias[c][i]) / seen(own, 2, i);
      CHECK(seen(found, c, i) / seen(found, 2, i) == doctest::Approx(wanted).epsilon(0.02));
    }
    CHECK(found.gain.row(i).mean() == doctest::Approx(1.0).epsilon(1e-6));
    CHECK(std::abs(found.bias.row(i).mean()) < 1e-6);
  }
}

TEST_CASE("one camera, and cameras that are exact by the capture, are taken as they are") {
  capture::Capture alone = demo_recording().capture;
  alone.cameras.resize(1);
  std::erase_if(alone.views, [](const capture::PackedView& view) { return view.camera != 0; });
  const silhouette::CameraColors one =
      silhouette::fit_camera_colors(demo_recording().chain, alone, demo_recording().states);
  CHECK(one.patches == 0);
  CHECK(one.gain.isOnes(1e-9));
  CHECK(one.bias.isZero(1e-9));

  capture::Capture exact = demo_recording().capture;
  expose(exact, 1, Vector3::Constant(0.8), Vector3::Zero());
  for (const capture::Camera& camera : exact.cameras)
    for (const char* const quantity : {"gain", "bias"}) exact.sigma.push_back({camera.name, quantity, 0.0});
  const silhouette::CameraColors held =
      silhouette::fit_camera_colors(demo_recording().chain, exact, demo_recording().states);
  CHECK(held.gain.isOnes(1e-4));
}

}  // namespace
