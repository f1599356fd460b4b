// Recordings that are too long for their angles: windows of them are fitted.
#include <doctest/doctest.h>
#include <algorithm>
#include <cmath>

#include "chainsplat/identification.h"
#include "src/identification/windows.h"

using namespace chainsplat;
using namespace chainsplat::identification;
using math::Vector3;
using math::VectorX;

namespace {

constexpr double kRate = 30.0;                 // frames a second
constexpr double kFrom = 10.0, kUntil = 15.0;  // s, while the grasp moves

// At rest but from kFrom to kUntil, when it goes to and fro by 8 cm at 0.8 Hz.
double place(double t) {
  if (t <= kFrom || t >= kUntil) return 0.0;
  const double s = std::sin(M_PI * (t - kFrom) / (kUntil - kFrom));
  return 0.08 * s * s * std::sin(2.0 * M_PI * 0.8 * t);
}

struct Scene {
  chain::Chain chain;
  dynamics::Parameters truth;
  trajectory::Trajectory base;
  chain::States clean, seen;
};

// A rope of four joints that hangs for `seconds` and is let go from the side at first.
Scene scene(double seconds) {
  Scene s;
  s.chain = chain::make_chain(0.3, 0.02, -Vector3::UnitZ(), Vector3::UnitY(), 4, chain::Bending::planar, false);
  const int n = s.chain.angles(), links = s.chain.links() - 1;
  dynamics::Parameters& p = s.truth;
  p.link_mass.assign(links, 0.06 / links);
  for (auto* zeros : {&p.viscous_friction, &p.coulomb_friction, &p.air_linear}) zeros->assign(links, 0.0);
  p.air_quadratic.assign(links, 0.0144 * 0.3 / links);
  p.stiffness.assign(n, 0.012), p.damping.assign(n, 8e-4), p.rest_angle.assign(n, 0.0);
  p.stiffness[0] *= 2.0, p.damping[0] *= 2.0;
  p.radius = 0.01;
  p.substeps = 16;
  std::vector<trajectory::Sample> samples;
  for (int k = 0; k <= 120 * (seconds + 0.1); ++k)
    samples.push_back({k / 120.0, {math::Matrix3::Identity(), Vector3(place(k / 120.0), 0, 0.5)}});
  s.base = trajectory::fit(samples, "test");
  std::vector<double> times;
  for (int k = 0; k < kRate * seconds; ++k) times.push_back(k / kRate);
  s.clean = dynamics::rollout(dynamics::make_model(s.chain, p), s.base,
                              {0.0, VectorX::Constant(n, 0.05), VectorX::Zero(n)}, times);
  s.seen = s.clean;
  core::Random random(3);
  for (VectorX& angles : s.seen.theta)
    for (int k = 0; k < n; ++k) angles[k] += 0.3 * M_PI / 180.0 * random.normal();
  return s;
}

double largest_distance(const chain::Chain& chain, const chain::States& a, const chain::States& b) {
  double largest = 0.0;
  for (std::size_t k = 0; k < a.theta.size(); ++k) {
    const math::MatrixX off = chain::nodes(chain, chain::link_motions(chain, a.theta[k], {})) -
                              chain::nodes(chain, chain::link_motions(chain, b.theta[k], {}));
    largest = std::max(largest, off.colwise().norm().maxCoeff());
  }
  return largest;
}

}  // namespace

