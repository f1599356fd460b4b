#include "chainsplat/planning.h"

#include <doctest/doctest.h>
#include <cmath>

#include "planning/parameter_correction.h"
#include "planning/search.h"

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
  problem.initial.theta =
      tabletop ? VectorX(0.03 * VectorX::Ones(n)) : dynamics::static_equilibrium(problem.model, problem.base).theta;
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
  const math::Vector6 twist = math::log_se3(at(t - e).pose.inverse() * at(t + e).pose) / (2.0 * e);
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
    CHECK(largest < 1e-6);

    const MatrixX& slope = rollout.theta_slope.back();
    const MatrixX& rate_slope = rollout.thetadot_slope.back();
    double theta_error = 0.0, rate_error = 0.0;
    for (Eigen::Index i = 0; i < q.size(); ++i) {
      // fourth-order differences: the friction bends within millimeters per second
      const double e = c.tabletop ? 2e-6 : 4e-5;
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
    CHECK(theta_error < 1e-8);
    CHECK(rate_error < 1e-8);

    // the fast one: of second order in the step
    double error[2];
    for (const int finer : {1, 2}) {
      Rollout quick, exact;
      const Grid other = make_grid(motion, finer * 2 * problem.model.parameters.substeps);
      REQUIRE(roll_out(problem.model, motion, other, q, problem.initial, true, quick, false));
      REQUIRE(roll_out(problem.model, motion, other, q, problem.initial, true, exact, true));
      error[finer - 1] = (quick.theta_slope.back() - exact.theta_slope.back()).norm() / exact.theta_slope.back().norm();
    }
    CHECK(error[0] < 0.05);
    CHECK(error[0] > 1e-6);  // not the same
    CHECK(error[1] < 0.4 * error[0]);
  }
}

namespace {

Task task_of(const Problem& problem, const Options& options, const Motion& motion) {
  return make_task(problem, options, {&problem.model}, motion, problem.initial, problem.targets.front(),
                   problem.model.parameters.substeps);
}

}  // namespace

TEST_CASE("the objective's gradient agrees with differences, limits and obstacles included") {
  for (bool tabletop : {false, true}) {
    Problem problem = problem_of(tabletop ? chain::Bending::planar : chain::Bending::spatial, tabletop);
    Options options;
    options.axes = tabletop ? std::vector<Axis>{Axis::x, Axis::yaw} : std::vector<Axis>{Axis::x, Axis::z, Axis::yaw};
    options.limits = {.velocity = 0.2,
                      .acceleration = 1.0,
                      .jerk = 8.0,
                      .stroke = 0.05,
                      .yaw_velocity = 0.3,
                      .yaw_acceleration = 1.0,
                      .yaw_jerk = 10.0,
                      .turn = 0.1};
    options.spheres = {{problem.base.translation + 0.15 * problem.model.chain.direction, 0.05}};
    options.boxes = {
        {problem.base.translation - Vector3(0.1, 0.02, 0.1), problem.base.translation + Vector3(0.02, 0.3, 0.02)}};
    problem.targets = {problem.base.translation + 0.27 * problem.model.chain.direction + Vector3(0.05, 0, 0)};
    Motion motion = motion_of(problem, options.axes, 0.8);
    const Task task = task_of(problem, options, motion);
    const VectorX q = wave(static_cast<Eigen::Index>(options.axes.size()) * kPerAxis, 0.1);
    const Sharpness sharpness{1e3, 1e-4};
    const Evaluation here = evaluate(task, q, sharpness, true);
    REQUIRE(here.good);
    CHECK(here.value == doctest::Approx(evaluate(task, q, sharpness, false).value).epsilon(1e-12));
    // fourth-order differences of the whole objective; on the table friction bends within millimeters per second
    VectorX differences = VectorX::Zero(q.size());
    const double e = tabletop ? 2e-6 : 1e-5;
    for (Eigen::Index i = 0; i < q.size(); ++i)
      for (const auto& [shift, weight] :
           {std::pair{-2.0, 1.0 / 12}, {-1.0, -8.0 / 12}, {1.0, 8.0 / 12}, {2.0, -1.0 / 12}}) {
        VectorX moved = q;
        moved[i] += shift * e;
        differences[i] += weight / e * evaluate(task, moved, sharpness, false).value;
      }
    CHECK((differences - here.gradient).norm() < 1e-8 * here.gradient.norm());
    CHECK(here.gradient.norm() > 0.0);
  }
}

