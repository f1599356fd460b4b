#include "chainsplat/identification.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "unknowns.h"

namespace chainsplat::identification {
namespace {

using dynamics::BaseGrid;
using math::Vector3;

constexpr double kHorizons[] = {1.0 / 3, 2.0 / 3, 4.0 / 3, 8.0 / 3};  // s, then everything
constexpr double kResidualShare = 1.0 / 9.0;  // of a residual that counts: neighbors in space and time err alike
constexpr double kHuber = 3.0;                // in robust standard deviations of a point's residual
constexpr double kThetaSd = 0.02;             // rad, initial angles about the recognized ones without covariances
constexpr int kLag = 10;                      // frames over which residuals are taken to be correlated (SPEC 5)
constexpr double kInfinity = std::numeric_limits<double>::infinity();

struct Problem {
  const chain::Chain& chain;
  Unknowns unknowns;
  std::vector<double> times;
  std::vector<int> links;          // of each compared point: middles and ends of the links, two a link, then
  std::vector<Vector3> home;       // where the rope can twist a point of its surface a link; base frame, at theta = 0
  std::vector<MatrixX> target;     // a frame: 3 x points, base frame
  std::vector<MatrixX> whitening;  // a frame: 3 x 3 blocks side by side
  std::vector<VectorX> theta;      // recognized
  BaseGrid grid;
  std::vector<std::size_t> nodes;  // of the grid, up to and with each output
  bool has_markers = false;        // the points are markers; unseen ones have no weight
};

// Points of the centerline in the base frame and, where asked, their derivatives by theta.
void place_points(const Problem& problem, const VectorX& theta, MatrixX& points, std::vector<MatrixX>* slopes) {
  const auto motions = chain::link_motions(problem.chain, theta, {});
  const std::size_t count = problem.home.size();
  points.resize(3, count);
  for (std::size_t i = 0; i < count; ++i) points.col(i) = motions[problem.links[i]] * problem.home[i];
  if (!slopes) return;
  const MatrixX axes = chain::world_axes(problem.chain, theta, {});
  slopes->resize(count);
  for (std::size_t i = 0; i < count; ++i)
    (*slopes)[i] = chain::point_jacobian(problem.chain, axes, problem.links[i], points.col(i));
}

BaseGrid prefix(const Problem& problem, std::size_t frames) {
  BaseGrid grid;
  grid.nodes.assign(problem.grid.nodes.begin(), problem.grid.nodes.begin() + problem.nodes[frames - 1] + 1);
  grid.nodes.back().step = 0.0;
  return grid;
}

bool simulate(const Problem& problem, const BaseGrid& grid, const VectorX& p, chain::States& states,
              dynamics::Sensitivities* sensitivities = nullptr) {
  const State state = apply(problem.chain, problem.unknowns, p);
  const dynamics::Model model = dynamics::make_model(problem.chain, state.parameters);
  if (!sensitivities) return dynamics::simulate(model, grid, state.theta, state.thetadot, states);
  const auto unknowns = tangents(problem.chain, problem.unknowns, p);
  if (model.parameters.integrator == dynamics::Integrator::rodas3)
    return dynamics::simulate(model, grid, state.theta, state.thetadot, states, unknowns, sensitivities);
  // the Euler step has no variational equation: differences of rollouts
  if (!dynamics::simulate(model, grid, state.theta, state.thetadot, states)) return false;
  const std::size_t frames = states.theta.size();
  const int size = static_cast<int>(p.size());
  sensitivities->theta.assign(frames, MatrixX::Zero(problem.chain.angles(), size));
  std::vector<char> good(size, 0);
  core::parallel_for(size, [&](std::int64_t i) {
    constexpr double kStep = 1e-5;  // of a log or an angle
    VectorX moved = p;
    moved[i] += kStep;
    const State shifted = apply(problem.chain, problem.unknowns, moved);
    chain::States out;
    if (!dynamics::simulate(dynamics::make_model(problem.chain, shifted.parameters), grid, shifted.theta,
                            shifted.thetadot, out))
      return;
    good[i] = 1;
    for (std::size_t k = 0; k < frames; ++k) sensitivities->theta[k].col(i) = (out.theta[k] - states.theta[k]) / kStep;
  });
  return std::all_of(good.begin(), good.end(), [](char g) { return g != 0; });
}

void residuals(const Problem& problem, const chain::States& states, std::vector<MatrixX>& out) {
  out.resize(states.theta.size());
  MatrixX points;
  for (std::size_t k = 0; k < states.theta.size(); ++k) {
    place_points(problem, states.theta[k], points, nullptr);
    out[k].resize(3, points.cols());
    for (Eigen::Index i = 0; i < points.cols(); ++i)
      out[k].col(i) = problem.whitening[k].middleCols<3>(3 * i) * (points.col(i) - problem.target[k].col(i));
  }
}

double median_norm(const std::vector<MatrixX>& values) {
  std::vector<double> norms;
  for (const MatrixX& frame : values)
    for (Eigen::Index i = 0; i < frame.cols(); ++i) norms.push_back(frame.col(i).norm());
  std::nth_element(norms.begin(), norms.begin() + norms.size() / 2, norms.end());
  return norms[norms.size() / 2];
}

// Huber's loss of whitened residuals with threshold `limit`, plus the prior.
double cost_of(const Problem& problem, const std::vector<MatrixX>& values, const VectorX& p, double limit) {
  double cost = 0.0;
  for (const MatrixX& frame : values)
    for (Eigen::Index i = 0; i < frame.cols(); ++i) {
      const double r = frame.col(i).norm();
      cost += r <= limit ? 0.5 * r * r : limit * (r - 0.5 * limit);
    }
  const VectorX off = p - problem.unknowns.mean;
  return kResidualShare * cost + 0.5 * off.dot(problem.unknowns.precision * off);
}

struct Normal {
  MatrixX hessian;   // J^T W J
  VectorX gradient;  // J^T W r
  MatrixX scores;    // a frame's part of the gradient, unknowns x frames
};

Normal normal_equations(const Problem& problem, const chain::States& states, const dynamics::Sensitivities& slopes,
                        const std::vector<MatrixX>& values, double limit) {
  const Eigen::Index size = problem.unknowns.size();
  const std::size_t frames = values.size();
  const Eigen::Index points = static_cast<Eigen::Index>(problem.home.size());
  // blocks of frames, summed in fixed order: the result does not depend on the number of threads
  constexpr std::size_t kBlock = 10;
  const std::size_t blocks = (frames + kBlock - 1) / kBlock;
  std::vector<MatrixX> hessians(blocks);
  Normal out;
  out.scores.resize(size, frames);
  core::parallel_for(static_cast<std::int64_t>(blocks), [&](std::int64_t block) {
    MatrixX& hessian = hessians[block];
    hessian = MatrixX::Zero(size, size);
    MatrixX placed, by_angle(3 * points, problem.chain.angles()), rows(3 * points, size);
    VectorX right(3 * points);
    std::vector<MatrixX> jacobians;
    for (std::size_t k = block * kBlock; k < std::min(frames, (block + 1) * kBlock); ++k) {
      place_points(problem, states.theta[k], placed, &jacobians);
      for (Eigen::Index i = 0; i < points; ++i) {
        const double r = values[k].col(i).norm();
        const double weight = std::sqrt(kResidualShare * (r <= limit ? 1.0 : limit / r));
        by_angle.middleRows<3>(3 * i).noalias() = weight * problem.whitening[k].middleCols<3>(3 * i) * jacobians[i];
        right.segment<3>(3 * i) = weight * values[k].col(i);
      }
      rows.noalias() = by_angle * slopes.theta[k];
      hessian.selfadjointView<Eigen::Lower>().rankUpdate(rows.transpose());
      out.scores.col(k).noalias() = rows.transpose() * right;
    }
  });
  out.hessian = MatrixX::Zero(size, size);
  for (const MatrixX& part : hessians) out.hessian += part;
  out.hessian = out.hessian.selfadjointView<Eigen::Lower>();
  out.gradient = out.scores.rowwise().sum();
  return out;
}

struct Fit {
  VectorX p;
  double cost = kInfinity;
  double limit = kInfinity;  // Huber's, in whitened units
};

// Levenberg-Marquardt over the first `frames` frames.
void improve(const Problem& problem, std::size_t frames, int iterations, Fit& fit) {
  constexpr double kProgress = 1e-4;  // relative, below which a horizon is done
  const BaseGrid grid = prefix(problem, frames);
  chain::States states, trial_states;
  dynamics::Sensitivities slopes;
  std::vector<MatrixX> values, trial_values;
  if (!simulate(problem, grid, fit.p, states, &slopes)) {
    fit.cost = kInfinity;
    return;
  }
  residuals(problem, states, values);
  // 1.54: median norm of three unit normal residuals
  fit.limit = std::max(kHuber * median_norm(values) / 1.54, kHuber * 0.3);
  fit.cost = cost_of(problem, values, fit.p, fit.limit);
  double damping = 1e-3;
  const MatrixX& prior = problem.unknowns.precision;
  for (int iteration = 0; iteration < iterations; ++iteration) {
    if (core::stop_requested()) throw Interrupted(core::stop_requested());
    const Normal normal = normal_equations(problem, states, slopes, values, fit.limit);
    const MatrixX hessian = normal.hessian + prior;
    const VectorX gradient = normal.gradient + prior * (fit.p - problem.unknowns.mean);
    bool better = false;
    double gained = 0.0;
    for (int attempt = 0; attempt < 6 && !better; ++attempt) {
      MatrixX damped = hessian;
      damped.diagonal() *= 1.0 + damping;
      VectorX step = damped.ldlt().solve(-gradient);
      constexpr double kMaxStep = 1.0;  // of a log or an angle or rad/s: beyond, the linearization is worthless
      const double largest = step.cwiseAbs().maxCoeff();
      if (!(largest < kInfinity)) break;
      if (largest > kMaxStep) step *= kMaxStep / largest;
      const VectorX p = fit.p + step;
      if (simulate(problem, grid, p, trial_states)) {
        residuals(problem, trial_states, trial_values);
        const double cost = cost_of(problem, trial_values, p, fit.limit);
        if (cost < fit.cost) {
          gained = fit.cost - cost;
          fit.p = p, fit.cost = cost;
          better = true;
          damping = std::max(0.1 * damping, 1e-9);
          break;
        }
      }
      damping = std::max(10.0 * damping, 1e-4);
    }
    if (!better || gained < kProgress * fit.cost) break;
    if (!simulate(problem, grid, fit.p, states, &slopes)) break;
    residuals(problem, states, values);
  }
}

// Local quadratic over the first frames: angle and velocity at the first time.
void initial_motion(const chain::States& states, VectorX& theta, VectorX& thetadot) {
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
  if (signal > 0.0) thetadot *= std::max(0.0, signal - noise) / signal;
}

Problem make_problem(const chain::Chain& chain, const trajectory::Trajectory& base, const chain::States& recognized,
                     std::span<const MatrixX> covariances, const Options& options, const Markers* markers = nullptr) {
  const std::size_t frames = recognized.time.size();
  if (frames < 3 || recognized.theta.size() != frames)
    throw InputError("identify", std::to_string(frames) + " recognized states", "give at least 3 with their times");
  for (const VectorX& theta : recognized.theta)
    if (theta.size() != chain.angles() || !theta.allFinite())
      throw InputError("identify", "a recognized state is not finite or of another chain", "recognize again");
  CHAINSPLAT_CHECK(covariances.empty() || covariances.size() == frames, std::to_string(covariances.size()));

  Problem problem{chain, {}, recognized.time, {}, {}, {}, {}, recognized.theta, {}, {}};
  problem.has_markers = markers != nullptr;
  for (int link = 1; !markers && link < chain.links(); ++link) {
    problem.home.push_back(0.5 * (chain.link_start(link) + chain.link_end(link)) * chain.direction);
    problem.home.push_back(chain.link_end(link) * chain.direction);
    problem.links.insert(problem.links.end(), 2, link);
  }
  const bool twists = std::any_of(chain.axes.begin(), chain.axes.end(), [&](const math::Vector6& axis) {
    return std::abs(axis.head<3>().dot(chain.direction)) > 0.5;
  });
  for (int link = 1; !markers && twists && link < chain.links(); ++link) {
    problem.home.push_back(chain.link_end(link) * chain.direction + 0.5 * chain.diameter * chain.bending_axis);
    problem.links.push_back(link);
  }

  for (std::size_t i = 0; markers && i < markers->arclengths.size(); ++i) {
    problem.home.push_back(markers->arclengths[i] * chain.direction);
    problem.links.push_back(chain::link_at(chain, markers->arclengths[i]));
  }

  const std::size_t points = problem.home.size();
  std::vector<MatrixX> jacobians;
  for (std::size_t k = 0; k < frames; ++k) {
    if (markers) {
      MatrixX target = MatrixX::Zero(3, points), whitening = MatrixX::Zero(3, 3 * points);
      const math::Pose base_from_world = base.pose(recognized.time[k]).inverse();
      for (std::size_t i = 0; i < points; ++i) {
        const Vector3 seen = markers->world[k].col(i);
        if (!seen.allFinite()) continue;
        target.col(i) = base_from_world * seen;
        whitening.middleCols<3>(3 * i) = math::Matrix3::Identity() / markers->deviation;
      }
      problem.target.push_back(target);
      problem.whitening.push_back(whitening);
      continue;
    }
    MatrixX target, whitening(3, 3 * points);
    place_points(problem, recognized.theta[k], target, covariances.empty() ? nullptr : &jacobians);
    for (std::size_t i = 0; i < points; ++i) {
      math::Matrix3 covariance = options.model_error * options.model_error * math::Matrix3::Identity();
      if (!covariances.empty()) covariance += jacobians[i] * covariances[k] * jacobians[i].transpose();
      whitening.middleCols<3>(3 * i) = covariance.llt().matrixL().solve(math::Matrix3::Identity());
    }
    problem.target.push_back(target);
    problem.whitening.push_back(whitening);
  }

  VectorX theta, thetadot, theta_sd = VectorX::Constant(chain.angles(), kThetaSd);
  initial_motion(recognized, theta, thetadot);
  if (options.paper) theta = recognized.theta[0];
  if (!covariances.empty()) theta_sd = (covariances[0].diagonal().array() + 0.25 * kThetaSd * kThetaSd).sqrt();
  problem.unknowns = make_unknowns(chain, options, theta, thetadot, theta_sd);
  problem.grid = dynamics::sample_base([&](double t) { return base.at(t); }, recognized.time[0], recognized.time,
                                       problem.unknowns.fixed.substeps);
  for (std::size_t i = 0; i < problem.grid.nodes.size(); ++i)
    if (problem.grid.nodes[i].output) problem.nodes.push_back(i);
  return problem;
}

std::size_t frames_within(const Problem& problem, double horizon) {
  std::size_t count = 0;
  while (count < problem.times.size() && problem.times[count] <= problem.times[0] + horizon + 1e-9) ++count;
  return std::clamp<std::size_t>(count, 3, problem.times.size());
}

// Best of several starts: stiffness and damping scaled together, then random ones where all fit poorly.
Fit fit_centerline(const Problem& problem, const Options& options) {
  const Unknowns& u = problem.unknowns;
  constexpr double kScales[] = {1.0, 0.2, 5.0};
  constexpr int kRandomStarts = 3;
  constexpr double kPoor = 4.0;  // median whitened residual, i.e. mm without covariances
  const std::size_t all = problem.times.size(), trial = frames_within(problem, kHorizons[2]);

  const auto start = [&](int index) {
    VectorX p = u.mean;
    if (index < 3) {
      for (int i : {u.stiffness, u.damping})
        if (i >= 0) p[i] += std::log(kScales[index]);
    } else {
      core::Random random(options.seed * 1000003u + static_cast<std::uint64_t>(index));
      for (int i : {u.stiffness, u.damping, u.drag, u.tip})
        if (i >= 0) p[i] += 1.5 * random.normal();
      for (int j = 0; u.coulomb >= 0 && j < problem.chain.links() - 1; ++j) p[u.coulomb + j] += random.normal();
    }
    return p;
  };
  const auto warm = [&](int index) {
    Fit fit;
    fit.p = start(index);
    for (double horizon : {kHorizons[0], kHorizons[1], kHorizons[2]})
      improve(problem, frames_within(problem, horizon), std::min(options.max_iterations, 10), fit);
    return fit;
  };
  const auto finish = [&](Fit fit) {
    // the whole twice: again with the threshold of the better fit
    for (std::size_t frames : {frames_within(problem, kHorizons[3]), all, all}) {
      improve(problem, frames, options.max_iterations, fit);
      core::report({"identify", static_cast<std::int64_t>(frames), static_cast<std::int64_t>(all), fit.cost, NAN,
                    "fitting the rollout to the recognized motion"});
    }
    return fit;
  };
  // a common scale for comparing: the plain robust cost of the trial horizon with a fixed threshold
  const auto score = [&](const Fit& fit, std::size_t frames, double limit) {
    chain::States states;
    std::vector<MatrixX> values;
    if (fit.cost == kInfinity || !simulate(problem, prefix(problem, frames), fit.p, states)) return kInfinity;
    residuals(problem, states, values);
    return cost_of(problem, values, fit.p, limit);
  };
  const auto best_of = [&](int first, int count) {
    std::vector<Fit> fits(count);
    core::parallel_for(count, [&](std::int64_t i) { fits[i] = warm(first + static_cast<int>(i)); });
    std::size_t best = 0;
    for (std::size_t i = 1; i < fits.size(); ++i)
      if (score(fits[i], trial, kHuber) < score(fits[best], trial, kHuber)) best = i;
    return finish(fits[best]);
  };
  Fit best = best_of(0, 3);
  const auto poor = [&](const Fit& fit) {
    chain::States states;
    std::vector<MatrixX> values;
    if (fit.cost == kInfinity || !simulate(problem, problem.grid, fit.p, states)) return true;
    residuals(problem, states, values);
    return median_norm(values) > kPoor;
  };
  if (poor(best)) {
    const Fit other = best_of(3, kRandomStarts);
    if (score(other, all, kHuber) < score(best, all, kHuber)) best = other;
  }
  return best;
}

// [P]: Adam on half the squared angle differences, gradients by differences of rollouts.
Fit fit_angles(const Problem& problem, const Options& options) {
  constexpr double kRate = 0.05, kBeta1 = 0.9, kBeta2 = 0.999, kEpsilon = 1e-12;
  Fit best, fit;
  fit.p = problem.unknowns.mean;
  double rate = kRate;
  VectorX first = VectorX::Zero(fit.p.size()), second = first;
  for (int iteration = 1; iteration <= options.adam_iterations; ++iteration) {
    if (core::stop_requested()) throw Interrupted(core::stop_requested());
    chain::States states;
    dynamics::Sensitivities slopes;
    if (!simulate(problem, problem.grid, fit.p, states, &slopes)) {
      // beyond the step's stability: go back and step less
      if (best.cost == kInfinity)
        fit.p.array() += 0.3;
      else
        fit.p = best.p;
      rate *= 0.5;
      first.setZero();
      continue;
    }
    double cost = 0.0;
    VectorX gradient = VectorX::Zero(fit.p.size());
    for (std::size_t k = 0; k < states.theta.size(); ++k) {
      const VectorX off = states.theta[k] - problem.theta[k];
      cost += 0.5 * off.squaredNorm();
      gradient += slopes.theta[k].transpose() * off;
    }
    fit.cost = cost;
    if (cost < best.cost) best = fit;
    first = kBeta1 * first + (1.0 - kBeta1) * gradient;
    second = kBeta2 * second + (1.0 - kBeta2) * gradient.cwiseAbs2();
    const double correction1 = 1.0 - std::pow(kBeta1, iteration), correction2 = 1.0 - std::pow(kBeta2, iteration);
    fit.p.array() -= rate * (first.array() / correction1) / ((second.array() / correction2).sqrt() + kEpsilon);
  }
  return best;
}

// Sandwich covariance of the estimate in the position metric ([P] included): residuals of frames up to kLag apart are
// correlated (Newey-West, SPEC 5).
MatrixX covariance_of(const Problem& problem, const Normal& normal) {
  const MatrixX& prior = problem.unknowns.precision;
  MatrixX meat = normal.scores * normal.scores.transpose();
  const Eigen::Index frames = normal.scores.cols();
  for (int lag = 1; lag <= kLag && lag < frames; ++lag) {
    const double weight = 1.0 - lag / (kLag + 1.0);
    const MatrixX part = normal.scores.rightCols(frames - lag) * normal.scores.leftCols(frames - lag).transpose();
    meat += weight * (part + part.transpose());
  }
  const MatrixX bread = (normal.hessian + prior).ldlt().solve(MatrixX::Identity(prior.rows(), prior.cols()));
  const MatrixX out = bread * (meat + prior) * bread;
  return 0.5 * (out + out.transpose());
}

}  // namespace

static Result solve(const chain::Chain& chain, const Problem& problem, const Options& options) {
  const Fit fit = options.paper ? fit_angles(problem, options) : fit_centerline(problem, options);
  Result result;
  dynamics::Sensitivities slopes;
  if (fit.cost == kInfinity || !simulate(problem, problem.grid, fit.p, result.rollout, &slopes))
    throw WorkError("identify", "no parameters gave a rollout that stays finite",
                    "check the base trajectory, the recognized angles and the object's length");
  const State state = apply(chain, problem.unknowns, fit.p);
  result.parameters = state.parameters;
  result.initial = {problem.times[0], state.theta, state.thetadot};

  std::vector<MatrixX> values;
  residuals(problem, result.rollout, values);
  const Normal normal = normal_equations(problem, result.rollout, slopes, values, fit.limit);
  result.estimates.names = problem.unknowns.names;
  result.estimates.values.assign(fit.p.begin(), fit.p.end());
  result.estimates.covariance = covariance_of(problem, normal);
  for (Eigen::Index i = 0; i < fit.p.size(); ++i)
    result.estimates.standard_errors.push_back(std::sqrt(std::max(0.0, result.estimates.covariance(i, i))));
  result.estimates.held = problem.unknowns.held;

  double sum = 0.0;
  std::size_t count = 0;
  MatrixX points;
  for (std::size_t k = 0; k < problem.times.size(); ++k) {
    place_points(problem, result.rollout.theta[k], points, nullptr);
    const int stop = problem.has_markers ? static_cast<int>(points.cols()) : 2 * (chain.links() - 1);
    for (int i = problem.has_markers ? 0 : 1; i < stop; i += problem.has_markers ? 1 : 2) {  // odd: the links' ends
      if (problem.whitening[k].middleCols<3>(3 * i).isZero(0.0)) continue;
      ++count;
      sum += (points.col(i) - problem.target[k].col(i)).squaredNorm();
    }
  }
  result.node_rms = std::sqrt(sum / static_cast<double>(count));
  return result;
}

Result identify(const chain::Chain& chain, const trajectory::Trajectory& base, const chain::States& recognized,
                std::span<const MatrixX> covariances, const Options& options) {
  return solve(chain, make_problem(chain, base, recognized, covariances, options), options);
}

Result identify(const chain::Chain& chain, const trajectory::Trajectory& base, const Markers& markers,
                const Options& options) {
  std::vector<MatrixX> covariances;
  const chain::States fitted = fit_markers(chain, base, markers, &covariances);
  return solve(chain, make_problem(chain, base, fitted, covariances, options, &markers), options);
}

}  // namespace chainsplat::identification
