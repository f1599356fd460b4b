#include "chainsplat/dynamics.h"

#include <doctest/doctest.h>
#include <cmath>
#include <fstream>
#include <nlohmann/json.hpp>

#include "dynamics/planar.h"
#include "dynamics/spatial.h"
#include "src/math/decompositions.h"

using namespace chainsplat;
using namespace chainsplat::dynamics;
using math::Matrix6;
using math::Pose;
using nlohmann::json;

namespace {

const char* kFiles[] = {"chain_planar_1", "chain_planar_3", "chain_planar_8", "chain_universal_4"};

json load(const std::string& name) {
  return json::parse(core::read_file(Path(CHAINSPLAT_SOURCE_DIR) / "tests/data/vectors" / (name + ".json")));
}
VectorX vector_of(const json& j) {
  VectorX v(j.size());
  for (std::size_t i = 0; i < j.size(); ++i) v[i] = j[i];
  return v;
}
MatrixX matrix_of(const json& j) {  // rows
  MatrixX m(j.size(), j[0].size());
  for (std::size_t i = 0; i < j.size(); ++i) m.row(i) = vector_of(j[i]).transpose();
  return m;
}
Pose pose_of(const json& j) {
  const MatrixX m = matrix_of(j);
  return {m.topLeftCorner<3, 3>(), m.topRightCorner<3, 1>()};
}
double difference(const MatrixX& a, const MatrixX& b) {  // relative to the largest entry of b
  REQUIRE(a.rows() == b.rows());
  REQUIRE(a.cols() == b.cols());
  return (a - b).cwiseAbs().maxCoeff() / std::max(b.cwiseAbs().maxCoeff(), 1e-300);
}

Model model_of(const json& file) {
  const json& p = file["parameters"];
  const int links = file["links"];
  const bool universal = file["kind"] == "universal";
  const Vector3 d = vector_of(p["direction"]), a = vector_of(p["axis_1"]);
  const chain::Chain chain =
      chain::make_chain(p["length"], 2.0 * double(p["radius"]), d, a, links,
                        universal ? chain::Bending::spatial : chain::Bending::planar, false, p["first_joint"]);
  Parameters out;
  out.link_mass = p["link_mass"].get<std::vector<double>>();
  out.viscous_friction = p["viscous_friction"].get<std::vector<double>>();
  out.coulomb_friction = p["coulomb_friction"].get<std::vector<double>>();
  out.air_linear = p["air_linear"].get<std::vector<double>>();
  out.air_quadratic = p["air_quadratic"].get<std::vector<double>>();
  out.stiffness = p["stiffness"].get<std::vector<double>>();
  out.rest_angle = p["rest_angle"].get<std::vector<double>>();
  out.damping = p["damping"].get<std::vector<double>>();
  out.tip_mass = p["tip_mass"];
  out.radius = p["radius"];
  out.gravity = vector_of(p["gravity"]);
  out.table_normal = vector_of(p["table_normal"]);
  out.table_carries_weight = false;
  out.coulomb_speed = p["coulomb_speed"];
  out.drag_speed = p["air_speed"];
  return make_model(chain, out);
}

// p(t) = p0 + A (1 - cos w t), turned about z by psi (1 - cos(wpsi t)).
BaseFunction base_of(const json& file) {
  const json& b = file["base_motion"];
  const Vector3 p0 = vector_of(b["p0"]), amplitude = vector_of(b["A"]), w = vector_of(b["w"]);
  const double psi = b["psi"], wpsi = b["wpsi"];
  return [=](double t) {
    trajectory::BaseMotion base;
    const double angle = psi * (1 - std::cos(wpsi * t)), rate = psi * wpsi * std::sin(wpsi * t);
    Vector3 v, a;
    for (int k = 0; k < 3; ++k) {
      base.pose.translation[k] = p0[k] + amplitude[k] * (1 - std::cos(w[k] * t));
      v[k] = amplitude[k] * w[k] * std::sin(w[k] * t);
      a[k] = amplitude[k] * w[k] * w[k] * std::cos(w[k] * t);
    }
    const Vector3 z = Vector3::UnitZ();
    base.pose.rotation = math::exp_so3(angle * z);
    const Matrix3 back = base.pose.rotation.transpose();
    base.velocity << rate * z, back * v;
    base.acceleration << psi * wpsi * wpsi * std::cos(wpsi * t) * z, back * a - rate * z.cross(back * v);
    return base;
  };
}
Vector6 jerk_of(const BaseFunction& base, double t) {
  const double e = 1e-4;  // central difference of fourth order
  return (8.0 * (base(t + e).acceleration - base(t - e).acceleration) -
          (base(t + 2 * e).acceleration - base(t - 2 * e).acceleration)) /
         (12.0 * e);
}

// A planar or spatial rope of n joints with every term switched on.
Model rope(int joints, chain::Bending bending, bool twist = false) {
  const chain::Chain chain = chain::make_chain(0.3, 0.02, -Vector3::UnitZ(), Vector3::UnitY(), joints, bending, twist);
  Parameters p;
  const auto fill = [](int count, double value) { return std::vector<double>(count, value); };
  p.link_mass = fill(joints, 0.06 / joints);
  p.viscous_friction = fill(joints, 0.002), p.coulomb_friction = fill(joints, 0.05);
  p.air_linear = fill(joints, 0.0005), p.air_quadratic = fill(joints, 0.0144 * 0.3 / joints);
  p.stiffness = fill(chain.angles(), 0.012), p.rest_angle = fill(chain.angles(), 0.03);
  p.damping = fill(chain.angles(), 3.6e-4);
  p.tip_mass = 0.002, p.tip_length = 0.03, p.radius = 0.01;
  p.table_normal = Vector3(0.1, 0.2, 1.0);
  p.coulomb_speed = 0.02;
  return make_model(chain, p);
}
Model without_losses(Model m) {
  Parameters p = m.parameters;
  for (auto* v : {&p.viscous_friction, &p.coulomb_friction, &p.air_linear, &p.air_quadratic, &p.damping})
    std::fill(v->begin(), v->end(), 0.0);
  p.table_normal.reset();
  return make_model(m.chain, p);
}
VectorX random_vector(core::Random& random, int n, double scale) {
  VectorX v(n);
  for (int i = 0; i < n; ++i) v[i] = scale * random.normal();
  return v;
}
trajectory::BaseMotion random_base(core::Random& random) {
  trajectory::BaseMotion base;
  base.pose = math::exp_se3(random_vector(random, 6, 1.0));
  base.velocity = random_vector(random, 6, 1.0);
  base.acceleration = random_vector(random, 6, 3.0);
  return base;
}

}  // namespace

