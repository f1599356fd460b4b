#include <doctest/doctest.h>
#include <cmath>

#include "chainsplat/dynamics/base_wrench.h"

using namespace chainsplat;
using namespace chainsplat::dynamics;

namespace {

constexpr int kJoints = 4;
constexpr double kLength = 0.4, kMass = 0.08, kTip = 0.03;  // m, kg

// Thin links (no inertia about themselves), so that mass points stand for them exactly.
Model make_rope(bool table) {
  const Vector3 direction = table ? Vector3::UnitX() : Vector3(-Vector3::UnitZ());
  const chain::Chain chain =
      chain::make_chain(kLength, 0.01, direction, table ? Vector3::UnitZ() : Vector3::UnitY(), kJoints,
                        table ? chain::Bending::planar : chain::Bending::spatial, false, 0.0);
  Parameters p;
  p.link_mass.assign(kJoints, kMass / kJoints);
  for (auto* zeros : {&p.viscous_friction, &p.coulomb_friction, &p.air_linear, &p.air_quadratic})
    zeros->assign(kJoints, 0.0);
  const std::size_t n = chain.angles();
  p.stiffness.assign(n, 0.02), p.rest_angle.assign(n, 0.05), p.damping.assign(n, 5e-4);
  if (table) {
    p.table_normal = Vector3::UnitZ();
    p.rest_angle.assign(n, 0.0);
    p.coulomb_friction.assign(kJoints, 0.3), p.viscous_friction.assign(kJoints, 0.2);
  } else {
    p.tip_mass = kTip;
  }
  p.integrator = Integrator::rodas3;
  p.substeps = 8;
  return make_model(chain, p);
}

struct MassPoint {
  double mass;
  Vector3 place;
};
// A thin rod has the mass, center and moments of inertia of two halves at its Gauss points.
std::vector<MassPoint> mass_points(const Model& model, const math::Pose& base, const VectorX& theta) {
  const std::vector<math::Pose> motions = chain::link_motions(model.chain, theta, base);
  std::vector<double> at;
  const double link = kLength / kJoints;
  for (int j = 0; j < kJoints; ++j)
    for (const double sign : {-1.0, 1.0}) at.push_back(link * (j + 0.5 + sign * 0.5 / std::sqrt(3.0)));
  at.push_back(kLength);
  const MatrixX places = chain::centerline(model.chain, motions, at);
  std::vector<MassPoint> out;
  for (std::size_t i = 0; i < at.size(); ++i)
    out.push_back({i + 1 < at.size() ? 0.5 * kMass / kJoints : kTip, places.col(static_cast<Eigen::Index>(i))});
  return out;
}

}  // namespace

TEST_CASE("the gripper's wrench is what the mass points of a rollout need") {
  const Model model = make_rope(false);
  constexpr double kRate = 1000.0;
  std::vector<trajectory::Sample> samples;
  for (int i = 0; i <= 240; ++i) {
    const double t = i / 120.0;
    samples.push_back({t,
                       {Eigen::AngleAxisd(0.5 * std::sin(4.0 * t), Vector3(1, 2, 2) / 3.0).toRotationMatrix(),
                        Vector3(0.1 * std::sin(5.0 * t), 0.05 * std::cos(4.0 * t), 0.5 + 0.03 * std::sin(6.0 * t))}});
  }
  const trajectory::Trajectory base = trajectory::fit(samples, "base");
  std::vector<double> times;
  for (int i = 0; i <= 1500; ++i) times.push_back(0.2 + i / kRate);
  const VectorX rest = VectorX::Constant(model.chain.angles(), 0.1);
  const chain::States states = rollout(model, base, {times.front(), rest, VectorX::Zero(rest.size())}, times);
  const std::vector<Vector6> wrenches = base_wrenches(model, base, states);
  REQUIRE(wrenches.size() == times.size());

  double worst = 0.0, largest = 0.0;
  for (std::size_t i = 100; i + 1 < times.size(); i += 100) {
    std::vector<MassPoint> points[3];
    for (std::size_t k = 0; k < 3; ++k)
      points[k] = mass_points(model, base.pose(times[i + k - 1]), states.theta[i + k - 1]);
    Vector6 wrench = Vector6::Zero();
    for (std::size_t p = 0; p < points[0].size(); ++p) {
      const Vector3 acceleration = (points[0][p].place - 2.0 * points[1][p].place + points[2][p].place) * kRate * kRate;
      const Vector3 force = points[1][p].mass * (acceleration - model.parameters.gravity);
      wrench.head<3>() += (points[1][p].place - base.pose(times[i]).translation).cross(force);
      wrench.tail<3>() += force;
    }
    worst = std::max(worst, (wrench - wrenches[i]).norm());
    largest = std::max(largest, wrench.norm());
  }
  CHECK(largest > 1.1 * 9.81 * (kMass + kTip));  // it moves
  CHECK(worst < 2e-3 * largest);                 // of second differences
}

TEST_CASE("a rope at rest hangs by its weight") {
  const Model model = make_rope(false);
  const math::Pose pose{Matrix3::Identity(), Vector3(0.3, -0.2, 1.0)};
  const VectorX theta = static_equilibrium(model, pose).theta;
  const Vector6 wrench = base_wrench(model, at_rest(pose), theta, VectorX::Zero(theta.size()));
  Vector6 expected = Vector6::Zero();
  for (const MassPoint& point : mass_points(model, pose, theta)) {
    const Vector3 force = -point.mass * model.parameters.gravity;
    expected.head<3>() += (point.place - pose.translation).cross(force);
    expected.tail<3>() += force;
  }
  CHECK((wrench - expected).norm() < 1e-6);
  CHECK(wrench.tail<3>().z() == doctest::Approx(9.81 * (kMass + kTip)));
}

TEST_CASE("a rope dragged along a table resists by its friction alone") {
  const Model model = make_rope(true);
  trajectory::BaseMotion base;
  base.velocity.tail<3>() = Vector3(-0.3, 0.0, 0.0);  // the rope follows in a straight line
  const VectorX straight = VectorX::Zero(model.chain.angles());
  const Vector6 wrench = base_wrench(model, base, straight, straight);
  CHECK(wrench[3] == doctest::Approx(-(0.3 * kMass * 9.81 + 0.2 * kJoints * 0.3)).epsilon(1e-4));
  Vector6 rest = wrench;
  rest[3] = 0.0;
  CHECK(rest.norm() < 1e-12);
}

TEST_CASE("states of the wrong size are refused") {
  const Model model = make_rope(false);
  CHECK_THROWS_AS(base_wrench(model, {}, VectorX::Zero(3), VectorX::Zero(3)), InputError);
}
