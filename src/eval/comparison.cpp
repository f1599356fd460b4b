#include "chainsplat/comparison.h"

#include <algorithm>
#include <cmath>

namespace chainsplat::eval {

using capture::Image8;

namespace {

constexpr int kMoments = 4;        // rows of the comparison
constexpr int kGap = 2;            // px between two pictures
constexpr int kWideGap = 8;        // px between two cameras
constexpr int kSheetWidth = 2000;  // px, about, of the enlarged comparison
constexpr int kMostZoom = 3;
constexpr std::uint8_t kGapLevel = 96;  // gray

std::uint8_t level(float value) {
  return static_cast<std::uint8_t>(std::lround(255.0f * std::clamp(value, 0.0f, 1.0f)));
}

// Copies the part of an RGB picture at (x0, y0) of its image that lies in `bounds` to (left, top) of `sheet`.
template <class Pixel>  // Pixel(index, channel) -> level
void paste(int x0, int y0, int width, int height, const Pixel& pixel, const math::Rectangle& bounds, int left, int top,
           Image8& sheet) {
  for (int y = std::max(y0, bounds.y0); y < std::min(y0 + height, bounds.y1); ++y)
    for (int x = std::max(x0, bounds.x0); x < std::min(x0 + width, bounds.x1); ++x)
      for (int c = 0; c < 3; ++c)
        sheet.pixels[3 * (static_cast<std::size_t>(top + y - bounds.y0) * sheet.width + left + x - bounds.x0) + c] =
            pixel(static_cast<std::size_t>(y - y0) * width + (x - x0), c);
}

void paste(const capture::View& view, const math::Rectangle& bounds, int left, int top, Image8& sheet) {
  paste(
      view.x0, view.y0, view.width, view.height, [&](std::size_t i, int c) { return view.rgba[4 * i + c]; }, bounds,
      left, top, sheet);
}

void paste(const render::Frame& frame, const math::Rectangle& bounds, int left, int top, Image8& sheet) {
  paste(
      frame.x0, frame.y0, frame.picture.width, frame.picture.height,
      [&](std::size_t i, int c) { return level(frame.picture.rgba[4 * i + c]); }, bounds, left, top, sheet);
}

void blacken(int left, int top, const math::Rectangle& bounds, Image8& sheet) {
  for (int y = 0; y < bounds.height(); ++y)
    std::fill_n(sheet.pixels.begin() + 3 * (static_cast<std::ptrdiff_t>(top + y) * sheet.width + left),
                3 * bounds.width(), std::uint8_t{0});
}

Image8 enlarged(const Image8& image, int zoom) {
  Image8 out{zoom * image.width, zoom * image.height, image.channels, {}};
  out.pixels.reserve(image.pixels.size() * zoom * zoom);
  for (int y = 0; y < out.height; ++y)
    for (int x = 0; x < out.width; ++x) {
      const auto from =
          image.pixels.begin() + image.channels * (static_cast<std::ptrdiff_t>(y / zoom) * image.width + x / zoom);
      out.pixels.insert(out.pixels.end(), from, from + image.channels);
    }
  return out;
}

}  // namespace

Image8 whole_image(const render::Frame& frame, const capture::Camera& camera) {
  Image8 image{camera.width, camera.height, 3, {}};
  image.pixels.assign(3 * static_cast<std::size_t>(camera.width) * camera.height, 0);
  paste(frame, {0, 0, camera.width, camera.height}, 0, 0, image);
  return image;
}

Image8 comparison(splat::Engine& engine, const twin::Twin& twin, const capture::Capture& recorded) {
  const std::vector<double>& covered = twin.states.time.empty() ? twin.rollout.time : twin.states.time;
  struct Column {
    std::vector<const capture::PackedView*> views;  // one a moment
    std::vector<std::vector<render::Frame>> drawn;  // recognized, rollout
  };
  std::vector<Column> columns;
  int width = 0, height = 0, pictures = 0;  // of every window, px; windows beside each other
  std::size_t rows = 0;
  for (int c = 0; c < static_cast<int>(recorded.cameras.size()); ++c) {
    std::vector<const capture::PackedView*> views;
    for (const capture::PackedView& view : recorded.views)
      if (view.camera == c && view.time >= covered.front() && view.time <= covered.back() && view.width > 0)
        views.push_back(&view);
    if (views.empty()) continue;
    Column column;
    std::vector<double> times;
    for (int m = 0; m < kMoments; ++m) {
      const capture::PackedView* view = views[(2 * m + 1) * views.size() / (2 * kMoments)];
      if (!column.views.empty() && column.views.back() == view) continue;  // fewer frames than moments
      column.views.push_back(view);
      times.push_back(view->time);
      width = std::max(width, view->width);
      height = std::max(height, view->height);
    }
    for (const chain::States* states : {&twin.states, &twin.rollout})
      if (!states->time.empty())
        column.drawn.push_back(
            render::frames(engine, twin.gaussians, twin.chain, *states, recorded.base, recorded.cameras[c], c, times));
    pictures += 1 + static_cast<int>(column.drawn.size());
    rows = std::max(rows, column.views.size());
    columns.push_back(std::move(column));
  }
  if (columns.empty())
    throw InputError(recorded.folder.string(), "no frame of it has the rope in it", "name another capture");

  Image8 sheet;
  sheet.channels = 3;
  sheet.width = pictures * (width + kGap) - kGap + (static_cast<int>(columns.size()) - 1) * (kWideGap - kGap);
  sheet.height = static_cast<int>(rows) * (height + kGap) - kGap;
  sheet.pixels.assign(3 * static_cast<std::size_t>(sheet.width) * sheet.height, kGapLevel);
  int left = 0;
  for (const Column& column : columns) {
    for (std::size_t row = 0; row < column.views.size(); ++row) {
      const capture::View view = capture::unpacked(*column.views[row]);
      const int top = static_cast<int>(row) * (height + kGap);
      const int x0 = view.x0 + (view.width - width) / 2, y0 = view.y0 + (view.height - height) / 2;
      const math::Rectangle window{x0, y0, x0 + width, y0 + height};
      int x = left;
      blacken(x, top, window, sheet);
      paste(view, window, x, top, sheet);
      for (const std::vector<render::Frame>& drawn : column.drawn) {
        x += width + kGap;
        blacken(x, top, window, sheet);
        for (const render::Frame& frame : drawn)
          if (frame.time == view.time) paste(frame, window, x, top, sheet);
      }
    }
    left += (1 + static_cast<int>(column.drawn.size())) * (width + kGap) - kGap + kWideGap;
  }
  return enlarged(sheet, std::clamp(kSheetWidth / sheet.width, 1, kMostZoom));
}

}  // namespace chainsplat::eval
