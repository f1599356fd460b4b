// Private to planning: the rope's motion and its derivative with respect to a stretch of base motion.
//
// The derivative is that of the discrete RODAS3 map, stage by stage. A Rosenbrock stage (1/G - J) k_i = r_i gives
//   (1/G - J) dk_i = dr_i + d/de [J(y + e k_i, t + e H gamma_i) S + f_w(same)],  S = dy/dw:
// the second derivatives enter only along k_i, one further linearization of the equations of motion a stage.
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
// `substeps` a 1/30 s.
Grid make_grid(const Motion& motion, int substeps);

// Everything at the nodes; columns of the derivatives: axis by axis, kPerAxis each.
struct Rollout {
  std::vector<Coordinates> base;
  std::vector<VectorX> theta, thetadot;
  std::vector<MatrixX> theta_slope, thetadot_slope;  // n x unknowns; empty without derivatives
};
// `unknowns` of the last piece, kPerAxis an axis. False where the motion diverges. Without derivatives it is
// dynamics::simulate on this grid. Not `exact`: the variational equation by the trapezoidal rule, with the step's own
// factorization; of second order, seven times faster, enough for a Gauss-Newton step.
bool roll_out(const dynamics::Model& model, const Motion& motion, const Grid& grid, const VectorX& unknowns,
              const dynamics::InitialState& initial, bool derivatives, Rollout& out, bool exact = true);

}  // namespace chainsplat::planning
