#include "chainsplat/identification.h"
#include "src/math/decompositions.h"

#include <doctest/doctest.h>
#include <algorithm>
#include <cmath>
#include <sstream>

using namespace chainsplat;
using namespace chainsplat::identification;
using math::MatrixX;
using math::Pose;
using math::Vector3;
using math::VectorX;

namespace {

// A grasp that swings along x by 15 cm at 0.4 Hz, eased in, sampled at 120 Hz.
trajectory::Trajectory swing(double seconds, const Vector3& start) {
  std::vector<trajectory::Sample> samples;
  for (int k = 0; k <= 120 * seconds; ++k) {
    const double t = k / 120.0, ease = 1.0 - std::exp(-std::pow(t / 0.4, 3));
    samples.push_back(
        {t, {math::Matrix3::Identity(), start + Vector3(0.15 * ease * std::sin(2 * M_PI * 0.4 * t), 0, 0)}});
  }
  return trajectory::fit(samples, "test");
}

std::vector<double> frames(int count) {
  std::vector<double> times;
  for (int k = 0; k < count; ++k) times.push_back(k / 30.0);
  return times;
}

struct Scene {
  chain::Chain chain;
  dynamics::Parameters truth;
  trajectory::Trajectory base;
  chain::States clean, seen;
};

// A rope of the model's own kind, simulated eight times finer than it is fitted, seen with noise on every angle.
Scene scene(bool table, chain::Bending bending, double noise, int count = 100) {
  Scene s;
  s.chain = table ? chain::make_chain(0.3, 0.02, Vector3::UnitY(), Vector3::UnitZ(), 6, bending, false)
                  : chain::make_chain(0.3, 0.02, -Vector3::UnitZ(), Vector3::UnitY(), 6, bending, false);
  const int n = s.chain.angles(), links = s.chain.links() - 1;
  dynamics::Parameters& p = s.truth;
  p.tip_mass = table ? 0.0 : 0.002;
  p.link_mass.assign(links, (0.06 - p.tip_mass) / links);
  p.viscous_friction.assign(links, 0.0), p.coulomb_friction.assign(links, table ? 0.35 : 0.0);
  p.air_linear.assign(links, 0.0), p.air_quadratic.assign(links, table ? 0.0 : 0.0144 * 0.3 / links);
  p.stiffness.assign(n, 0.012), p.damping.assign(n, 8e-4), p.rest_angle.assign(n, 0.05);
  for (int k = 0; k < n && s.chain.child_link[k] == 1; ++k) p.stiffness[k] *= 2.0, p.damping[k] *= 2.0;
  p.radius = 0.01;
  p.substeps = 32;
  if (table) p.table_normal = Vector3::UnitZ();
  s.base = swing(count / 30.0 + 0.1, Vector3(0, 0, 0.5));
  const dynamics::Model model = dynamics::make_model(s.chain, p);
  VectorX theta = dynamics::static_equilibrium(model, s.base.pose(0.0)).theta, thetadot = VectorX::Zero(n);
  if (bending == chain::Bending::spatial) thetadot[1] = 0.3;  // out of the plane of motion
  s.clean = dynamics::rollout(model, s.base, {0.0, theta, thetadot}, frames(count));
  s.seen = s.clean;
  core::Random random(11);
  for (VectorX& angles : s.seen.theta)
    for (int k = 0; k < n; ++k) angles[k] += noise * random.normal();
  return s;
}

double estimate(const Result& result, const std::string& name) {
  for (std::size_t i = 0; i < result.estimates.names.size(); ++i)
    if (result.estimates.names[i] == name) return result.estimates.values[i];
  FAIL("no estimate named " << name);
  return 0.0;
}

double node_rms(const chain::Chain& chain, const chain::States& a, const chain::States& b) {
  double sum = 0.0;
  Eigen::Index count = 0;
  for (std::size_t k = 0; k < a.theta.size(); ++k) {
    const MatrixX off = chain::nodes(chain, chain::link_motions(chain, a.theta[k], {})) -
                        chain::nodes(chain, chain::link_motions(chain, b.theta[k], {}));
    sum += off.squaredNorm(), count += off.cols();
  }
  return std::sqrt(sum / count);
}

constexpr double kDegree = M_PI / 180.0;

}  // namespace

