// The search: random motions scaled to the arm's limits, the best of them refined by random changes that shrink where
// they stop helping. An evaluation is a rollout with sensitivities, tens of milliseconds: no gradient is needed.
#include <algorithm>
#include <cmath>
#include <limits>

#include "chainsplat/excitation.h"
#include "src/math/decompositions.h"

namespace chainsplat::excitation {
namespace {

using planning::Axis;

constexpr double kPiece = 2.0;          // s, of one stretch of basis functions: up to about 2 Hz
constexpr double kOverlap = 0.5;        // of a stretch with the next: no rest between them
constexpr int kChanges = 8;             // a generation
constexpr double kFirstChange = 0.5;    // of a weight's spread
constexpr double kSmallerChange = 0.7;  // by which it shrinks after a generation without a better motion
constexpr double kMargin = 0.998;       // of a limit: peaks lie between the points of the grid
constexpr double kGrid = 2e-3;          // s, of that grid
constexpr int kMaxSofter = 16;          // times that a motion which asks too much of rope or twin is made smaller
constexpr double kSofter = 0.8;
constexpr double kSharpest = 2.0;  // diameters: the smallest radius that a motion bends the rope to
// of the length: what the twin's own uncertainty may spread its prediction by. A rollout and a recording that are
// further apart are no longer related by derivatives.
constexpr double kMaxSpread = 0.05;
constexpr int kMostFrames = 100000;  // each has the derivatives of all angles by all parameters: some 10 kB

struct Candidate {
  planning::Motion motion;
  int softer = 0;  // times that it was made smaller than the arm's limits ask
  double value = -std::numeric_limits<double>::infinity();
};

std::vector<Axis> default_axes(const Problem& problem) {
  if (problem.tabletop) return {Axis::x, Axis::y, Axis::yaw};
  return chain::bends_in_space(problem.model.chain) ? std::vector<Axis>{Axis::x, Axis::y}
                                                                        : std::vector<Axis>{Axis::x};
}

void scale(planning::Motion& motion, double translation, double yaw) {
  for (planning::Piece& piece : motion.pieces)
    for (std::size_t a = 0; a < motion.axes.size(); ++a)
      piece.weights.col(static_cast<Eigen::Index>(a)) *= motion.axes[a] == Axis::yaw ? yaw : translation;
}

// The motion is linear in its weights: scaled so that the tightest limit is just met.
void scale_to_limits(planning::Motion& motion, const Options& options) {
  const planning::Limits& l = options.limits;
  const auto factor = [&](const planning::Peaks& p, bool yaw) {
    double out = std::numeric_limits<double>::infinity();
    const auto use = [&](double limit, double peak) { out = peak > 0.0 ? std::min(out, kMargin * limit / peak) : out; };
    if (yaw) {
      use(l.yaw_velocity, p.yaw_velocity), use(l.yaw_acceleration, p.yaw_acceleration);
      use(l.yaw_jerk, p.yaw_jerk), use(l.turn, p.turn);
    } else {
      use(l.velocity, p.velocity), use(l.acceleration, p.acceleration), use(l.jerk, p.jerk), use(l.stroke, p.stroke);
    }
    return std::isfinite(out) ? out : 0.0;
  };
  const planning::Peaks peaks = planning::peaks(motion, 0.0, options.duration, l, kGrid);
  scale(motion, factor(peaks, false), factor(peaks, true));
}

double log_det(const MatrixX& positive) {
  const Eigen::LLT<MatrixX> factor(positive);
  if (factor.info() != Eigen::Success) return -std::numeric_limits<double>::infinity();
  return 2.0 * factor.matrixLLT().diagonal().array().log().sum();
}

// Of the estimates that are parameters.
struct Known {
  std::vector<dynamics::Unknown> unknowns;
  MatrixX covariance, information;
};

Known known_parameters(const Problem& problem) {
  const dynamics::Estimates& e = problem.estimates;
  const auto size = static_cast<Eigen::Index>(e.names.size());
  if (size == 0 || e.covariance.rows() != size || e.covariance.cols() != size || !e.covariance.allFinite())
    throw InputError("excite", "the twin knows no covariance of its parameters", "identify it first");
  const std::vector<dynamics::Unknown> all = dynamics::unknowns_of(problem.model.chain, e);
  const std::vector<Eigen::Index> kept = dynamics::parameters_among(all);
  Known known;
  for (Eigen::Index i : kept) known.unknowns.push_back(all[i]);
  if (kept.empty()) throw InputError("excite", "the twin has no identified parameter", "identify it first");
  known.covariance = e.covariance(kept, kept);
  known.covariance = (0.5 * (known.covariance + known.covariance.transpose())).eval();
  // written and read, it may be off positive by rounding
  known.covariance.diagonal() *= 1.0 + 1e-9;
  const Eigen::LDLT<MatrixX> factor(known.covariance);
  if (!math::is_positive(factor))
    throw InputError("excite", "the covariance of the twin's parameters is not positive definite", "identify it again");
  known.information = factor.solve(MatrixX::Identity(known.covariance.rows(), known.covariance.cols()));
  return known;
}

// Of one more recording of the old motion where points have the given noise; without information where there is none.
Forecast forecast_of_repetition(const Problem& problem, const Known& known, double frame_rate, double noise) {
  if (!problem.recorded) return {};
  std::vector<double> times;
  for (int k = 0; problem.recorded_start + k / frame_rate <= problem.recorded_end + 1e-9; ++k)
    times.push_back(problem.recorded_start + k / frame_rate);
  if (times.size() < 2) return {};
  dynamics::InitialState initial = problem.initial;
  initial.time = problem.recorded_start;
  return forecast(problem.model, known.unknowns, known.covariance, problem.recorded, initial, times, noise);
}

// The noise with which the old recording tells no combination of parameters better than the twin knows it, and one as
// well (mathematics.md 5.7): errors of the model, of marks and of images, as identification reckoned with them.
double noise_of_recording(const Problem& problem, const Known& known, double frame_rate) {
  constexpr double kUnknown = 2e-3;  // m, where there is no old motion
  constexpr double kSame = 1e-3;     // of the noise
  constexpr int kMost = 10;          // usually three; the initial state, which has a prior, makes it more than one
  const MatrixX root = known.covariance.llt().matrixL();
  double noise = kUnknown;
  for (int i = 0; i < kMost; ++i) {
    const MatrixX told = forecast_of_repetition(problem, known, frame_rate, noise).information;
    if (!told.size()) return kUnknown;
    const Eigen::SelfAdjointEigenSolver<MatrixX> eigen(MatrixX(root.transpose() * told * root), Eigen::EigenvaluesOnly);
    const double factor = std::sqrt(eigen.eigenvalues().maxCoeff());
    if (!std::isfinite(factor) || !(factor > 0.0)) return kUnknown;
    noise *= factor;
    if (std::abs(factor - 1.0) < kSame) break;
  }
  return noise;
}

// All that stays the same during the search.
struct Search {
  const Problem& problem;
  const Options& options;
  std::vector<Axis> axes;
  Known known;
  double noise = 0.0;       // m
  Forecast repeated;        // of the old motion
  double max_spread = 0.0;  // m
  VectorX max_bend;         // rad, per angle
  double known_log_det = 0.0;
  std::vector<double> times;  // s, of the frames
  dynamics::InitialState initial;
};

VectorX largest_bends(const chain::Chain& chain, double max_bend) {
  VectorX out = VectorX::Constant(chain.angles(), max_bend);
  for (int k = 0; k < chain.angles(); ++k)
    if (!chain::is_twist(chain, k))
      out[k] = std::min(out[k], chain::bent_length(chain, chain.child_link[k]) / (kSharpest * chain.diameter));
  return out;
}

Search make_search(const Problem& problem, const Options& options) {
  if (const double seconds = std::max(options.duration, problem.recorded_end - problem.recorded_start);
      options.frame_rate * seconds > kMostFrames)
    throw InputError("`frame_rate`",
                     core::exact(options.frame_rate) + " frames a second for " + core::exact(seconds) +
                         " s are more than the " + std::to_string(kMostFrames) + " frames that fit into memory",
                     "give those of the camera, for example 30");
  Search search{problem,
                options,
                options.axes.empty() ? default_axes(problem) : options.axes,
                known_parameters(problem),
                0.0,
                {},
                0.0,
                largest_bends(problem.model.chain, options.max_bend),
                0.0,
                {},
                problem.initial};
  search.noise = options.noise ? *options.noise : noise_of_recording(problem, search.known, options.frame_rate);
  search.repeated = forecast_of_repetition(problem, search.known, options.frame_rate, search.noise);
  // a twin that predicts its own recording no better is given motions of that kind
  search.max_spread = std::max(kMaxSpread * problem.model.chain.length, search.repeated.spread);
  search.known_log_det = log_det(search.known.information);
  for (int k = 0; k / options.frame_rate <= options.duration + 1e-9; ++k)
    search.times.push_back(k / options.frame_rate);
  search.initial.time = 0.0;
  return search;
}

// Whether the rope follows the motion without a joint that bends too far.
bool stays_within_bend(const Search& search, const planning::Motion& motion) {
  const dynamics::Model& model = search.problem.model;
  const auto grid = dynamics::sample_base([&](double t) { return planning::base_at(motion, t); }, 0.0, search.times,
                                          model.parameters.substeps);
  chain::States states;
  if (!dynamics::simulate(model, grid, search.initial, states)) return false;
  return std::all_of(states.theta.begin(), states.theta.end(), [&](const VectorX& theta) {
    return ((theta - search.initial.theta).cwiseAbs().array() <= search.max_bend.array()).all();
  });
}

Forecast forecast_of(const Search& search, const planning::Motion& motion) {
  return forecast(
      search.problem.model, search.known.unknowns, search.known.covariance,
      [&](double t) { return planning::base_at(motion, t); }, search.initial, search.times, search.noise);
}

// Makes the motion as large as limits, rope and twin allow, and values it.
void evaluate(const Search& search, Candidate& candidate) {
  scale_to_limits(candidate.motion, search.options);
  const auto soften = [&](int times) { scale(candidate.motion, std::pow(kSofter, times), std::pow(kSofter, times)); };
  soften(candidate.softer);
  for (int more = 1; candidate.softer < kMaxSofter; candidate.softer += more, soften(more)) {
    more = 1;
    if (!stays_within_bend(search, candidate.motion)) continue;
    const Forecast told = forecast_of(search, candidate.motion);
    if (!told.information.size()) continue;
    if (const double over = told.spread / search.max_spread; over > 1.0) {
      // near chaos it falls with the fourth power of the motion's size and faster: several steps at once, since a
      // forecast is what costs time
      more = std::max(1, static_cast<int>(std::log(over) / (-4.0 * std::log(kSofter))));
      continue;
    }
    candidate.value = log_det(search.known.information + told.information);
    return;
  }
}

// Values all of them; returns the best.
Candidate best_of(const Search& search, std::vector<Candidate>& candidates) {
  core::parallel_for(static_cast<std::int64_t>(candidates.size()),
                     [&](std::int64_t i) { evaluate(search, candidates[i]); });
  return *std::max_element(candidates.begin(), candidates.end(),
                           [](const Candidate& a, const Candidate& b) { return a.value < b.value; });
}

MatrixX random_weights(const Search& search, core::Random& random) {
  MatrixX weights(planning::kBasisCount, static_cast<Eigen::Index>(search.axes.size()));
  for (double& w : weights.reshaped()) w = random.normal();
  return weights;
}

// Stretches of basis functions that overlap, with random weights.
std::vector<Candidate> random_motions(const Search& search, core::Random& random) {
  const Options& options = search.options;
  const int pieces =
      std::max(1, static_cast<int>(std::floor((options.duration - kPiece) / (kOverlap * kPiece) + 1e-9)) + 1);
  const double piece = std::min(kPiece, options.duration);
  const double shift = pieces > 1 ? (options.duration - piece) / (pieces - 1) : 0.0;
  std::vector<Candidate> candidates(std::max(1, options.starts));
  for (Candidate& c : candidates) {
    c.motion.origin = search.problem.base;
    c.motion.up = -search.problem.model.parameters.gravity.normalized();
    if (!c.motion.up.allFinite()) c.motion.up = math::Vector3::UnitZ();
    c.motion.axes = search.axes;
    for (int i = 0; i < pieces; ++i)
      c.motion.pieces.push_back({i * shift, piece, random_weights(search, random),
                                 VectorX::Zero(static_cast<Eigen::Index>(search.axes.size()))});
  }
  return candidates;
}

// Random changes of the best motion, smaller where none was better.
Candidate refine(const Search& search, Candidate best, core::Random& random) {
  double change = kFirstChange;
  for (int generation = 0; generation < search.options.generations; ++generation) {
    if (core::stop_requested()) throw Interrupted(core::stop_requested());
    double spread = 0.0, count = 0.0;
    for (const auto& p : best.motion.pieces)
      spread += p.weights.squaredNorm(), count += static_cast<double>(p.weights.size());
    spread = std::sqrt(spread / count);
    std::vector<Candidate> candidates(kChanges, best);
    for (Candidate& c : candidates) {
      c.value = -std::numeric_limits<double>::infinity();
      c.softer = std::max(0, best.softer - 1);  // most that was tried before is too large again
      for (auto& p : c.motion.pieces) p.weights += change * spread * random_weights(search, random);
    }
    const Candidate other = best_of(search, candidates);
    if (other.value > best.value)
      best = other;
    else
      change *= kSmallerChange;
    core::report({"excite", generation + 1, search.options.generations, -best.value, NAN, "refining the motion"});
  }
  return best;
}

std::vector<double> standard_errors(const MatrixX& information) {
  const MatrixX covariance = information.ldlt().solve(MatrixX::Identity(information.rows(), information.cols()));
  std::vector<double> out;
  for (Eigen::Index i = 0; i < covariance.rows(); ++i) out.push_back(std::sqrt(covariance(i, i)));
  return out;
}

Prediction predict(const Search& search, const Candidate& best, const Forecast& told) {
  const Known& known = search.known;
  const auto size = static_cast<double>(known.unknowns.size());
  Prediction out;
  for (const dynamics::Unknown& unknown : known.unknowns) out.names.push_back(dynamics::name_of(unknown));
  out.now = standard_errors(known.information);
  out.excited = standard_errors(known.information + told.information);
  out.gain = (best.value - search.known_log_det) / size;
  if (const MatrixX& again = search.repeated.information; again.size()) {
    out.repeated = standard_errors(known.information + again);
    out.repeated_gain = (log_det(known.information + again) - search.known_log_det) / size;
  }
  return out;
}

}  // namespace

void Options::check() const {
  constexpr double kShortest = 0.5, kLongest = 120.0;  // s
  if (!(duration >= kShortest && duration <= kLongest))
    throw InputError("`duration`", "is " + core::exact(duration) + " s",
                     "give " + core::exact(kShortest) + " to " + core::exact(kLongest) + " s");
  const std::pair<const char*, double> positive[] = {{"`noise`", noise.value_or(1.0)},
                                                     {"`frame_rate`", frame_rate},
                                                     {"`max_bend`", max_bend},
                                                     {"`velocity`", limits.velocity},
                                                     {"`acceleration`", limits.acceleration},
                                                     {"`jerk`", limits.jerk},
                                                     {"`stroke`", limits.stroke},
                                                     {"`yaw_velocity`", limits.yaw_velocity},
                                                     {"`yaw_acceleration`", limits.yaw_acceleration},
                                                     {"`yaw_jerk`", limits.yaw_jerk},
                                                     {"`turn`", limits.turn}};
  for (const auto& [name, value] : positive)
    if (!(value > 0.0)) throw InputError(name, "is " + core::exact(value), "give a number above 0");
}

Result excite(const Problem& problem, const Options& options) {
  options.check();
  const Search search = make_search(problem, options);
  core::Random random(options.seed * 1000003u + 17u);
  std::vector<Candidate> candidates = random_motions(search, random);
  Candidate best = best_of(search, candidates);
  if (!std::isfinite(best.value))
    throw WorkError("excite",
                    "no motion keeps every joint within " + core::exact(options.max_bend) + " rad, and the twin's " +
                        "prediction within " + core::exact(std::round(1e3 * search.max_spread)) + " mm",
                    "raise `max_bend`, lower `acceleration` or shorten `duration`");
  best = refine(search, best, random);

  Result result;
  result.motion = best.motion;
  result.peaks = planning::peaks(best.motion, 0.0, options.duration, options.limits);
  result.noise = search.noise;
  const Forecast told = forecast_of(search, best.motion);
  result.states = told.states;
  result.spread = told.spread;
  result.prediction = predict(search, best, told);
  return result;
}

}  // namespace chainsplat::excitation
