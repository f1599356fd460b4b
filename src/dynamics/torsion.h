// Private to dynamics: twist of a rope within a chain of universal joints (mathematics.md 3.11). The links carry no
// twist angle; the rope turns about itself within them, by a roll psi_j of its material in link j. It has hardly any
// inertia about itself, so that its rolls are always those of least elastic energy, and only the elastic law changes:
//   E = sum_j  k/2 |(alpha, beta) - Rot(chi_j) (alpha0, beta0)|^2 + C_j/2 tau_j^2
//   tau_j = psi_j - psi_{j-1} + delta_j,   chi_j = (psi_{j-1} + psi_j)/2,   delta_j = 2 atan(tan(alpha/2) tan(beta/2))
#pragma once
#include <vector>

#include "chainsplat/dynamics.h"

namespace chainsplat::dynamics {

class Torsion {
 public:
  explicit Torsion(const Model& model);

  bool present = false;  // else nothing below may be called
  // Finds the rolls for these angles, from the last ones on.
  void place(const VectorX& theta);
  double energy() const;                             // J, of bending and twist
  const VectorX& torque() const { return torque_; }  // -dE / d theta
  // d2E / d theta2 with the rolls following, added to `stiffness`.
  void add_stiffness(MatrixX& stiffness) const;
  // d(torque) / d unknown at fixed angles, the rolls following, added to `column`.
  void add_unknown(const Tangent& unknown, Eigen::Ref<VectorX> column) const;

 private:
  struct Joint {
    double k[2], rest[2], twist;                             // N m/rad, rad, N m/rad
    double theta[2] = {}, rolled[2] = {};                    // the angles, and the rest angles rolled
    double tau = 0.0, delta[2] = {}, bend[3] = {};           // delta by alpha and beta, and twice: aa, ab, bb
    double by_chi = 0.0, by_chi_twice = 0.0, mixed[2] = {};  // of the bending energy
  };
  void evaluate(Joint& joint, double before, double after) const;
  void gradient();               // of E by the rolls, and its tridiagonal matrix
  void solve(VectorX& x) const;  // x = (d2E / d psi2)^-1 x

  std::vector<Joint> joints_;
  VectorX roll_, torque_, slope_, diagonal_, beside_;
};

}  // namespace chainsplat::dynamics
