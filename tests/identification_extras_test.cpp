// Friction in bending and payloads: asked for by the data, or not.
#include <doctest/doctest.h>
#include <cmath>

#include "chainsplat/dynamics/rod.h"
#include "chainsplat/identification.h"

using namespace chainsplat;
using namespace chainsplat::identification;
using math::MatrixX;
using math::Vector3;
using math::VectorX;

namespace {

constexpr double kRopeMass = 0.3, kRopeLength = 0.5, kStiffness = 0.6;  // kg, rope alone; m; N m/rad
constexpr double kMoment = 0.03, kAngle = 0.02;                         // N m, rad
constexpr double kPayload = 0.2, kReach = 0.08;                         // kg, m
constexpr double kNoise = 5e-4;                                         // m, of a marker's coordinate

struct LoadedScene {
  chain::Chain chain;
  trajectory::Trajectory base;
  Markers markers;
};

// A rope bent aside and let go while its base stands still, then swings a little: six joints, three markers.
LoadedScene make_loaded_scene(double moment, double payload) {
  LoadedScene s;
  s.chain = chain::make_chain(kRopeLength, 0.02, -Vector3::UnitZ(), Vector3::UnitY(), 6, chain::Bending::planar, false);
  dynamics::Parameters p;
  p.link_mass.assign(6, kRopeMass / 6), p.tip_mass = payload, p.tip_length = payload > 0.0 ? kReach : 0.0;
  for (auto* zeros : {&p.viscous_friction, &p.coulomb_friction, &p.air_linear, &p.air_quadratic}) zeros->assign(6, 0.0);
  p.stiffness.assign(6, kStiffness), p.damping.assign(6, 0.01), p.rest_angle.assign(6, 0.03);
  p.stiffness[0] *= 2.0, p.damping[0] *= 2.0;
  p.radius = 0.01;
  p.substeps = 32;
  if (moment > 0.0) {
    p.bending_friction.assign(6, moment), p.bending_friction_angle.assign(6, kAngle);
    p.bending_friction_angle[0] *= 0.5;
  }
  std::vector<trajectory::Sample> samples;
  for (int k = 0; k <= 500; ++k) {
    const double t = k / 120.0, u = std::clamp((t - 2.0) / 1.0, 0.0, 1.0);
    const double x = 0.15 * u * u * u * (10.0 - 15.0 * u + 6.0 * u * u);
    samples.push_back({t, {math::Matrix3::Identity(), Vector3(x, 0, 1)}});
  }
  s.base = trajectory::fit(samples, "test");
  for (int k = 0; k < 120; ++k) s.markers.time.push_back(k / 30.0);
  const dynamics::Model model = dynamics::make_model(s.chain, p);
  dynamics::InitialState start{0.0, VectorX::Constant(6, 0.2), VectorX::Zero(6)};
  start.internal_state = VectorX::Constant(6, 0.9);
  const chain::States states = dynamics::rollout(model, s.base, start, s.markers.time);
  s.markers.arclengths = {0.15, 0.3, 0.5};
  s.markers.deviation = kNoise;
  core::Random random(5);
  for (std::size_t k = 0; k < states.time.size(); ++k) {
    MatrixX seen = chain::centerline(
        s.chain, chain::link_motions(s.chain, states.theta[k], s.base.pose(states.time[k])), s.markers.arclengths);
    for (double& x : seen.reshaped()) x += kNoise * random.normal();
    s.markers.world.push_back(seen);
  }
  return s;
}

Options options_of(double payload) {
  Options options;
  options.mass = kRopeMass + payload;
  return options;
}

// Estimate and standard error.
std::pair<double, double> found(const Result& result, const std::string& name) {
  for (std::size_t i = 0; i < result.estimates.names.size(); ++i)
    if (result.estimates.names[i] == name) return {result.estimates.values[i], result.estimates.standard_errors[i]};
  FAIL("no estimate named " << name);
  return {};
}

double logit(double part) { return std::log(part / (1.0 - part)); }

}  // namespace

