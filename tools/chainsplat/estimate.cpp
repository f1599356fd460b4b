// estimate.cpp - a rope followed frame by frame: one JSON line a frame on standard output, flushed.
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <iostream>
#include <memory>
#include <optional>
#include <thread>
#include <tuple>

#include "chainsplat/capture.h"
#include "chainsplat/encode.h"
#include "chainsplat/estimation.h"
#include "chainsplat/follow.h"
#include "chainsplat/force.h"
#include "chainsplat/mcap.h"
#include "chainsplat/run_folder.h"
#include "chainsplat/twin.h"
#include "cli.h"
#include "command_line.h"
#include "window.h"

namespace chainsplat::tools {

namespace {

struct EstimateRequest {
  std::string run, camera, calibration, start, base, frames, centerline, mcap, solver;
  double rate = 0.0;
  int drop = 1;
  int serve = 0;  // port of the live window; 0: none
  bool covariance = false;
};

// What a stream has come to so far, in the same memory however long it lasts.
struct Tally {
  static constexpr double kShortest = 1e-6;  // s, latency of the first bin
  static constexpr double kGrowth = 1.01;    // from bin to bin: latencies are told to 1 %
  std::array<std::int64_t, 2100> bins{};     // up to 1,000 s
  std::int64_t frames = 0, lost = 0, doubtful = 0;
};

void count(Tally& tally, const estimation::Estimate& estimate, double latency) {
  ++tally.frames;
  tally.lost += estimate.lost;
  tally.doubtful += estimate.doubtful;
  const double bin = std::log(std::max(latency, Tally::kShortest) / Tally::kShortest) / std::log(Tally::kGrowth);
  ++tally.bins[static_cast<std::size_t>(std::min(bin, static_cast<double>(tally.bins.size() - 1)))];
}

// "p50 0.71 ms, p99 4.90 ms"
std::string latency_text(const Tally& tally) {
  const auto at = [&](double share) {  // the middle of the bin in which this share of the frames is reached
    std::size_t bin = 0;
    for (auto within = static_cast<double>(tally.bins[0]);
         within < share * static_cast<double>(tally.frames) && bin + 1 < tally.bins.size();)
      within += static_cast<double>(tally.bins[++bin]);
    return Tally::kShortest * std::pow(Tally::kGrowth, static_cast<double>(bin) + 0.5);
  };
  char text[64];
  std::snprintf(text, sizeof text, "p50 %.2f ms, p99 %.2f ms", 1e3 * at(0.5), 1e3 * at(0.99));
  return text;
}

// As an arrow from the contact; a force as large as the rope's weight is half as long as the rope.
void show_force(const force::Estimate& f, const twin::Twin& twin, const dynamics::Model& model,
                const capture::Camera& camera, Shown& shown) {
  const double weight = dynamics::total_mass(model.parameters) * model.parameters.gravity.norm();
  // along the force: across it there may be directions that nobody sees
  const double deviation = f.force.cwiseProduct(f.sigma).norm() / std::max(f.force.norm(), 1e-9);
  char text[80];
  std::snprintf(text, sizeof text, "%.3f ± %.3f %s", f.force.norm(), deviation, twin.known_mass ? "N" : "N/kg");
  shown.force_text = f.touching ? text : "none";
  if (!f.touching || !(weight > 0.0)) return;
  math::MatrixX ends(3, 2);
  ends << f.point, f.point + 0.5 * twin.chain.length / weight * f.force;
  shown.force = recorded_line(camera, ends);
}

double seconds_of(const std::string& start) {
  char* end = nullptr;
  const double value = std::strtod(start.c_str(), &end);
  if (*end || !std::isfinite(value))
    throw InputError("--start", "'" + start + "' is no time", "give seconds, or 'unix' for a device");
  return value;
}

pipeline::FollowOptions options_of(const Globals& globals, const EstimateRequest& request) {
  pipeline::FollowOptions options;
  pipeline::SourceOptions& source = options.source;
  source.calibration = request.calibration;
  source.source = request.camera;
  if (request.calibration.empty()) std::tie(source.source, source.camera) = split_camera(request.camera);
  source.rate = request.rate;
  source.unix_time = request.start == "unix";
  if (!request.start.empty() && !source.unix_time) source.start = seconds_of(request.start);
  source.frames = capture::read_frame_range(request.frames, "--frames");
  source.pictures = request.serve > 0 || !request.mcap.empty();
  if (!request.base.empty()) options.base = pipeline::input_path(request.base);
  if (request.solver == "newton") options.solver = pipeline::Solver::newton;
  if (request.solver == "silhouette") options.solver = pipeline::Solver::silhouette;
  if (request.solver == "adam") options.solver = pipeline::Solver::adam;
  options.drop = request.drop;
  options.device = globals.device;
  options.check();
  return options;
}

void check(const Globals& globals, const EstimateRequest& request) {
  if (globals.json)
    throw InputError("--json", "estimate writes one JSON line a frame, not one document", "leave it out");
  if (!request.centerline.empty()) pipeline::check_output_file(request.centerline);
  if (!request.mcap.empty()) {
    pipeline::check_output_file(request.mcap);
    check_not_input(request.mcap, request.run, {request.camera, request.calibration, request.base});
  }
  for (const auto& [name, file] : {std::pair{"--centerline", request.centerline}, {"--mcap", request.mcap}})
    if (file == "-") throw InputError(name, "standard output is for the estimates", "name a file");
  if (request.base == "-" && request.camera == "-")
    throw InputError("--base", "standard input is for the frames", "name a file");
}

// What touches the rope while it is followed; nothing where its dynamics are not known.
class Push {
 public:
  explicit Push(const pipeline::Follower& follower) {
    if (!follower.twin().parameters) return;
    live_.emplace(follower.model(), force::deviations(follower.model(), follower.twin().estimates),
                  [&follower](double time) { return follower.base_at(time); });
  }
  // None of a rope that may be somewhere else, and of the first frames.
  std::optional<force::Estimate> update(const estimation::Estimate& e) {
    if (!live_ || e.lost || e.doubtful || e.settling) return {};
    const Eigen::Index n = std::min(e.theta.size(), e.covariance.rows());  // 0: no covariance
    return live_->update(e.time, e.theta, e.covariance.topLeftCorner(n, n), {e.late_sigma, e.theta_by_late});
  }

