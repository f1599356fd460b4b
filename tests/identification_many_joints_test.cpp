// Chains of many joints: from the parameters of few, and smoothly.
#include <doctest/doctest.h>
#include <algorithm>
#include <cmath>

#include "chainsplat/dynamics/rod.h"
#include "src/identification/coarse.h"

using namespace chainsplat;
using namespace chainsplat::identification;
using math::MatrixX;
using math::Vector3;
using math::VectorX;

namespace {

constexpr double kLength = 0.6, kMass = 0.12, kBending = 4e-3, kRetards = 0.06;  // m, kg, N m^2, s
constexpr double kCurvature = 0.8;                                               // 1/m, natural

// A uniform, naturally bent rod that hangs.
dynamics::Parameters rod(const chain::Chain& chain) {
  const int links = chain.links() - 1, n = chain.angles();
  dynamics::Parameters p;
  p.link_mass.assign(links, kMass / links);
  for (auto* zeros : {&p.viscous_friction, &p.coulomb_friction, &p.air_linear}) zeros->assign(links, 0.0);
  p.air_quadratic.assign(links, 0.02 * kLength / links);
  for (int k = 0; k < n; ++k) {
    const dynamics::RodJoint joint = dynamics::rod_joint(chain, chain.child_link[k], kBending, 0.0);
    p.stiffness.push_back(joint.stiffness), p.damping.push_back(kRetards * joint.stiffness);
    p.rest_angle.push_back(kCurvature * chain::bent_length(chain, chain.child_link[k]));
  }
  p.radius = 0.01;
  p.substeps = 8;
  return p;
}

chain::Chain hanging(int joints, chain::Bending bending) {
  return chain::make_chain(kLength, 0.02, -Vector3::UnitZ(), Vector3::UnitY(), joints, bending, false);
}

Start at_rest(const chain::Chain& chain) {
  const VectorX zero = VectorX::Zero(chain.angles());
  return {zero, zero, VectorX::Constant(chain.angles(), 0.02)};
}

}  // namespace

TEST_CASE("only chains of many joints have one of few beside them, of the same rope") {
  CHECK_FALSE(with_few_joints(hanging(16, chain::Bending::spatial), {}));
  const chain::Chain many =
      chain::make_chain(kLength, 0.02, -Vector3::UnitZ(), Vector3::UnitY(), 64, chain::Bending::spatial, false, 0.05);
  const auto few = with_few_joints(many, {});
  REQUIRE(few);
  CHECK(few->links() < 20);
  CHECK(few->angles() == 2 * (few->links() - 1));
  CHECK(few->length == many.length);
  CHECK(few->link_start(1) == many.link_start(1));
  CHECK_FALSE(with_few_joints(
      chain::make_chain(kLength, 0.02, -Vector3::UnitZ(), Vector3::UnitY(), 40, chain::Bending::spatial, true), {}));
  Options paper;
  paper.paper = true;
  CHECK_FALSE(with_few_joints(many, paper));
}

