// estimate.cpp - a rope followed frame by frame: one JSON line a frame on standard output, flushed.
#include <CLI/CLI.hpp>
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <functional>
#include <iostream>
#include <memory>
#include <span>
#include <thread>

#include "chainsplat/capture.h"
#include "chainsplat/estimation.h"
#include "chainsplat/force.h"
#include "chainsplat/gpu.h"
#include "chainsplat/masking.h"
#include "chainsplat/twin.h"
#include "cli.h"
#include "frame_source.h"
#include "run_folder.h"
#include "window.h"

namespace chainsplat::tools {

namespace {

struct EstimateRequest {
  SourceRequest source;
  std::string run, base, frames, centerline, solver;
  int drop = 1;
  int serve = 0;  // port of the live window; 0: none
  bool covariance = false;
};

// What one frame came to.
struct Followed {
  const LiveFrame& frame;
  const std::vector<capture::View>& views;  // what was looked at: the frame's own, or made of its picture
  const estimation::Estimate& estimate;
  double latency;  // s, from the decoded frame until now
};
// Called after every frame, in the order given.
using Subscriber = std::function<void(const Followed&)>;

// The mask of a picture; `theta` is where the rope is expected, none when that is not known.
using MaskMaker = std::function<capture::View(const capture::Image8& picture, const math::Pose& base,
                                              const std::optional<math::VectorX>& theta)>;

// What follows the rope: frame by frame, and where it expects the rope at a time.
struct Follower {
  std::function<estimation::Estimate(std::span<const capture::View* const> views)> update;
  std::function<std::optional<math::VectorX>(double time)> expected;
};

struct FollowOptions {
  int drop = 1;
  double base_start = -std::numeric_limits<double>::infinity();  // s, from when the base's motion is known
  double base_end = std::numeric_limits<double>::infinity();     // s, and until when
  std::string base_name, source_name;
};

// Frame by frame until the source ends.
void follow(FrameSource& source, const Follower& follower, const dynamics::BaseFunction& base, const MaskMaker& mask,
            const FollowOptions& options, const std::vector<Subscriber>& subscribers) {
  LiveFrame frame;
  std::vector<capture::View> made;
  double last = -std::numeric_limits<double>::infinity();  // s
  for (int read = 0; source.next(frame); ++read) {
    if (core::stop_requested()) throw Interrupted(core::stop_requested());
    if (!(frame.time > last))
      throw WorkError(options.source_name,
                      "frame " + std::to_string(frame.frame) + " is at " + core::exact(frame.time) +
                          " s, not after the one before",
                      "give times that increase, and near enough to 0 that a frame's interval is told; the states so "
                      "far are kept");
    last = frame.time;
    if (read % options.drop != 0) continue;
    constexpr double kSlack = 1.0 / 30.0;  // s, a frame beyond the first or last sample
    if (read == 0 && frame.time < options.base_start - kSlack)
      core::warn(options.base_name + ": the base motion begins " + core::exact(options.base_start - frame.time) +
                 " s after the first frame; until then the base is assumed to rest where it begins");
    if (frame.time > options.base_end + kSlack)
      throw WorkError(options.base_name,
                      "the base motion ends at " + core::exact(options.base_end) + " s, before frame " +
                          std::to_string(frame.frame),
                      "give a base motion as long as the frames; the states so far are kept");
    if (!source.masked) {
      made.assign(1, mask(frame.picture, base(frame.time).pose, follower.expected(frame.time)));
      made[0].frame = frame.frame;
      made[0].time = frame.time;
    }
    const std::vector<capture::View>& views = source.masked ? frame.views : made;
    std::vector<const capture::View*> pointers;
    for (const capture::View& view : views) pointers.push_back(&view);
    const estimation::Estimate estimate = follower.update(pointers);
    for (const Subscriber& subscriber : subscribers)
      subscriber({frame, views, estimate, core::seconds_now() - frame.arrived});
  }
}

// What a stream has come to so far, in the same memory however long it lasts.
struct Tally {
  static constexpr double kShortest = 1e-6;  // s, latency of the first bin
  static constexpr double kGrowth = 1.01;    // from bin to bin: latencies are told to 1 %
  std::array<std::int64_t, 2100> bins{};     // up to 1,000 s
  std::int64_t frames = 0, lost = 0;
  double first_time = 0.0;  // s, of the first frame
};

void count(Tally& tally, const estimation::Estimate& estimate, double latency) {
  if (tally.frames++ == 0) tally.first_time = estimate.time;
  tally.lost += estimate.lost;
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

// Colors of a twin's Gaussians, as seen from the sides: what the rope looks like before the first frame.
std::vector<std::uint8_t> twin_colors(const twin::Twin& twin) {
  constexpr float kOpaque = 0.0f;  // logit of one half
  std::vector<std::uint8_t> rgb;
  const math::Vector3 across = twin.chain.direction.cross(twin.chain.bending_axis);
  for (int i = 0; i < twin.gaussians.count; ++i) {
    if (twin.gaussians.opacity_logit[i] < kOpaque) continue;
    for (const math::Vector3& from : {across, math::Vector3(-across), twin.chain.bending_axis}) {
      const math::Vector3 color = splat::sh_color(twin.gaussians, i, from);
      for (int c = 0; c < 3; ++c)
        rgb.push_back(static_cast<std::uint8_t>(std::lround(255.0 * std::clamp(color[c], 0.0, 1.0))));
    }
  }
  return rgb;
}

// The twin drawn into a crop (x0, y0, width, height; without size the whole picture).
capture::View drawn_view(splat::Engine& engine, const twin::Twin& twin, const capture::Camera& camera,
                         const math::Pose& base, const math::VectorX& theta, const std::array<int, 4>& crop) {
  capture::View view;
  view.width = camera.width, view.height = camera.height;
  if (crop[2] > 0 && crop[3] > 0) view.x0 = crop[0], view.y0 = crop[1], view.width = crop[2], view.height = crop[3];
  const splat::ViewSpec spec{&camera,    view.x0,     view.y0,
                             view.width, view.height, chain::link_motions(twin.chain, theta, base)};
  const splat::Picture drawn = std::move(engine.draw(twin.gaussians, {&spec, 1}, false).front());
  for (const float value : drawn.rgba)
    view.rgba.push_back(static_cast<std::uint8_t>(std::lround(255.0f * std::clamp(value, 0.0f, 1.0f))));
  return view;
}

// Whether a picture was masked before: most of it is black.
bool black_about(const capture::Image8& picture) {
  constexpr int kBlack = 16;  // of 255: lossy coding does not keep black black
  std::size_t black = 0;
  for (std::size_t i = 0; i + 2 < picture.pixels.size(); i += 3)
    black += std::max({picture.pixels[i], picture.pixels[i + 1], picture.pixels[i + 2]}) <= kBlack;
  return 2 * black > picture.pixels.size() / 3;
}

// As an arrow from the contact; a force as large as the rope's weight is half as long as the rope.
void show_force(const force::Estimate& f, const twin::Twin& twin, const dynamics::Model& model,
                const capture::Camera& camera, Shown& shown) {
  double mass = model.parameters.tip_mass;
  for (const double m : model.parameters.link_mass) mass += m;
  const double weight = mass * model.parameters.gravity.norm();
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

// The device's kernels are made at their first use, and its buffers grow, which no frame shall wait for: it is shown
// masks that fill the pictures, which no frame does, and masks of a size that a rope's may have.
void warm_up(const estimation::Filter& filter, double start) {
  constexpr int kMostWidth = 2048, kMostHeight = 1536;  // px; larger masks can be more than the device takes at once
  const std::vector<math::Pose> rest = chain::link_motions(filter.model.chain, filter.rest, filter.base(start).pose);
  for (const int share : {1, 4}) {
    std::vector<capture::View> views;
    std::vector<const capture::View*> pointers;
    for (const capture::Camera& camera : filter.cameras) {
      capture::View& view = views.emplace_back();
      view.camera = static_cast<int>(views.size()) - 1;
      view.width = std::min(camera.width, kMostWidth);
      view.height = std::min(camera.height, kMostHeight);
      view.rgba.assign(4 * static_cast<std::size_t>(view.width) * view.height, 0);
      const int wide = view.width / share, left = (view.width - wide) / 2;
      for (int y = 0; y < view.height; ++y)
        std::fill_n(&view.rgba[4 * (static_cast<std::size_t>(y) * view.width + left)], 4 * wide, std::uint8_t{255});
    }
    for (const capture::View& view : views) pointers.push_back(&view);
    filter.compare_colors(pointers, std::vector<std::vector<math::Pose>>(views.size(), rest));
  }
}

void estimate(const Globals& globals, EstimateRequest& request) {
  if (globals.json)
    throw InputError("--json", "estimate writes one JSON line a frame, not one document", "leave it out");
  if (request.drop < 1) throw InputError("--drop", "must be 1 or more", "give 2 for every second frame");
  if (!request.centerline.empty()) check_output_file(request.centerline);
  if (request.centerline == "-")
    throw InputError("--centerline", "standard output is for the estimates", "name a file");
  if (request.base == "-" && request.source.camera == "-")
    throw InputError("--base", "standard input is for the frames", "name a file");
  std::tie(request.source.first, request.source.last) = parse_frames(request.frames);
  const twin::Twin twin = load_twin(request.run);
  if (!twin.parameters)
    core::warn(request.run + ": its dynamics are not identified; angles are assumed to go on at constant rate");

  request.source.pictures = request.serve > 0;
  watch_signals(true);
  FrameSource source = open_frames(request.source);
  trajectory::Trajectory base;
  if (!request.base.empty()) {
    base = read_base(request.base);
  } else if (source.base) {
    base = *source.base;
  } else {
    const trajectory::Trajectory own = own_base(request.run);
    base = trajectory::fit({{own.start(), own.pose(own.start())}}, request.run);
    core::warn("--base: is missing; the base is assumed to rest where the twin's capture began");
  }
  FollowOptions options;
  options.drop = request.drop;
  options.source_name = request.source.camera;
  options.base_name = request.base.empty() ? request.source.camera : request.base;
  if (base.samples().size() > 1) options.base_start = base.start(), options.base_end = base.end();
  estimation::Filter filter = estimation::start(
      twin, source.cameras, [&](double time) { return base.at(time); }, base.start());
  std::optional<Window> window;
  if (request.serve > 0) {
    const capture::Camera& camera = source.cameras[0];
    window.emplace(request.serve, camera.width, camera.height, request.run + ", " + request.source.camera);
    say("Live window: http://127.0.0.1:" + std::to_string(request.serve) + "/");
  }
  gpu::DevicePtr device;
  std::optional<splat::Engine> engine;
  if (request.solver != "silhouette" && twin.gaussians.count > 0) {
    try {
      device = gpu::open_device({.selector = globals.device});
      engine.emplace(*device);
    } catch (const InputError& error) {
      if (!request.solver.empty() || !globals.device.empty()) throw;  // asked for
      core::warn(std::string(error.what()) + "; the rope is followed by its outline alone");
    }
  }
  const bool by_adam = request.solver == "adam";
  if (by_adam && !engine)
    throw InputError("--solver", "adam draws the twin, and " + request.run + " has no Gaussians", "train it first");
  if (engine && !by_adam) {
    engine->set_gaussians(twin.gaussians);
    filter.compare_colors = [&](std::span<const capture::View* const> views,
                                std::span<const std::vector<math::Pose>> motions) {
      std::vector<splat::ViewSpec> specs;
      std::vector<const std::vector<std::uint8_t>*> seen;
      for (std::size_t v = 0; v < views.size(); ++v) {
        const capture::View& view = *views[v];
        specs.push_back({&source.cameras.at(view.camera), view.x0, view.y0, view.width, view.height, motions[v]});
        seen.push_back(&view.rgba);
      }
      return engine->color_sums(twin.chain, specs, seen);
    };
    warm_up(filter, base.start());
  }
  Follower follower;
  follower.update = [&](std::span<const capture::View* const> views) { return estimation::update(filter, views); };
  follower.expected = [&](double time) { return estimation::expected(filter, time); };
  estimation::AdamFollower adam;
  if (by_adam) {
    adam = estimation::start_adam(filter, [&](const capture::View& view, const std::vector<math::Pose>& motions) {
      const capture::Camera& camera = source.cameras.at(view.camera);
      const splat::ViewSpec spec{&camera, view.x0, view.y0, view.width, view.height, motions};
      const std::vector<std::uint8_t>* const target = &view.rgba;
      splat::Gradients gradients;
      engine->loss(twin.gaussians, {&spec, 1}, {&target, 1}, {}, static_cast<double>(camera.width) * camera.height,
                   &gradients);
      return std::move(gradients.link_twists.front());
    });
    follower.update = [&](std::span<const capture::View* const> views) { return estimation::update(adam, views); };
    follower.expected = [&](double) {
      return adam.theta.size() > 0 ? std::optional<math::VectorX>(adam.theta) : std::nullopt;
    };
  }
  std::optional<bool> masked_before;  // by the first picture
  std::optional<masking::Live> live;
  std::array<int, 4> masked = {0, 0, 0, 0};  // crop of the last mask: x0, y0, width, height
  const MaskMaker mask = [&](const capture::Image8& picture, const math::Pose& pose,
                             const std::optional<math::VectorX>& theta) {
    if (!masked_before) {
      masked_before = black_about(picture);
      if (!*masked_before) {
        filter.options = estimation::options_for_live_masks(twin.tabletop);
        const std::vector<std::uint8_t> colors = twin_colors(twin);
        if (colors.empty())
          core::warn(request.source.camera +
                     ": is not masked, and the twin has no colors to find the rope by; what is " +
                     "not black is taken for the rope");
        else
          live = masking::start(source.cameras[0], twin.chain, colors);
      }
    }
    if (!live) return bright_view(picture, source.cameras[0]);
    constexpr int kMarksEvery = 10;  // frames; the rope shows nearly the same side
    if (engine && live->frames % kMarksEvery == 0) {
      const math::VectorX near = theta.value_or(filter.rest);  // marks stay on the rope wherever it lies
      masking::learn_marks(*live, drawn_view(*engine, twin, source.cameras[0], pose, near, masked), pose, near);
    }
    capture::View view = masking::mask(*live, picture, pose, theta);
    masked = {view.x0, view.y0, view.width, view.height};
    return view;
  };

  chain::States states;  // of all frames, where a centerline is to be written
  Tally tally;
  const Subscriber print = [&](const Followed& followed) {
    std::cout << estimation::to_json(followed.estimate, followed.latency, request.covariance) << "\n";
    flush_output();
  };
  const Subscriber keep = [&](const Followed& followed) {
    count(tally, followed.estimate, followed.latency);
    if (request.centerline.empty()) return;
    states.time.push_back(followed.estimate.time);
    states.theta.push_back(followed.estimate.theta);
  };
  std::vector<Subscriber> subscribers{keep, print};  // what cannot be printed is kept nevertheless
  // recorded frames are shown at the pace at which they were taken
  const bool recorded = request.source.calibration.empty();
  const double begun = core::seconds_now();
  std::optional<force::Live> pushed;  // what touches the rope, for the window
  if (window && twin.parameters) {
    pushed.emplace();
    pushed->model = filter.model;
    pushed->deviations = force::deviations(filter.model, twin.estimates);
    pushed->base = [&](double time) { return base.at(time); };
  }
  if (window)
    subscribers.push_back([&](const Followed& followed) {
      const estimation::Estimate& e = followed.estimate;
      Shown shown;
      shown.frame = e.frame, shown.time = e.time, shown.latency = followed.latency;
      shown.iou = e.iou, shown.residual = e.residual, shown.seen = e.seen, shown.lost = e.lost;
      shown.line = recorded_line(source.cameras[0],
                                 chain::nodes(twin.chain, chain::link_motions(twin.chain, e.theta, base.pose(e.time))));
      if (pushed && !e.lost) {
        const Eigen::Index n = std::min(e.theta.size(), e.covariance.rows());  // 0: no covariance
        if (const auto f = force::update(*pushed, e.time, e.theta, e.covariance.topLeftCorner(n, n)))
          show_force(*f, twin, filter.model, source.cameras[0], shown);
      }
      if (!followed.frame.picture.pixels.empty()) shown.picture = &followed.frame.picture;
      if (!followed.views.empty()) shown.view = &followed.views[0];
      window->show(shown);
      while (recorded && !core::stop_requested() && core::seconds_now() - begun < e.time - tally.first_time)
        std::this_thread::sleep_for(std::chrono::milliseconds(1));
    });
  const auto write = [&] {
    if (!request.centerline.empty() && !states.time.empty())
      write_result(request.centerline, twin::centerline_csv(twin.chain, states, base));
  };
  const auto summarize = [&] {
    if (tally.frames > 0)
      say(std::to_string(tally.frames) + " frames" + (tally.lost ? ", lost in " + std::to_string(tally.lost) : "") + "; " +
          latency_text(tally) + ".");
  };
  watch_signals();  // a camera never ends by itself
  try {
    follow(source, follower, filter.base, mask, options, subscribers);
  } catch (const Interrupted&) {
    write();
    summarize();
    throw;
  } catch (const InputError& error) {
    write();
    if (tally.frames == 0) throw;
    throw broken_off(error, "the states so far are kept");
  } catch (...) {
    write();
    throw;
  }
  write();
  summarize();
  if (tally.frames == 0)
    throw InputError(request.source.camera, "has no frame", "name a camera that recorded something");
}

}  // namespace

void add_estimation_commands(CLI::App& app, const Globals& globals, Job& job) {
  CLI::App* command = app.add_subcommand("estimate", "Follow the rope: one JSON line a frame on standard output");
  auto request = std::make_shared<EstimateRequest>();
  command->add_option("RUN", request->run, "Run folder of a twin")->required();
  command
      ->add_option(
          "--camera", request->source.camera,
          "CAPTURE:NAME one camera of a capture, CAPTURE all of them together; with --calibration a video, a\n"
          "V4L2 device such as /dev/video0, or - for raw RGB24 frames on standard input, of the rope on black\n"
          "or as it comes: then masks are made")
      ->required()
      ->type_name("SOURCE");
  command->add_option("--calibration", request->source.calibration, "Camera object as in capture.json")
      ->type_name("FILE.json");
  command->add_option("--rate", request->source.rate, "Frames a second (default: the calibration's, else the video's)")
      ->check(CLI::Range(1e-3, 1e6))
      ->type_name("HZ");
  command
      ->add_option(
          "--start", request->source.start,
          "Time of the first frame by the base motion's clock (default: the calibration's, else 0); 'unix': a\n"
          "device's own time stamps in Unix time, for a base motion that is stamped so")
      ->type_name("SECONDS|unix");
  command->add_option("--base", request->base, "Base motion (default: the capture's; with --calibration at rest)")
      ->type_name("FILE.tum");
  command
      ->add_option("--solver", request->solver,
                   "newton: outlines, then the colors inside them, drawn on the Vulkan device (default, where there\n"
                   "is one)\n"
                   "silhouette: outlines alone, without a device\n"
                   "adam: the paper's, 10 Adam steps on the rendering loss from the last frame's angles, without\n"
                   "deviations; to compare with")
      ->check(CLI::IsMember({"newton", "silhouette", "adam"}))
      ->type_name("KIND");
  command->add_option("--frames", request->frames, "Only frames A to B - 1")->type_name("A:B");
  command->add_option("--drop", request->drop, "Use every N-th frame (default 1)")->type_name("N");
  command
      ->add_option("--centerline", request->centerline, "Also write the world points of the grasp, joints and free end")
      ->type_name("FILE.csv");
  command
      ->add_option("--serve", request->serve,
                   "Show picture, chain, trust and latency in a browser at http://127.0.0.1:PORT/; recorded frames at\n"
                   "their own pace")
      ->check(CLI::Range(1, 65535))
      ->type_name("PORT");
  command->add_flag("--covariance", request->covariance,
                    "Also the covariance of theta and thetadot together: its lower triangle, row by row");
  command->callback([&globals, &job, request] { job = [&globals, request] { estimate(globals, *request); }; });
}

}  // namespace chainsplat::tools
