#include "chainsplat/identification.h"

#include <algorithm>
#include <cmath>
#include <cstdio>

#include "coarse.h"
#include "models.h"
#include "uncertainty.h"
#include "windows.h"

namespace chainsplat::identification {
namespace {

// How well a recording can be followed with parameters of its own, from those of all.
double alone_rms(const Problem& problem, std::size_t index, const VectorX& p) {
  constexpr int kIterations = 8;
  const Problem alone = make_problem(problem.chain, {problem.parts[index]});
  Fit fit;
  fit.p = problem.of_part(p, index);
  improve(alone, kInfinity, true, kIterations, fit);
  Rollouts rollouts(alone, kInfinity, true);
  return fit.cost < kInfinity && rollouts.run(alone, fit.p, false) ? rms_of(alone.parts[0], rollouts.states[0])
                                                                   : kInfinity;
}

// `alone`: how well each part could be followed without the others is asked, too.
std::vector<Result> fit_parts(const chain::Chain& chain, std::vector<Part> parts, const std::vector<Part>& rough,
                              const Options& options, bool alone) {
  const auto paper = [&] {
    Candidate only{{}, make_problem(chain, std::move(parts)), {}};
    only.fit = fit_angles(only.problem, options);
    return only;
  };
  const Candidate chosen = options.paper ? paper() : fit_chain(chain, parts, rough, options);
  if (chosen.extras.friction) core::say_more("identify: the motion asks for friction in bending");
  if (chosen.extras.payload) core::say_more("identify: the motion asks for a payload at the free end");
  const Problem& problem = chosen.problem;
  const Fit& fit = chosen.fit;
  Rollouts rollouts(problem, kInfinity, true);
  if (fit.cost == kInfinity || !rollouts.run(problem, fit.p, true))
    throw WorkError("identify", "no parameters gave a rollout that stays finite",
                    "check the base trajectory, the recognized angles and the object's length");
  const solve::ArrowEquations data = normal_equations(problem, rollouts, fit.limit);
  const MatrixX covariance = covariance_of(problem, solve::dense(data).matrix, rollouts, fit.limit);
  if (fit.summary.reason == solve::Reason::last_iteration && !options.paper)
    core::warn("identify: the fit " + solve::describe(fit.summary) + "; the parameters may not be the best ones yet");
  const Eigen::Index shared = problem.shared, own = problem.own();
  const double misfit = misfit_of(rollouts).scale;

  std::vector<Result> results(problem.parts.size());
  const std::vector<dynamics::Estimates::Weak> weak = weak_directions(problem, data);
  for (std::size_t i = 0; i < results.size(); ++i) {
    Result& result = results[i];
    const Part& part = problem.parts[i];
    const VectorX p = problem.of_part(fit.p, i);
    const State state = apply(chain, part.unknowns, p);
    result.parameters = state.parameters;
    result.initial = state.initial;
    result.initial.time = part.times[0];
    result.rollout = std::move(rollouts.states[i]);
    result.node_rms = result.alone_rms = rms_of(part, result.rollout);
    if (alone && !options.paper) result.alone_rms = std::min(result.node_rms, alone_rms(problem, i, fit.p));
    dynamics::Estimates& e = result.estimates;
    e.names = part.unknowns.names();
    e.held = part.unknowns.held;
    e.solver = fit.summary;
    e.weak = weak;
    if (!options.paper) e.misfit = misfit;
    e.values.assign(p.begin(), p.end());
    const Eigen::Index first = shared + static_cast<Eigen::Index>(i) * own;
    e.covariance.resize(shared + own, shared + own);
    e.covariance << covariance.topLeftCorner(shared, shared), covariance.block(0, first, shared, own),
        covariance.block(first, 0, own, shared), covariance.block(first, first, own, own);
    for (Eigen::Index k = 0; k < p.size(); ++k) e.standard_errors.push_back(std::sqrt(e.covariance(k, k)));
  }
  return results;
}

// The parts of recordings, and those of the chain `few` where there is one and all recordings tell its motion. They
// refer to both chains.
struct Parts {
  std::vector<Part> parts, rough;
};

Parts make_parts(const chain::Chain& chain, const std::optional<chain::Chain>& few,
                 std::span<const Recording> recordings, const Options& options) {
  Parts out;
  for (const Recording& r : recordings) {
    out.parts.push_back(make_part(chain, r.base, r.recognized, options));
    if (!few) continue;
    const Markers markers = centerline_markers(chain, r.base, r.recognized, *few, options.model_error);
    if (markers.time.size() >= kLeastTimes)
      out.rough.push_back(make_part(*few, r.base, fit_markers(*few, r.base, markers).states, options, &markers));
  }
  if (out.rough.size() < out.parts.size()) out.rough.clear();
  return out;
}

Parts make_parts(const chain::Chain& chain, const std::optional<chain::Chain>& few,
                 std::span<const MarkerRecording> recordings, const Options& options) {
  Parts out;
  for (const MarkerRecording& r : recordings) {
    out.parts.push_back(make_part(chain, r.base, fit_markers(chain, r.base, r.markers).states, options, &r.markers));
    if (few)
      out.rough.push_back(make_part(*few, r.base, fit_markers(*few, r.base, r.markers).states, options, &r.markers));
  }
  return out;
}

const std::vector<double>& times_of(const Recording& recording) { return recording.recognized.time; }
const std::vector<double>& times_of(const MarkerRecording& recording) { return recording.markers.time; }

chain::States shapes_of(const chain::Chain&, const Recording& recording) {
  return {recording.recognized.time, recording.recognized.theta, {}, {}};
}
chain::States shapes_of(const chain::Chain& chain, const MarkerRecording& recording) {
  return fit_markers(chain, recording.base, recording.markers).states;
}

Recording window_of(const Recording& recording, const std::vector<std::size_t>& frames) {
  Recording out{recording.base, {}};
  for (const std::size_t k : frames) {
    out.recognized.time.push_back(recording.recognized.time[k]);
    out.recognized.theta.push_back(recording.recognized.theta[k]);
    if (!recording.recognized.covariance.empty())
      out.recognized.covariance.push_back(recording.recognized.covariance[k]);
  }
  return out;
}
MarkerRecording window_of(const MarkerRecording& recording, const std::vector<std::size_t>& frames) {
  MarkerRecording out{recording.base, {recording.markers.arclengths, {}, {}, recording.markers.deviation}};
  for (const std::size_t k : frames) {
    out.markers.time.push_back(recording.markers.time[k]);
    out.markers.world.push_back(recording.markers.world[k]);
  }
  return out;
}

// What the windows of a recording say of it: all begin with the first one's initial state.
Result joined(const chain::Chain& chain, const trajectory::Trajectory& base, const std::vector<double>& times,
              std::span<const Result> windows) {
  Result out = windows.front();
  double squares = 0.0, alone = 0.0, frames = 0.0;
  for (const Result& window : windows) {
    const auto count = static_cast<double>(window.rollout.time.size());
    squares += count * window.node_rms * window.node_rms, alone += count * window.alone_rms * window.alone_rms;
    frames += count;
  }
  out.node_rms = std::sqrt(squares / frames), out.alone_rms = std::sqrt(alone / frames);
  out.rollout = dynamics::rollout(dynamics::make_model(chain, out.parameters), base, out.initial, times);
  return out;
}

// Of all recordings; of windows of them, where all of it has more than Options::most_numbers.
template <class R>
std::vector<Result> fit_recordings(const chain::Chain& chain, std::span<const R> recordings, const Options& options) {
  const bool several = recordings.size() > 1;
  const std::optional<chain::Chain> few = with_few_joints(chain, options);
  const std::size_t most = options.most_numbers / static_cast<std::size_t>(chain.angles() * chain.angles());
  std::size_t all = 0;
  for (const R& recording : recordings) all += times_of(recording).size();
  if (all <= most) {
    Parts parts = make_parts(chain, few, recordings, options);
    return fit_parts(chain, std::move(parts.parts), parts.rough, options, several);
  }
  std::vector<R> windows;
  std::vector<std::size_t> first;  // window of a recording
  for (const R& recording : recordings) {
    first.push_back(windows.size());
    const std::size_t share = std::max(kLeastTimes, most * times_of(recording).size() / all);
    for (const std::vector<std::size_t>& frames : windows_of(shapes_of(chain, recording), share)) {
      windows.push_back(window_of(recording, frames));
      const std::vector<double>& times = times_of(windows.back());
      char text[120];
      std::snprintf(text, sizeof text,
                    "identify: too long to fit whole with so many angles; one window is %.2f to %.2f s", times.front(),
                    times.back());
      core::say_more(text);
    }
  }
  first.push_back(windows.size());
  Parts parts = make_parts(chain, few, std::span<const R>(windows), options);
  const std::vector<Result> found = fit_parts(chain, std::move(parts.parts), parts.rough, options, several);
  std::vector<Result> results;
  for (std::size_t i = 0; i < recordings.size(); ++i)
    results.push_back(joined(chain, recordings[i].base, times_of(recordings[i]),
                             std::span(found).subspan(first[i], first[i + 1] - first[i])));
  return results;
}

}  // namespace

dynamics::InitialState fit_initial(const chain::Chain& chain, const dynamics::Parameters& parameters,
                                   const trajectory::Trajectory& base, const Markers& markers, double seconds) {
  constexpr int kIterations = 30, kMostRefinement = 32;  // of the steps, as a rollout refines them
  Options options;
  options.tabletop = parameters.table_normal.has_value();
  const chain::States shapes = fit_markers(chain, base, markers).states;
  for (int refinement = 1; refinement <= kMostRefinement; refinement *= 2) {
    options.substeps = refinement * parameters.substeps;
    std::vector<Part> parts{make_part(chain, base, shapes, options, &markers)};
    parts[0].unknowns = make_state_unknowns(chain, parameters, parts[0].start);
    const Problem problem = make_problem(chain, std::move(parts));
    Fit fit;
    fit.p = problem.mean;
    improve(problem, seconds, true, kIterations, fit);
    if (fit.cost == kInfinity) continue;
    dynamics::InitialState found = apply(chain, problem.parts[0].unknowns, problem.of_part(fit.p, 0)).initial;
    found.time = problem.parts[0].times[0];
    return found;
  }
  throw WorkError("identify", "no initial state gave a rollout that stays finite", "check the markers and the twin");
}

std::vector<Result> identify(const chain::Chain& chain, std::span<const Recording> recordings, const Options& options) {
  return fit_recordings(chain, recordings, options);
}

std::vector<Result> identify(const chain::Chain& chain, std::span<const MarkerRecording> recordings,
                             const Options& options) {
  return fit_recordings(chain, recordings, options);
}

Result identify(const chain::Chain& chain, const trajectory::Trajectory& base, const chain::States& recognized,
                const Options& options) {
  const Recording recording{base, recognized};
  return std::move(identify(chain, std::span(&recording, 1), options).front());
}

Result identify(const chain::Chain& chain, const trajectory::Trajectory& base, const Markers& markers,
                const Options& options) {
  const MarkerRecording recording{base, markers};
  return std::move(identify(chain, std::span(&recording, 1), options).front());
}

}  // namespace chainsplat::identification
