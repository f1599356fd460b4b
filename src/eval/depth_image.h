// depth_image.h - Chamfer distance of what two depth images of one camera show (SPEC 9), without a tree where they are
// close to each other.
#pragma once
#include "chainsplat/capture.h"

namespace chainsplat::eval {

// Depth of a rectangle of recorded pixels, m along the camera's z, 0 = none.
struct DepthImage {
  int x0 = 0, y0 = 0, width = 0, height = 0;
  std::vector<float> depth;  // width * height
};

// chamfer() of the two images' points; both of the same rectangle.
double chamfer(const DepthImage& p, const DepthImage& q, const capture::Camera& camera);

}  // namespace chainsplat::eval
