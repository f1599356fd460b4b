// The solvers against closed forms, and against themselves where the order of things must not matter.
#include "chainsplat/solve.h"

#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <nlohmann/json.hpp>
#include <numeric>
#include <vector>

#include "chainsplat/solve_json.h"
#include "src/math/decompositions.h"

using namespace chainsplat;
using namespace chainsplat::solve;

namespace {

constexpr double kInfinity = std::numeric_limits<double>::infinity();

MatrixX random_matrix(Eigen::Index rows, Eigen::Index columns, std::uint64_t seed) {
  core::Random random(seed);
  MatrixX out(rows, columns);
  for (double& value : out.reshaped()) value = random.normal();
  return out;
}

VectorX random_vector(Eigen::Index size, std::uint64_t seed) { return random_matrix(size, 1, seed); }

// Half the squares of design x - right.
struct Linear {
  MatrixX design;
  VectorX right;
  double operator()(const VectorX& x, NormalEquations* equations) const {
    const VectorX r = design * x - right;
    if (equations) *equations = {design.transpose() * design, design.transpose() * r};
    return 0.5 * r.squaredNorm();
  }
};

// Rosenbrock's valley as two residuals: least at (1, 1).
double rosenbrock(const VectorX& x, NormalEquations* equations) {
  Eigen::Matrix2d slope;
  slope << -20.0 * x[0], 10.0, -1.0, 0.0;
  const Eigen::Vector2d r(10.0 * (x[1] - x[0] * x[0]), 1.0 - x[0]);
  if (equations) *equations = {slope.transpose() * slope, slope.transpose() * r};
  return 0.5 * r.squaredNorm();
}

ArrowEquations random_arrow(int shared, const std::vector<int>& own) {
  const int size = shared + std::accumulate(own.begin(), own.end(), 0);
  ArrowEquations out{MatrixX::Identity(shared, shared), random_vector(shared, 1), {}};
  for (std::size_t i = 0; i < own.size(); ++i) {
    // J^T J of rows about the shared unknowns and those of one block
    const MatrixX rows = random_matrix(2 * size, shared + own[i], 100 + i);
    const MatrixX normal = rows.transpose() * rows;
    out.shared += normal.topLeftCorner(shared, shared);
    out.local.push_back({normal.bottomRightCorner(own[i], own[i]), normal.bottomLeftCorner(own[i], shared),
                         random_vector(own[i], 200 + i)});
  }
  return out;
}

}  // namespace

TEST_CASE("linear least squares: one Gauss-Newton step is the closed form") {
  const Linear problem{random_matrix(12, 4, 1), random_vector(12, 2)};
  const VectorX expected = problem.design.householderQr().solve(problem.right);
  VectorX x = random_vector(4, 3);
  Summary summary = least_squares(x, problem, {.steps = 1, .checked = false, .damping = {.rule = Damping::Rule::none}});
  CHECK((x - expected).norm() < 1e-12 * expected.norm());
  CHECK(summary.reason == Reason::last_iteration);
  CHECK(summary.iterations == 1);

  // with every damping rule the same place is found, and it says why it ended
  for (const Damping& damping :
       {Damping{}, Damping{.rule = Damping::Rule::fixed, .first = 0.1}, Damping{.rule = Damping::Rule::shift}}) {
    x = random_vector(4, 3);
    const double start = problem(x, nullptr);
    summary = least_squares(x, problem, {.steps = 200, .rounding = 1e-12, .step_tolerance = 1e-9, .damping = damping});
    CHECK((x - expected).norm() < 1e-8 * expected.norm());
    CHECK(summary.reason == Reason::step);
    CHECK(summary.initial_cost == start);
    CHECK(summary.final_cost == doctest::Approx(problem(expected, nullptr)));
    CHECK(summary.worst_step < 1e-9);
  }
}

