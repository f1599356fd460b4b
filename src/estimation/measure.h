// measure.h - the masks as a measurement of the state (mathematics.md 6.4).
#pragma once
#include "src/estimation/state.h"

namespace chainsplat::estimation {

struct Measured {
  silhouette::FrameFit fit;
  Belief belief;          // posterior; how it changes with the setup is still that of the prediction
  math::MatrixX gain;     // by which the whole mean follows the angles
  double surprise = 0.0;  // squared innovation over its expectation
};

// Updates `predicted` with the views' silhouettes. Only a share of the fit's variance is independent of earlier frames:
// the prior is tightened in proportion, which gives the same angles as weakening the data, and the covariance is
// widened again. `warm`: the rope is near the prediction. Throws WorkError.
Measured measure(const State& state, const Belief& predicted, std::span<const capture::View* const> views, bool warm);

}  // namespace chainsplat::estimation
