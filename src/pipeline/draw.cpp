// draw.cpp - a twin drawn through the cameras of a capture: which frames, on what, and into which files.
#include "chainsplat/draw.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <optional>
#include <utility>

#include "chainsplat/corrections.h"
#include "chainsplat/encode.h"
#include "chainsplat/gpu.h"
#include "chainsplat/run_folder.h"

namespace chainsplat::pipeline {

namespace {

constexpr double kRate = 30.0;  // frames per second, for a camera of one frame

bool is_video(const Path& output) { return output.extension() == ".mp4"; }

std::string frame_name(int frame, const char* ending) {
  char text[64];
  std::snprintf(text, sizeof text, "%06d%s", frame, ending);
  return text;
}

// The camera's times and, as a motion of its own may be longer than the recording, as many more at its rate. A motion
// at quite other times is drawn from its beginning on.
std::vector<double> frame_times(const std::vector<double>& recorded, const chain::States& states) {
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

// What is drawn.
struct Motion {
  twin::Twin twin;
  chain::States states;
  capture::Capture scene;     // as the twin corrects it, without frames; its times are those that are drawn
  std::vector<int> recorded;  // by camera, how many of these times are those of its frames
  trajectory::Trajectory base;
};

// How many of a camera's times the states cover.
int covered_frames(const Motion& motion, std::size_t camera) {
  const std::vector<double>& times = motion.scene.times[camera];
  const double interval = render::median_interval(times);
  return static_cast<int>(std::count_if(times.begin(), times.end(),
                                        [&](double time) { return render::covered(motion.states, time, interval); }));
}

Motion motion_of(const Path& run, const Path& capture, const DrawOptions& options) {
  Motion motion;
  motion.twin = load_twin(run);
  check_drawable(motion.twin, run);
  motion.states =
      options.states.empty() ? motion.twin.states : twin::read_states(input_path(options.states), motion.twin.chain);
  capture::LoadOptions load;
  load.images = false;
  load.camera = options.camera;
  motion.scene = capture::load(capture, load);
  capture::apply(motion.twin.corrections, motion.scene);
  const bool own_base = !options.base.empty();
  motion.base = own_base ? read_base(options.base) : motion.scene.base;
  if (!options.states.empty() && !own_base)
    core::warn(options.states.string() + ": no base motion lies beside it; that of " + capture.string() + " is taken");
  for (std::vector<double>& times : motion.scene.times) {
    const std::vector<double> frames = times;
    if (own_base) times = frame_times(frames, motion.states);
    motion.recorded.push_back(times.front() == frames.front() ? static_cast<int>(frames.size()) : 0);
  }
  return motion;
}

// Throws InputError where the output cannot be written, before anything is read.
void check_output(const DrawOptions& options) {
  if (is_video(options.output))
    check_output_file(options.output.string());
  else
    check_output_folder(options.output, options.force, "name another folder or give `force` to write into it");
}

// Throws InputError where the motion cannot go there, before the first camera's frames are written.
void check_motion(const Path& run, const Path& capture, const DrawOptions& options, const Motion& motion) {
  const std::vector<capture::Camera>& cameras = motion.scene.cameras;
  if (is_video(options.output) && cameras.size() != 1)
    throw InputError(capture.string(), "has " + std::to_string(cameras.size()) + " cameras and a video shows one",
                     "name it, for example " + capture.string() + ":" + cameras.front().name);
  if (!is_video(options.output)) {
    check_not_capture(options.output, motion.scene.folder);
    for (const capture::Camera& camera : cameras)
      check_output_folder(options.output / camera.name, true, "");  // may be a file
  }
  for (std::size_t c = 0; c < cameras.size(); ++c)
    if (covered_frames(motion, c) == 0)
      throw InputError((options.states.empty() ? run : options.states).string(),
                       "covers none of the times of " + cameras[c].name, "give states at the camera's times");
}

// Where the pictures of one camera go.
class Files {
 public:
  Files(const DrawOptions& options, const capture::Camera& camera, const std::vector<double>& times)
      : options_(options), camera_(camera), stem_(options.output / camera.name) {
    if (is_video(options.output))
      movie_.emplace(options.output,
                     times.size() > 1 ? double(times.size() - 1) / (times.back() - times.front()) : kRate);
    else
      core::make_folder(stem_);
  }
  // Those of a movie are to come in order.
  bool in_order() const { return movie_.has_value(); }
  // Several threads may add frames that need no order.
  void add(const render::Frame& frame, const capture::Image8& picture) {
    if (movie_) return movie_->add(picture);
    capture::write_png(file(frame, ".png"), picture);
    if (options_.mask) capture::write_png(file(frame, ".mask.png"), render::mask_image(frame, camera_));
    if (options_.depth)
      capture::write_depth_exr(file(frame, ".depth.exr"), camera_.width, camera_.height,
                               render::depth_image(frame, camera_));
  }
  void finish() {
    if (movie_) movie_->finish();
  }

 private:
  Path file(const render::Frame& frame, const char* ending) const { return stem_ / frame_name(frame.frame, ending); }

  const DrawOptions& options_;
  const capture::Camera& camera_;
  Path stem_;
  std::optional<capture::VideoWriter> movie_;
};

// Returns how many frames were written.
int draw_camera(splat::Engine& engine, const Motion& motion, const Path& capture, const DrawOptions& options,
                std::size_t c) {
  const capture::Camera& camera = motion.scene.cameras[c];
  const std::vector<double>& times = motion.scene.times[c];
  const int count = covered_frames(motion, c);
  Files files(options, camera, times);
  std::optional<capture::FrameReader> reader;
  if (options.layout != render::Layout::drawn)
    reader.emplace(capture, camera.name, capture::FrameRange{0, motion.recorded[c]}, capture::Pixels::recorded);
  // RGB; empty where there is none. Frames are asked for in order.
  const auto recorded_at = [&](int number) {
    while (std::optional<capture::Frame> frame = reader ? reader->next() : std::nullopt)
      if (frame->frame == number) return std::move(frame->picture);
    return capture::Image8{};
  };
  int written = 0;
  const auto write = [&](std::vector<render::Frame>& batch) {
    std::vector<capture::Image8> recorded;
    for (const render::Frame& frame : batch) recorded.push_back(recorded_at(frame.frame));
    const auto picture = [&](std::size_t i) {
      const double share = static_cast<double>(batch[i].frame) / std::max<std::size_t>(1, times.size() - 1);
      return render::laid_out(options.layout, batch[i], camera, std::exchange(recorded[i], {}), share);
    };
    if (files.in_order()) {
      for (std::size_t i = 0; i < batch.size(); ++i) files.add(batch[i], picture(i));
    } else {  // compressing a picture takes ten times as long as drawing it
      core::parallel_for(static_cast<std::int64_t>(batch.size()),
                         [&](std::int64_t i) { files.add(batch[i], picture(i)); });
    }
    written += static_cast<int>(batch.size());
    core::report({"write " + camera.name, written, count, NAN, NAN, ""});
  };
  render::Options drawing;
  drawing.depth = options.depth;
  drawing.undistorted = options.undistorted;
  render::for_batches(engine, motion.twin.gaussians, motion.twin.chain, motion.states, motion.base, camera,
                      static_cast<int>(c), times, drawing, write);
  files.finish();
  return written;
}

}  // namespace

void DrawOptions::check() const {
  if (layout != render::Layout::drawn && undistorted)
    throw InputError("`undistorted`", "what was recorded has the lens distortion", "leave it or `layout` out");
  if (is_video(output) && (mask || depth))
    throw InputError("`mask`, `depth`", "go with a folder of frames, not with a video",
                     "let `output` end in another way than .mp4");
}

DrawResult draw(const Path& run, const Path& capture, const DrawOptions& options, const core::Listener& listener) {
  const core::ListenerScope scope(listener);
  options.check();
  check_output(options);
  const Motion motion = motion_of(run, capture, options);
  check_motion(run, capture, options, motion);
  const gpu::DevicePtr device = gpu::open_device({.selector = options.device});
  splat::Engine engine(*device);
  DrawResult result;
  for (std::size_t c = 0; c < motion.scene.cameras.size(); ++c)
    result.frames.emplace_back(motion.scene.cameras[c].name, draw_camera(engine, motion, capture, options, c));
  return result;
}

}  // namespace chainsplat::pipeline