// Several identifications of whole recordings: of the suite "whole".
TEST_CASE("the parameters of a simulated hanging rope are found again through noise" * doctest::test_suite("whole")) {
  const Scene s = scene(false, chain::Bending::spatial, 0.5 * kDegree);
  Options options;
  options.mass = 0.06;
  const Result result = identify(s.chain, s.base, s.seen, options);
  CHECK(node_rms(s.chain, result.rollout, s.clean) < 1.2e-3);  // noise alone displaces the nodes by 3 mm
  CHECK(result.node_rms > 2e-3);
  CHECK(result.parameters.stiffness[6] / 0.012 == doctest::Approx(1.0).epsilon(0.15));
  CHECK(result.parameters.damping[6] / 8e-4 == doctest::Approx(1.0).epsilon(0.25));
  CHECK(std::exp(estimate(result, "log_drag")) / 0.0144 == doctest::Approx(1.0).epsilon(0.3));
  double mass = result.parameters.tip_mass;
  for (double m : result.parameters.link_mass) mass += m;
  CHECK(mass == doctest::Approx(0.06).epsilon(1e-12));
  CHECK(result.initial.thetadot[1] == doctest::Approx(0.3).epsilon(0.5));

  // errors in units of their standard errors
  const auto& e = result.estimates;
  REQUIRE(e.covariance.rows() == static_cast<Eigen::Index>(e.names.size()));
  for (std::size_t i = 0; i < e.names.size(); ++i) CHECK(e.standard_errors[i] > 0.0);
  double squares = 0.0;
  for (int k = 0; k < 12; ++k) {
    const auto z = [&](const std::string& name, double truth) {
      const auto at = std::find(e.names.begin(), e.names.end(), name) - e.names.begin();
      return (e.values[at] - truth) / e.standard_errors[at];
    };
    squares += std::pow(z("rest_angle_" + std::to_string(k + 1), 0.05), 2);
    squares += std::pow(z("theta_" + std::to_string(k + 1), s.clean.theta[0][k]), 2);
  }
  const double spread = std::sqrt(squares / 24.0);  // 1 for perfect standard errors
  CHECK(spread > 0.2);
  CHECK(spread < 3.0);
  CHECK(e.held.size() >= 1);
  CHECK(e.held[0].first == "total_mass");
  REQUIRE(e.solver);
  CHECK(solve::converged(*e.solver));
  CHECK(e.solver->final_cost <= e.solver->initial_cost);

  options.max_iterations = 1;  // one step per horizon is too little, and it says so
  const Result stopped = identify(s.chain, s.base, s.seen, options);
  CHECK(stopped.estimates.solver->reason == solve::Reason::last_iteration);
}

TEST_CASE("how friction rolls a rope on a table is found again through noise, and carries over to another motion") {
  constexpr double kLever = 0.006;  // m
  Scene s = scene(true, chain::Bending::planar, 0.0);
  s.truth.roll_lever.assign(6, kLever);
  const dynamics::Model model = dynamics::make_model(s.chain, s.truth);
  const dynamics::InitialState start{0.0, s.clean.theta[0], VectorX::Zero(6)};
  s.seen = dynamics::rollout(model, s.base, start, frames(100));
  core::Random random(13);
  for (VectorX& angles : s.seen.theta)
    for (double& angle : angles) angle += 0.2 * kDegree * random.normal();
  Options options;
  options.tabletop = true;
  options.mass = 0.06;
  const Result found = identify(s.chain, s.base, s.seen, options);
  double mean = 0.0;
  for (int k = 1; k < 6; ++k) mean += found.parameters.roll_lever[k] / 5.0;
  CHECK(mean == doctest::Approx(kLever).epsilon(0.25));
  std::vector<trajectory::Sample> samples;
  for (int k = 0; k <= 240; ++k) {
    const double t = k / 120.0;
    samples.push_back({t, {math::exp_so3({0, 0, 0.3 * t * t}), Vector3(-0.1 * t * t, 0.02 * t * t, 0.5)}});
  }
  const trajectory::Trajectory other = trajectory::fit(samples, "test");
  const auto times = frames(55);
  const chain::States truth = dynamics::rollout(model, other, start, times);
  const auto error = [&](const dynamics::Parameters& p) {
    return node_rms(s.chain, dynamics::rollout(dynamics::make_model(s.chain, p), other, start, times), truth);
  };
  dynamics::Parameters without = s.truth;
  without.roll_lever.clear();
  CHECK(error(without) > 5e-4);
  CHECK(error(found.parameters) < 0.5 * error(without));
}

