// color.h - the rope's colors as a measurement of its angles: the information that a picture has beyond its outline.
//
// Only pixels inside the mask count, away from its edge and from that of the drawn rope: the edges are the silhouette's
// measurement, and what hides the rope is not in the mask. The frame's exposure, a gain and a bias, is solved for and
// eliminated (design.md, 'Recognition').
#pragma once
#include "src/estimation/state.h"

namespace chainsplat::estimation {

struct ColorEquations {  // of one view, for the residual r = gain * drawn + bias - recorded
  math::MatrixX normal;  // n x n: J^T W J, exposure eliminated
  math::VectorX right;   // n: J^T W r, exposure eliminated
  double weight = 0.0;   // sum of the robust weights, one per pixel and channel
  double square = 0.0;   // weighted sum of the squared residuals
  double gain = 1.0, bias = 0.0;
  std::optional<double> likeness;  // as in Estimate
};

// Returns the normal equations of one view. `sums`: of that view, with the twin drawn at theta.
ColorEquations color_equations(const chain::Chain& chain, const math::Pose& base, const math::VectorX& theta,
                               const splat::ColorSums& sums);

// Updates the belief with the colors inside the masks, and tells in `out` how they fit. The drawn rope must be within a
// stripe's width of the real one.
void look_at_colors(const State& state, std::span<const capture::View* const> views, Belief& belief, Estimate& out);

}  // namespace chainsplat::estimation
