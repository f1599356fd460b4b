// train.cpp - train, recognize: a twin from a capture.
#include <iostream>
#include <memory>
#include <nlohmann/json.hpp>

#include "chainsplat/json.h"
#include "chainsplat/pipeline.h"
#include "chainsplat/properties.h"
#include "chainsplat/run_folder.h"
#include "chainsplat/solve_json.h"
#include "chainsplat/twin_json.h"
#include "cli.h"
#include "command_line.h"

namespace chainsplat::tools {

namespace {

using Json = nlohmann::ordered_json;

struct TrainRequest {
  std::string capture, out, picture;
  std::string stages;  // empty: all
  std::string joints = "auto", bending = "auto", mode = "fast", paper, frames;
  pipeline::TrainOptions options;
};

pipeline::TrainOptions options_of(const TrainRequest& request, const Globals& globals) {
  pipeline::TrainOptions options = request.options;
  pipeline::set(options, "joints", request.joints, "`joints`");
  pipeline::set(options, "bending", request.bending, "`bending`");
  pipeline::set(options, "mode", request.mode, "`mode`");
  pipeline::set(options, "paper", request.paper, "`paper`");
  pipeline::set(options, "stages", request.stages, "`stages`");
  pipeline::set(options, "frames", request.frames, "`frames`");
  options.picture = request.picture;
  options.seed = globals.seed;
  options.device = globals.device;
  return options;
}

Json summary_json(const pipeline::TrainResult& result, const std::string& run) {
  const twin::Twin& twin = result.twin;
  Json document;
  document["run"] = run;
  document["capture"] = twin.provenance.capture;
  document["frames"] = twin.states.time.size();
  document["joints"] = twin.chain.links() - 1;
  document["angles"] = twin.chain.angles();
  document["gaussians"] = twin.gaussians.count;
  for (const auto& [name, metrics] :
       {std::pair("recognized", &result.recognized), std::pair("rollout", &result.rollout)})
    if (*metrics) document[name] = Json::parse(eval::to_json(**metrics))["mean"];
  for (const auto& [stage, summary] : result.fits) document["solver"][stage] = summary;
  document["seconds"] = twin.provenance.seconds;
  if (!twin.corrections.empty() || !twin.verdict.empty()) {
    document["verdict"] = twin::to_json(twin.verdict);
    document["trusted"] = twin.trusted();
  }
  return document;
}

void train(const Globals& globals, const TrainRequest& request) {
  const pipeline::TrainOptions options = options_of(request, globals);
  watch_signals();
  const pipeline::TrainResult result = pipeline::train(request.capture, request.out, options, terminal());
  end_progress();
  if (globals.json) {
    std::cout << core::json_text(summary_json(result, Path(request.out).string())) << "\n";
    return;
  }
  std::vector<MetricsRow> rows;
  if (result.recognized) rows.push_back({"recognized", &result.recognized->mean});
  if (result.rollout) rows.push_back({"rollout", &result.rollout->mean});
  if (!rows.empty()) std::cout << metrics_table(rows);
  if (const twin::Twin& twin = result.twin; twin.parameters) std::cout << twin::describe(twin::properties(twin));
  std::cout << "twin: " << request.out << "\nreport: " << (Path(request.out) / pipeline::kReportFile).string() << "\n";
  for (const capture::Finding& finding : result.twin.verdict) std::cout << core::printable(finding.text) << "\n";
  if (!request.picture.empty() && result.recognized) std::cout << "picture: " << request.picture << "\n";
}

void add_recognition_options(Command command, TrainRequest& request) {
  pipeline::TrainOptions& options = request.options;
  command.add_option("CAPTURE", request.capture, "The capture's folder or its capture.json").required();
  command.add_option("-o,--output", request.out, "Run folder to make: the twin").required().type_name("RUN");
  command.add_flag("--force", options.force, "Begin again in a run folder that is not empty");
  command.add_flag("--resume", options.resume, "Continue in a run folder that was left unfinished");
  command
      .add_option("--joints", request.joints,
                  "Joints along the rope, 1 to 64 (default: 8, 12, 16 or 24, as many as its bends ask for)")
      .type_name("N|auto");
  command
      .add_option(
          "--bending", request.bending,
          "Axes a joint: planar (one), spatial (two) or auto (default: planar on a table; in free space spatial\n"
          "unless the rope hardly leaves its plane)")
      .one_of({"auto", "planar", "spatial"})
      .type_name("KIND");
  command.add_flag("--twist", options.twist, "Also a twist axis a joint");
  command.add_option("--every", options.every, "Train the Gaussians on every N-th frame (default 5)")
      .positive()
      .type_name("N");
  command.add_option("--frames", request.frames, "Only these frames: from A up to, not including, B").type_name("A:B");
  command.add_option("--mode", request.mode, "fast (default) or paper: the paper's own procedure, slow")
      .one_of({"fast", "paper"})
      .type_name("MODE");
  command
      .add_option("--fixed", options.fixed,
                  "Take as given what is else corrected, with commas: cameras, focal, time, length, diameter, grasp, "
                  "table, masks, colors, or all")
      .delimiter(',')
      .type_name("LIST");
  command
      .add_option("--paper", request.paper,
                  "Of --mode paper, to see what it does: background=black|white|random, growth=no,\n"
                  "resets=none|opacity|links|both, gaussians=N, iterations=N")
      .type_name("LIST");
  command.add_flag("--anyway", options.anyway,
                   "Go on where check names a mistake in the capture; do not trust the twin");
}

}  // namespace

void add_training_commands(Command app, const Globals& globals, Job& job) {
  Command trainer = app.add_command("train", "Make a twin from a capture: recognize, identify, roll out, evaluate");
  auto request = std::make_shared<TrainRequest>();
  add_recognition_options(trainer, *request);
  trainer.add_option("--stages", request->stages, "Only these, by comma: recognize,identify,rollout,evaluate")
      .type_name("LIST");
  trainer.add_flag("--joint", request->options.joint,
                   "Refine angles, Gaussians and dynamics together: helps where a single camera hardly sees depth");
  trainer.add_option("--picture", request->picture, "Also make a picture: observed beside rendered frames")
      .type_name("FILE.png");
  trainer.callback([&globals, &job, request] { job = [&globals, request] { train(globals, *request); }; });

  Command recognizer = app.add_command("recognize", "The first stage of train alone: Gaussians and angles from images");
  auto recognition = std::make_shared<TrainRequest>();
  add_recognition_options(recognizer, *recognition);
  recognizer.callback([&globals, &job, recognition] {
    recognition->stages = "recognize";
    job = [&globals, recognition] { train(globals, *recognition); };
  });
}

}  // namespace chainsplat::tools
