#include "chainsplat/identification.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <functional>
#include <limits>
#include <memory>

#include "chainsplat/dynamics/rod.h"
#include "coarse.h"
#include "src/math/decompositions.h"
#include "unknowns.h"
#include "windows.h"

namespace chainsplat::identification {
namespace {

using dynamics::BaseGrid;
using dynamics::Quantity;
using math::Vector3;

constexpr double kHorizons[] = {1.0 / 3, 2.0 / 3, 4.0 / 3};  // s, then doubled until everything is within
// Of the length: open-loop error of a few links. Ropes of 0.3 m: 0.1 to 0.5 %; a foam noodle of 1.9 m: 2 %. Larger
// values let the priors hold what two markers cannot tell, smaller ones make the loss rough.
constexpr double kMarkerModelShare = 5e-3;
constexpr double kCorrelated = 9.0;  // model errors of neighbors in space and time are alike: so many count as one
constexpr double kHuber = 1.75;      // times the usual root mean square of a group of residuals
constexpr double kLeastUsual = 0.1;  // of the standard deviation expected: a closer fit does not make outliers
constexpr double kMedianRms = 0.9;   // median of the root mean square of a few unit normals
// A fit's last step lowers its cost by less: half the square of a step in standard errors, of which that is a twelfth.
constexpr double kLeastGain = 3e-3;
constexpr int kLag = 10;  // frames over which residuals are taken to be correlated (mathematics.md 5)
constexpr std::size_t kLeastTimes = 3;
constexpr double kInfinity = std::numeric_limits<double>::infinity();
constexpr double kUnknown = std::numeric_limits<double>::quiet_NaN();

// One recording, its own unknowns after the shared ones.
struct Part {
  const chain::Chain& chain;
  Unknowns unknowns;
  std::vector<double> times;
  std::vector<chain::MaterialPoint> points;  // that are compared
  std::vector<MatrixX> target;               // per frame: 3 x points, base frame
  std::vector<VectorX> theta;                // recognized
  // a frame: of the angles, n x n, in the metric of the points; of markers, 3 x 3 blocks side by side. Copies of a part
  // share them, since of many angles they are nearly all of it.
  std::shared_ptr<const std::vector<MatrixX>> whitening;
  BaseGrid grids[2];                  // half the substeps, for the way to the minimum, and all of them
  std::vector<std::size_t> nodes[2];  // of the grid, up to and with each output
  bool has_markers = false;           // the points are markers; unseen ones have no weight
  // of the first link, world axes, in the mean: of a rope that swings that in which it hangs
  Vector3 direction = Vector3::Zero();
  Start start = {};
};

// All recordings. The unknowns: those that are shared, then the initial state of each recording.
struct Problem {
  const chain::Chain& chain;
  std::vector<Part> parts;
  int shared = 0;
  VectorX mean;
  MatrixX precision;
  // Of a chain of many joints: what a fit may change the unknowns of a part by, unknowns x modes, the first ones the
  // shared unknowns alone and the others its initial state; empty: everything.
  MatrixX modes = {};
  int shared_modes = 0;
  Rod rod = {};  // that the unknowns of the parts are about