TEST_CASE("Coulomb friction of a rope on a table is found again through noise") {
  const Scene s = scene(true, chain::Bending::planar, 0.5 * kDegree);
  Options options;
  options.tabletop = true;
  const Result result = identify(s.chain, s.base, s.seen, options);
  CHECK(node_rms(s.chain, result.rollout, s.clean) < 0.8e-3);
  double mean = 0.0;
  for (double c : result.parameters.coulomb_friction) mean += std::log(c) / 6.0;
  CHECK(std::exp(mean) == doctest::Approx(0.35).epsilon(0.25));
  // without a mass everything is per kilogram: stiffness over mass is what is known
  CHECK(result.parameters.stiffness[3] * 0.06 / 0.012 == doctest::Approx(1.0).epsilon(0.2));
  double mass = result.parameters.tip_mass;
  for (double m : result.parameters.link_mass) mass += m;
  CHECK(mass == doctest::Approx(1.0).epsilon(1e-12));
}

TEST_CASE("the given mass only scales what has a unit of force") {
  const Scene s = scene(false, chain::Bending::planar, 0.0, 60);
  Options options;
  const Result unit = identify(s.chain, s.base, s.seen, options);
  options.mass = 0.06;
  const Result scaled = identify(s.chain, s.base, s.seen, options);
  // the prior of the drag knows the air and is no ratio, so equality is not exact
  CHECK(scaled.parameters.stiffness[3] / unit.parameters.stiffness[3] == doctest::Approx(0.06).epsilon(0.05));
  CHECK(node_rms(s.chain, scaled.rollout, unit.rollout) < 2e-4);
}

// Several identifications of whole recordings: of the suite "whole".
TEST_CASE("frames that are declared uncertain do not count" * doctest::test_suite("whole")) {
  Scene s = scene(false, chain::Bending::planar, 0.0, 60);
  for (std::size_t k = 20; k < 40; ++k) s.seen.theta[k].array() += 0.3;
  const Result misled = identify(s.chain, s.base, s.seen, {});
  s.seen.covariance.assign(s.seen.theta.size(), 1e-6 * MatrixX::Identity(6, 6));
  for (std::size_t k = 20; k < 40; ++k) s.seen.covariance[k] = MatrixX::Identity(6, 6);
  const Result informed = identify(s.chain, s.base, s.seen, {});
  CHECK(node_rms(s.chain, informed.rollout, s.clean) < 1e-3);
  CHECK(node_rms(s.chain, misled.rollout, s.clean) > 2.0 * node_rms(s.chain, informed.rollout, s.clean));
}

TEST_CASE("results do not depend on the number of threads") {
  const Scene s = scene(true, chain::Bending::planar, 0.5 * kDegree, 40);
  Options options;
  options.tabletop = true;
  const int threads = core::threads();
  core::set_threads(1);
  const Result one = identify(s.chain, s.base, s.seen, options);
  core::set_threads(3);
  const Result three = identify(s.chain, s.base, s.seen, options);
  core::set_threads(threads);
  REQUIRE(one.estimates.values.size() == three.estimates.values.size());
  for (std::size_t i = 0; i < one.estimates.values.size(); ++i)
    CHECK(one.estimates.values[i] == three.estimates.values[i]);
}

TEST_CASE("the paper's procedure runs, and is worse on an elastic rope") {
  const Scene s = scene(false, chain::Bending::planar, 0.0, 60);
  Options options;
  options.mass = 0.06;
  const Result ours = identify(s.chain, s.base, s.seen, options);
  options.paper = true;
  options.adam_iterations = 60;
  const Result paper = identify(s.chain, s.base, s.seen, options);
  for (double k : paper.parameters.stiffness) CHECK(k == 0.0);
  CHECK(paper.parameters.integrator == dynamics::Integrator::implicit_velocity_euler);
  CHECK(ours.node_rms < 0.5e-3);
  CHECK(paper.node_rms > 3.0 * ours.node_rms);
  CHECK(paper.node_rms < 0.05);
}