TEST_CASE("constants of the model agree with the reference vectors") {
  for (const char* name : kFiles) {
    CAPTURE(name);
    const json file = load(name);
    const Model model = model_of(file);
    for (int i = 0; i < model.chain.angles(); ++i) {
      CHECK(difference(model.axis[i], vector_of(file["derived"]["A"][i])) < 1e-12);
      CHECK(difference(model.chain.axes[i], vector_of(file["derived"]["S"][i])) < 1e-12);
      CHECK((model.home[i].translation - pose_of(file["derived"]["home_frames"][i]).translation).norm() < 1e-12);
      const MatrixX g = matrix_of(file["derived"]["G"][i]);
      CHECK((model.inertia[i] - g).cwiseAbs().maxCoeff() <= 1e-12 * std::max(1e-3, g.cwiseAbs().maxCoeff()));
    }
  }
}

TEST_CASE("dynamics at single states agree with the reference vectors") {
  for (const char* name : kFiles) {
    CAPTURE(name);
    const json file = load(name);
    const Model model = model_of(file);
    const BaseFunction base_at = base_of(file);
    const int n = model.chain.angles();
    for (const json& state : file["states"]) {
      const double t = state["t"];
      const trajectory::BaseMotion base = base_at(t);
      CHECK((base.velocity - vector_of(state["V_b"])).norm() < 1e-12);
      CHECK((base.acceleration - vector_of(state["Vdot_b"])).norm() < 1e-12);
      const VectorX theta = vector_of(state["theta"]), thetadot = vector_of(state["thetadot"]),
                    thetaddot = vector_of(state["thetaddot"]);
      CHECK(difference(inverse_dynamics(model, base, theta, thetadot, thetaddot), vector_of(state["rnea_torque"])) <
            1e-12);
      CHECK(difference(mass_matrix(model, theta), matrix_of(state["mass_matrix"])) < 1e-12);
      CHECK(difference(body_twists(model, base, theta, thetadot), matrix_of(state["link_twists_body"]).transpose()) <
            1e-12);
      CHECK(difference(external_wrenches(model, base, theta, thetadot),
                       matrix_of(state["external_wrenches_body"]).transpose()) < 1e-12);
      CHECK(difference(joint_law(model, theta, thetadot), vector_of(state["joint_law_torque"])) < 1e-12);
      const VectorX a = vector_of(state["forward_dynamics"]);
      CHECK(difference(forward_dynamics(model, base, theta, thetadot), a) < 1e-10);
      CHECK(difference(forward_dynamics_articulated(model, base, theta, thetadot), a) < 1e-10);

      const Linearization linear = linearize(model, base, jerk_of(base_at, t), theta, thetadot);
      const auto solve = [&](const MatrixX& b) -> MatrixX { return linear.mass.ldlt().solve(b); };
      CHECK(difference(-solve(linear.stiffness), matrix_of(state["da_dtheta"])) < 1e-10);
      CHECK(difference(-solve(linear.damping), matrix_of(state["da_dthetadot"])) < 1e-10);
      CHECK(difference(solve(linear.drive_rate), vector_of(state["da_dt"])) < 1e-9);  // the jerk is a difference

      const ClosedForm closed = closed_form(model, base, theta, thetadot);
      CHECK(difference(closed.mass, matrix_of(state["mass_matrix"])) < 1e-12);
      CHECK((closed.coriolis - vector_of(state["coriolis_vector"])).norm() < 1e-12);
      CHECK(difference(closed.gravity, vector_of(state["gravity_vector"])) < 1e-12);
      CHECK(difference(closed.base, vector_of(state["base_motion_vector"])) < 1e-12);
      CHECK(difference(-closed.friction, vector_of(state["friction_vector"])) < 1e-12);
      CHECK(difference(closed.velocity_jacobian, matrix_of(state["da_dthetadot"])) < 1e-10);
      CHECK(n == closed.mass.rows());
    }
  }
}

TEST_CASE("steps and rollouts agree with the reference vectors") {
  for (const char* name : kFiles) {
    CAPTURE(name);
    const json file = load(name);
    Model model = model_of(file);
    const BaseFunction base = base_of(file);
    const int n = model.chain.angles();
    for (const json& state : file["states"]) {
      const double t = state["t"];
      const InitialState initial{t, vector_of(state["theta"]), vector_of(state["thetadot"])};
      for (const bool rodas : {true, false}) {
        const json& step = state[rodas ? "rodas3" : "implicit_velocity_euler"];
        model.parameters.integrator = rodas ? Integrator::rodas3 : Integrator::implicit_velocity_euler;
        model.parameters.substeps = rodas ? 4 : 1;
        BaseGrid grid = sample_base(base, t, {t + double(step["h"])}, model.parameters.substeps);
        grid.nodes[0].jerk = jerk_of(base, t);  // better than what a general base function gives
        REQUIRE(grid.nodes.size() == 2);
        chain::States end;
        REQUIRE(simulate(model, grid, initial.theta, initial.thetadot, end));
        CHECK(difference(end.theta[0], vector_of(step["theta"])) < 1e-10);
        CHECK(difference(end.thetadot[0], vector_of(step["thetadot"])) < 1e-10);
      }
    }
    for (const bool rodas : {true, false}) {
      const json& reference = file[rodas ? "rollout_rodas3" : "rollout_implicit_velocity_euler"];
      model.parameters.integrator = rodas ? Integrator::rodas3 : Integrator::implicit_velocity_euler;
      model.parameters.substeps = reference["substeps"];
      std::vector<double> times;
      for (int k = 0; k <= 150; ++k) times.push_back(k / 30.0);
      const chain::States states = rollout(model, base, {0.0, VectorX::Zero(n), VectorX::Zero(n)}, times);
      double worst = 0.0;
      for (int k = 0; k <= 150; ++k)
        worst = std::max(worst, (states.theta[k] - vector_of(reference["state"][k]).head(n)).cwiseAbs().maxCoeff());
      CHECK(worst < 1e-8);
    }
  }
}

