// One rope in all pictures of a moment: the chain and the width whose tube fits the outlines that were found in each
// picture by itself.
//
// Cameras see the rope's two sides along different lines, so that an outline that is none of the rope's, as that of a
// shadow or of a board's joint beside it, fits no tube together with the others. It counts the less, the farther it is
// from the tube.
#pragma once
#include <span>

#include "src/masking/ribbon.h"

namespace chainsplat::masking {

struct OneRope {
  math::VectorX theta;
  math::Vector3 shift = math::Vector3::Zero();  // m, base frame: the grasp is off by this
  double width = 1.0;                           // as a share of the chain's diameter
};

// The outlines in one picture.
struct Outlined {
  const capture::Camera* camera = nullptr;  // without distortion
  math::Pose base;                          // world
  const Ribbon* ribbon = nullptr;           // not empty
};

// How sure is what is known of the rope: deviations.
struct Leeway {
  double width = 0.1;         // of the width about that of the start,
  double grasp = 0.006;       // m, of the shift,
  double bend_change = 0.17;  // rad, and of the difference of neighboring joints' angles
};

// The rope near `start`. `seen`: at least two pictures.
OneRope fit_one_rope(const chain::Chain& chain, std::span<const Outlined> seen, const OneRope& start,
                     const Leeway& leeway = {});

}  // namespace chainsplat::masking
