// A twin at work inside another program.
#include "chainsplat/rope.h"

#include <doctest/doctest.h>

#include <cmath>
#include <filesystem>
#include <thread>

#include "chainsplat/run_folder.h"
#include "small_twin.h"

using namespace chainsplat;

namespace {

// A rope of three joints that hangs from a moving base, as if it had been loaded.
pipeline::Rope hanging_rope() {
  pipeline::Rope rope;
  rope.run = "rope";
  rope.twin.chain =
      chain::make_chain(0.3, 0.02, -math::Vector3::UnitZ(), math::Vector3::UnitY(), 3, chain::Bending::spatial, false);
  const int links = rope.twin.chain.links() - 1, angles = rope.twin.chain.angles();
  dynamics::Parameters p;
  p.link_mass.assign(links, 0.02);
  p.viscous_friction.assign(links, 0.0);
  p.coulomb_friction.assign(links, 0.0);
  p.air_linear.assign(links, 0.0);
  p.air_quadratic.assign(links, 1e-4);
  p.stiffness.assign(angles, 0.01);
  p.rest_angle.assign(angles, 0.05);
  p.damping.assign(angles, 5e-4);
  p.radius = 0.01;
  rope.twin.parameters = p;
  rope.model = dynamics::make_model(rope.twin.chain, p);
  rope.base = test::moving_base(1.0);
  return rope;
}

std::vector<double> some_times() {
  std::vector<double> times;
  for (int k = 0; k <= 20; ++k) times.push_back(0.04 * k);
  return times;
}

double largest(const math::MatrixX& a) { return a.cwiseAbs().maxCoeff(); }

}  // namespace

TEST_CASE("a rope at rest stays") {
  const pipeline::Rope rope = hanging_rope();
  const math::Pose pose = rope.base.pose(0.0);
  const dynamics::InitialState rest = pipeline::rest_state(rope, pose, 0.5);
  CHECK(rest.time == 0.5);
  const trajectory::Trajectory held = trajectory::fit({{0.0, pose}}, "held");
  const chain::States states = dynamics::rollout(*rope.model, held, rest, {0.5, 1.0, 2.0});
  for (const math::VectorX& theta : states.theta) CHECK(largest(theta - rest.theta) < 1e-6);
}

TEST_CASE("a batch gives each rollout as if alone, from many threads too") {
  const pipeline::Rope rope = hanging_rope();
  const std::vector<double> times = some_times();
  std::vector<dynamics::Parameters> parameters;
  std::vector<dynamics::InitialState> initials;
  for (int i = 0; i < 6; ++i) {
    parameters.push_back(rope.model->parameters);
    for (double& k : parameters.back().stiffness) k *= 1.0 + 0.2 * i;
    initials.push_back(pipeline::rest_state(rope, rope.base.pose(0.0), 0.0));
    initials.back().theta[1] += 0.1 * i;
  }
  std::vector<chain::States> twice[2];
  std::thread other([&] { twice[1] = pipeline::rollout_batch(rope, parameters, {&rope.base, 1}, initials, times); });
  twice[0] = pipeline::rollout_batch(rope, parameters, {&rope.base, 1}, initials, times);
  other.join();
  for (int i = 0; i < 6; ++i) {
    const chain::States alone =
        dynamics::rollout(dynamics::make_model(rope.twin.chain, parameters[i]), rope.base, initials[i], times);
    for (const auto& batch : twice) {
      REQUIRE(batch[i].theta.size() == times.size());
      for (std::size_t k = 0; k < times.size(); ++k) CHECK(batch[i].theta[k] == alone.theta[k]);
    }
  }
  CHECK_THROWS_AS(pipeline::rollout_batch(rope, {parameters.data(), 2}, {&rope.base, 1}, initials, times), InputError);
  initials[0].theta.resize(2);
  CHECK_THROWS_AS(pipeline::rollout_batch(rope, {}, {&rope.base, 1}, {&initials[0], 1}, times), InputError);
}

