// The search: random motions scaled to the arm's limits, the best of them refined by random changes that shrink where
// they stop helping. An evaluation is a rollout with sensitivities, tens of milliseconds: no gradient is needed.
#include <algorithm>
#include <cmath>
#include <limits>

#include "chainsplat/excitation.h"

namespace chainsplat::excitation {
namespace {

using planning::Axis;

constexpr double kPiece = 2.0;        // s, of one stretch of basis functions: up to about 2 Hz
constexpr double kOverlap = 0.5;      // of a stretch with the next: no rest between them
constexpr int kChanges = 8;           // a generation
constexpr double kFirstChange = 0.5;  // of a weight's spread
constexpr double kMargin = 0.998;     // of a limit: peaks lie between the points of the grid
constexpr double kGrid = 2e-3;        // s, of that grid
constexpr int kMaxSofter = 12;        // times that a motion which bends the rope too far is made smaller
constexpr double kSofter = 0.8;

struct Candidate {
  planning::Motion motion;
  double value = -std::numeric_limits<double>::infinity();
};

std::vector<Axis> default_axes(const Problem& problem) {
  if (problem.tabletop) return {Axis::x, Axis::y, Axis::yaw};
  return problem.model.chain.angles() > problem.model.chain.links() - 1 ? std::vector<Axis>{Axis::x, Axis::y}
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

}  // namespace

Result excite(const Problem& problem, const Options& options) {
  if (!(options.duration >= 0.5 && options.duration <= 120.0))
    throw InputError("`duration`", "is " + core::exact(options.duration) + " s", "give 0.5 to 120 s");
  if (!(options.noise > 0.0) || !(options.frame_rate > 0.0) || !(options.max_bend > 0.0))
    throw InputError("excite", "noise, frame rate or largest bend is not above 0", "give numbers above 0");
  const planning::Limits& l = options.limits;
  for (double limit :
       {l.velocity, l.acceleration, l.jerk, l.stroke, l.yaw_velocity, l.yaw_acceleration, l.yaw_jerk, l.turn})
    if (!(limit > 0.0)) throw InputError("excite", "a limit is not above 0", "give limits that allow a motion");
  const Known known = known_parameters(problem);
  const auto axes = options.axes.empty() ? default_axes(problem) : options.axes;
  const double known_log_det = log_det(known.information);

  std::vector<double> times;
  for (int k = 0; k / options.frame_rate <= options.duration + 1e-9; ++k) times.push_back(k / options.frame_rate);
  dynamics::InitialState initial = problem.initial;
  initial.time = 0.0;

  const auto simulate = [&](const planning::Motion& motion, chain::States& states) {
    const auto grid = dynamics::sample_base([&](double t) { return planning::base_at(motion, t); }, 0.0, times,
                                            problem.model.parameters.substeps);
    if (!dynamics::simulate(problem.model, grid, initial, states)) return false;
    for (const VectorX& theta : states.theta)
      if (!((theta - initial.theta).cwiseAbs().maxCoeff() <= options.max_bend)) return false;
    return true;
  };
  const auto evaluate = [&](Candidate& c) {
    scale_to_limits(c.motion, options);
    chain::States states;
    int softer = 0;
    for (; softer < kMaxSofter && !simulate(c.motion, states); ++softer) scale(c.motion, kSofter, kSofter);
    if (softer == kMaxSofter) return;
    const MatrixX told = information(
        problem.model, known.unknowns, [&](double t) { return planning::base_at(c.motion, t); }, initial, times,
        options.noise);
    if (told.size()) c.value = log_det(known.information + told);
  };
  const auto best_of = [](std::vector<Candidate>& candidates) {
    return *std::max_element(candidates.begin(), candidates.end(),
                             [](const Candidate& a, const Candidate& b) { return a.value < b.value; });
  };

  core::Random random(options.seed * 1000003u + 17u);
  const int pieces =
      std::max(1, static_cast<int>(std::floor((options.duration - kPiece) / (kOverlap * kPiece) + 1e-9)) + 1);
  const double piece = std::min(kPiece, options.duration);
  const double shift = pieces > 1 ? (options.duration - piece) / (pieces - 1) : 0.0;
  const auto random_weights = [&] {
    MatrixX weights(planning::kBasisCount, static_cast<Eigen::Index>(axes.size()));
    for (double& w : weights.reshaped()) w = random.normal();
    return weights;
  };
  std::vector<Candidate> candidates(std::max(1, options.starts));
  for (Candidate& c : candidates) {
    c.motion.origin = problem.base;
    c.motion.up = -problem.model.parameters.gravity.normalized();
    if (!c.motion.up.allFinite()) c.motion.up = math::Vector3::UnitZ();
    c.motion.axes = axes;
    for (int i = 0; i < pieces; ++i)
      c.motion.pieces.push_back(
          {i * shift, piece, random_weights(), VectorX::Zero(static_cast<Eigen::Index>(axes.size()))});
  }
  const auto evaluate_all = [&] {
    core::parallel_for(static_cast<std::int64_t>(candidates.size()), [&](std::int64_t i) { evaluate(candidates[i]); });
  };
  evaluate_all();
  Candidate best = best_of(candidates);
  if (!std::isfinite(best.value))
    throw WorkError("excite", "no motion keeps every joint within " + core::exact(options.max_bend) + " rad",
                    "raise `max_bend` or lower `acceleration`");
  double change = kFirstChange;
  for (int generation = 0; generation < options.generations; ++generation) {
    if (core::stop_requested()) throw Interrupted(core::stop_requested());
    double spread = 0.0, count = 0.0;
    for (const auto& p : best.motion.pieces)
      spread += p.weights.squaredNorm(), count += static_cast<double>(p.weights.size());
    spread = std::sqrt(spread / count);
    candidates.assign(kChanges, best);
    for (Candidate& c : candidates) {
      c.value = -std::numeric_limits<double>::infinity();
      for (auto& p : c.motion.pieces) p.weights += change * spread * random_weights();
    }
    evaluate_all();
    const Candidate other = best_of(candidates);
    if (other.value > best.value)
      best = other;
    else
      change *= 0.7;
    core::report({"excite", generation + 1, options.generations, -best.value, NAN, "refining the motion"});
  }

  Result result;
  result.motion = best.motion;
  result.peaks = planning::peaks(best.motion, 0.0, options.duration, options.limits);
  const auto size = static_cast<double>(known.unknowns.size());
  const auto errors = [](const MatrixX& information) {
    const MatrixX covariance = information.ldlt().solve(MatrixX::Identity(information.rows(), information.cols()));
    std::vector<double> out;
    for (Eigen::Index i = 0; i < covariance.rows(); ++i) out.push_back(std::sqrt(covariance(i, i)));
    return out;
  };
  Prediction& p = result.prediction;
  for (const dynamics::Unknown& unknown : known.unknowns) p.names.push_back(dynamics::name_of(unknown));
  p.now = errors(known.information);
  const MatrixX told = information(
      problem.model, known.unknowns, [&](double t) { return planning::base_at(best.motion, t); }, initial, times,
      options.noise, &result.states);
  p.excited = errors(known.information + told);
  p.gain = (best.value - known_log_det) / size;
  if (problem.recorded) {
    std::vector<double> old;
    for (int k = 0; problem.recorded_start + k / options.frame_rate <= problem.recorded_end + 1e-9; ++k)
      old.push_back(problem.recorded_start + k / options.frame_rate);
    initial.time = problem.recorded_start;
    const MatrixX again = old.size() < 2
                              ? MatrixX()
                              : information(problem.model, known.unknowns, problem.recorded, initial, old,
                                            options.noise);
    if (again.size()) {
      p.repeated = errors(known.information + again);
      p.repeated_gain = (log_det(known.information + again) - known_log_det) / size;
    }
  }
  return result;
}

}  // namespace chainsplat::excitation
