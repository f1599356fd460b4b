#include "clock.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "chainsplat/image_model.h"

namespace chainsplat::importing {

using math::Vector2;
using math::Vector3;

namespace {

constexpr int kClockFrames = 60;
constexpr int kMostPoints = 400;         // rope pixels of a frame that are kept
constexpr double kCovered = 0.6;         // share of the frames' duration that the base must cover
constexpr double kStep = 0.02;           // s, of the search; a rope moves by a few pixels meanwhile
constexpr double kFinest = 1e-4;         // s
constexpr double kApart = 0.2;           // s; starts that are farther apart are different ones
constexpr double kClear = 1.3;           // times the best one's distance that every other start must have, and
constexpr double kClearPixels = 1.0;     // px more
constexpr double kMostDistance = 100.0;  // px, of one frame: one outlier must not decide

double miss_at(const std::vector<SeenRope>& seen, const capture::Camera& camera, const trajectory::Trajectory& base,
               double start) {
  const math::Pose camera_from_world = camera.world_from_camera.inverse();
  double sum = 0.0;
  int count = 0;
  for (const SeenRope& rope : seen) {
    const double time = start + rope.time;
    if (time < base.start() || time > base.end()) continue;
    const Vector3 p = camera_from_world * base.pose(time).translation;
    double least = kMostDistance * kMostDistance;
    if (p.z() > 0.0) {
      const Eigen::Vector2f at = capture::project(camera, p).cast<float>();
      least = std::min<double>(least, (rope.pixels.colwise() - at).colwise().squaredNorm().minCoeff());
    }
    sum += least;
    ++count;
  }
  return count > 0 ? std::sqrt(sum / count) : std::numeric_limits<double>::infinity();
}

}  // namespace

std::vector<SeenRope> seen_ropes(const Media& masks, const MaskRule& rule, double rate, const capture::Camera& camera,
                                 const Undistortion* lens) {
  std::vector<SeenRope> seen;
  const int every = std::max(1, masks.frames / kClockFrames);
  for_each_frame(masks, {0, masks.frames}, [&](int frame, const capture::Image8& image) {
    if (frame % every != 0) return;
    const capture::Image8 mask = lens ? undistort(*lens, binary_mask(image, rule)) : binary_mask(image, rule);
    std::vector<Eigen::Vector2f> points;
    for (std::size_t i = 0; i < mask.pixels.size(); ++i)
      if (mask.pixels[i] >= image_model::kObjectMask) {
        const std::size_t row = i / mask.width, column = i % mask.width;
        const Vector2 at(static_cast<double>(column) + 0.5, static_cast<double>(row) + 0.5);
        points.push_back(capture::undistort(camera, at).cast<float>());
      }
    if (points.empty()) return;
    const std::size_t thin = 1 + points.size() / kMostPoints;
    SeenRope rope{frame / rate, Eigen::Matrix2Xf(2, static_cast<Eigen::Index>((points.size() + thin - 1) / thin))};
    for (std::size_t i = 0; i < points.size(); i += thin)
      rope.pixels.col(static_cast<Eigen::Index>(i / thin)) = points[i];
    seen.push_back(std::move(rope));
  });
  return seen;
}

std::optional<FoundStart> find_start(const std::vector<SeenRope>& seen, const capture::Camera& camera,
                                     const trajectory::Trajectory& base) {
  if (seen.size() < 3) return std::nullopt;
  const double length = seen.back().time - seen.front().time, spare = (1.0 - kCovered) * length;
  const double from = base.start() - seen.front().time - spare, to = base.end() - seen.back().time + spare;
  std::vector<std::pair<double, double>> tried;  // start, miss
  for (double start = from; start <= to; start += kStep) tried.emplace_back(start, miss_at(seen, camera, base, start));
  if (tried.empty()) return std::nullopt;
  const auto refined = [&](double start) {
    double miss = miss_at(seen, camera, base, start);
    for (double step = 0.5 * kStep; step > kFinest; step *= 0.5)
      for (const double other : {start - step, start + step})
        if (const double there = miss_at(seen, camera, base, other); there < miss) start = other, miss = there;
    return FoundStart{start, miss};
  };
  const auto less = [](const auto& a, const auto& b) { return a.second < b.second; };
  const FoundStart best = refined(std::min_element(tried.begin(), tried.end(), less)->first);
  // every other dip of the distance
  for (std::size_t k = 0; k < tried.size(); ++k) {
    const bool dip = (k == 0 || tried[k].second <= tried[k - 1].second) &&
                     (k + 1 == tried.size() || tried[k].second <= tried[k + 1].second);
    if (!dip || std::abs(tried[k].first - best.start) < kApart) continue;
    if (refined(tried[k].first).miss < std::max(kClear * best.miss, best.miss + kClearPixels)) return std::nullopt;
  }
  return best;
}

}  // namespace chainsplat::importing