  int own() const { return parts[0].unknowns.size() - shared; }
  // where the unknowns of a recording are among all: `shared` and then its own
  VectorX of_part(const VectorX& p, std::size_t part) const {
    VectorX out(shared + own());
    out << p.head(shared), p.segment(shared + part * own(), own());
    return out;
  }
  auto modes_of_shared() const { return modes.topLeftCorner(modes.size() > 0 ? shared : 0, shared_modes); }
  auto modes_of_own() const {
    return modes.bottomRightCorner(modes.size() > 0 ? own() : 0, modes.cols() - shared_modes);
  }
  Eigen::Index coordinates() const {
    return shared_modes + static_cast<Eigen::Index>(parts.size()) * (modes.cols() - shared_modes);
  }
  // p with all modes moved by x.
  VectorX moved(const VectorX& p, const VectorX& x) const {
    VectorX out = p;
    out.head(shared) += modes_of_shared() * x.head(shared_modes);
    const Eigen::Index each = modes.cols() - shared_modes;
    for (Eigen::Index i = 0; i < static_cast<Eigen::Index>(parts.size()); ++i)
      out.segment(shared + i * own(), own()) += modes_of_own() * x.segment(shared_modes + i * each, each);
    return out;
  }
};

// Points of the centerline in the base frame and, where asked, their derivatives by theta.
void place_points(const Part& part, const VectorX& theta, MatrixX& points, std::vector<MatrixX>* slopes) {
  const auto motions = chain::link_motions(part.chain, theta, {});
  points.resize(3, part.points.size());
  for (std::size_t i = 0; i < part.points.size(); ++i)
    points.col(i) = motions[part.points[i].link] * part.points[i].home;
  if (slopes)
    *slopes = chain::point_jacobians(part.chain, chain::world_axes(part.chain, theta, {}), motions, part.points);
}

BaseGrid prefix(const Part& part, std::size_t frames, bool fine) {
  BaseGrid grid;
  const auto& nodes = part.grids[fine].nodes;
  grid.nodes.assign(nodes.begin(), nodes.begin() + part.nodes[fine][frames - 1] + 1);
  grid.nodes.back().step = 0.0;
  return grid;
}

std::size_t frames_within(const Part& part, double horizon) {
  std::size_t count = 0;
  while (count < part.times.size() && part.times[count] <= part.times[0] + horizon + 1e-9) ++count;
  return std::clamp<std::size_t>(count, 3, part.times.size());
}

// A motion with its derivatives, some unknowns on each thread. Every group moves the rope itself again; which unknowns
// are one does not depend on the number of threads, so that the bits do not either.
bool simulate_in_groups(const dynamics::Model& model, const BaseGrid& grid, const dynamics::InitialState& initial,
                        std::span<const dynamics::Tangent> unknowns, chain::States& states,
                        dynamics::Sensitivities& sensitivities) {
  constexpr std::size_t kGroup = 64;  // at least: their derivatives take several times as long as the motion
  const std::size_t count = std::max<std::size_t>(1, unknowns.size() / kGroup);
  const auto first = [&](std::size_t group) { return group * unknowns.size() / count; };
  std::vector<chain::States> moved(count);
  std::vector<dynamics::Sensitivities> slopes(count);
  std::vector<char> good(count);
  core::parallel_for(static_cast<std::int64_t>(count), [&](std::int64_t i) {
    const auto group = static_cast<std::size_t>(i);
    good[group] = dynamics::simulate(model, grid, initial, moved[group],
                                     unknowns.subspan(first(group), first(group + 1) - first(group)), &slopes[group]);
  });
  if (std::find(good.begin(), good.end(), 0) != good.end()) return false;
  states = std::move(moved[0]);
  sensitivities.theta.resize(states.theta.size());
  for (std::size_t k = 0; k < states.theta.size(); ++k) {
    MatrixX& all = sensitivities.theta[k];
    all.resize(model.chain.angles(), static_cast<Eigen::Index>(unknowns.size()));
    for (std::size_t i = 0; i < count; ++i) {
      all.middleCols(static_cast<Eigen::Index>(first(i)), slopes[i].theta[k].cols()) = slopes[i].theta[k];
      slopes[i].theta[k].resize(0, 0);  // or all derivatives were there twice
    }
  }
  return true;
}

// `modes`: the directions of the derivatives; empty: every unknown.
bool simulate(const Part& part, const BaseGrid& grid, const VectorX& p, chain::States& states,
              dynamics::Sensitivities* sensitivities, const MatrixX& modes) {
  const State state = apply(part.chain, part.unknowns, p);
  const dynamics::Model model = dynamics::make_model(part.chain, state.parameters);
  if (!sensitivities) return dynamics::simulate(model, grid, state.initial, states);
  auto unknowns = tangents(part.chain, part.unknowns, p);
  if (modes.size() > 0) unknowns = along(unknowns, modes);
  if (model.parameters.integrator == dynamics::Integrator::rodas3)
    return simulate_in_groups(model, grid, state.initial, unknowns, states, *sensitivities);
  // the Euler step has no variational equation: differences of rollouts
  if (!dynamics::simulate(model, grid, state.initial.theta, state.initial.thetadot, states)) return false;
  const std::size_t frames = states.theta.size();
  const int size = static_cast<int>(p.size());
  sensitivities->theta.assign(frames, MatrixX::Zero(part.chain.angles(), size));
  std::vector<char> good(size, 0);
  core::parallel_for(size, [&](std::int64_t i) {
    constexpr double kStep = 1e-5;  // of a log or an angle
    VectorX moved = p;
    moved[i] += kStep;
    const State shifted = apply(part.chain, part.unknowns, moved);
    chain::States out;
    if (!dynamics::simulate(dynamics::make_model(part.chain, shifted.parameters), grid, shifted.initial.theta,
                            shifted.initial.thetadot, out))
      return;
    good[i] = 1;
    for (std::size_t k = 0; k < frames; ++k) sensitivities->theta[k].col(i) = (out.theta[k] - states.theta[k]) / kStep;
  });
  return std::all_of(good.begin(), good.end(), [](char g) { return g != 0; });
}

// Whitened residuals of a frame in groups, its columns: all angles at once, or a marker each. The angles' weights are
// those of the centerline's points near the recognized shape (mathematics.md 5), so that they need no points here.
void residuals(const Part& part, const chain::States& states, std::vector<MatrixX>& out) {
  out.resize(states.theta.size());
  MatrixX points;
  for (std::size_t k = 0; k < states.theta.size(); ++k) {
    if (!part.has_markers) {
      out[k] = (*part.whitening)[k] * (states.theta[k] - part.theta[k]);
      continue;
    }
    place_points(part, states.theta[k], points, nullptr);
    out[k].resize(3, points.cols());
    for (Eigen::Index i = 0; i < points.cols(); ++i)
      out[k].col(i) = (*part.whitening)[k].middleCols<3>(3 * i) * (points.col(i) - part.target[k].col(i));
  }
}

// Of the groups' root mean squares.
double median_rms(const std::vector<std::vector<MatrixX>>& values) {
  std::vector<double> norms;
  for (const auto& part : values)
    for (const MatrixX& frame : part)
      for (Eigen::Index i = 0; i < frame.cols(); ++i)
        norms.push_back(frame.col(i).norm() / std::sqrt(static_cast<double>(frame.rows())));
  std::nth_element(norms.begin(), norms.begin() + norms.size() / 2, norms.end());
  return norms[norms.size() / 2];
}

// Huber's loss of whitened groups; `limit`: root mean square of a group from where on it grows linearly.
double loss_of(const std::vector<MatrixX>& values, double limit) {
  double loss = 0.0;
  for (const MatrixX& frame : values) {
    const double most = limit * std::sqrt(static_cast<double>(frame.rows()));
    for (Eigen::Index i = 0; i < frame.cols(); ++i) {
      const double r = frame.col(i).norm();
      loss += r <= most ? 0.5 * r * r : most * (r - 0.5 * most);
    }
  }
  return loss;
}

// Whitened residuals of frame k and, where asked for, their derivatives by the unknowns, with the roots of Huber's
// weights.
struct Rows {
  VectorX right;
  MatrixX slopes;  // residuals x unknowns
};

void weighted_rows(const Part& part, const chain::States& states, const dynamics::Sensitivities* slopes,
                   const std::vector<MatrixX>& values, double limit, std::size_t k, Rows& out) {
  const Eigen::Index group = values[k].rows(), groups = values[k].cols();
  const double most = limit * std::sqrt(static_cast<double>(group));
  MatrixX placed, by_angle(group * groups, part.chain.angles());
  std::vector<MatrixX> jacobians;
  out.right.resize(group * groups);
  if (part.has_markers) place_points(part, states.theta[k], placed, &jacobians);
  for (Eigen::Index i = 0; i < groups; ++i) {
    const double r = values[k].col(i).norm();
    const double weight = std::sqrt(r <= most ? 1.0 : most / r);
    if (part.has_markers)
      by_angle.middleRows<3>(3 * i).noalias() = weight * (*part.whitening)[k].middleCols<3>(3 * i) * jacobians[i];
    else
      by_angle = weight * (*part.whitening)[k];
    out.right.segment(group * i, group) = weight * values[k].col(i);
  }
  if (slopes) out.slopes.noalias() = by_angle * slopes->theta[k];
}

solve::NormalEquations normal_equations(const Part& part, const chain::States& states,
                                        const dynamics::Sensitivities& slopes, const std::vector<MatrixX>& values,
                                        double limit) {
  const Eigen::Index size = slopes.theta[0].cols();
  const std::size_t frames = values.size();
  // blocks of frames, summed in fixed order: the result does not depend on the number of threads
  constexpr std::size_t kBlock = 10, kAtOnce = 32;  // frames; blocks whose sums are held
  const std::size_t blocks = (frames + kBlock - 1) / kBlock;
  const solve::NormalEquations zero{MatrixX::Zero(size, size), VectorX::Zero(size)};
  solve::NormalEquations out = zero;
  for (std::size_t first = 0; first < blocks; first += kAtOnce) {
    std::vector<solve::NormalEquations> sums(std::min(kAtOnce, blocks - first), zero);
    core::parallel_for(static_cast<std::int64_t>(sums.size()), [&](std::int64_t i) {
      const std::size_t begin = (first + i) * kBlock;
      Rows rows;
      for (std::size_t k = begin; k < std::min(frames, begin + kBlock); ++k) {
        weighted_rows(part, states, &slopes, values, limit, k, rows);
        sums[i].matrix.selfadjointView<Eigen::Lower>().rankUpdate(rows.slopes.transpose());
        sums[i].gradient.noalias() += rows.slopes.transpose() * rows.right;
      }
    });
    for (const solve::NormalEquations& sum : sums) out.matrix += sum.matrix, out.gradient += sum.gradient;
  }
  out.matrix = out.matrix.selfadjointView<Eigen::Lower>();
  return out;
}

// J^T G J, G the covariance of the weighted residuals: frames up to kLag apart are correlated (mathematics.md 5), every
// residual alike. The autocovariance is that of all residuals together: of one unknown's score alone, which a few
// frames may decide, it would be mostly chance.
MatrixX covariance_of_scores(const Part& part, const chain::States& states, const dynamics::Sensitivities& slopes,
                             const std::vector<MatrixX>& values, double limit) {
  const std::size_t frames = values.size();
  const std::size_t window = std::min<std::size_t>(kLag + 1, frames);
  std::vector<double> sums(window, 0.0);
  double seen = 0.0;
  std::vector<Rows> last(window);  // frame k at k % window
  for (std::size_t k = 0; k < frames; ++k) {
    VectorX& now = last[k % window].right;
    weighted_rows(part, states, nullptr, values, limit, k, last[k % window]);
    seen += static_cast<double>((now.array() != 0.0).count());  // no weight where a marker is not seen
    for (std::size_t lag = 0; lag < window && lag <= k; ++lag) sums[lag] += now.dot(last[(k - lag) % window].right);
  }
  // one product per frame: with those before it together, each with its weight, Bartlett's
  const Eigen::Index size = part.unknowns.size();
  MatrixX half = MatrixX::Zero(size, size), before;
  for (std::size_t k = 0; k < frames; ++k) {
    const Rows& now = last[k % window];
    weighted_rows(part, states, &slopes, values, limit, k, last[k % window]);
    before = 0.5 * sums[0] * now.slopes;
    for (std::size_t lag = 1; lag < window && lag <= k; ++lag)
      before += (1.0 - lag / (kLag + 1.0)) * sums[lag] * last[(k - lag) % window].slopes;
    half.noalias() += now.slopes.transpose() * before;
  }
  return (half + half.transpose()) / std::max(seen, 1.0);
}

// All recordings up to a horizon.
struct Rollouts {
  std::vector<BaseGrid> grids;
  std::vector<chain::States> states;
  std::vector<dynamics::Sensitivities> slopes;
  std::vector<std::vector<MatrixX>> values;  // whitened residuals per recording and frame

