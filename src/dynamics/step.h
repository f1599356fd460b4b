// Private to dynamics: one step of the integrators (mathematics.md 4), the factorization that its parts share, and the
// derivatives that go along. No allocation after construction.
#pragma once
#include <functional>
#include <vector>

#include "factor.h"
#include "internal_state.h"

namespace chainsplat::dynamics {

// A rollout's derivatives by unknowns, at the present node: S' = J S + b with S = (x, y), all n x unknowns. `start`,
// then `advance` from node to node, is the trapezoidal rule. Where `exact`, Step::advance takes x and y along instead:
// then they are the derivatives of the discrete RODAS3 map. A Rosenbrock stage (1/G - J) k_i = r_i has
//   (1/G - J) dk_i = dr_i + d/de [J(s + e k_i, t + e H gamma_i) S + b(same)],  s = (theta, thetadot):
// the second derivatives enter only along k_i, two further linearizations per stage.
struct Variation {
  // d(joint law - tau_ID) / d unknowns where `engine` is linearized: `after` s past a node.
  using Forces = std::function<void(Engine& engine, std::size_t node, double after, MatrixX& forces)>;
  // The base motion there.
  using Base = std::function<trajectory::BaseMotion(std::size_t node, double after)>;

  Forces forces_of;
  Base base;  // for `exact`
  bool exact = false;
  MatrixX x, y;          // d theta / d unknowns, d thetadot / d unknowns
  MatrixX acceleration;  // y'
  // The same of the internal state, where there is one: z and z', by unknowns with tangents of it.
  MatrixX z, z_rate;
  std::span<const Tangent> tangents;

  Variation(int n, Eigen::Index unknowns, Forces forces_of, Base base, bool exact, Eigen::Index internal);
  // The acceleration at a node where engine and internal state are linearized. False where the mass matrix is singular.
  bool start(Engine& engine, const InternalState& internal, std::size_t node);
  // Both are linearized at the new node; `factor` holds M + g damping + g^2 stiffness there, with the internal state's
  // part, which is prepared for g, half the step before.
  void advance(Engine& engine, const InternalState& internal, const Factor& factor, std::size_t node, double g);

  // Step's own, for `exact`: what multiplies 1/G - J, and the stages
  MatrixX right, work, stage_x, stage_y, k_x[4], k_y[4];
  MatrixX right_z, stage_z, k_z[4];
  VectorX probe_theta, probe_rate;
  // forces = b + J S at (s_x, s_y, s_z): forces_of - stiffness s_x - damping s_y - the internal state's moment s_z
  void force(Engine& engine, const InternalState& internal, std::size_t node, double after, const MatrixX& s_x,
             const MatrixX& s_y, const MatrixX& s_z, MatrixX& forces);

 private:
  Factor mass_;
  MatrixX forces_, predicted_x_, predicted_y_, predicted_z_;
};

class Step {
  std::unique_ptr<Engine> engine_, stage_;

 public:
  explicit Step(const Model& model);
  // Linearizes at the node and factors M + G C (+ G^2 K). With the last node's step of 0 there is no factor.
  bool linearize(const BaseGrid::Node& now, const VectorX& theta, const VectorX& thetadot);
  // From the linearized node to the next, with what `variation` has to take along.
  bool advance(double h, const trajectory::BaseMotion& next, VectorX& theta, VectorX& thetadot,
               Variation* variation = nullptr, std::size_t node = 0);

  Engine& engine;          // at the node
  InternalState internal;  // there, too
  VectorX internal_state;  // there; empty where the rope has none
  Factor factor;           // M + G C + G^2 K (Euler: M + h C), and the internal state's part
  // After a failure: the first angle beyond all bounds, or without inertia.
  int bad_angle = 0;
  bool singular = false;

  // False, and bad_angle set, where a number is beyond all bounds or NaN.
  bool bounded(const VectorX& theta, const VectorX& thetadot);

 private:
  bool factor_mass(Engine& at);
  bool evaluate(const trajectory::BaseMotion& motion, bool slopes);
  void solve_stage(int i, double g);
  void right_internal(int i, double h);  // right_z_ of stage i
  bool vary_stage(int i, double h, std::size_t node, const VectorX& theta, const VectorX& thetadot, Variation& v);

  bool rodas_;
  VectorX right_theta_, stage_theta_, stage_thetadot_, stage_acceleration_, work_;
  VectorX k_theta_[4], k_rate_[4];
  InternalState stage_internal_;
  VectorX right_z_, stage_z_, k_z_[4];
};

}  // namespace chainsplat::dynamics