TEST_CASE("targets that a random motion passes are reached within the limits, the same on any number of threads") {
  for (bool tabletop : {false, true}) {
    Problem problem = problem_of(tabletop ? chain::Bending::planar : chain::Bending::spatial, tabletop);
    Options options;
    options.horizon = 1.5;
    options.starts = 8;
    problem.targets = {random_target(problem, options, 3)};
    core::set_threads(1);
    const Plan one = plan(problem, options);
    core::set_threads(3);
    const Plan three = plan(problem, options);
    core::set_threads(0);
    CHECK(one.reached);
    CHECK(one.hits[0].miss < 1e-3);
    CHECK(one.peaks.over.empty());
    CHECK(one.peaks.velocity <= options.limits.velocity);
    CHECK(one.motion.pieces[0].weights == three.motion.pieces[0].weights);
    CHECK(one.summary.final_cost == three.summary.final_cost);
    CHECK(one.summary.final_cost <= one.summary.initial_cost);

    // judged by the rollout of dynamics itself, on a grid of its own
    std::vector<double> times;
    for (int k = 1; k <= 3000; ++k) times.push_back(1.5 * k / 3000);
    const chain::States states = predict(problem, one.motion, times);
    double least = 1.0;
    for (std::size_t k = tabletop ? times.size() - 1 : 0; k < times.size(); ++k)
      least = std::min(least, std::sqrt(nearest(problem.model.chain,
                                                chain::link_motions(problem.model.chain, states.theta[k],
                                                                    base_at(one.motion, times[k]).pose),
                                                tabletop ? Part::rope : Part::tip, problem.targets[0])
                                            .squared));
    CHECK(std::abs(least - one.hits[0].miss) < 3e-4);
  }
}

TEST_CASE("what of the rope hits is what was asked for, and it is said where along the rope that is") {
  Problem problem = problem_of(chain::Bending::planar, false);
  Options options;
  options.horizon = 1.0;
  options.starts = 2;
  // a place beside the middle of the rope at rest: the whole rope is there at once, the tip must come up
  problem.targets = {problem.base.translation + Vector3(0.0, 0.0, -0.15)};
  options.part = Part::rope;
  const Plan rope_plan = plan(problem, options);
  CHECK(rope_plan.reached);
  CHECK(rope_plan.hits[0].arclength < 0.25);
  for (const Part part : {Part::tip, Part::last_link}) {
    options.part = part;
    problem.targets = {problem.base.translation + Vector3(0.1, 0.0, -0.28)};
    const Plan found = plan(problem, options);
    CHECK(found.reached);
    const double first = part == Part::tip ? 0.3 : 0.3 - 0.3 / 8 - 1e-9;
    CHECK(found.hits[0].arclength >= first);
    // the point at that arclength is where the hit says
    const chain::States there = predict(problem, found.motion, {found.hits[0].time});
    const auto motions =
        chain::link_motions(problem.model.chain, there.theta[0], base_at(found.motion, found.hits[0].time).pose);
    const Vector3 point = motions.back() * (found.hits[0].arclength * problem.model.chain.direction);
    CHECK((point - found.hits[0].point).norm() < 1e-3);
  }
}

TEST_CASE("on a table a target that only the free end can be brought to is reached") {
  // a random motion left the rope's end behind the gripper, where a straight rope has no part to draw near
  Problem problem = problem_of(chain::Bending::planar, true);
  Options options;
  std::uint64_t seed = 1;
  do problem.targets = {random_target(problem, options, seed++)};
  while (problem.targets[0].y() > problem.base.translation.y() - 0.05 && seed < 400);
  REQUIRE(seed < 400);
  CHECK(plan(problem, options).reached);
}