TEST_CASE("a rope with friction in bending gets it, and its numbers; one without gets none") {
  const LoadedScene braked = make_loaded_scene(kMoment, 0.0);
  Options options = options_of(0.0);
  options.tip_mass = 0.0;
  const Result result = identify(braked.chain, braked.base, braked.markers, options);
  REQUIRE(!result.parameters.bending_friction.empty());
  const auto [moment, moment_error] = found(result, "log_bending_friction");
  CHECK(std::abs(moment - std::log(kMoment)) < std::max(3.0 * moment_error, 0.05));
  CHECK(moment_error < 0.5);
  CHECK(result.parameters.bending_friction_angle[3] / kAngle == doctest::Approx(1.0).epsilon(0.5));
  CHECK(result.node_rms < 2e-3);
  options.ask_for_more = false;
  const Result smooth = identify(braked.chain, braked.base, braked.markers, options);
  CHECK(smooth.parameters.bending_friction.empty());
  CHECK(smooth.node_rms > 3.0 * result.node_rms);
  // what is expected of a marker's coordinate: its deviation, and half a hundredth of the length for what the chain
  // lacks
  const double expected = std::hypot(kNoise, 0.005 * kRopeLength);
  for (const Result& one : {result, smooth})
    CHECK(one.estimates.misfit == doctest::Approx(one.node_rms / std::sqrt(3.0) / expected).epsilon(1e-6));

  const LoadedScene free = make_loaded_scene(0.0, 0.0);
  options.ask_for_more = true;
  const Result none = identify(free.chain, free.base, free.markers, options);
  CHECK(none.parameters.bending_friction.empty());
  options.ask_for_more = false;
  const Result before = identify(free.chain, free.base, free.markers, options);
  CHECK(none.estimates.values == before.estimates.values);
}

// Identifications of several whole recordings: of the suite "whole".
TEST_CASE("a payload is believed where it was weighed, and found where it was not" * doctest::test_suite("whole")) {
  const LoadedScene s = make_loaded_scene(0.0, kPayload);
  const double part = kPayload / (kRopeMass + kPayload);
  Options options = options_of(kPayload);
  options.tip_mass = kPayload;
  const Result weighed = identify(s.chain, s.base, s.markers, options);
  CHECK(weighed.parameters.tip_mass == doctest::Approx(kPayload).epsilon(2e-3));
  CHECK(weighed.node_rms < 2e-3);
  options.tip_mass_deviation = 0.1 * kPayload;
  const Result about = identify(s.chain, s.base, s.markers, options);
  CHECK(std::abs(about.parameters.tip_mass - kPayload) < 0.3 * kPayload);
  options.tip_mass.reset(), options.tip_mass_deviation = 0.0;
  const Result unknown = identify(s.chain, s.base, s.markers, options);
  const auto [found_part, error] = found(unknown, "logit_tip_mass_fraction");
  CHECK(std::abs(found_part - logit(part)) < std::max(3.0 * error, 0.3));
}

TEST_CASE("how far a payload reaches is used where it is given, and doubted where it is not") {
  const LoadedScene s = make_loaded_scene(0.0, kPayload);
  Options options = options_of(kPayload);
  options.tip_mass = kPayload;
  // log of the stiffness over the true one, and its standard error
  const auto off = [&](const Result& result) {
    const auto [value, error] = found(result, "log_stiffness");
    return std::pair(value - std::log(kStiffness), error);
  };
  options.tip_length = kReach;
  const Result given = identify(s.chain, s.base, s.markers, options);
  CHECK(given.parameters.tip_length == kReach);
  const auto [right, sure] = off(given);
  options.tip_length.reset();
  const Result free = identify(s.chain, s.base, s.markers, options);
  const auto [about, unsure] = off(free);
  const auto [reach, reach_error] = found(free, "log_tip_length");
  options.tip_length = 0.0;
  const auto [wrong, deceived] = off(identify(s.chain, s.base, s.markers, options));
  CHECK(std::abs(right) < 3.0 * sure);
  CHECK(std::abs(about) < 3.0 * unsure);
  CHECK(std::abs(reach - std::log(kReach)) < 3.0 * reach_error);
  CHECK(unsure > 1.15 * sure);
  CHECK(wrong < -3.0 * deceived);  // too soft, and sure of it: what a point would have to be to swing as slowly
}

TEST_CASE("the initial state of a known rope is found from the first marks") {
  const LoadedScene s = make_loaded_scene(kMoment, kPayload);
  Options options = options_of(kPayload);
  options.tip_mass = kPayload;
  const Result result = identify(s.chain, s.base, s.markers, options);
  // begin in the midst of a swing
  constexpr std::size_t kFirst = 10;
  Markers later = s.markers;
  later.time.erase(later.time.begin(), later.time.begin() + kFirst);
  later.world.erase(later.world.begin(), later.world.begin() + kFirst);
  const dynamics::InitialState start = fit_initial(s.chain, result.parameters, s.base, later);
  CHECK(start.time == later.time[0]);
  CHECK(start.thetadot.norm() > 0.5);
  const dynamics::Model model = dynamics::make_model(s.chain, result.parameters);
  const auto off = [&](const dynamics::InitialState& from) {
    const chain::States states = dynamics::rollout(model, s.base, from, later.time);
    double sum = 0.0;
    for (std::size_t k = 0; k < later.time.size(); ++k)
      sum += (chain::centerline(s.chain, chain::link_motions(s.chain, states.theta[k], s.base.pose(later.time[k])),
                                {kRopeLength}) -
              later.world[k].col(2))
                 .squaredNorm();
    return std::sqrt(sum / later.time.size());
  };
  dynamics::InitialState still = start;
  still.thetadot.setZero();
  CHECK(off(start) < 4e-3);
  CHECK(off(still) > 3.0 * off(start));
  // parameters that ask for finer steps get them, as in a rollout: friction that is as good as rigid at small bends
  dynamics::Parameters rigid = result.parameters;
  rigid.substeps = 1;
  for (double& angle : rigid.bending_friction_angle) angle *= 0.03;
  chain::States states;
  const dynamics::Model coarse = dynamics::make_model(s.chain, rigid);
  REQUIRE(!dynamics::simulate(
      coarse, dynamics::sample_base([&](double t) { return s.base.at(t); }, start.time, later.time, 1), start, states));
  CHECK_NOTHROW(fit_initial(s.chain, rigid, s.base, later));
}

