// viewpoint.h - pictures with the rope's pose at their moment, and how wide a rope they show.
#pragma once
#include <span>
#include <vector>

#include "chainsplat/capture.h"
#include "chainsplat/chain.h"
#include "chainsplat/math.h"

namespace chainsplat::recognition {

struct Viewpoint {
  const capture::Camera* camera = nullptr;
  const capture::PackedView* view = nullptr;
  std::span<const math::Pose> motions;  // of the links, at its moment
};

// The pixel (r, g, b, mask) of the rope that shows this point of the world; null where something else is seen there.
const std::uint8_t* pixel_of(const capture::Camera& camera, const capture::View& view, const math::Vector3& world);

// Of places along the posed rope, by arclength, m: which lie in the view's mask. Something hides the others.
std::vector<char> shown(const chain::Chain& chain, const capture::Camera& camera, const capture::View& view,
                        std::span<const math::Pose> motions, std::span<const double> arclengths);

// What a pixel of the nearest of these pictures covers of the rope, m; 0 where none has the rope before its camera.
double pixel_footprint(const chain::Chain& chain, std::span<const Viewpoint> views);

// The radius that masks show along the rope, which a connector at the tip or a knot makes larger than the given one.
struct Radii {
  double spacing = 0.0;               // m of arclength between values, from half of it on
  std::vector<double> radius;         // m
  double at(double arclength) const;  // the largest of the nearest value and its neighbors
};
// Median over the views and both sides, where a view sees the rope from the side and nothing hides its middle; nowhere
// less than the given radius.
Radii radii_in(const chain::Chain& chain, std::span<const Viewpoint> views);

}  // namespace chainsplat::recognition