TEST_CASE("a rope that is held above the table is planned for like one that is not") {
  const auto planned = [](double lift) {
    Problem problem = problem_of(chain::Bending::planar, true);
    std::vector<double>& lower = problem.model.chain.lift;
    lower.assign(problem.model.chain.links(), -lift);
    lower[0] = 0.0, lower[1] = -0.5 * lift;
    problem.base.translation.z() += lift;
    problem.targets = {{0.05, 0.08, 0.01}};
    Options options;
    options.axes = {Axis::x, Axis::y};
    return plan(problem, options);
  };
  const Plan flat = planned(0.0), held = planned(0.015);
  CHECK(flat.reached);
  CHECK(held.reached);
  CHECK(held.hits[0].miss == doctest::Approx(flat.hits[0].miss).epsilon(0.01));
  CHECK(held.iterations == flat.iterations);  // nothing was sought in vain

  Problem problem = problem_of(chain::Bending::planar, true);
  problem.model.chain.lift.assign(problem.model.chain.links(), -0.015);
  problem.targets = {{0.05, 0.08, 0.01}};
  Options options;
  options.axes = {Axis::x, Axis::y};
  CHECK(unreachable_distance(problem, options, problem.targets[0]) == 0.0);
}

TEST_CASE("a target out of reach is said to be so, with the nearest motion") {
  Problem problem = problem_of(chain::Bending::planar, false);
  Options options;
  options.horizon = 1.0;
  options.starts = 2;
  // 10 cm out of the plane of the rope
  problem.targets = {problem.base.translation + Vector3(0.05, 0.1, -0.25)};
  CHECK(unreachable_distance(problem, options, problem.targets[0]) == doctest::Approx(0.1));
  const Plan far = plan(problem, options);
  CHECK(!far.reached);
  CHECK(far.hits[0].miss == doctest::Approx(0.1).epsilon(0.01));
  CHECK(far.reason.find("100.0 mm") != std::string::npos);
  // beyond rope and stroke
  problem.targets = {problem.base.translation + Vector3(1.2, 0.0, 0.0)};
  CHECK(unreachable_distance(problem, options, problem.targets[0]) == doctest::Approx(1.2 - 0.6 - 0.3));
}

TEST_CASE("wrong requests name what is wrong") {
  Problem problem = problem_of(chain::Bending::planar, true);
  Options options;
  problem.targets = {{0.1, NAN, 0.0}};
  CHECK_THROWS_AS(plan(problem, options), InputError);
  problem.targets = {{0.1, 0.1, -0.02}};  // under the table
  CHECK_THROWS_AS(plan(problem, options), InputError);
  problem.targets = {{0.1, 0.1, 0.0}};
  options.limits.velocity = -1.0;
  CHECK_THROWS_AS(plan(problem, options), InputError);
  options.limits.velocity = 1.5;
  options.axes = {Axis::z};
  CHECK_THROWS_AS(plan(problem, options), InputError);
  options.axes = {Axis::x};
  options.terminal = VectorX::Constant(1, 0.7);  // outside the stroke
  CHECK_THROWS_AS(plan(problem, options), InputError);
  options.terminal.reset();
  options.samples = 3;  // no covariance
  CHECK_THROWS_AS(plan(problem, options), InputError);
}

TEST_CASE("fixed end, two targets in sequence and a keep-out sphere are kept to") {
  Problem problem = problem_of(chain::Bending::planar, false);
  Options options;
  options.axes = {Axis::x, Axis::z};
  options.horizon = 1.2;
  options.starts = 8;
  options.terminal = VectorX::Zero(2);
  const Vector3 p = problem.base.translation;
  problem.targets = {p + Vector3(0.1, 0, -0.28), p + Vector3(-0.12, 0, -0.22)};
  options.spheres = {{p + Vector3(0.25, 0, -0.25), 0.03}};
  const Plan found = plan(problem, options);
  CHECK(found.reached);
  REQUIRE(found.hits.size() == 2);
  CHECK(found.hits[0].time <= 1.2 + 1e-9);
  CHECK(found.hits[1].time >= 1.2);
  CHECK((base_at(found.motion, found.motion.end()).pose.translation - p).norm() < 1e-12);
  const std::vector<double> times = [] {
    std::vector<double> t;
    for (int k = 1; k <= 480; ++k) t.push_back(2.4 * k / 480);
    return t;
  }();
  const chain::States states = predict(problem, found.motion, times);
  for (std::size_t k = 0; k < times.size(); ++k) {
    const MatrixX nodes = chain::nodes(problem.model.chain, chain::link_motions(problem.model.chain, states.theta[k],
                                                                                base_at(found.motion, times[k]).pose));
    for (Eigen::Index i = 0; i < nodes.cols(); ++i)
      CHECK((nodes.col(i) - options.spheres[0].center).norm() > 0.03 + 0.01 - 1e-4);
  }
}

