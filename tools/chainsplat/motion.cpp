// motion.cpp - rollout and render: a twin set in motion, and drawn.
#include <CLI/CLI.hpp>
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <iostream>
#include <memory>
#include <nlohmann/json.hpp>
#include <optional>

#include "chainsplat/capture.h"
#include "chainsplat/dynamics/base_wrench.h"
#include "chainsplat/encode.h"
#include "chainsplat/layout.h"
#include "chainsplat/pipeline.h"
#include "chainsplat/render.h"
#include "chainsplat/run_folder.h"
#include "chainsplat/twin.h"
#include "cli.h"

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
  if (!request.base.empty()) options.base = input_path(request.base);
  if (!request.initial.empty()) options.initial = input_path(request.initial);
  options.rate = request.rate;
  options.check();
  if (globals.json && (request.out == "-" || request.centerline == "-" || request.wrench == "-"))
    throw InputError("--json", "standard output is wanted by '-' too", "name a file");
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
  std::cout << document.dump(1, ' ', false, Json::error_handler_t::replace) << "\n";
}

struct RenderRequest {
  std::string run, states, base, camera, out, layout = "drawn";
  bool mask = false, depth = false, undistorted = false, force = false;
};

std::string frame_name(int frame, const char* ending) {
  char text[64];
  std::snprintf(text, sizeof text, "%06d%s", frame, ending);
  return text;
}

// The camera's times and, as a motion of its own may be longer than the recording, as many more at its rate. A motion
// at quite other times is drawn from its beginning on.
std::vector<double> frame_times(const std::vector<double>& recorded, const chain::States& states) {
  constexpr double kRate = 30.0;  // frames per second, for a camera of one frame
  const double known = render::median_interval(recorded), interval = known > 0.0 ? known : 1.0 / kRate;
  const bool any = std::any_of(recorded.begin(), recorded.end(),
                               [&](double time) { return render::covered(states, time, interval); });
  std::vector<double> times = any ? recorded : std::vector<double>{states.time.front()};
  const double last = times.back();
  for (int k = 1; static_cast<int>(times.size()) < capture::kMostFrames; ++k) {
    const double time = last + k * interval;
    if (time > states.time.back() + 1e-9) break;
    times.push_back(time);
  }
  return times;
}

// What a camera recorded, read in parts, so that a recording may be long.
class Recorded {
 public:
  // `frames`: that may be asked for, from the first on.
  Recorded(Path capture, const capture::Camera& camera, std::size_t frames)
      : capture_(std::move(capture)), frames_(static_cast<int>(frames)), at_once_(capture::frames_at_once({camera})) {
    load_.undistort = false, load_.masked = false, load_.camera = camera.name;
  }
  // RGB; empty where there is none. Frames are asked for in order.
  capture::Image8 at(int frame) {
    if (frame >= frames_) return {};
    if (views_.empty() || frame >= load_.last) {
      load_.first = frame, load_.last = std::min(frames_, frame + at_once_);
      views_.clear();
      views_ = capture::load(capture_, load_).views;
    }
    return capture::rgb(views_[frame - load_.first]);
  }

 private:
  Path capture_;
  capture::LoadOptions load_;
  std::vector<capture::View> views_;
  int frames_, at_once_;
};

