// track.h - tracking over time whether and where the rope is touched: a hidden Markov chain whose states are 'nowhere'
// and the places.
#pragma once
#include <vector>

#include "chainsplat/force.h"

namespace chainsplat::force {

struct Track {
  std::vector<double> arclengths;  // m, the places
  VectorX clock;                   // deviations by which the base's clock may be off, tried side by side
  double odds = 1.0;               // prior odds of no contact against a contact
  Options options;
};

// Returns the prior belief. Beliefs are probabilities: a row for 'nowhere', then one for each place; a column for each
// of `clock`, which stays as it is over time.
MatrixX first_belief(const Track& track);
// Returns that about the clock alone, one number for each of `clock`.
VectorX first_clock(const Track& track);
// Returns the transition matrix of the places to a time `interval` s later; one column per state before.
MatrixX transition(const Track& track, double interval);
// Returns the likelihood of the observation at a time, up to a factor, from log likelihoods; shaped as a belief.
// `interval`: s since the previous time. Errors are correlated over time, so that evidence counts only in part when it
// follows shortly.
MatrixX likelihood(const Track& track, const MatrixX& logs, double interval);
// Returns the belief after an observation by Bayes' rule.
MatrixX posterior(const MatrixX& before, const MatrixX& likely);

}  // namespace chainsplat::force