 private:
  std::optional<force::LiveForce> live_;
};

// The live window.
class Page {
 public:
  Page(const pipeline::Follower& follower, const EstimateRequest& request)
      : follower_(follower),
        window_(request.serve, follower.cameras()[0].width, follower.cameras()[0].height,
                request.run + ", " + request.camera),
        recorded_(request.calibration.empty()) {
    say("Live window: http://127.0.0.1:" + std::to_string(request.serve) + "/");
  }

  void show(const pipeline::Followed& followed, const std::optional<force::Estimate>& pushed) {
    const estimation::Estimate& e = followed.estimate;
    const twin::Twin& twin = follower_.twin();
    const capture::Camera& camera = follower_.cameras()[0];
    if (!first_time_) first_time_ = e.time;
    Shown shown;
    shown.frame = e.frame, shown.time = e.time, shown.latency = followed.latency;
    shown.iou = e.iou, shown.residual = e.residual, shown.seen = e.seen, shown.status = estimation::status(e);
    shown.line = recorded_line(
        camera, chain::nodes(twin.chain, chain::link_motions(twin.chain, e.theta, follower_.base_at(e.time).pose)));
    if (pushed) show_force(*pushed, twin, follower_.model(), camera, shown);
    if (!followed.frame.picture.pixels.empty()) shown.picture = &followed.frame.picture;
    if (!followed.views.empty()) shown.view = &followed.views[0];
    window_.show(shown);
    // recorded frames are shown at the pace at which they were taken
    while (recorded_ && !core::stop_requested() && core::seconds_now() - begun_ < e.time - *first_time_)
      std::this_thread::sleep_for(std::chrono::milliseconds(1));
  }

 private:
  const pipeline::Follower& follower_;
  Window window_;
  bool recorded_;
  std::optional<double> first_time_;  // s
  double begun_ = core::seconds_now();
};

void record(const pipeline::Followed& followed, const pipeline::Follower& follower,
            const std::optional<force::Estimate>& pushed, exports::McapRecording& recording) {
  constexpr int kQuality = 80;  // of JPEG
  const estimation::Estimate& e = followed.estimate;
  recording.pose(e.time, follower.base_at(e.time).pose, e.theta, e.thetadot);
  recording.status(e.time, estimation::status(e), e.centerline_sigma, followed.latency);
  if (pushed)
    recording.force(pushed->time, pushed->point, pushed->force, pushed->sigma, pushed->touching,
                    follower.twin().known_mass);
  if (const capture::Image8& picture = followed.frame.picture; !picture.pixels.empty())
    recording.picture(e.time, 0, capture::jpeg(picture, kQuality), false);
}

// What a run leaves behind at its end, however it ends.
struct Ending {
  const EstimateRequest& request;
  const pipeline::Follower& follower;
  Tally tally;
  chain::States states = {};                             // of all frames, where a centerline is to be written,
  std::vector<math::Pose> base = {};                     // and the base there, as it was believed to stand
  std::optional<exports::McapRecording> recording = {};  // begun by the first frame: without one there is no file

