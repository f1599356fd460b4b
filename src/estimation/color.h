// color.h - the rope's colors as a measurement of its angles: the information that a picture has beyond its outline.
//
// Only pixels inside the mask count, away from its edge and from that of the drawn rope: the edges are the silhouette's
// measurement, and what hides the rope is not in the mask. The frame's exposure, a gain and a bias, is solved for and
// eliminated (design.md, 'Recognition').
#pragma once
#include "src/estimation/state.h"

namespace chainsplat::estimation {

struct ColorEquations {        // of one view, for the residual r = gain * drawn + bias - recorded
  math::MatrixX normal;        // n x n: J^T W J, exposure eliminated
  math::VectorX right;         // n: J^T W r, exposure eliminated
  math::MatrixX coupling;      // n x m: J^T W J_y, with J_y by the rope's twists, exposure eliminated
  math::MatrixX shared;        // m x m: J_y^T W J_y, likewise
  math::VectorX shared_right;  // m: J_y^T W r, likewise
  double weight = 0.0;         // sum of the robust weights, one per pixel and channel
  double square = 0.0;         // weighted sum of the squared residuals
  double gain = 1.0, bias = 0.0;
  std::optional<double> likeness;  // as in Estimate
};

// Returns the normal equations of one view. `sums`: of that view, with the twin drawn at theta. `rope_twists`: 6 x m,
// of the whole rope about the world's origin.
ColorEquations color_equations(const chain::Chain& chain, const math::Pose& base, const math::VectorX& theta,
                               const splat::ColorSums& sums, const math::MatrixX& rope_twists);

// What the colors of a frame have done to a belief, and what they say of the setup: sums over the views of what
// ColorEquations holds, per variance, about the mean before; empty where they say nothing.
struct ColorEvidence {
  math::MatrixX normal, coupling, shared;
  math::VectorX right, shared_right;
  math::MatrixX gain;  // of the whole mean by n: the mean has changed by -gain right
};
// Adds what they say of the setup to what the outlines say. `by_setup`: how the belief before the colors changes with
// the setup; afterwards how it does with them.
void add_colors(const ColorEvidence& colors, math::MatrixX& by_setup, silhouette::SetupEquations& frame);

// Updates the belief with the colors inside the masks, and tells in `out` how they fit; how the belief changes with the
// setup stays as it was. The drawn rope must be within a stripe's width of the real one.
ColorEvidence look_at_colors(const State& state, std::span<const capture::View* const> views, Belief& belief,
                             Estimate& out);

}  // namespace chainsplat::estimation
