// motion.cpp - rollout and render: a twin set in motion, and drawn.
#include <iostream>
#include <memory>
#include <nlohmann/json.hpp>

#include "chainsplat/draw.h"
#include "chainsplat/dynamics/base_wrench.h"
#include "chainsplat/json.h"
#include "chainsplat/pipeline.h"
#include "chainsplat/run_folder.h"
#include "chainsplat/twin.h"
#include "cli.h"
#include "command_line.h"

namespace chainsplat::tools {

namespace {

namespace fs = std::filesystem;
using Json = nlohmann::ordered_json;

struct RolloutRequest {
  std::string run, base, out, centerline, wrench, initial;
  double rate = 30.0;
};

// Where the base motion of states goes, so that nobody draws them under another one; empty for a stream.
Path base_file_of(const std::string& states) {
  std::error_code error;
  if (states == "-" || (fs::exists(states, error) && !fs::is_regular_file(states, error))) return {};
  return Path(states).replace_extension(".base.tum");
}

std::string wrench_csv(const std::vector<double>& times, const std::vector<math::Vector6>& wrenches) {
  std::string out = "time,fx,fy,fz,mx,my,mz\n";
  for (std::size_t i = 0; i < times.size(); ++i) {
    out += core::exact(times[i]);
    for (const int k : {3, 4, 5, 0, 1, 2}) out += "," + core::exact(wrenches[i][k]);
    out += "\n";
  }
  return out;
}

void rollout(const Globals& globals, const RolloutRequest& request) {
  pipeline::RolloutOptions options;
  if (!request.base.empty()) options.base = pipeline::input_path(request.base);
  if (!request.initial.empty()) options.initial = pipeline::input_path(request.initial);
  options.rate = request.rate;
  options.check();
  for (const std::string& out : {request.out, request.centerline, request.wrench})
    check_one_wants_standard_output(globals, out);
  pipeline::check_output_file(request.out);
  for (const std::string& out : {request.centerline, request.wrench})
    if (!out.empty()) pipeline::check_output_file(out);
  for (const std::string& out : {request.out, request.centerline, request.wrench})
    if (!out.empty()) check_not_input(out, request.run, {request.base, request.initial});
  const auto [twin, base, states] = pipeline::rollout(request.run, options, terminal());
  write_result(request.out, twin::states_csv(states));
  const Path kept_base = base_file_of(request.out);
  if (!kept_base.empty()) core::write_file(kept_base, trajectory::write_tum(base.samples()));
  if (!request.centerline.empty()) write_result(request.centerline, twin::centerline_csv(twin.chain, states, base));
  if (!request.wrench.empty()) {
    const dynamics::Model model = dynamics::make_model(twin.chain, *twin.parameters);
    write_result(request.wrench, wrench_csv(states.time, dynamics::base_wrenches(model, base, states)));
    if (!twin.known_mass) core::warn(request.run + ": the rope's mass is not known; wrenches are per kilogram of rope");
  }
  if (!globals.json) {
    say(std::to_string(states.time.size()) + " rows" + (request.out == "-" ? "" : ": " + request.out));
    return;
  }
  Json document;
  document["states"] = request.out;
  if (!kept_base.empty()) document["base"] = kept_base.string();
  if (!request.centerline.empty()) document["centerline"] = request.centerline;
  if (!request.wrench.empty()) document["wrench"] = request.wrench;
  document["rows"] = states.time.size();
  document["start"] = states.time.front();
  document["end"] = states.time.back();
  std::cout << core::json_text(document) << "\n";
}

struct RenderRequest {
  std::string run, states, base, camera, out, layout = "drawn";
  bool mask = false, depth = false, undistorted = false, force = false;
};

void render(const Globals& globals, const RenderRequest& request) {
  pipeline::DrawOptions options;
  options.output = request.out;
  options.layout = render::read_layout(request.layout);
  options.mask = request.mask;
  options.depth = request.depth;
  options.undistorted = request.undistorted;
  options.force = request.force;
  options.device = globals.device;
  const auto [folder, camera] = split_camera(request.camera);
  options.camera = camera;
  options.states = request.states;
  // states of a motion of their own bring its base with them
  options.base = request.base.empty() ? base_beside(request.states) : pipeline::input_path(request.base);
  const pipeline::DrawResult result = pipeline::draw(request.run, folder, options, terminal());
  int total = 0;
  Json document;
  document["output"] = request.out;
  for (const auto& [name, frames] : result.frames) {
    total += frames;
    document["cameras"][name] = frames;
  }
  if (globals.json)
    std::cout << core::json_text(document) << "\n";
  else
    say(std::to_string(total) + " frames: " + request.out);
}

}  // namespace

void add_motion_commands(Command app, const Globals& globals, Job& job) {
  Command roller = app.add_command("rollout", "Set the twin in motion under a base trajectory");
  auto request = std::make_shared<RolloutRequest>();
  roller.add_option("RUN", request->run, "Run folder of an identified twin").required();
  roller
      .add_option("--base", request->base,
                  "Base motion, 'timestamp tx ty tz qx qy qz qw' a line (default: the capture's own)")
      .type_name("FILE.tum");
  roller.add_option("-o,--output", request->out, "States to write; - is standard output")
      .required()
      .type_name("STATES.csv");
  roller.add_option("--rate", request->rate, "Rows a second (default 30)").type_name("HZ");
  roller
      .add_option("--centerline", request->centerline, "Also write the world points of the grasp, joints and free end")
      .type_name("FILE.csv");
  roller
      .add_option(
          "--wrench", request->wrench,
          "Also write what the gripper exerts on the rope: force, and moment about the grasp; N, N m, world axes")
      .type_name("FILE.csv");
  roller
      .add_option("--initial", request->initial,
                  "Start from its first row (default: the identified state; with --base at rest), or from the state\n"
                  "that fits the first half second of a file of markers")
      .type_name("FILE.csv");
  roller.callback([&globals, &job, request] { job = [&globals, request] { rollout(globals, *request); }; });

  Command renderer = app.add_command("render", "Draw the twin through the cameras of a capture");
  auto drawing = std::make_shared<RenderRequest>();
  renderer.add_option("RUN", drawing->run, "Run folder of a twin").required();
  renderer.add_option("--states", drawing->states, "Motion to draw (default: the recognized states)")
      .type_name("STATES.csv");
  renderer.add_option("--camera", drawing->camera, "Whose cameras; with :NAME only that one")
      .required()
      .type_name("CAPTURE[:NAME]");
  renderer.add_option("-o,--output", drawing->out, "Folder for CAMERA/000000.png ..., or a video that ends in .mp4")
      .required()
      .type_name("OUT");
  renderer
      .add_option("--base", drawing->base,
                  "Base motion (default: the one kept beside the states, else that of --camera's capture)")
      .type_name("FILE.tum");
  renderer.add_flag("--mask", drawing->mask, "Also 000000.mask.png: 255 where the rope covers half or more");
  renderer.add_flag("--depth", drawing->depth, "Also 000000.depth.exr: meters along the optical axis, 0 = none");
  renderer
      .add_option("--layout", drawing->layout,
                  "drawn (default), or on what the camera recorded: side-by-side, overlay, wipe, outline, error")
      .type_name("NAME");
  renderer.add_flag("--undistorted", drawing->undistorted, "Leave the lens distortion out");
  renderer.add_flag("--force", drawing->force, "Write into a folder that is not empty");
  renderer.callback([&globals, &job, drawing] { job = [&globals, drawing] { render(globals, *drawing); }; });
}

}  // namespace chainsplat::tools