void render(const Globals& globals, const RenderRequest& request) {
  const Path out = request.out;
  const bool video = out.extension() == ".mp4";
  const render::Layout layout = render::read_layout(request.layout);
  if (layout != render::Layout::drawn && request.undistorted)
    throw InputError("--undistorted", "what was recorded has the lens distortion", "leave it or --layout out");
  const auto [folder, camera_name] = split_camera(request.camera);
  if (video) {
    pipeline::check_output_file(request.out);
    if (request.mask || request.depth)
      throw InputError("--mask, --depth", "go with a folder of frames, not with a video",
                       "let -o end in another way than .mp4");
  } else {
    pipeline::check_output_folder(out, request.force, "name another folder or give --force to write into it");
  }
  const twin::Twin twin = pipeline::load_twin(request.run);
  pipeline::check_drawable(twin, request.run);
  const chain::States states =
      request.states.empty() ? twin.states : twin::read_states(input_path(request.states), twin.chain.angles());
  capture::LoadOptions load;
  load.images = false;
  load.camera = camera_name;
  capture::Capture capture = capture::load(folder, load);
  capture::apply(twin.corrections, capture);
  // states of a motion of their own bring its base with them
  const Path beside = base_beside(request.states);
  const bool own_base = !request.base.empty() || !beside.empty();
  const trajectory::Trajectory base = !request.base.empty() ? pipeline::read_base(input_path(request.base))
                                      : !beside.empty()     ? pipeline::read_base(beside)
                                                            : capture.base;
  if (!request.states.empty() && !own_base)
    core::warn(request.states + ": no base motion lies beside it; that of " + folder + " is taken");
  std::vector<std::size_t> recorded;  // how many of a camera's times are those of its frames
  for (std::vector<double>& times : capture.times) {
    const std::vector<double> own = times;
    if (own_base) times = frame_times(own, states);
    recorded.push_back(times.front() == own.front() ? own.size() : 0);
  }
  if (video && capture.cameras.size() != 1)
    throw InputError(request.camera, "has " + std::to_string(capture.cameras.size()) + " cameras and a video shows one",
                     "name it, for example " + folder + ":" + capture.cameras.front().name);
  if (!video) {
    pipeline::check_not_capture(out, capture.folder);
    for (const capture::Camera& camera : capture.cameras)
      pipeline::check_output_folder(out / camera.name, true, "");  // may be a file
  }
  // before the first camera's frames are written
  for (std::size_t c = 0; c < capture.cameras.size(); ++c) {
    const double interval = render::median_interval(capture.times[c]);
    if (std::none_of(capture.times[c].begin(), capture.times[c].end(),
                     [&](double time) { return render::covered(states, time, interval); }))
      throw InputError(request.states.empty() ? request.run : request.states,
                       "covers none of the times of " + capture.cameras[c].name, "give states at the camera's times");
  }
  const gpu::DevicePtr device = gpu::open_device({.selector = globals.device});
  splat::Engine engine(*device);
  render::Options options;
  options.depth = request.depth;
  options.undistorted = request.undistorted;

  Json document;
  document["output"] = request.out;
  std::size_t total = 0;
  for (std::size_t c = 0; c < capture.cameras.size(); ++c) {
    const capture::Camera& camera = capture.cameras[c];
    const std::vector<double>& times = capture.times[c];
    const double interval = render::median_interval(times);
    const auto count =
        std::count_if(times.begin(), times.end(), [&](double time) { return render::covered(states, time, interval); });
    const Path stem = out / camera.name;
    std::optional<capture::VideoWriter> movie;
    if (video)
      movie.emplace(out, times.size() > 1 ? double(times.size() - 1) / (times.back() - times.front()) : 30.0);
    else
      core::make_folder(stem);
    Recorded seen(folder, camera, layout == render::Layout::drawn ? 0 : recorded[c]);
    std::size_t written = 0;
    const auto write = [&](std::vector<render::Frame>& batch) {
      for (const render::Frame& frame : batch) {
        const double share = static_cast<double>(frame.frame) / std::max<std::size_t>(1, times.size() - 1);
        const capture::Image8 picture = render::laid_out(layout, frame, camera, seen.at(frame.frame), share);
        if (movie)
          movie->add(picture);
        else
          capture::write_png(stem / frame_name(frame.frame, ".png"), picture);
        if (request.mask)
          capture::write_png(stem / frame_name(frame.frame, ".mask.png"), render::mask_image(frame, camera));
        if (request.depth)
          capture::write_depth_exr(stem / frame_name(frame.frame, ".depth.exr"), camera.width, camera.height,
                                   render::depth_image(frame, camera));
        core::report({"write " + camera.name, static_cast<std::int64_t>(++written), count, NAN, NAN, ""});
      }
    };
    render::for_batches(engine, twin.gaussians, twin.chain, states, base, camera, static_cast<int>(c), times, options,
                        write);
    if (movie) movie->finish();
    total += written;
    document["cameras"][camera.name] = written;
  }
  if (globals.json)
    std::cout << document.dump(1, ' ', false, Json::error_handler_t::replace) << "\n";
  else
    say(std::to_string(total) + " frames: " + request.out);
}

}  // namespace

void add_motion_commands(CLI::App& app, const Globals& globals, Job& job) {
  CLI::App* roller = app.add_subcommand("rollout", "Set the twin in motion under a base trajectory");
  auto request = std::make_shared<RolloutRequest>();
  roller->add_option("RUN", request->run, "Run folder of an identified twin")->required();
  roller
      ->add_option("--base", request->base,
                   "Base motion, 'timestamp tx ty tz qx qy qz qw' a line (default: the capture's own)")
      ->type_name("FILE.tum");
  roller->add_option("-o,--output", request->out, "States to write; - is standard output")
      ->required()
      ->type_name("STATES.csv");
  roller->add_option("--rate", request->rate, "Rows a second (default 30)")->type_name("HZ");
  roller
      ->add_option("--centerline", request->centerline, "Also write the world points of the grasp, joints and free end")
      ->type_name("FILE.csv");
  roller
      ->add_option(
          "--wrench", request->wrench,
          "Also write what the gripper exerts on the rope: force, and moment about the grasp; N, N m, world axes")
      ->type_name("FILE.csv");
  roller
      ->add_option("--initial", request->initial,
                   "Start from its first row (default: the identified state; with --base at rest), or from the state\n"
                   "that fits the first half second of a file of markers")
      ->type_name("FILE.csv");
  roller->callback([&globals, &job, request] { job = [&globals, request] { rollout(globals, *request); }; });

  CLI::App* renderer = app.add_subcommand("render", "Draw the twin through the cameras of a capture");
  auto drawing = std::make_shared<RenderRequest>();
  renderer->add_option("RUN", drawing->run, "Run folder of a twin")->required();
  renderer->add_option("--states", drawing->states, "Motion to draw (default: the recognized states)")
      ->type_name("STATES.csv");
  renderer->add_option("--camera", drawing->camera, "Whose cameras; with :NAME only that one")
      ->required()
      ->type_name("CAPTURE[:NAME]");
  renderer->add_option("-o,--output", drawing->out, "Folder for CAMERA/000000.png ..., or a video that ends in .mp4")
      ->required()
      ->type_name("OUT");
  renderer
      ->add_option("--base", drawing->base,
                   "Base motion (default: the one kept beside the states, else that of --camera's capture)")
      ->type_name("FILE.tum");
  renderer->add_flag("--mask", drawing->mask, "Also 000000.mask.png: 255 where the rope covers half or more");
  renderer->add_flag("--depth", drawing->depth, "Also 000000.depth.exr: meters along the optical axis, 0 = none");
  renderer
      ->add_option("--layout", drawing->layout,
                   "drawn (default), or on what the camera recorded: side-by-side, overlay, wipe, outline, error")
      ->type_name("NAME");
  renderer->add_flag("--undistorted", drawing->undistorted, "Leave the lens distortion out");
  renderer->add_flag("--force", drawing->force, "Write into a folder that is not empty");
  renderer->callback([&globals, &job, drawing] { job = [&globals, drawing] { render(globals, *drawing); }; });
}

}  // namespace chainsplat::tools