TEST_CASE("Rosenbrock's valley; every reason to end is told") {
  Options options{.steps = 200, .cost_tolerance = 1e-10, .step_tolerance = 1e-10};
  VectorX x = Eigen::Vector2d(-1.2, 1.0);
  const Summary summary = least_squares(x, rosenbrock, options);
  CHECK((x - VectorX::Ones(2)).norm() < 1e-6);
  CHECK(converged(summary));
  CHECK(summary.final_cost < 1e-12);
  CHECK(summary.initial_cost == doctest::Approx(0.5 * (4.4 * 4.4 + 2.2 * 2.2)));

  const auto from_start = [&](const Options& changed) {
    x = Eigen::Vector2d(-1.2, 1.0);
    return least_squares(x, rosenbrock, changed);
  };
  Options few = options;
  few.steps = 3;
  Summary stopped = from_start(few);
  CHECK(stopped.reason == Reason::last_iteration);
  CHECK(stopped.final_cost == rosenbrock(x, nullptr));
  CHECK(stopped.worst_step > 1e-3);
  CHECK(describe(stopped).find("stopped at its last iteration") == 0);
  few = options;
  few.trials = 3;
  stopped = from_start(few);
  CHECK(stopped.reason == Reason::last_iteration);
  CHECK(stopped.iterations == 3);
  Options level = options;
  level.gradient_tolerance = 1e-3, level.cost_tolerance = level.step_tolerance = 0.0;
  CHECK(from_start(level).reason == Reason::gradient);
  Options short_steps = options;
  short_steps.longest = 1e-2;
  short_steps.steps = 5;
  CHECK(from_start(short_steps).worst_step == doctest::Approx(1e-2));
  CHECK((x - Eigen::Vector2d(-1.2, 1.0)).cwiseAbs().maxCoeff() <= 0.05 + 1e-12);
  Options negligible = options;
  negligible.negligible = 1e3;
  CHECK(from_start(negligible).reason == Reason::step);
  CHECK(x == Eigen::Vector2d(-1.2, 1.0));

  // a step that looks good and is not: the gradient has the wrong sign
  const auto wrong = [](const VectorX& place, NormalEquations* equations) {
    const double cost = rosenbrock(place, equations);
    if (equations) equations->gradient = -equations->gradient;
    return cost;
  };
  x = Eigen::Vector2d(-1.2, 1.0);
  CHECK(least_squares(x, wrong, {.attempts = 8}).reason == Reason::no_decrease);
  CHECK(x == Eigen::Vector2d(-1.2, 1.0));
}

TEST_CASE("derivatives asked for with the first trial change nothing but who asks for them") {
  Options options{.steps = 30, .cost_tolerance = 1e-10};
  int with = 0, without = 0;
  const auto counted = [](int& derivatives) {
    return [&derivatives](const VectorX& x, NormalEquations* equations) {
      derivatives += equations != nullptr;
      return rosenbrock(x, equations);
    };
  };
  VectorX lazy = Eigen::Vector2d(-1.2, 1.0), eager = lazy;
  const Summary a = least_squares(lazy, counted(without), options);
  options.eager = true;
  const Summary b = least_squares(eager, counted(with), options);
  CHECK(lazy == eager);
  CHECK(a.iterations == b.iterations);
  CHECK(with > without);
}

TEST_CASE("singular equations: what shows no unknown leaves it where it is") {
  Linear problem{random_matrix(8, 3, 4), random_vector(8, 5)};
  problem.design.col(2).setZero();  // nothing depends on the third
  VectorX x = Eigen::Vector3d(0.3, -0.2, 0.7);
  const Summary summary = least_squares(x, problem, {.ties = true, .step_tolerance = 1e-12});
  CHECK(summary.reason == Reason::step);
  CHECK(x[2] == 0.7);
  CHECK(x.head(2).isApprox(problem.design.leftCols(2).householderQr().solve(problem.right), 1e-9));

  // two unknowns of which only the sum shows: any place on the line of least cost is right
  problem.design = random_matrix(8, 3, 6);
  problem.design.col(2) = problem.design.col(1);
  least_squares(x, problem, {.ties = true, .step_tolerance = 1e-12});
  CHECK((problem.design.transpose() * (problem.design * x - problem.right)).norm() < 1e-8);

  // a matrix that no shift allowed makes positive definite
  const auto saddle = [](const VectorX& place, NormalEquations* equations) {
    if (equations) *equations = {-MatrixX::Identity(2, 2), VectorX(-place)};
    return -0.5 * place.squaredNorm();
  };
  x = Eigen::Vector2d(1.0, 0.0);
  Options shift{.attempts = 5, .damping = {.rule = Damping::Rule::shift, .first = 0.0, .least_raised = 1e-9}};
  CHECK(least_squares(x, saddle, shift).reason == Reason::singular);
  shift.attempts = Options::kAny;
  shift.steps = 3;
  CHECK(least_squares(x, saddle, shift).reason == Reason::last_iteration);  // it runs downhill as long as it may
  CHECK(x[0] > 1.0);
}

