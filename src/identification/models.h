// Private to identification: what a rope has beside what every rope has, chosen by evidence (mathematics.md 5.10).
#pragma once
#include "fit.h"

namespace chainsplat::identification {

struct Candidate {
  Extras extras;
  Problem problem;
  Fit fit;
  double lack = kInfinity;  // of evidence
};

// The chain's own fit. `rough`: the same recordings for a chain of few joints, whose parameters it begins with; or
// none. What few joints ask for beside a rope's own is tried, and the many decide: straight links that are long cannot
// follow what the rope does near the grasp, and friction or a payload would stand for that.
Candidate fit_chain(const chain::Chain& chain, const std::vector<Part>& parts, const std::vector<Part>& rough,
                    const Options& options);

}  // namespace chainsplat::identification
