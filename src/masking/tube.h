// The chain's tube in a picture: the signed distance of each pixel from its outline.
#pragma once
#include <vector>

#include "chainsplat/capture.h"
#include "chainsplat/chain.h"
#include "chainsplat/rectangle.h"

namespace chainsplat::masking {

struct Tube {
  math::Rectangle box;
  std::vector<float> outside;  // px to the outline, negative inside; kFar beyond the requested reach
  std::vector<float> along;    // m, arclength of the nearest point of the centerline
  std::vector<char> left;      // whether it is left of the centerline, seen toward the free end in the picture
  double radius = 0.0;         // px, mean along the rope
  float at(int x, int y) const {
    if (x < box.x0 || y < box.y0 || x >= box.x1 || y >= box.y1) return kFar;
    return outside[static_cast<std::size_t>(y - box.y0) * box.width() + (x - box.x0)];
  }
  float arclength(int x, int y) const {  // for pixels in the box
    return along[static_cast<std::size_t>(y - box.y0) * box.width() + (x - box.x0)];
  }
  bool is_left(int x, int y) const {  // for pixels in the box
    return left[static_cast<std::size_t>(y - box.y0) * box.width() + (x - box.x0)] != 0;
  }
  static constexpr float kFar = 1e6f;
};

struct AxisPoint {
  math::Vector2 at;        // px
  double radius = 0.0;     // px
  double arclength = 0.0;  // m
};
// The axis of a tube in a picture, of at least two points, or empty where the rope is behind the camera.
struct Axis {
  std::vector<AxisPoint> points;
  double bulge = 0.0;  // radii, half the short axis of the free end's disc as an ellipse in the picture
};
Axis axis(const chain::Chain& chain, const math::Pose& base, const math::VectorX& theta, const capture::Camera& camera,
          double from, double to);
// The tube about an axis in a picture of this size.
Tube tube(const Axis& axis, int width, int height, double reach);

// Projects a cylinder bent along the chain, flat where it begins and with the ellipse of its end disc where it ends.
// `from`, `to`: arclengths in m; beyond the free end it continues straight. `reach`: px beyond the outline that are
// filled in. The camera must have no distortion.
Tube tube(const chain::Chain& chain, const math::Pose& base, const math::VectorX& theta, const capture::Camera& camera,
          double from, double to, double reach);

}  // namespace chainsplat::masking
