// chainsplat/dynamics.h - motion of the chain under gravity, stiffness, damping, friction, drag and a moving base
// (mathematics.md 3, 4).
//
// Twists and wrenches are (angular, linear), in the frame of their link. Equations are named by the numbers of
// mathematics.md.
#pragma once
#include <functional>
#include <limits>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <utility>
#include <vector>
#include "chainsplat/chain.h"
#include "chainsplat/solve.h"
#include "chainsplat/trajectory.h"

namespace chainsplat::dynamics {

using math::Matrix3;
using math::MatrixX;
using math::Vector3;
using math::Vector6;
using math::VectorX;

enum class Integrator { rodas3, implicit_velocity_euler };  // mathematics.md 4 [D], [P] (corrected, base motion at t_k)

// The numbers of mathematics.md 3.1. Arrays per moving link j = 1..n_l are indexed j - 1; per angle k = 1..n are
// indexed k - 1.
struct Parameters {
  std::vector<double> link_mass;         // kg
  std::vector<double> viscous_friction;  // N s/m per link, against the table
  std::vector<double> coulomb_friction;  // effective coefficient per link, -
  std::vector<double> air_linear;        // N s/m per link, across the rope
  std::vector<double> air_quadratic;     // N s^2/m^2 per link, across the rope
  std::vector<double> stiffness;         // N m/rad per angle
  std::vector<double> rest_angle;        // rad
  std::vector<double> damping;           // N m s/rad per angle
  // m per angle, planar chains on a table only; empty: 0. Friction grips a rope at its underside and rolls it, and what
  // it is naturally curved out of the table's plane turns into the plane: torque -roll_lever_k sum_j share_kj f_j, f_j
  // the friction across link j (along bending axis x link), share_kj = min(s_k, middle of j) / L. It is k r L B/C for a
  // natural curvature k out of the plane, radius r, bending stiffness B and torsional stiffness C.
  std::vector<double> roll_lever;
  // Dry friction in bending (mathematics.md 3.10), per angle; both empty: none. The moment of joints that slip, N m,
  // and the bend over which it builds up after a change of direction, rad. Angles that twist the rope have none.
  std::vector<double> bending_friction, bending_friction_angle;
  // N m/rad per joint of two bending angles; empty: what the rope is naturally bent keeps its place about the links.
  // Else the rope rolls within the links as its moments about itself ask, with the retardation time of its bending
  // (mathematics.md 3.11).
  std::vector<double> torsional_stiffness;
  double tip_mass = 0.0;         // kg, of what hangs at the free end: a thin rod that goes on where the last link ends
  double tip_length = 0.0;       // m, of that rod; 0: a point at the free end
  double radius = 0.0;           // m, of the cylinder that gives the links' inertia; 0 allowed
  Vector3 gravity{0, 0, -9.81};  // m/s^2, world
  std::optional<Vector3> table_normal;  // unit, world; none: no table
  bool table_carries_weight = true;     // gravity has no part along table_normal: the table holds the rope up
  double coulomb_speed = 0.002;         // v_s, m/s
  double drag_speed = 0.001;            // v_eps, m/s
  Integrator integrator = Integrator::rodas3;
  int substeps = 4;  // per frame of 1/30 s
};

// Speed below which friction in bending is a spring, rad/s: slow for every motion that a camera sees. It rounds the
// corner of |theta'| at 0, and keeps a joint at rest from creeping.
inline constexpr double kBendingFrictionRate = 1e-3;

// Of all links and the tip, kg.
double total_mass(const Parameters& parameters);

// State at one time: where a rollout starts.
struct InitialState {
  double time = 0.0;
  VectorX theta, thetadot;  // rad, rad/s
  // What else the rope remembers. First, with friction in bending, the share of its moment that each angle's bending
  // has built up, from -1 to 1; then, with torsion, each joint's roll of the material in its link, rad. What is missing
  // is that of a rope that has come to rest at theta by ever smaller swings: shares of 0, rolls of least elastic
  // energy.
  VectorX internal_state = {};
};

// How the material of a rope on a table rolls within its links (dynamics/rolling.h, mathematics.md 3.14).
struct Rolling {
  double torsion = 0.0;         // torsional over bending stiffness; above 0
  double friction = 0.0;        // share of the links' Coulomb friction that rolls the rope; not negative
  double speed = 0.0;           // m/s, of the underside, below which that friction is viscous; above 0
  std::vector<double> set;      // 1/m per joint: natural curvature out of the table's plane, at a roll of 0
  std::vector<double> texture;  // rad per link, base link first: the roll at which the texture lies as at home
  double deviation = 0.0;       // rad, root mean square of the rolls that it was fitted to about it
};

// What identification says of its numbers; one entry per fitted number, in the order of the covariance. Names are those
// of files and may be of another program; dynamics/parametrization.h says what they mean.
struct Estimates {
  std::vector<std::string> names;               // e.g. "log_stiffness", "rest_angle_3": a log where the name says so
  std::vector<double> values, standard_errors;  // in the units of the name
  MatrixX covariance;
  std::vector<std::pair<std::string, std::string>> held;  // name -> why it was not fitted
  // A combination of parameters of which the data tell less than the priors.
  struct Weak {
    double singular_value = 0.0;  // of the sensitivities in units of the priors' deviations; below 1, weakest first
    std::vector<std::pair<std::string, double>> parts;  // name, large components of the unit vector
  };
  std::vector<Weak> weak;
  // Root mean square of what the fit leaves, in units of what one residual alone is expected to be off (mathematics.md
  // 5.10). Well above 1: something acts on the rope that the model lacks, and the numbers may stand for it. NaN: a
  // filter's estimates, the paper's procedure, or an older twin's.
  double misfit = std::numeric_limits<double>::quiet_NaN();
  // Of the fit over the whole recordings: whitened squares, halves, priors included; steps in the units of the names.
  // None: a filter's estimates, or an older twin's.
  std::optional<solve::Summary> solver;
};

using BaseFunction = std::function<trajectory::BaseMotion(double)>;  // base motion at a time, s

// A chain and its parameters, with the constants that follow from them. {i} is the link frame of angle i
// (mathematics.md 2.2); bodies between the coincident axes of one joint have no mass and no length.
struct Model {
  chain::Chain chain;
  Parameters parameters;
  std::vector<Vector6> axis;           // A_i, in {i}; pure rotations through the origin of {i}
  std::vector<math::Pose> home;        // M_i, {i} in the base frame at theta = 0
  std::vector<math::Matrix6> inertia;  // G_i, in {i}; 0 for massless bodies, what hangs at the tip in the last one
};

// Throws InputError where an array has the wrong length, a number is not finite or negative where it must not be, a
// link has no mass, or an axis does not pass through its joint.
Model make_model(const chain::Chain& chain, const Parameters& parameters);

// The base at rest in `pose`.
trajectory::BaseMotion at_rest(const math::Pose& pose);

// tau_i = A_i^T F_i of mathematics.md 3.2, external wrenches of mathematics.md 3.3 included, joint law not. n, N m.
VectorX inverse_dynamics(const Model& model, const trajectory::BaseMotion& base, const VectorX& theta,
                         const VectorX& thetadot, const VectorX& thetaddot);
// -K (theta - theta_0) - D thetadot. n, N m. What follows here about single states leaves friction in bending out,
// whose moment is of the past (internal_states()), and takes a rope that twists for one whose rolls have come to rest.
VectorX joint_law(const Model& model, const VectorX& theta, const VectorX& thetadot);
// M(theta), n x n, kg m^2. mathematics.md 3.4.
MatrixX mass_matrix(const Model& model, const VectorX& theta);
// thetaddot of the free motion: dense M and Cholesky. Throws InputError, with the joint, where M is not positive
// definite.
VectorX forward_dynamics(const Model& model, const trajectory::BaseMotion& base, const VectorX& theta,
                         const VectorX& thetadot);
// The same by the articulated body algorithm, O(n). mathematics.md 3.4.
VectorX forward_dynamics_articulated(const Model& model, const trajectory::BaseMotion& base, const VectorX& theta,
                                     const VectorX& thetadot);
// W_i of mathematics.md 3.3 on every body, in {i}; and body twists V_i in {i}. 6 x n.
MatrixX external_wrenches(const Model& model, const trajectory::BaseMotion& base, const VectorX& theta,
                          const VectorX& thetadot);
MatrixX body_twists(const Model& model, const trajectory::BaseMotion& base, const VectorX& theta,
                    const VectorX& thetadot);

// What the implicit integrators need at one state (mathematics.md 3.6): M a = torque - bias with
// da/dtheta = -M^-1 stiffness, da/dthetadot = -M^-1 damping, da/dt = M^-1 drive_rate (through the base motion only).
struct Linearization {
  VectorX acceleration;  // a
  MatrixX mass;          // M
  MatrixX stiffness;     // d tau_ID / d theta + K
  MatrixX damping;       // d tau_ID / d thetadot + D
  VectorX drive_rate;    // -d tau_ID / dt
};
// `base_jerk` is the component-wise derivative of `base.acceleration`.
Linearization linearize(const Model& model, const trajectory::BaseMotion& base, const Vector6& base_jerk,
                        const VectorX& theta, const VectorX& thetadot);

// d tau_ID at fixed thetaddot = a by the base motion, components as in BaseMotion; rotation: by a small turn of the
// base about its own axes, R_b <- R_b exp([.]). da/d(.) = -M^-1 of them.
struct BaseSlopes {
  MatrixX acceleration, velocity;  // n x 6
  MatrixX rotation;                // n x 3
};
BaseSlopes base_slopes(const Model& model, const trajectory::BaseMotion& base, const VectorX& theta,
                       const VectorX& thetadot);

// The stacked matrices of mathematics.md 3.5 (paper, "Closed-form dynamics", corrected): for reading and checking,
// O(n^3), viscous and other wrenches as in 3.3. M thetaddot + coriolis + gravity + base - friction = -K(theta -
// theta_0) - D thetadot.
struct ClosedForm {
  MatrixX mass;               // A^T L^T G L A
  VectorX coriolis;           // C thetadot, base at rest
  VectorX gravity;            // g
  VectorX base;               // M_0 dV_b - C_0 V_b: all that the base motion adds
  VectorX friction;           // A^T L^T W_ext(V)
  MatrixX velocity_jacobian;  // da/dthetadot = M^-1 M^
};
ClosedForm closed_form(const Model& model, const trajectory::BaseMotion& base, const VectorX& theta,
                       const VectorX& thetadot);

// Potential energy of gravity and stiffness, J, zero with the rope's mass at the world origin and the joints at rest.
double potential_energy(const Model& model, const math::Pose& base, const VectorX& theta);
// The angles at rest under a base at rest: least potential energy by damped Newton from `start` (empty: the rest
// angles). Friction is left out. Throws WorkError where no minimum was found.
struct Equilibrium {
  VectorX theta;
  solve::Summary summary;  // J, rad
};
Equilibrium static_equilibrium(const Model& model, const math::Pose& base, const VectorX& start = {});

// The internal states of InitialState along given motion, from `before` (empty: 0) at its first time: shares of
// friction are exact where the angles of a joint go straight from one time to the next, rolls those of a rope at rest.
// Empty for a rope without any.
std::vector<VectorX> internal_states(const Model& model, const std::vector<VectorX>& theta, const VectorX& before = {});
// Where only one state is known: that of joints that have moved on at their present rates until here. Empty as above.
VectorX internal_state_in_motion(const Model& model, const VectorX& theta, const VectorX& thetadot);

// The base motion on the integrator's own time grid, sampled once for many rollouts.
struct BaseGrid {
  struct Node {
    double time = 0.0;  // s
    double step = 0.0;  // to the next node, s; 0 at the last
    trajectory::BaseMotion motion;
    Vector6 jerk = Vector6::Zero();  // derivative of motion.acceleration
    bool output = false;             // one of the asked times
  };
  std::vector<Node> nodes;
};
// Steps for an interval of seconds with `substeps` per 1/30 s, at least one.
int step_count(double interval, int substeps);
// From `start` through all `times` (increasing, the first >= start), `substeps` per 1/30 s, equal within each interval.
BaseGrid sample_base(const BaseFunction& base, double start, const std::vector<double>& times, int substeps);

// One unknown's derivative: d(Parameters) and d(initial state). Empty arrays mean zeros. dynamics/parametrization.h
// makes them.
struct Tangent {
  std::vector<double> link_mass, viscous_friction, coulomb_friction, air_linear, air_quadratic;  // per link
  std::vector<double> stiffness, rest_angle, damping, roll_lever;                                // per angle
  std::vector<double> bending_friction, bending_friction_angle;                                  // per angle
  std::vector<double> torsional_stiffness;                                                       // per joint
  double tip_mass = 0.0, tip_length = 0.0;
  VectorX theta, thetadot, internal_state;
};
// d(joint law - tau_ID) / d unknowns at fixed thetaddot = a, n x unknowns; M^-1 of it is da / d unknowns. The tangents'
// initial states have no part in it.
MatrixX unknown_forces(const Model& model, const trajectory::BaseMotion& base, const VectorX& theta,
                       const VectorX& thetadot, std::span<const Tangent> unknowns);
// d theta / d unknowns and d thetadot / d unknowns at every output time, n x unknowns each.
struct Sensitivities {
  std::vector<MatrixX> theta, thetadot;
};

// Where a motion left all bounds, or where the mass matrix was singular.
struct Divergence {
  double time = 0.0;  // s
  int angle = 0;      // from 0: the first beyond bounds, or the first without inertia
  bool singular = false;
};

// Integrates over the grid and fills `states` at the output nodes (allocated once, reused). False where the motion left
// all bounds (then `states` is shorter). With `unknowns`, the variational equation is integrated beside (mathematics.md
// 4; RODAS3 only): trapezoidal rule with the factorization of the step, second order, not the exact derivative of the
// discrete map.
bool simulate(const Model& model, const BaseGrid& grid, const InitialState& initial, chain::States& states,
              std::span<const Tangent> unknowns = {}, Sensitivities* sensitivities = nullptr,
              Divergence* divergence = nullptr);
// From angles and rates alone.
bool simulate(const Model& model, const BaseGrid& grid, const VectorX& theta, const VectorX& thetadot,
              chain::States& states, std::span<const Tangent> unknowns = {}, Sensitivities* sensitivities = nullptr,
              Divergence* divergence = nullptr);

// Unknowns that shape the base motion. `after`: s past a node of the grid, or before it, far less than a step.
struct BaseUnknowns {
  Eigen::Index count = 0;
  // The base motion there.
  std::function<trajectory::BaseMotion(std::size_t node, double after)> motion;
  // Sets `torques`, n x count, to d tau_ID / d unknowns there: the sums of `slopes` times the motion's derivatives.
  std::function<void(std::size_t node, double after, const BaseSlopes& slopes, MatrixX& torques)> torques;
};
// The same rollout with its derivatives by those; RODAS3 only. `exact`: those of the discrete map, stage by stage; else
// by the trapezoidal rule as above, of second order and several times faster, enough for a Gauss-Newton step.
bool simulate(const Model& model, const BaseGrid& grid, const InitialState& initial, chain::States& states,
              const BaseUnknowns& unknowns, bool exact, Sensitivities& sensitivities);
bool simulate(const Model& model, const BaseGrid& grid, const VectorX& theta, const VectorX& thetadot,
              chain::States& states, const BaseUnknowns& unknowns, bool exact, Sensitivities& sensitivities);

// One evaluation or one step at a time, without allocation: for loops that cannot wait for a rollout (filters,
// control). `model` must outlive it.
class Step;
class Stepper {
 public:
  explicit Stepper(const Model& model);
  ~Stepper();
  // thetaddot of the free motion as forward_dynamics(); NaN where M is singular. Valid until the next call.
  const VectorX& acceleration(const trajectory::BaseMotion& base, const VectorX& theta, const VectorX& thetadot);
  // From `now` (motion, jerk, step) to the base motion `next`, with the model's integrator; `substeps` are the
  // caller's. `internal_state`, where given, goes along; without it, or where it is empty, it starts as
  // InitialState's. False where the state leaves all bounds or M is singular.
  bool step(const BaseGrid::Node& now, const trajectory::BaseMotion& next, VectorX& theta, VectorX& thetadot,
            VectorX* internal_state = nullptr);

 private:
  std::unique_ptr<Step> step_;
};

// States at `times` from `initial` (times increasing, the first >= initial.time). Where a rollout diverges it is
// repeated with half the step, down to 1/32, then the Euler step gives way to RODAS3; each with a warning. Throws
// WorkError with time and joint where all diverge, InputError where M is singular or sizes do not fit.
chain::States rollout(const Model& model, const BaseFunction& base, const InitialState& initial,
                      const std::vector<double>& times);
chain::States rollout(const Model& model, const trajectory::Trajectory& base, const InitialState& initial,
                      const std::vector<double>& times);

}  // namespace chainsplat::dynamics
