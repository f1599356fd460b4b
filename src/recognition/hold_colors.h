// hold_colors.h - the colors of Gaussians from directions in which no camera saw them.
#pragma once
#include <span>

#include "chainsplat/chain.h"
#include "chainsplat/splat.h"
#include "src/recognition/viewpoint.h"

namespace chainsplat::recognition {

// Colors that are linear in the direction (SH degree 1) are fitted to the few from which cameras saw a Gaussian, and
// rise or fall on beyond these. Here an SH of degree 2 takes the place of that of degree 1, fitted to the colors at the
// directions that were seen and to held ones at all others from which the surface can be seen. A held color is that of
// the nearest direction that was seen where cameras faced the surface; the flatter they saw it, the more it becomes the
// color of the texture around it, which one row of pixels at the limb does not tell. What is guessed, seen from hardly
// anywhere, or has no side as it lies near the axis keeps its colors. All Gaussians are of degree 2 then. (design.md,
// 'Recognition'.)
void hold_colors(const chain::Chain& chain, std::span<const Viewpoint> views, splat::Gaussians& gaussians);

}  // namespace chainsplat::recognition
