#include "picture.h"

#include <algorithm>
#include <climits>
#include <cmath>

namespace chainsplat::tools {

using capture::Image8;

namespace {

constexpr int kMoments = 4;       // rows of the comparison
constexpr int kGap = 2;           // px between two pictures
constexpr int kWideGap = 8;       // px between two cameras
constexpr int kMargin = 8;        // px around what was seen
constexpr std::uint8_t kGapLevel = 96;  // gray

struct Bounds {
  int x0 = INT_MAX, y0 = INT_MAX, x1 = INT_MIN, y1 = INT_MIN;
  int width() const { return x1 - x0; }
  int height() const { return y1 - y0; }
};

std::uint8_t level(float value) {
  return static_cast<std::uint8_t>(std::lround(255.0f * std::clamp(value, 0.0f, 1.0f)));
}

// Copies the part of an RGB picture at (x0, y0) of its image that lies in `bounds` to (left, top) of `sheet`.
template <class Pixel>  // Pixel(index, channel) -> level
void paste(int x0, int y0, int width, int height, const Pixel& pixel, const Bounds& bounds, int left, int top, Image8& sheet) {
  for (int y = std::max(y0, bounds.y0); y < std::min(y0 + height, bounds.y1); ++y)
    for (int x = std::max(x0, bounds.x0); x < std::min(x0 + width, bounds.x1); ++x)
      for (int c = 0; c < 3; ++c)
        sheet.pixels[3 * (static_cast<std::size_t>(top + y - bounds.y0) * sheet.width + left + x - bounds.x0) + c] =
            pixel(static_cast<std::size_t>(y - y0) * width + (x - x0), c);
}

void paste(const capture::View& view, const Bounds& bounds, int left, int top, Image8& sheet) {
  paste(view.x0, view.y0, view.width, view.height, [&](std::size_t i, int c) { return view.rgba[4 * i + c]; }, bounds, left,
        top, sheet);
}

void paste(const render::Frame& frame, const Bounds& bounds, int left, int top, Image8& sheet) {
  paste(frame.x0, frame.y0, frame.picture.width, frame.picture.height,
        [&](std::size_t i, int c) { return level(frame.picture.rgba[4 * i + c]); }, bounds, left, top, sheet);
}

void blacken(int left, int top, const Bounds& bounds, Image8& sheet) {
  for (int y = 0; y < bounds.height(); ++y)
    std::fill_n(sheet.pixels.begin() + 3 * (static_cast<std::ptrdiff_t>(top + y) * sheet.width + left), 3 * bounds.width(),
                std::uint8_t{0});
}

}  // namespace

Image8 whole_image(const render::Frame& frame, const capture::Camera& camera) {
  Image8 image{camera.width, camera.height, 3, {}};
  image.pixels.assign(3 * static_cast<std::size_t>(camera.width) * camera.height, 0);
  paste(frame, {0, 0, camera.width, camera.height}, 0, 0, image);
  return image;
}

Image8 comparison(splat::Engine& engine, const twin::Twin& twin, const capture::Capture& recorded) {
  struct Column {
    Bounds bounds;
    std::vector<const capture::View*> views;
    std::vector<std::vector<render::Frame>> drawn;  // recognized, rollout
    int width = 0;                                  // of its two or three pictures
  };
  const std::vector<double>& covered = twin.states.time.empty() ? twin.rollout.time : twin.states.time;
  std::vector<Column> columns;
  for (int c = 0; c < static_cast<int>(recorded.cameras.size()); ++c) {
    std::vector<const capture::View*> views;
    for (const capture::View& view : recorded.views)
      if (view.camera == c && view.time >= covered.front() && view.time <= covered.back() && view.width > 0)
        views.push_back(&view);
    if (views.empty()) continue;
    Column column;
    std::vector<double> times;
    for (int m = 0; m < kMoments; ++m) {
      const std::size_t index = (2 * m + 1) * views.size() / (2 * kMoments);
      if (!column.views.empty() && column.views.back() == views[index]) continue;  // fewer frames than moments
      column.views.push_back(views[index]);
      times.push_back(views[index]->time);
    }
    const auto grow = [&](int x0, int y0, int width, int height) {
      const capture::Camera& camera = recorded.cameras[c];
      column.bounds.x0 = std::max(0, std::min(column.bounds.x0, x0 - kMargin));
      column.bounds.y0 = std::max(0, std::min(column.bounds.y0, y0 - kMargin));
      column.bounds.x1 = std::min(camera.width, std::max(column.bounds.x1, x0 + width + kMargin));
      column.bounds.y1 = std::min(camera.height, std::max(column.bounds.y1, y0 + height + kMargin));
    };
    for (const capture::View* view : column.views) grow(view->x0, view->y0, view->width, view->height);
    for (const chain::States* states : {&twin.states, &twin.rollout})
      if (!states->time.empty())
        column.drawn.push_back(
            render::frames(engine, twin.gaussians, twin.chain, *states, recorded.base, recorded.cameras[c], c, times));
    const int pictures = 1 + static_cast<int>(column.drawn.size());
    column.width = pictures * column.bounds.width() + (pictures - 1) * kGap;
    columns.push_back(std::move(column));
  }
  if (columns.empty()) throw InputError(recorded.folder.string(), "no frame of it has the rope in it", "name another capture");

  Image8 sheet;
  sheet.channels = 3;
  std::size_t rows = 0;
  int row_height = 0;
  for (const Column& column : columns) {
    sheet.width += column.width + (sheet.width > 0 ? kWideGap : 0);
    rows = std::max(rows, column.views.size());
    row_height = std::max(row_height, column.bounds.height());
  }
  sheet.height = static_cast<int>(rows) * (row_height + kGap) - kGap;
  sheet.pixels.assign(3 * static_cast<std::size_t>(sheet.width) * sheet.height, kGapLevel);
  int left = 0;
  for (const Column& column : columns) {
    for (std::size_t row = 0; row < column.views.size(); ++row) {
      const int top = static_cast<int>(row) * (row_height + kGap);
      int x = left;
      blacken(x, top, column.bounds, sheet);
      paste(*column.views[row], column.bounds, x, top, sheet);
      for (const std::vector<render::Frame>& drawn : column.drawn) {
        x += column.bounds.width() + kGap;
        blacken(x, top, column.bounds, sheet);
        for (const render::Frame& frame : drawn)
          if (frame.time == column.views[row]->time) paste(frame, column.bounds, x, top, sheet);
      }
    }
    left += column.width + kWideGap;
  }
  return sheet;
}

}  // namespace chainsplat::tools