TEST_CASE("articulated, dense and inverse dynamics agree on chains with two and three axes a joint") {
  core::Random random(3);
  for (const bool twist : {false, true}) {
    const Model model = rope(6, chain::Bending::spatial, twist);
    const int n = model.chain.angles();
    for (int trial = 0; trial < 5; ++trial) {
      const trajectory::BaseMotion base = random_base(random);
      const VectorX theta = random_vector(random, n, 0.4), thetadot = random_vector(random, n, 2.0);
      const VectorX a = forward_dynamics(model, base, theta, thetadot);
      CHECK(difference(forward_dynamics_articulated(model, base, theta, thetadot), a) < 1e-8);
      CHECK(difference(inverse_dynamics(model, base, theta, thetadot, a), joint_law(model, theta, thetadot)) < 1e-8);
      CHECK(difference(closed_form(model, base, theta, thetadot).mass, mass_matrix(model, theta)) < 1e-12);
    }
  }
}

TEST_CASE("the linearization agrees with central differences, table normal included") {
  core::Random random(4);
  const Model model = rope(5, chain::Bending::spatial, true);
  const int n = model.chain.angles();
  const trajectory::BaseMotion base = random_base(random);
  const Vector6 jerk = random_vector(random, 6, 5.0);
  const VectorX theta = random_vector(random, n, 0.4), thetadot = random_vector(random, n, 2.0);
  const Linearization linear = linearize(model, base, jerk, theta, thetadot);
  const double e = 1e-5;
  const auto force = [&](const trajectory::BaseMotion& b, const VectorX& q,
                         const VectorX& v) {  // M a - torque at fixed a
    return VectorX(inverse_dynamics(model, b, q, v, linear.acceleration) - joint_law(model, q, v));
  };
  for (int k = 0; k < n; ++k) {
    const VectorX unit = e * VectorX::Unit(n, k);
    const VectorX by_angle = (force(base, theta + unit, thetadot) - force(base, theta - unit, thetadot)) / (2 * e);
    const VectorX by_rate = (force(base, theta, thetadot + unit) - force(base, theta, thetadot - unit)) / (2 * e);
    CHECK((by_angle - linear.stiffness.col(k)).norm() < 1e-7 * linear.stiffness.norm());
    CHECK((by_rate - linear.damping.col(k)).norm() < 1e-7 * linear.damping.norm());
  }
  const auto moved = [&](double dt) {
    trajectory::BaseMotion b = base;
    b.pose = base.pose * math::exp_se3(dt * base.velocity);
    b.velocity += dt * base.acceleration;
    b.acceleration += dt * jerk;
    return b;
  };
  const VectorX by_time = (force(moved(e), theta, thetadot) - force(moved(-e), theta, thetadot)) / (2 * e);
  CHECK((by_time + linear.drive_rate).norm() < 1e-7 * linear.drive_rate.norm());
}

TEST_CASE("energy is kept without losses and falls by what the dampers take") {
  const Model free = without_losses(rope(8, chain::Bending::spatial));
  const int n = free.chain.angles();
  core::Random random(6);
  const InitialState initial{0.0, random_vector(random, n, 0.2), random_vector(random, n, 0.5)};
  const auto energy = [](const Model& m, const VectorX& q, const VectorX& v) {
    return potential_energy(m, Pose(), q) + 0.5 * v.dot(mass_matrix(m, q) * v);
  };
  const BaseFunction still = [](double) { return at_rest(Pose()); };
  Model fine = free;
  fine.parameters.substeps = 64;
  const chain::States kept = rollout(fine, still, initial, {1.0});
  const double before = energy(free, initial.theta, initial.thetadot);
  const double swing = before - potential_energy(free, Pose(), static_equilibrium(free, Pose()).theta);
  CHECK(swing > 1e-3);
  CHECK(std::abs(energy(free, kept.theta[0], kept.thetadot[0]) - before) < 1e-3 * swing);

  Parameters p = free.parameters;
  p.substeps = 32;
  std::fill(p.damping.begin(), p.damping.end(), 5e-4);
  const Model damped = make_model(free.chain, p);
  std::vector<double> times;
  const int count = 600;
  for (int k = 0; k <= count; ++k) times.push_back(k / 600.0);
  const chain::States states = rollout(damped, still, initial, times);
  double taken = 0.0;  // Simpson's rule over thetadot^T D thetadot
  for (int k = 0; k <= count; ++k)
    taken += (k == 0 || k == count ? 1.0 : k % 2 ? 4.0 : 2.0) / 3.0 / 600.0 * 5e-4 * states.thetadot[k].squaredNorm();
  const double after = energy(damped, states.theta.back(), states.thetadot.back());
  CHECK(taken > 0.3 * swing);
  CHECK(before - after == doctest::Approx(taken).epsilon(1e-3));
}

