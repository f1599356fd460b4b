// Parts of the silhouette fit by themselves: what is looked up in a mask, and the smoothing over time.
#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <map>

#include "chainsplat/core.h"
#include "src/silhouette/mask_points.h"
#include "src/silhouette/smooth_in_time.h"

using namespace chainsplat;
using math::MatrixX;
using math::Vector2;
using math::VectorX;

TEST_CASE("a pixel's blob is that of a flood fill") {
  constexpr int kWidth = 60, kHeight = 45, kLeft = 100, kTop = 50;
  capture::Camera camera;
  camera.width = 320, camera.height = 240;
  core::Random random(3);
  for (int round = 0; round < 8; ++round) {
    capture::View view;
    view.x0 = kLeft, view.y0 = kTop, view.width = kWidth, view.height = kHeight;
    view.rgba.assign(std::size_t{4} * kWidth * kHeight, 0);
    // disks, which may touch, and single pixels; none in the last round
    for (int disk = 0; disk < 6 && round < 7; ++disk) {
      const double x0 = random.uniform(0.0, kWidth), y0 = random.uniform(0.0, kHeight), r = random.uniform(0.5, 9.0);
      for (int y = 0; y < kHeight; ++y)
        for (int x = 0; x < kWidth; ++x)
          if (std::hypot(x - x0, y - y0) < r) view.rgba[4 * (y * kWidth + x) + 3] = 255;
    }
    const silhouette::MaskPoints mask = silhouette::mask_points(view, camera, 500);

    std::vector<int> part(kWidth * kHeight, -1), sizes;  // by flood fill, neighbors by a corner included
    for (int start = 0; start < kWidth * kHeight; ++start) {
      if (view.rgba[4 * start + 3] == 0 || part[start] >= 0) continue;
      std::vector<int> open{start};
      part[start] = static_cast<int>(sizes.size());
      sizes.push_back(0);
      while (!open.empty()) {
        const int at = open.back(), x = at % kWidth, y = at / kWidth;
        open.pop_back();
        ++sizes.back();
        for (int v = std::max(0, y - 1); v <= std::min(kHeight - 1, y + 1); ++v)
          for (int u = std::max(0, x - 1); u <= std::min(kWidth - 1, x + 1); ++u)
            if (const int k = v * kWidth + u; view.rgba[4 * k + 3] != 0 && part[k] < 0) {
              part[k] = part[start];
              open.push_back(k);
            }
      }
    }
    std::map<int, int> blob_of;  // part -> blob
    for (int y = -2; y < kHeight + 2; ++y)
      for (int x = -2; x < kWidth + 2; ++x) {
        const bool inside = x >= 0 && y >= 0 && x < kWidth && y < kHeight;
        const int here = inside ? part[y * kWidth + x] : -1;
        const int blob = mask.blob_at(Vector2(kLeft + x + 0.5, kTop + y + 0.5));
        if (here < 0) {
          CHECK(blob == -1);
        } else if (blob < 0) {  // a speck
          CHECK(sizes[here] < std::max(4.0, 0.02 * *std::max_element(sizes.begin(), sizes.end())));
        } else {
          CHECK(blob_of.emplace(here, blob).first->second == blob);
          CHECK(mask.blobs[blob].area == sizes[here]);
        }
      }
    CHECK(blob_of.size() == mask.blobs.size());
    CHECK(mask.blob_at(Vector2(1e9, 1e9)) == -1);
    CHECK(mask.blob_at(Vector2(NAN, 0.0)) == -1);
  }
}

TEST_CASE("smoothed in stretches, a motion is the same as in one piece") {
  constexpr int kFrames = 700, kAngles = 3;
  core::Random random(8);
  std::vector<double> times;
  std::vector<silhouette::FrameSolution> solutions(kFrames);
  std::vector<char> seen(kFrames, 1);
  for (int f = 0; f < kFrames; ++f) {
    times.push_back(f / 60.0);
    silhouette::FrameSolution& s = solutions[f];
    s.fit.theta.resize(kAngles);
    for (int k = 0; k < kAngles; ++k) s.fit.theta[k] = std::sin(0.05 * f + k) + 0.01 * random.normal();
    const MatrixX root = MatrixX::NullaryExpr(kAngles, kAngles, [&] { return random.normal(); });
    s.information = 1e4 * (root * root.transpose() + MatrixX::Identity(kAngles, kAngles));
    s.gradient = VectorX::Zero(kAngles);
    seen[f] = f % 50 != 7;
  }
  const std::vector<VectorX> whole = silhouette::smoothed(times, solutions, seen);
  const std::vector<VectorX> parts = silhouette::smoothed(times, solutions, seen, 1);  // as short as they may be
  REQUIRE(parts.size() == whole.size());
  double apart = 0.0, smoothing = 0.0;
  for (int f = 0; f < kFrames; ++f) {
    apart = std::max(apart, (parts[f] - whole[f]).norm());
    smoothing = std::max(smoothing, (whole[f] - solutions[f].fit.theta).norm());
  }
  CHECK(smoothing > 1e-3);
  CHECK(apart < 1e-9);
}
