// Model predictive control: the motion's rest is planned anew at a fixed rate, from the state that is seen.
#include <time.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>

#include "parameter_correction.h"
#include "search.h"

namespace chainsplat::planning {
namespace {

constexpr double kTruthStep = 1.0 / 240.0;  // s, between states of the true chain
constexpr double kReplanSharpness = 3e5;    // m^-2
constexpr double kReplanSmoothness = 1e-8;
// Two steps: the motion so far is the start, and the next replan goes on. The damping is a part of the curvature's
// trace, which limits may dominate; where the rope sticks or a limit is near, full steps fail and much shorter ones do.
// A target that has moved by centimeters asks for a change of that size; where the curvature is nearly singular full
// steps are of meters.
constexpr Effort kReplanEffort{
    .steps = 2, .evaluations = 9, .damping = 1e-7, .more_damping = 50.0, .longest = 0.1, .hopeful = false};
// Where that leads to no hit the rest may need another motion altogether: each replan tries one more, the best of a
// few.
constexpr double kStuck = 0.003;        // m, a foretold miss
constexpr double kProgress = 0.8;       // of the miss that the replan before foretold: less progress is none
constexpr int kOthers = 6;              // motions tried
constexpr double kLeastOther = 0.4;     // s before the hit
constexpr double kClearlyBetter = 0.5;  // of the miss, for which the motion is changed altogether
constexpr double kOtherSharpness = 1e4, kOtherSmoothness = 1e-7;
constexpr Effort kOtherEffort{.steps = 4, .evaluations = 6, .longest = 0.3};
constexpr double kShortest = 0.15;    // s before the hit, after which nothing is changed any more
constexpr double kLimitStep = 0.002;  // s, between tests of the limits
constexpr int kLimitParts = 250;      // of a correction at least: a short one has a fast jerk
constexpr double kLimitPart = 0.995;  // of the limits: between the tests no more than 0.2 % is added
constexpr double kLeastPiece = 0.35;  // s, of a correction
constexpr double kPieceMargin = 1.6;  // its length over the time to the hit, in free space
constexpr int kReplanNodes = 60;      // of its rollout, where the substeps allow
constexpr int kFitIterations = 20;
constexpr double kFitConverged = 1e-9;  // rad
constexpr double kFitStiffness = 1e-5;  // m/rad: angles that the points leave open stay as they are
constexpr int kSeenPoints = 33;         // of the rope's centerline

// Distance of `target` to a polyline.
double distance_to(const MatrixX& points, const Vector3& target, Vector3& nearest) {
  double least = std::numeric_limits<double>::infinity();
  for (Eigen::Index i = 0; i < points.cols(); ++i) {
    const Vector3 a = points.col(i), d = points.col(std::min(i + 1, points.cols() - 1)) - a;
    const double length = d.squaredNorm();
    const Vector3 p = a + (length > 0.0 ? std::clamp((target - a).dot(d) / length, 0.0, 1.0) : 0.0) * d;
    if (const double distance = (p - target).norm(); distance < least) least = distance, nearest = p;
  }
  return least;
}

// World velocities of the centerline at `arclengths`.
MatrixX centerline_velocity(const chain::Chain& chain, const VectorX& theta, const VectorX& thetadot,
                            const trajectory::BaseMotion& base, const std::vector<double>& arclengths) {
  const auto motions = chain::link_motions(chain, theta, base.pose);
  const MatrixX axes = chain::world_axes(chain, theta, base.pose);
  const Vector3 spin = base.pose.rotation * base.velocity.head<3>();
  const Vector3 speed = base.pose.rotation * base.velocity.tail<3>();
  MatrixX out(3, arclengths.size());
  for (std::size_t i = 0; i < arclengths.size(); ++i) {
    const int link = chain::link_at(chain, arclengths[i]);
    const Vector3 point = motions[link] * (arclengths[i] * chain.direction);
    out.col(static_cast<Eigen::Index>(i)) =
        speed + spin.cross(point - base.pose.translation) + chain::point_jacobian(chain, axes, link, point) * thetadot;
  }
  return out;
}

}  // namespace

StateFit fit_state(const chain::Chain& chain, const trajectory::BaseMotion& base, const std::vector<double>& arclengths,
                   const MatrixX& points, const MatrixX& velocities, const VectorX& start) {
  const int n = chain.angles();
  const Eigen::Index rows = 3 * static_cast<Eigen::Index>(arclengths.size());
  MatrixX jacobian(rows, n);
  VectorX residual(rows);
  const auto place = [&](const VectorX& theta) {
    const auto motions = chain::link_motions(chain, theta, base.pose);
    const MatrixX axes = chain::world_axes(chain, theta, base.pose);
    for (std::size_t i = 0; i < arclengths.size(); ++i) {
      const int link = chain::link_at(chain, arclengths[i]);
      const Vector3 point = motions[link] * (arclengths[i] * chain.direction);
      const auto row = 3 * static_cast<Eigen::Index>(i);
      jacobian.middleRows<3>(row) = chain::point_jacobian(chain, axes, link, point);
      residual.segment<3>(row) = points.col(static_cast<Eigen::Index>(i)) - point;
    }
  };
  const auto evaluate = [&](const VectorX& theta, solve::NormalEquations* equations) {
    place(theta);
    *equations = {jacobian.transpose() * jacobian, -(jacobian.transpose() * residual)};
    return 0.5 * residual.squaredNorm();
  };
  const solve::Damping ridge{.rule = solve::Damping::Rule::fixed,
                             .first = kFitStiffness * kFitStiffness * static_cast<double>(arclengths.size())};
  StateFit out;
  out.state.theta = start, out.state.thetadot = VectorX::Zero(n);
  out.summary = solve::least_squares(out.state.theta, evaluate,
                                     {.steps = kFitIterations,
                                      .checked = false,
                                      .step_tolerance = kFitConverged,
                                      .euclidean = true,
                                      .damping = ridge});
  if (velocities.cols() == points.cols()) {
    place(out.state.theta);
    const MatrixX rest = centerline_velocity(chain, out.state.theta, VectorX::Zero(n), base, arclengths);
    const MatrixX relative = velocities - rest;
    const Eigen::Map<const VectorX> right(relative.data(), relative.size());
    const solve::NormalEquations equations{jacobian.transpose() * jacobian, -(jacobian.transpose() * right)};
    solve::damped_step(equations, ridge, ridge.first, out.state.thetadot);
  }
  return out;
}

namespace {

// Time that this thread had a core, s: what a replan costs does not depend on what else the machine does.
double core_time() {
  timespec time{};
  ::clock_gettime(CLOCK_THREAD_CPUTIME_ID, &time);
  return static_cast<double>(time.tv_sec) + 1e-9 * static_cast<double>(time.tv_nsec);
}

// The largest part <= `part` of the change `d` for which |f + part d| <= most, or stays what it was where that is more.
template <class Fixed, class Change>
double part_within(const Fixed& f, const Change& d, double most, double part) {
  const double room = std::max(0.0, most * most - f.squaredNorm());
  const double change = d.squaredNorm(), along = f.dot(d);
  // |f + part d|^2 - |f|^2 = part (2 along + part change) <= room
  if (part * (2.0 * along + part * change) <= room) return part;
  return (std::sqrt(along * along + change * room) - along) / change;
}

// The executed motion, sampled over time, so that a replan need not sum up all corrections before it.
class Samples {
 public:
  explicit Samples(const Motion& motion) {
    const int count = static_cast<int>(std::ceil(motion.end() / kLimitStep)) + 1;
    for (int i = 0; i < count; ++i) watch(motion, i * kLimitStep);
    for (const Piece& piece : motion.pieces)
      for (double time : jumps(piece)) watch(motion, time);
  }
  // Makes the last piece of `motion` so much smaller that it keeps the limits together with the others, and takes it
  // in.
  void take_within(Motion& motion, const Limits& limits) {
    Piece& last = motion.pieces.back();
    Motion others = motion, alone = motion;
    others.pieces.pop_back();
    alone.pieces = {last};
    alone.origin.translation.setZero();
    for (double time : jumps(last)) watch(others, time);
    if (const double step = last.duration / kLimitParts; step < kLimitStep)
      for (int i = 1; i < kLimitParts; ++i) watch(others, last.start + i * step);
    std::vector<Coordinates> change;
    double part = 1.0;
    const bool smooth = motion.window == Window::smooth;
    const double most[] = {limits.stroke, limits.velocity, limits.acceleration, limits.jerk};
    const double yaw_most[] = {limits.turn, limits.yaw_velocity, limits.yaw_acceleration, limits.yaw_jerk};
    for (std::size_t i = 0; i < time_.size(); ++i) {
      if (time_[i] < last.start) continue;
      const Coordinates d = coordinates(alone, time_[i]);
      Coordinates c = at_[i];
      c.col(0).head<3>() -= motion.origin.translation;
      for (int order = 0; order <= (smooth ? 3 : 2); ++order) {
        for (int row = 0; order == 0 && row < 3; ++row)  // the stroke is one along each axis
          part = part_within(c.block<1, 1>(row, 0).col(0), d.block<1, 1>(row, 0).col(0), kLimitPart * most[0], part);
        if (order > 0)
          part = part_within(c.col(order).head<3>(), d.col(order).head<3>(), kLimitPart * most[order], part);
        part = part_within(c.block<1, 1>(3, order).col(0), d.block<1, 1>(3, order).col(0), kLimitPart * yaw_most[order],
                           part);
      }
      change.push_back(d);
    }
    last.weights *= part, last.terminal *= part;
    for (std::size_t i = 0, k = 0; i < time_.size(); ++i)
      if (time_[i] >= last.start) at_[i] += part * change[k++];
  }

