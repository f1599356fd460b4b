// The rope in pictures of one moment, before its colors are known: where a tube of the known length and diameter that
// begins at the grasp best separates the colors inside from those beside it.
//
// A chain is laid link by link, in space, so that all cameras must agree. Its evidence is the Bayes factor of two
// populations, the sampled colors inside and beside the tube, against a single one. Each population is a
// Dirichlet-multinomial, so that few samples prove little and an unknown color favors neither. Where something hides
// the rope from a camera there is only one population, which adds no evidence.
#pragma once
#include <span>

#include "chainsplat/masking.h"

namespace chainsplat::masking {

// One camera's picture of the moment.
struct Shot {
  Picture picture;  // undistorted
  const capture::Camera* camera = nullptr;
  math::Pose camera_from_base;
};

// Numbers of samples inside and beside the tube per coarse color.
struct Tally {
  std::vector<int> inside, beside;  // 8^3; empty: nothing known
  int inside_sum = 0, beside_sum = 0;
};
// Adds the numbers of `other`.
void add(Tally& tally, const Tally& other);
// Returns the tally scaled to about `samples` samples per side.
Tally scaled(const Tally& tally, int samples);

struct Grown {
  math::VectorX theta;
  double evidence = 0.0;       // nats per sample, log of the Bayes factor: 0 (none) to log 2 (colors never shared)
  std::vector<Tally> tallies;  // per shot, of this moment alone
};

// Grows a chain without twist joints. `known`: per shot, the colors known from other moments; empty: none.
Grown grow(const chain::Chain& chain, std::span<const Shot> shots, std::span<const Tally> known);

}  // namespace chainsplat::masking
