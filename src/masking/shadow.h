// The shadow of a rope on what it lies on.
//
// A rope on a table has a dark band beside it, often with a harder outline than its own dark side has against that
// band. A shadow has the hue of what it falls on, though; where the rope's own hue is another, that tells them apart.
#pragma once
#include <array>
#include <vector>

namespace chainsplat::masking {

using Color = std::array<float, 3>;  // gray levels

// A picture straightened along the rope's axis: a row for every station, columns across it.
struct Strip {
  std::vector<Color> colors;   // by station and column
  std::vector<double> across;  // radii from the axis, negative on its left, by column
  int begin = 0, end = 0;      // stations that are rope
  int about = 1;               // stations on either side, over which is averaged

  int stations() const { return static_cast<int>(colors.size() / across.size()); }
  std::size_t at(int station, int column) const { return station * across.size() + column; }
};

// By station and column: log odds, 0 or negative, that it is the rope's and no shadow; and the colors if the whole
// table were as dark as where its shadow meets the rope, so that the shadow has no outline of its own.
struct Shadowless {
  std::vector<double> odds;
  std::vector<Color> colors;
};
Shadowless without_shadow(const Strip& strip);

}  // namespace chainsplat::masking
