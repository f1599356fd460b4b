// place_gaussians.h - Gaussians where the rope is: at first along the links, later where the images are not explained,
// and never far past the joints of their own link.
#pragma once
#include <span>
#include <vector>

#include "chainsplat/capture.h"
#include "chainsplat/chain.h"
#include "chainsplat/core.h"
#include "chainsplat/splat.h"
#include "src/recognition/frames.h"
#include "src/recognition/viewpoint.h"

namespace chainsplat::recognition {

// `count` Gaussians in the shell of the rope's tube (home configuration), hard on their own link, colored by the views
// that see their side, as it is in `light`. Deterministic for one `random`.
splat::Gaussians place_along_chain(const chain::Chain& chain, const capture::Capture& capture,
                                   const chain::States& states, const std::vector<FrameViews>& frames,
                                   std::span<const int> training, const splat::Light& light, int count,
                                   core::Random& random);

// Pixels of a view that a picture of it, drawn with these link motions, does not explain.
struct Unexplained {
  std::vector<math::Pose> motions;
  std::vector<int> pixels;     // of the crop, row-major
  std::vector<double> errors;  // of each, squared
};
Unexplained unexplained(const capture::PackedView& view, const splat::Picture& picture,
                        const std::vector<math::Pose>& motions);

// A view, and what is not explained of it.
struct Drawn {
  const capture::PackedView* view = nullptr;
  const Unexplained* left = nullptr;
};

// Removes Gaussians whose opacity is below `least_opacity` or that are larger than the rope, then adds up to `budget`
// where color or mask error is largest (drawn in proportion to the squared error), carried back to the home
// configuration by the nearest link. Returns how many were removed and added.
struct Changed {
  int removed = 0, added = 0;
};
Changed add_and_prune(splat::Gaussians& gaussians, const chain::Chain& chain, const capture::Capture& capture,
                      std::span<const Drawn> drawn, int budget, int most_added, core::Random& random);

// Adam lets Gaussians grow across joints, where they tear open or cover what is behind when a joint bends, and base
// colors leave what a picture can show, which other viewers cut. Base colors are cut to [0, 1]; a Gaussian becomes its
// place's link's, and is compressed along the rope until it reaches at most `past`, m, beyond that link's joints, at
// two standard deviations. The rope's ends are no joints. For Gaussians that are hard on one link.
// Few views also leave places beside the rope that all of their masks cover, where nothing pulls a Gaussian away: with
// `radii` it is compressed across the rope and moved inward until it reaches not much farther than the rope is wide.
void bound_gaussians(const chain::Chain& chain, splat::Gaussians& gaussians, double past, const Radii* radii = nullptr);

}  // namespace chainsplat::recognition
