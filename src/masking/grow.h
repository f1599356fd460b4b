// The rope in pictures of one moment, before its colors are known: where a tube of the known length and diameter that
// begins at the grasp best separates the colors inside from those on either side of it.
//
// A chain is laid link by link, in space, so that all cameras must agree. Its evidence has two parts. Colors: the Bayes
// factor of two populations, the sampled colors inside and beside the tube, against a single one. Each population is a
// Dirichlet-multinomial, so that few samples prove little and an unknown color favors neither; the side that differs
// less counts, since one alone is a step, as at a window's edge, and no rope. Outlines: how seldom a place of this
// picture, taken at random, contrasts as much with both sides at the rope's width. Where something hides the rope from
// a camera there is only one population, which adds no evidence. What is known besides (gravity, by how much the grasp
// may be off) joins as a prior. Of two ropes the one that runs through more of the user's points is the better one.
#pragma once
#include <optional>
#include <span>

#include "src/masking/look.h"

namespace chainsplat::masking {

// One camera's picture of the moment.
struct Shot {
  Picture picture;  // undistorted
  const capture::Camera* camera = nullptr;
  math::Pose camera_from_base;
  std::vector<math::Vector2> on_rope;  // px, undistorted: points that the user says lie on the rope
  std::optional<math::Rectangle> bounds;  // the rope lies in here
};

// What is known of the rope besides its size.
struct Clues {
  math::Vector3 down = math::Vector3::Zero();   // unit, base frame, where it hangs at rest; zero: it need not
  math::Vector3 grasp = math::Vector3::Zero();  // m, base frame: the grasp is thought to be off by this,
  math::VectorX shape;      // rad, angles that are likely, as of a rope that rests; empty: not known
  double bend_change = 0.0;      // rad, by which neighboring joints' angles differ, as in a stiff cable; 0: unknown
  double grasp_deviation = 0.0;  // m, and how sure that is; 0: it is exactly there
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
  math::Vector3 shift = math::Vector3::Zero();  // m, base frame: the grasp is off by this
  double margin = 1e9;         // nats, by which the best rope that ends elsewhere is worse; large where there is none
  double evidence = 0.0;       // nats per sample, log of the Bayes factor: 0 (none) to log 2 (colors never shared)
  std::vector<Tally> tallies;  // per shot, of this moment alone
};

// Grows a chain without twist joints. `known`: per shot, the colors known from other moments; empty: none.
Grown grow(const chain::Chain& chain, std::span<const Shot> shots, std::span<const Tally> known,
           const Clues& clues = {});

}  // namespace chainsplat::masking
