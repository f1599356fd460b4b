// depth_image.h - Chamfer distance (mathematics.md 9) of the points of two depth images of one camera, without a search
// tree where they are close to each other.
#pragma once
#include "chainsplat/capture.h"

namespace chainsplat::eval {

// Depth of a rectangle of recorded pixels: m along the camera's z, 0 = none.
struct DepthImage {
  int x0 = 0, y0 = 0, width = 0, height = 0;
  std::vector<float> depth;  // width * height
};

// Chamfer distance (m) of the points of two images of the same rectangle; NaN if one has none.
double chamfer(const DepthImage& p, const DepthImage& q, const capture::Camera& camera);

}  // namespace chainsplat::eval