TEST_CASE("a target behind a keep-out sphere is reached around it") {
  Problem problem = problem_of(chain::Bending::planar, false);
  Options options;
  options.axes = {Axis::x, Axis::z};
  const Vector3 p = problem.base.translation;
  problem.targets = {p + Vector3(0.3, 0, -0.25)};
  const Plan free = plan(problem, options);
  // what is not in the way changes nothing
  options.spheres = {{p + Vector3(0, 1.5, 0), 0.03}};
  CHECK(unknowns_of(plan(problem, options).motion) == unknowns_of(free.motion));
  // and what is, is kept clear of, by a way that an evaluation on another grid sees
  options.spheres = {{p + Vector3(0.18, 0, -0.27), 0.03}};
  const auto nearest_to_sphere = [&](const Plan& made) {
    double least = 1e9;
    std::vector<double> times;
    for (int k = 1; k <= 700; ++k) times.push_back(made.motion.end() * k / 700);
    const chain::States states = predict(problem, made.motion, times);
    for (std::size_t k = 0; k < times.size(); ++k) {
      const auto motions =
          chain::link_motions(problem.model.chain, states.theta[k], base_at(made.motion, times[k]).pose);
      const MatrixX nodes = chain::nodes(problem.model.chain, motions);
      for (Eigen::Index i = 0; i < nodes.cols(); ++i)
        least = std::min(least, (nodes.col(i) - options.spheres[0].center).norm());
    }
    return least;
  };
  const Plan around = plan(problem, options);
  CHECK(around.reached);
  CHECK(nearest_to_sphere(around) > 0.03 + 0.01 - 1e-4);
  CHECK(nearest_to_sphere(free) < 0.03 + 0.01 - 1e-3);  // else the test would show nothing
}

TEST_CASE("what a step may run into is told with its slope") {
  const Problem problem = problem_of(chain::Bending::planar, false);
  Options options;
  options.axes = {Axis::x, Axis::z};
  const Vector3 p = problem.base.translation;
  options.spheres = {{p + Vector3(0.06, 0, -0.25), 0.03}};
  Motion motion = empty_motion(problem, options);
  append_piece(motion, 0.0, 1.0);
  const Task task =
      make_task(problem, options, {&problem.model}, motion, problem.initial, p + Vector3(0.2, 0, -0.25), 2);
  VectorX q = VectorX::Zero(2 * kPerAxis);
  q[kBasisCount] = 0.01;
  const Sharpness sharpness{1e4, 1e-7};
  const Evaluation here = evaluate(task, q, sharpness, true);
  REQUIRE(here.good);
  REQUIRE(!here.near.empty());
  VectorX step = VectorX::Zero(q.size());
  step[3] = 1e-5, step[kBasisCount] = 1e-5;
  const Evaluation there = evaluate(task, q + step, sharpness, true);
  REQUIRE(there.near.size() == here.near.size());
  int moved = 0;
  for (std::size_t k = 0; k < here.near.size(); ++k) {
    const double change = there.near[k].residual - here.near[k].residual;
    CHECK(change == doctest::Approx(here.near[k].slope.dot(step)).epsilon(0.02).scale(1e-6));
    moved += std::abs(change) > 1e-6;
  }
  CHECK(moved > 0);
}

TEST_CASE("a horizon of its own is the shortest that reaches; samples of the parameters spread the miss") {
  Problem problem = problem_of(chain::Bending::planar, false);
  Options options;
  options.horizon = 3.0;
  options.starts = 6;
  options.free_horizon = true;
  problem.targets = {problem.base.translation + Vector3(0.08, 0, -0.29)};
  const Plan quick = plan(problem, options);
  CHECK(quick.reached);
  CHECK(quick.motion.end() < 2.0);

  options.free_horizon = false;
  options.horizon = 1.0;
  options.samples = 4;
  problem.estimates.names = {"log_damping", "log_stiffness"};
  problem.estimates.covariance = 0.04 * MatrixX::Identity(2, 2);
  const Plan robust = plan(problem, options);
  CHECK(robust.hits[0].worst_miss >= robust.hits[0].mean_miss);
  CHECK(robust.hits[0].mean_miss > 0.0);
  CHECK(robust.hits[0].mean_miss < 0.05);
}