// Identifications of several whole recordings: of the suite "whole".
TEST_CASE("how stiff a rope is in torsion is found where it bends in space" * doctest::test_suite("whole")) {
  constexpr int kJoints = 5;
  constexpr double kRatio = 0.45, kAngleNoise = 2e-3;  // GJ/EI, far below a round rod's; rad
  const chain::Chain chain =
      chain::make_chain(0.4, 0.02, -Vector3::UnitZ(), Vector3::UnitY(), kJoints, chain::Bending::spatial, false, 0.0);
  dynamics::Parameters p;
  p.link_mass.assign(kJoints, 0.02);
  for (auto* zeros : {&p.viscous_friction, &p.coulomb_friction, &p.air_linear}) zeros->assign(kJoints, 0.0);
  p.air_quadratic.assign(kJoints, 0.001);
  constexpr double kBending = 8e-4, kDampingTime = 0.06;  // N m^2, s
  const double tension = dynamics::grasp_tension(p, p.gravity);
  for (int k = 0; k < 2 * kJoints; ++k) {
    const dynamics::RodJoint rod = dynamics::rod_joint(chain, k / 2 + 1, kBending, tension);
    p.stiffness.push_back(rod.stiffness), p.damping.push_back(kDampingTime * rod.slope);
    p.rest_angle.push_back(0.35 * std::cos(1.1 * k));
  }
  for (int j = 1; j <= kJoints; ++j) p.torsional_stiffness.push_back(kRatio * kBending / chain::bent_length(chain, j));
  p.radius = 0.01;
  p.substeps = 16;
  std::vector<trajectory::Sample> samples;
  for (int k = 0; k <= 480; ++k) {  // a circle of 8 cm that begins and ends at rest
    const double t = k / 120.0, u = std::clamp(t / 0.5, 0.0, 1.0), in = u * u * u * (10.0 - 15.0 * u + 6.0 * u * u);
    samples.push_back(
        {t, {math::Matrix3::Identity(), Vector3(0.08 * in * std::sin(7.0 * t), 0.08 * in * std::cos(7.0 * t), 1)}});
  }
  const trajectory::Trajectory base = trajectory::fit(samples, "test");
  const dynamics::Model model = dynamics::make_model(chain, p);
  dynamics::InitialState start{0.0, dynamics::static_equilibrium(model, base.pose(0.0)).theta,
                               VectorX::Zero(2 * kJoints)};
  std::vector<double> times;
  for (int k = 0; k < 115; ++k) times.push_back(k / 30.0);
  const chain::States truth = dynamics::rollout(model, base, start, times);
  chain::States seen = truth;
  core::Random random(3);
  for (VectorX& theta : seen.theta) {
    for (double& angle : theta) angle += kAngleNoise * random.normal();
    seen.covariance.push_back(MatrixX::Identity(2 * kJoints, 2 * kJoints) * kAngleNoise * kAngleNoise);
  }
  Options options;
  options.mass = 0.1;
  const Result result = identify(chain, base, seen, options);
  REQUIRE(result.parameters.torsional_stiffness.size() == kJoints);
  const auto [ratio, error] = found(result, "log_torsional_stiffness_ratio");
  CHECK(std::abs(ratio - std::log(kRatio)) < std::max(3.0 * error, 0.05));
  CHECK(error < 0.25);
  const auto off = [&](const Result& of) {
    double square = 0.0;
    for (std::size_t k = 0; k < times.size(); ++k) square += (of.rollout.theta[k] - truth.theta[k]).squaredNorm();
    return std::sqrt(square / static_cast<double>(times.size() * 2 * kJoints));
  };
  CHECK(off(result) < 1.5 * kAngleNoise);
  // left out, as on a table or in a plane, it is missed
  options.fit_torsion = false;
  const Result without = identify(chain, base, seen, options);
  CHECK(without.parameters.torsional_stiffness.empty());
  CHECK(off(without) > 4.0 * off(result));
}
