// What is known beforehand of what a recording may be given wrongly: priors with heavy tails, and where masks begin
// (mathematics.md 6.10, 'Heavy tails', 'Fingers', 'Which of two').
#pragma once
#include <vector>

#include "src/silhouette/correction_layout.h"

namespace chainsplat::silhouette {

// Whether all masks may begin anywhere, or those begin at the grasp that do so nearly.
enum class Starts { anywhere, at_grasp };

// What the priors tell of each shared unknown at x, in units of its deviation. Their tails are heavy, since
// most recordings are right in most things, and wrong by much in a few. `start_deviations`: by camera, how little its
// masks tell of where the rope leaves the gripper, m along it.
struct SharedPrior {
  math::VectorX information, gradient;  // curvature (never negative) and derivative of the penalty
};
SharedPrior shared_prior(const Layout& layout, const math::VectorX& x, Starts starts,
                         const std::vector<double>& start_deviations);

// What a change of the shared unknowns costs where the beginnings of the masks follow it as well as they can.
struct Followed {
  math::MatrixX cost;    // of all shared unknowns, 0 for those of `starts`: xT cost x is what square residuals grow by
  math::MatrixX follow;  // change of `starts` by that of `others`
  std::vector<int> starts, others;  // the unknowns that say where masks begin, and the rest
};
// Where masks begin is free: fingers hide a piece of the rope in many recordings that are right. So the outlines'
// `information` of all else is that with the starts at their best.
Followed cost_of_change(const Layout& layout, const math::MatrixX& information);

// -ln of how likely it is, but for constants, that just these directions are wrong, and by x: of the priors' density
// there (where masks begin in units of 1 mm), and of the share that the outlines leave of what the priors leave open.
// `cost`: Followed::cost.
double surprise_of(const Layout& layout, const math::MatrixX& directions, const math::MatrixX& cost,
                   const math::VectorX& x, const std::vector<double>& start_deviations);

}  // namespace chainsplat::silhouette
