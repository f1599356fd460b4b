#include "fit.h"

#include <algorithm>
#include <cmath>

namespace chainsplat::identification {

using dynamics::Quantity;

namespace {

constexpr double kHorizons[] = {1.0 / 3, 2.0 / 3, 4.0 / 3};  // s, then doubled until everything is within
constexpr double kHuber = 1.75;                              // times the usual root mean square of a group of residuals
constexpr double kLeastUsual = 0.1;  // of the standard deviation expected: a closer fit does not make outliers
constexpr double kMedianRms = 0.9;   // median of the root mean square of a few unit normals
// A fit's last step lowers its cost by less: half the square of a step in standard errors, of which that is a twelfth.
constexpr double kLeastGain = 3e-3;

}  // namespace

void improve(const Problem& problem, double horizon, bool fine, int iterations, Fit& fit) {
  Rollouts rollouts(problem, horizon, fine);
  const bool with_modes = problem.modes.size() > 0;
  bool first = true;
  const auto evaluate = [&](const VectorX& x, solve::ArrowEquations* equations) {
    const VectorX p = with_modes ? problem.moved(fit.p, x) : x;
    if (!rollouts.run(problem, p, equations != nullptr)) return kInfinity;
    if (first) fit.limit = kHuber * std::max(median_rms(rollouts.values) / kMedianRms, kLeastUsual);
    first = false;
    if (equations) {
      *equations = normal_equations(problem, rollouts, fit.limit);
      add_prior(problem, p, *equations);
    }
    return rollouts.cost(problem, p, fit.limit);
  };
  solve::Options options;
  options.steps = iterations;
  options.attempts = 6;
  // on the way to the whole recording a start is enough; of many joints a step takes long and the last ones gain little
  options.cost_tolerance = fine && !with_modes ? 1e-6 : 1e-4;
  options.decrease_tolerance = kLeastGain;
  options.longest = 1.0;  // of a log or an angle or rad/s: beyond, the linearization is worthless
  options.cancellable = true;
  // lowered slowly: on a table, where friction turns, the damping that a step needs is much the same as before
  options.damping.lower = 0.3;
  options.damping.least_raised = 1e-4;
  options.damping.least = 1e-9;
  VectorX x = with_modes ? VectorX::Zero(problem.coordinates()) : fit.p;
  fit.summary = solve::least_squares(x, evaluate, options);
  fit.p = with_modes ? problem.moved(fit.p, x) : x;
  if (fit.summary.reason == solve::Reason::cancelled) throw Interrupted(core::stop_requested());
  fit.cost = fit.summary.final_cost;
}

Fit fit_centerline(Problem& problem, const Options& options, const std::function<bool(Problem&, VectorX&)>& follow) {
  const Unknowns& u = problem.parts[0].unknowns;
  constexpr double kScales[] = {1.0, 0.2, 5.0};
  constexpr int kRandomStarts = 3;
  constexpr double kPoor = 0.02;       // of the rope's length, root mean square: other starts may do better
  constexpr double kScoreLimit = 0.6;  // of Huber's loss where fits are compared: some 2 mm
  std::int64_t all = 0;
  double longest = 0.0;  // s
  for (const Part& part : problem.parts) {
    all += static_cast<std::int64_t>(part.times.size());
    longest = std::max(longest, part.times.back() - part.times.front());
  }

  const auto start = [&](int index) {
    VectorX p = problem.mean;
    const int coulomb = u.first(Quantity::coulomb_friction), links = coulomb < 0 ? 0 : problem.chain.links() - 1;
    const auto scale = [&](std::initializer_list<Quantity> quantities, const auto& by) {
      for (const Quantity quantity : quantities)
        if (const int i = u.first(quantity); i >= 0) p[i] += by();
    };
    const auto factor = [&] { return std::log(options.start_factor); };
    scale({Quantity::stiffness, Quantity::damping, Quantity::drag}, factor);
    for (int j = 0; j < links; ++j) p[coulomb + j] += factor();
    if (index < 3) {
      scale({Quantity::stiffness, Quantity::damping}, [&] { return std::log(kScales[index]); });
    } else {
      core::Random random(options.seed * 1000003u + static_cast<std::uint64_t>(index));
      scale({Quantity::stiffness, Quantity::damping, Quantity::drag, Quantity::tip_mass},
            [&] { return 1.5 * random.normal(); });
      for (int j = 0; j < links; ++j) p[coulomb + j] += random.normal();
    }
    return p;
  };
  const auto warm = [&](int index) {
    Fit fit;
    fit.p = start(index);
    for (double horizon : {kHorizons[0], kHorizons[1], kHorizons[2]})
      improve(problem, horizon, false, std::min(options.max_iterations, 10), fit);
    return fit;
  };
  const auto finish = [&](Fit fit) {
    std::vector<double> horizons;
    for (double horizon = 2.0 * kHorizons[2]; horizon < longest; horizon *= 2.0) horizons.push_back(horizon);
    // the whole twice: again with all substeps and the threshold of the better fit
    horizons.insert(horizons.end(), 2, kInfinity);
    for (std::size_t i = 0; i < horizons.size(); ++i) {
      const double horizon = horizons[i];
      if (fit.cost < kInfinity) follow(problem, fit.p);
      improve(problem, horizon, i + 1 == horizons.size(), options.max_iterations, fit);
      std::int64_t frames = 0;
      for (const Part& part : problem.parts) frames += static_cast<std::int64_t>(frames_within(part, horizon));
      core::report({"identify", frames, all, fit.cost, NAN, "fitting the rollout to the recognized motion"});
    }
    return fit;
  };
  // a common scale for comparing: the robust cost of a horizon with a fixed threshold
  const auto score = [&](const Fit& fit, double horizon) {
    if (fit.cost == kInfinity) return kInfinity;
    Rollouts rollouts(problem, horizon, true);
    return rollouts.run(problem, fit.p, false) ? rollouts.cost(problem, fit.p, kScoreLimit) : kInfinity;
  };
  const auto best_of = [&](int first, int count) {
    std::vector<Fit> fits(count);
    core::parallel_for(count, [&](std::int64_t i) { fits[i] = warm(first + static_cast<int>(i)); });
    std::size_t best = 0;
    double best_score = kInfinity;
    for (std::size_t i = 0; i < fits.size(); ++i) {
      const double value = score(fits[i], kHorizons[2]);
      if (value < best_score) best = i, best_score = value;
    }
    return finish(fits[best]);
  };
  Fit best = best_of(0, 3);
  const auto poor = [&](const Fit& fit) {
    if (fit.cost == kInfinity) return true;
    Rollouts rollouts(problem, kInfinity, true);
    if (!rollouts.run(problem, fit.p, false)) return true;
    for (std::size_t i = 0; i < problem.parts.size(); ++i)
      if (rms_of(problem.parts[i], rollouts.states[i]) > kPoor * problem.chain.length) return true;
    return false;
  };
  if (poor(best)) {
    const double lowest = score(best, kInfinity);
    std::vector<Part> parts = problem.parts;
    const Rod rod = problem.rod;
    const Fit other = best_of(3, kRandomStarts);
    if (score(other, kInfinity) < lowest)
      best = other;
    else
      problem.parts = std::move(parts), problem.rod = rod;
  }
  return best;
}

Fit fit_angles(const Problem& problem, const Options& options) {
  Fit best, fit;
  fit.p = problem.mean;
  solve::AdamOptions rates{.rate = 0.05, .epsilon = 1e-12};
  solve::AdamState adam;
  solve::Summary summary;
  Rollouts rollouts(problem, kInfinity, true);
  for (int iteration = 1; iteration <= options.adam_iterations; ++iteration) {
    if (core::stop_requested()) throw Interrupted(core::stop_requested());
    if (!rollouts.run(problem, fit.p, true)) {
      // beyond the step's stability: go back and step less
      if (best.cost == kInfinity)
        fit.p.array() += 0.3;
      else
        fit.p = best.p;
      rates.rate *= 0.5;
      adam.first = VectorX::Zero(fit.p.size());
      if (adam.second.size() == 0) adam.second = adam.first;
      ++adam.steps;
      continue;
    }
    double cost = 0.0;
    VectorX gradient = VectorX::Zero(fit.p.size());
    for (std::size_t i = 0; i < problem.parts.size(); ++i)
      for (std::size_t k = 0; k < rollouts.states[i].theta.size(); ++k) {
        const VectorX off = rollouts.states[i].theta[k] - problem.parts[i].theta[k];
        cost += 0.5 * off.squaredNorm();
        gradient += rollouts.slopes[i].theta[k].transpose() * off;  // [P] fits no initial state: all are shared
      }
    fit.cost = cost;
    if (cost < best.cost) best = fit;
    if (std::isnan(summary.initial_cost)) summary.initial_cost = cost;
    const VectorX before = fit.p;
    solve::adam_step(adam, gradient, rates, fit.p);
    summary.worst_step = (fit.p - before).cwiseAbs().maxCoeff();
    summary.iterations = iteration;
  }
  best.summary = summary;  // a number of steps, by design: it ends at the last
  best.summary.final_cost = best.cost;
  return best;
}

}  // namespace chainsplat::identification
