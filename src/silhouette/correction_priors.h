// What is known beforehand of what a recording may be given wrongly: priors with heavy tails, and where masks begin
// (mathematics.md 6.10, 'Heavy tails', 'Fingers', 'Which of two').
#pragma once
#include <vector>

#include "src/silhouette/correction_layout.h"

namespace chainsplat::silhouette {

// Whether all masks may begin anywhere, or those begin at the grasp that do so nearly.
enum class Starts { anywhere, at_grasp };

// Information of the priors about each shared unknown at x, in units of its deviation. `start_deviations`: how little
// each camera's masks tell of where the rope leaves the gripper, m along it.
math::VectorX prior_weights(const Layout& layout, const math::VectorX& x, Starts starts,
                            const std::vector<double>& start_deviations);

// The square of a change of the shared unknowns, by which the outlines' residuals grow.
struct Followed {
  math::MatrixX cost;    // of all shared unknowns, 0 for where masks begin, which is at its best
  math::MatrixX follow;  // how that follows the others: starts x others
  std::vector<int> starts, others;
};
// Where masks begin is free: fingers hide a piece of the rope in many recordings that are right. So the outlines'
// `information` of all else is that with the starts at their best.
Followed cost_of_change(const Layout& layout, const math::MatrixX& information);

// -ln of how likely it is, but for constants, that just these directions are wrong, and by x: prior_surprise(), and of
// the share that the outlines leave of what the priors leave open.
double surprise_of(const Layout& layout, const math::MatrixX& directions, const math::MatrixX& cost,
                   const math::VectorX& x, const std::vector<double>& start_deviations);

}  // namespace chainsplat::silhouette
