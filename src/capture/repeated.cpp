#include "src/capture/repeated.h"

#include <algorithm>
#include <iterator>

#include "src/capture/packed_view.h"

namespace chainsplat::capture {

namespace {

constexpr double kMoved = 1.0;      // px that the grasp goes on at least: by less a repeated picture is off by little
constexpr double kUnchanged = 0.1;  // of how much masks change before and after, below which one is the same
constexpr int kNear = 3;            // views before, and as many after, that say how much masks change
constexpr int kLongest = 3;         // views in a row; that many are lost by a bus or a disk, more stand still
constexpr double kNearest = 1e-3;   // m from the camera, at which a point is seen

// Pixels of the mask in the image, increasing.
std::vector<int> pixels_of(const PackedView& view, int width) {
  std::vector<int> out;
  out.reserve(view.rgba.size() / 4);
  each_pixel(view, [&](int x, int y) { out.push_back((view.y0 + y) * width + view.x0 + x); });
  return out;
}

// How many pixels are in one mask alone.
double differing(const std::vector<int>& a, const std::vector<int>& b) {
  std::vector<int> out;
  std::set_symmetric_difference(a.begin(), a.end(), b.begin(), b.end(), std::back_inserter(out));
  return static_cast<double>(out.size());
}

// How far the picture of the grasp moves between two times, px; 0 where the camera does not see it.
double grasp_moves(const Capture& capture, const Camera& camera, double from, double to) {
  const auto seen = [&](double time) {
    return camera.world_from_camera.inverse() * capture.base.pose(time).translation;
  };
  const math::Vector3 a = seen(from), b = seen(to);
  return a.z() > kNearest && b.z() > kNearest ? (project(camera, b) - project(camera, a)).norm() : 0.0;
}

// Of one camera's views.
void find_repeated(const Capture& capture, const PackedView* views, int count, std::vector<ViewPlace>& repeated) {
  if (count < 3) return;
  const Camera& camera = capture.cameras[views[0].camera];
  std::vector<double> changes(count, 0.0);
  std::vector<int> before = pixels_of(views[0], camera.width);
  for (int k = 1; k < count; ++k) {
    std::vector<int> now = pixels_of(views[k], camera.width);
    changes[k] = differing(before, now);
    before = std::move(now);
  }
  for (int k = 1; k < count; ++k) {
    if (views[k].width == 0 || grasp_moves(capture, camera, views[k - 1].time, views[k].time) < kMoved) continue;
    double earlier = 0.0, later = 0.0;
    for (int j = std::max(1, k - kNear); j < k; ++j) earlier = std::max(earlier, changes[j]);
    for (int j = k + 1; j <= std::min(count - 1, k + kNear); ++j) later = std::max(later, changes[j]);
    const double unchanged = kUnchanged * std::min(earlier, later);
    int first = k, end = k;  // of those that are the same
    while (first > 1 && changes[first - 1] < unchanged) --first;
    while (end < count && changes[end] < unchanged) ++end;
    if (changes[k] < unchanged && end - first <= kLongest) repeated.push_back(views[k]);
  }
}

}  // namespace

std::vector<ViewPlace> empty_repeated(const Capture& capture, std::vector<PackedView>& views) {
  std::vector<ViewPlace> out;
  if (capture.base.samples().size() < 2) return out;
  for (std::size_t first = 0; first < views.size();) {
    std::size_t end = first;
    while (end < views.size() && views[end].camera == views[first].camera) ++end;
    find_repeated(capture, &views[first], static_cast<int>(end - first), out);
    first = end;
  }
  for (const ViewPlace& repeated : out)
    for (PackedView& view : views) {
      if (view.camera != repeated.camera || view.frame != repeated.frame) continue;
      PackedView empty;
      empty.camera = view.camera;
      empty.frame = view.frame;
      empty.time = view.time;
      view = std::move(empty);
    }
  return out;
}

}  // namespace chainsplat::capture
