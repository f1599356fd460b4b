#include <doctest/doctest.h>
#include <cmath>

#include "chainsplat/dynamics.h"
#include "src/math/decompositions.h"

using namespace chainsplat;
using namespace chainsplat::dynamics;

namespace {

// A hanging rope of 0.3 m that is clearly braked, three joints.
Model make_rope(chain::Bending bending, double moment, double angle, bool twist = false) {
  const chain::Chain chain = chain::make_chain(0.3, 0.02, -Vector3::UnitZ(), Vector3::UnitY(), 3, bending, twist, 0.0);
  const int n = chain.angles(), links = chain.links() - 1;
  Parameters p;
  p.link_mass = {0.02, 0.021, 0.018}, p.tip_mass = 0.01;
  for (auto* zeros : {&p.viscous_friction, &p.coulomb_friction, &p.air_linear, &p.air_quadratic})
    zeros->assign(links, 0.0);
  p.stiffness.assign(n, 0.012), p.damping.assign(n, 2e-4), p.rest_angle.assign(n, 0.05);
  p.bending_friction.assign(n, moment), p.bending_friction_angle.assign(n, angle);
  p.bending_friction[0] *= 1.3, p.bending_friction_angle[n - 1] *= 1.2;
  p.radius = 0.01;
  return make_model(chain, p);
}

// A base that shakes along x, `size` m/s^2.
trajectory::BaseMotion shaken(double t, double size) {
  constexpr double w = 2.0 * M_PI * 1.5;
  trajectory::BaseMotion base;
  base.pose.translation.x() = size * std::sin(w * t) / (w * w);
  base.velocity[3] = size * std::cos(w * t) / w;
  base.acceleration[3] = -size * std::sin(w * t);
  return base;
}

BaseGrid grid_of(double size, const std::vector<double>& times, int substeps) {
  return sample_base([&](double t) { return shaken(t, size); }, 0.0, times, substeps);
}

std::vector<double> times_to(double end, int count) {
  std::vector<double> out;
  for (int k = 0; k <= count; ++k) out.push_back(end * k / count);
  return out;
}

InitialState start_of(const Model& model) {
  const int n = model.chain.angles();
  InitialState start{0.0, VectorX::Zero(n), VectorX::Zero(n), VectorX::Zero(n)};
  for (int k = 0; k < n; ++k) start.theta[k] = 0.3 - 0.1 * k, start.internal_state[k] = 0.2 * (k % 3) - 0.1;
  return start;
}

}  // namespace

TEST_CASE("friction in bending agrees with an explicit solution of its equations in small steps") {
  for (const auto bending : {chain::Bending::planar, chain::Bending::spatial}) {
    const Model model = make_rope(bending, 0.004, 0.04);
    const Parameters& p = model.parameters;
    const int n = model.chain.angles(), axes = n / 3;
    const InitialState start = start_of(model);
    // y = (theta, theta', z), by Runge and Kutta's method; the equations again, from the page of mathematics
    const auto slope = [&](double t, const VectorX& y) {
      const VectorX theta = y.head(n), rate = y.segment(n, n), z = y.tail(n);
      VectorX moment(n), z_rate(n);
      for (int joint = 0; joint < 3; ++joint) {
        const VectorX turning = rate.segment(joint * axes, axes);
        const double speed =
            std::sqrt(turning.squaredNorm() + std::pow(kBendingFrictionRate, 2)) - kBendingFrictionRate;
        for (int k = joint * axes; k < (joint + 1) * axes; ++k) {
          moment[k] = p.bending_friction[k] * z[k];
          z_rate[k] = (rate[k] - z[k] * speed) / p.bending_friction_angle[k];
        }
      }
      VectorX out(3 * n);
      out << rate, forward_dynamics(model, shaken(t, 4.0), theta, rate) - mass_matrix(model, theta).llt().solve(moment),
          z_rate;
      return out;
    };
    VectorX y(3 * n);
    y << start.theta, start.thetadot, start.internal_state;
    constexpr double kEnd = 0.8, kStep = 2e-4;
    for (int k = 0; k < std::lround(kEnd / kStep); ++k) {
      const double t = k * kStep;
      const VectorX a = slope(t, y), b = slope(t + 0.5 * kStep, y + 0.5 * kStep * a),
                    c = slope(t + 0.5 * kStep, y + 0.5 * kStep * b), d = slope(t + kStep, y + kStep * c);
      y += kStep / 6.0 * (a + 2.0 * b + 2.0 * c + d);
    }
    chain::States states;
    const auto off = [&](int substeps) {
      REQUIRE(simulate(model, grid_of(4.0, {kEnd}, substeps), start, states));
      return (states.theta[0] - y.head(n)).cwiseAbs().maxCoeff();
    };
    const double coarse = off(4), fine = off(64);
    CHECK(coarse < 6e-3);  // rad, over a motion of 0.5 rad; corners where joints turn back
    CHECK(fine < 3e-4);
    CHECK((states.internal_state[0] - y.tail(n)).cwiseAbs().maxCoeff() < 5e-3);
    // and without friction the rope is elsewhere
    Model smooth = model;
    smooth.parameters.bending_friction.clear(), smooth.parameters.bending_friction_angle.clear();
    REQUIRE(simulate(smooth, grid_of(4.0, {kEnd}, 64), {0.0, start.theta, start.thetadot}, states));
    CHECK((states.theta[0] - y.head(n)).cwiseAbs().maxCoeff() > 0.05);
    CHECK(states.internal_state.empty());
  }
}

