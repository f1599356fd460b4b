#include <doctest/doctest.h>
#include <Eigen/Geometry>
#include <cmath>

#include "chainsplat/dynamics.h"

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
