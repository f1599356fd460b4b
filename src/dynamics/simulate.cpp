// RODAS3 and the implicit-in-velocity Euler step (SPEC 4), with the variational equation beside.
#include <cmath>

#include "engine.h"

namespace chainsplat::dynamics {
namespace {

constexpr double kFrame = 1.0 / 30.0;  // s, what `substeps` counts in
constexpr double kAngleBound = 1e3;    // rad, beyond which a motion counts as diverged
constexpr double kRateBound = 1e5;     // rad/s
constexpr int kMaxRefinement = 32;     // of the steps of a diverging rollout
constexpr double kJerkStep = 0.01;     // of a step, for the one-sided difference of the base acceleration

bool bounded(const VectorX& theta, const VectorX& thetadot) {
  // written so that NaN fails
  for (Eigen::Index k = 0; k < theta.size(); ++k)
    if (!(std::abs(theta[k]) < kAngleBound && std::abs(thetadot[k]) < kRateBound)) return false;
  return true;
}

// LU with partial pivoting in place, for a few dozen unknowns and without allocation.
class Factor {
 public:
  explicit Factor(int n) : pivot_(n) { matrix.resize(n, n); }
  MatrixX matrix;  // set it, then factor()

  bool factor() {
    const int n = static_cast<int>(matrix.rows());
    for (int j = 0; j < n; ++j) {
      int best = j;
      for (int i = j + 1; i < n; ++i)
        if (std::abs(matrix(i, j)) > std::abs(matrix(best, j))) best = i;
      pivot_[j] = best;
      if (!(std::abs(matrix(best, j)) > 0.0)) return false;
      if (best != j) matrix.row(j).swap(matrix.row(best));
      const double scale = 1.0 / matrix(j, j);
      for (int i = j + 1; i < n; ++i) matrix(i, j) *= scale;
      for (int k = j + 1; k < n; ++k) {
        const double factor = matrix(j, k);
        for (int i = j + 1; i < n; ++i) matrix(i, k) -= factor * matrix(i, j);
      }
    }
    return true;
  }
  template <class Column>
  void solve(Column&& x) const {
    const int n = static_cast<int>(matrix.rows());
    for (int j = 0; j < n; ++j)
      if (pivot_[j] != j) std::swap(x[j], x[pivot_[j]]);
    for (int j = 0; j < n; ++j) {
      const double value = x[j];
      for (int i = j + 1; i < n; ++i) x[i] -= value * matrix(i, j);
    }
    for (int j = n - 1; j >= 0; --j) {
      const double value = x[j] /= matrix(j, j);
      for (int i = 0; i < j; ++i) x[i] -= value * matrix(i, j);
    }
  }

 private:
  std::vector<int> pivot_;
};

// S' = J S + b by the trapezoidal rule; X = d theta / d unknowns, Y = X', acceleration = Y'.
struct Variation {
  MatrixX x, y, acceleration, forces, right, predicted_x, predicted_y;
  bool started = false;

  Variation(std::span<const Tangent> unknowns, int n) {
    const auto columns = static_cast<Eigen::Index>(unknowns.size());
    for (MatrixX* m : {&x, &y, &acceleration, &forces, &right, &predicted_x, &predicted_y}) m->setZero(n, columns);
    for (Eigen::Index p = 0; p < columns; ++p) {
      if (unknowns[p].theta.size()) x.col(p) = unknowns[p].theta;
      if (unknowns[p].thetadot.size()) y.col(p) = unknowns[p].thetadot;
    }
  }

