#include "chainsplat/planning.h"

#include <cmath>
#include <doctest/doctest.h>

#include "planning/sensitivities.h"

using namespace chainsplat;
using namespace chainsplat::planning;

namespace {

// A 30 cm rope of 60 g like those of the captures: stiff enough to swing, damped, with drag or friction.
dynamics::Model rope(chain::Bending bending, bool tabletop, int joints = 8, double factor = 1.0) {
  const Vector3 direction = tabletop ? Vector3(0, 1, 0) : Vector3(0, 0, -1);
  const Vector3 axis = tabletop ? Vector3(0, 0, 1) : Vector3(0, 1, 0);
  const chain::Chain chain = chain::make_chain(0.3, 0.02, direction, axis, joints, bending, false);
  dynamics::Parameters p;
  const double bend = 4.5e-4 * joints / 0.3 * factor;
  for (int j = 0; j < joints; ++j) {
    p.link_mass.push_back(0.06 / joints);
    p.viscous_friction.push_back(0.0);
    p.coulomb_friction.push_back(tabletop ? 0.35 * factor : 0.0);
    p.air_linear.push_back(0.0);
    p.air_quadratic.push_back(tabletop ? 0.0 : 0.0144 * 0.3 / joints);
  }
  for (int k = 0; k < chain.angles(); ++k) {
    const double first = chain.child_link[k] == 1 ? 2.0 : 1.0;
    p.stiffness.push_back(bend * first);
    p.rest_angle.push_back(0.02 * std::sin(k + 1.0));
    p.damping.push_back(0.08 * bend * first * factor);
  }
  p.radius = 0.01;
  if (tabletop) p.table_normal = Vector3::UnitZ();
  p.substeps = tabletop ? 8 : 4;
  return dynamics::make_model(chain, p);
}

Problem problem_of(chain::Bending bending, bool tabletop) {
  Problem problem;
  problem.model = rope(bending, tabletop);
  problem.tabletop = tabletop;
  if (tabletop) problem.table_point = Vector3::Zero();
  problem.base.translation = tabletop ? Vector3(0, -0.15, 0.0105) : Vector3(0, 0, 0.55);
  const int n = problem.model.chain.angles();
  problem.initial.theta = tabletop ? VectorX(0.03 * VectorX::Ones(n))
                                   : dynamics::static_equilibrium(problem.model, problem.base);
  problem.initial.thetadot = VectorX::Zero(n);
  return problem;
}

Motion motion_of(const Problem& problem, std::vector<Axis> axes, double duration) {
  Motion motion;
  motion.origin = problem.base;
  motion.axes = std::move(axes);
  const auto count = static_cast<Eigen::Index>(motion.axes.size());
  motion.pieces.push_back({0.0, duration, MatrixX::Zero(kBasisCount, count), VectorX::Zero(count)});
  return motion;
}

VectorX wave(Eigen::Index size, double amplitude) {
  VectorX q(size);
  for (Eigen::Index i = 0; i < size; ++i) q[i] = amplitude * std::sin(1.0 + 2.3 * static_cast<double>(i));
  return q;
}

void set(Motion& motion, const VectorX& q) {
  for (std::size_t a = 0; a < motion.axes.size(); ++a) {
    const auto first = static_cast<Eigen::Index>(a) * kPerAxis;
    motion.pieces.back().weights.col(static_cast<Eigen::Index>(a)) = q.segment(first, kBasisCount);
    motion.pieces.back().terminal[static_cast<Eigen::Index>(a)] = q[first + kBasisCount];
  }
}

}  // namespace

TEST_CASE("basis derivatives agree with differences; the smooth window starts without acceleration") {
  for (Window window : {Window::smooth, Window::paper})
    for (double t : {0.5, 0.9, 1.7, 2.3}) {
      const double e = 1e-5;
      const Basis here = basis(window, 0.4, 2.0, t), up = basis(window, 0.4, 2.0, t + e),
                  down = basis(window, 0.4, 2.0, t - e);
      for (int d = 0; d < 3; ++d)
        CHECK(((up.col(d) - down.col(d)) / (2 * e) - here.col(d + 1)).norm() < 1e-6 * (1.0 + here.col(d + 1).norm()));
    }
  CHECK(basis(Window::smooth, 0.0, 1.0, 1e-6).col(2).norm() < 1e-2);
  CHECK(basis(Window::paper, 0.0, 1.0, 1e-6).col(2).norm() > 1.0);
  CHECK(basis(Window::paper, 0.0, 1.0, 2.0)(kBasisCount, 0) == 1.0);
}

