// layout.h - the surface of a rope, as the cameras show it at one moment, laid out flat.
#pragma once
#include <vector>

#include "chainsplat/capture.h"
#include "chainsplat/chain.h"
#include "src/recognition/frames.h"
#include "src/recognition/surface.h"

namespace chainsplat::recognition {

using Color = Eigen::Vector3f;  // RGB, 0..1

inline constexpr std::size_t kCellsTogether = 4000000;  // that are laid out at once: 64 MB

// The cells, and on which link each row lies.
struct Grid : Cells {
  std::vector<int> link;
  explicit Grid(const chain::Chain& of) : Cells(of) {
    for (int row = 0; row < rows; ++row) link.push_back(chain::link_at(chain, arclength(row)));
  }
};

// What one moment shows of the surface: row i of arclength, column j of angle about the axis in the link's frame.
struct Layout {
  std::vector<Color> color;   // as a camera without gain and bias records it
  std::vector<float> weight;  // sum of squared cosines between surface normal and view ray; 0: not seen
};
// Of frame `index`. `states` need angles only; where they have rolls, columns are those of the material.
Layout laid_out(const Grid& grid, const capture::Capture& capture, const FrameViews& frame, int index,
                const chain::States& states);

// Columns between whose middles lies the material that a turn by `roll`, rad, brings to the middle of `column`.
struct MaterialColumn {
  int first, second;
  float share;  // of the second
};
MaterialColumn material_column(int column, double roll);

}  // namespace chainsplat::recognition
