#include <doctest/doctest.h>
#include <Eigen/Geometry>
#include <cmath>

#include "chainsplat/dynamics.h"
#include "src/math/decompositions.h"

using namespace chainsplat;
using namespace chainsplat::dynamics;

namespace {

constexpr int kJoints = 4;

// A hanging rope that is naturally bent out of every plane; weightless where only its elasticity counts.
Model make_rope(double bend, bool heavy) {
  const chain::Chain chain =
      chain::make_chain(0.3, 0.02, -Vector3::UnitZ(), Vector3::UnitY(), kJoints, chain::Bending::spatial, false, 0.0);
  Parameters p;
  p.link_mass.assign(kJoints, 0.015);
  for (auto* zeros : {&p.viscous_friction, &p.coulomb_friction, &p.air_linear, &p.air_quadratic})
    zeros->assign(kJoints, 0.0);
  for (int k = 0; k < 2 * kJoints; ++k) {
    p.stiffness.push_back(0.012 * (1.0 + 0.1 * (k % 3)));
    p.damping.push_back(4e-4);
    p.rest_angle.push_back(bend * std::sin(1.3 * k + 0.4));
  }
  for (int j = 0; j < kJoints; ++j) p.torsional_stiffness.push_back(0.009 * (1.0 + 0.2 * j));
  p.radius = 0.01;
  if (!heavy) p.gravity.setZero();
  return make_model(chain, p);
}

VectorX shape() {
  VectorX theta(2 * kJoints);
  for (Eigen::Index k = 0; k < theta.size(); ++k) theta[k] = 0.6 * std::cos(0.9 * k - 0.3);
  return theta;
}

// The energy of 3.11 for given rolls, the twist of every joint taken from its material's rotation as a quaternion.
double energy_of(const Model& model, const VectorX& theta, const VectorX& roll) {
  const Parameters& p = model.parameters;
  const Vector3 d = model.chain.direction, a = model.chain.bending_axis, b = d.cross(a);
  const auto turn = [](double angle, const Vector3& axis) {
    return Eigen::Quaterniond(Eigen::AngleAxisd(angle, axis));
  };
  double energy = 0.0;
  for (int j = 0; j < kJoints; ++j) {
    const double before = j > 0 ? roll[j - 1] : 0.0, after = roll[j];
    const Eigen::Quaterniond q = turn(-before, d) * turn(theta[2 * j], a) * turn(theta[2 * j + 1], b) * turn(after, d);
    const double twist = 2.0 * std::atan2(q.vec().dot(d), q.w());
    const Vector3 rest =
        turn(0.5 * (before + after), d) * Vector3(p.rest_angle[2 * j] * a + p.rest_angle[2 * j + 1] * b);
    const Vector3 off = theta[2 * j] * a + theta[2 * j + 1] * b - rest;
    energy += 0.5 * p.stiffness[2 * j] * std::pow(off.dot(a), 2) +
              0.5 * p.stiffness[2 * j + 1] * std::pow(off.dot(b), 2) + 0.5 * p.torsional_stiffness[j] * twist * twist;
  }
  return energy;
}

// Its least value, roll by roll in turn, by parabolas through three points.
double least_energy(const Model& model, const VectorX& theta) {
  VectorX roll = VectorX::Zero(kJoints);
  constexpr double kStep = 1e-3;
  for (int round = 0; round < 2000; ++round)
    for (int j = 0; j < kJoints; ++j) {
      const auto at = [&](double by) {
        VectorX moved = roll;
        moved[j] += by;
        return energy_of(model, theta, moved);
      };
      const double low = at(-kStep), middle = at(0.0), high = at(kStep);
      roll[j] -= 0.5 * kStep * (high - low) / (high - 2.0 * middle + low);
    }
  return energy_of(model, theta, roll);
}

}  // namespace

