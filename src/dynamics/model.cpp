#include <cmath>
#include <functional>

#include "chainsplat/dynamics/base_wrench.h"
#include "planar.h"
#include "spatial.h"
#include "src/math/decompositions.h"

namespace chainsplat::dynamics {
namespace {

void require(bool condition, const std::string& what, const std::string& mend) {
  if (!condition) throw InputError("dynamics", what, mend);
}

void check_array(const std::vector<double>& values, int size, const char* name, bool may_be_negative = false) {
  require(static_cast<int>(values.size()) == size,
          std::string(name) + " has " + std::to_string(values.size()) + " entries", "give " + std::to_string(size));
  for (double value : values)
    require(std::isfinite(value) && (may_be_negative || value >= 0.0), std::string(name) + " is " + core::exact(value),
            may_be_negative ? "give a finite number" : "give a number >= 0");
}

}  // namespace

Model make_model(const chain::Chain& chain, const Parameters& p) {
  const int links = chain.links() - 1, angles = chain.angles();
  require(links >= 1 && angles >= 1, "the chain has no joint", "make it with at least one");
  check_array(p.link_mass, links, "link_mass");
  for (int j = 0; j < links; ++j)
    require(p.link_mass[j] > 0.0,
            "link " + std::to_string(j + 1) + " has a mass of " + core::exact(p.link_mass[j]) + " kg",
            "give every link a mass > 0");
  check_array(p.viscous_friction, links, "viscous_friction");
  check_array(p.coulomb_friction, links, "coulomb_friction");
  check_array(p.air_linear, links, "air_linear");
  check_array(p.air_quadratic, links, "air_quadratic");
  check_array(p.stiffness, angles, "stiffness");
  check_array(p.rest_angle, angles, "rest_angle", true);
  check_array(p.damping, angles, "damping");
  if (!p.roll_lever.empty()) {
    check_array(p.roll_lever, angles, "roll_lever", true);
    require(is_planar(chain), "roll_lever is given for a chain that bends in more than one plane", "leave it empty");
  }
  require(p.bending_friction.empty() == p.bending_friction_angle.empty(),
          "bending_friction is given without bending_friction_angle, or the other way round", "give both or none");
  if (!p.bending_friction.empty()) {
    check_array(p.bending_friction, angles, "bending_friction");
    check_array(p.bending_friction_angle, angles, "bending_friction_angle");
    for (const double angle : p.bending_friction_angle)
      require(angle > 0.0, "a bending_friction_angle is 0", "give a number > 0");
    require(p.integrator == Integrator::rodas3, "friction in bending needs the integrator rodas3", "choose it");
  }
  if (!p.torsional_stiffness.empty()) {
    require(p.integrator == Integrator::rodas3, "torsion needs the integrator rodas3", "choose it");
    check_array(p.torsional_stiffness, links, "torsional_stiffness");
    require(angles == 2 * links && !chain::has_twist(chain),
            "torsional_stiffness is given for a chain whose joints do not bend in two directions", "leave it empty");
    for (const double twist : p.torsional_stiffness)
      require(twist > 0.0, "a torsional_stiffness is 0", "give a number > 0");
    for (int k = 0; k < angles; ++k) {
      const Vector3 axis = k % 2 == 0 ? chain.bending_axis : chain.direction.cross(chain.bending_axis);
      require((chain.axes[k].head<3>() - axis).norm() < 1e-9,
              "torsional_stiffness is given for joints that bend about other axes than a and d x a", "leave it empty");
    }
  }
  check_array({p.tip_mass, p.tip_length, p.radius}, 3, "tip_mass, tip_length or radius");
  check_array({p.coulomb_speed, p.drag_speed}, 2, "coulomb_speed or drag_speed");
  require(p.coulomb_speed > 0.0 && p.drag_speed > 0.0, "a regularization speed is 0", "give a number > 0");
  require(p.gravity.allFinite(), "gravity is not finite", "give three finite numbers");
  require(p.substeps >= 1, "substeps is " + std::to_string(p.substeps), "give at least 1");

  Model model;
  model.chain = chain;
  model.parameters = p;
  if (p.table_normal) model.parameters.table_normal = p.table_normal->normalized();
  for (int k = 0; k < angles; ++k) {
    const int link = chain.child_link[k];
    const math::Pose home{Matrix3::Identity(), chain.link_start(link) * chain.direction};
    const Vector6 axis = math::transform_twist(home.inverse(), chain.axes[k]);
    // of link_start: a joint's axes must meet in it
    require(axis.tail<3>().norm() < 1e-9 * (1.0 + chain.length) && std::abs(axis.head<3>().norm() - 1.0) < 1e-9,
            "axis " + std::to_string(k + 1) + " is no rotation about its joint",
            "use chain axes that pass through s_j d");
    model.axis.push_back(axis);
    model.home.push_back(home);
    math::Matrix6 inertia = math::Matrix6::Zero();
    if (chain.last_angle(link) == k) {
      const auto add = [&](double mass, double center, double transverse, double axial) {
        const RigidInertia body = world_inertia(mass, center, transverse, axial, Vector3::Zero(), chain.direction);
        inertia.topLeftCorner<3, 3>() += body.rotational;
        inertia.topRightCorner<3, 3>() += math::hat(body.moment);
        inertia.bottomLeftCorner<3, 3>() -= math::hat(body.moment);
        inertia.bottomRightCorner<3, 3>() += mass * Matrix3::Identity();
      };
      const double l = chain.link_end(link) - chain.link_start(link), m = p.link_mass[link - 1], r = p.radius;
      add(m, 0.5 * l, m * (l * l / 12.0 + 0.25 * r * r), 0.5 * m * r * r);
      if (link == links) add(p.tip_mass, l + 0.5 * p.tip_length, p.tip_mass * p.tip_length * p.tip_length / 12.0, 0.0);
    }
    model.inertia.push_back(inertia);
  }
  return model;
}

namespace {

// An angle in messages.
std::string joint_name(const chain::Chain& chain, int angle) {
  return "joint " + std::to_string(chain.child_link[angle]) + " (angle " + std::to_string(angle + 1) + ")";
}

[[noreturn]] void throw_singular(const Model& model, int angle) {
  throw InputError("dynamics", "the mass matrix is singular: no inertia about " + joint_name(model.chain, angle),
                   "give every link mass, and the rope a diameter where it can twist");
}

// The state of the chain, checked at the edge.
void check_state(const Model& model, const VectorX& theta, const VectorX& thetadot) {
  const Eigen::Index n = model.chain.angles();
  for (const VectorX* v : {&theta, &thetadot}) {
    require(v->size() == n,
            "a state has " + std::to_string(v->size()) + " numbers, the chain " + std::to_string(n) + " angles",
            "give the states of this rope");
    require(v->allFinite(), "a state is not finite", "give finite angles and rates");
  }
}

}  // namespace

double total_mass(const Parameters& parameters) {
  double mass = parameters.tip_mass;
  for (const double m : parameters.link_mass) mass += m;
  return mass;
}

trajectory::BaseMotion at_rest(const math::Pose& pose) {
  trajectory::BaseMotion base;
  base.pose = pose;
  return base;
}

VectorX joint_law(const Model& model, const VectorX& theta, const VectorX& thetadot) {
  VectorX torque(theta.size());
  const Parameters& p = model.parameters;
  if (Torsion torsion(model); torsion.present) {
    torsion.settle(theta);
    for (Eigen::Index k = 0; k < theta.size(); ++k) torque[k] = torsion.torque()[k] - p.damping[k] * thetadot[k];
    return torque;
  }
  for (Eigen::Index k = 0; k < theta.size(); ++k)
    torque[k] = -p.stiffness[k] * (theta[k] - p.rest_angle[k]) - p.damping[k] * thetadot[k];
  return torque;
}

VectorX inverse_dynamics(const Model& model, const trajectory::BaseMotion& base, const VectorX& theta,
                         const VectorX& thetadot, const VectorX& thetaddot) {
  check_state(model, theta, thetadot);
  check_state(model, thetaddot, thetadot);
  SpatialEngine engine(model);
  engine.place(base, theta, thetadot, false);
  engine.acceleration = thetaddot;
  engine.inverse_torque();
  return engine.inverse;
}

MatrixX mass_matrix(const Model& model, const VectorX& theta) {
  SpatialEngine engine(model);
  engine.place({}, theta, VectorX::Zero(theta.size()), false);
  return engine.mass;
}

VectorX forward_dynamics(const Model& model, const trajectory::BaseMotion& base, const VectorX& theta,
                         const VectorX& thetadot) {
  check_state(model, theta, thetadot);
  SpatialEngine engine(model);
  engine.place(base, theta, thetadot, false);
  if (!engine.factor_mass()) throw_singular(model, engine.singular_angle);
  engine.accelerate();
  return engine.acceleration;
}

// The engine's bodies share one frame, so the force of all bodies beyond the base acts between it and the rope.
Vector6 base_wrench(const Model& model, const trajectory::BaseMotion& base, const VectorX& theta,
                    const VectorX& thetadot, const VectorX& internal_state) {
  check_state(model, theta, thetadot);
  SpatialEngine engine(model);
  engine.internal_state = internal_state;
  engine.place(base, theta, thetadot, false);
  if (!engine.factor_mass()) throw_singular(model, engine.singular_angle);
  engine.accelerate();
  engine.inverse_torque();
  return engine.body_force.front();
}

std::vector<Vector6> base_wrenches(const Model& model, const trajectory::Trajectory& base,
                                   const chain::States& states) {
  CHAINSPLAT_CHECK(states.thetadot.size() == states.time.size(), std::to_string(states.thetadot.size()));
  const std::vector<VectorX> internal =
      states.internal_state.empty() ? internal_states(model, states.theta) : states.internal_state;
  std::vector<Vector6> out;
  for (std::size_t i = 0; i < states.time.size(); ++i)
    out.push_back(base_wrench(model, base.at(states.time[i]), states.theta[i], states.thetadot[i],
                              internal.empty() ? VectorX() : internal[i]));
  return out;
}

VectorX forward_dynamics_articulated(const Model& model, const trajectory::BaseMotion& base, const VectorX& theta,
                                     const VectorX& thetadot) {
  check_state(model, theta, thetadot);
  SpatialEngine engine(model);
  engine.place(base, theta, thetadot, false);
  if (!engine.articulated_acceleration()) throw_singular(model, engine.singular_angle);
  return engine.acceleration;
}

// Engine frames have world axes and the base origin: turn and shift into {i}.
static MatrixX in_link_frames(const SpatialEngine& engine, bool wrenches) {
  MatrixX out = MatrixX::Zero(6, engine.angles);
  for (int j = 0; j < engine.link_count; ++j)
    for (int k = engine.links[j].first_angle; k < engine.links[j].end_angle; ++k) {
      const bool last = k + 1 == engine.links[j].end_angle;
      const math::Pose frame{engine.rotation[k], engine.origin[j]};
      if (wrenches) {
        if (last) out.col(k) = math::adjoint(frame).transpose() * engine.wrench[j];
      } else {
        const Vector6 v = last ? engine.velocity[j] : engine.inner_velocity[k + 1];
        out.col(k) = math::transform_twist(frame.inverse(), v);
      }
    }
  return out;
}

MatrixX external_wrenches(const Model& model, const trajectory::BaseMotion& base, const VectorX& theta,
                          const VectorX& thetadot) {
  check_state(model, theta, thetadot);
  SpatialEngine engine(model);
  engine.place(base, theta, thetadot, false);
  return in_link_frames(engine, true);
}

MatrixX body_twists(const Model& model, const trajectory::BaseMotion& base, const VectorX& theta,
                    const VectorX& thetadot) {
  check_state(model, theta, thetadot);
  SpatialEngine engine(model);
  engine.place(base, theta, thetadot, false);
  return in_link_frames(engine, false);
}

Linearization linearize(const Model& model, const trajectory::BaseMotion& base, const Vector6& base_jerk,
                        const VectorX& theta, const VectorX& thetadot) {
  check_state(model, theta, thetadot);
  SpatialEngine engine(model);
  engine.place(base, theta, thetadot, true);
  if (!engine.factor_mass()) throw_singular(model, engine.singular_angle);
  engine.accelerate();
  engine.linearize(base_jerk);
  return {engine.acceleration, engine.mass, engine.stiffness, engine.damping, engine.drive_rate};
}

BaseSlopes base_slopes(const Model& model, const trajectory::BaseMotion& base, const VectorX& theta,
                       const VectorX& thetadot) {
  check_state(model, theta, thetadot);
  SpatialEngine engine(model);
  engine.place(base, theta, thetadot, true);
  if (!engine.factor_mass()) throw_singular(model, engine.singular_angle);
  engine.accelerate();
  engine.linearize(Vector6::Zero());
  BaseSlopes slopes;
  engine.base_slopes(slopes);
  return slopes;
}

MatrixX unknown_forces(const Model& model, const trajectory::BaseMotion& base, const VectorX& theta,
                       const VectorX& thetadot, std::span<const Tangent> unknowns) {
  check_state(model, theta, thetadot);
  SpatialEngine engine(model);
  engine.place(base, theta, thetadot, false);
  if (!engine.factor_mass()) throw_singular(model, engine.singular_angle);
  engine.accelerate();
  engine.inverse_torque();
  MatrixX forces(engine.angles, static_cast<Eigen::Index>(unknowns.size()));
  engine.unknown_forces(unknowns, forces);
  return forces;
}

double potential_energy(const Model& model, const math::Pose& base, const VectorX& theta) {
  const Parameters& p = model.parameters;
  Vector3 gravity = p.gravity;
  if (p.table_normal && p.table_carries_weight)
    gravity -= p.table_normal->normalized() * p.table_normal->normalized().dot(gravity);
  double energy = 0.0;
  const auto motions = chain::link_motions(model.chain, theta, base);
  const chain::Chain& chain = model.chain;
  for (int link = 1; link < chain.links(); ++link) {
    const double start = chain.link_start(link), end = chain.link_end(link);
    energy -= p.link_mass[link - 1] * gravity.dot(motions[link] * (0.5 * (start + end) * chain.direction));
    if (link + 1 == chain.links())
      energy -= p.tip_mass * gravity.dot(motions[link] * ((end + 0.5 * p.tip_length) * chain.direction));
  }
  if (Torsion torsion(model); torsion.present) {
    torsion.settle(theta);
    return energy + torsion.energy();
  }
  for (int k = 0; k < chain.angles(); ++k) {
    const double bend = theta[k] - p.rest_angle[k];
    energy += 0.5 * p.stiffness[k] * bend * bend;
  }
  return energy;
}

Equilibrium static_equilibrium(const Model& model, const math::Pose& base, const VectorX& start) {
  constexpr double kRounding = 1e-12;   // of the torque scale: what energies and curvatures are known to
  constexpr double kLeastShift = 1e-6;  // of the torque scale
  constexpr int kMostSaddles = 100;     // that are left again
  const int n = model.chain.angles();
  const Parameters& p = model.parameters;
  const VectorX rest = VectorX::Zero(n);
  Equilibrium out{start.size() == n ? start : Eigen::Map<const VectorX>(p.rest_angle.data(), n).eval(), {}};
  double scale = p.tip_mass;
  for (double m : p.link_mass) scale += m;
  scale *= p.gravity.norm() * model.chain.length;
  for (double k : p.stiffness) scale += k;
  if (!(scale > 0.0)) {  // nothing pulls: it rests where it is
    out.summary.reason = solve::Reason::gradient;
    return out;
  }

  SpatialEngine engine(model);
  MatrixX hessian;
  const auto evaluate = [&](const VectorX& theta, solve::NormalEquations* equations) {
    if (equations) {
      engine.place(at_rest(base), theta, rest, true);
      engine.acceleration = rest;
      engine.linearize(Vector6::Zero());
      hessian = 0.5 * (engine.stiffness + engine.stiffness.transpose());
      hessian.diagonal().array() += kRounding * scale;
      *equations = {hessian, engine.bias - engine.torque};
    }
    return potential_energy(model, base, theta);
  };
  solve::Options options;
  options.steps = 1000;
  options.attempts = 30;  // up to a shift of 1e12 of the torque scale
  options.rounding = options.gradient_tolerance = kRounding * scale;
  options.trusted = 1e-11;  // rad, Newton step at the minimum
  options.longest = 0.5;    // rad
  options.damping = {.rule = solve::Damping::Rule::shift,
                     .first = 0.0,
                     .raise = 4.0,
                     .lower = 0.1,
                     .least_raised = kLeastShift * scale,
                     .least = kLeastShift * scale};
  for (int saddles = 0; saddles < kMostSaddles; ++saddles) {
    out.summary = solve::least_squares(out.theta, evaluate, options);
    if (out.summary.reason == solve::Reason::step) return out;
    if (out.summary.reason != solve::Reason::gradient) break;
    // at rest; where the potential curves down it is a saddle (a rope standing upright): leave it
    const Eigen::SelfAdjointEigenSolver<MatrixX> curvature(hessian);
    if (curvature.eigenvalues()[0] >= 0.0) return out;
    out.theta += 0.1 * curvature.eigenvectors().col(0);
  }
  throw WorkError("static equilibrium", "no minimum of the potential energy found: " + solve::describe(out.summary),
                  "check masses and stiffnesses");
}

}  // namespace chainsplat::dynamics
