#include "chainsplat/excitation.h"

#include <doctest/doctest.h>
#include <algorithm>
#include <cmath>
#include <functional>
#include <string>

#include "chainsplat/dynamics/rod.h"
#include "chainsplat/identification.h"

using namespace chainsplat;
using math::Vector3;
using math::VectorX;

namespace {

constexpr double kStiffness = 0.012, kDamping = 6e-4;  // N m/rad, N m s/rad, of joints but the one at the grasp

dynamics::Model rope() {
  const chain::Chain chain =
      chain::make_chain(0.3, 0.02, -Vector3::UnitZ(), Vector3::UnitY(), 5, chain::Bending::planar, false);
  const auto fill = [](int count, double value) { return std::vector<double>(count, value); };
  dynamics::Parameters p;
  p.link_mass = fill(5, 0.012), p.viscous_friction = p.coulomb_friction = p.air_linear = fill(5, 0.0);
  p.air_quadratic = fill(5, 0.0144 * 0.06);
  p.rest_angle = fill(5, 0.02);
  p.radius = 0.01, p.tip_mass = 0.002;
  const double link = chain.length / 5, tension = dynamics::grasp_tension(p, p.gravity);  // m, N
  for (int j = 1; j <= 5; ++j) {
    const dynamics::RodJoint joint = dynamics::rod_joint(chain, j, kStiffness * link, tension);
    p.stiffness.push_back(joint.stiffness);
    p.damping.push_back(kDamping / kStiffness * joint.slope);
  }
  return dynamics::make_model(chain, p);
}

// 15 cm at 0.25 Hz: a gentle recording.
trajectory::BaseMotion gentle(double t) {
  const double a = 0.075, w = 2.0 * M_PI * 0.25;
  trajectory::BaseMotion base;
  base.pose.translation.x() = a * (1.0 - std::cos(w * t));
  base.velocity[3] = a * w * std::sin(w * t);
  base.acceleration[3] = a * w * w * std::cos(w * t);
  return base;
}

struct Recording {
  trajectory::Trajectory base;
  chain::States states;
};

Recording record(const dynamics::Model& model, const dynamics::BaseFunction& motion, double duration,
                 std::uint64_t seed) {
  std::vector<trajectory::Sample> samples;
  for (int k = 0; k <= duration * 100 + 1e-9; ++k) samples.push_back({k / 100.0, motion(k / 100.0).pose});
  std::vector<double> times;
  for (int k = 0; k <= duration * 30 + 1e-9; ++k) times.push_back(k / 30.0);
  const VectorX rest = dynamics::static_equilibrium(model, motion(0.0).pose).theta;
  dynamics::Model fine = model;
  fine.parameters.substeps = 16;
  Recording out{trajectory::fit(samples, "test"),
                dynamics::rollout(fine, motion, {0.0, rest, VectorX::Zero(rest.size())}, times)};
  core::Random random(seed);
  for (VectorX& theta : out.states.theta)
    for (double& angle : theta) angle += 0.5 * M_PI / 180.0 * random.normal();
  out.states.thetadot.clear();
  return out;
}

}  // namespace

// A motion is searched for and two recordings are identified: of the suite "whole".
TEST_CASE("the proposed motion keeps the limits, tells more than the old one, and identification confirms it" *
          doctest::test_suite("whole")) {
  const dynamics::Model model = rope();
  identification::Options options;
  options.mass = 0.062;
  options.per_joint = false;
  const Recording old = record(model, gentle, 4.0, 1);
  const identification::Result found = identification::identify(model.chain, old.base, old.states, options);

  excitation::Problem problem;
  problem.model = dynamics::make_model(model.chain, found.parameters);
  problem.base = old.base.pose(0.0);
  problem.initial = {0.0, dynamics::static_equilibrium(problem.model, problem.base).theta, VectorX::Zero(5)};
  problem.estimates = found.estimates;
  problem.recorded = [&](double t) { return old.base.at(t); };
  problem.recorded_end = 4.0;
  excitation::Options request;
  request.duration = 4.0;
  request.limits.stroke = 0.15;
  request.starts = 12, request.generations = 8;
  const excitation::Result result = excitation::excite(problem, request);

  CHECK(result.spread > 0.0);
  CHECK(result.spread <= 0.05 * 0.3);  // the twin can predict it
  CHECK(result.peaks.over.empty());
  CHECK(result.peaks.stroke <= 0.15 * (1 + 1e-9));
  const planning::Peaks fine = planning::peaks(result.motion, 0.0, 4.0, request.limits, 2.7e-4);
  CHECK(fine.over.empty());
  for (double t : {0.0, 4.0}) CHECK(planning::base_at(result.motion, t).acceleration.norm() < 1e-9);
  const excitation::Prediction& p = result.prediction;
  CHECK(p.gain > p.repeated_gain + 0.2);  // a parameter's uncertainty falls by a further 20 % in the mean
  for (std::size_t i = 0; i < p.names.size(); ++i) {
    CHECK(p.excited[i] <= p.now[i] * (1.0 + 1e-9));
    CHECK(p.repeated[i] <= p.now[i] * (1.0 + 1e-9));
  }
  // the same request, the same motion
  const excitation::Result again = excitation::excite(problem, request);
  CHECK(again.motion.pieces[0].weights == result.motion.pieces[0].weights);

  // both recordings identified together: the standard errors of what was uncertain shrink as promised
  const auto after = [&](const dynamics::BaseFunction& motion) {
    const Recording recording = record(model, motion, 4.0, 2);
    const identification::Recording both[] = {{old.base, old.states}, {recording.base, recording.states}};
    return identification::identify(model.chain, both, options)[0].estimates;
  };
  const auto compare = [&](const dynamics::Estimates& both, const std::vector<double>& promised) {
    constexpr double kUncertain = 0.8;
    double sum = 0.0, close = 0.0, count = 0.0;
    for (std::size_t i = 0; i < p.names.size(); ++i) {
      const auto at = std::find(both.names.begin(), both.names.end(), p.names[i]) - both.names.begin();
      REQUIRE(at < static_cast<std::ptrdiff_t>(both.names.size()));
      if (promised[i] > kUncertain * p.now[i]) continue;
      const double log = std::log(both.standard_errors[at] / promised[i]);
      close += std::abs(log) < std::log(1.5) ? 1.0 : 0.0;
      sum += log, count += 1.0;
    }
    MESSAGE(close, " of ", count, " within 1.5; found over promised ", std::exp(sum / count));
    CHECK(close >= 0.8 * count);
    CHECK(std::abs(sum) < count * std::log(1.2));
    return count;
  };
  CHECK(compare(after([&](double t) { return planning::base_at(result.motion, t); }), p.excited) >= 4);

  // recorded alone: errors of stiffness, damping and drag under either motion, a few noise seeds
  const auto error = [&](const dynamics::BaseFunction& motion) {
    double sum = 0.0;
    for (std::uint64_t seed = 10; seed < 14; ++seed) {
      const Recording recording = record(model, motion, 4.0, seed);
      const dynamics::Parameters q =
          identification::identify(model.chain, recording.base, recording.states, options).parameters;
      for (const double log : {std::log(q.stiffness[2] / kStiffness), std::log(q.damping[2] / kDamping),
                               std::log(q.air_quadratic[2] / model.parameters.air_quadratic[2])})
        sum += log * log;
    }
    return std::sqrt(sum / 12.0);
  };
  const double gentle_error = error(gentle),
               excited_error = error([&](double t) { return planning::base_at(result.motion, t); });
  MESSAGE("RMS log error ", gentle_error, " under the old motion, ", excited_error, " under the proposed one");
  CHECK(excited_error < 0.7 * gentle_error);
}

