// reach.h - the pixels that Gaussians can reach, however the links move.
#pragma once
#include <vector>

#include "chainsplat/capture.h"
#include "chainsplat/rectangle.h"
#include "chainsplat/splat.h"

namespace chainsplat::render {

// A Gaussian on a link to which it is bound enough to be visible there.
struct Replica {
  int link;
  math::Vector3 mean;       // in the home frame of the chain, m
  math::Matrix3 half_axes;  // R(q) diag(s), m
  double reach;             // standard deviations out to where its alpha falls to 1/255
};

// All visible replicas. They do not depend on where the links are, so that one list serves all frames.
std::vector<Replica> visible_replicas(const splat::Gaussians& gaussians);

// As render::reach, of replicas that were found before.
// `motions` are those of chain::link_motions, `pixel_footprint` is Gaussians::pixel_footprint.
math::Rectangle reach(const std::vector<Replica>& replicas, double pixel_footprint,
                      const std::vector<math::Pose>& motions, const capture::Camera& camera);

}  // namespace chainsplat::render