TEST_CASE("RODAS3 has third order, the Euler step first") {
  const json file = load("chain_planar_8");
  Model model = model_of(file);
  model.parameters.coulomb_friction.assign(8, 0.0);  // its 20 mm/s corner hides the order at these steps
  const BaseFunction base = base_of(file);
  const InitialState initial{0.0, VectorX::Zero(8), VectorX::Zero(8)};
  const auto end = [&](Integrator integrator, int substeps) {
    model.parameters.integrator = integrator;
    model.parameters.substeps = substeps;
    return rollout(model, base, initial, {1.0}).theta[0];
  };
  const VectorX truth = end(Integrator::rodas3, 512);
  const auto error = [&](Integrator integrator, int substeps) { return (end(integrator, substeps) - truth).norm(); };
  const double third = std::log2(error(Integrator::rodas3, 16) / error(Integrator::rodas3, 32));
  CHECK(third > 2.7);
  CHECK(third < 3.6);
  const double first =
      std::log2(error(Integrator::implicit_velocity_euler, 64) / error(Integrator::implicit_velocity_euler, 128));
  CHECK(first > 0.8);
  CHECK(first < 1.2);
}

TEST_CASE("sensitivities agree with differences of rollouts") {
  core::Random random(8);
  Model model = rope(4, chain::Bending::spatial);
  model.parameters.substeps = 64;
  const int n = model.chain.angles(), links = 4;
  const BaseFunction base = base_of(load("chain_planar_8"));
  std::vector<double> times;
  for (int k = 1; k <= 20; ++k) times.push_back(k / 30.0);
  const auto grid = sample_base(base, 0.0, times, model.parameters.substeps);
  const VectorX theta = random_vector(random, n, 0.2), thetadot = random_vector(random, n, 0.3);

  std::vector<Tangent> unknowns(11);
  const auto some = [&](int count, double scale) {
    std::vector<double> v(count);
    for (double& x : v) x = scale * random.uniform(0.5, 1.0);
    return v;
  };
  unknowns[0].stiffness = some(n, 0.012);
  unknowns[1].damping = some(n, 3e-4);
  unknowns[2].rest_angle = some(n, 0.1);
  unknowns[3].link_mass = some(links, 0.015);
  unknowns[4].tip_mass = 0.002;
  unknowns[5].viscous_friction = some(links, 0.002);
  unknowns[6].coulomb_friction = some(links, 0.05);
  unknowns[7].air_linear = some(links, 0.0005), unknowns[7].air_quadratic = some(links, 0.0005);
  unknowns[8].theta = random_vector(random, n, 0.1);
  unknowns[9].thetadot = random_vector(random, n, 0.1);
  unknowns[10].tip_length = 0.01;
  chain::States states;
  Sensitivities sensitivities;
  REQUIRE(simulate(model, grid, theta, thetadot, states, unknowns, &sensitivities));
  for (std::size_t u = 0; u < unknowns.size(); ++u) {
    CAPTURE(u);
    const double e = 1e-4;
    const auto shifted = [&](double step) {
      const Tangent& d = unknowns[u];
      Parameters p = model.parameters;
      const auto add = [&](std::vector<double>& x, const std::vector<double>& dx) {
        for (std::size_t i = 0; i < dx.size(); ++i) x[i] += step * dx[i];
      };
      add(p.stiffness, d.stiffness), add(p.damping, d.damping), add(p.rest_angle, d.rest_angle);
      add(p.link_mass, d.link_mass), add(p.viscous_friction, d.viscous_friction);
      add(p.coulomb_friction, d.coulomb_friction), add(p.air_linear, d.air_linear);
      add(p.air_quadratic, d.air_quadratic);
      p.tip_mass += step * d.tip_mass, p.tip_length += step * d.tip_length;
      VectorX q = theta, v = thetadot;
      if (d.theta.size()) q += step * d.theta;
      if (d.thetadot.size()) v += step * d.thetadot;
      chain::States out;
      REQUIRE(simulate(make_model(model.chain, p), grid, q, v, out));
      return out;
    };
    const chain::States up = shifted(e), down = shifted(-e);
    double error = 0.0, size = 0.0;
    for (std::size_t k = 0; k < times.size(); ++k) {
      const VectorX d = (up.theta[k] - down.theta[k]) / (2 * e);
      error += (d - sensitivities.theta[k].col(u)).squaredNorm();
      size += d.squaredNorm();
    }
    CHECK(std::sqrt(error / size) < 2e-3);  // the variational equation is solved to second order only
  }
}

TEST_CASE("what hangs at the tip is a rod that goes on there: the same as a last link that is longer and heavier") {
  core::Random random(9);
  for (const chain::Bending bending : {chain::Bending::planar, chain::Bending::spatial}) {
    Parameters p = without_losses(rope(3, bending)).parameters;
    p.radius = 0.0, p.link_mass = {0.02, 0.03, 0.04};
    chain::Chain chain = rope(3, bending).chain, longer = chain;
    longer.length += 0.05;
    Parameters whole = p;
    p.tip_length = 0.05, p.tip_mass = 0.04 * 0.05 / 0.1;  // links are 10 cm long
    whole.tip_length = whole.tip_mass = 0.0, whole.link_mass[2] += p.tip_mass;
    const Model apart = make_model(chain, p), together = make_model(longer, whole);
    const int n = chain.angles();
    const VectorX theta = random_vector(random, n, 0.5), thetadot = random_vector(random, n, 2.0);
    const trajectory::BaseMotion base = random_base(random);
    const auto same = [](const MatrixX& a, const MatrixX& b) {
      CHECK((a - b).cwiseAbs().maxCoeff() < 1e-12 * b.cwiseAbs().maxCoeff());
    };
    same(mass_matrix(apart, theta), mass_matrix(together, theta));
    same(forward_dynamics(apart, base, theta, thetadot), forward_dynamics(together, base, theta, thetadot));
    same(closed_form(apart, base, theta, thetadot).gravity, closed_form(together, base, theta, thetadot).gravity);
    CHECK(potential_energy(apart, base.pose, theta) ==
          doctest::Approx(potential_energy(together, base.pose, theta)).epsilon(1e-12));
    p.tip_length = 0.0;  // as a point it is another rope
    CHECK((mass_matrix(make_model(chain, p), theta) - mass_matrix(together, theta)).cwiseAbs().maxCoeff() >
          0.03 * mass_matrix(together, theta).cwiseAbs().maxCoeff());
  }
}