TEST_CASE("a step that lowers the cost by less than the tolerance is the last, by whichever of both is the larger") {
  // f = sum of r^2/2 with r = x^3 + 10: steps get smaller by a third from one to the next
  const auto slow = [](const VectorX& x, NormalEquations* equations) {
    const double r = std::pow(x[0], 3), slope = 3.0 * x[0] * x[0];
    if (equations) *equations = {MatrixX::Constant(1, 1, slope * slope), VectorX::Constant(1, slope * r)};
    return 0.5 * r * r + 10.0;
  };
  const auto taken = [&](double cost, double decrease) {
    VectorX x = VectorX::Constant(1, 2.0);
    const Summary summary = least_squares(x, slow, {.cost_tolerance = cost, .decrease_tolerance = decrease});
    CHECK(summary.reason == Reason::cost);
    return std::pair(summary.iterations, summary.final_cost);
  };
  const auto [few, high] = taken(1e-12, 1.0);
  const auto [many, low] = taken(1e-12, 1e-4);
  CHECK(few < many);
  CHECK(high > low);
  CHECK(high < 12.0);  // each step leaves (2/3)^6 of what is above 10
  CHECK(taken(1e-1, 1e-4).first == few);
  Options wrong;
  wrong.decrease_tolerance = -1.0;
  CHECK_THROWS_WITH_AS(check(wrong), doctest::Contains("decrease_tolerance"), InputError);
}

TEST_CASE("what is not finite ends the fit at the last good place, without an exception") {
  const Linear problem{MatrixX::Identity(2, 2), Eigen::Vector2d(3.0, 0.0)};
  const auto bounded = [&](const VectorX& x, NormalEquations* equations) {
    return x[0] > 1.0 ? kInfinity : problem(x, equations);
  };
  VectorX x = VectorX::Zero(2);
  const Summary summary = least_squares(x, bounded, {.attempts = 12, .cost_tolerance = 1e-3});
  CHECK(x[0] > 0.5);
  CHECK(x[0] <= 1.0);
  CHECK(std::isfinite(summary.final_cost));
  x = Eigen::Vector2d(2.0, 0.0);
  const Summary outside = least_squares(x, bounded, {});
  CHECK(outside.reason == Reason::not_finite);
  CHECK(x == Eigen::Vector2d(2.0, 0.0));
  const auto damaged = [&](const VectorX& place, NormalEquations* equations) {
    const double cost = problem(place, equations);
    if (equations) equations->gradient[0] = std::nan("");
    return cost;
  };
  x.setZero();
  CHECK(least_squares(x, damaged, {}).reason == Reason::not_finite);
  CHECK(x == VectorX::Zero(2));
}

TEST_CASE("the loop ends where it is asked to stop") {
  core::request_stop(2);
  VectorX x = Eigen::Vector2d(-1.2, 1.0);
  CHECK(least_squares(x, rosenbrock, {.cancellable = true}).reason == Reason::cancelled);
  CHECK(least_squares(x, rosenbrock, {.steps = 2}).reason == Reason::last_iteration);
  core::clear_stop();
}

TEST_CASE("the arrow form is the dense one, also damped, whatever the order of its blocks") {
  const ArrowEquations arrow = random_arrow(5, {3, 1, 4, 2, 3});
  const NormalEquations whole = dense(arrow);
  CHECK(whole.matrix.isApprox(whole.matrix.transpose(), 1e-15));
  CHECK(whole.matrix.rows() == 18);
  for (const auto rule : {Damping::Rule::none, Damping::Rule::fixed, Damping::Rule::multiply, Damping::Rule::shift}) {
    const Damping damping{.rule = rule};
    VectorX step, expected;
    REQUIRE(damped_step(arrow, damping, 0.3, step));
    REQUIRE(damped_step(whole, damping, 0.3, expected));
    CHECK((step - expected).norm() < 1e-12 * expected.norm());
    MatrixX damped = whole.matrix;
    if (rule == Damping::Rule::multiply) damped.diagonal() *= 1.3;
    if (rule == Damping::Rule::fixed || rule == Damping::Rule::shift) damped.diagonal().array() += 0.3;
    CHECK((damped * step + whole.gradient).norm() < 1e-11 * whole.gradient.norm());
  }
  // eliminated by the inverse: its block about the shared unknowns is that of the inverse of all
  CHECK((reduced(arrow).matrix.inverse() - whole.matrix.inverse().topLeftCorner(5, 5)).norm() <
        1e-12 * whole.matrix.inverse().norm());

  ArrowEquations turned = arrow;
  std::reverse(turned.local.begin(), turned.local.end());
  VectorX step, other;
  damped_step(arrow, {}, 0.1, step);
  damped_step(turned, {}, 0.1, other);
  CHECK((step.head(5) - other.head(5)).norm() < 1e-12 * step.norm());
  CHECK((step.tail(3) - other.segment(5, 3)).norm() < 1e-12 * step.norm());
  // of one block alone, bit by bit what the dense matrix gives
  ArrowEquations one = arrow;
  one.local.resize(1);
  damped_step(one, {}, 0.1, step);
  damped_step(dense(one), {}, 0.1, other);
  CHECK(step == other);
}

