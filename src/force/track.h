// track.h - whether the rope is touched, and where, along time: a hidden Markov chain over 'nowhere' and the places.
#pragma once
#include <vector>

#include "chainsplat/force.h"

namespace chainsplat::force {

struct Track {
  std::vector<double> arclengths;  // m, the places
  double odds = 1.0;               // of none over a contact, before anything was seen
  Options options;
};

// Beliefs are probabilities: 'nowhere' first, then the places.
VectorX first_belief(const Track& track);
// From a time to one `interval` later; a column a belief before.
MatrixX transition(const Track& track, double interval);
// How likely what is seen is at a time, up to a factor. `evidence`: log likelihood of a force at each place over that
// of none; `interval`: s since the state before. Errors last, so what is near in time is in part the same news.
VectorX likelihood(const Track& track, const VectorX& evidence, double interval);
// Both together: the belief after what was seen.
VectorX seen(const VectorX& before, const VectorX& likely);

}  // namespace chainsplat::force