TEST_CASE("the rope's rolls are those of least energy") {
  const Model model = make_rope(0.3, false);
  const VectorX theta = shape();
  const double least = least_energy(model, theta);
  CHECK(potential_energy(model, {}, theta) == doctest::Approx(least).epsilon(1e-8));
  // the twist matters: rolls of zero, and of the rope's links, have clearly more
  CHECK(energy_of(model, theta, VectorX::Zero(kJoints)) > 1.05 * least);
  Model stiff = model;
  stiff.parameters.torsional_stiffness.clear();
  CHECK(std::abs(potential_energy(stiff, {}, theta) / least - 1.0) > 0.02);
}

TEST_CASE("a rope that is naturally straight is not twisted") {
  const Model twisting = make_rope(0.0, true);
  Model plain = twisting;
  plain.parameters.torsional_stiffness.clear();
  const VectorX theta = shape(), rate = 0.5 * theta;
  const VectorX a = forward_dynamics(twisting, at_rest({}), theta, rate),
                b = forward_dynamics(plain, at_rest({}), theta, rate);
  CHECK((a - b).norm() < 1e-9 * b.norm());
}

TEST_CASE("torque, stiffness and derivatives by parameters follow from the energy") {
  const Model model = make_rope(0.3, false);
  const VectorX theta = shape(), still = VectorX::Zero(2 * kJoints);
  constexpr double kStep = 1e-5;
  const auto by_angle = [&](Eigen::Index k, double by) { return VectorX(theta + by * VectorX::Unit(theta.size(), k)); };
  const VectorX torque = joint_law(model, theta, still);
  const MatrixX stiffness = linearize(model, at_rest({}), Vector6::Zero(), theta, still).stiffness;
  for (Eigen::Index k = 0; k < theta.size(); ++k) {
    const double up = potential_energy(model, {}, by_angle(k, kStep)),
                 down = potential_energy(model, {}, by_angle(k, -kStep));
    CHECK(torque[k] == doctest::Approx(-(up - down) / (2.0 * kStep)).epsilon(1e-6));
  }
  // d tau_ID / d theta + K: of the accelerations that the torque causes
  const VectorX acceleration = forward_dynamics(model, at_rest({}), theta, still);
  double error = 0.0;
  for (Eigen::Index k = 0; k < theta.size(); ++k) {
    const auto balance = [&](double by) {
      const VectorX moved = by_angle(k, by);
      return VectorX(inverse_dynamics(model, at_rest({}), moved, still, acceleration) - joint_law(model, moved, still));
    };
    error =
        std::max(error, (stiffness.col(k) - (balance(kStep) - balance(-kStep)) / (2.0 * kStep)).cwiseAbs().maxCoeff());
  }
  CHECK(error < 1e-7 * stiffness.cwiseAbs().maxCoeff());
  // by parameters, at fixed acceleration
  for (int kind = 0; kind < 3; ++kind)
    for (int element : {0, 2, 3}) {
      Tangent unknown;
      const auto array = [&](auto& of) -> std::vector<double>& {
        return kind == 0 ? of.stiffness : kind == 1 ? of.rest_angle : of.torsional_stiffness;
      };
      array(unknown).assign(kind == 2 ? kJoints : 2 * kJoints, 0.0);
      array(unknown)[element] = 0.01;
      const auto moved = [&](double by) {
        Parameters p = model.parameters;
        array(p)[element] += by * 0.01;
        return joint_law(make_model(model.chain, p), theta, still);
      };
      const VectorX difference = (moved(1e-3) - moved(-1e-3)) / 2e-3;
      const VectorX found = unknown_forces(model, at_rest({}), theta, still, {&unknown, 1}).col(0);
      CAPTURE(kind);
      CHECK(difference.norm() > 1e-9);
      CHECK((found - difference).norm() < 1e-5 * difference.norm());
    }
}

