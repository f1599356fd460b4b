// identify.cpp - a twin's dynamics from its recognized states, from several runs' or from marker trajectories.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <nlohmann/json.hpp>

#include "chainsplat/marker_files.h"
#include "chainsplat/rope.h"
#include "chainsplat/run_folder.h"
#include "chainsplat/solve_json.h"
#include "pipeline/stages.h"

namespace chainsplat::pipeline {

namespace fs = std::filesystem;

Stopwatch::~Stopwatch() {
  const double seconds = core::seconds_now() - start_;
  twin_.provenance.seconds[stage_] += seconds;
  char text[64];
  std::snprintf(text, sizeof text, ": %.1f s", seconds);
  core::say_more(stage_ + text);
}

identification::Options identification_options(const twin::Twin& twin, bool paper, std::uint64_t seed) {
  identification::Options options;
  options.tabletop = twin.tabletop;
  options.gravity = twin.gravity;
  if (twin.table_normal) options.table_normal = *twin.table_normal;
  options.mass = twin.provenance.mass;
  if (const std::optional<capture::Payload>& payload = twin.provenance.payload) {
    if (!options.mass)
      throw InputError("tip_mass", "says nothing beside a rope of unknown mass", "give the rope's mass, too");
    *options.mass += payload->mass;
    options.tip_mass = payload->mass, options.tip_mass_deviation = payload->sigma;
    options.tip_length = payload->length;
  }
  options.paper = paper;
  if (paper) {
    options.fit_stiffness = false;
    options.per_joint = true;
    options.integrator = dynamics::Integrator::implicit_velocity_euler;
    options.substeps = 1;
  }
  options.seed = seed;
  return options;
}

void adopt(twin::Twin& twin, const trajectory::Trajectory& base, identification::Result found) {
  twin.validity = twin::validity_of(twin.chain, base, found.rollout);
  twin.parameters = std::move(found.parameters);
  twin.initial = std::move(found.initial);
  twin.estimates = std::move(found.estimates);
  twin.rollout = std::move(found.rollout);
  if (!twin.states.roll.empty() && twin.parameters->table_normal && twin.chain.angles() + 1 == twin.chain.links()) {
    identification::RollingFit fit = identification::fit_rolling(model_of(twin, {}), base, twin.states);
    tell_fit("rolling", fit.summary);
    twin.rolling = std::move(fit.rolling);
  }
  add_rolls(twin, base, twin.rollout);
  judge_motion(twin, base);
}

void tell_fit(const std::string& stage, const solve::Summary& summary) {
  core::record(nlohmann::ordered_json{{"stage", stage}, {"solver", summary}}.dump());
  core::say_more(stage + ": " + solve::describe(summary));
}

void identify_states(twin::Twin& twin, const trajectory::Trajectory& base, bool paper, std::uint64_t seed) {
  const Stopwatch watch(twin, "identify");
  adopt(twin, base, identification::identify(twin.chain, base, twin.states, identification_options(twin, paper, seed)));
  tell_fit("identify", *twin.estimates.solver);
}

void roll_out(twin::Twin& twin, const trajectory::Trajectory& base, const Path& run) {
  const Stopwatch watch(twin, "rollout");
  if (!twin.initial) throw InputError((run / "twin.json").string(), "has no initial state", "add identify to `stages`");
  twin.rollout = dynamics::rollout(model_of(twin, run), base, *twin.initial, twin.states.time);
  add_rolls(twin, base, twin.rollout);
}

namespace {

// A recording that parameters of its own follow far better is of another rope than the rest, unless both follow it well
// enough to be of use: recordings of one foam noodle, which creeps and softens over an hour, differ by 3.6 times and
// 1.8 % of its length.
void check_same_rope(const chain::Chain& chain, const std::vector<identification::Result>& found,
                     const std::vector<Path>& names) {
  constexpr double kOther = 3.0, kUseful = 0.02;  // kUseful: of the length
  for (std::size_t i = 0; i < found.size(); ++i)
    if (found[i].node_rms > kOther * found[i].alone_rms && found[i].node_rms > kUseful * chain.length) {
      char text[200];
      std::snprintf(text, sizeof text,
                    "is of another rope than the rest: one set of parameters leaves %.1f mm, its own %.1f mm",
                    1e3 * found[i].node_rms, 1e3 * found[i].alone_rms);
      throw InputError(names[i].string(), text, "identify it alone");
    }
}

void say_fit(const std::vector<identification::Result>& found, const std::vector<Path>& names) {
  for (std::size_t i = 0; i < found.size(); ++i) {
    char text[100];
    const int length = std::snprintf(text, sizeof text, ": rollout within %.2f mm RMS", 1e3 * found[i].node_rms);
    if (found.size() > 1)
      std::snprintf(text + length, sizeof text - length, " (%.2f with parameters of its own)",
                    1e3 * found[i].alone_rms);
    core::say(names[i].string() + text);
  }
}

// Throws InputError where two twins cannot be of one rope.
void check_same_chain(const twin::Twin& one, const Path& first, const twin::Twin& other, const Path& run) {
  const auto refuse = [&](const std::string& what) {
    throw InputError(run.string(), what + " than that of " + first.string(), "identify ropes apart");
  };
  const auto number = [](double value) {
    char text[32];
    std::snprintf(text, sizeof text, "%.4g", value);
    return std::string(text);
  };
  constexpr double kSame = 1e-6;
  const chain::Chain &a = one.chain, &b = other.chain;
  if (std::abs(a.length - b.length) > kSame * a.length)
    refuse("is of another rope: its length is " + number(b.length) + " m, another");
  if (a.joint_arclength.size() != b.joint_arclength.size() || a.angles() != b.angles())
    refuse("has " + std::to_string(b.joint_arclength.size()) + " joints with " + std::to_string(b.angles()) +
           " angles, others");
  for (int k = 0; k < a.angles(); ++k)
    if (!a.axes[k].isApprox(b.axes[k], kSame)) refuse("bends about other axes");
  if (!a.direction.isApprox(b.direction, kSame)) refuse("is grasped in another direction");
  if (one.tabletop != other.tabletop) refuse(other.tabletop ? "lies on a table, otherwise" : "hangs free, otherwise");
  if (one.tabletop && one.table_normal && other.table_normal && !one.table_normal->isApprox(*other.table_normal, 1e-3))
    refuse("lies on a table with another normal");
  if (!one.gravity.isApprox(other.gravity, 1e-3)) refuse("is under another gravity");
  const std::optional<double>&mass = one.provenance.mass, &other_mass = other.provenance.mass;
  if (mass && other_mass && *mass != *other_mass)
    refuse("is of another rope: its mass is " + core::exact(*other_mass) + " kg, another");
}

std::vector<twin::Twin> load_all(const std::vector<Path>& runs) {
  std::vector<twin::Twin> twins;
  for (std::size_t i = 0; i < runs.size(); ++i) {
    for (std::size_t k = 0; k < i; ++k) {
      std::error_code ignored;
      if (fs::equivalent(runs[i], runs[k], ignored))
        throw InputError(runs[i].string(), "is named twice", "name it once");
    }
    twins.push_back(load_twin(runs[i]));
  }
  return twins;
}

// One set of parameters for all.
void identify_several(std::vector<twin::Twin>& twins, const std::vector<Path>& runs, std::uint64_t seed) {
  std::vector<identification::Recording> recordings;
  identification::Options options = identification_options(twins[0], false, seed);
  for (std::size_t i = 0; i < twins.size(); ++i) {
    twin::Twin& twin = twins[i];
    if (i > 0) check_same_chain(twins[0], runs[0], twin, runs[i]);
    if (!options.mass && twin.provenance.mass) {  // what one capture knows is that of all
      twins[0].provenance.mass = twin.provenance.mass;
      options = identification_options(twins[0], false, seed);
    }
    twin.states.covariance = read_covariances(runs[i] / kCovarianceFile, twin.states);
    recordings.push_back({own_base(runs[i], twin.states), twin.states});
  }
  std::vector<identification::Result> found;
  {
    const Stopwatch watch(twins[0], "identify");
    found = identification::identify(twins[0].chain, recordings, options);
  }
  check_same_rope(twins[0].chain, found, runs);
  say_fit(found, runs);
  for (std::size_t i = 0; i < twins.size(); ++i) {
    adopt(twins[i], recordings[i].base, std::move(found[i]));
    tell_fit("identify", *twins[i].estimates.solver);
    twins[i].known_mass = options.mass.has_value();
    twins[i].provenance.mass = twins[0].provenance.mass;
  }
  twin::Validity all;
  for (const twin::Twin& twin : twins) all = twin::larger(all, *twin.validity);
  for (twin::Twin& twin : twins) twin.validity = all;
}

void identify_one(twin::Twin& twin, const Path& run, const IdentifyOptions& options) {
  const trajectory::Trajectory base = own_base(run, twin.states);
  const Path covariance_file = run / kCovarianceFile;
  twin.states.covariance = read_covariances(covariance_file, twin.states);
  capture::Capture capture;
  gpu::DevicePtr device;
  if (options.joint) {
    check_joint(twin, run);
    capture = load_own_capture(twin, run);
    device = gpu::open_device({.selector = options.device});
  }
  identify_states(twin, base, twin.provenance.mode == twin::Mode::paper, options.seed);
  if (options.joint) refine(twin, capture, *device, options.seed);
  roll_out(twin, base, run);
  // last, when nothing can fail but the disk: covariances and states belong together
  if (options.joint) write_covariances(covariance_file, twin.states);
}

// What was measured on the old parameters is not true any more.
IdentifyResult save_all(std::vector<twin::Twin> twins, const std::vector<Path>& runs) {
  IdentifyResult result{std::move(twins), {}};
  for (std::size_t i = 0; i < runs.size(); ++i) {
    twin::save(result.twins[i], runs[i]);
    std::error_code ignored;
    if (fs::remove(runs[i] / kMetricsFile, ignored)) result.lost_metrics.push_back(runs[i]);
    if (fs::exists(runs[i] / kReportFile, ignored)) write_report(runs[i]);
  }
  return result;
}

}  // namespace

IdentifyResult identify(const std::vector<Path>& runs, const IdentifyOptions& options, const core::Listener& listener) {
  const core::ListenerScope scope(listener);
  if (runs.empty()) throw InputError("runs", "is empty", "name one or more");
  if (options.joint && runs.size() > 1)
    throw InputError("`joint`", "goes with one RUN", "refine them one after the other");
  std::vector<twin::Twin> twins = load_all(runs);
  if (options.payload)
    for (twin::Twin& twin : twins) twin.provenance.payload = options.payload;
  if (runs.size() > 1)
    identify_several(twins, runs, options.seed);
  else
    identify_one(twins[0], runs[0], options);
  return save_all(std::move(twins), runs);
}

IdentifyResult identify_markers(const Path& run, const std::vector<Path>& files, const MarkerOptions& options,
                                const core::Listener& listener) {
  const core::ListenerScope scope(listener);
  if (files.empty()) throw InputError("files", "is empty", "name one or more");
  twin::Twin twin = twin::load(run);
  if (options.payload) twin.provenance.payload = options.payload;
  {
    const Stopwatch watch(twin, "identify");
    std::vector<identification::MarkerRecording> recordings;
    std::vector<trajectory::Sample> first_base;
    std::string names;
    for (const Path& file : files) {
      identification::MarkerFile measured = identification::read_markers(file);
      recordings.push_back({trajectory::fit(measured.base, file.string()), std::move(measured.markers)});
      if (first_base.empty()) first_base = std::move(measured.base);
      names += (names.empty() ? "" : " ") + file.filename().string();
    }
    identification::MarkerFit fitted =
        identification::fit_markers(twin.chain, recordings[0].base, recordings[0].markers);
    tell_fit("markers", fitted.summary);
    twin.states = std::move(fitted.states);
    if (options.shape_only) {
      twin.parameters.reset(), twin.initial.reset();
      twin.estimates = {}, twin.rollout = {}, twin.validity.reset();
    } else {
      std::vector<identification::Result> found =
          identification::identify(twin.chain, recordings, identification_options(twin, false, options.seed));
      check_same_rope(twin.chain, found, files);
      say_fit(found, files);
      twin::Validity all;
      for (std::size_t i = 0; i < found.size(); ++i)
        all = twin::larger(all, twin::validity_of(twin.chain, recordings[i].base, found[i].rollout));
      adopt(twin, recordings[0].base, std::move(found[0]));
      twin.validity = all;
      tell_fit("identify", *twin.estimates.solver);
    }
    twin.provenance.options["markers"] = names;
    core::write_file(run / kBaseFile, trajectory::write_tum(first_base));
    write_covariances(run / kCovarianceFile, twin.states);
  }
  std::vector<twin::Twin> twins;
  twins.push_back(std::move(twin));
  return save_all(std::move(twins), {run});
}

}  // namespace chainsplat::pipeline
