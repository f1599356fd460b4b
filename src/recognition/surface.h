// surface.h - the surface of a rope at home in cells: rows of arclength, columns of the angle about the axis.
#pragma once
#include <algorithm>
#include <cmath>
#include <numbers>

#include "chainsplat/chain.h"

namespace chainsplat::recognition {

inline constexpr double kTurn = 2.0 * std::numbers::pi;
inline constexpr int kColumns = 36;          // of cells around the tube
inline constexpr double kCellLength = 0.15;  // diameters along it
// Least cosine between surface normal and view ray of a color that is trusted: beyond, a pixel averages over too much.
inline constexpr double kTrusted = 0.4;

struct Cells {
  const chain::Chain& chain;
  int rows = 1;

  explicit Cells(const chain::Chain& of)
      : chain(of), rows(std::max(2, static_cast<int>(std::ceil(of.length / (kCellLength * of.diameter))))) {}
  std::size_t size() const { return static_cast<std::size_t>(rows) * kColumns; }
  // Of the middle of a row, m, and of a column, rad from the bending axis on.
  double arclength(int row) const { return (row + 0.5) * chain.length / rows; }
  static double angle(int column) { return (column + 0.5) * kTurn / kColumns; }
  math::Vector3 normal(double at) const {
    return std::cos(at) * chain.bending_axis + std::sin(at) * chain.direction.cross(chain.bending_axis);
  }
  std::size_t cell(int row, int column) const { return static_cast<std::size_t>(row) * kColumns + column; }
  std::size_t cell_at(double arclength, double angle) const {
    const int row = static_cast<int>(std::floor(arclength / chain.length * rows));
    const int column = static_cast<int>(std::floor(angle / kTurn * kColumns));
    return cell(std::clamp(row, 0, rows - 1), ((column % kColumns) + kColumns) % kColumns);
  }
};

}  // namespace chainsplat::recognition
