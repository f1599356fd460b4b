// result.cpp - eval, export, synth: how good a twin is, and what others can do with it.
#include <CLI/CLI.hpp>
#include <algorithm>
#include <iostream>
#include <memory>
#include <nlohmann/json.hpp>

#include "chainsplat/capture.h"
#include "chainsplat/dynamics.h"
#include "chainsplat/eval.h"
#include "chainsplat/export.h"
#include "chainsplat/synth.h"
#include "cli.h"
#include "picture.h"
#include "run_folder.h"

namespace chainsplat::tools {

namespace {

namespace fs = std::filesystem;

struct EvalRequest {
  std::string run, capture, out, picture, frames;
};

// The twin set in motion by another capture's base, at the times of its first camera that the base covers.
chain::States rollout_on(const twin::Twin& twin, const Path& run, const capture::Capture& capture) {
  const dynamics::Model model = model_of(twin, run);
  dynamics::InitialState initial;
  std::vector<double> times;
  for (const double time : capture.times.front())
    if (time >= capture.base.start() && time <= capture.base.end()) times.push_back(time);
  if (times.empty())
    throw InputError(capture.folder.string(), "its base motion covers none of its frames", "correct base.tum");
  initial.time = std::min(capture.base.start(), times.front());
  initial.thetadot = math::VectorX::Zero(twin.chain.angles());
  initial.theta = twin.tabletop ? (twin.initial ? twin.initial->theta : twin.states.theta.front())
                                : dynamics::static_equilibrium(model, capture.base.pose(initial.time));
  return dynamics::rollout(model, capture.base, initial, times);
}

void evaluate(const Globals& globals, const EvalRequest& request) {
  if (!request.out.empty()) check_output_file(request.out);
  if (!request.picture.empty()) check_output_file(request.picture);
  if (globals.json && request.out == "-")
    throw InputError("--json", "standard output is wanted by '-o -' too", "leave one of them out");
  twin::Twin twin = load_twin(request.run);
  check_drawable(twin, request.run);
  const auto [first, last] = parse_frames(request.frames);
  capture::LoadOptions load;
  load.first = first;
  load.last = last;
  load.undistort = false;
  load.depth = true;
  const capture::Capture recorded = capture::load(request.capture, load);
  const bool own = twin.provenance.capture_hash == hash_text(recorded.hash);
  if (!own) {
    say("another capture than the twin's own: only the rollout is evaluated, from rest");
    twin.states = {};
    twin.rollout = rollout_on(twin, request.run, recorded);
  }
  const gpu::DevicePtr device = gpu::open_device({.selector = globals.device});
  splat::Engine engine(*device);
  eval::Metrics recognized, rollout;
  const bool has_rollout = !twin.rollout.time.empty();
  if (own) recognized = eval::evaluate(engine, twin.gaussians, twin.chain, twin.states, recorded);
  if (has_rollout) rollout = eval::evaluate(engine, twin.gaussians, twin.chain, twin.rollout, recorded);
  const std::string json = metrics_json(own ? &recognized : nullptr, has_rollout ? &rollout : nullptr);
  if (!request.out.empty()) write_result(request.out, json);
  if (!request.picture.empty()) capture::write_png(request.picture, comparison(engine, twin, recorded));
  end_progress();
  if (globals.json) {
    std::cout << json;
    return;
  }
  if (request.out == "-") return;
  std::vector<MetricsRow> rows;
  for (const auto& [name, metrics, there] :
       {std::tuple("recognized", &recognized, own), std::tuple("rollout", &rollout, has_rollout)}) {
    if (!there) continue;
    for (std::size_t c = 0; c < metrics->cameras.size(); ++c)
      rows.push_back({std::string(name) + " " + metrics->camera_names[c], metrics->cameras[c]});
    rows.push_back({std::string(name) + " mean", metrics->mean});
  }
  std::cout << metrics_table(rows);
  if (!request.picture.empty()) std::cout << "picture: " << request.picture << "\n";
}

struct ExportRequest {
  std::string run, states, base, out;
};

void export_twin(const Globals& globals, const ExportRequest& request) {
  const std::vector<std::string>& known = exports::endings();
  if (std::find(known.begin(), known.end(), Path(request.out).extension().string()) == known.end()) {
    std::string list;
    for (const std::string& ending : known) list += (list.empty() ? "" : ", ") + ending;
    throw InputError(request.out, "its ending is not known", "use one of " + list);
  }
  check_output_file(request.out);
  const twin::Twin twin = load_twin(request.run);
  const chain::States motion =
      request.states.empty() ? twin.states : twin::read_states(input_path(request.states), twin.chain.angles());
  exports::write(twin, motion, request.base.empty() ? own_base(request.run) : read_base(request.base), request.out);
  if (globals.json)
    std::cout << nlohmann::ordered_json{{"output", request.out}}.dump(-1, ' ', false,
                                                                      nlohmann::ordered_json::error_handler_t::replace)
              << "\n";
  else
    say("written: " + request.out);
}

struct SynthRequest {
  std::string run, states, base, camera, out;
  bool images = false, force = false;
};

void synthesize(const Globals& globals, const SynthRequest& request) {
  const Path out = request.out;
  check_output_folder(out, request.force, "name another folder or give --force to write into it");
  const twin::Twin twin = load_twin(request.run);
  check_drawable(twin, request.run);
  auto [folder, camera] = split_camera(request.camera);
  if (folder.empty()) {
    const auto path = twin.provenance.options.find("path");
    if (path == twin.provenance.options.end())
      throw InputError(request.run, "does not say which capture it was made from", "give --camera with a capture");
    folder = (Path(request.run) / path->second).lexically_normal().string();
  }
  capture::LoadOptions load;
  load.images = false;
  load.camera = camera;
  capture::Capture scene = capture::load(folder, load);
  check_not_capture(out, scene.folder);
  if (!request.base.empty()) scene.base = read_base(request.base);
  const chain::States states = !request.states.empty()
                                   ? twin::read_states(input_path(request.states), twin.chain.angles())
                               : twin.rollout.time.empty() ? twin.states
                                                           : twin.rollout;
  const gpu::DevicePtr device = gpu::open_device({.selector = globals.device});
  splat::Engine engine(*device);
  synth::Options options;
  options.name = fs::absolute(out).lexically_normal().filename().string();
  if (options.name.empty()) options.name = "synth";
  options.video = !request.images;
  synth::write(engine, twin, states, scene, out, options);
  if (globals.json)
    std::cout << nlohmann::ordered_json{{"capture", request.out}}.dump(-1, ' ', false,
                                                                       nlohmann::ordered_json::error_handler_t::replace)
              << "\n";
  else
    say("capture: " + request.out);
}

}  // namespace

void add_result_commands(CLI::App& app, const Globals& globals, Job& job) {
  CLI::App* evaluator = app.add_subcommand("eval", "Measure how well a twin explains a capture");
  auto request = std::make_shared<EvalRequest>();
  evaluator->add_option("RUN", request->run, "Run folder of a twin")->required();
  evaluator->add_option("CAPTURE", request->capture, "Its own capture, or another one of the same rope (rollout only)")
      ->required();
  evaluator->add_option("-o,--output", request->out, "Also write the metrics as JSON")->type_name("FILE.json");
  evaluator->add_option("--frames", request->frames, "Only these frames: from A up to, not including, B")
      ->type_name("A:B");
  evaluator->add_option("--picture", request->picture, "Also make a picture: observed beside rendered frames")
      ->type_name("FILE.png");
  evaluator->callback([&globals, &job, request] { job = [&globals, request] { evaluate(globals, *request); }; });

  CLI::App* exporter = app.add_subcommand("export", "Write the twin for other programs, by the file's ending");
  auto exporting = std::make_shared<ExportRequest>();
  exporter->add_option("RUN", exporting->run, "Run folder of a twin")->required();
  std::string endings;
  for (const std::string& ending : exports::endings()) endings += (endings.empty() ? "" : " ") + ending;
  exporter->add_option("-o,--output", exporting->out, "File to write; its ending says what: " + endings)
      ->required()
      ->type_name("FILE");
  exporter->add_option("--states", exporting->states, "Motion to write (default: the recognized states)")
      ->type_name("STATES.csv");
  exporter->add_option("--base", exporting->base, "Its base motion (default: the capture's own)")
      ->type_name("FILE.tum");
  exporter->callback(
      [&globals, &job, exporting] { job = [&globals, exporting] { export_twin(globals, *exporting); }; });

  CLI::App* synthesizer = app.add_subcommand("synth", "Draw a capture from a twin: videos, masks, depth, truth");
  auto scene = std::make_shared<SynthRequest>();
  synthesizer->add_option("RUN", scene->run, "Run folder of a twin")->required();
  synthesizer->add_option("-o,--output", scene->out, "Capture folder to make")->required()->type_name("CAPTURE");
  synthesizer
      ->add_option("--states", scene->states, "Motion to draw (default: the rollout, else the recognized states)")
      ->type_name("STATES.csv");
  synthesizer
      ->add_option("--camera", scene->camera, "Whose cameras, base motion and table (default: the twin's own capture)")
      ->type_name("CAPTURE[:NAME]");
  synthesizer->add_option("--base", scene->base, "Base motion (default: that of the capture)")->type_name("FILE.tum");
  synthesizer->add_flag("--images", scene->images, "Images without loss instead of videos");
  synthesizer->add_flag("--force", scene->force, "Write into a folder that is not empty");
  synthesizer->callback([&globals, &job, scene] { job = [&globals, scene] { synthesize(globals, *scene); }; });
}

}  // namespace chainsplat::tools
