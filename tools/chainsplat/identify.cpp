// identify.cpp - identify: a twin's dynamics from its recognized states or from marker trajectories.
#include "identify.h"

#include <CLI/CLI.hpp>
#include <cmath>
#include <cstdio>
#include <iostream>
#include <limits>
#include <memory>
#include <nlohmann/json.hpp>

#include "chainsplat/identification.h"
#include "cli.h"
#include "joint.h"
#include "markers.h"
#include "online.h"

namespace chainsplat::tools {

identification::Options identification_options(const twin::Twin& twin, bool paper, std::uint64_t seed) {
  identification::Options options;
  options.tabletop = twin.tabletop;
  options.gravity = twin.gravity;
  if (twin.table_normal) options.table_normal = *twin.table_normal;
  const auto mass = twin.provenance.options.find("mass");
  if (mass != twin.provenance.options.end()) options.mass = std::stod(mass->second);  // checked when it was read
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

namespace {

namespace fs = std::filesystem;
using Json = nlohmann::ordered_json;

struct Request {
  std::vector<std::string> runs, markers;
  bool shape_only = false, joint = false;
};

void take(twin::Twin& twin, identification::Result result) {
  twin.parameters = std::move(result.parameters);
  twin.initial = std::move(result.initial);
  twin.estimates = std::move(result.estimates);
  twin.rollout = std::move(result.rollout);
}

// A recording that parameters of its own follow far better is of another rope than the rest, unless both follow it well
// enough to be of use: recordings of one foam noodle, which creeps and softens over an hour, differ by 3.6 times and
// 1.8 % of its length.
void same_rope(const chain::Chain& chain, const std::vector<identification::Result>& found,
               const std::vector<std::string>& names) {
  constexpr double kOther = 3.0, kUseful = 0.02;  // kUseful: of the length
  for (std::size_t i = 0; i < found.size(); ++i)
    if (found[i].node_rms > kOther * found[i].alone_rms && found[i].node_rms > kUseful * chain.length) {
      char text[200];
      std::snprintf(text, sizeof text,
                    "is of another rope than the rest: one set of parameters leaves %.1f mm, its own %.1f mm",
                    1e3 * found[i].node_rms, 1e3 * found[i].alone_rms);
      throw InputError(names[i], text, "identify it alone");
    }
}

void say_fit(const std::vector<identification::Result>& found, const std::vector<std::string>& names) {
  for (std::size_t i = 0; i < found.size(); ++i) {
    char text[100];
    int length = std::snprintf(text, sizeof text, ": rollout within %.2f mm RMS", 1e3 * found[i].node_rms);
    if (found.size() > 1)
      std::snprintf(text + length, sizeof text - length, " (%.2f with parameters of its own)",
                    1e3 * found[i].alone_rms);
    say(names[i] + text);
  }
}

// Marker positions take the place of recognized states; the twin can be an empty one. It keeps the motion of the first
// file; the others take part in its parameters.
void identify_markers(twin::Twin& twin, const Request& request, std::uint64_t seed) {
  const Stopwatch watch(twin, "identify");
  const std::string& run = request.runs.front();
  std::vector<identification::MarkerRecording> recordings;
  std::vector<trajectory::Sample> first_base;
  std::string names;
  for (const std::string& file : request.markers) {
    MarkerFile measured = read_markers(input_path(file));
    recordings.push_back({trajectory::fit(measured.base, file), std::move(measured.markers)});
    if (first_base.empty()) first_base = std::move(measured.base);
    names += (names.empty() ? "" : " ") + Path(file).filename().string();
  }
  std::vector<math::MatrixX> covariances;
  twin.states = identification::fit_markers(twin.chain, recordings[0].base, recordings[0].markers, &covariances);
  if (request.shape_only) {
    twin.parameters.reset(), twin.initial.reset();
    twin.estimates = {}, twin.rollout = {};
  } else {
    std::vector<identification::Result> found =
        identification::identify(twin.chain, recordings, identification_options(twin, false, seed));
    same_rope(twin.chain, found, request.markers);
    say_fit(found, request.markers);
    take(twin, std::move(found[0]));
  }
  twin.provenance.options["markers"] = names;
  core::write_file(Path(run) / kBaseFile, trajectory::write_tum(first_base));
  core::write_file(Path(run) / kCovarianceFile, covariance_csv(twin.states, covariances));
}

// Throws where two twins cannot be of one rope.
void same_chain(const twin::Twin& one, const std::string& first, const twin::Twin& other, const std::string& run) {
  const auto refuse = [&](const std::string& what) {
    throw InputError(run, what + " than that of " + first, "identify ropes apart");
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
  const auto mass = one.provenance.options.find("mass"), mass2 = other.provenance.options.find("mass");
  if (mass != one.provenance.options.end() && mass2 != other.provenance.options.end() && mass->second != mass2->second)
    refuse("is of another rope: its mass is " + mass2->second + " kg, another");
}

void identify_several(std::vector<twin::Twin>& twins, const std::vector<std::string>& runs, std::uint64_t seed) {
  std::vector<identification::Recording> recordings;
  identification::Options options = identification_options(twins[0], false, seed);
  for (std::size_t i = 0; i < twins.size(); ++i) {
    const twin::Twin& twin = twins[i];
    if (i > 0) same_chain(twins[0], runs[0], twin, runs[i]);
    // a mass that one capture knows is that of all
    if (!options.mass) options.mass = identification_options(twin, false, seed).mass;
    recordings.push_back(
        {own_base(runs[i], twin.states), twin.states, read_covariances(Path(runs[i]) / kCovarianceFile, twin.states)});
  }
  std::vector<identification::Result> found;
  {
    const Stopwatch watch(twins[0], "identify");
    found = identification::identify(twins[0].chain, recordings, options);
  }
  same_rope(twins[0].chain, found, runs);
  say_fit(found, runs);
  for (std::size_t i = 0; i < twins.size(); ++i) {
    take(twins[i], std::move(found[i]));
    twins[i].known_mass = options.mass.has_value();
    if (options.mass) twins[i].provenance.options["mass"] = core::exact(*options.mass);
  }
}

void identify(const Globals& globals, const Request& request) {
  watch_signals();
  const std::vector<std::string>& runs = request.runs;
  if (request.joint && runs.size() > 1)
    throw InputError("--joint", "goes with one RUN", "refine them one after the other");
  std::vector<twin::Twin> twins;
  if (!request.markers.empty()) {
    if (runs.size() > 1)
      throw InputError("--markers", "goes with one RUN", "name one twin; several files can follow --markers");
    twins.push_back(twin::load(runs[0]));
    identify_markers(twins[0], request, globals.seed);
  } else {
    for (std::size_t i = 0; i < runs.size(); ++i) {
      for (std::size_t k = 0; k < i; ++k) {
        std::error_code ignored;
        if (fs::equivalent(runs[i], runs[k], ignored)) throw InputError(runs[i], "is named twice", "name it once");
      }
      twins.push_back(load_twin(runs[i]));
    }
    const auto mode = twins[0].provenance.options.find("mode");
    const bool paper = mode != twins[0].provenance.options.end() && mode->second == "paper";
    if (runs.size() > 1) {
      identify_several(twins, runs, globals.seed);
    } else {
      const trajectory::Trajectory base = own_base(runs[0], twins[0].states);
      const Path covariance_file = Path(runs[0]) / kCovarianceFile;
      std::vector<math::MatrixX> covariances = read_covariances(covariance_file, twins[0].states);
      capture::Capture capture;
      gpu::DevicePtr device;
      if (request.joint) {
        check_joint(twins[0], covariances, runs[0]);
        capture = load_own_capture(twins[0], runs[0]);
        device = gpu::open_device({.selector = globals.device});
      }
      identify_stage(twins[0], base, covariances, paper, globals.seed);
      if (request.joint) joint_stage(twins[0], covariances, capture, *device, globals.seed);
      rollout_stage(twins[0], base, runs[0]);
      // last, when nothing can fail but the disk: covariances and states belong together
      if (request.joint) core::write_file(covariance_file, covariance_csv(twins[0].states, covariances));
    }
  }
  for (std::size_t i = 0; i < runs.size(); ++i) {
    twin::save(twins[i], runs[i]);
    std::error_code ignored;
    // what was measured on the old parameters is not true any more
    if (fs::remove(Path(runs[i]) / kMetricsFile, ignored))
      say("metrics.json was of the old parameters and is removed: 'chainsplat eval " + runs[i] + " CAPTURE -o " +
          runs[i] + "/metrics.json' makes it again");
  }
  end_progress();
  const dynamics::Estimates& found = twins[0].estimates;
  if (globals.json) {
    Json document;
    document["run"] = runs[0];
    if (runs.size() > 1) document["runs"] = runs;
    document["known_mass"] = twins[0].known_mass;
    document["names"] = found.names;
    document["estimates"] = found.values;
    document["standard_errors"] = found.standard_errors;
    document["held"] = Json::array();
    for (const auto& [name, reason] : found.held) document["held"].push_back({{"name", name}, {"reason", reason}});
    document["weak"] = Json::array();
    for (const auto& weak : found.weak) {
      Json direction = Json::object();
      for (const auto& [name, component] : weak.parts) direction[name] = component;
      document["weak"].push_back({{"singular_value", weak.singular_value}, {"direction", direction}});
    }
    std::cout << document.dump(1, ' ', false, Json::error_handler_t::replace) << "\n";
    return;
  }
  if (!found.names.empty()) std::cout << "parameter                        estimate   standard error\n";
  char line[160];
  for (std::size_t i = 0; i < found.names.size(); ++i) {
    std::snprintf(
        line, sizeof line, "%-28.60s %12.5g %16.3g\n", found.names[i].c_str(), found.values[i],
        i < found.standard_errors.size() ? found.standard_errors[i] : std::numeric_limits<double>::quiet_NaN());
    std::cout << line;
  }
  for (const auto& [name, reason] : found.held) std::cout << name << ": held, " << reason << "\n";
  constexpr std::size_t kMostLines = 6;
  if (!found.weak.empty())
    std::cout << "The data tell less than the priors (singular value below 1) of " << found.weak.size()
              << " combinations" << (found.weak.size() > kMostLines ? ", the weakest first:\n" : ":\n");
  for (std::size_t i = 0; i < std::min(kMostLines, found.weak.size()); ++i) {
    std::snprintf(line, sizeof line, "%8.2g ", found.weak[i].singular_value);
    std::cout << line;
    for (const auto& [name, component] : found.weak[i].parts) {
      std::snprintf(line, sizeof line, " %+.1f %s", component, name.c_str());
      std::cout << line;
    }
    std::cout << "\n";
  }
  if (found.weak.size() > kMostLines) std::cout << "all of them: twin.json, identification.weak\n";
  for (const std::string& run : runs) std::cout << "twin: " << run << "\n";
}

}  // namespace

Stopwatch::~Stopwatch() {
  const double seconds = core::seconds_now() - start_;
  twin_.provenance.seconds[stage_] += seconds;
  char text[64];
  std::snprintf(text, sizeof text, ": %.1f s", seconds);
  say_more(stage_ + text);
}

void identify_stage(twin::Twin& twin, const trajectory::Trajectory& base, const std::vector<math::MatrixX>& covariances,
                    bool paper, std::uint64_t seed) {
  const Stopwatch watch(twin, "identify");
  identification::Result found =
      identification::identify(twin.chain, base, twin.states, covariances, identification_options(twin, paper, seed));
  twin.parameters = std::move(found.parameters);
  twin.initial = std::move(found.initial);
  twin.estimates = std::move(found.estimates);
  twin.rollout = std::move(found.rollout);
}

void rollout_stage(twin::Twin& twin, const trajectory::Trajectory& base, const Path& out) {
  const Stopwatch watch(twin, "rollout");
  if (!twin.initial) throw InputError((out / "twin.json").string(), "has no initial state", "add identify to --stages");
  twin.rollout = dynamics::rollout(model_of(twin, out), base, *twin.initial, twin.states.time);
}

void add_identify_command(CLI::App& app, const Globals& globals, Job& job) {
  CLI::App* identifier =
      app.add_subcommand("identify", "The second stage alone: masses, stiffness, damping, friction of a twin");
  auto request = std::make_shared<Request>();
  identifier
      ->add_option("RUN", request->runs,
                   "Run folder with recognized states; it is updated. Several of one rope get one set of parameters,\n"
                   "each its own initial state and rollout")
      ->required();
  CLI::Option* markers =
      identifier
          ->add_option("--markers", request->markers,
                       "Measured positions of points of the rope and the base's motion instead of recognized states;\n"
                       "RUN can be an empty twin (see new). Several files of one rope give one set of parameters; RUN\n"
                       "keeps the motion of the first")
          ->type_name("FILE.csv ...");
  identifier->add_flag("--shape-only", request->shape_only, "With --markers: only the angles at each time, no dynamics")
      ->needs(markers);
  identifier
      ->add_flag(
          "--joint", request->joint,
          "Then refine angles, Gaussians and dynamics of one RUN together with the capture's images: helps where\n"
          "a single camera hardly sees depth")
      ->excludes(markers);
  auto online = std::make_shared<OnlineRequest>();
  CLI::Option* stream =
      identifier
          ->add_option(
              "--online", online->file,
              "Follow the states that 'estimate' printed (-: standard input): the twin's parameters move with\n"
              "the rope, old frames are forgotten")
          ->type_name("FILE.jsonl")
          ->excludes(markers)
          ->excludes("--joint");
  identifier
      ->add_option("--base", online->base, "With --online: the base's motion meanwhile (default: the capture's own)")
      ->type_name("FILE.tum")
      ->needs(stream);
  identifier
      ->add_option("--memory", online->memory,
                   "With --online: seconds in which old frames fade (default 5; inf: never)")
      ->type_name("S")
      ->needs(stream);
  identifier->callback([&globals, &job, request, online] {
    job = [&globals, request, online] {
      if (online->file.empty()) return identify(globals, *request);
      if (request->runs.size() != 1)
        throw InputError("--online", "follows one twin, " + std::to_string(request->runs.size()) + " are named",
                         "name one RUN");
      online->run = request->runs[0];
      identify_online(globals, *online);
    };
  });
}

}  // namespace chainsplat::tools