TEST_CASE("a rope simulated by another program is followed open loop within half a millimeter") {
  // assets/demo_free_30: MuJoCo, 48 elements, 60 frames; angles fitted to the true centerline frame by frame
  const Path folder = Path(CHAINSPLAT_SOURCE_DIR) / "assets/demo_free_30";
  const trajectory::Trajectory base = trajectory::fit(trajectory::read_tum(folder / "base.tum"), "base.tum");
  const chain::Chain chain =
      chain::make_chain(0.3, 0.02, -Vector3::UnitZ(), Vector3::UnitY(), 8, chain::Bending::spatial, false);
  std::istringstream file(core::read_file(folder / "truth/centreline.csv"));
  std::string line;
  std::getline(file, line);
  chain::States states;
  std::vector<MatrixX> truth;
  std::vector<double> arclengths = chain::equal_arclengths(chain, 49);
  VectorX theta = VectorX::Zero(16);
  while (std::getline(file, line)) {
    std::istringstream row(line);
    std::vector<double> values;
    for (std::string cell; std::getline(row, cell, ',');) values.push_back(std::stod(cell));
    REQUIRE(values.size() == 2 + 3 * 49);
    truth.push_back(Eigen::Map<const MatrixX>(values.data() + 2, 3, 49));
    const Pose pose = base.pose(values[1]);
    for (int iteration = 0; iteration < 15; ++iteration) {  // Gauss-Newton, a little ridge
      const auto motions = chain::link_motions(chain, theta, pose);
      const MatrixX axes = chain::world_axes(chain, theta, pose),
                    points = chain::centerline(chain, motions, arclengths);
      MatrixX hessian = 1e-6 * MatrixX::Identity(16, 16);
      VectorX gradient = 1e-6 * theta;
      for (int i = 0; i < 49; ++i) {
        const int link = chain::link_at(chain, arclengths[i]);
        const MatrixX slope = chain::point_jacobian(chain, axes, link, points.col(i));
        hessian += slope.transpose() * slope;
        gradient += slope.transpose() * (points.col(i) - truth.back().col(i));
      }
      theta -= hessian.ldlt().solve(gradient);
    }
    states.time.push_back(values[1]);
    states.theta.push_back(theta);
  }
  Options options;
  options.mass = 0.06;
  const Result result = identify(chain, base, states, options);
  double sum = 0.0;
  for (std::size_t k = 0; k < truth.size(); ++k)
    sum += (chain::centerline(chain, chain::link_motions(chain, result.rollout.theta[k], base.pose(states.time[k])),
                              arclengths) -
            truth[k])
               .squaredNorm() /
           49.0;
  CHECK(std::sqrt(sum / truth.size()) < 0.5e-3);
  // rope.json: bending stiffness 4.5e-4 N m^2 over 37.5 mm, retardation 0.08 s
  CHECK(std::exp(estimate(result, "log_stiffness")) == doctest::Approx(0.012).epsilon(0.25));
  CHECK(std::exp(estimate(result, "log_damping")) == doctest::Approx(9.6e-4).epsilon(0.3));
}

TEST_CASE("markers alone tell the motion between and beyond them") {
  const Scene s = scene(false, chain::Bending::planar, 0.0);
  Markers markers;
  markers.arclengths = {0.1, 0.2, 0.3};
  markers.deviation = 1e-3;
  core::Random random(3);
  for (std::size_t k = 0; k < s.clean.time.size(); ++k) {
    const auto motions = chain::link_motions(s.chain, s.clean.theta[k], s.base.pose(s.clean.time[k]));
    MatrixX seen = chain::centerline(s.chain, motions, markers.arclengths);
    for (Eigen::Index i = 0; i < seen.size(); ++i) seen.data()[i] += 1e-3 * random.normal();
    if (k % 10 == 3) seen.col(1).setConstant(NAN);  // a marker that is hidden now and then
    markers.time.push_back(s.clean.time[k]);
    markers.world.push_back(seen);
  }
  const MarkerFit fitted = fit_markers(s.chain, s.base, markers);
  CHECK(node_rms(s.chain, fitted.states, s.clean) < 2e-3);
  CHECK(fitted.states.covariance.size() == fitted.states.theta.size());
  // a few times end at the last iteration, and that is told
  CHECK(fitted.summary.final_cost < fitted.summary.initial_cost);
  Options options;
  options.mass = 0.06;
  const Result result = identify(s.chain, s.base, markers, options);
  CHECK(node_rms(s.chain, result.rollout, s.clean) < 1e-3);  // less than one marker's noise
  markers.arclengths[2] = 0.4;                               // beyond the rope
  CHECK_THROWS_AS(fit_markers(s.chain, s.base, markers), InputError);
}

