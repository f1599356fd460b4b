#include "chainsplat/layout.h"

#include <algorithm>
#include <array>
#include <cmath>

namespace chainsplat::render {
namespace {

using capture::Image8;
using Color = std::array<std::uint8_t, 3>;

constexpr Color kEdge = {90, 255, 60};  // seen on ropes and on most rooms
constexpr Color kLine = {255, 255, 255};
constexpr int kEdgeWidth = 640;  // px of an image per px that the edge is wide
constexpr double kFull = 0.25;   // mean difference of a pixel's colors, of 1, that is shown as the worst

struct Name {
  const char* text;
  Layout layout;
};
constexpr Name kNames[] = {{"drawn", Layout::drawn},     {"side-by-side", Layout::side_by_side},
                           {"overlay", Layout::overlay}, {"wipe", Layout::wipe},
                           {"outline", Layout::outline}, {"error", Layout::error}};

std::uint8_t byte(double value) { return static_cast<std::uint8_t>(std::lround(255.0 * std::clamp(value, 0.0, 1.0))); }

Color pixel(const Image8& image, int x, int y) {
  const std::size_t at = 3 * (static_cast<std::size_t>(y) * image.width + x);
  return {image.pixels[at], image.pixels[at + 1], image.pixels[at + 2]};
}
void set(Image8& image, int x, int y, const Color& color) {
  std::copy(color.begin(), color.end(), image.pixels.begin() + 3 * (static_cast<std::ptrdiff_t>(y) * image.width + x));
}

Color dimmed(const Color& color) {
  const auto gray = static_cast<std::uint8_t>((299 * color[0] + 587 * color[1] + 114 * color[2]) / 2000);  // BT.601
  return {gray, gray, gray};
}

// Black, red, yellow, white.
Color heat(double value) { return {byte(3.0 * value), byte(3.0 * value - 1.0), byte(3.0 * value - 2.0)}; }

// Colors times alpha, and alpha; 0 outside of the crop.
std::array<float, 4> drawn_at(const Frame& frame, int x, int y) {
  const int u = x - frame.x0, v = y - frame.y0;
  if (u < 0 || v < 0 || u >= frame.picture.width || v >= frame.picture.height) return {};
  const float* const at = &frame.picture.rgba[4 * (static_cast<std::size_t>(v) * frame.picture.width + u)];
  return {at[0], at[1], at[2], at[3]};
}

Color over(const std::array<float, 4>& drawn, const Color& behind) {
  Color out;
  for (int c = 0; c < 3; ++c) out[c] = byte(drawn[c] + (1.0 - drawn[3]) * behind[c] / 255.0);
  return out;
}

// A pixel of the rope less than `width` from one that is not.
bool on_edge(const Frame& frame, int x, int y, int width) {
  const auto inside = [&](int u, int v) { return drawn_at(frame, u, v)[3] >= 0.5f; };
  if (!inside(x, y)) return false;
  for (int dy = -width; dy <= width; ++dy)
    for (int dx = -width; dx <= width; ++dx)
      if (dx * dx + dy * dy <= width * width && !inside(x + dx, y + dy)) return true;
  return false;
}

double difference(const std::array<float, 4>& drawn, const Color& recorded) {
  double sum = 0.0;
  for (int c = 0; c < 3; ++c) sum += std::abs(std::min(drawn[c], 1.0f) - recorded[c] / 255.0) / 3.0;
  return sum;
}

}  // namespace

const std::vector<std::string>& layout_names() {
  static const std::vector<std::string> names = [] {
    std::vector<std::string> out;
    for (const Name& name : kNames) out.emplace_back(name.text);
    return out;
  }();
  return names;
}

Layout read_layout(const std::string& name) {
  std::string all;
  for (const Name& known : kNames) {
    if (name == known.text) return known.layout;
    all += (all.empty() ? "" : ", ") + std::string(known.text);
  }
  throw InputError("`layout`", "'" + name + "' is not known", "give one of " + all);
}

Image8 laid_out(Layout layout, const Frame& frame, const capture::Camera& camera, const Image8& recorded,
                double share) {
  const int width = camera.width, height = camera.height;
  CHAINSPLAT_CHECK(
      recorded.pixels.empty() || (recorded.width == width && recorded.height == height && recorded.channels == 3),
      std::to_string(recorded.width));
  if (layout == Layout::drawn) return color_image(frame, camera);
  const bool beside = layout == Layout::side_by_side;
  Image8 out{beside ? 2 * width : width, height, 3, {}};
  out.pixels.assign(3u * out.width * out.height, 0);
  const int line = static_cast<int>(std::lround(share * (width - 1))), edge = std::max(1, width / kEdgeWidth);
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x) {
      const Color seen = recorded.pixels.empty() ? Color{} : pixel(recorded, x, y);
      const std::array<float, 4> drawn = drawn_at(frame, x, y);
      Color color = seen;
      if (layout == Layout::overlay || (layout == Layout::wipe && x < line))
        color = over(drawn, dimmed(seen));
      else if (layout == Layout::wipe && x == line)
        color = kLine;
      else if (layout == Layout::outline && on_edge(frame, x, y, edge))
        color = kEdge;
      else if (layout == Layout::error)
        color = drawn[3] >= 0.5f ? heat(difference(drawn, seen) / kFull) : dimmed(seen);
      set(out, x, y, color);
      if (beside) set(out, width + x, y, over(drawn, {}));
    }
  return out;
}

}  // namespace chainsplat::render