namespace {

// The dampers' part of 3.11 by the joints' rates, for rolls that turn at `turning`: half of what they take, W.
double dissipation_of(const Model& model, const VectorX& theta, const VectorX& thetadot, const VectorX& turning) {
  const Parameters& p = model.parameters;
  double half = 0.0;
  for (int j = 0; j < kJoints; ++j) {
    const double before = j > 0 ? turning[j - 1] : 0.0, after = turning[j], chi = 0.5 * (before + after);
    const auto twist = [&](double time) {
      return 2.0 * std::atan(std::tan(0.5 * (theta[2 * j] + time * thetadot[2 * j])) *
                             std::tan(0.5 * (theta[2 * j + 1] + time * thetadot[2 * j + 1])));
    };
    const double twisting = after - before + (twist(1e-6) - twist(-1e-6)) / 2e-6;
    const double retardation =
        (p.damping[2 * j] + p.damping[2 * j + 1]) / (p.stiffness[2 * j] + p.stiffness[2 * j + 1]);
    half += 0.5 * p.damping[2 * j] * std::pow(thetadot[2 * j] + chi * theta[2 * j + 1], 2) +
            0.5 * p.damping[2 * j + 1] * std::pow(thetadot[2 * j + 1] - chi * theta[2 * j], 2) +
            0.5 * p.torsional_stiffness[j] * retardation * twisting * twisting;
  }
  return half;
}

template <class F>
VectorX slope_of(const F& f, const VectorX& at, double step) {
  VectorX slope(at.size());
  for (Eigen::Index k = 0; k < at.size(); ++k) {
    const VectorX unit = step * VectorX::Unit(at.size(), k);
    slope[k] = (f(VectorX(at + unit)) - f(VectorX(at - unit))) / (2.0 * step);
  }
  return slope;
}

// Accelerations and turning of the rolls from energy and dissipation alone, by differences.
void explicit_law(const Model& model, const trajectory::BaseMotion& base, const VectorX& theta, const VectorX& thetadot,
                  const VectorX& roll, VectorX& acceleration, VectorX& turning) {
  const VectorX pull = slope_of([&](const VectorX& r) { return energy_of(model, theta, r); }, roll, 1e-5);
  const VectorX none = VectorX::Zero(kJoints);
  const auto brake = [&](const VectorX& t) {
    return slope_of([&](const VectorX& r) { return dissipation_of(model, theta, thetadot, r); }, t, 1e-2);
  };
  // the dissipation is quadratic in the turning, so that its slope is linear
  const VectorX offset = brake(none);
  MatrixX dampers(kJoints, kJoints);
  for (int j = 0; j < kJoints; ++j) dampers.col(j) = brake(VectorX::Unit(kJoints, j)) - offset;
  turning = -dampers.lu().solve(pull + offset);
  const VectorX torque =
      -slope_of([&](const VectorX& t) { return energy_of(model, t, roll); }, theta, 1e-5) -
      slope_of([&](const VectorX& t) { return dissipation_of(model, theta, t, turning); }, thetadot, 1e-2);
  const VectorX rest = VectorX::Zero(theta.size());
  acceleration = mass_matrix(model, theta).ldlt().solve(torque - inverse_dynamics(model, base, theta, thetadot, rest));
}

trajectory::BaseMotion shaken(double time) {  // across the bend, at 2 Hz
  trajectory::BaseMotion base;
  const double w = 4.0 * 3.14159265358979, a = 0.02;
  base.pose.translation = Vector3(a * std::sin(w * time), 0.5 * a * (1.0 - std::cos(w * time)), 0.0);
  base.velocity.tail<3>() = Vector3(a * w * std::cos(w * time), 0.5 * a * w * std::sin(w * time), 0.0);
  base.acceleration.tail<3>() = Vector3(-a * w * w * std::sin(w * time), 0.5 * a * w * w * std::cos(w * time), 0.0);
  return base;
}

std::vector<double> times_of(int count, double interval) {
  std::vector<double> times;
  for (int k = 0; k <= count; ++k) times.push_back(k * interval);
  return times;
}

}  // namespace

