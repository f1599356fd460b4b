// reference_colors.h - splat::ColorSums in double on the host, pixel by pixel, from a drawn picture with depth. The
// device's sums are compared with these, and they replace the device's in tests that paint their own pictures. Header
// only; for tests.
#pragma once
#include <cmath>
#include <cstdint>
#include <vector>

#include "chainsplat/splat.h"
#include "src/splat/color_model.h"

namespace chainsplat::reference {

// `drawn`: the twin in the pixels of `spec`. `observed`: RGBA8 of the same pixels, A = mask.
inline splat::ColorSums color_sums(const chain::Chain& chain, const splat::ViewSpec& spec,
                                   const std::vector<std::uint8_t>& observed, const splat::Picture& drawn) {
  using shared::kColorBiasWeight;
  using shared::kColorGainWeight;
  using shared::kColorOpaque;
  constexpr int kEdge = shared::kColorEdge;
  const int w = spec.width, h = spec.height;
  const auto inside = [&](int x, int y) {
    return x >= 0 && y >= 0 && x < w && y < h && observed[4 * (static_cast<std::size_t>(y) * w + x) + 3] >= 128;
  };
  const auto counts = [&](int x, int y) {
    for (int dy = -kEdge; dy <= kEdge; ++dy)
      for (int dx = -kEdge; dx <= kEdge; ++dx)
        if (!inside(x + dx, y + dy)) return false;
    const std::size_t k = static_cast<std::size_t>(y) * w + x;
    return static_cast<double>(drawn.rgba[4 * k + 3]) >= static_cast<double>(kColorOpaque) && drawn.depth[k] > 0.0f;
  };
  const splat::LinkAxes axes = splat::link_axes(chain, spec.motions);
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
      const math::Vector3 point = splat::surface_point(camera, spec.x0 + x + 0.5, spec.y0 + y + 0.5,
                                                       drawn.depth[static_cast<std::size_t>(y) * w + x]);
      const Pixel pixel{x, y, splat::nearest_link(axes, camera.world_from_camera * point),
                        splat::pixel_motion(camera, point)};
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
    Eigen::Matrix2d exposure = Eigen::Vector2d(kColorGainWeight, kColorBiasWeight).asDiagonal();
    Eigen::Vector2d pull = Eigen::Vector2d::Zero();
    for (const Pixel& pixel : pixels)
      for (int c = 0; c < 3; ++c) {
        const double residual = out.gain * shown_at(pixel.x, pixel.y, c) + out.bias - observed_at(pixel.x, pixel.y, c);
        const double weight = splat::color_weight(residual);
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