TEST_CASE("a joint problem in the arrow form ends where the dense one does") {
  // recordings of one decay rate (shared), each with an amplitude and an offset of its own
  constexpr int kRecordings = 4, kTimes = 20;
  const double rate = 1.3;
  const auto value = [](double a, double b, double k, double t) { return a * std::exp(-k * t) + b; };
  const auto fill = [&](const VectorX& x, ArrowEquations* equations) {
    double cost = 0.0;
    if (equations) *equations = {MatrixX::Zero(1, 1), VectorX::Zero(1), {}};
    for (int i = 0; i < kRecordings; ++i) {
      ArrowEquations::Local local{MatrixX::Zero(2, 2), MatrixX::Zero(2, 1), VectorX::Zero(2)};
      for (int k = 0; k < kTimes; ++k) {
        const double t = 0.1 * k, noise = 0.01 * std::sin(7.0 * k + i);
        const double a = x[1 + 2 * i], b = x[2 + 2 * i];
        const double r = value(a, b, x[0], t) - value(1.0 + i, -0.5 * i, rate, t) - noise;
        cost += 0.5 * r * r;
        if (!equations) continue;
        const double by_rate = -a * t * std::exp(-x[0] * t);
        const Eigen::Vector2d own(std::exp(-x[0] * t), 1.0);
        equations->shared(0, 0) += by_rate * by_rate;
        equations->gradient[0] += by_rate * r;
        local.matrix += own * own.transpose();
        local.coupling += own * by_rate;
        local.gradient += own * r;
      }
      if (equations) equations->local.push_back(local);
    }
    return cost;
  };
  const auto whole = [&](const VectorX& x, NormalEquations* equations) {
    ArrowEquations arrow;
    const double cost = fill(x, equations ? &arrow : nullptr);
    if (equations) *equations = dense(arrow);
    return cost;
  };
  const Options options{.steps = 100, .ties = true, .step_tolerance = 1e-10};
  VectorX a = VectorX::Ones(1 + 2 * kRecordings), b = a;
  const Summary by_arrow = least_squares(a, fill, options), by_dense = least_squares(b, whole, options);
  CHECK(converged(by_arrow));
  CHECK((a - b).norm() < 1e-9);
  CHECK(by_arrow.final_cost == doctest::Approx(by_dense.final_cost).epsilon(1e-12));
  CHECK(a[0] == doctest::Approx(rate).epsilon(0.02));
}

TEST_CASE("many fits evaluated at once, each by its own loop, are those one by one") {
  const std::vector<VectorX> starts{Eigen::Vector2d(-1.2, 1.0), Eigen::Vector2d(2.0, 2.0), Eigen::Vector2d(0.0, -1.0)};
  const Options options{.steps = 60, .cost_tolerance = 1e-10, .step_tolerance = 1e-10, .eager = true};
  std::vector<Descent> fits;
  std::vector<NormalEquations> now(starts.size());
  for (const VectorX& start : starts) fits.push_back(begin(start, options));
  const auto running = [&] { return std::any_of(fits.begin(), fits.end(), [](const Descent& d) { return !d.done; }); };
  while (running())
    for (std::size_t i = 0; i < starts.size(); ++i) {
      if (fits[i].done) continue;
      NormalEquations next;
      const double cost = rosenbrock(fits[i].trial, &next);
      if (judge(fits[i], cost, options)) now[i] = next;
      const auto step = [&](double damping, VectorX& out) {
        return damped_step(now[i], options.damping, damping, out);
      };
      if (!fits[i].done) propose(fits[i], step, options);
    }
  for (std::size_t i = 0; i < starts.size(); ++i) {
    VectorX x = starts[i];
    const Summary alone = least_squares(x, rosenbrock, options);
    CHECK(x == fits[i].x);
    CHECK(alone.iterations == fits[i].summary.iterations);
    CHECK(alone.reason == fits[i].summary.reason);
  }
}