TEST_CASE("static equilibrium hangs down, also from above, and is where a damped rollout ends") {
  Model model = without_losses(rope(8, chain::Bending::spatial));
  const Pose upside_down{math::exp_so3(Vector3(M_PI, 0, 0)), Vector3::Zero()};
  Parameters p = model.parameters;
  std::fill(p.stiffness.begin(), p.stiffness.end(), 0.0);
  const Model slack = make_model(model.chain, p);
  for (const Pose& pose : {Pose(), upside_down}) {
    const Equilibrium found = static_equilibrium(slack, pose);
    CHECK(solve::converged(found.summary));
    const VectorX& theta = found.theta;
    const auto nodes = chain::nodes(slack.chain, chain::link_motions(slack.chain, theta, pose));
    CHECK((nodes.col(nodes.cols() - 1) - Vector3(0, 0, -0.3)).norm() < 1e-6);
  }
  p = model.parameters;
  std::fill(p.damping.begin(), p.damping.end(), 3e-3);
  const Model damped = make_model(model.chain, p);
  const Pose tilted{math::exp_so3(Vector3(0.4, -0.7, 0.2)), Vector3(0.1, 0.2, 0.3)};
  const int n = model.chain.angles();
  const VectorX theta = static_equilibrium(damped, tilted).theta;
  const chain::States end = rollout(damped, [&](double) { return at_rest(tilted); },
                                    {0.0, VectorX::Zero(n), VectorX::Zero(n)}, {60.0});  // its slowest mode takes 2.5 s
  const VectorX still = VectorX::Zero(n);
  CHECK(forward_dynamics(damped, at_rest(tilted), theta, still).norm() < 1e-6);
  CHECK((end.theta[0] - theta).norm() < 1e-6);
}

// A planar rope on a table that also rolls.
Model rolling(Model model) {
  for (int k = 0; k < model.chain.angles(); ++k) model.parameters.roll_lever.push_back(0.004 * (k - 1.5));
  return make_model(model.chain, model.parameters);
}

TEST_CASE("friction that rolls the rope enters the closed form, the recursions and their derivatives alike") {
  core::Random random(21);
  const Model model = rolling(rope(5, chain::Bending::planar));
  CHECK_THROWS_AS(rolling(rope(5, chain::Bending::spatial)), InputError);
  for (int trial = 0; trial < 3; ++trial) {
    const trajectory::BaseMotion base = random_base(random);
    const VectorX theta = random_vector(random, 5, 0.4), thetadot = random_vector(random, 5, 2.0);
    const ClosedForm closed = closed_form(model, base, theta, thetadot);
    const VectorX a = forward_dynamics(model, base, theta, thetadot);
    const VectorX force =
        joint_law(model, theta, thetadot) - closed.coriolis - closed.gravity - closed.base + closed.friction;
    CHECK(difference(a, closed.mass.ldlt().solve(force)) < 1e-10);
    CHECK(difference(a, forward_dynamics_articulated(model, base, theta, thetadot)) < 1e-10);
    Model still = model;
    still.parameters.roll_lever.clear();
    CHECK(difference(a, forward_dynamics(still, base, theta, thetadot)) > 1e-4);
    const Linearization at = linearize(model, base, Vector6::Zero(), theta, thetadot);
    const MatrixX by_rate = -at.mass.ldlt().solve(at.damping);
    CHECK(difference(by_rate, closed.velocity_jacobian) < 1e-9);
    constexpr double kStep = 1e-6;
    for (int k = 0; k < 5; ++k) {
      const VectorX unit = kStep * VectorX::Unit(5, k);
      const VectorX slope = (forward_dynamics(model, base, theta + unit, thetadot) -
                             forward_dynamics(model, base, theta - unit, thetadot)) /
                            (2.0 * kStep);
      CHECK(difference(-at.mass.ldlt().solve(at.stiffness.col(k)), slope) < 1e-6);
    }
  }
}

TEST_CASE("the planar equations agree with the spatial ones, the base moving and turning out of the plane too") {
  core::Random random(12);
  for (const double first_joint : {0.0, 0.02})
    for (const bool table : {true, false}) {
      Model model = rope(6, chain::Bending::planar);
      Parameters p = model.parameters;
      if (!table) p.table_normal.reset();
      for (double& m : p.link_mass) m *= random.uniform(0.5, 1.5);
      const Vector3 d = Vector3(0.3, -0.5, 0.8).normalized(), a = d.cross(Vector3(1, 2, 0.5)).normalized();
      model = rolling(make_model(chain::make_chain(0.3, 0.02, d, a, 6, chain::Bending::planar, false, first_joint), p));
      REQUIRE(is_planar(model.chain));
      CHECK(!is_planar(rope(6, chain::Bending::spatial).chain));
      std::vector<Tangent> unknowns(9);
      unknowns[0].link_mass = unknowns[1].viscous_friction = unknowns[2].coulomb_friction = unknowns[3].air_linear =
          unknowns[4].air_quadratic = {0.1, 0.2, 0.3, 0.2, 0.4, 0.1};
      unknowns[5].tip_mass = 1.0;
      unknowns[6].stiffness = unknowns[6].damping = unknowns[6].rest_angle = {0.1, 0.2, 0.3, 0.2, 0.4, 0.1};
      unknowns[7].roll_lever = {0.1, 0.2, 0.3, 0.2, 0.4, 0.1};
      unknowns[8].tip_length = 1.0;
      for (int trial = 0; trial < 3; ++trial) {
        const trajectory::BaseMotion base = random_base(random);
        const Vector6 jerk = random_vector(random, 6, 5.0);
        const VectorX theta = random_vector(random, 6, 0.5), thetadot = random_vector(random, 6, 2.0);
        SpatialEngine general(model);
        PlanarEngine planar(model);
        MatrixX forces(6, 9), planar_forces(6, 9);
        for (Engine* engine : {static_cast<Engine*>(&general), static_cast<Engine*>(&planar)}) {
          engine->place(base, theta, thetadot, true);
          REQUIRE(engine->factor_mass());
          engine->accelerate();
          engine->linearize(jerk);
          engine->unknown_forces(unknowns, engine == &general ? forces : planar_forces);
        }
        CHECK(difference(planar.mass, general.mass) < 1e-12);
        CHECK(difference(planar.bias, general.bias) < 1e-12);
        CHECK(difference(planar.acceleration, general.acceleration) < 1e-10);
        CHECK(difference(planar.inverse, general.inverse) < 1e-9);
        CHECK(difference(planar.stiffness, general.stiffness) < 1e-11);
        CHECK(difference(planar.damping, general.damping) < 1e-11);
        CHECK(difference(planar.drive_rate, general.drive_rate) < 1e-11);
        BaseSlopes planar_slopes, slopes;
        planar.base_slopes(planar_slopes), general.base_slopes(slopes);
        CHECK(difference(planar_slopes.acceleration, slopes.acceleration) < 1e-11);
        CHECK(difference(planar_slopes.velocity, slopes.velocity) < 1e-11);
        CHECK(difference(planar_slopes.rotation, slopes.rotation) < 1e-11);
        for (int u = 0; u < 8; ++u) {
          if (u == 7 && !table) continue;  // rolls on a table only
          CHECK(difference(planar_forces.col(u), forces.col(u)) < 1e-9);
        }
      }
    }
}

