#include "search.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include "src/math/decompositions.h"

namespace chainsplat::planning {
namespace {

constexpr double kLeastDamping = 1e-9;
constexpr double kLessDamping = 0.15;
constexpr double kIdle = 0.03;       // of the squared miss: steps that decrease less are idle
constexpr int kIdleSteps = 3;        // so many end it
constexpr double kConverged = 1e-4;  // relative decrease of the objective
constexpr double kNothing = 1e-11;   // m^2, (3 um)^2: a smaller decrease does not count
constexpr int kMostSides = 8;        // solutions of a step, each with the obstacles that the last one runs into

}  // namespace

std::vector<Axis> default_axes(const chain::Chain& chain) {
  for (const math::Vector6& axis : chain.axes)
    if (std::abs(axis.head<3>().dot(chain.bending_axis)) < 0.5 && std::abs(axis.head<3>().dot(chain.direction)) < 0.5)
      return {Axis::x, Axis::y};
  return {Axis::x};
}

Motion empty_motion(const Problem& problem, const Options& options) {
  Motion motion;
  motion.origin = problem.base;
  const dynamics::Parameters& p = problem.model.parameters;
  if (p.table_normal)
    motion.up = *p.table_normal;
  else if (p.gravity.norm() > 0.0)
    motion.up = -p.gravity.normalized();
  motion.axes = options.axes.empty() ? default_axes(problem.model.chain) : options.axes;
  motion.window = options.window;
  return motion;
}

void append_piece(Motion& motion, double start, double duration) {
  const auto axes = static_cast<Eigen::Index>(motion.axes.size());
  motion.pieces.push_back({start, duration, MatrixX::Zero(kBasisCount, axes), VectorX::Zero(axes)});
}

void set_unknowns(Motion& motion, const VectorX& unknowns) {
  Piece& piece = motion.pieces.back();
  for (Eigen::Index a = 0; a < piece.terminal.size(); ++a) {
    piece.weights.col(a) = unknowns.segment(a * kPerAxis, kBasisCount);
    piece.terminal[a] = unknowns[a * kPerAxis + kBasisCount];
  }
}

VectorX unknowns_of(const Motion& motion) {
  const Piece& piece = motion.pieces.back();
  VectorX unknowns(piece.terminal.size() * kPerAxis);
  for (Eigen::Index a = 0; a < piece.terminal.size(); ++a)
    unknowns.segment(a * kPerAxis, kPerAxis) << piece.weights.col(a), piece.terminal[a];
  return unknowns;
}

Vector3 where_it_lies(const Problem& problem) {
  const chain::Chain& chain = problem.model.chain;
  return problem.base * (chain.link_lift(chain.links() - 1) * chain.bending_axis);
}

Vector3 at_rope_height(const Problem& problem, const Vector3& target) {
  if (!problem.tabletop || !problem.model.parameters.table_normal) return target;
  const Vector3& normal = *problem.model.parameters.table_normal;
  return target + normal * normal.dot(where_it_lies(problem) - target);
}

Task make_task(const Problem& problem, const Options& options, const std::vector<const dynamics::Model*>& models,
               const Motion& motion, const dynamics::InitialState& initial, const Vector3& target, int substeps) {
  Task task;
  task.models = models;
  task.tabletop = problem.tabletop;
  task.part = part_of(options, problem.tabletop);
  task.motion = motion;
  task.grid = make_grid(motion, substeps);
  task.initial = initial;
  task.target = at_rope_height(problem, target);
  task.options = &options;
  task.held.assign(motion.axes.size() * kPerAxis, false);
  return task;
}

solve::Summary minimize(const Task& task, VectorX& unknowns, const Sharpness& sharpness, const Effort& effort) {
  // unit of the damping: acceleration, so that a step changes the motion as little as it can
  MatrixX metric = MatrixX::Zero(unknowns.size(), unknowns.size());
  for (const Basis& b : task.grid.basis)
    for (std::size_t a = 0; a < task.motion.axes.size(); ++a) {
      const auto first = static_cast<Eigen::Index>(a) * kPerAxis;
      metric.block(first, first, kPerAxis, kPerAxis) += b.col(2) * b.col(2).transpose();
    }
  for (Eigen::Index i = 0; i < unknowns.size(); ++i)
    if (task.held[i]) metric.row(i).setZero(), metric.col(i).setZero(), metric(i, i) = 1.0;
  metric /= metric.trace();

  Evaluation now, next;
  int idle = 0;
  const bool around = !task.options->spheres.empty() || !task.options->boxes.empty();
  solve::Callbacks callbacks;
  callbacks.evaluate = [&](const VectorX& q, bool derivatives) {
    next = evaluate(task, q, sharpness, derivatives);
    return next.good ? next.value : std::numeric_limits<double>::infinity();
  };
  callbacks.step = [&](double damping, VectorX& step) {
    const double scale = now.curvature.trace();
    MatrixX matrix = now.curvature + damping * scale * metric;
    // the metric has no part in directions without acceleration; held unknowns have no row
    matrix.diagonal().array() += 1e-12 * scale;
    step = -matrix.ldlt().solve(now.gradient);
    // Squares that count on one side only: what the step runs into joins them, what it leaves drops out. Without this a
    // step along an obstacle is refused again and again.
    VectorX gradient = now.gradient;
    std::vector<char> counts(now.near.size());
    for (std::size_t k = 0; k < now.near.size(); ++k) counts[k] = now.near[k].residual > 0.0;
    for (int round = 0; round < kMostSides; ++round) {
      bool changed = false;
      for (std::size_t k = 0; k < now.near.size(); ++k) {
        const Near& near = now.near[k];
        const bool then = near.residual + near.slope.dot(step) > 0.0;
        if (then == static_cast<bool>(counts[k])) continue;
        const double weight = then ? 2.0 * near.weight : -2.0 * near.weight;
        gradient += weight * near.residual * near.slope;
        matrix += weight * near.slope * near.slope.transpose();
        counts[k] = then, changed = true;
      }
      if (!changed) break;
      step = -matrix.ldlt().solve(gradient);
    }
    for (Eigen::Index i = 0; i < step.size(); ++i)
      if (task.held[i]) step[i] = 0.0;
    return true;
  };
  callbacks.accepted = [&](double decrease) -> std::optional<solve::Reason> {
    now = std::move(next);
    if (now.miss < effort.enough && now.violation < effort.enough * effort.enough) return solve::Reason::goal;
    idle = decrease < kIdle * (now.miss * now.miss + now.violation) ? idle + 1 : 0;
    if (decrease < kNothing || idle == (around ? effort.steps : kIdleSteps)) return solve::Reason::cost;
    return {};
  };
  callbacks.rejected = [&](const VectorX& step) -> std::optional<solve::Reason> {
    double foretold = -step.dot(now.gradient + 0.5 * (now.curvature * step));
    for (const Near& near : now.near) {
      const double then = near.residual + near.slope.dot(step);
      if ((then > 0.0) != (near.residual > 0.0)) foretold += (then > 0.0 ? -1.0 : 1.0) * near.weight * then * then;
    }
    if (!(foretold > kNothing)) return solve::Reason::no_decrease;
    return {};
  };
  solve::Options options;
  options.steps = effort.steps;
  options.trials = effort.evaluations - 1;
  options.attempts = solve::Options::kAny;
  options.cost_tolerance = kConverged;
  options.longest = effort.longest;
  options.euclidean = true;
  options.eager = effort.hopeful;
  options.damping = {
      .first = effort.damping, .raise = effort.more_damping, .lower = kLessDamping, .least = kLeastDamping};
  return solve::least_squares(unknowns, callbacks, options);
}

double load(const Task& task, const VectorX& unknowns) {
  const Limits& limits = task.options->limits;
  double most = 0.0;
  const auto raise = [&](const Coordinates& c) {
    const Vector3 offset = c.col(0).head<3>() - task.motion.origin.translation;
    most = std::max({most, c.col(1).head<3>().norm() / limits.velocity, c.col(2).head<3>().norm() / limits.acceleration,
                     offset.cwiseAbs().maxCoeff() / limits.stroke, std::abs(c(3, 1)) / limits.yaw_velocity,
                     std::abs(c(3, 2)) / limits.yaw_acceleration, std::abs(c(3, 0)) / limits.turn});
    if (task.motion.window == Window::smooth)
      most = std::max({most, c.col(3).head<3>().norm() / limits.jerk, std::abs(c(3, 3)) / limits.yaw_jerk});
  };
  for (int node = 0; node < task.grid.nodes(); ++node)
    raise(moved(task.motion, unknowns, task.grid.basis[node], task.grid.fixed[node]));
  raise(moved(task.motion, unknowns, task.grid.end_basis, task.grid.end_fixed));
  return most;
}

std::vector<VectorX> carried(const Task& task) {
  std::vector<VectorX> out;
  const chain::Chain& chain = task.models.front()->chain;
  math::Pose base{task.motion.origin.rotation, task.grid.fixed[0].col(0).head<3>()};
  const auto motions = chain::link_motions(chain, task.initial.theta, base);
  for (const double part : task.part == Part::rope ? std::vector<double>{0.35, 0.65, 1.0} : std::vector<double>{1.0}) {
    const double s = part * chain.length;
    const Vector3 point = motions[chain::link_at(chain, std::min(s, 0.999 * chain.length))] * (s * chain.direction);
    VectorX q = VectorX::Zero(static_cast<Eigen::Index>(task.motion.axes.size()) * kPerAxis);
    for (std::size_t a = 0; a < task.motion.axes.size(); ++a) {
      const Eigen::Index i = static_cast<Eigen::Index>(a) * kPerAxis + kBasisCount;
      if (task.motion.axes[a] != Axis::yaw && !task.held[i])
        q[i] = (task.target - point)[static_cast<int>(task.motion.axes[a])];
    }
    const double most = load(task, q);
    if (most > kMostLoad) q *= kMostLoad / most;
    out.push_back(q);
  }
  return out;
}

VectorX random_unknowns(const Task& task, core::Random& random, double fraction) {
  VectorX q(static_cast<Eigen::Index>(task.motion.axes.size()) * kPerAxis);
  // weights that follow one another give slow wide motions, independent ones shake
  const double memory = random.uniform(-0.5, 0.9);
  for (std::size_t a = 0; a < task.motion.axes.size(); ++a) {
    double weight = 0.0;
    for (int i = 0; i < kBasisCount; ++i) {
      weight = memory * weight + random.normal();
      q[static_cast<Eigen::Index>(a) * kPerAxis + i] = weight;
    }
    q[static_cast<Eigen::Index>(a) * kPerAxis + kBasisCount] = 2.0 * random.normal();
  }
  for (Eigen::Index i = 0; i < q.size(); ++i)
    if (task.held[i]) q[i] = 0.0;
  // where other pieces move too, the load is not proportional: a few rounds
  for (int round = 0; round < 3; ++round) q *= std::min(10.0, fraction / std::max(load(task, q), 1e-6));
  return q;
}

}  // namespace chainsplat::planning
