// The numbers of the page; its pictures are compared with render's by tests/cli/report.sh.
#include "chainsplat/report.h"

#include <doctest/doctest.h>

#include <cmath>
#include <nlohmann/json.hpp>
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
  // nor where the derivatives of all frames would fill the memory; it is not tried
  twin.estimates = independent(names, {0, 0, 0, 0}, {0.05, 0.03, 0.01, 0.004});
  twin.rollout.time.assign(8'000'000, twin.rollout.time.front());
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

TEST_CASE("how large a force is, and how sure that is") {
  force::Estimate e;
  e.force = e.low = e.high = math::Vector3(3.0, 4.0, 0.0);
  e.covariance = math::Vector3(0.01, 0.04, 100.0).asDiagonal();
  report::ForceSize size = report::size_of(e);
  CHECK(size.value == doctest::Approx(5.0));
  CHECK(size.error == doctest::Approx(std::sqrt(0.36 * 0.01 + 0.64 * 0.04)));  // nothing of the component across
  CHECK(size.least == doctest::Approx(5.0 - 2 * size.error));
  CHECK(size.most == doctest::Approx(5.0 + 2 * size.error));
  // friction at rest leaves a box, which reaches beyond zero in x only
  e.low = math::Vector3(-1.0, 2.0, 0.0), e.high = math::Vector3(3.0, 6.0, 0.0);
  size = report::size_of(e);
  CHECK(size.least == doctest::Approx(2.0 - 2 * size.error));
  CHECK(size.most == doctest::Approx(std::hypot(3.0, 6.0) + 2 * size.error));
  // a force of zero has no direction
  e.force = e.low = e.high = math::Vector3::Zero();
  size = report::size_of(e);
  CHECK(size.error == doctest::Approx(10.0));
  CHECK(size.least == 0.0);

  std::vector<force::Estimate> forces(3);
  forces[0].force.x() = 2.0, forces[1].force.x() = 1.0, forces[2].force.x() = 0.5;
  CHECK(report::largest(forces) == nullptr);
  forces[1].touching = forces[2].touching = true;
  CHECK(report::largest(forces) == &forces[1]);
}

namespace {

report::Contents followed_contents(int states) {
  report::Contents contents;
  contents.twin = test::small_twin();
  contents.base = test::moving_base(1.0);
  report::Followed followed;
  for (int k = 0; k < states; ++k) {
    followed.states.time.push_back(k / 30.0);
    followed.states.theta.push_back(math::VectorX::Constant(contents.twin.chain.angles(), 0.1));
    followed.sigma.push_back(math::VectorX::Constant(contents.twin.chain.angles(), 0.01));
    followed.base.emplace_back();
    followed.forces.emplace_back().time = k / 30.0;
  }
  contents.followed = std::move(followed);
  return contents;
}

nlohmann::json data_of(const std::string& page) {
  const std::string begin = "<script type=\"application/json\" id=\"data\">";
  const std::size_t from = page.find(begin) + begin.size();
  return nlohmann::json::parse(page.substr(from, page.find("</script>", from) - from));
}

}  // namespace

TEST_CASE("a page shows what was followed, and its largest force") {
  report::Contents contents = followed_contents(20);
  force::Estimate& push = contents.followed->forces[7];
  push.touching = true;
  push.force = push.low = push.high = math::Vector3(0.3, 0.0, 0.4);
  push.covariance = 1e-4 * math::Matrix3::Identity();
  push.contact.arclength = 0.2, push.arclength_sigma = 0.01;
  const nlohmann::json data = data_of(report::page(contents));
  REQUIRE(data["motions"].size() == 3);
  CHECK(data["motions"][2]["name"] == "followed");
  CHECK(data["motions"][2]["own"] == true);
  CHECK(data["motions"][2]["gap"].get<double>() == doctest::Approx(3.5 / 30.0));
  const nlohmann::json& largest = data["forces"]["largest"];
  CHECK(largest["value"].get<double>() == doctest::Approx(0.5));
  CHECK(largest["error"].get<double>() == doctest::Approx(0.01));
  CHECK(largest["time"].get<double>() == doctest::Approx(7 / 30.0));
  CHECK(data["forces"]["unit"] == "N");
  CHECK(data["forces"]["length"].get<double>() <= 0.8 * 0.3 / 0.5 + 1e-12);  // the arrow stays in the picture

  // nothing touches; no forces; no stream
  push.touching = false;
  CHECK_FALSE(data_of(report::page(contents))["forces"].contains("largest"));
  contents.followed->forces.clear();
  CHECK_FALSE(data_of(report::page(contents)).contains("forces"));
  contents.followed.reset();
  CHECK(data_of(report::page(contents))["motions"].size() == 2);
}

TEST_CASE("of a long stream the page keeps states in equal steps, and all that it says of the largest force") {
  report::Contents contents = followed_contents(30001);
  force::Estimate& push = contents.followed->forces[10001];
  push.touching = true;
  push.force.x() = 0.7;
  const nlohmann::json data = data_of(report::page(contents));
  CHECK(data["motions"][2]["frames"] == 30001);
  CHECK(data["motions"][2]["time"].get<std::string>().size() == 4 * ((7501 * 8 + 2) / 3));  // every fourth, in base64
  CHECK(data["motions"][2]["gap"].get<double>() == doctest::Approx(4 * 3.5 / 30.0));
  CHECK(data["forces"]["largest"]["value"].get<double>() == doctest::Approx(0.7));
}