 private:
  // The jerk jumps at both ends of a piece; coordinates() gives the value after a jump.
  static std::vector<double> jumps(const Piece& piece) {
    constexpr double kBefore = 1e-9;  // s
    const double end = piece.start + piece.duration;
    return {piece.start - kBefore, piece.start, end - kBefore, end};
  }
  void watch(const Motion& motion, double time) {
    time_.push_back(time);
    at_.push_back(coordinates(motion, time));
  }

  std::vector<double> time_;
  std::vector<Coordinates> at_;
};

void check(const Problem& problem, const Plan& plan, const dynamics::Model& truth, const LoopOptions& loop) {
  if (plan.hits.size() != 1) throw InputError("`targets`", "feedback is for one of them", "give one target");
  if (!(loop.rate > 0.0) || !std::isfinite(loop.rate))
    throw InputError("`loop.rate`", "must be above 0", "give replans a second, for example 10");
  if (!loop.target_velocity.allFinite())
    throw InputError("`loop.target_velocity`", "is not finite", "give VX,VY,VZ in m/s");
  if (truth.chain.direction != problem.model.chain.direction)
    throw InputError("`truth`", "the chain leaves the gripper in another direction", "give one of the same grasp");
}

// The play of a plan on the true rope, as far as it has come.
struct Play {
  const Problem& problem;
  const Options& options;
  const dynamics::Model& truth;
  const LoopOptions& loop;
  const chain::Chain& chain = problem.model.chain;                         // the twin's
  std::vector<double> seen = chain::equal_arclengths(chain, kSeenPoints);  // arc lengths that a camera follows
  std::vector<double> true_seen = seen;                                    // the same parts of the true rope
  LoopResult out = {};
  dynamics::InitialState state = {};      // of the true rope
  dynamics::InitialState last_seen = {};  // of the twin
  Samples samples;                        // of the base's motion
  double end;                             // s, of the plan
  double hit_time;                        // s, as planned last
  core::Random random{options.seed + 3};
  double foretold = std::numeric_limits<double>::infinity();  // m, miss by the last replan
  bool elsewhere = false;                                     // the next replan looks elsewhere, too
  ParameterCorrection corrected = start_correction(problem.model);
  std::vector<solve::Summary> summaries = {};