TEST_CASE("derivatives of a rollout are differences") {
  const pipeline::Rope rope = hanging_rope();
  const std::vector<double> times = some_times();
  const dynamics::InitialState start = pipeline::rest_state(rope, rope.base.pose(0.0), 0.0);
  std::vector<trajectory::Sample> path, sway;
  for (int k = 0; k <= 60; ++k) {
    const double t = k / 60.0;
    math::Pose shift;
    shift.translation = {0.3 * std::sin(5.0 * t), 0.1 * std::cos(3.0 * t), 0.2 * t * t};
    sway.push_back({t, shift});
  }
  const trajectory::Trajectory direction = trajectory::fit(sway, "sway");
  const std::vector<std::string> names{"log_stiffness", "rest_angle_3", "theta_2", "thetadot_5"};
  const pipeline::Derivatives found =
      pipeline::rollout_derivatives(rope, rope.base, start, times, names, {&direction, 1});

  // log_stiffness, rest_angle_3, theta_2, thetadot_5, amplitude of the sway
  const auto rolled = [&](const std::array<double, 5>& by) {
    dynamics::Parameters p = rope.model->parameters;
    for (double& k : p.stiffness) k *= std::exp(by[0]);
    p.rest_angle[2] += by[1];
    dynamics::InitialState at = start;
    at.theta[1] += by[2];
    at.thetadot[4] += by[3];
    p.substeps = 16;
    const dynamics::BaseFunction base = [&](double time) {
      trajectory::BaseMotion now = rope.base.at(time);
      const trajectory::BaseMotion shift = direction.at(time);  // its rotation is the identity
      const math::Matrix3 to_base = now.pose.rotation.transpose();
      // V_b of a displaced base, and its derivative by a difference: nothing of what is tested
      const auto twist = [&](double t) {
        const trajectory::BaseMotion b = rope.base.at(t);
        math::Vector6 v = b.velocity;
        v.tail<3>() += by[4] * (b.pose.rotation.transpose() * direction.at(t).velocity.tail<3>());
        return v;
      };
      now.pose.translation += by[4] * shift.pose.translation;
      now.acceleration = (twist(time + 1e-5) - twist(time - 1e-5)) / 2e-5;
      now.velocity.tail<3>() += by[4] * (to_base * shift.velocity.tail<3>());
      return now;
    };
    return dynamics::rollout(dynamics::make_model(rope.twin.chain, p), base, at, times);
  };
  const double step = 1e-4;
  for (int k = 0; k < 5; ++k) {
    std::array<double, 5> more{}, less{};
    more[k] = step, less[k] = -step;
    const chain::States high = rolled(more), low = rolled(less);
    double scale = 0.0, off = 0.0;
    for (std::size_t t = 1; t + 1 < times.size(); ++t) {  // the base's end is a kink for the difference above
      const math::VectorX difference = (high.theta[t] - low.theta[t]) / (2.0 * step);
      const math::VectorX told = k < 4 ? found.by_names.theta[t].col(k) : found.by_directions.theta[t].col(0);
      scale = std::max(scale, largest(difference));
      off = std::max(off, largest(told - difference));
    }
    CAPTURE(k);
    CHECK(scale > 0.0);
    CHECK(off < 0.02 * scale);
  }
  const std::vector<std::string> unknown{"log_color"}, beyond{"theta_7"};
  CHECK_THROWS_AS(pipeline::rollout_derivatives(rope, rope.base, start, times, unknown), InputError);
  CHECK_THROWS_AS(pipeline::rollout_derivatives(rope, rope.base, start, times, beyond), InputError);
}

TEST_CASE("a base that comes pose by pose is known as the whole motion is") {
  const trajectory::Trajectory whole = test::moving_base(2.0);
  pipeline::LiveBase live;
  CHECK_THROWS_AS(live.at(0.0), InputError);
  double speed = 0.0, place = 0.0;
  for (int k = 0; k <= 90; ++k) {
    const double time = k / 60.0;
    live.add(time, whole.pose(time));
    if (k < 30) continue;
    const trajectory::BaseMotion now = live.at(time), true_motion = whole.at(time);
    place = std::max(place, (now.pose.translation - true_motion.pose.translation).norm());
    speed = std::max(speed, (now.velocity - true_motion.velocity).norm());
  }
  CHECK(place < 5e-4);                                          // m
  CHECK(speed < 0.05);                                          // m/s, of swings of up to 0.5 m/s
  CHECK_THROWS_AS(live.add(1.0, whole.pose(1.0)), InputError);  // back in time
  CHECK(live.at(1.5).pose.translation == live.at(1.5).pose.translation);
}

TEST_CASE("no dynamics: planning assumes some, rollouts refuse") {
  pipeline::Rope rope = hanging_rope();
  rope.twin.parameters.reset();
  rope.model.reset();
  CHECK_THROWS_AS(pipeline::model_of(rope), InputError);
  CHECK_THROWS_AS(pipeline::rest_state(rope, {}, 0.0), InputError);
  std::string warned;
  core::Listener listener;
  listener.warning = [&](const std::string& line) { warned += line; };
  const core::ListenerScope scope(listener);
  const planning::Problem problem = pipeline::planning_problem(rope);
  CHECK(dynamics::total_mass(problem.model.parameters) == doctest::Approx(0.06));
  CHECK(warned.find("not identified") != std::string::npos);
}

TEST_CASE("the next recording is designed from where this one began, and compared with it") {
  pipeline::Rope rope = hanging_rope();
  rope.twin.states = rope.twin.rollout =
      pipeline::rollout_batch(rope, {}, {&rope.base, 1},
                              std::vector{pipeline::rest_state(rope, rope.base.pose(0.0), 0.0)}, some_times())
          .front();
  const excitation::Problem problem = pipeline::excitation_problem(rope);
  CHECK(problem.base.translation == rope.base.pose(rope.base.start()).translation);
  CHECK(problem.recorded_start == rope.twin.states.time.front());
  CHECK(problem.recorded_end == rope.twin.states.time.back());
  CHECK((problem.recorded(0.4).velocity - rope.base.at(0.4).velocity).norm() == 0.0);
}
