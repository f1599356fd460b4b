// frame_source.cpp - frames from a capture, a video, a device or standard input.
#include <algorithm>
#include <chrono>
#include <cmath>
#include <limits>

#include "chainsplat/follow.h"
#include "pipeline/bright_view.h"

namespace chainsplat::pipeline {

namespace {

constexpr int kBlack = 16;      // brightness up to which a pixel of a masked video is background (lossy coding)
constexpr int kMargin = 24;     // px about what a frame shows
constexpr int kMostStale = 30;  // frames of a device in a row whose time stamps do not increase

// What to add to a device's time stamp to have it in Unix time. Most drivers stamp by the monotonic clock, some in Unix
// time already.
double until_unix(double stamp) {
  const auto seconds = [](auto time) { return std::chrono::duration<double>(time.time_since_epoch()).count(); };
  const double monotonic = seconds(std::chrono::steady_clock::now()), unix = seconds(std::chrono::system_clock::now());
  return std::abs(stamp - monotonic) < std::abs(stamp - unix) ? unix - monotonic : 0.0;
}

// Whether the twin was made with this camera as it is given. A twin without corrections does not say.
bool is_unverified(const capture::Corrections& corrections, const capture::Camera& camera) {
  if (corrections.empty()) return false;
  const capture::Correction* const known = capture::find(corrections, camera.name, "rotation");
  return !known || known->calibration != capture::calibration_text(camera);
}

// A capture, loaded and checked as a whole.
FrameSource open_capture(const SourceOptions& options) {
  capture::LoadOptions load;
  load.camera = options.camera;
  load.first = options.frames.first, load.last = options.frames.last;
  FrameSource source;
  const auto recorded = std::make_shared<capture::Capture>(capture::load(options.source, load));
  for (const capture::Camera& camera : recorded->cameras)
    source.unverified.push_back(is_unverified(options.corrections, camera));
  capture::apply(options.corrections, *recorded);
  // in memory beforehand, so that frames come as fast as they are followed
  const auto pictures = std::make_shared<std::vector<capture::Image8>>();
  if (options.pictures) {
    capture::FrameReader reader(options.source, recorded->cameras.front().name, options.frames,
                                capture::Pixels::recorded);
    while (std::optional<capture::Frame> frame = reader.next()) pictures->push_back(std::move(frame->picture));
  }
  source.cameras = recorded->cameras;
  source.base = recorded->base;
  source.masked = true;
  // the first camera sets the pace, the others' frames of the moment join
  std::vector<double> moments;
  for (const capture::ViewPlace& view : recorded->views)
    if (view.camera == 0) moments.push_back(view.time);
  source.next = [recorded, pictures, together = capture::views_at(*recorded, moments),
                 at = std::size_t{0}](LiveFrame& frame) mutable {
    if (at >= together.size()) return false;
    const capture::ViewPlace& leader = recorded->views[at];
    frame.frame = leader.frame;
    frame.time = leader.time;
    frame.views.clear();
    for (const int v : together[at]) frame.views.push_back(capture::unpacked(recorded->views[v]));
    if (!pictures->empty()) frame.picture = pictures->at(at);
    ++at;
    frame.arrived = core::seconds_now();
    return true;
  };
  return source;
}

// Frames of one camera whose calibration is given: from a file, a device or standard input.
FrameSource open_stream(const SourceOptions& options) {
  const capture::Calibration calibration = capture::read_calibration(options.calibration);
  double rate = options.rate > 0.0 ? options.rate : calibration.rate, start = calibration.start;
  FrameSource source;
  source.cameras = as_corrected(options.corrections, {calibration.camera}, &source.unverified);
  source.cameras[0].mask_offset = 0.0;  // that of the masks which the twin was made of
  const double late = capture::value_of(options.corrections, calibration.camera.name, "time");
  const double half_readout = 0.5 * std::abs(source.cameras[0].readout);  // a frame's time is that of its middle row
  const auto reader = std::make_shared<capture::VideoReader>(
      options.source, 1,
      capture::DeviceFormat{.width = calibration.camera.width, .height = calibration.camera.height, .rate = rate});
  if (rate <= 0.0) rate = reader->rate();
  const bool device = reader->device();
  if (!device && rate <= 0.0)
    throw InputError("`rate`", "is needed to know the frames' times", "give frames a second, for example 30");
  const bool unix = options.unix_time;
  if (unix && !device) throw InputError("`start`", "only a device stamps its frames", "give seconds");
  if (options.start) start = *options.start;
  const std::string where = options.source == "-" ? "standard input" : options.source.string();
  // a device has a clock of its own, so that frames which were passed over leave a gap in time
  std::optional<double> offset;                             // from that clock to ours
  double stamp = -std::numeric_limits<double>::infinity();  // s, the last frame's by that clock
  source.next = [camera = source.cameras[0], frames = options.frames, reader, rate, start, where, device, unix, offset,
                 stamp, late, half_readout, count = 0](LiveFrame& frame) mutable {
    int stale = 0;  // in a row: some drivers' stamps jitter, others' are none
    do {
      if (frames.last >= 0 && count >= frames.last) return false;
      if (!reader->next(frame.picture)) return false;
      frame.frame = device ? reader->frames() - 1 : count;
      if (frames.last >= 0 && frame.frame >= frames.last) return false;
      if (frame.picture.width != camera.width || frame.picture.height != camera.height)
        throw WorkError(where,
                        "frame " + std::to_string(frame.frame) + " has " + std::to_string(frame.picture.width) + "x" +
                            std::to_string(frame.picture.height) + " pixels, the calibration says " +
                            std::to_string(camera.width) + "x" + std::to_string(camera.height),
                        "give the calibration of this camera; the states so far are kept");
      count = frame.frame + 1;
      stale = device && !(reader->time() > stamp) ? stale + 1 : 0;
      if (stale > kMostStale)
        throw WorkError(where, "its time stamps do not increase, from frame " + std::to_string(frame.frame - stale + 1),
                        "check the camera and its driver; the states so far are kept");
    } while (frame.frame < frames.first || stale > 0);
    if (device) stamp = reader->time();
    if (device && !offset) offset = unix ? until_unix(reader->time()) : start - reader->first_time();
    frame.time = (device ? reader->time() + *offset : start + frame.frame / rate) - late + half_readout;
    frame.views.clear();
    frame.arrived = core::seconds_now();
    return true;
  };
  return source;
}

}  // namespace

std::vector<capture::Camera> as_corrected(const capture::Corrections& corrections, std::vector<capture::Camera> cameras,
                                          std::vector<char>* unverified) {
  if (unverified) unverified->clear();
  for (capture::Camera& camera : cameras) {
    const bool unknown = is_unverified(corrections, camera);
    if (unverified) unverified->push_back(unknown);
    if (!unknown) camera = capture::corrected(corrections, camera);
    if (camera.readout == 0.0) camera.readout = capture::value_of(corrections, camera.name, "readout");
  }
  return cameras;
}

FrameSource open_frames(const SourceOptions& options) {
  if (options.calibration.empty()) {
    std::error_code error;
    const Path& file = options.source;
    const bool none = file == "-" || std::filesystem::is_character_file(file, error) ||
                      (std::filesystem::is_regular_file(file, error) && file.extension() != ".json");
    if (none)
      throw InputError("`calibration`", "is needed with " + file.string() + ", which is no capture",
                       "give a camera object as in capture.json");
    if (options.start || options.unix_time)
      throw InputError("`start`", "a capture has times of its own", "leave it out");
  }
  return options.calibration.empty() ? open_capture(options) : open_stream(options);
}

capture::View bright_view(const capture::Image8& picture, const capture::Camera& camera) {
  std::vector<std::int32_t> from(static_cast<std::size_t>(camera.width) * camera.height, -1);  // pixel; black: -1
  const bool distorted = camera.distorted();
  int x0 = camera.width, y0 = camera.height, x1 = 0, y1 = 0;
  for (int y = 0; y < camera.height; ++y)
    for (int x = 0; x < camera.width; ++x) {
      int u = x, v = y;
      if (distorted) {
        const math::Vector2 at = capture::distort(camera, math::Vector2(x + 0.5, y + 0.5));
        u = static_cast<int>(std::floor(at.x())), v = static_cast<int>(std::floor(at.y()));
        if (u < 0 || v < 0 || u >= camera.width || v >= camera.height) continue;
      }
      const std::int32_t pixel = v * camera.width + u;
      const std::uint8_t* const rgb = &picture.pixels[3 * static_cast<std::size_t>(pixel)];
      if (std::max({rgb[0], rgb[1], rgb[2]}) <= kBlack) continue;
      from[static_cast<std::size_t>(y) * camera.width + x] = pixel;
      x0 = std::min(x0, x), x1 = std::max(x1, x + 1), y0 = std::min(y0, y), y1 = y + 1;
    }
  capture::View view;
  if (x1 <= x0) return view;
  view.x0 = std::max(0, x0 - kMargin), view.y0 = std::max(0, y0 - kMargin);
  view.width = std::min(camera.width, x1 + kMargin) - view.x0;
  view.height = std::min(camera.height, y1 + kMargin) - view.y0;
  view.rgba.assign(4 * static_cast<std::size_t>(view.width) * view.height, 0);
  for (int y = 0; y < view.height; ++y)
    for (int x = 0; x < view.width; ++x) {
      const std::int32_t pixel = from[static_cast<std::size_t>(view.y0 + y) * camera.width + view.x0 + x];
      if (pixel < 0) continue;
      std::uint8_t* const rgba = &view.rgba[4 * (static_cast<std::size_t>(y) * view.width + x)];
      std::copy_n(&picture.pixels[3 * static_cast<std::size_t>(pixel)], 3, rgba);
      rgba[3] = 255;
    }
  return view;
}

}  // namespace chainsplat::pipeline
