// Private to dynamics: twist of a rope within a chain of universal joints (mathematics.md 3.11). The links carry no
// twist angle; the rope turns about itself within them, by a roll psi_j of its material in link j, one per joint. It
// has hardly any inertia about itself, so that its rolls follow from the balance of elastic and viscous moments alone:
//   E = sum_j  k/2 |(alpha, beta) - Rot(chi_j) (alpha0, beta0)|^2 + C_j/2 tau_j^2
//   R = sum_j  d/2 |(alpha' + chi_j' beta, beta' - chi_j' alpha)|^2 + D_j/2 tau_j'^2
//   tau_j = psi_j - psi_{j-1} + delta_j,   chi_j = (psi_{j-1} + psi_j)/2,   delta_j = 2 atan(tan(alpha/2) tan(beta/2))
//   dE/dpsi + dR/dpsi' = 0,   torque = -dE/dtheta - dR/dtheta'
#pragma once
#include <span>
#include <vector>

#include "chainsplat/dynamics.h"
#include "src/math/tridiagonal.h"

namespace chainsplat::dynamics {

class Torsion {
 public:
  explicit Torsion(const Model& model);

  bool present = false;    // else nothing below may be called
  Eigen::Index rolls = 0;  // m, one per joint

  // The law at a state: torque() but for the dampers -d theta', and rate() = psi'.
  void place(const VectorX& theta, const VectorX& thetadot, const VectorX& roll);
  const VectorX& torque() const { return torque_; }
  const VectorX& rate() const { return rate_; }
  double energy() const;  // J, of bending and twist
  // Their slopes at the placed state.
  void linearize();
  const MatrixX& stiffness() const { return stiffness_; }          // -d torque / d theta, n x n
  const MatrixX& damping() const { return damping_; }              // -d torque / d theta', n x n
  const MatrixX& moment() const { return moment_; }                // -d torque / d psi, n x m
  const MatrixX& rate_by_angle() const { return rate_by_angle_; }  // d psi' / d theta, m x n
  const MatrixX& rate_by_rate() const { return rate_by_rate_; }    // d psi' / d theta', m x n
  const MatrixX& rate_by_roll() const { return rate_by_roll_; }    // d psi' / d psi, m x m
  // d torque / d unknown but for the dampers, and where `rate` is given (m) d psi' / d unknown, added to both.
  void add_unknown(const Tangent& unknown, Eigen::Ref<VectorX> torque, VectorX* rate) const;

  // Places a rope at rest at these angles, by the rolls of least elastic energy from roll() on.
  void settle(const VectorX& theta);
  const VectorX& roll() const { return roll_; }
  // Of a settled rope, whose rolls follow: -d torque / d theta, added to `stiffness`; d torque / d unknown, added to
  // `to`.
  void add_settled_stiffness(MatrixX& stiffness) const;
  void add_settled_unknown(const Tangent& unknown, Eigen::Ref<VectorX> to) const;
  // d roll / d unknown where theta changes by `theta` and the parameters by `unknown`.
  VectorX settled_slope(const VectorX& theta, const Tangent& unknown) const;

 private:
  // Generalized forces dE/d. + dR/d.' by (alpha, beta, chi, tau), with their slopes by these and by their rates.
  struct Joint {
    double k[2] = {}, d[2] = {}, rest[2] = {};            // N m/rad, N m s/rad, rad
    double twist = 0.0, twist_damping = 0.0;              // N m/rad, N m s/rad
    double by_damping = 0.0, by_stiffness = 0.0;          // of twist_damping over twist, by each of d and of k
    double angle[2] = {}, rate[2] = {}, rolled[2] = {};   // rolled: the rest angles
    double own = 0.0, delta[2] = {}, bend[3] = {};        // delta_j, by alpha and beta, and twice by aa, ab, bb
    double twisted = 0.0;                                 // tau
    double along[2] = {}, turning = 0.0, twisting = 0.0;  // (alpha' + chi' beta, beta' - chi' alpha), chi', tau'
    double force[4] = {}, slope[4][4] = {}, viscous[4][4] = {};
  };
  // Over the rolls. Where they have no least energy nearby (a rope about to flip) its least pivot lets steps only lead
  // on.
  using Tridiagonal = math::Tridiagonal;
  void bend(const VectorX& theta);                                // what the angles say
  void turn(const VectorX& roll);                                 // what the rolls say, with the elastic slopes
  void balance(VectorX& to) const;                                // the forces over the rolls
  void gather(double (Joint::*of)[4][4], Tridiagonal& to) const;  // and factors it
  // Blocks over angles and rolls: n x m, and m x n.
  void angles_by_rolls(double (Joint::*of)[4][4], MatrixX& to) const;
  void rolls_by_angles(double (Joint::*of)[4][4], MatrixX& to) const;
  // d force / d unknown at fixed rolls and rates.
  void change(const Tangent& unknown, std::size_t joint, double (&to)[4]) const;
  void add_to_balance(std::size_t joint, const double (&force)[4], VectorX& to) const;

  std::vector<Joint> joints_;
  VectorX roll_, torque_, rate_, still_, step_;
  Tridiagonal elastic_, dampers_;
  MatrixX stiffness_, damping_, moment_, rate_by_angle_, rate_by_rate_, rate_by_roll_, viscous_moment_;
};

}  // namespace chainsplat::dynamics
