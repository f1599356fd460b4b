#include "models.h"

#include <algorithm>
#include <cmath>
#include <functional>

#include "coarse.h"
#include "src/math/decompositions.h"

namespace chainsplat::identification {

using math::Vector3;

namespace {

// Minus the logarithm of what the data say for a model, by Laplace's method at its fit; less is better. The residuals'
// own size says how large errors are, since a fit can be far within what was expected, but it is never taken as less
// than `least` of that (mathematics.md 5.10).
double lack_of_evidence(const Problem& problem, const Fit& fit, double least) {
  Rollouts rollouts(problem, kInfinity, true);
  if (fit.cost == kInfinity || !rollouts.run(problem, fit.p, true)) return kInfinity;
  const Misfit found = misfit_of(rollouts);
  const double scale = std::max(found.scale, least);
  const MatrixX data = solve::dense(normal_equations(problem, rollouts, kInfinity)).matrix / (scale * scale);
  const Eigen::LDLT<MatrixX> posterior(MatrixX(data + problem.precision)), prior(problem.precision);
  if (!math::is_positive(posterior) || !math::is_positive(prior)) return kInfinity;
  const double shrunk = posterior.vectorD().array().log().sum() - prior.vectorD().array().log().sum();
  const VectorX off = fit.p - problem.mean;
  const double free = found.count / kCorrelated;  // residuals, as many as are independent
  return free * (std::log(scale) + 0.5 * std::pow(found.scale / scale, 2)) + 0.5 * off.dot(problem.precision * off) +
         0.5 * shrunk;
}

// What a fit begins with; none: the usual starts.
using StartOf = std::function<VectorX(const Problem&)>;

// Fits, and fits again about the rod that was found, until that no longer changes.
Candidate fit_about_rod(const chain::Chain& chain, const std::vector<Part>& parts, const Options& options,
                        const Extras& extras, const StartOf& start = {}) {
  constexpr int kMost = 5;
  constexpr double kSame = 0.005;  // of log EI, whose standard errors are 0.05 and more
  Vector3 direction = Vector3::Zero();
  for (const Part& part : parts) direction += part.direction;
  const auto unknowns_about = [&](const Part& part, const Rod& rod) {
    return make_unknowns(chain, options, part.start, extras, rod);
  };
  std::vector<Part> own = parts;
  for (Part& part : own) part.unknowns = unknowns_about(part, {});
  Candidate now{extras, make_problem(chain, std::move(own)), {}};
  const auto rod_at = [&](const Problem& problem, const VectorX& p) {
    return rod_of(problem.chain, problem.parts[0].unknowns, problem.of_part(p, 0), direction);
  };
  // False where the rod at p is the problem's. The motion at p stays as it is.
  const auto follow = [&](Problem& problem, VectorX& p) {
    const Rod found = rod_at(problem, p);
    const bool slack = !(found.bending_stiffness > 0.0) || !(found.tension > 0.0);
    if (slack || std::abs(std::log(found.bending_stiffness / problem.rod.bending_stiffness)) < kSame) return false;
    const Unknowns before = problem.parts[0].unknowns;
    for (Part& part : problem.parts) part.unknowns = unknowns_about(part, found);
    problem.rod = found;
    if (problem.modes.size() == 0) keep_grasp(before, problem.parts[0].unknowns, p);
    return true;
  };
  now.problem.rod = rod_at(now.problem, start ? start(now.problem) : now.problem.mean);
  for (Part& part : now.problem.parts) part.unknowns = unknowns_about(part, now.problem.rod);
  if (start) {
    now.problem.modes = smooth_modes(chain, now.problem.parts[0].unknowns);
    const auto of_own = now.problem.modes.bottomRows(now.problem.own()).cwiseAbs().colwise().sum();
    now.problem.shared_modes = static_cast<int>((of_own.array() == 0.0).count());
    now.fit.p = start(now.problem);
    for (int i = 0; i < 2; ++i)  // again with the threshold of the better fit
      improve(now.problem, kInfinity, true, options.max_iterations, now.fit);
  } else {
    now.fit = fit_centerline(now.problem, options, follow);
  }
  for (int i = 0; i < kMost && now.fit.cost < kInfinity; ++i) {
    Candidate before = now;
    if (!follow(now.problem, now.fit.p)) break;
    improve(now.problem, kInfinity, true, options.max_iterations, now.fit);
    if (now.fit.cost == kInfinity) {
      before.problem.modes = {};
      return before;
    }
  }
  now.problem.modes = {};
  return now;
}

// Misfit that needs no further explanation. What is expected of markers is generous; of recognized angles it is a
// millimeter, within which errors of calibration look like physics.
double within_errors(const std::vector<Part>& parts) { return parts.front().has_markers ? 0.3 : 1.0; }

// The model of every rope, or one with friction in bending or a payload where the data ask for it. `fit` fits the model
// with these extras, after the one without; `extras` are those to try.
using FitOf = std::function<Candidate(const Extras& extras)>;
Candidate best_of_models(const FitOf& fit, std::span<const Extras> extras, const Options& options, double least) {
  constexpr double kEvidence = 5.0;  // in favor of what a rope need not have, natural logarithm
  std::vector<Candidate> tried;
  tried.push_back(fit({}));
  const auto within = [&](const Candidate& one) {
    Rollouts rollouts(one.problem, kInfinity, true);
    return one.fit.cost < kInfinity && rollouts.run(one.problem, one.fit.p, false) &&
           misfit_of(rollouts).scale <= least;
  };
  if (!options.ask_for_more || options.tabletop || !options.fit_stiffness || within(tried[0]))
    return std::move(tried[0]);
  for (const Extras& more : extras)
    if (!more.payload || !options.tip_mass) tried.push_back(fit(more));
  // what every rope has is the scale, and has to be beaten clearly
  std::size_t best = 0;
  for (std::size_t i = 0; i < tried.size(); ++i) {
    Candidate& now = tried[i];
    now.lack = lack_of_evidence(now.problem, now.fit, least);
    const double parts_more = static_cast<int>(now.extras.friction) + static_cast<int>(now.extras.payload);
    core::say_more("identify: " + std::string(now.extras.friction ? "friction in bending, " : "") +
                   (now.extras.payload ? "a payload, " : "") + "log evidence " + core::exact(-now.lack));
    now.lack += kEvidence * parts_more;
    if (now.lack < tried[best].lack) best = i;
  }
  return std::move(tried[best]);
}

constexpr Extras kAllExtras[] = {{true, false}, {false, true}, {true, true}};

Candidate fit_candidates(const chain::Chain& chain, const std::vector<Part>& parts, const Options& options) {
  const auto fit = [&](const Extras& extras) { return fit_about_rod(chain, parts, options, extras); };
  return best_of_models(fit, kAllExtras, options, within_errors(parts));
}

}  // namespace

Candidate fit_chain(const chain::Chain& chain, const std::vector<Part>& parts, const std::vector<Part>& rough,
                    const Options& options) {
  if (rough.empty()) return fit_candidates(chain, parts, options);
  const chain::Chain& few = rough.front().chain;
  const std::string from = "from the parameters of " + std::to_string(few.links() - 1) + " joints";
  std::vector<Candidate> found;  // without extras, and the best one with them
  const auto fit_few = [&](const Extras& extras) {
    Candidate one = fit_about_rod(few, rough, options, extras);
    if (found.empty()) found.push_back(one);
    return one;
  };
  const Candidate chosen = best_of_models(fit_few, kAllExtras, options, within_errors(rough));
  if (chosen.extras.friction || chosen.extras.payload) found.push_back(chosen);
  const auto fit_many = [&](const Extras& extras) {
    const bool plain = !extras.friction && !extras.payload;
    const Candidate& like = plain ? found.front() : found.back();
    const auto start = [&](const Problem& problem) {
      VectorX p = problem.mean;
      p.head(problem.shared) = start_from(few, like.problem.parts[0].unknowns, like.problem.of_part(like.fit.p, 0),
                                          chain, problem.parts[0].unknowns)
                                   .head(problem.shared);
      return p;
    };
    core::say_more("identify: " + from);
    return fit_about_rod(chain, parts, options, extras, start);
  };
  if (found.front().fit.cost < kInfinity) {
    const std::span<const Extras> asked(&chosen.extras, found.size() - 1);
    Candidate fine = best_of_models(fit_many, asked, options, within_errors(parts));
    if (fine.fit.cost < kInfinity) return fine;
  }
  core::warn("identify: " + from + " the motion of " + std::to_string(chain.links() - 1) +
             " does not stay finite; the usual starts take their place, which can take hours");
  return fit_candidates(chain, parts, options);
}

}  // namespace chainsplat::identification