TEST_CASE("a shaken rope moves and rolls as its energy and its dampers say") {
  Model model = make_rope(0.5, true);
  const auto times = times_of(6, 0.05);
  InitialState start{0.0, shape(), 0.3 * shape()};
  chain::States states;
  REQUIRE(simulate(model, sample_base(shaken, 0.0, times, 64), start, states));
  REQUIRE(states.internal_state.size() == times.size());

  // the classical Runge-Kutta method in steps of 0.1 ms
  VectorX theta = start.theta, rate = start.thetadot, roll = states.internal_state[0];
  // they begin at rest: the energy is least
  CHECK(slope_of([&](const VectorX& r) { return energy_of(model, theta, r); }, roll, 1e-5).norm() < 1e-8);
  constexpr double kStep = 1e-4;
  const int steps = static_cast<int>(std::lround(times.back() / kStep));
  for (int i = 0; i < steps; ++i) {
    const double t = i * kStep;
    VectorX a[4], v[4], w[4];
    for (int s = 0; s < 4; ++s) {
      const double by = s == 0 ? 0.0 : s == 3 ? kStep : 0.5 * kStep;
      const VectorX at = s == 0 ? theta : VectorX(theta + by * v[s - 1]);
      v[s] = s == 0 ? rate : VectorX(rate + by * a[s - 1]);
      const VectorX r = s == 0 ? roll : VectorX(roll + by * w[s - 1]);
      explicit_law(model, shaken(t + by), at, v[s], r, a[s], w[s]);
    }
    theta += kStep / 6.0 * (v[0] + 2.0 * v[1] + 2.0 * v[2] + v[3]);
    rate += kStep / 6.0 * (a[0] + 2.0 * a[1] + 2.0 * a[2] + a[3]);
    roll += kStep / 6.0 * (w[0] + 2.0 * w[1] + 2.0 * w[2] + w[3]);
  }
  CHECK((states.theta.back() - theta).norm() < 1e-4 * theta.norm());
  CHECK((states.thetadot.back() - rate).norm() < 1e-4 * rate.norm());
  CHECK((states.internal_state.back() - roll).norm() < 1e-4 * roll.norm());
  // and what rolls without dampers, or not at all, ends elsewhere
  for (double& d : model.parameters.damping) d *= 0.3;
  chain::States other;
  REQUIRE(simulate(make_model(model.chain, model.parameters), sample_base(shaken, 0.0, times, 64), start, other));
  CHECK((other.internal_state.back() - roll).norm() > 0.02 * roll.norm());
}