TEST_CASE("the parameters of few joints and those that follow for many are one rope's") {
  for (const auto bending : {chain::Bending::planar, chain::Bending::spatial}) {
    const chain::Chain many = hanging(48, bending);
    const chain::Chain few = *with_few_joints(many, {});
    Options options;
    options.mass = kMass;
    const Unknowns of_few = make_unknowns(few, options, at_rest(few)),
                   of_many = make_unknowns(many, options, at_rest(many));
    VectorX p = of_few.mean;
    p[of_few.first(dynamics::Quantity::stiffness)] += 0.7;
    p[of_few.first(dynamics::Quantity::damping)] -= 0.4;
    p[of_few.first(dynamics::Quantity::tip_mass)] += 0.3;
    // stiffer, heavier and more bent toward the free end, in proportion
    const auto slope = [&](dynamics::Quantity quantity, double by, const auto& arclength) {
      for (int i = 0; i < of_few.size(); ++i)
        if (of_few.list[i].quantity == quantity) p[i] += by * arclength(of_few.list[i].index);
    };
    const auto start = [&](int index) { return few.link_start(index + 1); };
    slope(dynamics::Quantity::joint_stiffness, 0.5, start);
    slope(dynamics::Quantity::link_mass, 0.4,
          [&](int index) { return start(index) + 0.5 * kLength / (few.links() - 1); });
    for (int i = 0; i < of_few.size(); ++i)
      if (of_few.list[i].quantity == dynamics::Quantity::rest_angle) {
        const int joint = few.child_link[of_few.list[i].index];
        p[i] = kCurvature * few.link_start(joint) * chain::bent_length(few, joint);
      }
    const VectorX q = start_from(few, of_few, p, many, of_many);
    const dynamics::Parameters coarse = apply(few, of_few, p).parameters, fine = apply(many, of_many, q).parameters;
    CHECK(dynamics::total_mass(fine) == doctest::Approx(dynamics::total_mass(coarse)));
    CHECK(fine.tip_mass == doctest::Approx(coarse.tip_mass));
    const double last = few.link_start(few.links() - 1);  // beyond nothing is told
    for (int k = 0; k < many.angles(); ++k) {
      const int joint = many.child_link[k];
      const double s = many.link_start(joint), length = chain::bent_length(many, joint);
      if (joint == 1 || s > last) continue;
      const int axis = bending == chain::Bending::spatial ? k % 2 : 0;
      const int there = bending == chain::Bending::spatial ? 2 + axis : 1;  // the second joint of the few
      const double expected =
          coarse.stiffness[there] * chain::bent_length(few, 2) * std::exp(0.5 * (s - few.link_start(2)));
      CHECK(fine.stiffness[k] * length == doctest::Approx(expected));
      CHECK(fine.damping[k] * length == doctest::Approx(coarse.damping[there] * chain::bent_length(few, 2)));
      CHECK(fine.rest_angle[k] / length == doctest::Approx(kCurvature * s));
    }
  }
}

TEST_CASE("about another rod the same motion has other unknowns") {
  for (const auto bending : {chain::Bending::planar, chain::Bending::spatial}) {
    const chain::Chain chain = hanging(12, bending);
    Options options;
    options.mass = kMass;
    const Rod soft{1e-4, 0.3}, stiff{5e-3, 0.3};
    const Unknowns before = make_unknowns(chain, options, at_rest(chain), {}, soft),
                   now = make_unknowns(chain, options, at_rest(chain), {}, stiff);
    VectorX p = before.mean, moved = p;
    keep_grasp(before, now, moved);
    CHECK((moved - p).cwiseAbs().maxCoeff() > 0.1);
    const dynamics::Parameters a = apply(chain, before, p).parameters, b = apply(chain, now, moved).parameters;
    for (int k = 0; k < chain.angles(); ++k) {
      CHECK(b.stiffness[k] == doctest::Approx(a.stiffness[k]).epsilon(1e-12));
      CHECK(b.damping[k] == doctest::Approx(a.damping[k]).epsilon(1e-12));
    }
    CHECK(b.link_mass == a.link_mass);
  }
}

TEST_CASE("derivatives along smooth modes are those of the parameters") {
  const chain::Chain chain = hanging(40, chain::Bending::spatial);
  Options options;
  options.mass = kMass;
  const Unknowns u = make_unknowns(chain, options, at_rest(chain), {true, true});
  const MatrixX modes = smooth_modes(chain, u);
  CHECK(modes.cols() < 200);
  CHECK(modes.rows() == u.size());
  for (Eigen::Index i = 0; i < modes.rows(); ++i) CHECK(modes.row(i).cwiseAbs().sum() > 0.1);  // nothing is held
  const VectorX p = u.mean;
  const std::vector<dynamics::Tangent> found = along(tangents(chain, u, p), modes);
  REQUIRE(found.size() == static_cast<std::size_t>(modes.cols()));
  constexpr double kStep = 1e-6;
  for (Eigen::Index mode = 0; mode < modes.cols(); ++mode) {
    const State plus = apply(chain, u, p + kStep * modes.col(mode)),
                minus = apply(chain, u, p - kStep * modes.col(mode));
    const auto compare = [&](const std::vector<double>& a, const std::vector<double>& b,
                             const std::vector<double>& slope) {
      for (std::size_t k = 0; k < a.size(); ++k) {
        const double expected = (a[k] - b[k]) / (2.0 * kStep);
        CHECK(std::abs((slope.empty() ? 0.0 : slope[k]) - expected) < 1e-7 * (1.0 + std::abs(expected)));
      }
    };
    const dynamics::Tangent& t = found[static_cast<std::size_t>(mode)];
    compare(plus.parameters.stiffness, minus.parameters.stiffness, t.stiffness);
    compare(plus.parameters.damping, minus.parameters.damping, t.damping);
    compare(plus.parameters.rest_angle, minus.parameters.rest_angle, t.rest_angle);
    compare(plus.parameters.link_mass, minus.parameters.link_mass, t.link_mass);
    compare(plus.parameters.bending_friction, minus.parameters.bending_friction, t.bending_friction);
    compare(plus.parameters.torsional_stiffness, minus.parameters.torsional_stiffness, t.torsional_stiffness);
    CHECK(t.tip_mass == doctest::Approx((plus.parameters.tip_mass - minus.parameters.tip_mass) / (2.0 * kStep)));
    const VectorX theta = (plus.initial.theta - minus.initial.theta) / (2.0 * kStep);
    CHECK((t.theta.size() ? VectorX(t.theta - theta) : theta).cwiseAbs().maxCoeff() < 1e-7);
  }
}