TEST_CASE("a step that raises the cost within its rounding is taken and is no end") {
  const double start = 1.0 + 1e-8;
  const auto evaluate = [&](const VectorX& x, NormalEquations* equations) {
    if (equations) *equations = {MatrixX::Identity(1, 1), VectorX::Constant(1, x[0] - 1.0)};
    return x[0] == start ? 1.0 : 1.0 + 1e-13;  // the decrease, 5e-17, drowns
  };
  VectorX x = VectorX::Constant(1, start);
  const Summary summary = least_squares(
      x, evaluate,
      {.rounding = 1e-12, .gradient_tolerance = 1e-15, .damping = {.rule = Damping::Rule::shift, .first = 0.0}});
  CHECK(summary.reason == Reason::gradient);
  CHECK(x[0] == 1.0);
}

TEST_CASE("a trusted step is taken unevaluated, and only near a minimum") {
  const Linear problem{MatrixX::Identity(2, 2), Eigen::Vector2d(1e-3, 0.0)};
  int evaluations = 0;
  const auto counted = [&](const VectorX& x, NormalEquations* equations) {
    ++evaluations;
    return problem(x, equations);
  };
  VectorX x = VectorX::Zero(2);
  const Options options{.trusted = 0.01, .damping = {.rule = Damping::Rule::none}};
  CHECK(least_squares(x, counted, options).reason == Reason::step);
  CHECK(evaluations == 1);
  CHECK(x == problem.right);
  x = Eigen::Vector2d(1.0, 0.0);
  evaluations = 0;
  least_squares(x, counted, options);
  CHECK(evaluations > 1);
}

TEST_CASE("Adam is Algorithm 1 of Kingma and Ba, line by line") {
  const double alpha = 0.02, beta1 = 0.8, beta2 = 0.95, epsilon = 1e-8;
  VectorX theta = random_vector(3, 8), m = VectorX::Zero(3), v = m, x = theta;
  AdamState state;
  for (int t = 1; t <= 50; ++t) {
    const VectorX g = (Eigen::Vector3d(1.0, 4.0, 0.25).array() * theta.array()).matrix();
    m = beta1 * m + (1 - beta1) * g;
    v = beta2 * v + (1 - beta2) * g.cwiseProduct(g);
    const VectorX m_hat = m / (1 - std::pow(beta1, t));
    const VectorX v_hat = v / (1 - std::pow(beta2, t));
    for (int i = 0; i < 3; ++i) theta[i] = theta[i] - alpha * m_hat[i] / (std::sqrt(v_hat[i]) + epsilon);
    const VectorX same = (Eigen::Vector3d(1.0, 4.0, 0.25).array() * x.array()).matrix();
    adam_step(state, same, {.rate = alpha, .beta1 = beta1, .beta2 = beta2, .epsilon = epsilon}, x);
    CHECK(x == theta);
  }
  CHECK(state.steps == 50);
  CHECK_THROWS_WITH_AS(check(AdamOptions{.beta2 = 1.0}), doctest::Contains("AdamOptions.beta2"), InputError);
}

TEST_CASE("options that mean nothing are refused by name; summaries are told and joined") {
  CHECK_THROWS_WITH_AS(check(Options{.steps = -1}), doctest::Contains("Options.steps"), InputError);
  CHECK_THROWS_WITH_AS(check(Options{.longest = 0.0}), doctest::Contains("Options.longest"), InputError);
  CHECK_THROWS_WITH_AS(check(Options{.step_tolerance = NAN}), doctest::Contains("Options.step_tolerance"), InputError);
  CHECK_THROWS_WITH_AS(check(Options{.damping = {.raise = 1.0}}), doctest::Contains("damping.raise"), InputError);
  check(Options{});

  const Summary fits[] = {{Reason::step, 3, 5.0, 1.0, 1e-3}, {Reason::last_iteration, 2, 2.0, 1.5, 1e-2}};
  const Summary all = together(fits);
  CHECK(all.reason == Reason::last_iteration);
  CHECK(all.iterations == 3);
  CHECK(all.initial_cost == 7.0);
  CHECK(all.final_cost == 2.5);
  CHECK(all.worst_step == 1e-2);
  CHECK(!converged(all));
  CHECK(nlohmann::ordered_json(all).dump() ==
        R"({"reason":"last_iteration","iterations":3,"initial_cost":7.0,"final_cost":2.5,"worst_step":0.01})");
  for (int i = 0; i <= static_cast<int>(Reason::cancelled); ++i)
    CHECK(reason_of(name(static_cast<Reason>(i))) == static_cast<Reason>(i));
  CHECK(!reason_of("tired"));
}
