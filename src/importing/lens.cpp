#include "lens.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>
#include "src/math/decompositions.h"

namespace chainsplat::importing {

using math::Vector2;
using math::VectorX;

namespace {

constexpr int kGrid = 24;                                       // points along each side of the image
constexpr double kWidestAngle = 60.0 * std::numbers::pi / 180;  // beyond, a flat image grows without use
constexpr double kMostGrowth = 2.0;                             // of a side of the undistorted image
constexpr int kNewtonSteps = 50;
constexpr double kConverged = 1e-12;  // normalized coordinates

double coefficient(const Lens& lens, std::size_t i) {
  return i < lens.coefficients.size() ? lens.coefficients[i] : 0.0;
}

// Where the lens moves a normalized point to, normalized.
Vector2 bent(const Lens& lens, const Vector2& p) {
  const auto k = [&](std::size_t i) { return coefficient(lens, i); };
  const double r2 = p.squaredNorm();
  if (lens.model == LensModel::fisheye) {
    const double r = std::sqrt(r2), t = std::atan(r), t2 = t * t;
    if (r < 1e-9) return p;
    return p * (t * (1.0 + t2 * (k(0) + t2 * (k(1) + t2 * (k(2) + t2 * k(3))))) / r);
  }
  double radial = 1.0 + r2 * (k(0) + r2 * (k(1) + r2 * k(4)));
  if (lens.model == LensModel::rational) radial /= 1.0 + r2 * (k(5) + r2 * (k(6) + r2 * k(7)));
  const double xy = p.x() * p.y();
  return radial * p + Vector2(2.0 * k(2) * xy + k(3) * (r2 + 2.0 * p.x() * p.x()),
                              k(2) * (r2 + 2.0 * p.y() * p.y()) + 2.0 * k(3) * xy);
}

// The inverse, by Newton's method with numerical slopes; NaN where there is none.
Vector2 straightened(const Lens& lens, const Vector2& recorded) {
  Vector2 p = recorded;
  if (lens.model == LensModel::fisheye) {  // the recorded radius is about the angle
    const double t = std::min(recorded.norm(), 1.5);
    if (t > 1e-9) p = recorded * (std::tan(t) / recorded.norm());
  }
  for (int i = 0; i < kNewtonSteps; ++i) {
    const Vector2 miss = bent(lens, p) - recorded;
    if (miss.norm() < kConverged) return p;
    const double h = 1e-6 * (1.0 + p.norm());
    Eigen::Matrix2d slope;
    for (int c = 0; c < 2; ++c) {
      const Vector2 step = h * Vector2::Unit(c);
      slope.col(c) = (bent(lens, p + step) - bent(lens, p - step)) / (2.0 * h);
    }
    const Vector2 step = slope.fullPivLu().solve(miss);
    if (!step.allFinite()) break;
    p -= step;
  }
  if ((bent(lens, p) - recorded).norm() < 1e-9) return p;
  return Vector2::Constant(std::numeric_limits<double>::quiet_NaN());
}

// Recorded pixels on a grid over the whole image.
std::vector<Vector2> grid(int width, int height) {
  std::vector<Vector2> points;
  for (int j = 0; j <= kGrid; ++j)
    for (int i = 0; i <= kGrid; ++i) points.emplace_back(double(width) * i / kGrid, double(height) * j / kGrid);
  return points;
}

Vector2 normalized(const Lens& lens, const Vector2& pixel) {
  return {(pixel.x() - lens.cx) / lens.fx, (pixel.y() - lens.cy) / lens.fy};
}

capture::Camera pinhole(const Lens& lens, int width, int height) {
  capture::Camera camera;
  camera.width = width, camera.height = height;
  camera.fx = lens.fx, camera.fy = lens.fy, camera.cx = lens.cx, camera.cy = lens.cy;
  return camera;
}

}  // namespace

Vector2 distort(const Lens& lens, const Vector2& point) {
  const Vector2 p = bent(lens, point);
  return {lens.fx * p.x() + lens.cx, lens.fy * p.y() + lens.cy};
}

std::optional<FittedLens> as_capture_lens(const Lens& lens, int width, int height) {
  FittedLens fitted{pinhole(lens, width, height)};
  const bool same =
      lens.model == LensModel::opencv || (lens.model == LensModel::rational && coefficient(lens, 5) == 0.0 &&
                                          coefficient(lens, 6) == 0.0 && coefficient(lens, 7) == 0.0);
  if (same) {
    for (std::size_t i = 0; i < 5; ++i) fitted.camera.distortion[i] = coefficient(lens, i);
    return fitted;
  }
  // the five coefficients enter linearly
  const std::vector<Vector2> pixels = grid(width, height);
  std::vector<Vector2> points;
  math::MatrixX rows(2 * static_cast<Eigen::Index>(pixels.size()), 5);
  VectorX moved(rows.rows());
  for (const Vector2& pixel : pixels) {
    const Vector2 recorded = normalized(lens, pixel), p = straightened(lens, recorded);
    if (!p.allFinite()) return std::nullopt;
    const double r2 = p.squaredNorm(), xy = p.x() * p.y();
    const auto row = 2 * static_cast<Eigen::Index>(points.size());
    rows.row(row) << r2 * p.x(), r2 * r2 * p.x(), 2.0 * xy, r2 + 2.0 * p.x() * p.x(), r2 * r2 * r2 * p.x();
    rows.row(row + 1) << r2 * p.y(), r2 * r2 * p.y(), r2 + 2.0 * p.y() * p.y(), 2.0 * xy, r2 * r2 * r2 * p.y();
    moved.segment<2>(row) = recorded - p;
    points.push_back(p);
  }
  const VectorX found = rows.colPivHouseholderQr().solve(moved);
  if (!found.allFinite()) return std::nullopt;
  for (Eigen::Index i = 0; i < 5; ++i) fitted.camera.distortion[i] = found[i];
  for (std::size_t i = 0; i < points.size(); ++i) {
    const Vector2 straight(lens.fx * points[i].x() + lens.cx, lens.fy * points[i].y() + lens.cy);
    fitted.error = std::max(fitted.error, (capture::distort(fitted.camera, straight) - pixels[i]).norm());
    // the program undoes the model, so it must be undone there, too
    fitted.error = std::max(fitted.error, (capture::undistort(fitted.camera, pixels[i]) - straight).norm());
  }
  if (!(fitted.error < kLensTolerance)) return std::nullopt;
  return fitted;
}

Undistortion undistortion(const Lens& lens, int width, int height) {
  const double widest = std::tan(kWidestAngle);
  Vector2 low = Vector2::Zero(), high = Vector2::Zero();
  for (const Vector2& pixel : grid(width, height)) {
    const Vector2 p = straightened(lens, normalized(lens, pixel));
    if (!p.allFinite() || p.norm() > widest) continue;
    low = low.cwiseMin(p), high = high.cwiseMax(p);
  }
  Undistortion out;
  const auto side = [](double length, int before) {
    return static_cast<int>(std::clamp(std::ceil(length), 1.0, kMostGrowth * before));
  };
  const double left = std::max(-low.x() * lens.fx, 1.0), top = std::max(-low.y() * lens.fy, 1.0);
  out.camera = pinhole(lens, side(left + high.x() * lens.fx, width), side(top + high.y() * lens.fy, height));
  out.camera.cx = std::min(left, 0.5 * kMostGrowth * width);
  out.camera.cy = std::min(top, 0.5 * kMostGrowth * height);
  out.from.resize(2, static_cast<Eigen::Index>(out.camera.width) * out.camera.height);
  for (int y = 0; y < out.camera.height; ++y)
    for (int x = 0; x < out.camera.width; ++x) {
      const Vector2 p((x + 0.5 - out.camera.cx) / lens.fx, (y + 0.5 - out.camera.cy) / lens.fy);
      const Vector2 from = distort(lens, p);
      // a polynomial far outside of the image may lead back into it
      const bool there = p.norm() <= 1.01 * widest && (straightened(lens, normalized(lens, from)) - p).norm() < 1e-3;
      Eigen::Vector2f pixel = Eigen::Vector2f::Constant(std::numeric_limits<float>::quiet_NaN());
      if (there) pixel = from.cast<float>();
      out.from.col(static_cast<Eigen::Index>(y) * out.camera.width + x) = pixel;
    }
  return out;
}

capture::Image8 undistort(const Undistortion& undistortion, const capture::Image8& image) {
  capture::Image8 out{undistortion.camera.width, undistortion.camera.height, image.channels, {}};
  out.pixels.assign(static_cast<std::size_t>(out.width) * out.height * out.channels, 0);
  for (Eigen::Index i = 0; i < undistortion.from.cols(); ++i) {
    const float x = undistortion.from(0, i) - 0.5f, y = undistortion.from(1, i) - 0.5f;  // in pixel centers
    if (!(x > -0.5f && y > -0.5f && x < float(image.width) - 0.5f && y < float(image.height) - 0.5f)) continue;
    const int x0 = static_cast<int>(std::floor(x)), y0 = static_cast<int>(std::floor(y));
    const float a = x - float(x0), b = y - float(y0);
    const auto at = [&](int column, int row, int channel) {
      const int u = std::clamp(column, 0, image.width - 1), v = std::clamp(row, 0, image.height - 1);
      return float(image.pixels[(static_cast<std::size_t>(v) * image.width + u) * image.channels + channel]);
    };
    for (int c = 0; c < image.channels; ++c)
      out.pixels[static_cast<std::size_t>(i) * image.channels + c] =
          static_cast<std::uint8_t>((1 - b) * ((1 - a) * at(x0, y0, c) + a * at(x0 + 1, y0, c)) +
                                    b * ((1 - a) * at(x0, y0 + 1, c) + a * at(x0 + 1, y0 + 1, c)) + 0.5f);
  }
  return out;
}

}  // namespace chainsplat::importing
