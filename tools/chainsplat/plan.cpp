// plan.cpp - a base motion that makes the rope hit a target.
#include <cstdlib>
#include <iostream>
#include <memory>

#include "chainsplat/motion_files.h"
#include "chainsplat/planning.h"
#include "chainsplat/rope.h"
#include "chainsplat/run_folder.h"
#include "chainsplat/twin.h"
#include "cli.h"
#include "command_line.h"

namespace chainsplat::tools {

namespace {

struct PlanRequest {
  std::string run, out, axes, initial, state_from, terminal, hit, horizon = "3", window = "smooth";
  std::vector<std::string> targets, spheres, boxes;
  double rate = 100.0;
  bool force = false, mpc = false;
  std::string simulate, target_velocity;
  planning::LoopOptions loop;
  planning::Options options;
};

// The true rope, held as the twin's is.
dynamics::Model read_truth(const std::string& file, const twin::Twin& twin) {
  const twin::Twin truth = twin::load_chain(pipeline::input_path(file), twin.chain);
  if (!truth.parameters) throw InputError(file, "has no masses, stiffness and damping", "give an identified chain");
  return dynamics::make_model(truth.chain, *truth.parameters);
}

// Fields of the options that are texts on the command line.
void read_options(const Globals& globals, PlanRequest& request) {
  planning::Options& options = request.options;
  options.seed = globals.seed;
  if (!request.axes.empty()) options.axes = planning::parse_axes(request.axes);
  options.window = request.window == "paper" ? planning::Window::paper : planning::Window::smooth;
  if (request.hit == "tip") options.part = planning::Part::tip;
  if (request.hit == "last-link") options.part = planning::Part::last_link;
  if (request.hit == "rope") options.part = planning::Part::rope;
  constexpr double kLongestFree = 4.0;  // s, of a free horizon
  options.free_horizon = request.horizon == "free";
  options.horizon = options.free_horizon ? kLongestFree : numbers(request.horizon, "--horizon", 1)[0];
  if (!request.terminal.empty()) {
    const std::vector<double> values = numbers(request.terminal, "--terminal", 0);
    options.terminal = Eigen::Map<const math::VectorX>(values.data(), static_cast<Eigen::Index>(values.size()));
  }
  for (const std::string& text : request.spheres) {
    const auto v = numbers(text, "--keep-out-sphere", 4);
    options.spheres.push_back({{v[0], v[1], v[2]}, v[3]});
  }
  for (const std::string& text : request.boxes) {
    const auto v = numbers(text, "--keep-out-box", 6);
    options.boxes.push_back({{v[0], v[1], v[2]}, {v[3], v[4], v[5]}});
  }
  if (!request.target_velocity.empty()) {
    const auto v = numbers(request.target_velocity, "--target-velocity", 3);
    request.loop.target_velocity = {v[0], v[1], v[2]};
  }
}

// Requests that would take hours or no memory holds, and what does not go together.
void check(const PlanRequest& request) {
  constexpr double kLongest = 120.0, kMostReplans = 1000.0;  // s; a second
  const planning::Options& options = request.options;
  if (options.horizon > kLongest)
    throw InputError("--horizon",
                     core::exact(options.horizon) + " s are more than " + core::exact(kLongest) +
                         " s, and the motion is computed in steps of milliseconds, many times",
                     "give seconds, for example 3");
  if (request.loop.rate > kMostReplans)
    throw InputError("--mpc-rate",
                     core::exact(request.loop.rate) + " replans a second are more than " + core::exact(kMostReplans) +
                         ", and each is an optimization",
                     "give for example 10");
  planning::check_rate(request.rate, options.horizon * static_cast<double>(request.targets.size()),
                       "give rows a second, for example 100");
  if (request.simulate.empty() && (request.mpc || !request.target_velocity.empty()))
    throw InputError("--mpc", "feedback needs a rope to see", "give --simulate CHAIN.json as the true one");
  pipeline::check_output_folder(request.out, request.force, "name another folder or give --force to write into it");
}

math::Vector3 read_target(const std::string& text, const planning::Problem& problem, const planning::Options& options) {
  const std::string random = "random:";
  if (!text.starts_with(random)) {
    const auto v = numbers(text, "--target", 3);
    return {v[0], v[1], v[2]};
  }
  char* end = nullptr;
  const std::uint64_t seed = std::strtoull(text.c_str() + random.size(), &end, 10);
  if (*end != '\0' || end == text.c_str() + random.size())
    throw InputError("--target", "'" + text + "' has no seed", "give for example random:1");
  return planning::random_target(problem, options, seed);
}

planning::Problem make_problem(const PlanRequest& request, const pipeline::Rope& rope) {
  planning::Problem problem = pipeline::planning_problem(rope);
  char text[160];
  if (!request.initial.empty()) {
    const chain::States given = twin::read_states(pipeline::input_path(request.initial), rope.twin.chain);
    if (given.time.empty()) throw InputError(request.initial, "has no rows", "give at least one");
    problem.initial.theta = given.theta[0];
    if (!given.thetadot.empty()) problem.initial.thetadot = given.thetadot[0];
  } else if (!request.state_from.empty()) {
    const auto [folder, name] = split_camera(request.state_from);
    const pipeline::FirstSight seen = pipeline::start_as_seen(rope, folder, name, problem);
    std::snprintf(text, sizeof text, "the rope starts as %s sees it: overlap %.3f, outline within %.2f px",
                  seen.camera.c_str(), seen.iou, seen.residual);
    say(text);
  }
  for (const std::string& target : request.targets)
    problem.targets.push_back(read_target(target, problem, request.options));
  for (const math::Vector3& target : problem.targets) {
    const double bound = planning::unreachable_distance(problem, request.options, target);
    if (!(bound > request.options.tolerance)) continue;
    std::snprintf(
        text, sizeof text,
        "--target: at least %.1f mm beyond what rope length, stroke and axes allow; the nearest motion is planned",
        1e3 * bound);
    core::warn(text);
  }
  return problem;
}

// The plan played on the true rope, without feedback and, where it is asked for, with it.
std::vector<planning::Simulated> simulate(PlanRequest& request, const planning::Problem& problem,
                                          const planning::Plan& plan, const dynamics::Model& truth) {
  std::vector<planning::Simulated> out;
  const auto play = [&](const char* name, bool feedback) {
    request.loop.feedback = feedback;
    out.push_back({name, planning::closed_loop(problem, request.options, plan, truth, request.loop)});
  };
  play("without_feedback", false);
  if (request.mpc) play("with_feedback", true);
  return out;
}

// Returns the document of plan.json.
std::string write_files(const PlanRequest& request, const twin::Twin& twin, const planning::Problem& problem,
                        const planning::Plan& plan, const std::vector<planning::Simulated>& simulated) {
  const planning::Motion& played = request.mpc ? simulated.back().loop.motion : plan.motion;
  const Path out = request.out;
  core::make_folder(out);
  const std::vector<double> times = planning::row_times(plan.motion.end(), request.rate);
  const chain::States predicted = planning::predict(problem, played, times);
  core::write_file(out / "base.tum", planning::motion_tum(played, times));
  core::write_file(out / "base.csv", planning::motion_csv(played, times));
  core::write_file(out / "states.csv", twin::states_csv(predicted));
  const trajectory::Trajectory written = trajectory::fit(trajectory::read_tum(out / "base.tum"), request.out);
  twin::warn_beyond(twin.validity, twin::validity_of(problem.model.chain, written, predicted), request.out);
  core::write_file(out / "picture.svg", planning::picture_svg(problem, request.options, plan));
  std::string document = planning::plan_json(problem, request.options, plan, request.horizon, simulated);
  core::write_file(out / "plan.json", document);
  return document;
}

void print(const PlanRequest& request, const planning::Plan& plan, const std::vector<planning::Simulated>& simulated) {
  char text[256];
  const planning::Hit& worst = planning::worst_hit(plan);
  std::snprintf(
      text, sizeof text,
      "%s: miss %.2f mm at %.2f s, %.0f mm along the rope, peak %.2f m/s and %.1f m/s^2, planned in %.2f s: %s",
      plan.reached ? "reached" : "cannot be reached", 1e3 * worst.miss, worst.time, 1e3 * worst.arclength,
      plan.peaks.velocity, plan.peaks.acceleration, plan.seconds, request.out.c_str());
  say(text);
  if (!plan.reached && !solve::converged(plan.summary)) say("its last fit: " + solve::describe(plan.summary));
  for (const auto& [name, loop] : simulated) {
    std::snprintf(text, sizeof text, "%s: miss %.2f mm", name.c_str(), 1e3 * loop.hit.miss);
    say(text);
    if (!(loop.out_of_reach > request.options.tolerance)) continue;
    std::snprintf(text, sizeof text, "%s: the target moves at least %.1f mm out of reach", name.c_str(),
                  1e3 * loop.out_of_reach);
    say(text);
  }
}

void plan(const Globals& globals, PlanRequest& request) {
  read_options(globals, request);
  check(request);
  const pipeline::Rope rope = pipeline::load_rope(request.run);
  const planning::Problem problem = make_problem(request, rope);
  std::optional<dynamics::Model> truth;
  if (!request.simulate.empty()) truth = read_truth(request.simulate, rope.twin);
  const planning::Plan plan = planning::plan(problem, request.options);
  std::vector<planning::Simulated> simulated;
  if (truth) simulated = simulate(request, problem, plan, *truth);
  const std::string document = write_files(request, rope.twin, problem, plan, simulated);
  if (globals.json)
    std::cout << document << std::flush;
  else
    print(request, plan, simulated);
  if (!plan.reached)
    throw WorkError("--target", "cannot be reached: " + plan.reason,
                    "give other axes, limits or a longer horizon; the nearest motion is in " + request.out);
}

}  // namespace

void add_planning_commands(Command app, const Globals& globals, Job& job) {
  Command planner = app.add_command("plan", "Find a base motion that makes the rope hit a target");
  auto request = std::make_shared<PlanRequest>();
  planning::Limits& limits = request->options.limits;
  planner.add_option("RUN", request->run, "Run folder of an identified twin").required();
  planner
      .add_option("--target", request->targets,
                  "Point to hit, m, world: in free space at any time, on a table at the end, at rest.\n"
                  "Several are hit one after the other. random:SEED: a point that a random motion passes")
      .required()
      .type_name("X,Y,Z");
  planner
      .add_option(
          "--hit", request->hit,
          "With what: tip, the nearest point of the last link or of the whole rope (default: tip, on a table rope)")
      .one_of({"tip", "last-link", "rope"});
  planner.add_option("-o,--output", request->out, "Folder for base.tum, base.csv, states.csv, plan.json, picture.svg")
      .required()
      .type_name("PLAN");
  planner.add_option("--axes", request->axes, "What moves (default: x, for a chain with two bending axes x,y)")
      .type_name("x,y,z,yaw");
  planner
      .add_option("--horizon", request->horizon, "Seconds for each target (default 3), or free: the shortest that does")
      .type_name("S|free");
  planner.add_option("--initial", request->initial, "Start from its first row (default: at rest)")
      .type_name("STATES.csv");
  planner
      .add_option("--state-from", request->state_from,
                  "Start from what one camera shows in its first frame, with the base where it is then, at rest")
      .type_name("CAPTURE:NAME")
      .excludes("--initial");
  planner
      .add_option("--terminal", request->terminal,
                  "Where the base ends, from its start, one number an axis (default: free)")
      .type_name("OFFSETS");
  planner.add_option("--window", request->window, "smooth: no acceleration at the ends; paper: s^2(1-s)^2")
      .one_of({"smooth", "paper"});
  planner.add_option("--velocity", limits.velocity, "Limit of the base, m/s (default 1.5)");
  planner.add_option("--acceleration", limits.acceleration, "Limit of the base, m/s^2 (default 10)");
  planner.add_option("--jerk", limits.jerk, "Limit of the base, m/s^3 (default 200)");
  planner.add_option("--stroke", limits.stroke, "Farthest from the start along an axis, m (default 0.6)");
  planner.add_option("--yaw-velocity", limits.yaw_velocity, "Limit, rad/s (default 3.1)");
  planner.add_option("--yaw-acceleration", limits.yaw_acceleration, "Limit, rad/s^2 (default 20)");
  planner.add_option("--yaw-jerk", limits.yaw_jerk, "Limit, rad/s^3 (default 400)");
  planner.add_option("--turn", limits.turn, "Farthest yaw from the start, rad (default 1.6)");
  planner.add_option("--keep-out-sphere", request->spheres, "Rope and gripper stay out of it").type_name("X,Y,Z,R");
  planner.add_option("--keep-out-box", request->boxes, "Rope and gripper stay out of it").type_name("X,Y,Z,X,Y,Z");
  planner.add_option("--gripper-radius", request->options.gripper_radius,
                     "Of a sphere about the base, m (default 0.04)");
  planner.add_option("--tolerance", request->options.tolerance, "A smaller miss counts as reached, m (default 0.001)");
  planner.add_option("--starts", request->options.starts, "Random motions to begin from (default 24)")
      .in_range(0, 100000);
  planner
      .add_option("--samples", request->options.samples,
                  "Also plan for N parameter sets drawn from the identification's covariance")
      .in_range(0, 1000)
      .type_name("N");
  planner.add_flag("--worst-case", request->options.worst_case, "Minimize the samples' worst miss, not the mean");
  planner.add_option("--simulate", request->simulate, "Also play the plan on this true chain (a twin.json's 'chain')")
      .type_name("CHAIN.json");
  planner.add_flag("--mpc", request->mpc,
                   "With --simulate: plan the rest anew from the state that is seen; base.* is\n"
                   "then the motion as corrected");
  planner.add_option("--mpc-rate", request->loop.rate, "Replans a second (default 10)").type_name("HZ");
  planner
      .add_option("--target-velocity", request->target_velocity, "With --mpc: the target moves from the start on, m/s")
      .type_name("VX,VY,VZ");
  planner.add_option("--rate", request->rate, "Rows a second of the files (default 100)").type_name("HZ");
  planner.add_flag("--force", request->force, "Write into a folder that is not empty");
  planner.callback([&globals, &job, request] { job = [&globals, request] { plan(globals, *request); }; });
}

}  // namespace chainsplat::tools
