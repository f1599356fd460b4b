#include "src/silhouette/mask_points.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <numeric>

#include "chainsplat/image_model.h"

namespace chainsplat::silhouette {

namespace {

constexpr double kLevel = image_model::kObjectMask - 0.5;  // coverage at the outline
constexpr double kSpeck = 0.02;         // share of the largest blob's area under which a blob is noise
constexpr int kSpeckPixels = 4;         // px, the same for small masks
constexpr std::size_t kMostBlobs = 64;  // a rope cut by fingers has a few; more are noise
constexpr int kWindow = 3;              // px, reach of the window that gives an edge its normal

struct RowRun {  // mask pixels [begin, end) of row y
  int y, begin, end, parent;
};

int root(std::vector<RowRun>& runs, int i) {
  while (runs[i].parent != i) i = runs[i].parent = runs[runs[i].parent].parent;
  return i;
}

// Runs of the rows, joined where they touch, also by a corner.
std::vector<RowRun> connected_runs(const capture::View& view) {
  std::vector<RowRun> runs;
  std::size_t above = 0, above_end = 0;  // runs of the row before
  for (int y = 0; y < view.height; ++y) {
    const std::size_t row_begin = runs.size();
    const std::uint8_t* const row = view.rgba.data() + 4 * static_cast<std::size_t>(y) * view.width + 3;
    for (int x = 0; x < view.width;) {
      while (x < view.width && row[4 * x] < image_model::kObjectMask) ++x;
      if (x == view.width) break;
      const int begin = x;
      while (x < view.width && row[4 * x] >= image_model::kObjectMask) ++x;
      runs.push_back({y, begin, x, static_cast<int>(runs.size())});
    }
    std::size_t a = above;
    for (std::size_t b = row_begin; b < runs.size(); ++b) {
      while (a < above_end && runs[a].end < runs[b].begin) ++a;
      for (std::size_t c = a; c < above_end && runs[c].begin <= runs[b].end; ++c)
        runs[root(runs, static_cast<int>(b))].parent = root(runs, static_cast<int>(c));
    }
    above = row_begin;
    above_end = runs.size();
  }
  return runs;
}

// Offsets of a disk: the window in which a normal is measured.
const std::vector<std::array<int, 2>>& window() {
  static const std::vector<std::array<int, 2>> offsets = [] {
    std::vector<std::array<int, 2>> disk;
    for (int y = -kWindow; y <= kWindow; ++y)
      for (int x = -kWindow; x <= kWindow; ++x)
        if (x * x + y * y <= kWindow * (kWindow + 1)) disk.push_back({x, y});
    return disk;
  }();
  return offsets;
}

}  // namespace

int MaskPoints::blob_at(const Vector2& pixel) const {
  const double x = std::floor(pixel.x()) - x0, y = std::floor(pixel.y()) - y0;
  if (!(x >= 0 && y >= 0 && x < width && y < height)) return -1;
  if (first_run.empty()) return -1;
  const auto row = static_cast<std::size_t>(y);
  const auto last = runs.begin() + first_run[row + 1];
  const auto run =
      std::partition_point(runs.begin() + first_run[row], last, [&](const Run& before) { return before.end <= x; });
  return run != last && run->begin <= x ? run->blob : -1;
}

MaskPoints mask_points(const capture::View& view, const capture::Camera& camera, int max_pixels) {
  MaskPoints out;
  out.x0 = view.x0;
  out.y0 = view.y0;
  out.width = view.width;
  out.height = view.height;
  std::vector<RowRun> runs = connected_runs(view);
  if (runs.empty()) return out;

  // areas by root, then the roots by area (ties by position, so that the order is the same everywhere)
  const int run_count = static_cast<int>(runs.size());
  std::vector<int> area(run_count, 0);
  for (int i = 0; i < run_count; ++i) area[root(runs, i)] += runs[i].end - runs[i].begin;
  std::vector<int> roots;
  for (int i = 0; i < run_count; ++i)
    if (area[i] > 0) roots.push_back(i);
  std::stable_sort(roots.begin(), roots.end(), [&](int a, int b) { return area[a] > area[b]; });
  const double least = std::max<double>(kSpeckPixels, kSpeck * area[roots[0]]);
  while (roots.size() > 1 && (area[roots.back()] < least || roots.size() > kMostBlobs)) roots.pop_back();
  std::vector<int> blob_of(run_count, -1);
  for (std::size_t b = 0; b < roots.size(); ++b) {
    blob_of[roots[b]] = static_cast<int>(b);
    out.area += area[roots[b]];
  }

  std::vector<char> in_blob(static_cast<std::size_t>(view.width) * view.height, 0);
  std::vector<std::vector<const RowRun*>> runs_of(roots.size());
  out.first_run.assign(static_cast<std::size_t>(view.height) + 1, 0);
  for (int i = 0; i < run_count; ++i) {
    const int blob = blob_of[root(runs, i)];
    if (blob < 0) continue;
    const RowRun& run = runs[i];
    runs_of[blob].push_back(&run);
    out.runs.push_back({run.begin, run.end, blob});
    ++out.first_run[static_cast<std::size_t>(run.y) + 1];
    std::fill_n(in_blob.begin() + static_cast<std::ptrdiff_t>(run.y) * view.width + run.begin, run.end - run.begin, 1);
  }
  std::partial_sum(out.first_run.begin(), out.first_run.end(), out.first_run.begin());

  const auto coverage = [&](int x, int y) {
    return static_cast<double>(view.rgba[4 * (static_cast<std::size_t>(y) * view.width + x) + 3]);
  };
  const auto inside = [&](int x, int y) {
    return x >= 0 && y >= 0 && x < view.width && y < view.height &&
           in_blob[static_cast<std::size_t>(y) * view.width + x] != 0;
  };
  // Outline between pixel (x, y), inside, and its neighbor in direction (dx, dy).
  const auto add_edge = [&](int x, int y, int dx, int dy) {
    const int nx = x + dx, ny = y + dy;
    if (nx < 0 || ny < 0 || nx >= view.width || ny >= view.height || inside(nx, ny)) return;
    // where the image ends, the mask ends without an outline
    const int ix = view.x0 + nx, iy = view.y0 + ny;
    if (ix <= 0 || iy <= 0 || ix >= camera.width - 1 || iy >= camera.height - 1) return;
    const double a = coverage(x, y), b = std::min(coverage(nx, ny), kLevel - 0.5);
    const double step = (a - kLevel) / (a - b);
    Edge edge;
    edge.point = Vector2(view.x0 + x + 0.5 + step * dx, view.y0 + y + 0.5 + step * dy);
    Vector2 inward = Vector2::Zero();  // towards the centroid of the mask within the window about the step
    for (const auto& [wx, wy] : window()) {
      if (inside(x + wx, y + wy)) inward += Vector2(wx - 0.5 * dx, wy - 0.5 * dy);
      if (inside(nx + wx, ny + wy)) inward += Vector2(wx + 0.5 * dx, wy + 0.5 * dy);
    }
    const double size = inward.norm();
    if (size <= 0.0) return;
    edge.outward = -inward / size;
    // rows measure steep outlines, columns flat ones: each piece of outline is taken once
    const double along = std::abs(edge.outward.x()), across = std::abs(edge.outward.y());
    if (dx != 0 ? along < across : across <= along) return;
    edge.weight = 1.0 / std::max(along, across);
    out.edges.push_back(edge);
  };

  const double share = std::min(1.0, static_cast<double>(max_pixels) / out.area);
  for (std::size_t b = 0; b < roots.size(); ++b) {
    Blob blob;
    blob.area = area[roots[b]];
    blob.first_pixel = static_cast<int>(out.pixels.size());
    blob.first_edge = static_cast<int>(out.edges.size());
    double counted = 0.5;  // a pixel is taken whenever this passes a whole number
    for (const RowRun* const run : runs_of[b]) {
      for (int x = run->begin; x < run->end; ++x) {
        counted += share;
        if (counted >= 1.0) {
          counted -= 1.0;
          out.pixels.emplace_back(view.x0 + x + 0.5, view.y0 + run->y + 0.5);
        }
        add_edge(x, run->y, 0, -1);
        add_edge(x, run->y, 0, 1);
      }
      add_edge(run->begin, run->y, -1, 0);
      add_edge(run->end - 1, run->y, 1, 0);
    }
    blob.last_pixel = static_cast<int>(out.pixels.size());
    blob.last_edge = static_cast<int>(out.edges.size());
    out.blobs.push_back(blob);
  }
  return out;
}

}  // namespace chainsplat::silhouette
