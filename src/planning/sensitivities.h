// Private to planning: the rope's motion and its derivative with respect to a stretch of base motion.
#pragma once
#include "base_motion.h"

namespace chainsplat::planning {

// Times of one stretch and the basis functions there; made once for many evaluations.
struct Grid {
  double start = 0.0, step = 0.0;  // s
  std::vector<Basis> basis;        // at every node, of the last piece
  std::vector<Coordinates> fixed;  // of all other pieces
  Basis end_basis;                 // just before the end, where the jerk jumps
  Coordinates end_fixed;
  int nodes() const { return static_cast<int>(basis.size()); }
  double time(int node) const { return start + node * step; }
};
// What all pieces do together where the last one has these unknowns.
Coordinates moved(const Motion& motion, const VectorX& unknowns, const Basis& basis, const Coordinates& fixed);
// `substeps` per 1/30 s.
Grid make_grid(const Motion& motion, int substeps);

// Everything at the nodes; columns of the derivatives: axis by axis, kPerAxis each.
struct Rollout {
  std::vector<Coordinates> base;
  std::vector<VectorX> theta, thetadot;
  std::vector<MatrixX> theta_slope, thetadot_slope;  // n x unknowns; empty without derivatives
};
// dynamics::simulate on this grid; `unknowns` of the last piece, kPerAxis per axis, and the derivatives by them, `exact`
// or of second order as described there. False where the motion diverges.
bool roll_out(const dynamics::Model& model, const Motion& motion, const Grid& grid, const VectorX& unknowns,
              const dynamics::InitialState& initial, bool derivatives, Rollout& out, bool exact = true);

}  // namespace chainsplat::planning
