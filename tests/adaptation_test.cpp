#include "chainsplat/adaptation.h"
#include "chainsplat/dynamics/parametrization.h"

#include <doctest/doctest.h>
#include <cmath>
#include <limits>

using namespace chainsplat;
using math::Vector3;
using math::VectorX;

namespace {

using dynamics::Quantity;
const std::vector<dynamics::Unknown> kUnknowns = {
    {Quantity::stiffness}, {Quantity::damping}, {Quantity::drag}, {Quantity::theta, 0}};

dynamics::Parameters rope_parameters(const chain::Chain& chain) {
  const auto fill = [](int count, double value) { return std::vector<double>(count, value); };
  const int links = chain.links() - 1, n = chain.angles();
  dynamics::Parameters p;
  p.link_mass = fill(links, 0.06 / links), p.viscous_friction = p.coulomb_friction = p.air_linear = fill(links, 0.0);
  p.air_quadratic = fill(links, 0.0144 * chain.length / links);
  p.stiffness = fill(n, 0.012), p.damping = fill(n, 6e-4), p.rest_angle = fill(n, 0.0);
  p.radius = 0.01;
  return p;
}

trajectory::BaseMotion base_at(double t) {
  trajectory::BaseMotion base;
  const double a = 0.08, w = 2.0 * M_PI * 0.9;
  base.pose.translation.x() = a * std::sin(w * t);
  base.velocity[3] = a * w * std::cos(w * t);
  base.acceleration[3] = -a * w * w * std::sin(w * t);
  return base;
}

dynamics::Estimates estimates(double sd) {
  dynamics::Estimates e;
  for (const dynamics::Unknown& unknown : kUnknowns) e.names.push_back(dynamics::name_of(unknown));
  e.values = {std::log(0.012), std::log(6e-4), std::log(0.0144), 0.0};
  e.standard_errors.assign(4, sd);
  e.covariance = sd * sd * math::MatrixX::Identity(4, 4);
  return e;
}

}  // namespace

TEST_CASE("adapted parameters follow a rope that changes half-way, and without forgetting they lag") {
  const chain::Chain chain =
      chain::make_chain(0.3, 0.02, -Vector3::UnitZ(), Vector3::UnitY(), 5, chain::Bending::planar, false);
  const dynamics::Parameters before = rope_parameters(chain);
  const dynamics::Parameters after =
      dynamics::moved(chain, before, kUnknowns, (VectorX(4) << std::log(1.5), std::log(0.6), 0.0, 0.0).finished());
  const VectorX rest = VectorX::Zero(5);
  constexpr int kFrames = 240;  // 8 s, 20 s
  std::vector<double> first, second;
  for (int k = 0; k <= kFrames; ++k) first.push_back(k / 30.0);
  for (int k = kFrames + 1; k <= 600; ++k) second.push_back(k / 30.0);
  chain::States states = dynamics::rollout(dynamics::make_model(chain, before), base_at, {0.0, rest, rest}, first);
  const chain::States rest_of = dynamics::rollout(dynamics::make_model(chain, after), base_at,
                                                  {first.back(), states.theta.back(), states.thetadot.back()}, second);
  states.time.insert(states.time.end(), rest_of.time.begin(), rest_of.time.end());
  states.theta.insert(states.theta.end(), rest_of.theta.begin(), rest_of.theta.end());

  const auto run = [&](double memory, double& old_error) {
    adaptation::Options options;
    options.memory = memory;
    // a start that is 20 % off
    const dynamics::Parameters start =
        dynamics::moved(chain, before, kUnknowns, (VectorX(4) << 0.2, -0.2, 0.1, 0.0).finished());
    adaptation::ParameterFilter online(chain, start, estimates(0.3), options);
    core::Random random(5);
    const double sigma = 0.5 * M_PI / 180.0;
    for (std::size_t k = 0; k < states.time.size(); ++k) {
      adaptation::Observation seen{states.time[k], states.theta[k], {}, VectorX::Constant(5, sigma)};
      for (double& angle : seen.theta) angle += sigma * random.normal();
      online.observe(seen, base_at);
      if (k == kFrames) old_error = std::log(online.result().parameters.stiffness[2] / before.stiffness[2]);
    }
    CHECK(online.result().used > 0.95 * static_cast<double>(states.time.size()));
    CHECK(online.result().estimates.values[0] ==
          doctest::Approx(std::log(0.012) + std::log(online.result().parameters.stiffness[2] / start.stiffness[2])));
    CHECK(online.result().estimates.standard_errors[0] < 0.2);
    CHECK(online.result().estimates.values[3] == 0.0);
    return online.result().parameters;
  };
  double old_error = 1.0, old_error_kept = 1.0;
  const dynamics::Parameters followed = run(3.0, old_error);
  const dynamics::Parameters kept = run(std::numeric_limits<double>::infinity(), old_error_kept);
  const auto error = [&](const dynamics::Parameters& p) { return std::log(p.stiffness[2] / after.stiffness[2]); };
  MESSAGE("stiffness before ", old_error, " after ", error(followed), " kept ", error(kept), "; damping after ",
          std::log(followed.damping[2] / after.damping[2]));
  CHECK(std::abs(old_error) < 0.05);
  CHECK(std::abs(old_error_kept) < 0.05);
  CHECK(std::abs(error(followed)) < 0.05);
  CHECK(std::abs(std::log(followed.damping[2] / after.damping[2])) < 0.15);
  CHECK(std::abs(error(kept)) > 0.08);
}

TEST_CASE("frames that do not fit are refused or left out") {
  const chain::Chain chain =
      chain::make_chain(0.3, 0.02, -Vector3::UnitZ(), Vector3::UnitY(), 3, chain::Bending::planar, false);
  const dynamics::Parameters p = rope_parameters(chain);
  adaptation::ParameterFilter online(chain, p, estimates(0.3), {});
  const VectorX rest = VectorX::Zero(3);
  CHECK_THROWS_AS(online.observe({0.0, VectorX::Zero(4), {}, {}}, base_at), InputError);
  CHECK_THROWS_AS(online.observe({0.0, rest, {}, VectorX::Constant(3, -0.01)}, base_at), InputError);
  CHECK(online.observe({0.0, rest, rest, {}}, base_at));
  CHECK_THROWS_AS(online.observe({0.0, rest, {}, {}}, base_at), InputError);
  CHECK_FALSE(online.observe({1.0 / 30, VectorX::Constant(3, 2.0), {}, {}}, base_at));  // no rope turns that fast
  CHECK(online.result().left_out == 1);
  CHECK(online.observe({1.0, rest, {}, {}}, base_at));  // after a gap
  CHECK(online.result().restarts == 1);
  CHECK_THROWS_AS(online.observe({1.0 + 1.0 / 30, rest, {}, VectorX::Constant(3, 1e200)}, base_at), InputError);
  CHECK_THROWS_AS(adaptation::ParameterFilter(chain, p, {}, {}), InputError);
  dynamics::Estimates indefinite = estimates(0.3);
  indefinite.covariance(0, 1) = indefinite.covariance(1, 0) = 1.0;
  CHECK_THROWS_AS(adaptation::ParameterFilter(chain, p, indefinite, {}), InputError);
}
