// result.cpp - eval, report, export, synth: how good a twin is, and what others can do with it.
#include <algorithm>
#include <iostream>
#include <memory>
#include <nlohmann/json.hpp>

#include "chainsplat/capture.h"
#include "chainsplat/eval.h"
#include "chainsplat/export.h"
#include "chainsplat/json.h"
#include "chainsplat/pipeline.h"
#include "chainsplat/rope.h"
#include "chainsplat/run_folder.h"
#include "chainsplat/synth.h"
#include "cli.h"
#include "command_line.h"

namespace chainsplat::tools {

namespace {

namespace fs = std::filesystem;

struct EvalRequest {
  std::string run, capture, out, picture, frames, lpips;
};

void evaluate(const Globals& globals, const EvalRequest& request) {
  if (!request.out.empty()) pipeline::check_output_file(request.out);
  if (!request.picture.empty()) pipeline::check_output_file(request.picture);
  check_one_wants_standard_output(globals, request.out);
  const pipeline::Evaluation found = pipeline::evaluate(
      request.run, request.capture,
      {capture::read_frame_range(request.frames, "--frames"), request.picture, globals.device, request.lpips},
      terminal());
  const eval::Metrics *recognized = found.recognized ? &*found.recognized : nullptr,
                      *rollout = found.rollout ? &*found.rollout : nullptr;
  const std::string json = pipeline::metrics_json(recognized, rollout);
  if (!request.out.empty()) write_result(request.out, json);
  end_progress();
  if (globals.json) {
    std::cout << json;
    return;
  }
  if (request.out == "-") return;
  std::vector<MetricsRow> rows;
  for (const auto& [name, metrics] : {std::pair("recognized", recognized), std::pair("rollout", rollout)}) {
    if (!metrics) continue;
    for (std::size_t c = 0; c < metrics->cameras.size(); ++c)
      rows.push_back({std::string(name) + " " + metrics->camera_names[c], &metrics->cameras[c]});
    rows.push_back({std::string(name) + " mean", &metrics->mean});
  }
  std::cout << metrics_table(rows);
  if (!request.picture.empty()) std::cout << "picture: " << request.picture << "\n";
}

struct ReportRequest {
  std::string run, out;
  pipeline::ReportOptions options;
  std::string capture, estimate, forces, base;
};

void report(const Globals& globals, const ReportRequest& request) {
  std::vector<std::string> inputs{request.estimate, request.forces, request.base};
  for (const std::string name : pipeline::kRunFiles)  // of them only the page may be written anew
    if (name != pipeline::kReportFile) inputs.push_back((Path(request.run) / name).string());
  check_not_input(request.out, inputs);
  check_one_wants_standard_output(globals, request.out);
  pipeline::check_output_file(request.out);
  pipeline::ReportOptions options = request.options;
  options.capture = request.capture;
  options.estimate = request.estimate;
  options.forces = request.forces;
  options.base = request.base;
  const std::string page = pipeline::report(request.run, options, terminal());
  end_progress();
  write_result(request.out, page);
  if (request.out == "-") return;
  if (globals.json)
    std::cout << core::json_text(nlohmann::ordered_json{{"output", request.out}, {"bytes", page.size()}}, -1) << "\n";
  else
    say("written: " + request.out + ", " + std::to_string(page.size() / 1024) + " KiB; open it in a browser");
}

struct ExportRequest {
  std::string run, states, base, out;
  bool force = false, raw = false, mesh = false, no_pictures = false;
};

void export_twin(const Globals& globals, const ExportRequest& request) {
  const std::vector<Path> files = exports::files(request.out);
  for (const Path& file : files) {
    check_not_input(file.string(), request.run, {request.states, request.base});
    pipeline::check_output_file(file.string());
    std::error_code error;
    if (!request.force && std::filesystem::is_regular_file(file, error))
      throw InputError(file.string(), "is there already", "name another file, or give --force to replace it");
  }
  twin::Twin twin = pipeline::load_twin(request.run);
  if (exports::ending(request.out) == ".npz")
    twin.states.covariance = pipeline::read_covariances(Path(request.run) / pipeline::kCovarianceFile, twin.states);
  const chain::States motion =
      request.states.empty() ? twin.states : twin::read_states(pipeline::input_path(request.states), twin.chain);
  const Path beside = base_beside(request.states);
  const trajectory::Trajectory base = !request.base.empty() ? pipeline::read_base(pipeline::input_path(request.base))
                                      : !beside.empty()     ? pipeline::read_base(beside)
                                                            : pipeline::own_base(request.run);
  exports::Options options;
  options.mesh = request.mesh;
  if (twin.parameters) {
    const dynamics::Model model = dynamics::make_model(twin.chain, *twin.parameters);
    options.properties = twin::properties(twin);
    // a simulator's model starts where `rollout` does
    if (!request.base.empty()) twin.initial = pipeline::rest_state(twin, model, base.pose(base.start()), base.start());
  }
  if (exports::ending(request.out) == ".mcap" && !request.no_pictures) {
    if (const std::optional<capture::Capture> recording = pipeline::own_recording(twin, request.run))
      options.capture = recording->folder;
    else
      core::warn(request.run + ": its capture is not there any more; the recording shows no pictures");
  }
  if (twin.gaussians.count > 0 && exports::for_viewers(request.out)) {
    const std::optional<capture::Capture> recording = pipeline::own_recording(twin, request.run);
    if (recording) options.cameras = recording->cameras;
    if (!request.raw && (recording || twin.gaussians.pixel_footprint > 0.0))
      twin.gaussians = exports::with_low_pass(twin.gaussians, twin.chain, twin.states,
                                              recording ? recording->base : base, options.cameras);
    else if (!request.raw)
      core::warn(request.run +
                 ": its capture is not there any more; the Gaussians are as trained, thin in other viewers");
  }
  exports::write(twin, motion, base, request.out, options);
  if (globals.json) {
    nlohmann::ordered_json document{{"output", request.out}, {"files", nlohmann::ordered_json::array()}};
    for (const Path& file : files) document["files"].push_back(file.string());
    std::cout << core::json_text(document, -1) << "\n";
    return;
  }
  for (const Path& file : files) say("written: " + file.string());
}

struct SynthRequest {
  std::string run, states, base, camera, out;
  bool images = false, force = false;
};

void synthesize(const Globals& globals, const SynthRequest& request) {
  const Path out = request.out;
  pipeline::check_output_folder(out, request.force, "name another folder or give --force to write into it");
  const twin::Twin twin = pipeline::load_twin(request.run);
  pipeline::check_drawable(twin, request.run);
  auto [folder, camera] = split_camera(request.camera);
  if (folder.empty()) {
    if (!twin.provenance.path)
      throw InputError(request.run, "does not say which capture it was made from", "give --camera with a capture");
    folder = (Path(request.run) / *twin.provenance.path).lexically_normal().string();
  }
  capture::LoadOptions load;
  load.images = false;
  load.camera = camera;
  capture::Capture scene = capture::load(folder, load);
  capture::apply(twin.corrections, scene);
  pipeline::check_not_capture(out, scene.folder);
  if (const Path beside = base_beside(request.states); !request.base.empty() || !beside.empty())
    scene.base = pipeline::read_base(request.base.empty() ? beside : pipeline::input_path(request.base));
  const chain::States states = !request.states.empty()
                                   ? twin::read_states(pipeline::input_path(request.states), twin.chain)
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
    std::cout << core::json_text(nlohmann::ordered_json{{"capture", request.out}}, -1) << "\n";
  else
    say("capture: " + request.out);
}

}  // namespace

void add_result_commands(Command app, const Globals& globals, Job& job) {
  Command evaluator = app.add_command("eval", "Measure how well a twin explains a capture");
  auto request = std::make_shared<EvalRequest>();
  evaluator.add_option("RUN", request->run, "Run folder of a twin").required();
  evaluator.add_option("CAPTURE", request->capture, "Its own capture, or another one of the same rope (rollout only)")
      .required();
  evaluator.add_option("-o,--output", request->out, "Also write the metrics as JSON").type_name("FILE.json");
  evaluator.add_option("--frames", request->frames, "Only these frames: from A up to, not including, B")
      .type_name("A:B");
  evaluator.add_option("--picture", request->picture, "Also make a picture: observed beside rendered frames")
      .type_name("FILE.png");
  evaluator.add_option("--lpips", request->lpips, "Also measure LPIPS, with a trunk that tools/lpips_trunk made")
      .type_name("TRUNK.onnx");
  evaluator.callback([&globals, &job, request] { job = [&globals, request] { evaluate(globals, *request); }; });

  Command reporter =
      app.add_command("report", "Show the twin as one page for a browser: replay, verdict, metrics, numbers");
  auto showing = std::make_shared<ReportRequest>();
  reporter.add_option("RUN", showing->run, "Run folder of a twin").required();
  reporter.add_option("-o,--output", showing->out, "Page to write; - is standard output")
      .required()
      .type_name("FILE.html");
  reporter
      .add_option("--video", showing->options.videos, "Cameras whose frames go into the page, small: about 2 MB each")
      .delimiter(',')
      .type_name("CAMERA,...");
  reporter.add_option("--capture", showing->capture, "The twin's own capture, where it has moved").type_name("CAPTURE");
  reporter
      .add_option("--estimate", showing->estimate, "Also what 'estimate' followed, its JSON lines; - is standard input")
      .type_name("FILE.jsonl");
  reporter.add_option("--forces", showing->forces, "The forces that 'force' told from them, its JSON lines")
      .type_name("FORCES.jsonl");
  reporter.add_option("--base", showing->base, "Base motion of the estimates (default: that of the twin's own capture)")
      .type_name("FILE.tum");
  reporter.callback([&globals, &job, showing] { job = [&globals, showing] { report(globals, *showing); }; });

  Command exporter = app.add_command("export", "Write the twin for other programs, by the file's ending");
  auto exporting = std::make_shared<ExportRequest>();
  exporter.add_option("RUN", exporting->run, "Run folder of a twin").required();
  std::string endings;
  for (const std::string& ending : exports::endings()) endings += (endings.empty() ? "" : " ") + ending;
  exporter.add_option("-o,--output", exporting->out, "File to write; its ending says what: " + endings)
      .required()
      .type_name("FILE");
  exporter.add_option("--states", exporting->states, "Motion to write (default: the recognized states)")
      .type_name("STATES.csv");
  exporter
      .add_option("--base", exporting->base,
                  "Its base motion (default: the one kept beside the states, else the capture's own)")
      .type_name("FILE.tum");
  exporter.add_flag("--mesh", exporting->mesh, "In glTF also a skinned tube, for viewers that draw no splats");
  exporter.add_flag("--raw", exporting->raw,
                    "Gaussians as trained, without what our renderer adds on the image and other viewers do not");
  exporter.add_flag("--no-pictures", exporting->no_pictures, "In MCAP without what the capture's cameras saw");
  exporter.add_flag("--force", exporting->force, "Replace files that are there");
  exporter.callback([&globals, &job, exporting] { job = [&globals, exporting] { export_twin(globals, *exporting); }; });

  Command synthesizer = app.add_command("synth", "Draw a capture from a twin: videos, masks, depth, truth");
  auto scene = std::make_shared<SynthRequest>();
  synthesizer.add_option("RUN", scene->run, "Run folder of a twin").required();
  synthesizer.add_option("-o,--output", scene->out, "Capture folder to make").required().type_name("CAPTURE");
  synthesizer.add_option("--states", scene->states, "Motion to draw (default: the rollout, else the recognized states)")
      .type_name("STATES.csv");
  synthesizer
      .add_option("--camera", scene->camera, "Whose cameras, base motion and table (default: the twin's own capture)")
      .type_name("CAPTURE[:NAME]");
  synthesizer
      .add_option("--base", scene->base,
                  "Base motion (default: the one kept beside the states, else that of the capture)")
      .type_name("FILE.tum");
  synthesizer.add_flag("--images", scene->images, "Images without loss instead of videos");
  synthesizer.add_flag("--force", scene->force, "Write into a folder that is not empty");
  synthesizer.callback([&globals, &job, scene] { job = [&globals, scene] { synthesize(globals, *scene); }; });
}

}  // namespace chainsplat::tools
