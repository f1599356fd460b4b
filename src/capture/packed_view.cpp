#include "src/capture/packed_view.h"

#include <algorithm>

#include "chainsplat/image_model.h"

namespace chainsplat::capture {

PackedView packed(const View& view) {
  PackedView out;
  static_cast<ViewPlace&>(out) = static_cast<const ViewPlace&>(view);
  const auto at = [&](int x, int y) { return static_cast<std::size_t>(y) * view.width + x; };
  set_runs(out, [&](int x, int y) {
    const std::uint8_t* const p = &view.rgba[4 * at(x, y)];
    return (p[0] | p[1] | p[2] | p[3]) != 0;
  });
  if (!view.depth.empty()) out.depth.resize(out.rgba.size() / 4);
  std::size_t k = 0;
  each_run(out, [&](std::size_t first, std::size_t count) {
    std::copy_n(&view.rgba[4 * first], 4 * count, &out.rgba[4 * k]);
    if (!view.depth.empty()) std::copy_n(&view.depth[first], count, &out.depth[k]);
    k += count;
  });
  return out;
}

bool shows_object(const PackedView& view) {
  for (std::size_t i = 3; i < view.rgba.size(); i += 4)
    if (view.rgba[i] >= image_model::kObjectMask) return true;
  return false;
}

View unpacked(const PackedView& view) {
  View out;
  static_cast<ViewPlace&>(out) = static_cast<const ViewPlace&>(view);
  const std::size_t pixels = static_cast<std::size_t>(view.width) * view.height;
  out.rgba.assign(4 * pixels, 0);
  if (!view.depth.empty()) out.depth.assign(pixels, 0.0f);
  std::size_t k = 0;
  each_run(view, [&](std::size_t first, std::size_t count) {
    std::copy_n(&view.rgba[4 * k], 4 * count, &out.rgba[4 * first]);
    if (!view.depth.empty()) std::copy_n(&view.depth[k], count, &out.depth[first]);
    k += count;
  });
  return out;
}

}  // namespace chainsplat::capture