  Rollouts(const Problem& problem, double horizon, bool fine)
      : states(problem.parts.size()), slopes(problem.parts.size()) {
    for (const Part& part : problem.parts) grids.push_back(prefix(part, frames_within(part, horizon), fine));
    values.resize(grids.size());
  }
  // False where a motion leaves all bounds.
  bool run(const Problem& problem, const VectorX& p, bool with_slopes) {
    std::vector<char> good(grids.size());
    core::parallel_for(static_cast<std::int64_t>(grids.size()), [&](std::int64_t i) {
      const Part& part = problem.parts[i];
      good[i] =
          simulate(part, grids[i], problem.of_part(p, i), states[i], with_slopes ? &slopes[i] : nullptr, problem.modes);
      if (good[i]) residuals(part, states[i], values[i]);
    });
    return std::all_of(good.begin(), good.end(), [](char g) { return g != 0; });
  }
  // With the prior.
  double cost(const Problem& problem, const VectorX& p, double limit) const {
    const VectorX off = p - problem.mean;
    double cost = 0.5 * off.dot(problem.precision * off);
    for (const auto& part : values) cost += loss_of(part, limit);
    return cost;
  }
};

// Adds a matrix about the shared unknowns and those of recording `index` to one about all unknowns.
void add_part(const Problem& problem, std::size_t index, const MatrixX& part, MatrixX& all) {
  const Eigen::Index shared = problem.shared, own = problem.own();
  const Eigen::Index first = shared + static_cast<Eigen::Index>(index) * own;
  all.topLeftCorner(shared, shared) += part.topLeftCorner(shared, shared);
  all.block(0, first, shared, own) += part.topRightCorner(shared, own);
  all.block(first, 0, own, shared) += part.bottomLeftCorner(own, shared);
  all.block(first, first, own, own) += part.bottomRightCorner(own, own);
}

// Of all recordings, without the prior: an initial state is a local block.
solve::ArrowEquations normal_equations(const Problem& problem, const Rollouts& rollouts, double limit) {
  const bool modes = problem.modes.size() > 0;
  const Eigen::Index shared = modes ? problem.shared_modes : problem.shared;
  const Eigen::Index own = modes ? problem.modes.cols() - shared : problem.own();
  solve::ArrowEquations out{MatrixX::Zero(shared, shared), VectorX::Zero(shared), {}};
  for (std::size_t i = 0; i < problem.parts.size(); ++i) {
    const solve::NormalEquations part =
        normal_equations(problem.parts[i], rollouts.states[i], rollouts.slopes[i], rollouts.values[i], limit);
    out.shared += part.matrix.topLeftCorner(shared, shared);
    out.gradient += part.gradient.head(shared);
    if (own > 0)
      out.local.push_back({part.matrix.bottomRightCorner(own, own), part.matrix.bottomLeftCorner(own, shared),
                           part.gradient.tail(own)});
  }
  return out;
}

// Adds the prior at p. It links the shared unknowns with no initial state.
void add_prior(const Problem& problem, const VectorX& p, solve::ArrowEquations& equations) {
  const Eigen::Index shared = problem.shared, own = problem.own();
  const VectorX pull = problem.precision * (p - problem.mean);
  const bool modes = problem.modes.size() > 0;
  // about the modes: B^T Lambda B and B^T Lambda (p - mean)
  const auto add = [&](Eigen::Index at, Eigen::Index size, const auto& basis, MatrixX& matrix, VectorX& gradient) {
    const auto precision = problem.precision.block(at, at, size, size);
    if (modes) {
      matrix += basis.transpose() * (precision * basis).eval();
      gradient += basis.transpose() * pull.segment(at, size);
    } else {
      matrix += precision;
      gradient += pull.segment(at, size);
    }
  };
  add(0, shared, problem.modes_of_shared(), equations.shared, equations.gradient);
  Eigen::Index at = shared;
  for (solve::ArrowEquations::Local& local : equations.local) {
    add(at, own, problem.modes_of_own(), local.matrix, local.gradient);
    at += own;
  }
}

struct Fit {
  VectorX p;
  double cost = kInfinity;
  double limit = kInfinity;  // Huber's, of the root mean square of a whitened group
  solve::Summary summary;    // of the last horizon
};

// Levenberg-Marquardt over the first `horizon` seconds of every recording.
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

// Local quadratic over the first frames: angle and velocity at the first time. Returns the standard deviation of one
// velocity, rad/s.
double initial_motion(const chain::States& states, VectorX& theta, VectorX& thetadot) {
  constexpr double kWindow = 0.21;  // s
  std::size_t count = 0;
  while (count < states.time.size() && states.time[count] <= states.time[0] + kWindow) ++count;
  count = std::max<std::size_t>(count, std::min<std::size_t>(3, states.time.size()));
  const int order = count >= 5 ? 2 : 1;
  MatrixX design(count, order + 1);
  MatrixX values(count, states.theta[0].size());
  for (std::size_t k = 0; k < count; ++k) {
    const double t = states.time[k] - states.time[0];
    for (int i = 0; i <= order; ++i) design(k, i) = std::pow(t, i);
    values.row(k) = states.theta[k].transpose();
  }
  const MatrixX fit = design.colPivHouseholderQr().solve(values);
  theta = fit.row(0).transpose();
  thetadot = fit.row(1).transpose();
  // shrink the velocity by its share of noise: a rope at rest seen with noise starts at rest
  const MatrixX residual = values - design * fit;
  const double freedom = std::max<double>(1.0, static_cast<double>(count) - order - 1.0);
  const double unit = (design.transpose() * design).inverse()(1, 1);
  const double noise = residual.squaredNorm() / freedom * unit;
  const double signal = thetadot.squaredNorm();
  if (signal > 0.0 && std::isfinite(noise)) thetadot *= std::max(0.0, signal - noise) / signal;
  return std::sqrt(noise / static_cast<double>(thetadot.size()));
}

Part make_part(const chain::Chain& chain, const trajectory::Trajectory& base, const chain::States& recognized,
               const Options& options, const Markers* markers = nullptr) {
  const std::vector<MatrixX>& covariances = recognized.covariance;
  const std::size_t frames = recognized.time.size();
  if (frames < kLeastTimes || recognized.theta.size() != frames)
    throw InputError("identify", std::to_string(frames) + " recognized states", "give at least 3 with their times");
  for (const VectorX& theta : recognized.theta)
    if (theta.size() != chain.angles() || !theta.allFinite())
      throw InputError("identify", "a recognized state is not finite or of another chain", "recognize again");
  CHAINSPLAT_CHECK(covariances.empty() || covariances.size() == frames, std::to_string(covariances.size()));

  Part part{chain, {}, recognized.time, {}, {}, recognized.theta, {}, {}, {}};
  for (std::size_t k = 1; k < frames; ++k)  // angles are known up to whole turns: the nearest to the frame before
    for (Eigen::Index i = 0; i < part.theta[k].size(); ++i)
      part.theta[k][i] -= 2.0 * M_PI * std::round((part.theta[k][i] - part.theta[k - 1][i]) / (2.0 * M_PI));
  part.has_markers = markers != nullptr;
  for (std::size_t k = 0; k < frames; ++k)
    part.direction +=
        dynamics::first_direction(chain, part.theta[k], base.pose(recognized.time[k])) / static_cast<double>(frames);
  if (!markers) part.points = chain::shape_points(chain, true);
  for (std::size_t i = 0; markers && i < markers->arclengths.size(); ++i)
    part.points.push_back(chain::centerline_point(chain, markers->arclengths[i]));
  const std::size_t points = part.points.size();
  std::vector<MatrixX> jacobians, weights;
  for (std::size_t k = 0; k < frames; ++k) {
    if (markers) {
      MatrixX target = MatrixX::Zero(3, points), whitening = MatrixX::Zero(3, 3 * points);
      const math::Pose base_from_world = base.pose(recognized.time[k]).inverse();
      for (std::size_t i = 0; i < points; ++i) {
        const Vector3 seen = markers->world[k].col(i);
        if (!seen.allFinite()) continue;
        target.col(i) = base_from_world * seen;
        whitening.middleCols<3>(3 * i) =
            math::Matrix3::Identity() /
            std::sqrt(kCorrelated * (std::pow(markers->deviation, 2) + std::pow(kMarkerModelShare * chain.length, 2)));
      }
      part.target.push_back(target);
      weights.push_back(whitening);
      continue;
    }
    MatrixX target;
    place_points(part, recognized.theta[k], target, &jacobians);
    // what the model's error of the points is in angles, and the recognized angles' own
    const MatrixX normal = chain::displacement_metric(jacobians);
    const MatrixX unit = MatrixX::Identity(chain.angles(), chain.angles());
    const Eigen::LDLT<MatrixX> by_points(normal);
    MatrixX covariance = kCorrelated * options.model_error * options.model_error * by_points.solve(unit);
    if (!covariances.empty()) covariance += covariances[k];
    const Eigen::LLT<MatrixX> factor(covariance);
    if (!math::is_positive(by_points) || !math::is_positive(factor))
      throw InputError("identify",
                       "the covariance of the angles at " + core::exact(recognized.time[k]) + " s is not positive",
                       "recognize again, or leave the covariances out: the frames then count the same");
    part.target.push_back(target);
    weights.push_back(factor.matrixL().solve(unit));
  }

  part.whitening = std::make_shared<const std::vector<MatrixX>>(std::move(weights));
  VectorX theta, thetadot, theta_sd = VectorX::Constant(chain.angles(), kThetaSd);
  const double thetadot_sd = initial_motion({part.times, part.theta, {}, {}}, theta, thetadot);
  if (!theta.allFinite() || !thetadot.allFinite() || !std::isfinite(thetadot_sd))
    throw InputError("identify", "the first times tell no velocity: they are too near or too far from each other",
                     "give frames of a video");
  if (options.paper) theta = recognized.theta[0];
  if (!covariances.empty()) theta_sd = (covariances[0].diagonal().array() + 0.25 * kThetaSd * kThetaSd).sqrt();
  // Friction soon stops a rope on a table: under a base at rest it is at rest, and what looks like motion is noise. As
  // an unknown its velocity would be worse than idle: where every link comes to a stop, and so the loss, jumps with it.
  constexpr double kBaseAtRest = 0.01;  // m/s and rad/s
  constexpr double kRopeAtRest = 1.0;   // rad/s: dry friction stops that within a frame or two
  constexpr double kSignificant = 4.0;  // standard deviations of a velocity
  const bool at_rest = options.tabletop && !options.paper && base.at(part.times[0]).velocity.norm() < kBaseAtRest &&
                       thetadot.cwiseAbs().maxCoeff() < std::max(kRopeAtRest, kSignificant * thetadot_sd);
  if (at_rest) thetadot.setZero();
  part.start = {theta, thetadot, theta_sd, at_rest ? kAtRestSd : kRateSd};
  part.unknowns = make_unknowns(chain, options, part.start);
  const int substeps = part.unknowns.reference.substeps;
  for (bool fine : {false, true}) {
    BaseGrid& grid = part.grids[fine];
    grid = dynamics::sample_base([&](double t) { return base.at(t); }, recognized.time[0], recognized.time,
                                 fine ? substeps : std::max(1, substeps / 2));
    for (std::size_t i = 0; i < grid.nodes.size(); ++i)
      if (grid.nodes[i].output) part.nodes[fine].push_back(i);
  }
  return part;
}

Problem make_problem(const chain::Chain& chain, std::vector<Part> parts) {
  const Unknowns& first = parts.front().unknowns;
  // an initial state alone is one block, too
  const int theta = first.first(Quantity::theta), shared = theta <= 0 ? first.size() : theta;
  Problem problem{chain, std::move(parts), shared, {}, {}};
  const int own = problem.own();
  const Eigen::Index size = shared + own * static_cast<Eigen::Index>(problem.parts.size());
  problem.mean.resize(size);
  problem.precision = MatrixX::Zero(size, size);
  for (std::size_t i = 0; i < problem.parts.size(); ++i) {
    const Unknowns& u = problem.parts[i].unknowns;  // no prior links the shared ones with an initial state
    const Eigen::Index at = shared + static_cast<Eigen::Index>(i) * own;
    problem.mean.head(shared) = u.mean.head(shared);
    problem.mean.segment(at, own) = u.mean.tail(own);
    problem.precision.topLeftCorner(shared, shared) = u.precision.topLeftCorner(shared, shared);
    problem.precision.block(at, at, own, own) = u.precision.bottomRightCorner(own, own);
  }
  return problem;
}

double rms_of(const Part& part, const chain::States& rollout) {
  double sum = 0.0;
  std::size_t count = 0;
  MatrixX points;
  for (std::size_t k = 0; k < part.times.size(); ++k) {
    place_points(part, rollout.theta[k], points, nullptr);
    const int stop = part.has_markers ? static_cast<int>(points.cols()) : 2 * (part.chain.links() - 1);
    for (int i = part.has_markers ? 0 : 1; i < stop; i += part.has_markers ? 1 : 2) {           // odd: the links' ends
      if (part.has_markers && (*part.whitening)[k].middleCols<3>(3 * i).isZero(0.0)) continue;  // not seen
      ++count;
      sum += (points.col(i) - part.target[k].col(i)).squaredNorm();
    }
  }
  return std::sqrt(sum / static_cast<double>(count));
}

// Best of several starts: stiffness and damping scaled together, then random ones where all fit poorly. `follow` puts
// the problem about the rod of a fit, on the way to the whole recording: else it would be fitted again and again.
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

// [P]: Adam on half the squared angle differences, gradients by differences of rollouts.
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

// Sandwich covariance of the estimate in the position metric ([P] included); recordings are independent.
MatrixX covariance_of(const Problem& problem, const MatrixX& hessian, const Rollouts& rollouts, double limit) {
  const MatrixX& prior = problem.precision;
  MatrixX meat = prior;
  for (std::size_t i = 0; i < problem.parts.size(); ++i)
    add_part(problem, i,
             covariance_of_scores(problem.parts[i], rollouts.states[i], rollouts.slopes[i], rollouts.values[i], limit),
             meat);
  // In coordinates in which the weights alone promise the covariance 1, the sandwich is `scores`. It is itself an
  // estimate, of few independent frames: along no combination of parameters less than what the weights promise.
  const Eigen::LLT<MatrixX> factor(MatrixX(hessian + prior));
  if (factor.info() == Eigen::Success) {
    factor.matrixL().solveInPlace(meat);
    MatrixX scores = meat.transpose();
    factor.matrixL().solveInPlace(scores);
    const Eigen::SelfAdjointEigenSolver<MatrixX> eigen(MatrixX(0.5 * (scores + scores.transpose())));
    MatrixX root = eigen.eigenvectors() * eigen.eigenvalues().cwiseMax(1.0).cwiseSqrt().asDiagonal();
    factor.matrixU().solveInPlace(root);
    const MatrixX covariance = root * root.transpose();
    if (math::is_covariance(covariance)) return covariance;
  }
  core::warn("identify: the data leave the parameters' covariance without meaning; it is written as not known");
  return MatrixX::Constant(prior.rows(), prior.cols(), kUnknown);
}

// Eigenvectors of the information about the shared unknowns, those of the initial states eliminated, in units of the
// priors' deviations; the roots of its eigenvalues are the singular values of the weighted, scaled sensitivities.
std::vector<dynamics::Estimates::Weak> weak_directions(const Problem& problem, solve::ArrowEquations data) {
  const int shared = problem.shared, own = problem.own();
  for (std::size_t i = 0; i < data.local.size(); ++i) {
    const Eigen::Index first = shared + static_cast<Eigen::Index>(i) * own;
    data.local[i].matrix += problem.precision.block(first, first, own, own);
  }
  const MatrixX information = solve::reduced(data).matrix;
  const MatrixX prior = problem.precision.topLeftCorner(shared, shared);
  const VectorX deviation = prior.ldlt().solve(MatrixX::Identity(shared, shared)).diagonal().cwiseMax(0.0).cwiseSqrt();
  if (!information.allFinite()) return {};  // its covariance is said not to be known
  const Eigen::SelfAdjointEigenSolver<MatrixX> eigen(
      MatrixX(deviation.asDiagonal() * information * deviation.asDiagonal()));
  constexpr double kLarge = 0.3;  // a component that is named: a tenth of the vector's square
  std::vector<dynamics::Estimates::Weak> weak;
  for (int i = 0; i < shared && eigen.eigenvalues()[i] < 1.0; ++i) {
    dynamics::Estimates::Weak direction{std::sqrt(std::max(0.0, eigen.eigenvalues()[i])), {}};
    VectorX vector = eigen.eigenvectors().col(i);
    Eigen::Index largest = 0;
    vector.cwiseAbs().maxCoeff(&largest);
    if (vector[largest] < 0.0) vector = -vector;
    for (int k = 0; k < shared; ++k)
      if (k == largest || std::abs(vector[k]) >= kLarge)
        direction.parts.emplace_back(dynamics::name_of(problem.parts[0].unknowns.list[k]), vector[k]);
    std::stable_sort(direction.parts.begin(), direction.parts.end(),
                     [](const auto& a, const auto& b) { return std::abs(a.second) > std::abs(b.second); });
    weak.push_back(std::move(direction));
  }
  return weak;
}

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

// Residuals of a fit: their root mean square in units of what one alone is expected to be off, and how many there are.
struct Misfit {
  double scale = kInfinity;
  double count = 0.0;
};

Misfit misfit_of(const Rollouts& rollouts) {
  double sum = 0.0;
  std::int64_t count = 0;
  for (const auto& part : rollouts.values)
    for (const MatrixX& frame : part) sum += frame.squaredNorm(), count += (frame.array() != 0.0).count();
  const double seen = static_cast<double>(std::max<std::int64_t>(count, 1));
  return {std::sqrt(kCorrelated * sum / seen), seen};
}

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

struct Candidate {
  Extras extras;
  Problem problem;
  Fit fit;
  double lack = kInfinity;  // of evidence
};

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

// The chain's own fit. `rough`: the same recordings for a chain of few joints, whose parameters it begins with; or
// none. What few joints ask for beside a rope's own is tried, and the many decide: straight links that are long cannot
// follow what the rope does near the grasp, and friction or a payload would stand for that.
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
