#include <doctest/doctest.h>

#include "chainsplat/layout.h"

using namespace chainsplat;
using render::Layout;

namespace {

// A red square of 4 x 4 px at (6, 2) of an image of 16 x 8 px that was recorded in one color.
struct Scene {
  capture::Camera camera;
  render::Frame frame;
  capture::Image8 recorded{16, 8, 3, std::vector<std::uint8_t>(3 * 16 * 8)};
  Scene() {
    camera.width = 16, camera.height = 8;
    frame.x0 = 6, frame.y0 = 2;
    frame.picture.width = frame.picture.height = 4;
    for (int i = 0; i < 16; ++i) frame.picture.rgba.insert(frame.picture.rgba.end(), {1.0f, 0.0f, 0.0f, 1.0f});
    for (std::size_t i = 0; i < recorded.pixels.size(); ++i)
      recorded.pixels[i] = std::array<std::uint8_t, 3>{255, 100, 50}[i % 3];
  }
  std::array<int, 3> at(Layout layout, int x, int y, double share = 0.5) const {
    const capture::Image8 image = render::laid_out(layout, frame, camera, recorded, share);
    const std::size_t i = 3 * (static_cast<std::size_t>(y) * image.width + x);
    return {image.pixels[i], image.pixels[i + 1], image.pixels[i + 2]};
  }
};

using Rgb = std::array<int, 3>;
constexpr Rgb kSeen{255, 100, 50}, kRed{255, 0, 0}, kBlack{0, 0, 0};

}  // namespace

TEST_CASE("each layout shows what it says, inside and outside of the rope") {
  const Scene scene;
  const int gray = (299 * 255 + 587 * 100 + 114 * 50) / 2000;
  const Rgb dim{gray, gray, gray};
  CHECK(scene.at(Layout::drawn, 7, 3) == kRed);
  CHECK(scene.at(Layout::drawn, 0, 0) == kBlack);
  CHECK(scene.at(Layout::side_by_side, 7, 3) == kSeen);
  CHECK(scene.at(Layout::side_by_side, 16 + 7, 3) == kRed);
  CHECK(scene.at(Layout::side_by_side, 16, 0) == kBlack);
  CHECK(scene.at(Layout::overlay, 7, 3) == kRed);
  CHECK(scene.at(Layout::overlay, 5, 3) == dim);
  CHECK(scene.at(Layout::wipe, 7, 3, 1.0) == kRed);
  CHECK(scene.at(Layout::wipe, 7, 3, 0.0) == kSeen);
  CHECK(scene.at(Layout::wipe, 0, 0, 0.0) == Rgb{255, 255, 255});
  CHECK(scene.at(Layout::outline, 6, 2) == Rgb{90, 255, 60});
  CHECK(scene.at(Layout::outline, 7, 3) == kSeen);
  CHECK(scene.at(Layout::outline, 5, 3) == kSeen);
  CHECK(scene.at(Layout::error, 5, 3) == dim);
  // (100 + 50)/255/3 of 0.25 is 0.784: red and yellow are full, white has begun
  CHECK(scene.at(Layout::error, 7, 3) == Rgb{255, 255, 90});
}

TEST_CASE("without a recorded frame the twin stands on black, and unknown layouts are listed") {
  Scene scene;
  scene.recorded = {};
  CHECK(scene.at(Layout::overlay, 7, 3) == kRed);
  CHECK(scene.at(Layout::outline, 0, 0) == kBlack);
  for (const std::string& name : render::layout_names()) CHECK_NOTHROW(render::read_layout(name));
  try {
    render::read_layout("beside");
    FAIL("nothing was thrown");
  } catch (const InputError& error) {
    CHECK(std::string(error.what()).find("side-by-side, overlay") != std::string::npos);
  }
}
