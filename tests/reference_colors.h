// reference_colors.h - splat::ColorSums in double on the host, pixel by pixel, from a drawn picture with depth. The
// device's sums are compared with these, and they replace the device's in tests that paint their own pictures. Header
// only; for tests.
#pragma once
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "chainsplat/splat.h"

namespace chainsplat::reference {

// `drawn`: the twin in the pixels of `spec`. `observed`: RGBA8 of the same pixels, A = mask.
inline splat::ColorSums color_sums(const chain::Chain& chain, const splat::ViewSpec& spec,
                                   const std::vector<std::uint8_t>& observed, const splat::Picture& drawn) {
  using math::Vector3;
  // the constants of shaders/shared/color.h
  constexpr int kEdge = 2;                              // px
  constexpr double kOpaque = 0.95, kNoise = 0.05;       // alpha; intensity
  constexpr double kGainWeight = 10, kBiasWeight = 40;  // of the priors
  constexpr double kNearer = 0.999;                     // of squared distances: a later link must be clearly nearer
  const int w = spec.width, h = spec.height;
  const auto inside = [&](int x, int y) {
    return x >= 0 && y >= 0 && x < w && y < h && observed[4 * (static_cast<std::size_t>(y) * w + x) + 3] >= 128;
  };
  const auto counts = [&](int x, int y) {
    for (int dy = -kEdge; dy <= kEdge; ++dy)
      for (int dx = -kEdge; dx <= kEdge; ++dx)
        if (!inside(x + dx, y + dy)) return false;
    const std::size_t k = static_cast<std::size_t>(y) * w + x;
    return static_cast<double>(drawn.rgba[4 * k + 3]) >= static_cast<double>(static_cast<float>(kOpaque)) &&
           drawn.depth[k] > 0.0f;
  };
  const auto link_of = [&](const Vector3& point) {
    int best = 0;
    double least = std::numeric_limits<double>::infinity();
    for (int j = 0; j < chain.links(); ++j) {
      const Vector3 home = spec.motions[j].inverse() * point;
      const double s = std::clamp(home.dot(chain.direction), chain.link_start(j), chain.link_end(j));
      const double distance2 = (home - s * chain.direction).squaredNorm();
      if (distance2 >= kNearer * least) continue;
      least = distance2;
      best = j;
    }
    return best;
  };
  struct Pixel {
    int x, y, link;
    Eigen::Matrix<double, 2, 6> flow;  // px per world twist about the world origin
  };

  // the pixels that count, with their links and their motion
  std::vector<Pixel> pixels;
  const capture::Camera& camera = *spec.camera;
  for (int y = 0; y < h; ++y)
    for (int x = 0; x < w; ++x) {
      if (!counts(x, y)) continue;
      const double z = drawn.depth[static_cast<std::size_t>(y) * w + x];
      const Vector3 point((spec.x0 + x + 0.5 - camera.cx) / camera.fx * z,
                          (spec.y0 + y + 0.5 - camera.cy) / camera.fy * z, z);
      const Vector3 world = camera.world_from_camera * point;
      Eigen::Matrix<double, 2, 3> projection;
      projection << camera.fx / z, 0, -camera.fx * point.x() / (z * z), 0, camera.fy / z,
          -camera.fy * point.y() / (z * z);
      const Eigen::Matrix<double, 2, 3> by_point = projection * camera.world_from_camera.rotation.transpose();
      Pixel pixel{x, y, link_of(world), {}};
      pixel.flow << -by_point * math::hat(world), by_point;
      pixels.push_back(pixel);
    }

  // central moments of the colors
  splat::ColorSums out;
  out.pixels = static_cast<int>(pixels.size());
  const auto shown_at = [&](int x, int y, int c) -> double {
    return drawn.rgba[4 * (static_cast<std::size_t>(y) * w + x) + c];
  };
  const auto observed_at = [&](int x, int y, int c) {
    return observed[4 * (static_cast<std::size_t>(y) * w + x) + c] / 255.0;
  };
  for (int c = 0; c < 3; ++c) {
    double shown_mean = 0.0, seen_mean = 0.0;
    for (const Pixel& pixel : pixels) {
      shown_mean += shown_at(pixel.x, pixel.y, c) / out.pixels;
      seen_mean += observed_at(pixel.x, pixel.y, c) / out.pixels;
    }
    for (const Pixel& pixel : pixels) {
      const double s = shown_at(pixel.x, pixel.y, c) - shown_mean, t = observed_at(pixel.x, pixel.y, c) - seen_mean;
      out.covariance += s * t, out.drawn_variance += s * s, out.seen_variance += t * t;
    }
  }

  // normal equations; the first pass is for the exposure only
  for (int pass = 0; pass < 2; ++pass) {
    out.normal.assign(chain.links(), splat::ColorSums::Matrix8::Zero());
    out.right.assign(chain.links(), splat::ColorSums::Vector8::Zero());
    out.weight = out.square = 0.0;
    Eigen::Matrix2d exposure = Eigen::Vector2d(kGainWeight, kBiasWeight).asDiagonal();
    Eigen::Vector2d pull = Eigen::Vector2d::Zero();
    for (const Pixel& pixel : pixels)
      for (int c = 0; c < 3; ++c) {
        const double residual = out.gain * shown_at(pixel.x, pixel.y, c) + out.bias - observed_at(pixel.x, pixel.y, c);
        const double weight = std::abs(residual) <= kNoise ? 1.0 : kNoise / std::abs(residual);
        const auto slope = [&](int dx, int dy) {
          const auto difference = [&](const auto& at) {
            return at(pixel.x + dx, pixel.y + dy, c) - at(pixel.x - dx, pixel.y - dy, c);
          };
          return 0.25 * (out.gain * difference(shown_at) + difference(observed_at));
        };
        splat::ColorSums::Vector8 row;
        row << -pixel.flow.transpose() * math::Vector2(slope(1, 0), slope(0, 1)), shown_at(pixel.x, pixel.y, c), 1.0;
        out.normal[pixel.link] += weight * row * row.transpose();
        out.right[pixel.link] += weight * residual * row;
        exposure += weight * row.tail<2>() * row.tail<2>().transpose();
        pull += weight * residual * row.tail<2>();
        out.weight += weight;
        out.square += weight * residual * residual;
      }
    if (pass > 0) break;
    const Eigen::Vector2d change = exposure.ldlt().solve(pull);
    out.gain -= change[0];
    out.bias -= change[1];
  }
  return out;
}

}  // namespace chainsplat::reference
