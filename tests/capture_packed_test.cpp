// Views without their black pixels against the whole views that they are made from.
#include <doctest/doctest.h>

#include <functional>

#include "chainsplat/capture.h"
#include "chainsplat/core.h"

using namespace chainsplat;

namespace {

capture::View view_of(int width, int height, const std::function<std::uint32_t(int, int)>& pixel) {
  capture::View view;
  view.camera = 2, view.frame = 7, view.time = 0.25, view.x0 = 11, view.y0 = -3;
  view.width = width, view.height = height;
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x)
      for (int c = 0; c < 4; ++c) view.rgba.push_back(static_cast<std::uint8_t>(pixel(x, y) >> (8 * c)));
  return view;
}

// Packs and unpacks, and counts with code of its own what must be kept.
void check_round_trip(const capture::View& view) {
  const capture::PackedView packed = capture::packed(view);
  const capture::View again = capture::unpacked(packed);
  CHECK(again.camera == view.camera);
  CHECK(again.frame == view.frame);
  CHECK(again.time == view.time);
  CHECK(again.x0 == view.x0);
  CHECK(again.y0 == view.y0);
  CHECK(again.width == view.width);
  CHECK(again.height == view.height);
  CHECK(again.rgba == view.rgba);
  std::size_t shown = 0;
  bool object = false;
  for (std::size_t k = 0; k < view.rgba.size(); k += 4) {
    const bool here = view.rgba[k] || view.rgba[k + 1] || view.rgba[k + 2] || view.rgba[k + 3];
    shown += here;
    object = object || view.rgba[k + 3] >= 128;
    if (again.depth.empty()) continue;
    CHECK(again.depth[k / 4] == (here ? view.depth[k / 4] : 0.0f));
  }
  CHECK(packed.rgba.size() == 4 * shown);
  CHECK(packed.depth.size() == (view.depth.empty() ? 0 : shown));
  CHECK(capture::shows_object(packed) == object);
  CHECK(again.depth.size() == (shown > 0 ? view.depth.size() : 0));  // black all over it has none
}

}  // namespace

TEST_CASE("a packed view is the same view, whatever it shows") {
  core::Random random(5);
  for (const double share : {0.0, 0.03, 0.5, 1.0}) {
    CAPTURE(share);
    capture::View view = view_of(
        37, 23, [&](int, int) { return random.uniform() < share ? static_cast<std::uint32_t>(random.next()) : 0u; });
    check_round_trip(view);
    for (std::size_t k = 0; k < view.rgba.size() / 4; ++k) view.depth.push_back(static_cast<float>(random.uniform()));
    check_round_trip(view);
  }
  check_round_trip(view_of(0, 0, [](int, int) { return 0u; }));
  check_round_trip(view_of(1, 1, [](int, int) { return 0u; }));
  check_round_trip(view_of(1, 1, [](int, int) { return 0x80000000u; }));
}

TEST_CASE("runs that are longer than a number of a run can say") {
  constexpr int kWidth = 400, kHeight = 500;  // three times 65,535 pixels
  const auto at = [](int x, int y) { return y * kWidth + x; };
  const int ends[] = {65535, 65536, 131070, 131071, 196605, 196606};
  check_round_trip(view_of(kWidth, kHeight, [](int, int) { return 0xffffffffu; }));
  check_round_trip(view_of(kWidth, kHeight, [](int, int) { return 0u; }));
  for (const int end : ends) {
    CAPTURE(end);
    check_round_trip(view_of(kWidth, kHeight, [&](int x, int y) { return at(x, y) < end ? 0u : 0xff102030u; }));
    check_round_trip(view_of(kWidth, kHeight, [&](int x, int y) { return at(x, y) < end ? 0xff102030u : 0u; }));
    check_round_trip(view_of(kWidth, kHeight, [&](int x, int y) { return at(x, y) == end ? 0xff102030u : 0u; }));
  }
}

TEST_CASE("the demo is held in a tenth of what its crops would take") {
  capture::LoadOptions options;
  options.depth = true;
  const Path folder = Path(CHAINSPLAT_SOURCE_DIR) / "assets/demo_free_30";
  std::size_t held = 0, whole = 0;
  for (const capture::PackedView& view : capture::load(folder, options).views) {
    const capture::Image8 mask =
        capture::read_image8(folder / "masks" / ("cam" + std::to_string(view.camera)) /
                             (std::string(view.frame < 10 ? "00000" : "0000") + std::to_string(view.frame) + ".png"));
    std::size_t object = 0;
    for (std::size_t i = 0; i < mask.pixels.size(); i += static_cast<std::size_t>(mask.channels))
      object += mask.pixels[i] >= 128;
    CHECK(view.rgba.size() == 4 * object);
    CHECK(view.depth.size() == object);
    held += view.rgba.capacity() + sizeof(float) * view.depth.capacity() + sizeof(std::uint16_t) * view.runs.capacity();
    whole += std::size_t{8} * view.width * view.height;
  }
  CHECK(held < whole / 5);
}
