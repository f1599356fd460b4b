// Rollouts, with their derivatives beside (mathematics.md 4).
#include <cmath>

#include "step.h"

namespace chainsplat::dynamics {
namespace {

constexpr double kFrame = 1.0 / 30.0;  // s, what `substeps` counts in
constexpr int kMaxRefinement = 32;     // of the steps of a diverging rollout
constexpr int kMostSteps = 4000000;  // a step is kept with its motion: 1 GiB. At 8 steps per frame more than four hours
constexpr double kJerkStep = 0.01;   // of a step, for the one-sided difference of the base acceleration

}  // namespace

int step_count(double interval, int substeps) {
  constexpr double kRounding = 1e-6;  // times are rounded in files
  return std::max(1, static_cast<int>(std::ceil(interval / kFrame * substeps - kRounding)));
}

BaseGrid sample_base(const BaseFunction& base, double start, const std::vector<double>& times, int substeps) {
  BaseGrid grid;
  double now = start;
  std::size_t begin = 0;
  if (times.empty()) throw InputError("rollout", "no output times", "ask for at least one");
  if (const double steps = (times.back() - start) / kFrame * substeps;
      steps > kMostSteps && std::isfinite(times.back()))
    throw InputError("rollout",
                     "from " + core::exact(start) + " to " + core::exact(times.back()) + " s it would take " +
                         core::exact(std::ceil(steps)) + " steps, and memory is meant for " +
                         std::to_string(kMostSteps),
                     "check the times, or split the motion");
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
    if (!(interval / kFrame * substeps < kMostSteps))
      throw InputError("rollout", "from " + core::exact(now) + " to " + core::exact(times[i]) + " s are too many steps",
                       "give times nearer to each other");
    const int steps = step_count(interval, substeps);
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

namespace {

bool integrate(const Model& model, const BaseGrid& grid, const InitialState& initial, chain::States& states,
               Variation* variation, Sensitivities* sensitivities, Divergence* divergence) {
  const int n = model.chain.angles();
  CHAINSPLAT_CHECK(initial.theta.size() == n && initial.thetadot.size() == n, std::to_string(initial.theta.size()));
  CHAINSPLAT_CHECK(!variation || model.parameters.integrator == Integrator::rodas3,
                   "variational equation with the Euler step");
  Step step(model);
  Factor other_factor(n);
  VectorX theta = initial.theta, thetadot = initial.thetadot;
  const bool internal = step.internal.present;
  CHAINSPLAT_CHECK(initial.internal_state.size() == 0 || initial.internal_state.size() == n ||
                       initial.internal_state.size() == step.internal.size,
                   std::to_string(initial.internal_state.size()));
  if (internal) step.internal_state = step.internal.start(step.engine, initial.internal_state, theta);
  if (internal && variation)
    step.internal.start_slopes(step.engine, initial.internal_state, variation->x, variation->tangents, variation->z);

  std::size_t count = 0;
  const auto write = [&](double time) {
    if (states.time.size() <= count)
      states.time.emplace_back(), states.theta.emplace_back(), states.thetadot.emplace_back();
    if (states.thetadot.size() <= count) states.thetadot.resize(count + 1);
    states.time[count] = time, states.theta[count] = theta, states.thetadot[count] = thetadot;
    if (internal && states.internal_state.size() <= count) states.internal_state.resize(count + 1);
    if (internal) states.internal_state[count] = step.internal_state;
    if (variation) {
      if (sensitivities->theta.size() <= count)
        sensitivities->theta.emplace_back(), sensitivities->thetadot.emplace_back();
      sensitivities->theta[count] = variation->x, sensitivities->thetadot[count] = variation->y;
    }
    ++count;
  };
  const auto finish = [&](bool good) {
    states.time.resize(count), states.theta.resize(count), states.thetadot.resize(count);
    states.internal_state.resize(internal ? count : 0);
    if (variation) sensitivities->theta.resize(count), sensitivities->thetadot.resize(count);
    return good;
  };

  double last_step = 0.0;
  for (std::size_t node = 0; node < grid.nodes.size(); ++node) {
    const BaseGrid::Node& now = grid.nodes[node];
    const bool last = node + 1 == grid.nodes.size();
    const auto failed = [&] {
      if (divergence) *divergence = {now.time, step.bad_angle, step.singular};
      return finish(false);
    };
    if (!step.bounded(theta, thetadot)) return failed();
    if ((!last || variation) && !step.linearize(now, theta, thetadot)) return failed();
    if (variation && (node == 0 || variation->exact)) {
      if (!variation->start(step.engine, step.internal, node)) return failed();
    } else if (variation) {
      const double half = 0.5 * last_step;
      const bool same = !last && std::abs(last_step - now.step) <= 1e-9 * now.step;
      if (!same) {
        other_factor.matrix = step.engine.mass + half * step.engine.damping + (half * half) * step.engine.stiffness;
        if (internal && !step.internal.prepare(half)) return failed();
        if (internal) step.internal.add_to(other_factor.matrix);
        if (!other_factor.factor()) return failed();
      }
      variation->advance(step.engine, step.internal, same ? step.factor : other_factor, node, half);
      if (internal && !same && !last && !step.internal.prepare(0.5 * now.step)) return failed();
    }
    if (now.output) write(now.time);
    if (last) break;
    last_step = now.step;
    if (!step.advance(now.step, grid.nodes[node + 1].motion, theta, thetadot, variation, node)) return failed();
  }
  return finish(true);
}

}  // namespace

bool simulate(const Model& model, const BaseGrid& grid, const InitialState& initial, chain::States& states,
              std::span<const Tangent> unknowns, Sensitivities* sensitivities, Divergence* divergence) {
  if (!sensitivities || unknowns.empty()) return integrate(model, grid, initial, states, nullptr, nullptr, divergence);
  const auto forces = [&](Engine& engine, std::size_t, double, MatrixX& out) { engine.unknown_forces(unknowns, out); };
  Variation variation(model.chain.angles(), static_cast<Eigen::Index>(unknowns.size()), forces, {}, false,
                      InternalState(model).size);
  variation.tangents = unknowns;
  for (Eigen::Index p = 0; p < variation.x.cols(); ++p) {
    if (unknowns[p].theta.size()) variation.x.col(p) = unknowns[p].theta;
    if (unknowns[p].thetadot.size()) variation.y.col(p) = unknowns[p].thetadot;
  }
  return integrate(model, grid, initial, states, &variation, sensitivities, divergence);
}

bool simulate(const Model& model, const BaseGrid& grid, const VectorX& theta, const VectorX& thetadot,
              chain::States& states, std::span<const Tangent> unknowns, Sensitivities* sensitivities,
              Divergence* divergence) {
  return simulate(model, grid, InitialState{0.0, theta, thetadot}, states, unknowns, sensitivities, divergence);
}

bool simulate(const Model& model, const BaseGrid& grid, const InitialState& initial, chain::States& states,
              const BaseUnknowns& unknowns, bool exact, Sensitivities& sensitivities) {
  BaseSlopes slopes;
  const auto forces = [&](Engine& engine, std::size_t node, double after, MatrixX& out) {
    engine.base_slopes(slopes);
    unknowns.torques(node, after, slopes, out);
    out = -out;
  };
  Variation variation(model.chain.angles(), unknowns.count, forces, unknowns.motion, exact, InternalState(model).size);
  return integrate(model, grid, initial, states, &variation, &sensitivities, nullptr);
}

bool simulate(const Model& model, const BaseGrid& grid, const VectorX& theta, const VectorX& thetadot,
              chain::States& states, const BaseUnknowns& unknowns, bool exact, Sensitivities& sensitivities) {
  return simulate(model, grid, InitialState{0.0, theta, thetadot}, states, unknowns, exact, sensitivities);
}

chain::States rollout(const Model& model, const BaseFunction& base, const InitialState& initial,
                      const std::vector<double>& times) {
  const int n = model.chain.angles();
  if (initial.theta.size() != n || initial.thetadot.size() != n)
    throw InputError("rollout",
                     "the initial state has " + std::to_string(initial.theta.size()) + " angles and " +
                         std::to_string(initial.thetadot.size()) + " rates, the chain " + std::to_string(n),
                     "start from a state of this rope");
  chain::States states;
  Divergence last;
  Model now = model;
  while (true) {
    const bool euler = now.parameters.integrator == Integrator::implicit_velocity_euler;
    const std::string name = euler ? "implicit Euler" : "RODAS3";
    for (int refinement = 1; refinement <= kMaxRefinement; refinement *= 2) {
      const int substeps = now.parameters.substeps * refinement;
      if (simulate(now, sample_base(base, initial.time, times, substeps), initial, states, {}, nullptr, &last))
        return states;
      const std::string joint = "joint " + std::to_string(model.chain.child_link[last.angle]);
      if (last.singular)
        throw InputError("rollout",
                         "the mass matrix is singular at " + core::exact(last.time) + " s: no inertia about " + joint,
                         "give every link mass, and the rope a diameter where it can twist");
      if (2 * refinement <= kMaxRefinement)
        core::warn("rollout: " + name + " with " + std::to_string(substeps) + " steps a frame diverges at " +
                   core::exact(last.time) + " s in " + joint + "; repeated with " + std::to_string(2 * substeps));
    }
    if (!euler) break;
    core::warn("rollout: implicit Euler diverges at every step size tried; RODAS3 takes its place");
    now.parameters.integrator = Integrator::rodas3;
  }
  throw WorkError("rollout",
                  "the motion diverged at " + core::exact(last.time) + " s in joint " +
                      std::to_string(model.chain.child_link[last.angle]) + " even with " +
                      std::to_string(model.parameters.substeps * kMaxRefinement) + " steps per frame",
                  "check the base trajectory for jumps and the parameters for tiny masses or huge frictions");
}

chain::States rollout(const Model& model, const trajectory::Trajectory& base, const InitialState& initial,
                      const std::vector<double>& times) {
  return rollout(
      model, [&](double time) { return base.at(time); }, initial, times);
}

}  // namespace chainsplat::dynamics
