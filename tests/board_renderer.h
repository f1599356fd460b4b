// tests/board_renderer.h - pictures of a printed board with known truth, by casting rays: nothing here is the code
// under test. What is black is read from the printed page (SVG), as a printer would; the lens is OpenCV's published
// model, undone by iteration.
#pragma once
#include <array>
#include <cmath>
#include <cstdio>
#include <map>
#include <string>
#include <vector>

#include "chainsplat/calibration.h"

namespace chainsplat::test {

struct Rectangle {
  double x0, y0, x1, y1;  // board's frame: m, x right, y up, from the middle of all tags
};

// The black rectangles of each tag on a page, in m from the middle of the tags' bounds.
inline std::map<int, std::vector<Rectangle>> read_page(const std::string& svg) {
  std::map<int, std::vector<Rectangle>> tags;
  double low_x = 1e9, low_y = 1e9, high_x = -1e9, high_y = -1e9;
  for (std::size_t at = 0; (at = svg.find("<path id=\"tag", at)) != std::string::npos;) {
    at += 13;
    const int id = std::atoi(svg.c_str() + at);
    const std::size_t end = svg.find("\"/>", at);
    for (std::size_t m = svg.find('M', at); m < end; m = svg.find('M', m + 1)) {
      double x, y, w, h;
      if (std::sscanf(svg.c_str() + m, "M%lf %lfh%lfv%lf", &x, &y, &w, &h) != 4) continue;
      tags[id].push_back({1e-3 * x, -1e-3 * (y + h), 1e-3 * (x + w), -1e-3 * y});
      low_x = std::min(low_x, 1e-3 * x), high_x = std::max(high_x, 1e-3 * (x + w));
      low_y = std::min(low_y, -1e-3 * (y + h)), high_y = std::max(high_y, -1e-3 * y);
    }
  }
  for (auto& [id, rectangles] : tags)
    for (Rectangle& r : rectangles) {
      r.x0 -= 0.5 * (low_x + high_x), r.x1 -= 0.5 * (low_x + high_x);
      r.y0 -= 0.5 * (low_y + high_y), r.y1 -= 0.5 * (low_y + high_y);
    }
  return tags;
}

class BoardRenderer {
 public:
  static constexpr int kSamples = 9;  // rays of a pixel

  BoardRenderer(const capture::Camera& camera, const calibration::Board& board) : camera_(camera) {
    for (const auto& [id, rectangles] : read_page(calibration::board_svg(board)))
      for (const Rectangle& r : rectangles) all_.push_back(r);
    // rectangles by columns of a fine grid, so that a ray asks few of them
    for (const Rectangle& r : all_)
      half_x_ = std::max(half_x_, std::abs(r.x0)), half_y_ = std::max(half_y_, std::abs(r.y0));
    margin_ = board.spacing;
    cells_.resize(kGrid * kGrid);
    for (std::size_t i = 0; i < all_.size(); ++i)
      for (int v = cell(all_[i].y0, half_y_); v <= cell(all_[i].y1, half_y_); ++v)
        for (int u = cell(all_[i].x0, half_x_); u <= cell(all_[i].x1, half_x_); ++u)
          cells_[v * kGrid + u].push_back(static_cast<int>(i));
    rays_.resize(static_cast<std::size_t>(camera.width) * camera.height * kSamples);
    // a Fibonacci lattice that is shifted by chance in every pixel: a regular grid would round the place of an edge
    // that runs along the pixels to a third of one
    core::Random random(1);
    for (std::size_t i = 0; i < rays_.size(); i += kSamples) {
      const double x = static_cast<double>(i / kSamples % camera.width),
                   y = static_cast<double>(i / kSamples / camera.width);
      const double shift_x = random.uniform(), shift_y = random.uniform();
      for (int s = 0; s < kSamples; ++s)
        rays_[i + s] = ray(x + std::fmod(s / double(kSamples) + shift_x, 1.0),
                           y + std::fmod(0.618033988749895 * s + shift_y, 1.0));
    }
  }

