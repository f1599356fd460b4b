// The rope in pictures of one moment, before anything is known of its colors: where a tube of the known length and
// diameter, begun at the grasp, best parts the colors inside from those beside it.
//
// A chain is laid link by link, in space, so that all cameras must agree. Its evidence is a Bayes factor: the sampled
// colors inside and beside the tube as two populations, against one (each a Dirichlet-multinomial, so that few samples
// prove little and a color unheard of speaks for neither). What hides the rope from a camera is one population and
// counts nothing.
#pragma once
#include <span>

#include "chainsplat/masking.h"

namespace chainsplat::masking {

// A picture of the moment.
struct Shot {
  Picture picture;  // undistorted
  const capture::Camera* camera = nullptr;
  math::Pose camera_from_base;
};

// Colors sampled inside and beside the tube, by coarse color.
struct Tally {
  std::vector<int> inside, beside;  // 8^3; empty: nothing known
  int inside_sum = 0, beside_sum = 0;
};
// Adds `other`; `most`: samples beyond which the sum is scaled down.
void add(Tally& tally, const Tally& other);
// As if of `samples` samples a side.
Tally scaled(const Tally& tally, int samples);

struct Grown {
  math::VectorX theta;
  double evidence = 0.0;       // log of the Bayes factor a sample, 0 (none) to log 2 (all colors tell)
  std::vector<Tally> tallies;  // by shot: of this moment alone
};

// `known`: by shot, what other moments have told of the colors; empty: nothing.
Grown grow(const chain::Chain& chain, std::span<const Shot> shots, std::span<const Tally> known);

}  // namespace chainsplat::masking