// Several identifications of whole recordings: of the suite "whole".
TEST_CASE("two recordings of one rope give one set of parameters, better known than from one" *
          doctest::test_suite("whole")) {
  const Scene slow = scene(false, chain::Bending::planar, 0.5 * kDegree, 60);
  Scene other = scene(false, chain::Bending::planar, 0.0, 60);
  // another motion of the same rope: let go from the side
  other.base = trajectory::fit({trajectory::Sample{0.0, {math::Matrix3::Identity(), Vector3(0, 0, 0.5)}}}, "rest");
  const VectorX theta = VectorX::Constant(6, 0.15);
  const auto record = [&](const dynamics::Parameters& rope) {
    chain::States seen = dynamics::rollout(dynamics::make_model(other.chain, rope), other.base,
                                           {0.0, theta, VectorX::Zero(6)}, frames(60));
    core::Random random(5);
    for (VectorX& angles : seen.theta)
      for (int k = 0; k < 6; ++k) angles[k] += 0.5 * kDegree * random.normal();
    return seen;
  };
  Options options;
  options.mass = 0.06;
  std::vector<Recording> recordings{{slow.base, slow.seen}, {other.base, record(slow.truth)}};
  const std::vector<Result> both = identify(slow.chain, recordings, options);
  REQUIRE(both.size() == 2);
  CHECK(both[0].parameters.stiffness == both[1].parameters.stiffness);
  CHECK(both[1].initial.theta[5] == doctest::Approx(0.15).epsilon(0.3));
  CHECK(both[0].parameters.stiffness[3] / 0.012 == doctest::Approx(1.0).epsilon(0.15));
  for (const Result& r : both) CHECK(r.node_rms < 1.5 * r.alone_rms);
  const Result one = identify(slow.chain, slow.base, slow.seen, options);
  CHECK(both[0].estimates.names == one.estimates.names);
  CHECK(both[0].estimates.standard_errors[0] < one.estimates.standard_errors[0]);

  dynamics::Parameters stiff = slow.truth;
  for (double& k : stiff.stiffness) k *= 4.0;
  recordings[1].recognized = record(stiff);
  const std::vector<Result> mixed = identify(slow.chain, recordings, options);
  CHECK(std::max(mixed[0].node_rms / mixed[0].alone_rms, mixed[1].node_rms / mixed[1].alone_rms) > 3.0);
}

TEST_CASE("a rope that hangs still tells nothing of what acts on motion only") {
  Scene s = scene(false, chain::Bending::planar, 0.0, 3);
  s.base = trajectory::fit({trajectory::Sample{0.0, {math::Matrix3::Identity(), Vector3(0, 0, 0.5)}}}, "rest");
  const VectorX rest = s.clean.theta[0];
  s.seen = {frames(20), std::vector<VectorX>(20, rest), {}, {}};
  const Result result = identify(s.chain, s.base, s.seen, {});
  const auto weak = [&](const std::string& name) {
    for (const auto& direction : result.estimates.weak)
      for (const auto& part : direction.parts)
        if (part.first == name) return direction.singular_value;
    return 1.0;
  };
  CHECK(weak("log_damping") < 0.1);
  CHECK(weak("log_drag") < 0.1);
  for (std::size_t i = 1; i < result.estimates.weak.size(); ++i)
    CHECK(result.estimates.weak[i].singular_value >= result.estimates.weak[i - 1].singular_value);
}

TEST_CASE("whole turns in recognized angles change nothing") {
  Scene s = scene(false, chain::Bending::planar, 0.5 * kDegree, 40);
  const Result as_is = identify(s.chain, s.base, s.seen, {});
  for (std::size_t k = 4; k < s.seen.theta.size(); ++k) s.seen.theta[k][2] += 2.0 * M_PI;
  const Result turned = identify(s.chain, s.base, s.seen, {});
  CHECK(node_rms(s.chain, as_is.rollout, turned.rollout) < 1e-6);
}

