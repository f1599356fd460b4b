#include "src/masking/recording.h"

#include <algorithm>
#include <cmath>

namespace chainsplat::masking {

using capture::Image8;
using capture::View;
using math::Vector2;

namespace {

// Memory for the frames of one camera that are held at once, so that all threads have some.
constexpr double kBlockBytes = 128.0 * 1024 * 1024;

// Where the scene without the rope is known, a moment's shots show what differs from it.
void take_away_scene(const Help& help, Moment& moment) {
  moment.differences.reserve(moment.shots.size());
  for (std::size_t k = 0; k < moment.shots.size(); ++k)
    if (const Image8* const empty = help.empty_of(moment.cameras[k])) {
      const Image8& shown = moment.differences.emplace_back(difference(*empty, moment.shots[k].picture));
      moment.shots[k].picture = {shown.pixels.data(), shown.width, shown.height, 3};
    }
}

// Adds the user's help to a moment's shots.
void add_help(const Help& help, const std::vector<Samples>& samples, Moment& moment) {
  for (std::size_t k = 0; k < moment.shots.size(); ++k) {
    const int c = moment.cameras[k];
    int frame = 0;
    for (const capture::Frame& one : samples[c].frames)
      if (picture_of(one).pixels == moment.shots[k].picture.pixels) frame = one.frame;
    for (const Help::Point& point : help.points)
      if (point.camera == c && point.frame == frame) moment.shots[k].on_rope.push_back(point.at);
    for (const Help::Region& region : help.boxes)
      if (region.camera == c && region.frame.value_or(frame) == frame) moment.shots[k].bounds = region.box;
  }
  take_away_scene(help, moment);  // last, since a shot's frame is told by its picture
}

}  // namespace

int frames_of(const Recording& recording, int camera) {
  const int all = static_cast<int>(recording.capture.times[camera].size());
  const int last = recording.last < 0 ? all : std::min(recording.last, all);
  return std::max(0, last - std::min(recording.first, last));
}

double frame_bytes(const capture::Camera& camera) { return 3.0 * camera.width * camera.height; }

void each_block(const Recording& recording, int camera, const std::function<void(std::vector<capture::Frame>&)>& body) {
  const capture::Camera& from = recording.capture.cameras[camera];
  const auto most = static_cast<std::size_t>(std::clamp(kBlockBytes / frame_bytes(from), 1.0, 1e6));
  capture::FrameReader reader(recording.path, from.name, {recording.first, recording.last},
                              capture::Pixels::undistorted);
  std::vector<capture::Frame> block;
  for (;;) {
    std::optional<capture::Frame> frame = reader.next();
    if (frame) block.push_back(std::move(*frame));
    if (block.size() == most || (!frame && !block.empty())) {
      body(block);
      block.clear();
      if (core::stop_requested()) throw Interrupted(core::stop_requested());
    }
    if (!frame) return;
  }
}

Picture picture_of(const capture::Frame& frame) {
  return {frame.picture.pixels.data(), frame.picture.width, frame.picture.height, 3};
}

std::vector<Picture> Samples::pictures() const {
  std::vector<Picture> out;
  for (const capture::Frame& frame : frames) out.push_back(picture_of(frame));
  return out;
}

std::vector<Moment> moments_of(const Recording& recording, const std::vector<Samples>& samples) {
  const capture::Capture& scene = recording.capture;
  const std::vector<capture::Camera>& cameras = recording.pinholes;
  const auto first = std::find_if(samples.begin(), samples.end(), [](const Samples& s) { return !s.frames.empty(); });
  std::vector<Moment> moments;
  const auto times_of = [](const Samples& some) {
    std::vector<double> times;
    for (const capture::Frame& frame : some.frames) times.push_back(frame.time);
    return times;
  };
  const std::vector<double> times = times_of(*first);
  for (const double time : times) moments.push_back({time, {}, {}, {}});
  // samples are some frames of many; together are those that all the frames' own interval says
  const double reach = capture::moment_reach(scene.times[first - samples.begin()]);
  for (std::size_t c = 0; c < samples.size(); ++c) {
    const std::vector<int> nearest = capture::frames_at(times, times_of(samples[c]), reach);
    for (std::size_t m = 0; m < times.size(); ++m) {
      if (nearest[m] < 0) continue;
      const capture::Frame& frame = samples[c].frames[nearest[m]];
      moments[m].shots.push_back({picture_of(frame),
                                  &cameras[c],
                                  cameras[c].world_from_camera.inverse() * scene.base.pose(frame.time),
                                  {},
                                  {}});
      moments[m].cameras.push_back(static_cast<int>(c));
    }
  }
  for (Moment& moment : moments) add_help(recording.help, samples, moment);
  return moments;
}

GrownMoments grow_moments(const Recording& recording, const chain::Chain& chain, const std::vector<Moment>& moments,
                          double least, const CluesOf& clues_of,
                          const std::function<bool(const std::vector<Grown>&)>& again) {
  std::vector<Tally> known(recording.capture.cameras.size());
  GrownMoments out;
  std::vector<Grown>& grown = out.grown;
  grown.resize(moments.size());
  for (int pass = 0; pass < 2; ++pass) {
    core::parallel_for(static_cast<std::int64_t>(moments.size()), [&](std::int64_t i) {
      std::vector<Tally> of_shots;
      for (const int c : moments[i].cameras) of_shots.push_back(known[c]);
      grown[i] = grow(chain, moments[i].shots, of_shots, clues_of(moments[i], pass));
    });
    if (core::stop_requested()) throw Interrupted(core::stop_requested());
    out.best = 0.0;
    for (const Grown& one : grown) out.best = std::max(out.best, one.evidence);
    if (out.best < least) throw_nothing(recording);
    if (pass == 1 || (again && !again(grown))) break;
    for (std::size_t i = 0; i < moments.size(); ++i)
      for (std::size_t k = 0; grown[i].evidence > kTrusted * out.best && k < moments[i].cameras.size(); ++k)
        add(known[moments[i].cameras[k]], grown[i].tallies[k]);
    for (Tally& tally : known) tally = scaled(tally, kKnownSamples);
  }
  return out;
}

bool masked_at(const View& view, int x, int y) {
  x -= view.x0, y -= view.y0;
  return x >= 0 && y >= 0 && x < view.width && y < view.height &&
         view.rgba[4 * (static_cast<std::size_t>(y) * view.width + x) + 3] != 0;
}

Image8 recorded_mask(const View& view, const capture::Camera& camera) {
  Image8 mask{camera.width, camera.height, 1, {}};
  mask.pixels.assign(static_cast<std::size_t>(camera.width) * camera.height, 0);
  if (view.width == 0) return mask;
  const auto inside = [&](int x, int y) { return masked_at(view, x, y); };
  if (!camera.distorted()) {
    for (int y = view.y0; y < view.y0 + view.height; ++y)
      for (int x = view.x0; x < view.x0 + view.width; ++x)
        if (inside(x, y)) mask.pixels[static_cast<std::size_t>(y) * camera.width + x] = 255;
    return mask;
  }
  // visit the recorded pixels that the crop may show, within the bounds of its distorted border, and sample the crop
  double x0 = 1e9, y0 = 1e9, x1 = -1e9, y1 = -1e9;
  const auto include = [&](int x, int y) {
    const Vector2 p = capture::distort(camera, Vector2(x, y));
    x0 = std::min(x0, p.x()), x1 = std::max(x1, p.x()), y0 = std::min(y0, p.y()), y1 = std::max(y1, p.y());
  };
  for (int x = view.x0; x <= view.x0 + view.width; ++x) include(x, view.y0), include(x, view.y0 + view.height);
  for (int y = view.y0; y <= view.y0 + view.height; ++y) include(view.x0, y), include(view.x0 + view.width, y);
  for (int y = std::max(0, static_cast<int>(y0)); y < std::min(camera.height, static_cast<int>(y1) + 1); ++y)
    for (int x = std::max(0, static_cast<int>(x0)); x < std::min(camera.width, static_cast<int>(x1) + 1); ++x) {
      const Vector2 p = capture::undistort(camera, Vector2(x + 0.5, y + 0.5)) - Vector2(0.5, 0.5);
      const int u = static_cast<int>(std::floor(p.x())), v = static_cast<int>(std::floor(p.y()));
      const double a = p.x() - u, b = p.y() - v;
      const double share = (1 - b) * ((1 - a) * inside(u, v) + a * inside(u + 1, v)) +
                           b * ((1 - a) * inside(u, v + 1) + a * inside(u + 1, v + 1));
      if (share >= 0.5) mask.pixels[static_cast<std::size_t>(y) * camera.width + x] = 255;
    }
  return mask;
}

void throw_nothing(const Recording& recording) {
  throw InputError(recording.path.string(), "nothing like the rope is found at the grasp",
                   "check cameras, base, length and direction (chainsplat check), or use `command`");
}

}  // namespace chainsplat::masking
