// The numbers of the page; its pictures are compared with render's by tests/cli/report.sh.
#include "chainsplat/report.h"

#include <doctest/doctest.h>

#include <cmath>
#include <numbers>

#include "chainsplat/dynamics/parametrization.h"
#include "chainsplat/dynamics/rod.h"
#include "small_twin.h"

using namespace chainsplat;

namespace {

const report::Quantity* find(const std::vector<report::Quantity>& all, const std::string& name) {
  for (const report::Quantity& each : all)
    if (each.name == name) return &each;
  return nullptr;
}

dynamics::Estimates independent(const std::vector<std::string>& names, const std::vector<double>& values,
                                const std::vector<double>& errors) {
  dynamics::Estimates e;
  e.names = names;
  e.values = values;
  e.standard_errors = errors;
  e.covariance = math::MatrixX::Zero(names.size(), names.size());
  for (std::size_t i = 0; i < names.size(); ++i) e.covariance(i, i) = errors[i] * errors[i];
  return e;
}

}  // namespace

TEST_CASE("a rigid rod that hangs from a hinge swings as the books say") {
  constexpr double kMass = 0.05, kLength = 0.4, kRadius = 0.01, kDamping = 2e-3, kStiffness = 0.03, kGravity = 9.81;
  twin::Twin twin;
  twin.chain = chain::make_chain(kLength, 2 * kRadius, {0, 0, -1}, {0, 1, 0}, 1, chain::Bending::planar, false);
  dynamics::Parameters p;
  p.link_mass = {kMass};
  p.viscous_friction = p.coulomb_friction = p.air_linear = p.air_quadratic = {0.0};
  p.stiffness = {kStiffness}, p.damping = {kDamping}, p.rest_angle = {0.0};
  p.radius = kRadius;
  twin.parameters = p;
  twin.estimates =
      independent({"log_stiffness", "log_damping"}, {std::log(kStiffness), std::log(kDamping)}, {0.1, 0.2});

  const double inertia = kMass * (kLength * kLength / 3 + kRadius * kRadius / 4);
  const double rate = std::sqrt((kMass * kGravity * kLength / 2 + kStiffness) / inertia);
  const double ratio = kDamping / (2 * inertia * rate);
  const auto all = report::identified(twin);
  const report::Quantity *swing = find(all, "slowest swing"), *damping = find(all, "its damping ratio");
  REQUIRE(swing);
  REQUIRE(damping);
  CHECK(swing->value == doctest::Approx(rate / (2 * std::numbers::pi)).epsilon(1e-9));
  CHECK(damping->value == doctest::Approx(ratio).epsilon(1e-9));
  // d ratio / d log damping = ratio, d ratio / d log stiffness = -ratio/2 kappa / (kappa + m g l/2)
  const double share = kStiffness / (kStiffness + kMass * kGravity * kLength / 2);
  CHECK(*damping->error == doctest::Approx(ratio * std::hypot(0.2, 0.1 * share / 2)).epsilon(1e-4));
  const double bending = find(all, "bending stiffness EI")->value;
  CHECK(dynamics::rod_joint(twin.chain, 1, bending, kMass * kGravity).stiffness == doctest::Approx(kStiffness));
  CHECK(*find(all, "retardation time")->error == doctest::Approx(kDamping / kStiffness * std::hypot(0.1, 0.2)));
  CHECK_FALSE(find(all, "friction coefficient"));
}

TEST_CASE("the rollout's band is that of rollouts with other parameters") {
  twin::Twin twin = test::small_twin();
  const trajectory::Trajectory base = test::moving_base(2.0);
  twin.rollout.time.clear();
  for (int k = 3; k < 20; ++k) twin.rollout.time.push_back(k / 30.0 + 0.001);
  twin.initial->time = 0.1;
  const std::vector<std::string> names{"log_damping", "log_stiffness", "rest_angle_3", "theta_2"};
  twin.estimates = independent(names, {0, 0, 0, 0}, {0.05, 0.03, 0.01, 0.004});
  const std::vector<math::VectorX> band = report::rollout_deviations(twin, base);
  REQUIRE(band.size() == twin.rollout.time.size());

  math::MatrixX squares = math::MatrixX::Zero(twin.chain.angles(), static_cast<Eigen::Index>(band.size()));
  const std::vector<dynamics::Unknown> unknowns = dynamics::unknowns_of(twin.chain, twin.estimates);
  for (std::size_t i = 0; i < unknowns.size(); ++i) {
    chain::States moved[2];
    for (const int side : {0, 1}) {
      const math::VectorX by = math::VectorX::Constant(1, (side ? 1e-3 : -1e-3) * twin.estimates.standard_errors[i]);
      const dynamics::Model model =
          dynamics::make_model(twin.chain, dynamics::moved(twin.chain, *twin.parameters, {&unknowns[i], 1}, by));
      moved[side] =
          dynamics::rollout(model, base, dynamics::moved(*twin.initial, {&unknowns[i], 1}, by), twin.rollout.time);
    }
    for (std::size_t k = 0; k < band.size(); ++k)
      squares.col(static_cast<Eigen::Index>(k)) += ((moved[1].theta[k] - moved[0].theta[k]) / 2e-3).cwiseAbs2();
  }
  for (std::size_t k = 0; k < band.size(); ++k) {
    const math::VectorX truth = squares.col(static_cast<Eigen::Index>(k)).cwiseSqrt();
    CHECK((band[k] - truth).norm() <= 0.03 * truth.norm() + 1e-6);
  }
  // nothing known of the covariance: no band
  twin.estimates.covariance(1, 1) = NAN;
  CHECK(report::rollout_deviations(twin, base).empty());
}

TEST_CASE("a page holds its data, and names in it end no script") {
  report::Contents contents;
  contents.twin = test::small_twin();
  contents.twin.provenance.capture = "</script><b>\xff";
  contents.base = test::moving_base(1.0);
  const std::string page = report::page(contents);
  CHECK(page.find("</script><b>") == std::string::npos);
  CHECK(page.find("\\u003c/script>\\u003cb>") != std::string::npos);
  CHECK(page.find("http") == page.find("http-equiv"));  // nothing from the network
  CHECK(page.find("@DATA@") == std::string::npos);
}
