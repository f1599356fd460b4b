// Private to dynamics: what a rope remembers beside its angles and rates, z, and how implicit steps take it along.
// First the shares of friction in bending, one per angle (mathematics.md 3.10), then the rolls of a rope that twists,
// one per joint (3.11); each only where the rope has it. With
//   z' = w(theta, theta', z),   P = dw/dtheta,   V = dw/dtheta',   W = dw/dz,   F = -d torque / dz
// a stage of right sides (r_theta, r_v, r_z) eliminates z, so that no system grows: T = (1/G - W)^-1 and
//   (M + G C + G^2 K + G F T (G P + V)) k_v = G (M r_v - G K r_theta - F T (r_z + G P r_theta)),
//   k_z = T (r_z + P k_theta + V k_v)
#pragma once
#include <span>

#include "bending_friction.h"
#include "engine.h"
#include "factor.h"

namespace chainsplat::dynamics {

class InternalState {
 public:
  explicit InternalState(const Model& model);

  bool present = false;   // else nothing below may be called
  Eigen::Index size = 0;  // of z

  // z where the motion begins: as `given`; where that ends early, of a rope that has come to rest at these angles.
  VectorX start(Engine& engine, const VectorX& given, const VectorX& theta) const;
  // d z / d unknowns there, for x = d theta / d unknowns. Right after start(), of which it needs the rolls.
  void start_slopes(const Engine& engine, const VectorX& given, const MatrixX& x, std::span<const Tangent> unknowns,
                    MatrixX& z) const;

  // z' where the engine is placed, and its slopes where the engine is linearized too.
  void linearize(const Engine& engine, const VectorX& thetadot, const VectorX& z);
  const VectorX& rate() const { return rate_; }
  // out = P x + V v + W z
  template <class X, class Z, class Out>
  void slope(const X& x, const X& v, const Z& z, Out&& out) const {
    if (friction_.present) friction_.slope(v, z, out);
    if (rolls_ == 0) return;
    auto to = out.bottomRows(rolls_);
    to.noalias() = torsion_->rate_by_angle() * x;
    to.noalias() += torsion_->rate_by_rate() * v;
    to.noalias() += torsion_->rate_by_roll() * z.bottomRows(rolls_);
  }
  // T for this g. All below are for the g prepared last.
  bool prepare(double g);
  // The matrix of the accelerations gains this: g F T (g P + V).
  void add_to(MatrixX& matrix) const;
  // z = T (right + P x + V v), in the place of `right`.
  template <class X, class Z>
  void solve(const X& x, const X& v, Z&& right) const {
    if (friction_.present) friction_.solve(g_, v, right);
    if (rolls_ == 0) return;
    auto to = right.bottomRows(rolls_);
    to.noalias() += torsion_->rate_by_angle() * x;
    to.noalias() += torsion_->rate_by_rate() * v;
    factor_.solve_columns(to);
  }
  // to -= F T (right_z + g P right_theta)
  template <class X, class Z, class To>
  void take_off(const X& right_theta, const Z& right_z, To&& to) const {
    if (friction_.present) friction_.take_off(g_, right_z, to);
    if (rolls_ == 0) return;
    work_ = right_z.bottomRows(rolls_);
    work_.noalias() += g_ * torsion_->rate_by_angle() * right_theta;
    factor_.solve_columns(work_);
    to.noalias() -= torsion_->moment() * work_;
  }
  // to -= F z
  template <class Z, class To>
  void take_off_moment(const Z& z, To&& to) const {
    if (friction_.present) friction_.take_off_moment(z, to);
    if (rolls_ > 0) to.noalias() -= torsion_->moment() * z.bottomRows(rolls_);
  }
  // Adds d z' / d(unknown p) at the linearized state to column p.
  void add_unknowns(std::span<const Tangent> unknowns, MatrixX& to) const;

 private:
  BendingFriction friction_;
  Eigen::Index angles_ = 0, rolls_ = 0;
  const Torsion* torsion_ = nullptr;  // of the engine that linearize() saw last
  VectorX rate_;
  double g_ = 0.0;
  Factor factor_;         // 1/g - W of the rolls
  mutable MatrixX work_;  // of take_off
  MatrixX coupled_;       // T (g P + V)
};

}  // namespace chainsplat::dynamics
