// Private to dynamics: one evaluation of the equations of motion, without allocation. What both kinematics share is
// here; spatial.h places chains of any kind, planar.h those that bend about one direction.
#pragma once
#include <memory>
#include <vector>

#include "chainsplat/dynamics.h"
#include "torsion.h"

namespace chainsplat::dynamics {

using math::Matrix6;

// Three-point Gauss-Legendre rule on [0, 1] (mathematics.md 3.3).
inline constexpr double kGaussPoint[3] = {0.1127016653792583, 0.5, 0.8872983346207417};  // (1 -+ sqrt(0.6)) / 2
inline constexpr double kGaussWeight[3] = {5.0 / 18.0, 8.0 / 18.0, 5.0 / 18.0};
inline constexpr double kSingular = 1e-13;  // of an angle's own inertia: less is rounding

struct LinkConstants {
  double length, mass, center, transverse, axial;      // with the tip's; center along d, inertia about the center
  double viscous, coulomb, air_linear, air_quadratic;  // coulomb: mu^C m g_n, N
  double coulomb_per_coefficient, coulomb_per_mass;
  int first_angle, end_angle;
};

// Whether a tangent changes the wrenches of links, not only the joint law.
inline bool moves_links(const Tangent& d) {
  return d.tip_mass != 0.0 || d.tip_length != 0.0 || !d.link_mass.empty() || !d.viscous_friction.empty() ||
         !d.coulomb_friction.empty() || !d.air_linear.empty() || !d.air_quadratic.empty();
}

// A thin rod of mass 1 that goes on for `length` where a link of `start` ends: its center from where the link begins,
// and its inertia about there. Both are polynomials in `length`, of which central differences are exact.
struct Attached {
  double center, second;
};
inline Attached attached(double start, double length) {
  return {start + 0.5 * length, start * start + start * length + length * length / 3.0};
}

class Engine {
 public:
  virtual ~Engine() = default;
  // The calls build on one another: place, factor_mass, accelerate, linearize, unknown_forces.
  // Poses, axes, velocities, M, bias; with `slopes` also what linearize needs.
  virtual void place(const trajectory::BaseMotion& base, const VectorX& theta, const VectorX& thetadot,
                     bool slopes) = 0;
  bool factor_mass();                 // false, and `singular_angle`, where M is not positive definite
  void accelerate();                  // acceleration = M^-1 force
  void solve_mass(MatrixX& x) const;  // x = M^-1 x
  // Adds `acceleration` to the placed bodies (once a place): `inverse`, then stiffness, damping and drive_rate (needs
  // place with slopes).
  virtual void linearize(const Vector6& base_jerk) = 0;
  // What BaseSlopes says, at the linearized state.
  virtual void base_slopes(BaseSlopes& slopes) const = 0;
  // Column p of `forces`: d(torque - tau_ID)/d(unknown p) at the present state and acceleration.
  virtual void unknown_forces(std::span<const Tangent> unknowns, MatrixX& forces) = 0;

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

  // What friction does by rolling the rope (Parameters::roll_lever); all empty where it does not.
  bool rolls = false;
  MatrixX roll_share, roll_map;                            // share_kj, and times the lever of angle k
  VectorX roll_friction, roll_torque;                      // a link: f_j; an angle: its part of tau_ID
  MatrixX roll_by_angle, roll_by_rate;                     // df_j / d theta_i, df_j / d thetadot_i: links x angles
  VectorX roll_by_time, roll_by_viscous, roll_by_coulomb;  // df_j through the base's motion; by a unit of mu, of mu^C

 protected:
  explicit Engine(const Model& model);
  const Vector3& gravity() const { return gravity_; }  // world; without the part that a table carries
  const Vector3& normal() const { return normal_; }    // world
  bool has_table() const { return table_; }
  const VectorX& rates() const { return thetadot_; }
  void set_state(const VectorX& theta, const VectorX& thetadot);  // and the joint law's torque
  void add_roll();                                                // to the bias, from roll_friction
  // To stiffness, damping and drive_rate: torsion, and the slopes of roll_friction.
  void linearize_torsion();
  void linearize_roll();
  // A tangent's part in the joint law and in the rolling (after roll_by_viscous and roll_by_coulomb).
  void joint_forces(const Tangent& unknown, Eigen::Ref<VectorX> column) const;

 private:
  Vector3 gravity_, normal_;
  bool table_ = false;
  VectorX theta_, thetadot_;
  Torsion torsion_;
  bool slips_ = false;       // it has friction in bending
  bool settled_ = true;      // its rolls are those at rest
  Eigen::Index shares_ = 0;  // of friction in bending, at the beginning of internal_state
};

// The faster one that fits.
std::unique_ptr<Engine> make_engine(const Model& model);

}  // namespace chainsplat::dynamics