  trajectory::BaseMotion base(double time) const { return base_at(out.motion, time); }
  Vector3 target_at(double time) const {
    return at_rope_height(problem, problem.targets.front()) + time * loop.target_velocity;
  }
};

Play begin(const Problem& problem, const Options& options, const Plan& plan, const dynamics::Model& truth,
           const LoopOptions& loop) {
  Play play{.problem = problem,
            .options = options,
            .truth = truth,
            .loop = loop,
            .samples = Samples(plan.motion),
            .end = plan.motion.end(),
            .hit_time = plan.hits.front().time};
  for (double& s : play.true_seen) s *= truth.chain.length / play.chain.length;
  play.out.motion = plan.motion;
  play.last_seen = problem.initial;
  play.last_seen.time = 0.0;

  dynamics::InitialState& state = play.state;
  state.time = 0.0;
  if (problem.tabletop) {
    const MatrixX shape =
        chain::centerline(play.chain, chain::link_motions(play.chain, problem.initial.theta, problem.base), play.seen);
    state = fit_state(truth.chain, dynamics::at_rest(problem.base), play.true_seen, shape, {},
                      VectorX::Zero(truth.chain.angles()))
                .state;
  } else {
    state.theta = dynamics::static_equilibrium(truth, problem.base).theta;
  }
  state.thetadot = VectorX::Zero(truth.chain.angles());
  chain::States& states = play.out.states;
  states.time.push_back(0.0), states.theta.push_back(state.theta), states.thetadot.push_back(state.thetadot);
  return play;
}

// The twin's state from the points of the true rope that a camera could follow.
dynamics::InitialState observe(const Play& play, double now) {
  const chain::Chain& rope = play.truth.chain;
  const trajectory::BaseMotion here = play.base(now);
  const MatrixX points =
      chain::centerline(rope, chain::link_motions(rope, play.state.theta, here.pose), play.true_seen);
  const MatrixX speeds = centerline_velocity(rope, play.state.theta, play.state.thetadot, here, play.true_seen);
  dynamics::InitialState found = fit_state(play.chain, here, play.seen, points, speeds, play.last_seen.theta).state;
  found.time = now;
  found.internal_state = dynamics::internal_state_in_motion(play.problem.model, found.theta, found.thetadot);
  return found;
}

// The rest of the motion with one more piece, of `length` s, that is to be found.
Task task_of_piece(const Play& play, const dynamics::InitialState& estimate, double now, double length) {
  Motion motion = play.out.motion;
  append_piece(motion, now, length);
  const int full = play.problem.model.parameters.substeps;
  const int substeps = std::clamp(static_cast<int>(kReplanNodes / (30.0 * length)), full > 4 ? 2 : 1, full);
  Task task = make_task(play.problem, play.options, {&play.corrected.model}, motion, estimate,
                        play.problem.targets.front(), substeps);
  task.exact = false;
  task.target = play.target_at(now);
  task.target_velocity = play.loop.target_velocity;
  task.target_time = now;
  if (play.options.terminal)
    for (std::size_t a = 0; a < motion.axes.size(); ++a) task.held[a * kPerAxis + kBasisCount] = true;
  return task;
}

struct Correction {
  Motion motion;
  Samples samples;
  double miss, time;
  solve::Summary summary;
};

// From these unknowns of the piece, by so much effort.
Correction correction_from(const Play& play, const Task& task, const dynamics::InitialState& estimate, VectorX unknowns,
                           const Effort& effort) {
  Correction c{task.motion, play.samples, std::numeric_limits<double>::infinity(), play.hit_time, {}};
  if (effort.steps > 0) c.summary = minimize(task, unknowns, {kReplanSharpness, kReplanSmoothness}, effort);
  set_unknowns(c.motion, unknowns);
  // what asks too much of the arm is taken in part
  c.samples.take_within(c.motion, play.options.limits);
  Rollout rollout;
  if (roll_out(play.corrected.model, task.motion, task.grid, unknowns_of(c.motion), estimate, false, rollout)) {
    const Hit hit = measure(task, play.corrected.model, rollout);
    c.miss = hit.miss, c.time = hit.time;
  }
  return c;
}

// From the best of other starts; none where all of them run away. `k`: of the replan.
std::optional<Correction> correction_elsewhere(Play& play, Task task, const dynamics::InitialState& estimate, int k) {
  if (task.part == Part::rope && play.problem.tabletop && k % 2 == 0) task.first_link = play.chain.links() - 1;
  std::vector<VectorX> starts = carried(task);
  while (starts.size() < kOthers)
    starts.push_back(random_unknowns(task, play.random, play.random.uniform(kLeastLoad, kMostLoad)));
  const Sharpness soft{kOtherSharpness, kOtherSmoothness};
  double least = std::numeric_limits<double>::infinity();
  VectorX best;
  for (const VectorX& start : starts)
    if (const Evaluation e = evaluate(task, start, soft, false); e.good && e.value < least)
      least = e.value, best = start;
  if (best.size() == 0) return std::nullopt;
  const solve::Summary summary = minimize(task, best, soft, kOtherEffort);
  Correction c = correction_from(play, task, estimate, std::move(best), {.steps = 0});
  c.summary = summary;
  return c;
}

// Looks at the rope, corrects the model by what it did since the last look, and plans the rest anew. `left`: s, to the
// hit. `k`: of the replan.
void replan(Play& play, double now, double left, int k) {
  const double begun = core_time();
  const dynamics::InitialState estimate = observe(play, now);
  correct(
      play.corrected, [&](double time) { return play.base(time); }, play.last_seen, estimate, play.seen);
  play.last_seen = estimate;
  const double rest = play.end - now;
  const double length = play.problem.tabletop ? rest : std::min(rest, std::max(kLeastPiece, kPieceMargin * left));
  const Task task = task_of_piece(play, estimate, now, length);
  const auto size = static_cast<Eigen::Index>(task.motion.axes.size()) * kPerAxis;
  Correction best = correction_from(play, task, estimate, VectorX::Zero(size), kReplanEffort);
  if (play.elsewhere)
    if (auto other = correction_elsewhere(play, task, estimate, k); other && other->miss < kClearlyBetter * best.miss)
      best = std::move(*other);
  play.out.motion = std::move(best.motion);
  play.samples = std::move(best.samples);
  play.hit_time = best.time;
  play.summaries.push_back(best.summary);
  // the next one looks elsewhere where this one, with all its steps, did not help
  play.elsewhere = best.miss > kStuck && best.miss > kProgress * play.foretold && left > kLeastOther;
  play.foretold = best.miss;
  const double seconds = core_time() - begun;
  LoopResult& out = play.out;
  ++out.replans;
  out.longest_replan = std::max(out.longest_replan, seconds);
  out.mean_replan += (seconds - out.mean_replan) / out.replans;
}

// The true rope moves on.
void advance(Play& play, double now, double next) {
  std::vector<double> times;
  const int steps = std::max(1, static_cast<int>(std::ceil((next - now) / kTruthStep - 1e-9)));
  for (int i = 1; i <= steps; ++i) times.push_back(i == steps ? next : now + (next - now) * i / steps);
  dynamics::InitialState& state = play.state;
  state.time = now;
  const chain::States states = dynamics::rollout(
      play.truth, [&](double time) { return play.base(time); }, state, times);
  for (std::size_t i = 0; i < states.time.size(); ++i) {
    play.out.states.time.push_back(states.time[i]);
    play.out.states.theta.push_back(states.theta[i]);
    play.out.states.thetadot.push_back(states.thetadot[i]);
  }
  state.theta = states.theta.back(), state.thetadot = states.thetadot.back();
  if (!states.internal_state.empty()) state.internal_state = states.internal_state.back();
}

// What the true rope came to: its nearest point, of the same part that counts for the twin.
Hit hit_of(const Play& play) {
  constexpr int kCounted = 65, kBetween = 4;  // points of the rope; parts of a step
  const chain::Chain& rope = play.truth.chain;
  const bool tabletop = play.problem.tabletop;
  const Part part = part_of(play.options, tabletop);
  const double first = part == Part::rope        ? 0.0
                       : part == Part::last_link ? play.chain.link_start(play.chain.links() - 1) / play.chain.length
                                                 : 1.0;
  std::vector<double> counts;
  for (int i = part == Part::tip ? kCounted - 1 : 0; i < kCounted; ++i)
    counts.push_back(rope.length * std::min(1.0, first + (1.0 - first) * i / (kCounted - 1)));
  Hit hit;
  hit.miss = std::numeric_limits<double>::infinity();
  const chain::States& states = play.out.states;
  const std::size_t count = states.time.size();
  for (std::size_t k = tabletop ? count - 1 : 0; k < count; ++k)
    for (int i = 0; i < (k + 1 < count ? kBetween : 1); ++i) {
      const double time =
          i == 0 ? states.time[k] : states.time[k] + (states.time[k + 1] - states.time[k]) * i / double(kBetween);
      const VectorX theta = i == 0 ? states.theta[k] : chain::interpolate(states, time);
      const MatrixX points = chain::centerline(rope, chain::link_motions(rope, theta, play.base(time).pose), counts);
      Vector3 nearest = Vector3::Zero();
      const double miss = distance_to(points, play.target_at(time), nearest);
      if (miss < hit.miss) hit.miss = miss, hit.time = time, hit.point = nearest;
    }
  hit.mean_miss = hit.worst_miss = hit.miss;
  return hit;
}

}  // namespace

LoopResult closed_loop(const Problem& problem, const Options& options, const Plan& plan, const dynamics::Model& truth,
                       const LoopOptions& loop) {
  check(problem, plan, truth, loop);
  Play play = begin(problem, options, plan, truth, loop);
  const double end = play.end;
  const int intervals = std::max(1, static_cast<int>(std::ceil(end * loop.rate - 1e-9)));
  for (int k = 0; k < intervals; ++k) {
    const double now = k / loop.rate, left = (problem.tabletop ? end : play.hit_time) - now;
    if (loop.feedback && k == 0) play.last_seen = observe(play, now);
    if (loop.feedback && k > 0 && left > kShortest) replan(play, now, left, k);
    advance(play, now, std::min(end, (k + 1) / loop.rate));
  }
  LoopResult& out = play.out;
  out.hit = hit_of(play);
  out.foretold = out.replans > 0 ? play.foretold : plan.hits.front().miss;
  out.out_of_reach = std::numeric_limits<double>::infinity();
  for (double share = problem.tabletop ? 1.0 : 0.0; share <= 1.0; share += 0.01)
    out.out_of_reach = std::min(out.out_of_reach, unreachable_distance(problem, options, play.target_at(share * end)));
  out.peaks = peaks(out.motion, 0.0, end, options.limits);
  out.summary = solve::together(play.summaries);
  return std::move(out);
}

}  // namespace chainsplat::planning