  // The engine is linearized at the new node; `factor` holds M + g damping + g^2 stiffness there, g half the step
  // before.
  void advance(Engine& engine, const Factor& factor, std::span<const Tangent> unknowns, double g) {
    engine.unknown_forces(unknowns, forces);
    predicted_y = y + g * acceleration;
    predicted_x = x + (2.0 * g) * y + (g * g) * acceleration;
    acceleration.noalias() = -engine.stiffness * predicted_x;
    acceleration.noalias() -= engine.damping * predicted_y;
    acceleration += forces;
    for (Eigen::Index p = 0; p < acceleration.cols(); ++p) factor.solve(acceleration.col(p));
    y = predicted_y + g * acceleration;
    x = predicted_x + (g * g) * acceleration;
  }
};

}  // namespace

BaseGrid sample_base(const BaseFunction& base, double start, const std::vector<double>& times, int substeps) {
  BaseGrid grid;
  double now = start;
  std::size_t begin = 0;
  if (times.empty()) throw InputError("rollout", "no output times", "ask for at least one");
  grid.nodes.push_back({start, 0.0, base(start), Vector6::Zero(), false});
  if (times[0] == start) {
    grid.nodes[0].output = true;
    begin = 1;
  }
  for (std::size_t i = begin; i < times.size(); ++i) {
    const double interval = times[i] - now;
    if (!(interval > 0.0) || !std::isfinite(interval))
      throw InputError("rollout", "output times do not increase at " + core::exact(times[i]) + " s",
                       "give increasing times from the initial state's time on");
    const double wanted = interval / kFrame * substeps;
    const int steps = std::max(1, static_cast<int>(std::ceil(wanted - 1e-6)));  // 1e-6: times are rounded in files
    for (int s = 1; s <= steps; ++s) {
      BaseGrid::Node& last = grid.nodes.back();
      const double next = s == steps ? times[i] : now + interval * s / steps;
      last.step = next - last.time;
      const double e = kJerkStep * last.step;
      last.jerk = (4.0 * base(last.time + e).acceleration - base(last.time + 2.0 * e).acceleration -
                   3.0 * last.motion.acceleration) /
                  (2.0 * e);
      grid.nodes.push_back({next, 0.0, base(next), Vector6::Zero(), s == steps});
    }
    now = times[i];
  }
  return grid;
}

bool simulate(const Model& model, const BaseGrid& grid, const VectorX& theta0, const VectorX& thetadot0,
              chain::States& states, std::span<const Tangent> unknowns, Sensitivities* sensitivities) {
  const int n = model.chain.angles();
  CHAINSPLAT_CHECK(theta0.size() == n && thetadot0.size() == n, std::to_string(theta0.size()));
  const bool rodas = model.parameters.integrator == Integrator::rodas3;
  const bool vary = sensitivities != nullptr && !unknowns.empty();
  CHAINSPLAT_CHECK(rodas || !vary, "variational equation with the Euler step");
  Engine engine(model), stage(model);
  Factor factor(n), other_factor(n);
  Variation variation(vary ? unknowns : std::span<const Tangent>{}, n);
  VectorX theta = theta0, thetadot = thetadot0;
  VectorX right_theta(n), stage_theta(n), stage_thetadot(n), stage_acceleration(n), work(n);
  VectorX k_theta[4], k_rate[4];
  for (int i = 0; i < 4; ++i) k_theta[i].setZero(n), k_rate[i].setZero(n);

  std::size_t count = 0;
  const auto write = [&](double time) {
    if (states.time.size() <= count)
      states.time.emplace_back(), states.theta.emplace_back(), states.thetadot.emplace_back();
    if (states.thetadot.size() <= count) states.thetadot.resize(count + 1);
    states.time[count] = time, states.theta[count] = theta, states.thetadot[count] = thetadot;
    if (vary) {
      if (sensitivities->theta.size() <= count)
        sensitivities->theta.emplace_back(), sensitivities->thetadot.emplace_back();
      sensitivities->theta[count] = variation.x, sensitivities->thetadot[count] = variation.y;
    }
    ++count;
  };
  const auto finish = [&](bool good) {
    states.time.resize(count), states.theta.resize(count), states.thetadot.resize(count);
    if (vary) sensitivities->theta.resize(count), sensitivities->thetadot.resize(count);
    return good;
  };
  // (1/G - J) k = r for r = (right_theta, M^-1 of `work`), G = gamma H: SPEC 4
  const auto solve_stage = [&](int i, double g) {
    work.noalias() -= g * (engine.stiffness * right_theta);
    work *= g;
    factor.solve(work);
    k_rate[i] = work;
    k_theta[i] = g * (right_theta + work);
  };
  // acceleration at (theta + ..., thetadot + ...) under the base motion of the next node
  const auto evaluate = [&](const trajectory::BaseMotion& motion) {
    stage.place(motion, stage_theta, stage_thetadot, false);
    if (!stage.factor_mass()) return false;
    stage.accelerate();
    return true;
  };

  double last_step = 0.0;
  for (std::size_t node = 0; node < grid.nodes.size(); ++node) {
    const BaseGrid::Node& now = grid.nodes[node];
    const double h = now.step, g = 0.5 * h;
    const bool last = node + 1 == grid.nodes.size();
    if (!bounded(theta, thetadot)) return finish(false);
    if (!last || vary) {
      engine.place(now.motion, theta, thetadot, true);
      // M a = force, so the first stage needs no factor of M; the tangents need a itself
      if (!engine.factor_mass()) return finish(false);
      engine.accelerate();
      engine.linearize(now.jerk);
      const double scale = rodas ? g : h;
      if (!last) {
        factor.matrix = engine.mass + scale * engine.damping;
        if (rodas) factor.matrix += (g * g) * engine.stiffness;
        if (!factor.factor()) return finish(false);
      }
      if (vary) {
        if (node == 0) {
          engine.unknown_forces(unknowns, variation.forces);
          variation.acceleration = variation.forces - engine.stiffness * variation.x - engine.damping * variation.y;
          other_factor.matrix = engine.mass;
          if (!other_factor.factor()) return finish(false);
          for (Eigen::Index p = 0; p < variation.acceleration.cols(); ++p)
            other_factor.solve(variation.acceleration.col(p));
        } else if (!last && std::abs(last_step - h) <= 1e-9 * h) {
          variation.advance(engine, factor, unknowns, 0.5 * last_step);
        } else {
          const double half = 0.5 * last_step;
          other_factor.matrix = engine.mass + half * engine.damping + (half * half) * engine.stiffness;
          if (!other_factor.factor()) return finish(false);
          variation.advance(engine, other_factor, unknowns, half);
        }
      }
    }
    if (now.output) write(now.time);
    if (last) break;
    last_step = h;

    if (!rodas) {
      work = h * engine.force;
      factor.solve(work);
      thetadot += work;
      theta += h * thetadot;
      continue;
    }
    const trajectory::BaseMotion& next = grid.nodes[node + 1].motion;
    // stages 1 and 2: f = (thetadot, a), f_t = (0, M^-1 drive_rate)
    right_theta = thetadot;
    work = engine.force + (0.5 * h) * engine.drive_rate;
    solve_stage(0, g);
    right_theta = thetadot + (4.0 / h) * k_theta[0];
    work = engine.force + (1.5 * h) * engine.drive_rate;
    work.noalias() += (4.0 / h) * (engine.mass * k_rate[0]);
    solve_stage(1, g);
    // stage 3
    stage_theta = theta + 2.0 * k_theta[0];
    stage_thetadot = thetadot + 2.0 * k_rate[0];
    if (!bounded(stage_theta, stage_thetadot) || !evaluate(next)) return finish(false);
    right_theta = stage_thetadot + (k_theta[0] - k_theta[1]) / h;
    stage_acceleration = stage.acceleration + (k_rate[0] - k_rate[1]) / h;
    work.noalias() = engine.mass * stage_acceleration;
    solve_stage(2, g);
    // stage 4
    stage_theta += k_theta[2];
    stage_thetadot += k_rate[2];
    if (!bounded(stage_theta, stage_thetadot) || !evaluate(next)) return finish(false);
    right_theta = stage_thetadot + (k_theta[0] - k_theta[1] - (8.0 / 3.0) * k_theta[2]) / h;
    stage_acceleration = stage.acceleration + (k_rate[0] - k_rate[1] - (8.0 / 3.0) * k_rate[2]) / h;
    work.noalias() = engine.mass * stage_acceleration;
    solve_stage(3, g);
    theta = stage_theta + k_theta[3];
    thetadot = stage_thetadot + k_rate[3];
  }
  return finish(true);
}

chain::States rollout(const Model& model, const BaseFunction& base, const InitialState& initial,
                      const std::vector<double>& times) {
  chain::States states;
  for (int refinement = 1; refinement <= kMaxRefinement; refinement *= 2) {
    const BaseGrid grid = sample_base(base, initial.time, times, model.parameters.substeps * refinement);
    if (simulate(model, grid, initial.theta, initial.thetadot, states)) return states;
  }
  const double reached = states.time.empty() ? initial.time : states.time.back();
  throw WorkError("rollout", "the motion diverged after " + core::exact(reached) + " s",
                  "check the base trajectory for jumps and the parameters for tiny masses or huge frictions");
}

chain::States rollout(const Model& model, const trajectory::Trajectory& base, const InitialState& initial,
                      const std::vector<double>& times) {
  return rollout(
      model, [&](double time) { return base.at(time); }, initial, times);
}

}  // namespace chainsplat::dynamics