TEST_CASE("a chain whose joints stand for their part of a rod has the rod's first bending frequency") {
  // Euler-Bernoulli, clamped and free, no gravity: omega = 1.8751^2 / L^2 sqrt(EI L / M)
  const double length = 0.52, mass = 0.327, stiffness = 1.267;
  const double omega = std::pow(1.8751041 / length, 2) * std::sqrt(stiffness * length / mass);
  for (const double first_joint : {0.0, 0.02}) {
    const chain::Chain chain = chain::make_chain(length, 0.001, Vector3::UnitX(), Vector3::UnitY(), 16,
                                                 chain::Bending::planar, false, first_joint);
    dynamics::Parameters p;
    p.viscous_friction = p.coulomb_friction = p.air_linear = p.air_quadratic = std::vector<double>(16, 0.0);
    p.rest_angle = p.damping = std::vector<double>(16, 0.0);
    p.gravity.setZero();
    for (int j = 1; j <= 16; ++j) {
      p.link_mass.push_back(mass * (chain.link_end(j) - chain.link_start(j)) / length);
      p.stiffness.push_back(stiffness / chain::bent_length(chain, j));
    }
    const MatrixX inertia = dynamics::mass_matrix(dynamics::make_model(chain, p), VectorX::Zero(16));
    const VectorX k = Eigen::Map<const VectorX>(p.stiffness.data(), 16);
    const Eigen::GeneralizedSelfAdjointEigenSolver<MatrixX> modes(MatrixX(k.asDiagonal()), inertia);
    CHECK(std::sqrt(modes.eigenvalues()[0]) == doctest::Approx(omega).epsilon(first_joint > 0.0 ? 0.01 : 0.003));
  }
}

TEST_CASE("markers farther from the grasp than their arclength are refused") {
  const Scene s = scene(false, chain::Bending::planar, 0.0, 5);
  Markers markers;
  markers.arclengths = {0.3};
  markers.time = frames(4);
  markers.world.assign(4, MatrixX(Vector3(0, 0, 0.2)));
  CHECK(fit_markers(s.chain, s.base, markers).states.theta.size() == 4);
  markers.world[2](2, 0) = -200.0;  // one slip of the tracker
  CHECK(fit_markers(s.chain, s.base, markers).states.theta.size() == 4);
  for (auto& at : markers.world) at(2, 0) = -200.0;  // millimeters, say
  CHECK_THROWS_AS(fit_markers(s.chain, s.base, markers), InputError);
}

TEST_CASE("markers of strongly bent shapes that have nothing to do with each other are fitted") {
  const chain::Chain chain =
      chain::make_chain(1.0, 0.02, Vector3::UnitX(), Vector3::UnitY(), 8, chain::Bending::spatial, false);
  const trajectory::Trajectory base = trajectory::fit({trajectory::Sample{}}, "rest");
  Markers markers;
  markers.deviation = 1e-3;
  for (int i = 1; i <= 10; ++i) markers.arclengths.push_back(0.1 * i);
  core::Random random(5);
  for (int k = 0; k < 40; ++k) {
    VectorX theta(chain.angles());
    for (double& angle : theta) angle = 0.6 * random.normal();
    markers.time.push_back(10.0 * k);
    markers.world.push_back(chain::centerline(chain, chain::link_motions(chain, theta, {}), markers.arclengths));
  }
  const chain::States found = fit_markers(chain, base, markers).states;
  for (std::size_t k = 0; k < found.theta.size(); ++k) {
    const MatrixX line = chain::centerline(chain, chain::link_motions(chain, found.theta[k], {}), markers.arclengths);
    CHECK((line - markers.world[k]).colwise().norm().maxCoeff() < 5e-3);
  }
}

TEST_CASE("too little or broken data are refused") {
  const Scene s = scene(false, chain::Bending::planar, 0.0, 5);
  chain::States few = s.seen;
  few.time.resize(2), few.theta.resize(2);
  CHECK_THROWS_AS(identify(s.chain, s.base, few, {}), InputError);
  chain::States broken = s.seen;
  broken.theta[1][0] = NAN;
  CHECK_THROWS_AS(identify(s.chain, s.base, broken, {}), InputError);
  const Eigen::Index n = s.chain.angles();
  chain::States unsure = s.seen;
  unsure.covariance.assign(s.seen.time.size(), 1e-6 * MatrixX::Identity(n, n));
  for (const double variance : {-1.0, static_cast<double>(NAN), static_cast<double>(INFINITY)}) {
    unsure.covariance[2](1, 1) = variance;
    CHECK_THROWS_AS(identify(s.chain, s.base, unsure, {}), InputError);
  }
  // times that no step count can bridge, and times between which nothing moves
  chain::States apart = s.seen;
  apart.time.back() = 1e300;
  CHECK_THROWS_AS(identify(s.chain, s.base, apart, {}), InputError);
  chain::States near = s.seen;
  for (std::size_t k = 0; k < near.time.size(); ++k) near.time[k] = 1e-300 * static_cast<double>(k);
  CHECK_THROWS_AS(identify(s.chain, s.base, near, {}), InputError);
}