TEST_CASE("derivatives by every parameter and by the base motion agree with central differences") {
  core::Random random(9);
  for (const bool twist : {false, true}) {
    const Model model = twist ? rope(4, chain::Bending::spatial, true) : rolling(rope(4, chain::Bending::planar));
    const int n = model.chain.angles(), links = 4;
    const trajectory::BaseMotion base = random_base(random);
    const VectorX theta = random_vector(random, n, 0.4), thetadot = random_vector(random, n, 2.0);
    const VectorX a = forward_dynamics(model, base, theta, thetadot);
    const auto force = [&](const Model& m, const trajectory::BaseMotion& b) {  // at fixed a
      return VectorX(joint_law(m, theta, thetadot) - inverse_dynamics(m, b, theta, thetadot, a));
    };

    // one unknown for every number of the parameters
    using Array = std::vector<double> Parameters::*;
    using Slope = std::vector<double> Tangent::*;
    const std::tuple<Array, Slope, int> arrays[] = {{&Parameters::link_mass, &Tangent::link_mass, links},
                                                    {&Parameters::viscous_friction, &Tangent::viscous_friction, links},
                                                    {&Parameters::coulomb_friction, &Tangent::coulomb_friction, links},
                                                    {&Parameters::air_linear, &Tangent::air_linear, links},
                                                    {&Parameters::air_quadratic, &Tangent::air_quadratic, links},
                                                    {&Parameters::stiffness, &Tangent::stiffness, n},
                                                    {&Parameters::rest_angle, &Tangent::rest_angle, n},
                                                    {&Parameters::damping, &Tangent::damping, n},
                                                    {&Parameters::roll_lever, &Tangent::roll_lever, twist ? 0 : n}};
    const auto check = [&](const Tangent& unknown, const Parameters& up, const Parameters& down, double size) {
      const VectorX difference =
          (force(make_model(model.chain, up), base) - force(make_model(model.chain, down), base)) / (2.0 * size);
      const VectorX found = unknown_forces(model, base, theta, thetadot, {&unknown, 1}).col(0);
      CHECK(difference.norm() > 0.0);
      CHECK((found - difference).norm() < 1e-7 * difference.norm());
    };
    for (const auto& [array, slope, count] : arrays)
      for (int i = 0; i < count; ++i) {
        if (array == &Parameters::roll_lever && i == 0) continue;  // at the grasp nothing rolls
        Parameters up = model.parameters, down = up;
        const double size = 1e-4 * std::abs((up.*array)[i]);
        (up.*array)[i] += size, (down.*array)[i] -= size;
        Tangent unknown;
        (unknown.*slope).assign(count, 0.0);
        (unknown.*slope)[i] = 1.0;
        check(unknown, up, down, size);
      }
    Parameters up = model.parameters, down = up;
    up.tip_mass += 1e-6, down.tip_mass -= 1e-6;
    Tangent tip;
    tip.tip_mass = 1.0;
    check(tip, up, down, 1e-6);
    up = down = model.parameters;
    up.tip_length += 1e-4, down.tip_length -= 1e-4;
    Tangent reach;
    reach.tip_length = 1.0;
    check(reach, up, down, 1e-4);

    const BaseSlopes slopes = base_slopes(model, base, theta, thetadot);
    const double e = 1e-5;
    const auto by_base = [&](const std::function<void(trajectory::BaseMotion&, double)>& move) {
      trajectory::BaseMotion forth = base, back = base;
      move(forth, e), move(back, -e);
      return VectorX((force(model, back) - force(model, forth)) / (2.0 * e));  // of tau_ID
    };
    for (int c = 0; c < 6; ++c) {
      const VectorX acceleration = by_base([&](auto& b, double x) { b.acceleration[c] += x; });
      const VectorX velocity = by_base([&](auto& b, double x) { b.velocity[c] += x; });
      CHECK((slopes.acceleration.col(c) - acceleration).norm() < 1e-7 * slopes.acceleration.norm());
      CHECK((slopes.velocity.col(c) - velocity).norm() < 1e-7 * slopes.velocity.norm());
    }
    for (int c = 0; c < 3; ++c) {
      const VectorX rotation =
          by_base([&](auto& b, double x) { b.pose.rotation *= math::exp_so3(x * Vector3::Unit(c)); });
      CHECK((slopes.rotation.col(c) - rotation).norm() < 1e-7 * slopes.rotation.norm());
    }
  }
}