// A rope of many joints is identified twice, from whole recordings: of the suite "whole".
TEST_CASE("a rope of many joints is identified: its stiffness, its motion, and again from markers" *
          doctest::test_suite("whole")) {
  const chain::Chain chain = hanging(40, chain::Bending::planar);
  const dynamics::Parameters truth = rod(chain);
  std::vector<trajectory::Sample> samples;
  for (int k = 0; k <= 400; ++k) {
    const double t = k / 120.0, ease = 1.0 - std::exp(-std::pow(t / 0.4, 3));
    samples.push_back({t, {math::Matrix3::Identity(), Vector3(0.12 * ease * std::sin(2 * M_PI * 0.7 * t), 0, 1)}});
  }
  const trajectory::Trajectory base = trajectory::fit(samples, "test");
  const dynamics::Model model = dynamics::make_model(chain, truth);
  std::vector<double> times;
  for (int k = 0; k < 75; ++k) times.push_back(k / 30.0);
  const VectorX rest = dynamics::static_equilibrium(model, base.pose(0.0)).theta;
  const chain::States clean = dynamics::rollout(model, base, {0.0, rest, VectorX::Zero(chain.angles())}, times);
  chain::States seen = clean;
  core::Random random(3);
  for (VectorX& angles : seen.theta)
    for (double& angle : angles) angle += 0.003 * random.normal();
  Options options;
  options.mass = kMass;
  const auto check = [&](const Result& result) {
    REQUIRE(result.estimates.names.size() == static_cast<std::size_t>(result.estimates.covariance.rows()));
    const auto value = [&](const std::string& name) {
      const auto& names = result.estimates.names;
      return static_cast<std::size_t>(std::find(names.begin(), names.end(), name) - names.begin());
    };
    const std::size_t stiffness = value("log_stiffness"), damping = value("log_damping");
    const double joint = kBending / mean_bent_length(chain);
    CHECK(std::abs(result.estimates.values[stiffness] - std::log(joint)) <
          3.0 * result.estimates.standard_errors[stiffness]);
    CHECK(std::abs(result.estimates.values[damping] - std::log(kRetards * joint)) <
          3.0 * result.estimates.standard_errors[damping]);
    CHECK(result.estimates.standard_errors[stiffness] < 0.25);
    double squares = 0.0;
    for (std::size_t k = 0; k < times.size(); ++k)
      squares += (chain::nodes(chain, chain::link_motions(chain, result.rollout.theta[k], {})) -
                  chain::nodes(chain, chain::link_motions(chain, clean.theta[k], {})))
                     .colwise()
                     .squaredNorm()
                     .mean();
    CHECK(std::sqrt(squares / static_cast<double>(times.size())) < 1.5e-3);  // m; noise alone displaces nodes by more
  };
  const Result from_states = identify(chain, base, seen, options);
  check(from_states);
  REQUIRE(from_states.estimates.solver);
  CHECK(solve::converged(*from_states.estimates.solver));

  Markers markers;
  markers.deviation = 1e-3;
  markers.time = times;
  markers.arclengths = {0.15, 0.3, 0.45, 0.6};
  for (std::size_t k = 0; k < times.size(); ++k) {
    markers.world.push_back(
        chain::centerline(chain, chain::link_motions(chain, clean.theta[k], base.pose(times[k])), markers.arclengths));
    for (double& x : markers.world.back().reshaped()) x += markers.deviation * random.normal();
  }
  check(identify(chain, base, markers, options));
}
