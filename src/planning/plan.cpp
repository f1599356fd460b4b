#include <algorithm>
#include <cmath>
#include <cstdio>
#include <limits>
#include <numeric>

#include "search.h"

namespace chainsplat::planning {
namespace {

// Annealing of the soft minimum (mathematics.md 8), with the steps for each.
constexpr struct {
  double sharpness, smoothness;
  int steps, evaluations;
} kCoarse[] = {{1e3, 1e-6, 4, 10}, {1e4, 1e-7, 5, 14}};
constexpr double kFinalSharpness = 1e5, kSharpest = 1e6;  // m^-2
constexpr double kFinalSmoothness = 3e-9;
constexpr double kFinalClearance = 0.001;  // m; a target may lie as near to an obstacle
// Behind obstacles many starts end beside the target: steps of 1/30 s lead the search nearly as well as finer ones at a
// fraction of the cost. Without obstacles, where the first start or two reach it, half the full steps.
int coarse_substeps(const Problem& problem, const Options& options) {
  const bool obstacles = !options.spheres.empty() || !options.boxes.empty();
  return obstacles ? 1 : std::max(1, problem.model.parameters.substeps / 2);
}
constexpr int kFinalSteps = 9, kFinalEvaluations = 20;
constexpr int kPolishSteps = 4;          // with exact derivatives, each as dear as seven others
constexpr double kWorthPolish = 2.0;     // of the tolerance
constexpr double kEnough = 0.1;          // of the tolerance: no further iteration is made
constexpr double kMostSpent = 80.0;      // evaluations with full steps, after which nothing further is tried
constexpr double kGoodMiss = 0.3;        // of the tolerance: no further start is tried
constexpr int kHard = 3;                 // groups after which the tolerance itself is enough
constexpr double kStrictLimits = 100.0;  // times the usual weight
// Starts optimized side by side; the next group only where the last failed.
constexpr int kGroups[] = {1, 1, 2, 2, 2, 2, 2, 2, 2, 2};
constexpr double kPromising = 10.0;     // of the tolerance: a coarse miss from which it is worth to go on at once,
constexpr double kNearlyClear = 0.002;  // m, unless it is deeper than this in an obstacle: through it, not around it
constexpr int kOutOfReach = 2;          // groups where geometry says that no motion reaches the target
constexpr int kLastTries = 2;           // of the nearest others, where no start was good
constexpr std::uint64_t kTargetStream = 0x7461726765740001ull;  // random numbers of random_target
constexpr double kHorizons[] = {0.25, 0.35, 0.5, 0.7, 1.0};     // of the longest, for a free one
constexpr double kTableSlack = 1e-6;                            // m, a target may lie in the table's plane

std::string millimeters(double meters) {
  char text[32];
  std::snprintf(text, sizeof text, "%.1f mm", 1e3 * meters);
  return text;
}

void validate(const Problem& problem, const Options& options) {
  const auto positive = [](double value, const char* name) {
    if (!(value > 0.0) || !std::isfinite(value))
      throw InputError(name, "is " + core::exact(value), "give a number above 0");
  };
  const Limits& limits = options.limits;
  positive(options.horizon, "`horizon`");
  positive(limits.velocity, "velocity limit");
  positive(limits.acceleration, "acceleration limit");
  positive(limits.jerk, "jerk limit");
  positive(limits.stroke, "stroke limit");
  positive(limits.yaw_velocity, "yaw velocity limit");
  positive(limits.yaw_acceleration, "yaw acceleration limit");
  positive(limits.yaw_jerk, "yaw jerk limit");
  positive(limits.turn, "turn limit");
  positive(options.tolerance, "`tolerance`");
  if (problem.targets.empty()) throw InputError("`targets`", "no target is given", "give X,Y,Z");
  const std::vector<Axis> axes = options.axes.empty() ? default_axes(problem.model.chain) : options.axes;
  for (std::size_t i = 0; i < axes.size(); ++i)
    if (std::find(axes.begin() + i + 1, axes.end(), axes[i]) != axes.end())
      throw InputError("`axes`", "an axis is named twice", "name each of x, y, z, yaw once at most");
  if (problem.tabletop && problem.model.parameters.table_normal)
    for (Axis axis : axes)
      if (axis != Axis::yaw &&
          std::abs(problem.model.parameters.table_normal->operator[](static_cast<int>(axis))) > 0.1)
        throw InputError("`axes`", "one leaves the table and the rope is known on the table only", "leave it out");
  for (const Vector3& target : problem.targets) {
    if (!target.allFinite())
      throw InputError("`targets`", "a coordinate is not a finite number", "give X,Y,Z in meters");
    if (problem.tabletop && problem.table_point && problem.model.parameters.table_normal &&
        problem.model.parameters.table_normal->dot(target - *problem.table_point) < -kTableSlack)
      throw InputError("`targets`", "lies under the table", "give a point on the table or above it");
  }
  if (options.terminal) {
    if (options.terminal->size() != static_cast<Eigen::Index>(axes.size()) || !options.terminal->allFinite())
      throw InputError("`terminal`", "has " + std::to_string(options.terminal->size()) + " numbers",
                       "give an offset for each of the " + std::to_string(axes.size()) + " axes");
    for (std::size_t a = 0; a < axes.size(); ++a)
      if (std::abs((*options.terminal)[static_cast<Eigen::Index>(a)]) >
          (axes[a] == Axis::yaw ? limits.turn : limits.stroke))
        throw InputError("`terminal`", "is outside the stroke", "raise the stroke limit or end nearer to the start");
    // from rest to rest: half the time faster and half slower, each limit alone
    const double time = options.horizon * static_cast<double>(problem.targets.size());
    for (std::size_t a = 0; a < axes.size(); ++a) {
      const double way = std::abs((*options.terminal)[static_cast<Eigen::Index>(a)]);
      const bool yaw = axes[a] == Axis::yaw;
      const char* limit = nullptr;
      if (way > (yaw ? limits.yaw_velocity : limits.velocity) * time)
        limit = "velocity";
      else if (way > (yaw ? limits.yaw_acceleration : limits.acceleration) * time * time / 4.0)
        limit = "acceleration";
      else if (way > (yaw ? limits.yaw_jerk : limits.jerk) * time * time * time / 32.0)
        limit = "jerk";
      if (limit) {
        std::string what = "cannot be reached in ";
        what += core::exact(time);
        what += " s within the ";
        what += limit;
        throw InputError("`terminal`", what + " limit", "give a longer horizon, a nearer end or a higher limit");
      }
    }
  }
  for (const Sphere& s : options.spheres)
    if (!s.center.allFinite() || !(s.radius > 0.0))
      throw InputError("`spheres`", "is no sphere", "give X,Y,Z,RADIUS with a radius above 0");
  for (const Box& b : options.boxes)
    if (!b.low.allFinite() || !b.high.allFinite() || !((b.high - b.low).minCoeff() > 0.0))
      throw InputError("`boxes`", "is no box", "give the lower corner, then the upper corner");
  if (!options.spheres.empty() || !options.boxes.empty()) {
    Motion motion = empty_motion(problem, options);
    append_piece(motion, 0.0, options.horizon);
    Task task = make_task(problem, options, {&problem.model}, motion, problem.initial, problem.base.translation, 1);
    task.grid.basis.resize(1);
    Rollout start;
    start.base = {task.grid.fixed[0]}, start.theta = {problem.initial.theta};
    if (clearance(task, problem.model, start) < 0.0)
      throw InputError(options.spheres.empty() ? "`boxes`" : "`spheres`", "rope or gripper touch it at the start",
                       "move it, or give the gripper's size with `gripper_radius`");
  }
}

struct Found {
  VectorX unknowns;
  Hit hit;
  Peaks peaks;
  double clearance = 0.0;
  bool good = false;   // finite, within the limits, clear of the obstacles
  int iterations = 0;  // evaluations spent on it
  solve::Summary summary;
};

void improve(const Task& task, const Sharpness& sharpness, const Effort& effort, Found& found) {
  found.summary = minimize(task, found.unknowns, sharpness, effort);
  found.iterations += 1 + found.summary.iterations;
}

// Full steps, fine peaks, all samples.
void judge(const Task& task, Found& found) {
  found.good = false;
  std::vector<Rollout> rollouts(task.models.size());
  std::vector<char> finite(task.models.size());
  core::parallel_for(static_cast<std::int64_t>(task.models.size()), [&](std::int64_t m) {
    finite[m] = roll_out(*task.models[m], task.motion, task.grid, found.unknowns, task.initial, false, rollouts[m]);
  });
  found.hit = {};
  found.hit.miss = std::numeric_limits<double>::infinity();
  if (std::find(finite.begin(), finite.end(), 0) != finite.end()) return;
  found.clearance = std::numeric_limits<double>::infinity();
  double mean = 0.0, worst = 0.0;
  for (std::size_t m = 0; m < task.models.size(); ++m) {
    const Hit hit = measure(task, *task.models[m], rollouts[m]);
    if (m == 0) found.hit = hit;
    mean += hit.miss / static_cast<double>(task.models.size());
    worst = std::max(worst, hit.miss);
    found.clearance = std::min(found.clearance, clearance(task, *task.models[m], rollouts[m]));
  }
  found.hit.mean_miss = mean, found.hit.worst_miss = worst;
  Motion motion = task.motion;
  set_unknowns(motion, found.unknowns);
  found.peaks = peaks(motion, task.grid.start, task.grid.time(task.grid.nodes() - 1), task.options->limits);
  found.good = found.peaks.over.empty() && found.clearance >= 0.0;
}

double merit(const Found& found, const Options& options) {
  return options.worst_case ? found.hit.worst_miss : found.hit.mean_miss;
}

bool better(const Found& a, const Found& b, const Options& options) {
  if (a.good != b.good) return a.good;
  return merit(a, options) < merit(b, options);
}

// With coarse steps and a soft minimum that is sharpened.
Found approach(const Task& coarse, VectorX unknowns) {
  Found found;
  found.unknowns = std::move(unknowns);
  for (const auto& stage : kCoarse)
    improve(coarse, {stage.sharpness, stage.smoothness}, {.steps = stage.steps, .evaluations = stage.evaluations},
            found);
  judge(coarse, found);
  return found;
}

// With full steps from what approach() left.
void finish(const Task& fine, Found& found) {
  const Options& options = *fine.options;
  Task quick = fine;
  quick.exact = false;
  const Sharpness last{kFinalSharpness, kFinalSmoothness, kFinalClearance};
  const double enough = kEnough * options.tolerance;
  improve(quick, last, {.steps = kFinalSteps, .evaluations = kFinalEvaluations, .enough = enough}, found);
  judge(fine, found);
  if (!std::isfinite(found.hit.miss)) return;
  if (!found.good) {  // a far target pulls harder than the limits push: once more with limits that count more
    quick.limit_weight = kStrictLimits;
    improve(quick, {kFinalSharpness, kFinalSmoothness}, {.steps = kFinalSteps, .evaluations = kFinalEvaluations},
            found);
    judge(fine, found);
  }
  if (found.good && merit(found, options) <= kGoodMiss * options.tolerance) return;
  if (!(merit(found, options) <= kWorthPolish * options.tolerance)) return;
  // what is left: the soft minimum likes to stay near for long, and derivatives of lower order end too early
  Task exact = fine;
  exact.limit_weight = quick.limit_weight;
  Found polished = found;
  const Effort dear{.steps = kPolishSteps, .evaluations = 3 * kPolishSteps, .hopeful = false, .enough = enough};
  improve(exact, {kSharpest, kFinalSmoothness, kFinalClearance}, dear, polished);
  judge(fine, polished);
  found.iterations = polished.iterations;
  if (better(polished, found, options)) found = std::move(polished);
}

// The best motion of one stretch; `tried` and `iterations` are added to.
Found solve(const Problem& problem, const Options& options, const std::vector<const dynamics::Model*>& models,
            const Motion& motion, const dynamics::InitialState& initial, const Vector3& target,
            const std::optional<VectorX>& terminal, bool out_of_reach, int& tried, int& iterations) {
  const int substeps = problem.model.parameters.substeps;
  Task fine = make_task(problem, options, models, motion, initial, target, substeps);
  Task coarse = make_task(problem, options, models, motion, initial, target, coarse_substeps(problem, options));
  coarse.exact = false;
  VectorX rest = VectorX::Zero(static_cast<Eigen::Index>(motion.axes.size()) * kPerAxis);
  if (terminal)
    for (Task* task : {&fine, &coarse})
      for (Eigen::Index a = 0; a < terminal->size(); ++a) {
        task->held[a * kPerAxis + kBasisCount] = true;
        rest[a * kPerAxis + kBasisCount] = (*terminal)[a];
      }

  // diverse motions, rolled out with the identified parameters only
  std::vector<VectorX> starts = carried(coarse);
  core::Random random(options.seed + 1);
  for (int i = 0; i < options.starts; ++i)
    starts.push_back(random_unknowns(coarse, random, random.uniform(kLeastLoad, kMostLoad)));
  for (VectorX& q : starts) q += rest;
  // a motion that obstacles do not touch is found as if they were not there, and one that they do is a start: it hits
  std::optional<Found> direct;
  if (!options.spheres.empty() || !options.boxes.empty()) {
    Options free = options;
    free.spheres.clear(), free.boxes.clear();
    direct = solve(problem, free, models, motion, initial, target, terminal, out_of_reach, tried, iterations);
    judge(fine, *direct);
    if (direct->good) return *direct;
  }
  tried += static_cast<int>(starts.size());
  // the best first, as they come near with the links that count; rolled out with the identified parameters only
  const auto ranked = [&](const Task& task) {
    Task screening = task;
    screening.models = {models.front()};
    std::vector<double> value(starts.size());
    core::parallel_for(static_cast<std::int64_t>(starts.size()), [&](std::int64_t i) {
      const Evaluation e = evaluate(screening, starts[i], {kFinalSharpness, kCoarse[0].smoothness}, false);
      value[i] = e.good ? e.value : std::numeric_limits<double>::infinity();
    });
    std::vector<int> order(starts.size());
    std::iota(order.begin(), order.end(), 0);
    std::stable_sort(order.begin(), order.end(), [&](int a, int b) { return value[a] < value[b]; });
    return order;
  };
  // The point of a rope on a table that is nearest at first is not always one that can be brought to the target: where
  // that failed every other start draws the free end alone.
  Task tip = coarse;
  tip.first_link = problem.model.chain.links() - 1;
  std::vector<int> order = ranked(coarse);
  if (direct) {
    order.insert(order.begin(), static_cast<int>(starts.size()));
    starts.push_back(direct->unknowns);
  }
  std::vector<int> tip_order;

  // samples have a spread that no motion removes
  const double enough = models.size() > 1 ? options.tolerance : kGoodMiss * options.tolerance;
  const auto good = [&](const Found& found) { return found.good && merit(found, options) <= enough; };
  const auto by_merit = [&](const Found& a, const Found& b) { return better(a, b, options); };
  std::vector<Found> near;  // where a start led with coarse steps, not gone further
  std::optional<Found> best;
  double spent = 0.0;  // evaluations with full steps, or what costs as much
  const double coarse_cost = static_cast<double>(coarse_substeps(problem, options)) / substeps;
  const auto go_further = [&](Found found) {
    found.iterations = 0;
    finish(fine, found);
    iterations += found.iterations;
    spent += found.iterations;
    if (!best || better(found, *best, options)) best = std::move(found);
  };
  std::size_t next = 0, next_tip = 0;
  int groups = 0;
  for (const int group : kGroups) {
    if (spent > kMostSpent || (out_of_reach && groups == kOutOfReach)) break;
    ++groups;
    std::vector<std::pair<const Task*, int>> chosen;  // with the start
    if (group > 1 && problem.tabletop && coarse.part == Part::rope && tip_order.empty()) tip_order = ranked(tip);
    for (int i = 0; i < group; ++i)
      if (i % 2 == 1 && next_tip < tip_order.size())
        chosen.emplace_back(&tip, tip_order[next_tip++]);
      else if (next < order.size())
        chosen.emplace_back(&coarse, order[next++]);
    std::vector<Found> found(chosen.size());
    core::parallel_for(static_cast<std::int64_t>(chosen.size()),
                       [&](std::int64_t i) { found[i] = approach(*chosen[i].first, starts[chosen[i].second]); });
    for (Found& f : found) {
      iterations += f.iterations;
      spent += coarse_cost * f.iterations;
      near.push_back(std::move(f));
    }
    std::stable_sort(near.begin(), near.end(), by_merit);
    if (!near.empty() && merit(near.front(), options) <= kPromising * options.tolerance &&
        near.front().clearance > -kNearlyClear) {
      go_further(near.front());
      near.erase(near.begin());
    }
    if (core::stop_requested()) throw Interrupted(core::stop_requested());
    if (best && good(*best)) return *best;
    if (best && best->good && groups >= kHard && merit(*best, options) <= options.tolerance) return *best;
    if (best && best->good && models.size() > 1 && group > 1) return *best;
  }
  for (int i = 0; i < kLastTries && !near.empty() && !(best && (good(*best) || spent > kMostSpent)); ++i) {
    go_further(near.front());
    near.erase(near.begin());
  }
  return *best;
}

}  // namespace

double unreachable_distance(const Problem& problem, const Options& options, const Vector3& asked) {
  validate(problem, options);
  const chain::Chain& chain = problem.model.chain;
  const Vector3 target = at_rope_height(problem, asked);
  const std::vector<Axis> axes = options.axes.empty() ? default_axes(chain) : options.axes;
  // from rest to rest in the horizon no axis gets further than the velocity limit allows
  const double time = options.horizon * static_cast<double>(problem.targets.size());
  const double stroke = std::min(options.limits.stroke, options.limits.velocity * time);
  Vector3 gap = target - problem.base.translation;
  bool turns = false;
  Vector3 moved = Vector3::Zero();  // along which axes the base goes
  for (Axis axis : axes) {
    if (axis == Axis::yaw) {
      turns = true;
      continue;
    }
    const int i = static_cast<int>(axis);
    moved[i] = 1.0;
    gap[i] = gap[i] > 0.0 ? std::max(0.0, gap[i] - stroke) : std::min(0.0, gap[i] + stroke);
  }
  double bound = std::max(0.0, gap.norm() - chain.length);
  // a planar chain stays in its plane
  const Vector3 normal = problem.base.rotation * chain.bending_axis;
  if (default_axes(chain).size() == 1 && !turns && normal.cwiseAbs().dot(moved) < 1e-9)
    bound = std::max(bound, std::abs(normal.dot(target - where_it_lies(problem))));
  return bound;
}

Plan plan(const Problem& problem, const Options& options) {
  validate(problem, options);
  const double begin = core::seconds_now();
  std::vector<dynamics::Model> drawn;
  std::vector<const dynamics::Model*> models{&problem.model};
  if (options.samples > 0) {
    for (const dynamics::Parameters& p : draw_parameters(problem.model.chain, problem.model.parameters,
                                                         problem.estimates, options.samples, options.seed + 2))
      drawn.push_back(dynamics::make_model(problem.model.chain, p));
    for (const dynamics::Model& model : drawn) models.push_back(&model);
  }

  Plan plan;
  std::vector<solve::Summary> summaries;
  plan.motion = empty_motion(problem, options);
  plan.reached = true;
  dynamics::InitialState state = problem.initial;
  state.time = 0.0;
  for (std::size_t t = 0; t < problem.targets.size(); ++t) {
    const bool last = t + 1 == problem.targets.size();
    std::optional<VectorX> terminal;
    if (options.terminal && last) {
      terminal = *options.terminal;
      for (const Piece& piece : plan.motion.pieces) *terminal -= piece.terminal;
    }
    const double start = plan.motion.end();
    const double bound = unreachable_distance(problem, options, problem.targets[t]);
    Found best;
    Motion motion;
    bool first = true;
    for (const double part : kHorizons) {
      if (!options.free_horizon && part != 1.0) continue;
      Motion trial = plan.motion;
      append_piece(trial, start, part * options.horizon);
      Found found = solve(problem, options, models, trial, state, problem.targets[t], terminal,
                          bound > options.tolerance, plan.starts, plan.iterations);
      if (first || better(found, best, options)) best = std::move(found), motion = std::move(trial);
      first = false;
      if (best.good && merit(best, options) <= options.tolerance) break;
    }
    if (!std::isfinite(best.hit.miss))
      throw WorkError("plan", "the rope's motion diverged for every start", "check the twin's parameters");
    set_unknowns(motion, best.unknowns);
    plan.motion = std::move(motion);
    plan.hits.push_back(best.hit);
    summaries.push_back(best.summary);
    if (!best.good || !(best.hit.miss <= options.tolerance)) {
      plan.reached = false;
      const std::string which = problem.targets.size() > 1 ? "target " + std::to_string(t + 1) + ": " : "";
      if (!plan.reason.empty()) plan.reason += "; ";
      if (bound > options.tolerance)
        plan.reason +=
            which + "it is at least " + millimeters(bound) + " beyond what rope length, stroke and axes allow";
      else if (!best.peaks.over.empty())
        plan.reason += which + "no motion found keeps the " + best.peaks.over + " limit";
      else if (best.clearance < 0.0)
        plan.reason += which + "no motion found stays clear of what must be kept out of";
      else
        plan.reason += which + "the nearest of all starts misses by " + millimeters(best.hit.miss) +
                       " with these axes, limits and horizon";
    }
    // the next stretch starts where this one leaves the rope
    if (!last) {
      const chain::States end = predict(problem, plan.motion, {plan.motion.end()});
      state.time = end.time.back(), state.theta = end.theta.back(), state.thetadot = end.thetadot.back();
    }
  }
  plan.summary = solve::together(summaries);
  plan.peaks = peaks(plan.motion, 0.0, plan.motion.end(), options.limits);
  plan.seconds = core::seconds_now() - begin;
  return plan;
}

chain::States predict(const Problem& problem, const Motion& motion, const std::vector<double>& times) {
  dynamics::InitialState initial = problem.initial;
  initial.time = 0.0;
  return dynamics::rollout(
      problem.model, [&](double time) { return base_at(motion, time); }, initial, times);
}

Vector3 random_target(const Problem& problem, const Options& options, std::uint64_t seed) {
  Problem asked = problem;
  asked.targets = {problem.base.translation};
  validate(asked, options);
  Motion motion = empty_motion(problem, options);
  append_piece(motion, 0.0, options.horizon);
  dynamics::InitialState initial = problem.initial;
  initial.time = 0.0;
  const Task task = make_task(problem, options, {&problem.model}, motion, initial, problem.base.translation,
                              problem.model.parameters.substeps);
  core::Random random(kTargetStream ^ (seed * 0x9e3779b97f4a7c15ull));
  for (int attempt = 0; attempt < 100; ++attempt) {
    const VectorX q = random_unknowns(task, random, random.uniform(0.2, 0.9));
    Rollout rollout;
    if (!roll_out(problem.model, task.motion, task.grid, q, task.initial, false, rollout)) continue;
    const int last = task.grid.nodes() - 1;
    const int node = problem.tabletop ? last : static_cast<int>(random.uniform(0.2, 1.0) * last);
    set_unknowns(motion, q);
    const auto motions =
        chain::link_motions(problem.model.chain, rollout.theta[node], base_from(motion, rollout.base[node]).pose);
    return motions.back() * (problem.model.chain.length * problem.model.chain.direction);
  }
  throw WorkError("random target", "no random motion stays finite", "check the twin's parameters");
}

}  // namespace chainsplat::planning
