// unseen.h - what no camera saw of a rope, so that it looks like a rope from there, too.
#pragma once
#include <span>

#include "chainsplat/chain.h"
#include "chainsplat/math.h"
#include "chainsplat/splat.h"

namespace chainsplat::recognition {

// Where a picture was taken from, and the link motions of its moment.
struct Viewpoint {
  math::Vector3 center = math::Vector3::Zero();  // of the camera, world, m
  std::span<const math::Pose> motions;
};

// Gaussians on the side of the tube that faces none of `views` have no gradient: they stay as they were placed. They
// are put flat onto the surface, at the radius of those that were seen, and get the colors that the texture has around
// the axis at their place: ropes are laid or braided, so that what repeats does so along a helix, whose slope is found
// from what was seen; where nothing repeats, the color at the same arclength. design.md, 'Recognition'. Returns how
// many these are.
int finish_unseen(const chain::Chain& chain, std::span<const Viewpoint> views, splat::Gaussians& gaussians);

}  // namespace chainsplat::recognition
