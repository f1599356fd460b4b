// evaluate.cpp - a twin set in motion, and measured against a capture.
#include <algorithm>
#include <filesystem>
#include <system_error>

#include "chainsplat/comparison.h"
#include "chainsplat/gpu.h"
#include "chainsplat/identification.h"
#include "chainsplat/lpips.h"
#include "chainsplat/marker_files.h"
#include "chainsplat/motion_files.h"
#include "chainsplat/pipeline.h"
#include "chainsplat/rope.h"
#include "chainsplat/run_folder.h"
#include "chainsplat/shutter.h"

namespace chainsplat::pipeline {

namespace {

constexpr const char* kExampleRate = "give rows per second, for example 30";

// Marker files begin with what their markers are (formats.md 4.1), states with a head line. A pipe can be read only
// once: it gives states.
bool is_marker_file(const Path& file) {
  std::error_code ignored;
  return std::filesystem::is_regular_file(file, ignored) && core::read_file(file).starts_with("#");
}

// Where the rollout starts (formats.md 2.4, rollout).
dynamics::InitialState start_of(const Path& run, const RolloutOptions& options, const twin::Twin& twin,
                                const dynamics::Model& model, const trajectory::Trajectory& base) {
  const int angles = twin.chain.angles();
  dynamics::InitialState initial;
  initial.time = base.start();
  initial.thetadot = math::VectorX::Zero(angles);
  if (!options.initial.empty() && is_marker_file(options.initial)) {
    const identification::MarkerFile measured = identification::read_markers(options.initial);
    initial = identification::fit_initial(twin.chain, *twin.parameters,
                                          trajectory::fit(measured.base, options.initial.string()), measured.markers);
    if (initial.time < base.start() || initial.time >= base.end())
      throw InputError(options.initial.string(),
                       "begins at " + core::exact(initial.time) + " s, outside of the base motion",
                       "give marks and base motion of one recording");
  } else if (!options.initial.empty()) {
    const chain::States states = twin::read_states(options.initial, twin.chain);
    if (states.time.empty()) throw InputError(options.initial.string(), "has no rows", "give at least one");
    // the states of the twin's own motion keep their time
    if (options.base.empty() && states.time[0] >= base.start() && states.time[0] < base.end())
      initial.time = states.time[0];
    if (states.thetadot.empty())
      core::warn(options.initial.string() + ": no thetadot columns; the rope is assumed to start at rest");
    initial = state_at(model, base.pose(initial.time), initial.time, states.theta[0],
                       states.thetadot.empty() ? initial.thetadot : states.thetadot[0]);
  } else if (options.base.empty()) {
    if (!twin.initial)
      throw InputError(run.string() + "/twin.json", "has no initial state",
                       "run 'chainsplat identify' or give `initial`");
    initial = *twin.initial;
  } else {
    initial = rest_state(twin, model, base.pose(base.start()), base.start());
  }
  return initial;
}

// The twin set in motion by another capture's base, at the times of its first camera that the base covers.
chain::States rollout_on(const twin::Twin& twin, const Path& run, const capture::Capture& capture) {
  const dynamics::Model model = model_of(twin, run);
  std::vector<double> times;
  for (const double time : capture.times.front())
    if (time >= capture.base.start() && time <= capture.base.end()) times.push_back(time);
  if (times.empty())
    throw InputError(capture.folder.string(), "its base motion covers none of its frames", "correct base.tum");
  const double start = std::min(capture.base.start(), times.front());
  chain::States states =
      dynamics::rollout(model, capture.base, rest_state(twin, model, capture.base.pose(start), start), times);
  add_rolls(twin, capture.base, states);
  return states;
}

}  // namespace

void RolloutOptions::check() const { planning::check_rate(rate, 0.0, kExampleRate); }

RolloutResult rollout(const Path& run, const RolloutOptions& options, const core::Listener& listener) {
  const core::ListenerScope scope(listener);
  options.check();
  RolloutResult result{twin::load(run), {}, {}};
  const dynamics::Model model = model_of(result.twin, run);
  result.base = options.base.empty() ? own_base(run) : read_base(options.base);
  const trajectory::Trajectory& base = result.base;
  const dynamics::InitialState initial = start_of(run, options, result.twin, model, base);
  const std::vector<double> times = times_of(base, initial.time, options.rate);
  if (times.empty())
    throw InputError((options.base.empty() ? run : options.base).string(), "the base motion ends before the start",
                     "give a base motion that goes on after it");
  result.states = dynamics::rollout(model, base, initial, times);
  add_rolls(result.twin, base, result.states);
  twin::warn_beyond(result.twin.validity, twin::validity_of(result.twin.chain, base, result.states),
                    (options.base.empty() ? run : options.base).string());
  return result;
}

Evaluation evaluate(const Path& run, const Path& capture, const EvaluateOptions& options,
                    const core::Listener& listener) {
  const core::ListenerScope scope(listener);
  if (!options.picture.empty()) check_output_file(options.picture.string());
  const eval::LpipsTrunkPtr trunk = options.lpips.empty() ? nullptr : eval::open_lpips_trunk(options.lpips);
  twin::Twin twin = load_twin(run);
  check_drawable(twin, run);
  capture::LoadOptions load;
  load.first = options.frames.first, load.last = options.frames.last;
  load.pixels = capture::Pixels::recorded;
  load.depth = true;
  capture::Capture recorded = capture::load(capture, load);
  capture::apply(twin.corrections, recorded);
  const bool own = twin.provenance.capture_hash == capture::hash_text(recorded.hash);
  if (!own) {
    core::say("another capture than the twin's own: only the rollout is evaluated, from rest");
    twin.states = {};
    twin.rollout = rollout_on(twin, run, recorded);
  }
  silhouette::read_at_once(recorded, twin.chain, own ? twin.states : twin.rollout);
  const gpu::DevicePtr device = gpu::open_device({.selector = options.device});
  splat::Engine engine(*device);
  Evaluation found;
  if (own) found.recognized = eval::evaluate(engine, twin.gaussians, twin.chain, twin.states, recorded, trunk.get());
  if (!twin.rollout.time.empty())
    found.rollout = eval::evaluate(engine, twin.gaussians, twin.chain, twin.rollout, recorded, trunk.get());
  if (!options.picture.empty()) capture::write_png(options.picture, eval::comparison(engine, twin, recorded));
  return found;
}

}  // namespace chainsplat::pipeline