  // Gray levels, `black` and `white` of the print on a background between them; blurred by a Gaussian of `blur` px,
  // with noise of `noise` gray levels.
  capture::Image8 image(const math::Pose& camera_from_board, double blur, double noise, core::Random& random) const {
    constexpr double kBlack = 30.0, kWhite = 215.0, kBackground = 110.0;
    const math::Pose board_from_camera = camera_from_board.inverse();
    const int width = camera_.width, height = camera_.height;
    std::vector<float> light(static_cast<std::size_t>(width) * height, kBackground);
    const math::Vector3 origin = board_from_camera.translation;
    // Rays of one pixel differ by a pixel's diagonal, which moves the place where they meet the page by less than this
    // times t^2 and the length of the direction, with twice as much for lenses that stretch: where the first one passes
    // the page farther away than that, so do all.
    const double spread = 4.0 * M_SQRT2 / std::min(camera_.fx, camera_.fy) / std::max(origin.z(), 1e-6);
    for (std::size_t i = 0; i < light.size(); ++i) {
      double sum = 0.0;
      for (int s = 0; s < kSamples; ++s) {
        const std::array<float, 2>& r = rays_[i * kSamples + s];
        const math::Vector3 direction = board_from_camera.rotation * math::Vector3(r[0], r[1], 1.0);
        const double t = -origin.z() / direction.z();
        const double x = origin.x() + t * direction.x(), y = origin.y() + t * direction.y();
        const bool ahead = t > 0 && origin.z() > 0;
        const bool page = ahead && std::abs(x) < half_x_ + margin_ && std::abs(y) < half_y_ + margin_;
        sum += !page ? kBackground : black(x, y) ? kBlack : kWhite;
        const double near = spread * t * t * direction.norm();
        if (s == 0 && ahead && (std::abs(x) > half_x_ + margin_ + near || std::abs(y) > half_y_ + margin_ + near)) {
          sum = kSamples * kBackground;
          break;
        }
      }
      light[i] = static_cast<float>(sum / kSamples);
    }
    if (blur > 0.0) light = blurred(blurred(light, width, height, blur, true), width, height, blur, false);
    capture::Image8 out{width, height, 1, {}};
    for (const float value : light)
      out.pixels.push_back(static_cast<std::uint8_t>(std::clamp(value + noise * random.normal(), 0.0, 255.0) + 0.5));
    return out;
  }

 private:
  static constexpr int kGrid = 96;
  static int cell(double x, double half) {
    return std::clamp(static_cast<int>((x + half) / (2.0 * half) * kGrid), 0, kGrid - 1);
  }
  bool black(double x, double y) const {
    if (std::abs(x) > half_x_ || std::abs(y) > half_y_) return false;
    for (const int i : cells_[cell(y, half_y_) * kGrid + cell(x, half_x_)])
      if (x >= all_[i].x0 && x < all_[i].x1 && y >= all_[i].y0 && y < all_[i].y1) return true;
    return false;
  }
  // Where the light of an image point comes from: (x/z, y/z). Pixel (0, 0) is centered at (0.5, 0.5).
  std::array<float, 2> ray(double u, double v) const {
    const auto& [k1, k2, p1, p2, k3] = camera_.distortion;
    const double bent_x = (u - camera_.cx) / camera_.fx, bent_y = (v - camera_.cy) / camera_.fy;
    double x = bent_x, y = bent_y, change = 1.0;
    for (int i = 0; i < 60 && change > 1e-10; ++i) {  // a thousandth of a float's last digit
      const double rr = x * x + y * y, radial = 1 + k1 * rr + k2 * rr * rr + k3 * rr * rr * rr;
      const double dx = 2 * p1 * x * y + p2 * (rr + 2 * x * x), dy = p1 * (rr + 2 * y * y) + 2 * p2 * x * y;
      const double next_x = (bent_x - dx) / radial, next_y = (bent_y - dy) / radial;
      change = std::abs(next_x - x) + std::abs(next_y - y);
      x = next_x, y = next_y;
    }
    return {static_cast<float>(x), static_cast<float>(y)};
  }
  static std::vector<float> blurred(const std::vector<float>& in, int width, int height, double sigma, bool across) {
    const int reach = static_cast<int>(std::ceil(4.0 * sigma));
    std::vector<double> kernel;
    double sum = 0.0;
    for (int i = -reach; i <= reach; ++i)
      kernel.push_back(std::exp(-0.5 * i * i / (sigma * sigma))), sum += kernel.back();
    std::vector<float> out(in.size());
    std::vector<double> row(width);
    for (int y = 0; y < height; ++y) {
      std::fill(row.begin(), row.end(), 0.0);
      for (int i = -reach; i <= reach; ++i) {  // tap by tap along a row, so that only its ends are clamped
        const double weight = kernel[i + reach];
        const float* const from =
            in.data() + static_cast<std::size_t>(across ? y : std::clamp(y + i, 0, height - 1)) * width;
        const int shift = across ? i : 0, first = std::max(0, -shift), last = std::min(width, width - shift);
        for (int x = 0; x < first; ++x) row[x] += weight * from[0];
        for (int x = first; x < last; ++x) row[x] += weight * from[x + shift];
        for (int x = last; x < width; ++x) row[x] += weight * from[width - 1];
      }
      for (int x = 0; x < width; ++x) out[static_cast<std::size_t>(y) * width + x] = static_cast<float>(row[x] / sum);
    }
    return out;
  }

  capture::Camera camera_;
  std::vector<Rectangle> all_;
  std::vector<std::vector<int>> cells_;
  std::vector<std::array<float, 2>> rays_;
  double half_x_ = 0.0, half_y_ = 0.0, margin_ = 0.0;
};

}  // namespace chainsplat::test
