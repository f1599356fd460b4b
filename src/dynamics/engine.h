// Private to dynamics: one evaluation of the equations of motion, without allocation.
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

#include "chainsplat/dynamics.h"
#include "torsion.h"

namespace chainsplat::dynamics {

using math::Matrix6;

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

struct LinkConstants {
  double length, mass, center, transverse, axial;      // tip mass included; center along d, inertia about the center
  double viscous, coulomb, air_linear, air_quadratic;  // coulomb: mu^C m g_n, N
  double coulomb_per_coefficient, coulomb_per_mass;
  int first_angle, end_angle;
};

// Inertia of a body of the given constants whose frame is at `origin` with axis `direction`.
RigidInertia world_inertia(double mass, double center, double transverse, double axial, const Vector3& origin,
                           const Vector3& direction);

class Engine {
 public:
  explicit Engine(const Model& model);
  virtual ~Engine() = default;
  // The calls build on one another: place, factor_mass, accelerate, linearize, unknown_forces.
  // Poses, axes, velocities, M, bias; with `slopes` also what linearize needs.
  virtual void place(const trajectory::BaseMotion& base, const VectorX& theta, const VectorX& thetadot, bool slopes);
  bool factor_mass();                 // false, and `singular_angle`, where M is not positive definite
  void accelerate();                  // acceleration = M^-1 force
  void solve_mass(MatrixX& x) const;  // x = M^-1 x
  // Adds `acceleration` to the placed bodies (once a place): fills body_force and `inverse`.
  void inverse_torque();
  // inverse_torque, then stiffness, damping and drive_rate (needs place with slopes).
  virtual void linearize(const Vector6& base_jerk);
  // What BaseSlopes says, at the linearized state.
  virtual void base_slopes(BaseSlopes& slopes) const;
  // Column p of `forces`: d(torque - tau_ID)/d(unknown p) at the present state and acceleration.
  virtual void unknown_forces(std::span<const Tangent> unknowns, MatrixX& forces);
  bool articulated_acceleration();  // acceleration by the articulated body algorithm; allocates; false as factor_mass

  Torsion& torsion() { return torsion_; }  // placed with the engine, linearized with it where it is not settled
  const Torsion& torsion() const { return torsion_; }

  const Model& model;
  int angles, link_count;
  int singular_angle = -1;
  std::vector<LinkConstants> links;

  VectorX internal_state;  // for place(); empty: no friction in bending, and a rope that twists is settled
  VectorX torque;          // joint law, and friction in bending
  VectorX bias;            // tau_ID at zero acceleration
  VectorX force;           // torque - bias = M a
  VectorX acceleration;    // a
  VectorX inverse;         // tau_ID at `acceleration`
  MatrixX mass;            // M, both triangles
  MatrixX cholesky;        // lower triangle
  MatrixX stiffness, damping;
  VectorX drive_rate;

  // per angle
  std::vector<Vector6> axis;                                // s_k
  std::vector<Vector6> inner_velocity, inner_acceleration;  // V_{k-1}, dV_{k-1}
  std::vector<Vector6> turn;                                // u_k
  std::vector<Matrix3> rotation;                            // of the body moved by angle k
  // What friction does by rolling the rope (Parameters::roll_lever); all empty where it does not.
  bool rolls = false;
  MatrixX roll_share, roll_map;                            // share_kj, and times the lever of angle k
  VectorX roll_friction, roll_torque;                      // a link: f_j; an angle: its part of tau_ID
  MatrixX roll_by_angle, roll_by_rate;                     // df_j / d theta_i, df_j / d thetadot_i: links x angles
  VectorX roll_by_time, roll_by_viscous, roll_by_coulomb;  // df_j through the base's motion; by a unit of mu, of mu^C
  // per link
  std::vector<Vector3> origin, direction;
  std::vector<Vector6> velocity, link_acceleration, wrench, body_force;  // the last: of all outer bodies
  std::vector<RigidInertia> inertia;

 protected:
  const Vector3& gravity() const { return gravity_; }  // world; without the part that a table carries
  const Vector3& normal() const { return normal_; }    // world
  bool has_table() const { return table_; }
  void set_state(const VectorX& theta, const VectorX& thetadot);  // and the joint law's torque
  void add_roll();                                                // to the bias, from roll_friction
  void linearize_roll();  // to stiffness, damping and drive_rate, from the slopes of roll_friction
  // A tangent's part in the joint law and in the rolling (after roll_by_viscous and roll_by_coulomb).
  void joint_forces(const Tangent& unknown, Eigen::Ref<VectorX> column) const;

 private:
  struct UnitWrenches {
    Vector6 mass, viscous, coulomb, air_linear, air_quadratic;
  };
  void friction(int link, bool slopes);

  Matrix3 base_rotation_;
  Vector6 base_velocity_, base_acceleration_, base_turn_;  // world axes; the second with gravity, the third without
  Vector3 gravity_, normal_;
  double normal_gravity_ = 0.0;
  bool table_ = false;
  VectorX theta_, thetadot_;
  Torsion torsion_;
  bool slips_ = false;               // it has friction in bending
  bool settled_ = true;              // its rolls are those at rest
  Eigen::Index shares_ = 0;          // of friction in bending, at the beginning of internal_state
  Vector3 bending_axis_;             // world
  std::vector<Vector6> roll_slope_;  // df_j / dV_j
  std::vector<Vector3> local_axis_;
  std::vector<RigidInertia> composite_inertia_;
  std::vector<Vector6> psi_;
  std::vector<Matrix6> slope_;                        // composite E
  std::vector<Eigen::Matrix<double, 6, 3>> turning_;  // composite N
  std::vector<Vector6> weighted_axis_;                // I s_i
  std::vector<UnitWrenches> unit_;
  Vector6 unit_tip_;
};

}  // namespace chainsplat::dynamics
