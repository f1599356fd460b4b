// growth.h - Gaussians are added where the images pull at them, and go where nothing shows them: the adaptive density
// control of 3DGS (Kerbl et al. 2023, section 5), with ScrewSplat's threshold, for the paper's procedure.
#pragma once
#include <vector>

#include "chainsplat/core.h"
#include "chainsplat/splat.h"

namespace chainsplat::recognition {

// What the steps since the last change say of each Gaussian.
struct Pull {
  std::vector<double> sum;  // norms of the loss gradient by the center in normalized device coordinates (-1 to 1)
  std::vector<int> steps;   // in which a pixel showed it
};

// Adds the gradient of one step on one view. `loss_scale` turns the step's loss into a mean over the whole image, for
// which the threshold is meant; `per_meter`: normalized device coordinates per meter across the view.
void add_step(const splat::Gaussians& gradient, double loss_scale, double per_meter, Pull& pull);

struct GrowthLimits {
  double extent = 1.0;            // m, of the scene: Gaussians above a hundredth of it are split, others doubled
  double pixels_per_meter = 0.0;  // at the rope
  bool prune_large = false;       // those that cover too many pixels, after the first reset of opacities
  int most = 0;                   // Gaussians, from where on none is added
};

// Rows that stay as they are, and the new ones: copies of those that are pulled, and the halves of large ones.
struct Grown {
  std::vector<int> kept;
  splat::Gaussians added;
};
Grown grow(const splat::Gaussians& gaussians, const Pull& pull, const GrowthLimits& limits, core::Random& random);

}  // namespace chainsplat::recognition
