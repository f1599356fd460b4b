// identify.cpp - identify: a twin's dynamics from its recognized states, from marker trajectories or from live
// estimates.
#include <algorithm>
#include <cstdio>
#include <fstream>
#include <iostream>
#include <limits>
#include <memory>
#include <nlohmann/json.hpp>

#include "chainsplat/json.h"
#include "chainsplat/pipeline.h"
#include "chainsplat/properties.h"
#include "chainsplat/run_folder.h"
#include "chainsplat/solve_json.h"
#include "cli.h"
#include "command_line.h"

namespace chainsplat::tools {

namespace {

using Json = nlohmann::ordered_json;

struct IdentifyRequest {
  std::vector<std::string> runs, markers;
  PayloadRequest payload;
  bool shape_only = false, joint = false;
};

struct OnlineRequest {
  std::string run, file;  // "-": standard input
  std::string base;       // TUM; empty: the capture's own
  double memory = 5.0;    // s
};

Json document_of(const twin::Twin& twin, const std::vector<std::string>& runs) {
  const dynamics::Estimates& found = twin.estimates;
  Json document;
  document["run"] = runs[0];
  if (runs.size() > 1) document["runs"] = runs;
  document["known_mass"] = twin.known_mass;
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
  if (std::isfinite(found.misfit)) document["misfit"] = found.misfit;
  if (found.solver) document["solver"] = *found.solver;
  return document;
}

void print_estimates(const dynamics::Estimates& found) {
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
}

pipeline::IdentifyResult identified(const Globals& globals, const IdentifyRequest& request) {
  if (request.markers.empty())
    return pipeline::identify({request.runs.begin(), request.runs.end()},
                              {.joint = request.joint,
                               .payload = payload_of(request.payload),
                               .seed = globals.seed,
                               .device = globals.device},
                              terminal());
  if (request.runs.size() > 1)
    throw InputError("--markers", "goes with one RUN", "name one twin; several files can follow --markers");
  std::vector<Path> files;
  for (const std::string& name : request.markers) files.push_back(pipeline::input_path(name));
  return pipeline::identify_markers(
      request.runs[0], files,
      {.shape_only = request.shape_only, .payload = payload_of(request.payload), .seed = globals.seed}, terminal());
}

void identify(const Globals& globals, const IdentifyRequest& request) {
  watch_signals();
  const pipeline::IdentifyResult result = identified(globals, request);
  for (const Path& path : result.lost_metrics) {
    const std::string run = path.string();
    say("metrics.json was of the old parameters and is removed: 'chainsplat eval " + run + " CAPTURE -o " + run +
        "/metrics.json' makes it again");
  }
  end_progress();
  if (globals.json) {
    std::cout << core::json_text(document_of(result.twins[0], request.runs)) << "\n";
    return;
  }
  print_estimates(result.twins[0].estimates);
  if (const twin::Twin& twin = result.twins[0]; twin.parameters) std::cout << twin::describe(twin::properties(twin));
  for (const std::string& run : request.runs) std::cout << "twin: " << run << "\n";
  for (std::size_t i = 0; i < result.twins.size(); ++i)
    for (const capture::Finding& finding : result.twins[i].verdict)
      std::cout << (result.twins.size() > 1 ? request.runs[i] + ": " : "") << core::printable(finding.text) << "\n";
}

pipeline::OnlineResult identified_online(const OnlineRequest& request) {
  const pipeline::OnlineOptions options{request.base.empty() ? Path() : pipeline::input_path(request.base),
                                        request.memory};
  if (request.file == "-") return pipeline::identify_online(request.run, std::cin, "-", options, terminal());
  std::ifstream file(request.file);
  return pipeline::identify_online(request.run, file, request.file, options, terminal());
}

void identify_online(const Globals& globals, const OnlineRequest& request) {
  watch_signals();
  const pipeline::OnlineResult found = identified_online(request);
  const dynamics::Estimates &before = found.before, &now = found.now;
  if (globals.json) {
    Json document;
    document["run"] = request.run;
    document["from"] = found.from, document["to"] = found.to;
    document["frames"] = found.frames, document["left_out"] = found.left_out;
    document["restarts"] = found.restarts;
    document["names"] = now.names;
    document["before"] = before.values;
    document["estimates"] = now.values;
    document["standard_errors"] = now.standard_errors;
    std::cout << core::json_text(document) << "\n";
    return;
  }
  char text[200];
  std::cout << "parameter                          before          now   standard error\n";
  for (std::size_t i = 0; i < now.names.size() && i < now.values.size() && i < now.standard_errors.size(); ++i) {
    if (now.values[i] == before.values[i]) continue;
    std::snprintf(text, sizeof text, "%-28.60s %12.5g %12.5g %16.3g\n", now.names[i].c_str(), before.values[i],
                  now.values[i], now.standard_errors[i]);
    std::cout << text;
  }
  std::snprintf(text, sizeof text, "%d frames from %g to %g s used, %d left out, %d restarts; twin: ", found.frames,
                found.from, found.to, found.left_out, found.restarts);
  std::cout << text << request.run << "\n";
}

}  // namespace

void add_identify_command(Command app, const Globals& globals, Job& job) {
  Command identifier =
      app.add_command("identify", "The second stage alone: masses, stiffness, damping, friction of a twin");
  auto request = std::make_shared<IdentifyRequest>();
  identifier
      .add_option("RUN", request->runs,
                  "Run folder with recognized states; it is updated. Several of one rope get one set of parameters,\n"
                  "each its own initial state and rollout")
      .required();
  Option markers =
      identifier
          .add_option("--markers", request->markers,
                      "Measured positions of points of the rope and the base's motion instead of recognized states;\n"
                      "RUN can be an empty twin (see new). Several files of one rope give one set of parameters; RUN\n"
                      "keeps the motion of the first")
          .type_name("FILE.csv ...");
  identifier.add_flag("--shape-only", request->shape_only, "With --markers: only the angles at each time, no dynamics")
      .needs(markers);
  identifier
      .add_flag(
          "--joint", request->joint,
          "Then refine angles, Gaussians and dynamics of one RUN together with the capture's images: helps where\n"
          "a single camera hardly sees depth")
      .excludes(markers);
  add_payload_options(identifier, request->payload);
  auto online = std::make_shared<OnlineRequest>();
  Option stream =
      identifier
          .add_option("--online", online->file,
                      "Follow the states that 'estimate' printed (-: standard input): the twin's parameters move with\n"
                      "the rope, old frames are forgotten")
          .type_name("FILE.jsonl")
          .excludes(markers)
          .excludes("--joint");
  identifier
      .add_option("--base", online->base, "With --online: the base's motion meanwhile (default: the capture's own)")
      .type_name("FILE.tum")
      .needs(stream);
  identifier
      .add_option("--memory", online->memory, "With --online: seconds in which old frames fade (default 5; inf: never)")
      .type_name("S")
      .needs(stream);
  identifier.callback([&globals, &job, request, online] {
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