TEST_CASE("power balance with a moving, turning base: energy changes by what base, dampers and friction give") {
  core::Random random(11);
  const Model model = [&] {
    Model m = rope(5, chain::Bending::spatial);
    m.parameters.table_carries_weight = false;  // then gravity is a potential in all directions
    return make_model(m.chain, m.parameters);
  }();
  const int n = model.chain.angles();
  const trajectory::BaseMotion base = random_base(random);
  const VectorX theta = random_vector(random, n, 0.4), thetadot = random_vector(random, n, 2.0);
  const VectorX a = forward_dynamics(model, base, theta, thetadot);
  const auto at = [&](double t) {  // along the motion, correct to second order
    trajectory::BaseMotion b = base;
    b.pose = base.pose * math::exp_se3(t * base.velocity + 0.5 * t * t * base.acceleration);
    b.velocity += t * base.acceleration;
    return b;
  };
  const auto frames = [&](const VectorX& q, const Pose& pose) {  // T_si
    std::vector<Pose> out;
    Pose motion = pose;
    for (int k = 0; k < n; ++k) {
      motion = motion * math::exp_se3(model.chain.axes[k] * q[k]);
      out.push_back(motion * model.home[k]);
    }
    return out;
  };
  struct Sum {
    double energy;
    Vector6 momentum;  // about the world origin
  };
  const auto sum = [&](double t) {
    const VectorX q = theta + t * thetadot + 0.5 * t * t * a, v = thetadot + t * a;
    const trajectory::BaseMotion b = at(t);
    const MatrixX twists = body_twists(model, b, q, v);
    const auto poses = frames(q, b.pose);
    Sum out{potential_energy(model, b.pose, q), Vector6::Zero()};
    for (int i = 0; i < n; ++i) {
      const Vector6 momentum = model.inertia[i] * twists.col(i);
      out.energy += 0.5 * twists.col(i).dot(momentum);
      out.momentum += math::adjoint(poses[i].inverse()).transpose() * momentum;
    }
    return out;
  };
  const double e = 1e-5;
  const Sum up = sum(e), down = sum(-e);
  const double rate = (up.energy - down.energy) / (2.0 * e);

  const MatrixX wrenches = external_wrenches(model, base, theta, thetadot),
                twists = body_twists(model, base, theta, thetadot);
  const auto poses = frames(theta, base.pose);
  Vector6 outside = Vector6::Zero();  // friction and gravity, about the world origin
  double power =
      -thetadot.dot(VectorX(Eigen::Map<const VectorX>(model.parameters.damping.data(), n).asDiagonal() * thetadot));
  for (int i = 0; i < n; ++i) {
    outside += math::adjoint(poses[i].inverse()).transpose() * wrenches.col(i);
    power += wrenches.col(i).dot(twists.col(i));
    const double mass = model.inertia[i](3, 3);
    if (mass == 0.0) continue;
    const Vector3 moment(model.inertia[i](4, 2), -model.inertia[i](3, 2), model.inertia[i](3, 1));
    const Vector3 center = poses[i] * Vector3(moment / mass);
    Vector6 weight;
    weight << center.cross(mass * model.parameters.gravity), mass * model.parameters.gravity;
    outside += weight;
  }
  const Vector6 hand = (up.momentum - down.momentum) / (2.0 * e) - outside;  // what the base exerts
  power += hand.dot(math::transform_twist(base.pose, base.velocity));
  CHECK(std::abs(rate) > 1e-3);
  CHECK(power == doctest::Approx(rate).epsilon(1e-6));
}

TEST_CASE("RODAS3 with the default steps is within 0.02 mm of an adaptive Runge-Kutta solution") {
  const json file = load("chain_planar_8");
  Model model = model_of(file);
  model.parameters.coulomb_friction.assign(8, 0.0);
  const BaseFunction base = base_of(file);
  // Dormand and Prince, order 5(4), on theta and thetadot by the articulated body algorithm
  const auto slope = [&](double t, const VectorX& y) {
    VectorX out(16);
    out << y.tail(8), forward_dynamics_articulated(model, base(t), y.head(8), y.tail(8));
    return out;
  };
  static const double c[] = {0, 0.2, 0.3, 0.8, 8.0 / 9, 1, 1};
  static const double b[7][6] = {{},
                                 {1.0 / 5},
                                 {3.0 / 40, 9.0 / 40},
                                 {44.0 / 45, -56.0 / 15, 32.0 / 9},
                                 {19372.0 / 6561, -25360.0 / 2187, 64448.0 / 6561, -212.0 / 729},
                                 {9017.0 / 3168, -355.0 / 33, 46732.0 / 5247, 49.0 / 176, -5103.0 / 18656},
                                 {35.0 / 384, 0, 500.0 / 1113, 125.0 / 192, -2187.0 / 6784, 11.0 / 84}};
  static const double error_weight[] = {71.0 / 57600,      0,          -71.0 / 16695, 71.0 / 1920,
                                        -17253.0 / 339200, 22.0 / 525, -1.0 / 40};
  constexpr double kTolerance = 1e-10, kEnd = 0.5;
  VectorX y = VectorX::Zero(16);
  double t = 0.0, h = 1e-3;
  while (t < kEnd) {
    h = std::min(h, kEnd - t);
    std::vector<VectorX> k;
    VectorX next;
    for (int i = 0; i < 7; ++i) {
      next = y;
      for (int j = 0; j < i; ++j) next += h * b[i][j] * k[j];
      k.push_back(slope(t + c[i] * h, next));
    }
    VectorX error = VectorX::Zero(16);
    for (int i = 0; i < 7; ++i) error += h * error_weight[i] * k[i];
    const double size = error.cwiseAbs().maxCoeff() / kTolerance;
    if (size <= 1.0) t += h, y = next;
    h *= std::min(3.0, std::max(0.2, 0.9 * std::pow(std::max(size, 1e-10), -0.2)));
  }
  const auto node_error = [&](int substeps) {
    model.parameters.substeps = substeps;
    const VectorX theta = rollout(model, base, {0.0, VectorX::Zero(8), VectorX::Zero(8)}, {kEnd}).theta[0];
    const auto place = [&](const VectorX& q) {
      return chain::nodes(model.chain, chain::link_motions(model.chain, q, {}));
    };
    return (place(theta) - place(y.head(8))).colwise().norm().maxCoeff();
  };
  const double coarse = node_error(4), fine = node_error(16);
  CHECK(coarse < 2e-5);
  CHECK(fine < coarse / 20.0);  // third order: 64
}