TEST_CASE("a forecast spreads as far as the ropes that the covariance allows do") {
  const dynamics::Model model = rope();
  const std::vector<dynamics::Unknown> unknowns{{dynamics::Quantity::stiffness},
                                                {dynamics::Quantity::damping},
                                                {dynamics::Quantity::drag},
                                                {dynamics::Quantity::rest_angle, 1},
                                                {dynamics::Quantity::rest_angle, 3}};
  math::MatrixX root = math::MatrixX::Zero(5, 5);
  root.diagonal() << 0.05, 0.1, 0.1, 0.01, 0.01;
  root(1, 0) = 0.05, root(4, 3) = -0.008;
  std::vector<double> times;
  for (int k = 0; k <= 60; ++k) times.push_back(k / 30.0);
  const dynamics::InitialState start{0.0, dynamics::static_equilibrium(model, gentle(0.0).pose).theta,
                                     VectorX::Zero(5)};
  const excitation::Forecast forecast =
      excitation::forecast(model, unknowns, root * root.transpose(), gentle, start, times, 1e-3);

  constexpr int kRopes = 200;
  const std::vector<chain::MaterialPoint> points = chain::shape_points(model.chain, true);
  const auto places = [&](const VectorX& theta) {
    const auto motions = chain::link_motions(model.chain, theta, {});
    math::MatrixX out(3, points.size());
    for (std::size_t i = 0; i < points.size(); ++i)
      out.col(static_cast<Eigen::Index>(i)) = motions[points[i].link] * points[i].home;
    return out;
  };
  core::Random random(5);
  std::vector<double> square(times.size(), 0.0);
  for (int i = 0; i < kRopes; ++i) {
    VectorX drawn(5);
    for (double& x : drawn) x = random.normal();
    const dynamics::Model other =
        dynamics::make_model(model.chain, dynamics::moved(model.chain, model.parameters, unknowns, root * drawn));
    const chain::States states = dynamics::rollout(other, gentle, start, times);
    for (std::size_t k = 0; k < times.size(); ++k)
      square[k] += (places(states.theta[k]) - places(forecast.states.theta[k])).squaredNorm() /
                   static_cast<double>(points.size() * kRopes);
  }
  const double spread = std::sqrt(*std::max_element(square.begin(), square.end()));
  MESSAGE("drawn ", 1e3 * spread, " mm, forecast ", 1e3 * forecast.spread, " mm");
  CHECK(forecast.spread > 0.9 * spread);  // 200 ropes know it to 5 %
  CHECK(forecast.spread < 1.1 * spread);
}

TEST_CASE("requests that cannot be met are refused") {
  excitation::Problem problem;
  problem.model = rope();
  problem.initial = {0.0, VectorX::Zero(5), VectorX::Zero(5)};
  CHECK_THROWS_AS(excitation::excite(problem, {}), InputError);  // nothing known
  problem.estimates.names = {"log_stiffness"};
  problem.estimates.covariance = math::MatrixX::Identity(1, 1);
  const auto refused = [&](const std::string& field, const std::function<void(excitation::Options&)>& change) {
    excitation::Options options;
    change(options);
    try {
      excitation::excite(problem, options);
      FAIL("not refused: ", field);
    } catch (const InputError& error) {
      CHECK(error.where == field);
    }
  };
  refused("`duration`", [](excitation::Options& o) { o.duration = -1.0; });
  refused("`noise`", [](excitation::Options& o) { o.noise = NAN; });
  refused("`frame_rate`", [](excitation::Options& o) { o.frame_rate = 1e9; });
  refused("`velocity`", [](excitation::Options& o) { o.limits.velocity = 0.0; });
  refused("`yaw_jerk`", [](excitation::Options& o) { o.limits.yaw_jerk = -1.0; });
}