TEST_CASE("draws from the covariance have its spread and keep the mass") {
  const dynamics::Model model = rope(chain::Bending::planar, true);
  dynamics::Estimates estimates;
  estimates.names = {"log_stiffness", "log_mass_link_2", "rest_angle_3", "theta_1"};
  estimates.covariance = VectorX(Eigen::Vector4d(0.04, 0.01, 0.0025, 1.0)).asDiagonal();
  const auto draws = draw_parameters(model.chain, model.parameters, estimates, 400, 5);
  double stiffness = 0.0, rest = 0.0;
  for (const dynamics::Parameters& p : draws) {
    double mass = p.tip_mass;
    for (double m : p.link_mass) mass += m;
    CHECK(mass == doctest::Approx(0.06).epsilon(1e-12));
    stiffness += std::pow(std::log(p.stiffness[4] / model.parameters.stiffness[4]), 2) / 400;
    rest += std::pow(p.rest_angle[2] - model.parameters.rest_angle[2], 2) / 400;
    CHECK(p.rest_angle[0] == model.parameters.rest_angle[0]);
  }
  CHECK(std::sqrt(stiffness) == doctest::Approx(0.2).epsilon(0.12));
  CHECK(std::sqrt(rest) == doctest::Approx(0.05).epsilon(0.12));
}

TEST_CASE("the state of one chain is found from points of another") {
  const dynamics::Model coarse = rope(chain::Bending::spatial, false), fine = rope(chain::Bending::spatial, false, 24);
  const trajectory::BaseMotion base = dynamics::at_rest({math::exp_so3({0, 0, 0.3}), {0.1, 0.2, 0.5}});
  const std::vector<double> s = chain::equal_arclengths(coarse.chain, 33);
  const VectorX theta = wave(16, 0.1), rate = wave(16, 1.0);
  const auto centerline = [&](const VectorX& angles) {
    return chain::centerline(coarse.chain, chain::link_motions(coarse.chain, angles, base.pose), s);
  };
  const MatrixX speed = (centerline(theta + 1e-6 * rate) - centerline(theta - 1e-6 * rate)) / 2e-6;
  const StateFit fit = fit_state(coarse.chain, base, s, centerline(theta), speed, VectorX::Zero(16));
  CHECK(fit.summary.reason == solve::Reason::step);
  const dynamics::InitialState& own = fit.state;
  CHECK((own.theta - theta).norm() < 1e-3);
  CHECK((own.thetadot - rate).norm() < 1e-2);
  const auto other = fit_state(fine.chain, base, s, centerline(theta), {}, VectorX::Zero(48)).state;
  const MatrixX near = chain::centerline(fine.chain, chain::link_motions(fine.chain, other.theta, base.pose), s);
  CHECK((near - centerline(theta)).colwise().norm().maxCoeff() < 1e-3);
}

TEST_CASE("feedback mends what a wrong model misses and follows a target that moves") {
  Problem problem = problem_of(chain::Bending::spatial, false);
  Options options;
  options.horizon = 1.5;
  options.starts = 8;
  problem.targets = {problem.base.translation + Vector3(0.25, 0.1, -0.24)};
  const Plan found = plan(problem, options);
  REQUIRE(found.reached);
  const dynamics::Model truth = rope(chain::Bending::spatial, false, 24, 0.6);
  LoopOptions loop;
  loop.feedback = false;
  const LoopResult blind = closed_loop(problem, options, found, truth, loop);
  loop.feedback = true;
  const LoopResult seeing = closed_loop(problem, options, found, truth, loop);
  CHECK(blind.hit.miss > 1e-3);
  CHECK(seeing.hit.miss < 0.5 * blind.hit.miss);
  CHECK(seeing.replans > 3);
  CHECK(seeing.peaks.over.empty());
  loop.target_velocity = {0.03, 0, 0};
  const double followed = closed_loop(problem, options, found, truth, loop).hit.miss;
  loop.feedback = false;
  CHECK(followed < 0.5 * closed_loop(problem, options, found, truth, loop).hit.miss);
}