  void keep(const pipeline::Followed& followed) {
    count(tally, followed.estimate, followed.latency);
    if (request.centerline.empty()) return;
    states.time.push_back(followed.estimate.time);
    states.theta.push_back(followed.estimate.theta);
    base.push_back(follower.base_at(followed.estimate.time).pose);
  }
  void write() {
    if (recording) recording->finish();
    recording.reset();
    if (!request.centerline.empty() && !states.time.empty())
      write_result(request.centerline, twin::centerline_csv(follower.twin().chain, states, base));
  }
  void summarize() const {
    for (const capture::Finding& finding : follower.findings()) core::warn(finding.text);
    if (tally.frames > 0)
      say(std::to_string(tally.frames) + " frames" + (tally.lost ? ", lost in " + std::to_string(tally.lost) : "") +
          (tally.doubtful ? ", doubtful in " + std::to_string(tally.doubtful) : "") + "; " + latency_text(tally) + ".");
  }
};

void estimate(const Globals& globals, const EstimateRequest& request) {
  check(globals, request);
  const pipeline::FollowOptions options = options_of(globals, request);
  watch_signals(true);
  pipeline::Follower follower(request.run, options);
  std::optional<Page> page;
  if (request.serve > 0) page.emplace(follower, request);
  std::optional<Push> push;
  if (page || !request.mcap.empty()) push.emplace(follower);
  Ending ending{request, follower, {}};
  watch_signals();  // a camera never ends by itself
  try {
    follower.follow([&](const pipeline::Followed& followed) {
      ending.keep(followed);  // what cannot be printed is kept nevertheless
      std::cout << estimation::to_json(followed.estimate, followed.latency, request.covariance) << "\n";
      flush_output();
      const std::optional<force::Estimate> pushed = push ? push->update(followed.estimate) : std::nullopt;
      if (!request.mcap.empty()) {
        if (!ending.recording) ending.recording.emplace(request.mcap, follower.twin().chain, follower.cameras());
        record(followed, follower, pushed, *ending.recording);
      }
      if (page) page->show(followed, pushed);
    });
  } catch (const Interrupted&) {
    ending.write();
    ending.summarize();
    throw;
  } catch (const InputError& error) {
    ending.write();
    if (ending.tally.frames == 0) throw;
    throw pipeline::broken_off(error, "the states so far are kept");
  } catch (...) {
    ending.write();
    throw;
  }
  ending.write();
  ending.summarize();
  if (ending.tally.frames == 0)
    throw InputError(request.camera, "has no frame", "name a camera that recorded something");
}

}  // namespace

void add_estimation_commands(Command app, const Globals& globals, Job& job) {
  Command command = app.add_command("estimate", "Follow the rope: one JSON line a frame on standard output");
  auto request = std::make_shared<EstimateRequest>();
  command.add_option("RUN", request->run, "Run folder of a twin").required();
  command
      .add_option("--camera", request->camera,
                  "CAPTURE:NAME one camera of a capture, CAPTURE all of them together; with --calibration a V4L2\n"
                  "device such as /dev/video0, whose newest frame is used; a video, a pipe, or - for standard input\n"
                  "with Y4M or raw RGB24 frames: each is used, and a live sender is to drop what is late. Of the rope\n"
                  "on black or as it comes: then masks are made")
      .required()
      .type_name("SOURCE");
  command.add_option("--calibration", request->calibration, "Camera object as in capture.json").type_name("FILE.json");
  command.add_option("--rate", request->rate, "Frames a second (default: the calibration's, else the video's)")
      .in_range(1e-3, 1e6)
      .type_name("HZ");
  command
      .add_option("--start", request->start,
                  "Time of the first frame by the base motion's clock (default: the calibration's, else 0); 'unix': a\n"
                  "device's own time stamps in Unix time, for a base motion that is stamped so")
      .type_name("SECONDS|unix");
  command.add_option("--base", request->base, "Base motion (default: the capture's; with --calibration at rest)")
      .type_name("FILE.tum");
  command
      .add_option("--solver", request->solver,
                  "newton: outlines, then the colors inside them, drawn on the Vulkan device (default, where there\n"
                  "is one)\n"
                  "silhouette: outlines alone, without a device\n"
                  "adam: the paper's, 10 Adam steps on the rendering loss from the last frame's angles, without\n"
                  "deviations; to compare with")
      .one_of({"newton", "silhouette", "adam"})
      .type_name("KIND");
  command.add_option("--frames", request->frames, "Only frames A to B - 1").type_name("A:B");
  command.add_option("--drop", request->drop, "Use every N-th frame (default 1)").type_name("N");
  command
      .add_option("--centerline", request->centerline, "Also write the world points of the grasp, joints and free end")
      .type_name("FILE.csv");
  command
      .add_option("--mcap", request->mcap,
                  "Also a recording for Foxglove or rerun: pictures, transforms, joints, trust, force")
      .type_name("FILE.mcap");
  command
      .add_option("--serve", request->serve,
                  "Show picture, chain, trust and latency in a browser at http://127.0.0.1:PORT/; recorded frames at\n"
                  "their own pace")
      .in_range(1, 65535)
      .type_name("PORT");
  command.add_flag("--covariance", request->covariance,
                   "Also the covariance of theta and thetadot together: its lower triangle, row by row");
  command.callback([&globals, &job, request] { job = [&globals, request] { estimate(globals, *request); }; });
}

}  // namespace chainsplat::tools