TEST_CASE("a diverging step is halved, then RODAS3 takes over, and both are said") {
  Parameters p = rope(8, chain::Bending::planar).parameters;
  const Model soft = rope(8, chain::Bending::planar);
  std::vector<std::string> warnings;
  core::Listener listener;
  listener.warning = [&](const std::string& line) { warnings.push_back(line); };
  core::set_listener(listener);
  p.integrator = Integrator::implicit_velocity_euler;
  p.substeps = 1;
  p.table_normal.reset();
  std::fill(p.stiffness.begin(), p.stiffness.end(), 0.05);  // mathematics.md 4: beyond the Euler step at 30 Hz
  const BaseFunction base = base_of(load("chain_planar_8"));
  const InitialState rest{0.0, VectorX::Zero(8), VectorX::Zero(8)};
  const std::vector<double> times = {0.5, 1.0, 5.0};
  const chain::States halved = rollout(make_model(soft.chain, p), base, rest, times);
  REQUIRE(!warnings.empty());
  CHECK(warnings.back().find("joint") != std::string::npos);
  CHECK(warnings.back().find("RODAS3") == std::string::npos);
  p.substeps = 1 << warnings.size();
  const chain::States direct = rollout(make_model(soft.chain, p), base, rest, times);
  for (int k = 0; k < 3; ++k) CHECK((halved.theta[k] - direct.theta[k]).norm() == 0.0);

  warnings.clear();
  std::fill(p.stiffness.begin(), p.stiffness.end(), 2000.0);  // beyond the Euler step at 960 Hz
  std::fill(p.rest_angle.begin(), p.rest_angle.end(), 0.1);
  p.substeps = 1;
  const chain::States taken = rollout(make_model(soft.chain, p), base, rest, {0.5});
  REQUIRE(!warnings.empty());
  CHECK(warnings.back().find("RODAS3 takes its place") != std::string::npos);
  p.integrator = Integrator::rodas3;
  CHECK((taken.theta[0] - rollout(make_model(soft.chain, p), base, rest, {0.5}).theta[0]).norm() == 0.0);
  core::set_listener({});
}

TEST_CASE("a stepper goes the same way as a rollout") {
  const json file = load("chain_universal_4");
  const Model model = model_of(file);
  const int n = model.chain.angles();
  const BaseFunction base = base_of(file);
  VectorX theta = VectorX::Constant(n, 0.1), thetadot = VectorX::Zero(n);
  const BaseGrid grid = sample_base(base, 0.0, {0.1}, 4);
  const chain::States states = rollout(model, base, {0.0, theta, thetadot}, {0.1});
  Stepper stepper(model);
  CHECK(
      (stepper.acceleration(base(0.0), theta, thetadot) - forward_dynamics(model, base(0.0), theta, thetadot)).norm() ==
      0.0);
  for (std::size_t k = 0; k + 1 < grid.nodes.size(); ++k)
    REQUIRE(stepper.step(grid.nodes[k], grid.nodes[k + 1].motion, theta, thetadot));
  CHECK((theta - states.theta[0]).norm() == 0.0);
}

TEST_CASE("nonsense is refused and divergence is told") {
  const Model model = rope(3, chain::Bending::planar);
  Parameters p = model.parameters;
  p.link_mass[1] = -1.0;
  CHECK_THROWS_AS(make_model(model.chain, p), InputError);
  p.link_mass[1] = 0.0;
  CHECK_THROWS_WITH_AS(make_model(model.chain, p), doctest::Contains("link 2"), InputError);
  p = model.parameters;
  p.stiffness.pop_back();
  CHECK_THROWS_AS(make_model(model.chain, p), InputError);
  const BaseFunction wild = [](double t) {
    trajectory::BaseMotion base;
    base.acceleration[3] = t > 0.1 ? NAN : 0.0;
    return base;
  };
  CHECK_THROWS_AS(rollout(model, wild, {0.0, VectorX::Zero(3), VectorX::Zero(3)}, {0.5}), WorkError);
  const BaseFunction still = [](double) { return trajectory::BaseMotion(); };
  CHECK_THROWS_AS(rollout(model, still, {0.0, VectorX::Zero(3), VectorX::Zero(3)}, {0.5, 0.4}), InputError);
  CHECK_THROWS_AS(rollout(model, still, {0.0, VectorX::Zero(4), VectorX::Zero(4)}, {0.5}), InputError);
  CHECK_THROWS_AS(forward_dynamics(model, at_rest(Pose()), VectorX::Zero(3), VectorX::Zero(2)), InputError);

  // a thread that can twist has no inertia about itself
  const Model twisting = rope(3, chain::Bending::spatial, true);
  p = twisting.parameters;
  p.radius = 0.0;
  const Model thread = make_model(twisting.chain, p);
  const VectorX zero = VectorX::Zero(9);
  CHECK_THROWS_WITH_AS(forward_dynamics(thread, at_rest(Pose()), zero, zero), doctest::Contains("joint"), InputError);
  CHECK_THROWS_WITH_AS(forward_dynamics_articulated(thread, at_rest(Pose()), zero, zero), doctest::Contains("joint"),
                       InputError);
  CHECK_THROWS_WITH_AS(rollout(thread, still, {0.0, zero, zero}, {0.5}), doctest::Contains("joint"), InputError);

  // blown up by negative damping: make_model refuses that, so that it is put in behind its back
  Model excited = rope(3, chain::Bending::planar);
  excited.parameters.damping.assign(3, -0.05);
  CHECK_THROWS_WITH_AS(rollout(excited, still, {0.0, VectorX::Constant(3, 0.1), VectorX::Zero(3)}, {5.0}),
                       doctest::Contains("in joint"), WorkError);
}
