// Where the outlines of a rope are, finer than pixels: the rims of a tube, fitted to the colors about rough outlines.
//
// Where color changes most is inside of a tube, as tubes are dimmer toward their outlines and pictures are blurred: on
// a rope of 9 px by 0.4 px on either side, a tenth of its area. A tube of one color has the light 1 - dim + dim sqrt(1
// - a^2), where a is 0 at its middle and 1 at its outline; what is beside it is even; a Gaussian blurs both. Along one
// outline of one picture blur and dim are the same; colors are another pair in every short piece, so that marks and a
// background that changes do not matter.
#pragma once
#include <array>
#include <vector>

namespace chainsplat::masking {

// The mean colors about the rough outline of a short piece of the rope.
struct Rim {
  int part = 0;                              // of the rope, which is moved as a whole
  std::vector<std::array<float, 3>> colors;  // gray levels, by rim_bin; NaN where nothing was sampled
};

// Colors are taken by their distance into the rope from the rough outline, px. `radius`: the rope's, px.
int rim_bins(double radius);
int rim_bin(double radius, double inside);  // may lie outside of [0, rim_bins)

// Returns by how much the rope is wider than the rough outline, px, for each of `parts`.
std::vector<double> fit_rims(const std::vector<Rim>& rims, int parts, double radius);

}  // namespace chainsplat::masking