TEST_CASE("the base's twist and its derivatives agree with differences of the pose") {
  Problem problem = problem_of(chain::Bending::spatial, false);
  problem.base.rotation = math::exp_so3({0.3, -0.2, 0.5});
  Motion motion = motion_of(problem, {Axis::x, Axis::y, Axis::z, Axis::yaw}, 2.0);
  set(motion, wave(4 * kPerAxis, 0.3));
  const double t = 0.83, e = 1e-4;
  const auto at = [&](double time) { return base_at(motion, time); };
  const math::Vector6 twist =
      math::log_se3(at(t - e).pose.inverse() * at(t + e).pose) / (2.0 * e);
  CHECK((twist - at(t).velocity).norm() < 1e-6);
  CHECK(((at(t + e).velocity - at(t - e).velocity) / (2 * e) - at(t).acceleration).norm() < 1e-5);
  math::Vector6 jerk;
  base_from(motion, coordinates(motion, t), &jerk);
  CHECK(((at(t + e).acceleration - at(t - e).acceleration) / (2 * e) - jerk).norm() < 1e-4);
}

TEST_CASE("the rollout is that of dynamics, and its derivative that of the discrete map") {
  struct Case {
    chain::Bending bending;
    bool tabletop;
    std::vector<Axis> axes;
  };
  for (const Case& c : {Case{chain::Bending::spatial, false, {Axis::x, Axis::y, Axis::z, Axis::yaw}},
                        Case{chain::Bending::planar, false, {Axis::x}},
                        Case{chain::Bending::planar, true, {Axis::y, Axis::yaw, Axis::x}}}) {
    Problem problem = problem_of(c.bending, c.tabletop);
    Motion motion = motion_of(problem, c.axes, 0.6);
    const VectorX q = wave(static_cast<Eigen::Index>(c.axes.size()) * kPerAxis, 0.1);
    set(motion, q);
    const Grid grid = make_grid(motion, problem.model.parameters.substeps);
    Rollout rollout;
    REQUIRE(roll_out(problem.model, motion, grid, q, problem.initial, true, rollout));

    std::vector<double> times;
    for (int k = 0; k < grid.nodes(); ++k) times.push_back(grid.time(k));
    const chain::States states = dynamics::rollout(
        problem.model, [&](double time) { return base_at(motion, time); }, problem.initial, times);
    double largest = 0.0;
    for (int k = 0; k < grid.nodes(); ++k) largest = std::max(largest, (states.theta[k] - rollout.theta[k]).norm());
    CHECK(largest < 1e-7);

    const MatrixX& slope = rollout.theta_slope.back();
    const MatrixX& rate_slope = rollout.thetadot_slope.back();
    double theta_error = 0.0, rate_error = 0.0;
    for (Eigen::Index i = 0; i < q.size(); ++i) {
      // fourth-order differences: the friction bends within millimeters per second
      const double e = c.tabletop ? 2e-6 : 1e-4;
      VectorX theta = VectorX::Zero(slope.rows()), rate = theta;
      for (const auto& [shift, weight] :
           {std::pair{-2.0, 1.0 / 12}, {-1.0, -8.0 / 12}, {1.0, 8.0 / 12}, {2.0, -1.0 / 12}}) {
        VectorX moved = q;
        moved[i] += shift * e;
        Rollout r;
        REQUIRE(roll_out(problem.model, motion, grid, moved, problem.initial, false, r));
        theta += weight / e * r.theta.back();
        rate += weight / e * r.thetadot.back();
      }
      theta_error = std::max(theta_error, (theta - slope.col(i)).norm() / slope.norm());
      rate_error = std::max(rate_error, (rate - rate_slope.col(i)).norm() / rate_slope.norm());
    }
    CHECK(theta_error < 1e-6);
    CHECK(rate_error < 1e-6);
  }
}