TEST_CASE("derivatives of a rollout take the rolls along") {
  Model model = make_rope(0.5, true);
  for (const bool slips : {false, true}) {
    CAPTURE(slips);
    if (slips) {
      model.parameters.bending_friction.assign(2 * kJoints, 1e-3);
      model.parameters.bending_friction_angle.assign(2 * kJoints, 0.1);
    }
    const int n = 2 * kJoints;
    std::vector<Tangent> unknowns(6);
    unknowns[0].torsional_stiffness.assign(kJoints, 0.01);
    unknowns[1].stiffness.assign(n, 0.01);
    unknowns[2].damping.assign(n, 5e-4);
    unknowns[3].rest_angle.assign(n, 0.0), unknowns[3].rest_angle[3] = 0.2;
    unknowns[4].theta = VectorX::Unit(n, 2);
    unknowns[5].thetadot = VectorX::Unit(n, 1);
    const auto times = times_of(5, 0.06);
    const BaseGrid grid = sample_base(shaken, 0.0, times, 64);
    const InitialState start{0.0, shape(), 0.3 * shape()};
    chain::States states;
    Sensitivities found;
    REQUIRE(simulate(model, grid, start, states, unknowns, &found));
    for (std::size_t i = 0; i < unknowns.size(); ++i) {
      CAPTURE(i);
      const auto moved = [&](double by) {
        Parameters p = model.parameters;
        const auto add = [&](std::vector<double>& to, const std::vector<double>& what) {
          for (std::size_t k = 0; k < what.size(); ++k) to[k] += by * what[k];
        };
        add(p.torsional_stiffness, unknowns[i].torsional_stiffness), add(p.stiffness, unknowns[i].stiffness);
        add(p.damping, unknowns[i].damping), add(p.rest_angle, unknowns[i].rest_angle);
        InitialState from = start;
        if (unknowns[i].theta.size()) from.theta += by * unknowns[i].theta;
        if (unknowns[i].thetadot.size()) from.thetadot += by * unknowns[i].thetadot;
        chain::States out;
        REQUIRE(simulate(make_model(model.chain, p), grid, from, out));
        return out;
      };
      constexpr double kBy = 1e-4;
      const chain::States up = moved(kBy), down = moved(-kBy);
      for (const std::size_t k : {std::size_t{1}, times.size() - 1}) {
        const VectorX angle = (up.theta[k] - down.theta[k]) / (2.0 * kBy),
                      rate = (up.thetadot[k] - down.thetadot[k]) / (2.0 * kBy);
        CHECK((found.theta[k].col(static_cast<Eigen::Index>(i)) - angle).norm() < 2e-3 * angle.norm());
        CHECK((found.thetadot[k].col(static_cast<Eigen::Index>(i)) - rate).norm() < 4e-3 * rate.norm());
      }
    }
    // by the base's motion, exactly: one unknown that moves the base along x
    BaseUnknowns base;
    base.count = 1;
    Sensitivities exact;
    chain::States again;
    const BaseGrid coarse = sample_base(shaken, 0.0, times, 4);
    const auto base_of = [&](double by) {
      return [&, by](double t) {
        trajectory::BaseMotion motion = shaken(t);
        const double w = 9.0;
        motion.pose.translation.x() += by * (1.0 - std::cos(w * t));
        motion.velocity[3] += by * w * std::sin(w * t);
        motion.acceleration[3] += by * w * w * std::cos(w * t);
        return motion;
      };
    };
    base.motion = [&](std::size_t node, double after) { return shaken(coarse.nodes[node].time + after); };
    base.torques = [&](std::size_t node, double after, const BaseSlopes& slopes, MatrixX& torques) {
      const double w = 9.0, t = coarse.nodes[node].time + after;
      torques = w * w * std::cos(w * t) * slopes.acceleration.col(3) + w * std::sin(w * t) * slopes.velocity.col(3);
    };
    REQUIRE(simulate(model, coarse, start, again, base, true, exact));
    chain::States up, down;
    constexpr double kBy = 1e-5;
    REQUIRE(simulate(model, sample_base(base_of(kBy), 0.0, times, 4), start, up));
    REQUIRE(simulate(model, sample_base(base_of(-kBy), 0.0, times, 4), start, down));
    const VectorX angle = (up.theta.back() - down.theta.back()) / (2.0 * kBy);
    CHECK((exact.theta.back().col(0) - angle).norm() < 1e-4 * angle.norm());
  }
}

TEST_CASE("a motion step by step is the motion at once, rolls included") {
  const Model model = make_rope(0.5, true);
  const auto times = times_of(10, 1.0 / 30.0);
  const BaseGrid grid = sample_base(shaken, 0.0, times, 4);
  const InitialState start{0.0, shape(), 0.3 * shape()};
  chain::States states;
  REQUIRE(simulate(model, grid, start, states));
  Stepper stepper(model);
  VectorX theta = start.theta, rate = start.thetadot, internal;
  for (std::size_t node = 0; node + 1 < grid.nodes.size(); ++node)
    REQUIRE(stepper.step(grid.nodes[node], grid.nodes[node + 1].motion, theta, rate, &internal));
  CHECK((theta - states.theta.back()).norm() == 0.0);
  CHECK((internal - states.internal_state.back()).norm() == 0.0);
}

TEST_CASE("torsion is refused where it has no meaning") {
  Model model = make_rope(0.3, true);
  Parameters p = model.parameters;
  p.torsional_stiffness[1] = 0.0;
  CHECK_THROWS_AS(make_model(model.chain, p), InputError);
  p = model.parameters, p.torsional_stiffness.pop_back();
  CHECK_THROWS_AS(make_model(model.chain, p), InputError);
  const chain::Chain planar = chain::make_chain(0.3, 0.02, -Vector3::UnitZ(), Vector3::UnitY(), 2 * kJoints,
                                                chain::Bending::planar, false, 0.0);
  p = model.parameters, p.torsional_stiffness.assign(2 * kJoints, 0.01);
  for (auto* of : {&p.link_mass, &p.viscous_friction, &p.coulomb_friction, &p.air_linear, &p.air_quadratic})
    of->assign(2 * kJoints, of->front());
  CHECK_THROWS_AS(make_model(planar, p), InputError);
}
