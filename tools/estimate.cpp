// estimate.cpp - a rope followed frame by frame: one JSON line a frame on standard output, flushed.
#include <CLI/CLI.hpp>
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <functional>
#include <iostream>
#include <memory>
#include <nlohmann/json.hpp>

#include "chainsplat/capture.h"
#include "chainsplat/estimation.h"
#include "chainsplat/twin.h"
#include "cli.h"
#include "run_folder.h"

namespace chainsplat::tools {

namespace {

using Json = nlohmann::json;

constexpr int kBlack = 16;         // brightness up to which a pixel of a masked video is background (lossy coding)
constexpr int kMargin = 24;        // px about what a frame shows
constexpr double kTogether = 0.5;  // of a frame's interval: frames of several cameras nearer than that are one moment

struct EstimateRequest {
  std::string run, camera, calibration, base, frames, centerline;
  int drop = 1;
  double rate = 0.0;
};

// Frames one after the other; false at the end.
using Source = std::function<bool(std::vector<capture::View>& views)>;

// A camera object as in capture.json.
capture::Camera read_calibration(const std::string& file, double& rate, double& start) {
  Json object;
  try {
    object = Json::parse(core::read_file(file));
  } catch (const Json::exception&) {
    throw InputError(file, "is no JSON document", "give a camera object as in capture.json");
  }
  if (object.contains("cameras") && object["cameras"].is_array() && object["cameras"].size() == 1)
    object = object["cameras"][0];
  capture::Camera camera;
  const auto number = [&](const char* key) {
    if (!object.contains(key) || !object[key].is_number())
      throw InputError(file + ": " + key, "is missing or no number", "give a camera object as in capture.json");
    return object[key].get<double>();
  };
  camera.name = object.value("name", std::string("camera"));
  camera.width = static_cast<int>(number("width"));
  camera.height = static_cast<int>(number("height"));
  camera.fx = number("fx"), camera.fy = number("fy"), camera.cx = number("cx"), camera.cy = number("cy");
  if (camera.width <= 0 || camera.height <= 0 || !(camera.fx > 0.0) || !(camera.fy > 0.0))
    throw InputError(file, "width, height, fx and fy must be above 0", "correct them");
  const auto list = [&](const char* key, std::size_t size) {
    const bool good = object.contains(key) && object[key].is_array() && object[key].size() == size &&
                      std::all_of(object[key].begin(), object[key].end(), [](const Json& x) { return x.is_number(); });
    if (!good)
      throw InputError(file + ": " + key, "is no list of " + std::to_string(size) + " numbers",
                       "give a camera object as in capture.json");
    return object[key].get<std::vector<double>>();
  };
  if (object.contains("distortion")) {
    const std::vector<double> distortion = list("distortion", 5);
    std::copy(distortion.begin(), distortion.end(), camera.distortion.begin());
  }
  const std::vector<double> pose = list("world_from_camera", 16);
  math::Matrix3 rotation;
  for (int r = 0; r < 3; ++r) {
    for (int c = 0; c < 3; ++c) rotation(r, c) = pose[4 * r + c];
    camera.world_from_camera.translation[r] = pose[4 * r + 3];
  }
  camera.world_from_camera.rotation = math::orthonormalized(rotation);
  if (object.contains("rate")) rate = number("rate");
  if (object.contains("start")) start = number("start");
  return camera;
}

// What is not black in a frame, undistorted and cropped.
capture::View masked_view(const capture::Image8& image, const capture::Camera& camera) {
  std::vector<std::uint8_t> mask(static_cast<std::size_t>(camera.width) * camera.height, 0);
  const bool distorted = camera.distorted();
  int x0 = camera.width, y0 = camera.height, x1 = 0, y1 = 0;
  for (int y = 0; y < camera.height; ++y)
    for (int x = 0; x < camera.width; ++x) {
      int u = x, v = y;
      if (distorted) {
        const math::Vector2 from = capture::distort(camera, math::Vector2(x + 0.5, y + 0.5));
        u = static_cast<int>(std::floor(from.x())), v = static_cast<int>(std::floor(from.y()));
        if (u < 0 || v < 0 || u >= camera.width || v >= camera.height) continue;
      }
      const std::uint8_t* const rgb = &image.pixels[3 * (static_cast<std::size_t>(v) * camera.width + u)];
      if (std::max({rgb[0], rgb[1], rgb[2]}) <= kBlack) continue;
      mask[static_cast<std::size_t>(y) * camera.width + x] = 255;
      x0 = std::min(x0, x), x1 = std::max(x1, x + 1), y0 = std::min(y0, y), y1 = y + 1;
    }
  capture::View view;
  if (x1 <= x0) return view;
  view.x0 = std::max(0, x0 - kMargin), view.y0 = std::max(0, y0 - kMargin);
  view.width = std::min(camera.width, x1 + kMargin) - view.x0;
  view.height = std::min(camera.height, y1 + kMargin) - view.y0;
  view.rgba.assign(4 * static_cast<std::size_t>(view.width) * view.height, 0);
  for (int y = 0; y < view.height; ++y)
    for (int x = 0; x < view.width; ++x)
      view.rgba[4 * (static_cast<std::size_t>(y) * view.width + x) + 3] =
          mask[static_cast<std::size_t>(view.y0 + y) * camera.width + view.x0 + x];
  return view;
}

// Raw RGB24 from standard input; an incomplete last frame ends the work.
bool read_raw(const capture::Camera& camera, capture::Image8& image) {
  image.width = camera.width, image.height = camera.height, image.channels = 3;
  image.pixels.resize(3 * static_cast<std::size_t>(camera.width) * camera.height);
  const std::size_t got = std::fread(image.pixels.data(), 1, image.pixels.size(), stdin);
  if (got == image.pixels.size()) return true;
  if (got != 0)
    throw WorkError("standard input", "ends within a frame",
                    "send whole frames of the calibration's size; the states so far are kept");
  return false;
}

void estimate(const Globals& globals, const EstimateRequest& request) {
  if (globals.json)
    throw InputError("--json", "estimate writes one JSON line a frame, not one document", "leave it out");
  if (request.drop < 1) throw InputError("--drop", "must be 1 or more", "give 2 for every second frame");
  if (!request.centerline.empty()) check_output_file(request.centerline);
  if (request.centerline == "-")
    throw InputError("--centerline", "standard output is for the estimates", "name a file");
  const auto [first, last] = parse_frames(request.frames);
  const twin::Twin twin = load_twin(request.run);
  if (!twin.parameters)
    core::warn(request.run + ": its dynamics are not identified; angles are assumed to go on at constant rate");

  std::vector<capture::Camera> cameras;
  trajectory::Trajectory base;
  Source source;
  capture::Capture recorded;  // the source reads them as long as the work goes on
  std::unique_ptr<capture::VideoReader> reader;
  if (request.calibration.empty()) {
    const auto [folder, name] = split_camera(request.camera);
    capture::LoadOptions load;
    load.camera = name;
    load.first = first;
    load.last = last;
    recorded = capture::load(folder, load);
    cameras = recorded.cameras;
    base = request.base.empty() ? recorded.base : read_base(request.base);
    source = [&, at = std::size_t{0}](std::vector<capture::View>& views) mutable {
      // the first camera sets the pace, the others' nearest frames join
      if (at >= recorded.views.size() || recorded.views[at].camera != 0) return false;
      const capture::View& leader = recorded.views[at++];
      views.assign(1, leader);
      const std::vector<double>& times = recorded.times[0];
      const double interval = times.size() > 1 ? (times.back() - times.front()) / (times.size() - 1.0) : 0.0;
      for (int c = 1; c < static_cast<int>(cameras.size()); ++c) {
        const capture::View* nearest = nullptr;
        for (const capture::View& view : recorded.views)
          if (view.camera == c && std::abs(view.time - leader.time) <= kTogether * interval &&
              (!nearest || std::abs(view.time - leader.time) < std::abs(nearest->time - leader.time)))
            nearest = &view;
        if (nearest) views.push_back(*nearest);
      }
      return true;
    };
  } else {
    double rate = request.rate, start = 0.0;
    double file_rate = 0.0;
    cameras = {read_calibration(request.calibration, file_rate, start)};
    if (rate <= 0.0) rate = file_rate;
    if (request.camera != "-") {
      if (rate <= 0.0) rate = capture::video_facts(request.camera).rate;
      reader = std::make_unique<capture::VideoReader>(request.camera);
    }
    if (!(rate > 0.0) || !std::isfinite(rate))
      throw InputError("--rate", "is needed to know the frames' times", "give frames a second, for example 30");
    if (!request.base.empty()) {
      base = read_base(request.base);
    } else {
      const trajectory::Trajectory own = own_base(request.run);
      base = trajectory::fit({{own.start(), own.pose(own.start())}}, request.run);
      core::warn("--base: is missing; the base is assumed to rest where the twin's capture began");
    }
    source = [&, rate, start, first_frame = first, last_frame = last, frame = 0,
              image = capture::Image8{}](std::vector<capture::View>& views) mutable {
      do {
        if (last_frame >= 0 && frame >= last_frame) return false;
        if (!(reader ? reader->next(image) : read_raw(cameras[0], image))) return false;
        if (image.width != cameras[0].width || image.height != cameras[0].height)
          throw InputError(request.camera,
                           "frames are " + std::to_string(image.width) + "x" + std::to_string(image.height) +
                               " pixels, the calibration says " + std::to_string(cameras[0].width) + "x" +
                               std::to_string(cameras[0].height),
                           "give the calibration of this camera");
      } while (frame++ < first_frame);
      views.assign(1, {});
      views[0] = masked_view(image, cameras[0]);
      views[0].frame = frame - 1;
      views[0].time = start + (frame - 1) / rate;
      return true;
    };
  }

  const double base_start = base.start(), base_end = base.end();
  const bool base_moves = base.samples().size() > 1;
  estimation::Filter filter = estimation::start(
      twin, cameras, [&](double time) { return base.at(time); }, base_start);
  chain::States states;
  std::vector<capture::View> views;
  int count = 0, lost = 0, read = 0;
  const auto keep = [&] {
    if (!request.centerline.empty() && !states.time.empty())
      write_result(request.centerline, twin::centerline_csv(twin.chain, states, base));
  };
  try {
    while (source(views)) {
      const double begun = core::seconds_now();
      if (read++ % request.drop != 0) continue;
      if (core::stop_requested()) throw Interrupted(core::stop_requested());
      const double slack = 1.0 / 30.0;  // s, a frame beyond the last sample
      if (base_moves && views[0].time > base_end + slack)
        throw WorkError(
            request.base.empty() ? request.camera : request.base,
            "the base motion ends at " + core::exact(base_end) + " s, before frame " + std::to_string(views[0].frame),
            "give a base motion as long as the frames; the states so far are kept");
      std::vector<const capture::View*> pointers;
      for (const capture::View& view : views) pointers.push_back(&view);
      const estimation::Estimate e = estimation::update(filter, pointers);
      std::cout << estimation::to_json(e, core::seconds_now() - begun) << "\n" << std::flush;
      if (!std::cout) throw WorkError("standard output", "writing failed", "make room or read on");
      states.time.push_back(e.time);
      states.theta.push_back(e.theta);
      states.thetadot.push_back(e.thetadot);
      ++count;
      lost += e.lost;
    }
  } catch (const InputError& error) {
    keep();
    if (count == 0) throw;
    // work has begun: what exists is kept, and the exit code says so
    throw WorkError(request.camera, error.what(), "the states so far are kept");
  } catch (...) {
    keep();
    throw;
  }
  keep();
  if (count == 0) throw InputError(request.camera, "has no frame", "name a camera that recorded something");
  say(std::to_string(count) + " frames" + (lost ? ", lost in " + std::to_string(lost) : "") + ".");
}

}  // namespace

void add_estimation_commands(CLI::App& app, const Globals& globals, Job& job) {
  CLI::App* command = app.add_subcommand("estimate", "Follow the rope: one JSON line a frame on standard output");
  auto request = std::make_shared<EstimateRequest>();
  command->add_option("RUN", request->run, "Run folder of a twin")->required();
  command
      ->add_option("--camera", request->camera,
                   "CAPTURE:NAME one camera of a capture, CAPTURE all of them together; with --calibration a video of\n"
                   "the rope on black, or - for raw RGB24 frames on standard input")
      ->required()
      ->type_name("SOURCE");
  command->add_option("--calibration", request->calibration, "Camera object as in capture.json")
      ->type_name("FILE.json");
  command->add_option("--rate", request->rate, "Frames a second (default: the calibration's, else the video's)")
      ->type_name("HZ");
  command->add_option("--base", request->base, "Base motion (default: the capture's; with --calibration at rest)")
      ->type_name("FILE.tum");
  command->add_option("--frames", request->frames, "Only frames A to B - 1")->type_name("A:B");
  command->add_option("--drop", request->drop, "Use every N-th frame (default 1)")->type_name("N");
  command
      ->add_option("--centerline", request->centerline, "Also write the world points of the grasp, joints and free end")
      ->type_name("FILE.csv");
  command->callback([&globals, &job, request] { job = [&globals, request] { estimate(globals, *request); }; });
}

}  // namespace chainsplat::tools
