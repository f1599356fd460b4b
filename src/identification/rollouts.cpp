#include "rollouts.h"

#include <algorithm>
#include <cmath>

#include "coarse.h"

namespace chainsplat::identification {

using dynamics::BaseGrid;

namespace {

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

}  // namespace

Rollouts::Rollouts(const Problem& problem, double horizon, bool fine)
    : states(problem.parts.size()), slopes(problem.parts.size()) {
  for (const Part& part : problem.parts) grids.push_back(prefix(part, frames_within(part, horizon), fine));
  values.resize(grids.size());
}

bool Rollouts::run(const Problem& problem, const VectorX& p, bool with_slopes) {
  std::vector<char> good(grids.size());
  core::parallel_for(static_cast<std::int64_t>(grids.size()), [&](std::int64_t i) {
    const Part& part = problem.parts[i];
    good[i] =
        simulate(part, grids[i], problem.of_part(p, i), states[i], with_slopes ? &slopes[i] : nullptr, problem.modes);
    if (good[i]) residuals(part, states[i], values[i]);
  });
  return std::all_of(good.begin(), good.end(), [](char g) { return g != 0; });
}

double Rollouts::cost(const Problem& problem, const VectorX& p, double limit) const {
  const VectorX off = p - problem.mean;
  double cost = 0.5 * off.dot(problem.precision * off);
  for (const auto& part : values) cost += loss_of(part, limit);
  return cost;
}

double median_rms(const std::vector<std::vector<MatrixX>>& values) {
  std::vector<double> norms;
  for (const auto& part : values)
    for (const MatrixX& frame : part)
      for (Eigen::Index i = 0; i < frame.cols(); ++i)
        norms.push_back(frame.col(i).norm() / std::sqrt(static_cast<double>(frame.rows())));
  std::nth_element(norms.begin(), norms.begin() + norms.size() / 2, norms.end());
  return norms[norms.size() / 2];
}

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

Misfit misfit_of(const Rollouts& rollouts) {
  double sum = 0.0;
  std::int64_t count = 0;
  for (const auto& part : rollouts.values)
    for (const MatrixX& frame : part) sum += frame.squaredNorm(), count += (frame.array() != 0.0).count();
  const double seen = static_cast<double>(std::max<std::int64_t>(count, 1));
  return {std::sqrt(kCorrelated * sum / seen), seen};
}

}  // namespace chainsplat::identification