TEST_CASE("friction of no moment changes no bit") {
  for (const auto bending : {chain::Bending::planar, chain::Bending::spatial}) {
    Model none = make_rope(bending, 0.0, 0.04), without = none;
    without.parameters.bending_friction.clear(), without.parameters.bending_friction_angle.clear();
    const InitialState start = start_of(none);
    const BaseGrid grid = grid_of(3.0, times_to(1.0, 10), 4);
    chain::States a, b;
    REQUIRE(simulate(none, grid, start, a));
    REQUIRE(simulate(without, grid, start.theta, start.thetadot, b));
    for (std::size_t k = 0; k < a.theta.size(); ++k) CHECK((a.theta[k] - b.theta[k]).norm() == 0.0);
    CHECK(a.internal_state.empty());
  }
}

TEST_CASE("a bend that is given builds the moment up and turns it round") {
  const Model model = make_rope(chain::Bending::planar, 0.004, 0.05);
  const double angle = model.parameters.bending_friction_angle[0];
  const auto bent = [](double to) { return VectorX::Constant(3, to).eval(); };
  const auto z = internal_states(model, {bent(0.0), bent(0.03), bent(0.3), bent(0.28), bent(-0.3)});
  CHECK(z[1][0] == doctest::Approx(1.0 - std::exp(-0.03 / angle)));
  CHECK(z[2][0] == doctest::Approx(1.0 - std::exp(-0.3 / angle)));
  CHECK(z[3][0] == doctest::Approx(-1.0 + (z[2][0] + 1.0) * std::exp(-0.02 / angle)));
  CHECK(z[4][0] == doctest::Approx(-1.0).epsilon(1e-4));
  // in two directions the moment is never more than that of slipping, and points against the motion
  const Model spatial = make_rope(chain::Bending::spatial, 0.004, 0.05, true);
  VectorX from = VectorX::Zero(9), to = from;
  to[0] = 0.3, to[1] = 0.4, to[2] = 0.7;
  const VectorX in_two = internal_states(spatial, {from, to}).back();
  CHECK(in_two[0] == doctest::Approx(0.6).epsilon(1e-3));
  CHECK(in_two[1] == doctest::Approx(0.8).epsilon(1e-3));
  CHECK(in_two[2] == 0.0);  // twists
  CHECK(internal_states(make_rope(chain::Bending::planar, 0.0, 0.05), {bent(0.0)}).empty());
  CHECK(internal_state_in_motion(make_rope(chain::Bending::planar, 0.0, 0.05), bent(0.0), bent(0.1)).size() == 0);
}

