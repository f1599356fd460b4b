// color.h - the rope's colors as a measurement of its angles: what a picture of the twin tells beside its outline.
//
// Only pixels inside the mask count, away from its edge and from the drawn rope's: the silhouette has told the rest,
// and what hides the rope is not in the mask. The frame's exposure, a gain and a bias, is solved for and eliminated.
// DESIGN, 'Recognition'.
#pragma once
#include "chainsplat/estimation.h"

namespace chainsplat::estimation {

struct ColorEquations {  // of one view; residual r = gain * drawn + bias - seen
  math::MatrixX normal;  // n x n: J^T W J, exposure eliminated
  math::VectorX right;   // n: J^T W r
  double weight = 0.0;   // sum of the robust weights, one a pixel and channel
  double square = 0.0;   // weighted sum of the squared residuals
  double gain = 1.0, bias = 0.0;
  std::optional<double> likeness;  // as in Estimate
};

// `sums`: of the view, the twin at theta.
ColorEquations color_equations(const chain::Chain& chain, const math::Pose& base, const math::VectorX& theta,
                               const splat::ColorSums& sums);

}  // namespace chainsplat::estimation