TEST_CASE("what the rope does tells by how much its parameters are off") {
  for (bool tabletop : {false, true}) {
    Problem problem = problem_of(chain::Bending::planar, tabletop);
    dynamics::Parameters off = problem.model.parameters;
    for (double& k : off.stiffness) k *= 0.8;
    for (double& d : off.damping) d *= 1.25;
    for (double& mu : off.coulomb_friction) mu *= 1.2;
    const dynamics::Model truth = dynamics::make_model(problem.model.chain, off);
    Motion motion = motion_of(problem, {Axis::x}, 2.0);
    set(motion, wave(kPerAxis, 0.3));
    const auto base = [&](double time) { return base_at(motion, time); };
    std::vector<double> times;
    for (int k = 1; k <= 20; ++k) times.push_back(0.1 * k);
    const chain::States states = dynamics::rollout(truth, base, problem.initial, times);
    ParameterCorrection correction = start_correction(problem.model);
    dynamics::InitialState before = problem.initial;
    const std::vector<double> seen = chain::equal_arclengths(problem.model.chain, 17);
    for (std::size_t k = 0; k < times.size(); ++k) {
      const dynamics::InitialState after{times[k], states.theta[k], states.thetadot[k]};
      correct(correction, base, before, after, seen);
      before = after;
    }
    // stiffness, damping, then friction or drag
    CHECK(std::exp(correction.change[0]) == doctest::Approx(0.8).epsilon(0.03));
    CHECK(std::exp(correction.change[1]) == doctest::Approx(1.25).epsilon(0.06));
    CHECK(std::exp(correction.change[2]) == doctest::Approx(tabletop ? 1.2 : 1.0).epsilon(0.06));
    CHECK(correction.covariance(0, 0) < 0.1 * 0.1);
  }
}

TEST_CASE("feedback on a table copes with another friction and keeps tight limits, also where the jerk jumps") {
  Problem problem = problem_of(chain::Bending::planar, true);
  Options options;
  options.horizon = 1.5;
  options.starts = 8;
  options.limits.jerk = 40.0;
  options.limits.acceleration = 4.0;
  dynamics::Parameters off = rope(chain::Bending::planar, true, 24).parameters;
  for (double& k : off.stiffness) k *= 0.8;
  for (double& mu : off.coulomb_friction) mu *= 1.2;
  const dynamics::Model truth = dynamics::make_model(rope(chain::Bending::planar, true, 24).chain, off);
  double blind = 0.0, seeing = 0.0;
  for (const std::uint64_t seed : {1, 2, 3, 4}) {
    problem.targets = {random_target(problem, options, seed)};
    const Plan found = plan(problem, options);
    REQUIRE(found.reached);
    LoopOptions loop;
    loop.rate = 7.0;  // replans between the tests of the limits
    const LoopResult result = closed_loop(problem, options, found, truth, loop);
    CHECK(peaks(result.motion, 0.0, 1.5, options.limits, 1e-4).over.empty());
    CHECK(std::abs(result.foretold - result.hit.miss) < 0.01);
    seeing += result.hit.miss;
    loop.feedback = false;
    blind += closed_loop(problem, options, found, truth, loop).hit.miss;
  }
  CAPTURE(blind);
  CHECK(seeing < 0.75 * blind);  // two of the plans use all of the jerk and leave no room to correct
}

// Three motions are planned and each is carried out three times, with a plan at every moment: of the suite "whole".
TEST_CASE("a target that moves by centimeters is followed on a table" * doctest::test_suite("whole")) {
  // far from the motion so far full steps overshoot by meters
  Problem problem = problem_of(chain::Bending::planar, true);
  Options options;
  options.starts = 8;
  const dynamics::Model truth = rope(chain::Bending::planar, true, 24);
  for (const std::uint64_t seed : {1, 4, 8}) {
    CAPTURE(seed);
    problem.targets = {random_target(problem, options, seed)};
    const Plan found = plan(problem, options);
    REQUIRE(found.reached);
    LoopOptions loop;
    loop.target_velocity = {0.02, 0.01, 0.0};
    loop.feedback = false;
    const double blind = closed_loop(problem, options, found, truth, loop).hit.miss;
    loop.feedback = true;
    const LoopResult seeing = closed_loop(problem, options, found, truth, loop);
    CHECK(seeing.hit.miss < 0.1 * blind);
    CHECK(seeing.peaks.over.empty());
    CHECK(seeing.out_of_reach == 0.0);
    // straight away from the gripper, which moves across only: the rope's length ends it
    loop.target_velocity = {0.0, 0.15, 0.0};
    const LoopResult beyond = closed_loop(problem, options, found, truth, loop);
    CHECK(beyond.out_of_reach > 0.0);
    CHECK(beyond.hit.miss >= beyond.out_of_reach);
  }
}
