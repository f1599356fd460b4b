// Private to dynamics: the equations of motion of chains whose joints turn about any axes.
//
// Everything is resolved in world axes about the instantaneous base origin, an inertial frame at that instant. There
// all bodies share one frame, so that the neighbor transforms of mathematics.md 3.2 vanish and the tangents of
// mathematics.md 3.6 become sums over links: a unit turn of angle k displaces all outer links rigidly by s_k; seen from
// the displaced links only the inner velocity and acceleration have changed, by u = V x s_k and psi = dV x s_k + V x u,
// and the table's normal. With composite inertia I, velocity product matrix E = 2B - dW/dV and table term N of the
// links outside of i,
//   i >= k:  d tau_i / d theta_k = s_i^T (I_i psi_k + E_i u_k - N_i omega_k)
//   i <  k:  d tau_i / d theta_k = s_i^T (I_k psi_k + E_k u_k - N_k omega_k + s_k x* F_k)
//   with respect to dtheta_k the same with (psi, u) = (2 u_k, s_k) and neither N nor F.
// 2B u = I (u x V) + u x* (I V) + V x* (I u) = [T 0; -2[p] 0] u, T = 2[w]J - tr(J)[w] - 2[h][v], for inertia J about
// the origin, first moment h, momentum p.
#pragma once
#include <vector>

#include "engine.h"

namespace chainsplat::dynamics {

// A rigid body's spatial inertia about the origin.
struct RigidInertia {
  double mass = 0.0;
  Vector3 moment = Vector3::Zero();      // mass times center of mass
  Matrix3 rotational = Matrix3::Zero();  // about the origin
  Vector6 operator*(const Vector6& twist) const {
    Vector6 momentum;
    momentum << rotational * twist.head<3>() + moment.cross(twist.tail<3>()),
        mass * twist.tail<3>() - moment.cross(twist.head<3>());
    return momentum;
  }
  void operator+=(const RigidInertia& other) {
    mass += other.mass;
    moment += other.moment;
    rotational += other.rotational;
  }
};

// X x Y (ad_X Y) and X x* F (-ad_X^T F).
inline Vector6 cross(const Vector6& x, const Vector6& y) {
  Vector6 z;
  z << x.head<3>().cross(y.head<3>()), x.tail<3>().cross(y.head<3>()) + x.head<3>().cross(y.tail<3>());
  return z;
}
inline Vector6 cross_dual(const Vector6& x, const Vector6& f) {
  Vector6 z;
  z << x.head<3>().cross(f.head<3>()) + x.tail<3>().cross(f.tail<3>()), x.head<3>().cross(f.tail<3>());
  return z;
}

// Inertia of a body of the given constants whose frame is at `origin` with axis `direction`.
RigidInertia world_inertia(double mass, double center, double transverse, double axial, const Vector3& origin,
                           const Vector3& direction);

class SpatialEngine : public Engine {
 public:
  explicit SpatialEngine(const Model& model);
  void place(const trajectory::BaseMotion& base, const VectorX& theta, const VectorX& thetadot, bool slopes) override;
  void linearize(const Vector6& base_jerk) override;
  void base_slopes(BaseSlopes& slopes) const override;
  void unknown_forces(std::span<const Tangent> unknowns, MatrixX& forces) override;
  // The first part of linearize(): adds `acceleration` to the placed bodies; fills body_force and `inverse`.
  void inverse_torque();
  bool articulated_acceleration();  // acceleration by the articulated body algorithm; allocates; false as factor_mass

  // per angle
  std::vector<Vector6> axis;                                // s_k
  std::vector<Vector6> inner_velocity, inner_acceleration;  // V_{k-1}, dV_{k-1}
  std::vector<Vector6> turn;                                // u_k
  std::vector<Matrix3> rotation;                            // of the body moved by angle k
  // per link
  std::vector<Vector3> origin, direction;
  std::vector<Vector6> velocity, link_acceleration, wrench, body_force;  // the last: of all outer bodies
  std::vector<RigidInertia> inertia;

 private:
  struct UnitWrenches {
    Vector6 mass, viscous, coulomb, air_linear, air_quadratic;
  };
  void friction(int link, bool slopes);

  Matrix3 base_rotation_;
  Vector6 base_velocity_, base_acceleration_, base_turn_;  // world axes; the second with gravity, the third without
  Vector3 bending_axis_;                                   // world
  std::vector<Vector6> roll_slope_;                        // df_j / dV_j
  std::vector<Vector3> local_axis_;
  std::vector<RigidInertia> composite_inertia_;
  std::vector<Vector6> psi_;
  std::vector<Matrix6> slope_;                        // composite E
  std::vector<Eigen::Matrix<double, 6, 3>> turning_;  // composite N
  std::vector<Vector6> weighted_axis_;                // I s_i
  std::vector<UnitWrenches> unit_;
  Vector6 unit_tip_, unit_tip_length_;
};

}  // namespace chainsplat::dynamics
