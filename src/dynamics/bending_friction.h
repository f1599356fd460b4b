// Private to dynamics: dry friction in bending (mathematics.md 3.10). Every joint has a state z, one number per angle,
// the share of the friction moment that its bending has built up:
//   z' = (theta' - z s) / phi,   s = sqrt(|theta'|^2 + v^2) - v over the bending angles of the joint
// In an implicit step z is eliminated angle by angle, so that no system grows.
#pragma once
#include <array>
#include <span>
#include <vector>

#include "chainsplat/dynamics.h"

namespace chainsplat::dynamics {

class BendingFriction {
 public:
  explicit BendingFriction(const Model& model);

  bool present = false;  // else nothing below may be called
  // z' at a state.
  void rate(const VectorX& thetadot, const VectorX& z, VectorX& out) const;
  // z after the angles went straight from `from` to `to`: the solution of the same equation with v = 0.
  void follow(const VectorX& from, const VectorX& to, VectorX& z) const;
  // z' and its slopes at a state, for all that follows.
  void linearize(const VectorX& thetadot, const VectorX& z);
  const VectorX& rate() const { return rate_; }
  // B v - S z, with the slopes B = dz'/d theta' and -S = dz'/dz; column by column.
  template <class V, class Z, class Out>
  void slope(const V& v, const Z& z, Out&& out) const {
    for (std::size_t k = 0; k < angle_.size(); ++k) {
      auto row = out.row(static_cast<Eigen::Index>(k));
      row = -decay_[k] * z.row(static_cast<Eigen::Index>(k));
      for (int i = first_[k]; i < end_[k]; ++i) row += by_rate_[k][i - first_[k]] * v.row(i);
    }
  }
  // The matrix of an implicit step of the accelerations, (1/G - J) without z, times G^2 gains this.
  void add_to(double g, MatrixX& matrix) const;
  // (1/G + S) z = right + B v: z in the place of `right`.
  template <class V, class Z>
  void solve(double g, const V& v, Z&& right) const {
    for (std::size_t k = 0; k < angle_.size(); ++k) {
      auto row = right.row(static_cast<Eigen::Index>(k));
      for (int i = first_[k]; i < end_[k]; ++i) row += by_rate_[k][i - first_[k]] * v.row(i);
      row *= g / (1.0 + g * decay_[k]);
    }
  }
  // Takes the moment of the eliminated z off the right side of the accelerations: to -= F (1/G + S)^-1 right.
  template <class Z, class To>
  void take_off(double g, const Z& right, To&& to) const {
    for (std::size_t k = 0; k < angle_.size(); ++k)
      to.row(static_cast<Eigen::Index>(k)) -=
          moment_[k] * (g / (1.0 + g * decay_[k])) * right.row(static_cast<Eigen::Index>(k));
  }
  // to -= F z, column by column.
  template <class Z, class To>
  void take_off_moment(const Z& z, To&& to) const {
    for (std::size_t k = 0; k < angle_.size(); ++k)
      to.row(static_cast<Eigen::Index>(k)) -= moment_[k] * z.row(static_cast<Eigen::Index>(k));
  }
  // Adds d z' / d(unknown p) at the linearized state to column p.
  void add_unknowns(std::span<const Tangent> unknowns, MatrixX& to) const;

 private:
  // The bending angles of angle k's joint: [first, end). An angle that twists has none and no friction.
  std::vector<int> first_, end_;
  std::vector<double> moment_, angle_;
  std::vector<double> decay_;                   // S
  std::vector<std::array<double, 2>> by_rate_;  // B, of the joint's one or two bending angles
  VectorX rate_;
};

}  // namespace chainsplat::dynamics
