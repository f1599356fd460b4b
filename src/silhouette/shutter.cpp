#include "chainsplat/shutter.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <optional>

#include "chainsplat/core.h"
#include "chainsplat/image_model.h"
#include "chainsplat/rectangle.h"

namespace chainsplat::silhouette {

using math::MatrixX;
using math::Vector2;
using math::Vector3;

namespace {

constexpr int kTile = 8;   // px; tiles without rope are not looked at
constexpr int kSlack = 2;  // px, of the bilinear footprint and of rounding
// Of a pixel's row. Each leaves of the error what the rope moves while a row is read, in rows: a hundredth and less.
constexpr int kIterations = 4;
constexpr double kShort = 1e-6;  // px, of a segment that is seen end-on or has no length

// The rope in the image when the first, the middle and the last row are read: between, nodes go as parabolas.
struct MovingRope {
  std::array<std::vector<Vector2>, 3> nodes;  // px
  double reach = 0.0;                         // px, how far a node goes from where it is at the middle

  // `share` of the readout after its middle, -1/2 to 1/2
  Vector2 node(std::size_t i, double share) const {
    const double t = 2.0 * share;
    return nodes[1][i] + 0.5 * t * (nodes[2][i] - nodes[0][i]) +
           0.5 * t * t * (nodes[2][i] - 2.0 * nodes[1][i] + nodes[0][i]);
  }
};

std::optional<MovingRope> moving_rope(const capture::ViewPlace& view, const capture::Camera& camera,
                                      capture::Pixels pixels, const NodesAt& nodes) {
  MovingRope out;
  const math::Pose camera_from_world = camera.world_from_camera.inverse();
  for (int k = 0; k < 3; ++k) {
    const MatrixX at = nodes(view.time + 0.5 * (k - 1) * std::abs(camera.readout));
    for (Eigen::Index i = 0; i < at.cols(); ++i) {
      const Vector3 x = camera_from_world * Vector3(at.col(i));
      if (!(x.z() > image_model::kNear)) return std::nullopt;
      const Vector2 straight = capture::project(camera, x);
      out.nodes[k].push_back(pixels == capture::Pixels::recorded ? capture::distort(camera, straight) : straight);
    }
  }
  for (const int k : {0, 2})
    for (std::size_t i = 0; i < out.nodes[1].size(); ++i)
      out.reach = std::max(out.reach, (out.nodes[k][i] - out.nodes[1][i]).norm());
  if (!std::isfinite(out.reach)) return std::nullopt;
  return out;
}

Vector2 normal_of(const Vector2& step) { return Vector2(-step.y(), step.x()).normalized(); }

// A segment of the rope at the middle of the readout.
struct Middle {
  std::size_t first = 0;  // node
  Vector2 from, step, normal;
  double per_square = 0.0;  // 1 / |step|^2
};

std::vector<Middle> middles_of(const std::vector<Vector2>& nodes) {
  std::vector<Middle> out;
  for (std::size_t i = 0; i + 1 < nodes.size(); ++i) {
    const Vector2 step = nodes[i + 1] - nodes[i];
    if (step.norm() > kShort) out.push_back({i, nodes[i], step, normal_of(step), 1.0 / step.squaredNorm()});
  }
  return out;
}

// Where the recorded picture shows what is at `pixel` at the middle of the readout: it goes with the segment that is
// nearest to it then. `segments`: at least one.
Vector2 recorded_place(const MovingRope& rope, const std::vector<Middle>& segments, const capture::Camera& camera,
                       capture::Pixels pixels, const Vector2& pixel) {
  std::size_t nearest = 0;
  double along = 0.0, least = INFINITY;
  for (std::size_t i = 0; i < segments.size(); ++i) {
    const Middle& one = segments[i];
    const double t = (pixel - one.from).dot(one.step) * one.per_square;
    const double away = (pixel - one.from - std::clamp(t, 0.0, 1.0) * one.step).squaredNorm();
    if (away >= least) continue;
    least = away, nearest = i, along = t;
  }
  const Middle& near = segments[nearest];
  // past the rope's ends their segments go on
  along = std::clamp(along, nearest == 0 ? -INFINITY : 0.0, nearest + 1 == segments.size() ? INFINITY : 1.0);
  const double across = (pixel - near.from).dot(near.normal);
  const Vector2 middle = near.from + along * near.step + across * near.normal;
  const bool straight = pixels == capture::Pixels::undistorted && camera.distorted();
  const double sign = camera.readout < 0.0 ? -1.0 : 1.0;
  Vector2 out = pixel;
  for (int i = 0; i < kIterations; ++i) {
    const double row = straight ? capture::distort(camera, out).y() : out.y();
    const double share = sign * std::clamp(row / camera.height - 0.5, -0.5, 0.5);
    const Vector2 from = rope.node(near.first, share), step = rope.node(near.first + 1, share) - from;
    out = pixel + from + along * step + across * normal_of(step) - middle;
  }
  // beyond the image's border what is at the border goes on
  return out.cwiseMax(Vector2(0.5, 0.5)).cwiseMin(Vector2(camera.width - 0.5, camera.height - 0.5));
}

// Tiles of the image near which the view shows something.
std::vector<char> tiles_of(const capture::View& view, int columns, int rows, int reach) {
  std::vector<char> out(static_cast<std::size_t>(columns) * rows, 0);
  for (int y = 0; y < view.height; ++y)
    for (int x = 0; x < view.width; ++x) {
      if (view.rgba[4 * (static_cast<std::size_t>(y) * view.width + x) + 3] == 0) continue;
      out[static_cast<std::size_t>((view.y0 + y) / kTile) * columns + (view.x0 + x) / kTile] = 1;
    }
  const std::vector<char> shown = out;
  const int far = (reach + kTile - 1) / kTile;
  for (int y = 0; y < rows; ++y)
    for (int x = 0; x < columns; ++x) {
      if (!shown[static_cast<std::size_t>(y) * columns + x]) continue;
      for (int v = std::max(0, y - far); v <= std::min(rows - 1, y + far); ++v)
        for (int u = std::max(0, x - far); u <= std::min(columns - 1, x + far); ++u)
          out[static_cast<std::size_t>(v) * columns + u] = 1;
    }
  return out;
}

// Sets a pixel of `out` to what `view` shows around `place`: inside where half of it is, and in the color of that part.
void sample(const capture::View& view, const Vector2& place, std::uint8_t* rgba, float* depth) {
  const double x = place.x() - 0.5 - view.x0, y = place.y() - 0.5 - view.y0;
  const int x0 = static_cast<int>(std::floor(x)), y0 = static_cast<int>(std::floor(y));
  double covered = 0.0, best = 0.0;
  Vector3 color = Vector3::Zero();
  for (int k = 0; k < 4; ++k) {
    const int u = x0 + k % 2, v = y0 + k / 2;
    if (u < 0 || v < 0 || u >= view.width || v >= view.height) continue;
    const std::size_t pixel = static_cast<std::size_t>(v) * view.width + u;
    const std::uint8_t* const from = &view.rgba[4 * pixel];
    const double weight = (1.0 - std::abs(x - u)) * (1.0 - std::abs(y - v)) * from[3] / 255.0;
    covered += weight;
    color += weight * Vector3(from[0], from[1], from[2]);
    if (depth && weight > best) best = weight, *depth = view.depth[pixel];
  }
  if (covered < 0.5) {
    if (depth) *depth = 0.0f;
    return;
  }
  for (int c = 0; c < 3; ++c) rgba[c] = static_cast<std::uint8_t>(std::lround(color[c] / covered));
  rgba[3] = 255;
}

}  // namespace

capture::View as_read_at_once(const capture::View& view, const capture::Camera& camera, capture::Pixels pixels,
                              const NodesAt& nodes) {
  if (camera.readout == 0.0 || view.width == 0) return view;
  const std::optional<MovingRope> rope = moving_rope(view, camera, pixels, nodes);
  const std::vector<Middle> segments = rope ? middles_of(rope->nodes[1]) : std::vector<Middle>{};
  if (segments.empty()) return view;
  const int reach = static_cast<int>(std::min(rope->reach + kSlack, 1.0 * (camera.width + camera.height)));
  const math::Rectangle crop =
      math::intersection(math::grown({view.x0, view.y0, view.x0 + view.width, view.y0 + view.height}, reach),
                         {0, 0, camera.width, camera.height});
  capture::View out;
  static_cast<capture::ViewPlace&>(out) = static_cast<const capture::ViewPlace&>(view);
  out.x0 = crop.x0, out.y0 = crop.y0, out.width = crop.x1 - crop.x0, out.height = crop.y1 - crop.y0;
  const std::size_t size = static_cast<std::size_t>(out.width) * out.height;
  out.rgba.assign(4 * size, 0);
  if (!view.depth.empty()) out.depth.assign(size, 0.0f);
  const int columns = (camera.width + kTile - 1) / kTile, rows = (camera.height + kTile - 1) / kTile;
  const std::vector<char> shown = tiles_of(view, columns, rows, reach);
  for (int y = crop.y0; y < crop.y1; ++y)
    for (int x = crop.x0; x < crop.x1; ++x) {
      if (!shown[static_cast<std::size_t>(y / kTile) * columns + x / kTile]) continue;
      const std::size_t pixel = static_cast<std::size_t>(y - crop.y0) * out.width + (x - crop.x0);
      sample(view, recorded_place(*rope, segments, camera, pixels, Vector2(x + 0.5, y + 0.5)), &out.rgba[4 * pixel],
             out.depth.empty() ? nullptr : &out.depth[pixel]);
    }
  return out;
}

bool has_rolling_shutter(const std::vector<capture::Camera>& cameras) {
  return std::any_of(cameras.begin(), cameras.end(), [](const auto& camera) { return camera.readout != 0.0; });
}

void read_at_once(capture::Capture& capture, const chain::Chain& chain, const chain::States& states) {
  if (!has_rolling_shutter(capture.cameras)) return;
  const NodesAt nodes = [&](double time) {
    return chain::nodes(chain, chain::link_motions(chain, chain::interpolate(states, time), capture.base.pose(time)));
  };
  core::parallel_for(static_cast<std::int64_t>(capture.views.size()), [&](std::int64_t i) {
    capture::PackedView& view = capture.views[i];
    const capture::Camera& camera = capture.cameras[view.camera];
    if (camera.readout != 0.0)
      view = capture::packed(as_read_at_once(capture::unpacked(view), camera, capture.pixels, nodes));
  });
}

}  // namespace chainsplat::silhouette