TEST_CASE("derivatives of a rollout with friction in bending agree with differences") {
  const auto times = times_to(0.5, 5);
  for (const auto bending : {chain::Bending::planar, chain::Bending::spatial}) {
    const Model model = make_rope(bending, 0.004, 0.06);
    const int n = model.chain.angles();
    const InitialState start = start_of(model);
    // first order where a joint turns back: many steps for a close comparison
    const BaseGrid grid = grid_of(4.0, times, 512);
    std::vector<Tangent> unknowns(6);
    unknowns[0].bending_friction = model.parameters.bending_friction;
    unknowns[1].bending_friction_angle = model.parameters.bending_friction_angle;
    unknowns[2].internal_state = VectorX::Unit(n, 1);
    unknowns[3].theta = VectorX::Unit(n, 0);
    unknowns[4].thetadot = VectorX::Unit(n, n - 1);
    unknowns[5].stiffness = model.parameters.stiffness;
    chain::States states;
    Sensitivities slopes;
    REQUIRE(simulate(model, grid, start, states, unknowns, &slopes));
    for (std::size_t i = 0; i < unknowns.size(); ++i) {
      const auto moved = [&](double by) {
        Parameters p = model.parameters;
        const auto add = [&](std::vector<double>& to, const std::vector<double>& d) {
          for (std::size_t k = 0; k < d.size(); ++k) to[k] += by * d[k];
        };
        add(p.bending_friction, unknowns[i].bending_friction);
        add(p.bending_friction_angle, unknowns[i].bending_friction_angle);
        add(p.stiffness, unknowns[i].stiffness);
        InitialState from = start;
        if (unknowns[i].theta.size()) from.theta += by * unknowns[i].theta;
        if (unknowns[i].thetadot.size()) from.thetadot += by * unknowns[i].thetadot;
        if (unknowns[i].internal_state.size()) from.internal_state += by * unknowns[i].internal_state;
        chain::States out;
        REQUIRE(simulate(make_model(model.chain, p), grid, from, out));
        return out;
      };
      constexpr double kStep = 1e-4;
      const chain::States up = moved(kStep), down = moved(-kStep);
      double error = 0.0, size = 0.0;
      for (std::size_t k = 1; k < times.size(); ++k) {
        const VectorX difference = (up.theta[k] - down.theta[k]) / (2.0 * kStep);
        error = std::max(error, (slopes.theta[k].col(static_cast<Eigen::Index>(i)) - difference).cwiseAbs().maxCoeff());
        size = std::max(size, difference.cwiseAbs().maxCoeff());
      }
      CAPTURE(i);
      CHECK(size > 0.0);
      CHECK(error < 0.01 * size);
    }
  }
}

TEST_CASE("derivatives of the discrete map by the base's motion hold with friction in bending") {
  const Model model = make_rope(chain::Bending::spatial, 0.004, 0.06);
  const InitialState start = start_of(model);
  constexpr double kSize = 4.0;
  const auto times = times_to(0.4, 12);
  const auto grid = [&](double size) {
    BaseGrid out = grid_of(size, times, 4);
    for (BaseGrid::Node& node : out.nodes) {  // exact, as planned motions have it
      constexpr double w = 2.0 * M_PI * 1.5;
      node.jerk = Vector6::Zero();
      node.jerk[3] = -size * w * std::cos(w * node.time);
    }
    return out;
  };
  const BaseGrid nodes = grid(kSize);
  BaseUnknowns by;
  by.count = 1;
  by.motion = [&](std::size_t node, double after) { return shaken(nodes.nodes[node].time + after, kSize); };
  by.torques = [&](std::size_t node, double after, const BaseSlopes& slopes, MatrixX& torques) {
    const trajectory::BaseMotion unit = shaken(nodes.nodes[node].time + after, 1.0);
    torques = slopes.acceleration * unit.acceleration + slopes.velocity * unit.velocity;
  };
  chain::States states;
  Sensitivities slopes;
  REQUIRE(simulate(model, nodes, start, states, by, true, slopes));
  constexpr double kStep = 1e-4;
  chain::States up, down;
  REQUIRE(simulate(model, grid(kSize + kStep), start, up));
  REQUIRE(simulate(model, grid(kSize - kStep), start, down));
  double error = 0.0, size = 0.0;
  for (std::size_t k = 0; k < times.size(); ++k) {
    const VectorX difference = (up.theta[k] - down.theta[k]) / (2.0 * kStep);
    error = std::max(error, (slopes.theta[k].col(0) - difference).cwiseAbs().maxCoeff());
    size = std::max(size, difference.cwiseAbs().maxCoeff());
  }
  CHECK(size > 1e-2);
  CHECK(error < 1e-5 * size);
}

TEST_CASE("a stepper carries the friction state along, and bad friction is refused") {
  const Model model = make_rope(chain::Bending::planar, 0.004, 0.04);
  const InitialState start = start_of(model);
  const BaseGrid grid = grid_of(4.0, {0.2}, 4);
  chain::States states;
  REQUIRE(simulate(model, grid, start, states));
  Stepper stepper(model);
  VectorX theta = start.theta, thetadot = start.thetadot, z = start.internal_state;
  for (std::size_t k = 0; k + 1 < grid.nodes.size(); ++k)
    REQUIRE(stepper.step(grid.nodes[k], grid.nodes[k + 1].motion, theta, thetadot, &z));
  CHECK((theta - states.theta[0]).norm() == 0.0);
  CHECK((z - states.internal_state[0]).norm() == 0.0);
  const auto refused = [&](const auto& change) {
    Parameters p = model.parameters;
    change(p);
    CHECK_THROWS_AS(make_model(model.chain, p), InputError);
  };
  refused([](Parameters& p) { p.bending_friction[1] = -1.0; });
  refused([](Parameters& p) { p.bending_friction_angle[1] = 0.0; });
  refused([](Parameters& p) { p.bending_friction_angle.clear(); });
  refused([](Parameters& p) { p.integrator = Integrator::implicit_velocity_euler; });
}
