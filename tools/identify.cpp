// identify.cpp - identify: a twin's dynamics from its recognized states or from marker trajectories.
#include "identify.h"

#include <CLI/CLI.hpp>
#include <cstdio>
#include <iostream>
#include <limits>
#include <memory>
#include <nlohmann/json.hpp>

#include "chainsplat/identification.h"
#include "cli.h"
#include "markers.h"

namespace chainsplat::tools {

identification::Options identification_options(const twin::Twin& twin, bool paper, std::uint64_t seed) {
  identification::Options options;
  options.tabletop = twin.tabletop;
  options.gravity = twin.gravity;
  if (twin.table_normal) options.table_normal = *twin.table_normal;
  const auto mass = twin.provenance.options.find("mass");
  if (mass != twin.provenance.options.end()) options.mass = std::stod(mass->second);
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

// Marker positions take the place of recognized states; the twin can be an empty one.
void identify_markers(twin::Twin& twin, const std::string& run, const std::string& file, std::uint64_t seed) {
  const Stopwatch watch(twin, "identify");
  const MarkerFile measured = read_markers(file);
  const trajectory::Trajectory base = trajectory::fit(measured.base, file);
  std::vector<math::MatrixX> covariances;
  twin.states = identification::fit_markers(twin.chain, base, measured.markers, &covariances);
  identification::Result found =
      identification::identify(twin.chain, base, measured.markers, identification_options(twin, false, seed));
  twin.parameters = std::move(found.parameters);
  twin.initial = std::move(found.initial);
  twin.estimates = std::move(found.estimates);
  twin.rollout = std::move(found.rollout);
  twin.provenance.options["markers"] = Path(file).filename().string();
  core::write_file(Path(run) / kBaseFile, trajectory::write_tum(measured.base));
  core::write_file(Path(run) / kCovarianceFile, covariance_csv(twin.states, covariances));
  char text[80];
  std::snprintf(text, sizeof text, "markers against the rollout: RMS %.2f mm", 1e3 * found.node_rms);
  say(text);
}

void identify(const Globals& globals, const std::string& run, const std::string& markers) {
  watch_signals();
  twin::Twin twin = markers.empty() ? load_twin(run) : twin::load(run);
  if (markers.empty()) {
    const trajectory::Trajectory base = own_base(run);
    const std::vector<math::MatrixX> covariances = read_covariances(Path(run) / kCovarianceFile, twin.states);
    const auto mode = twin.provenance.options.find("mode");
    identify_stage(twin, base, covariances, mode != twin.provenance.options.end() && mode->second == "paper",
                   globals.seed);
    rollout_stage(twin, base, run);
  } else {
    identify_markers(twin, run, markers, globals.seed);
  }
  std::error_code ignored;
  // what was measured on the old parameters is not true any more
  if (fs::remove(Path(run) / kMetricsFile, ignored))
    say("metrics.json was of the old parameters and is removed: 'chainsplat eval " + run + " CAPTURE -o " + run +
        "/metrics.json' makes it again");
  twin::save(twin, run);
  end_progress();
  const dynamics::Estimates& found = twin.estimates;
  if (globals.json) {
    Json document;
    document["run"] = run;
    document["known_mass"] = twin.known_mass;
    document["names"] = found.names;
    document["estimates"] = found.values;
    document["standard_errors"] = found.standard_errors;
    document["held"] = Json::array();
    for (const auto& [name, reason] : found.held) document["held"].push_back({{"name", name}, {"reason", reason}});
    std::cout << document.dump(1) << "\n";
    return;
  }
  std::cout << "parameter                        estimate   standard error\n";
  for (std::size_t i = 0; i < found.names.size(); ++i) {
    char line[160];
    std::snprintf(
        line, sizeof line, "%-28.60s %12.5g %16.3g\n", found.names[i].c_str(), found.values[i],
        i < found.standard_errors.size() ? found.standard_errors[i] : std::numeric_limits<double>::quiet_NaN());
    std::cout << line;
  }
  for (const auto& [name, reason] : found.held) std::cout << name << ": held, " << reason << "\n";
  std::cout << "twin: " << run << "\n";
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
  auto run = std::make_shared<std::string>();
  identifier->add_option("RUN", *run, "Run folder with recognized states; it is updated")->required();
  auto markers = std::make_shared<std::string>();
  identifier
      ->add_option("--markers", *markers,
                   "Measured positions of points of the rope and the base's motion instead of recognized states; RUN\n"
                   "can be an empty twin (see new)")
      ->type_name("FILE.csv");
  identifier->callback(
      [&globals, &job, run, markers] { job = [&globals, run, markers] { identify(globals, *run, *markers); }; });
}

}  // namespace chainsplat::tools
