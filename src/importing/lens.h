// src/importing/lens.h - lens models that a capture cannot hold (formats.md 1.3 has k1, k2, p1, p2, k3 alone), brought
// into one that it can: the five coefficients of the same lens where they say the same, else images without distortion.
#pragma once
#include <array>
#include <optional>
#include <vector>

#include "chainsplat/capture.h"

namespace chainsplat::importing {

enum class LensModel {
  opencv,    // k1 k2 p1 p2 k3
  rational,  // k1 k2 p1 p2 k3 k4 k5 k6: divided by 1 + k4 r^2 + k5 r^4 + k6 r^6
  fisheye    // k1 k2 k3 k4 of the angle from the axis: t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8), equidistant
};

struct Lens {
  double fx = 0.0, fy = 0.0, cx = 0.0, cy = 0.0;  // px
  LensModel model = LensModel::opencv;
  std::vector<double> coefficients = {};  // as many as the model has; missing ones are 0
};

// Image position (x/z, y/z) without distortion to recorded pixel; none where the point cannot be seen.
math::Vector2 distort(const Lens& lens, const math::Vector2& point);

// The lens as a capture's camera (without name, size and pose), and how far it is from the true one at most, px.
// None where no five coefficients come within kLensTolerance of it everywhere in the image.
constexpr double kLensTolerance = 0.05;  // px
struct FittedLens {
  capture::Camera camera;
  double error = 0.0;  // px; 0: the same model
};
std::optional<FittedLens> as_capture_lens(const Lens& lens, int width, int height);

// A camera without distortion that sees what the lens sees, up to kWidestAngle from the axis, at the same scale in the
// middle; and where in the recorded image each of its pixels comes from (2 x pixels, px; NaN: from nowhere).
struct Undistortion {
  capture::Camera camera;
  Eigen::Matrix2Xf from;
};
Undistortion undistortion(const Lens& lens, int width, int height);
// Resampled bilinearly; black outside.
capture::Image8 undistort(const Undistortion& undistortion, const capture::Image8& image);

}  // namespace chainsplat::importing
