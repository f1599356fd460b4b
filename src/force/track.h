// track.h - tracking over time whether and where the rope is touched: a hidden Markov chain whose states are 'nowhere'
// and the places.
#pragma once
#include <vector>

#include "chainsplat/force.h"

namespace chainsplat::force {

struct Track {
  std::vector<double> arclengths;  // m, the places
  double odds = 1.0;               // prior odds of no contact against a contact
  Options options;
};

// Returns the prior belief. Beliefs are probabilities: of 'nowhere' first, then of the places.
VectorX first_belief(const Track& track);
// Returns the transition matrix to a time `interval` s later; one column per state before.
MatrixX transition(const Track& track, double interval);
// Returns the likelihood of the observation at a time per state, up to a factor. `evidence`: log likelihood ratio of a
// force at each place to none; `interval`: s since the previous time. Errors are correlated over time, so that evidence
// counts only in part when it follows shortly.
VectorX likelihood(const Track& track, const VectorX& evidence, double interval);
// Returns the belief after an observation by Bayes' rule.
VectorX posterior(const VectorX& before, const VectorX& likely);

}  // namespace chainsplat::force