TEST_CASE("windows are where the rope moves, apart, and as long as asked for") {
  const Scene s = scene(20.0);
  const std::size_t all = s.seen.time.size();
  const auto whole = windows_of(s.seen, all);
  REQUIRE(whole.size() == 1);
  CHECK(whole[0].size() == all);
  CHECK(whole[0].back() == all - 1);

  const auto windows = windows_of(s.clean, 210);  // 7 s: two windows of 3.5 s
  REQUIRE(windows.size() == 2);
  CHECK(windows[0].front() == 0);
  for (const auto& window : windows) {
    CHECK(window.size() == 105);
    CHECK(window.back() - window.front() == 104);
  }
  CHECK(windows[1].front() > windows[0].back());
  CHECK(s.seen.time[windows[1].front()] < kUntil - 1.0);
  CHECK(s.seen.time[windows[1].back()] > kFrom + 2.0);

  const auto few = windows_of(s.clean, 10);
  REQUIRE(few.size() == 1);
  CHECK(few[0].size() == 10);

  chain::States fast;  // 120 frames a second
  for (int k = 0; k < 2400; ++k)
    fast.time.push_back(k / 120.0), fast.theta.push_back(VectorX::Constant(1, std::sin(k)));
  const auto thinned = windows_of(fast, 600);  // at 30 frames a second everything fits
  REQUIRE(thinned.size() == 1);
  CHECK(thinned[0].size() == 600);
  CHECK(thinned[0][1] == 4);
  const auto some = windows_of(fast, 1000);  // no more are left out than that needs
  REQUIRE(some.size() == 1);
  CHECK(some[0][1] == 3);
}

// A long recording is identified four times: of the suite "whole".
TEST_CASE("windows of a long recording tell what the rope is, and the rollout is that of all of it" *
          doctest::test_suite("whole")) {
  const Scene s = scene(20.0);
  Options options;
  options.mass = 0.06;
  const auto numbers = static_cast<std::size_t>(s.chain.angles() * s.chain.angles());
  options.most_numbers = 210 * numbers;
  const Result windows = identify(s.chain, s.base, s.seen, options);
  CHECK(windows.rollout.time == s.seen.time);
  CHECK(windows.parameters.stiffness[2] / 0.012 == doctest::Approx(1.0).epsilon(0.1));
  CHECK(windows.parameters.damping[2] / 8e-4 == doctest::Approx(1.0).epsilon(0.25));
  CHECK(largest_distance(s.chain, windows.rollout, s.clean) < 2e-3);
  CHECK(windows.initial.time == 0.0);
  CHECK(windows.initial.theta[0] == doctest::Approx(0.05).epsilon(0.1));

  options.most_numbers = 600 * numbers;  // everything: the same rope, known better
  const Result whole = identify(s.chain, s.base, s.seen, options);
  REQUIRE(whole.estimates.names == windows.estimates.names);
  for (const char* name : {"log_stiffness", "log_damping"}) {
    const auto& names = whole.estimates.names;
    const auto at = std::find(names.begin(), names.end(), name) - names.begin();
    REQUIRE(at < static_cast<std::ptrdiff_t>(names.size()));
    CAPTURE(name);
    CHECK(whole.estimates.standard_errors[at] < windows.estimates.standard_errors[at]);
    CHECK(std::abs(whole.estimates.values[at] - windows.estimates.values[at]) <
          3.0 * windows.estimates.standard_errors[at]);
  }

  // the same of markers, and of two recordings that share what is fitted
  Markers markers;
  markers.arclengths = {0.1, 0.2, 0.3};
  markers.time = s.seen.time;
  markers.deviation = 1e-3;
  for (std::size_t k = 0; k < s.seen.time.size(); ++k) {
    const auto motions = chain::link_motions(s.chain, s.clean.theta[k], s.base.pose(s.seen.time[k]));
    math::MatrixX points(3, 3);
    for (int i = 0; i < 3; ++i) {
      const chain::MaterialPoint point = chain::centerline_point(s.chain, markers.arclengths[i]);
      points.col(i) = motions[point.link] * point.home;
    }
    markers.world.push_back(points);
  }
  options.most_numbers = 210 * numbers;
  const Result marked = identify(s.chain, s.base, markers, options);
  CHECK(marked.rollout.time == s.seen.time);
  CHECK(largest_distance(s.chain, marked.rollout, s.clean) < 2e-3);

  const std::vector<Recording> recordings{{s.base, s.seen}, {s.base, s.clean}};
  options.most_numbers = 420 * numbers;
  const std::vector<Result> both = identify(s.chain, recordings, options);
  REQUIRE(both.size() == 2);
  for (const Result& result : both) {
    CHECK(result.rollout.time == s.seen.time);
    CHECK(largest_distance(s.chain, result.rollout, s.clean) < 2e-3);
    CHECK(result.node_rms < 1.5 * result.alone_rms);
  }
}
