// follow.cpp - frame by frame: the mask where there is none, the estimate, and whoever wants it.
#include "chainsplat/follow.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <span>
#include <variant>

#include "chainsplat/estimation.h"
#include "chainsplat/gpu.h"
#include "chainsplat/masking.h"
#include "chainsplat/run_folder.h"
#include "chainsplat/shutter.h"
#include "pipeline/bright_view.h"

namespace chainsplat::pipeline {

namespace {

using Views = std::span<const capture::View* const>;

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
  const splat::Picture drawn = std::move(engine.draw_set({&spec, 1}).front());
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

// The device's kernels are made at their first use, and its buffers grow, which no frame shall wait for: it is shown
// masks that fill the pictures, which no frame does, and masks of a size that a rope's may have. `motions`: of the
// links at rest.
void warm_up(const estimation::CompareColors& compare_colors, const std::vector<capture::Camera>& cameras,
             const std::vector<math::Pose>& motions) {
  constexpr int kMostWidth = 2048, kMostHeight = 1536;  // px; larger masks can be more than the device takes at once
  for (const int share : {1, 4}) {
    std::vector<capture::View> views;
    std::vector<const capture::View*> pointers;
    for (const capture::Camera& camera : cameras) {
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
    compare_colors(pointers, cameras, std::vector<std::vector<math::Pose>>(views.size(), motions));
  }
}

// m, by which a rope may seem to begin beside its grasp, where a camera is not known to stand where it is said to: a
// turn of half a degree moves what is a meter away by 9 mm.
constexpr double kSeemsOff = 0.008;

std::string name_of(const SourceOptions& source) {
  return source.source.string() + (source.camera.empty() ? "" : ":" + source.camera);
}

}  // namespace

struct Tracker::Implementation {
  Implementation(const twin::Twin& twin, const std::vector<capture::Camera>& cameras,
                 const std::vector<char>& unverified, dynamics::BaseFunction base, double start,
                 const TrackerOptions& options);

  using Kinds = std::variant<estimation::Filter, estimation::AdamFollower>;

  TrackerOptions options;
  twin::Twin twin;
  dynamics::BaseFunction base;  // as given
  gpu::DevicePtr device;
  std::optional<splat::Engine> engine;  // none: outlines alone
  Kinds follower;
  std::optional<bool> masked_before;                       // by the first picture
  std::optional<masking::LiveMasks> live;                  // masks made here
  bool unsure_of_pose = false;                             // a camera's pose was not compared with the rope
  std::array<int, 4> masked = {0, 0, 0, 0};                // crop of the last mask: x0, y0, width, height
  int marked = -1;                                         // frames that were masked when marks were learned last
  double last = -std::numeric_limits<double>::infinity();  // s, of the last frame
  math::VectorX last_theta;                                // rad, in it; empty: none yet

  void open_engine();
  std::vector<capture::View> read_at_once(std::span<const capture::View> views) const;
  Kinds make_follower(const std::vector<capture::Camera>& cameras, const std::vector<char>& unverified, double start);
  estimation::CompareColors color_comparison();
  estimation::LinkGradient link_gradient();
  void look_at_first_picture(const capture::Image8& picture);
  void learn_marks(const math::Pose& pose, const math::VectorX& theta);

  // What both kinds of followers tell.
  std::optional<math::VectorX> expected(double time) const {
    return std::visit([&](const auto& f) { return f.expected(time); }, follower);
  }
  const std::vector<capture::Camera>& cameras() const {
    return std::visit([](const auto& f) -> const std::vector<capture::Camera>& { return f.cameras(); }, follower);
  }
  math::Pose believed_base(double time) const {
    return std::visit([&](const auto& f) { return f.base_at(time); }, follower).pose;
  }
  const math::VectorX& rest() const {
    return std::visit([](const auto& f) -> const math::VectorX& { return f.rest(); }, follower);
  }
};

Tracker::Implementation::Implementation(const twin::Twin& followed, const std::vector<capture::Camera>& cameras,
                                        const std::vector<char>& unverified, dynamics::BaseFunction given, double start,
                                        const TrackerOptions& wanted)
    : options(wanted),
      twin(followed),
      base(std::move(given)),
      follower(make_follower(cameras, unverified, start)),
      unsure_of_pose(std::find(unverified.begin(), unverified.end(), 1) != unverified.end()) {}

Tracker::Implementation::Kinds Tracker::Implementation::make_follower(const std::vector<capture::Camera>& cameras,
                                                                      const std::vector<char>& unverified,
                                                                      double start) {
  if (cameras.empty()) throw InputError("`cameras`", "there is none", "give those whose frames will come");
  if (!twin.parameters)
    core::warn("the twin: its dynamics are not identified; angles are assumed to go on at constant rate");
  for (std::size_t c = 0; c < unverified.size(); ++c)
    if (unverified[c])
      core::warn(cameras[c].name + ": the twin was not made with this calibration; deviations allow for its errors");
  open_engine();
  if (options.solver == Solver::adam) return estimation::AdamFollower(twin, cameras, base, start, link_gradient());
  const estimation::CompareColors compare = engine ? color_comparison() : nullptr;
  estimation::Filter filter(twin, cameras, base, start, {}, unverified, compare);
  if (compare) warm_up(compare, cameras, chain::link_motions(twin.chain, filter.rest(), base(start).pose));
  return filter;
}

void Tracker::Implementation::open_engine() {
  if (options.solver != Solver::silhouette && twin.gaussians.count > 0) {
    try {
      device = gpu::open_device({.selector = options.device});
      engine.emplace(*device);
    } catch (const InputError& error) {
      if (options.solver || !options.device.empty()) throw;  // asked for
      core::warn(std::string(error.what()) + "; the rope is followed by its outline alone");
    }
  }
  if (options.solver == Solver::adam && !engine)
    throw InputError("`solver`", "adam draws the twin, and it has no Gaussians", "train it first");
}

estimation::CompareColors Tracker::Implementation::color_comparison() {
  engine->set_gaussians(twin.gaussians);
  return
      [this](Views views, std::span<const capture::Camera> cameras, std::span<const std::vector<math::Pose>> motions) {
        std::vector<splat::ViewSpec> specs;
        std::vector<const std::vector<std::uint8_t>*> pixels;
        for (std::size_t v = 0; v < views.size(); ++v) {
          const capture::View& view = *views[v];
          specs.push_back({&cameras[view.camera], view.x0, view.y0, view.width, view.height, motions[v]});
          pixels.push_back(&view.rgba);
        }
        return engine->color_sums(twin.chain, specs, pixels);
      };
}

estimation::LinkGradient Tracker::Implementation::link_gradient() {
  return [this](const capture::View& view, const capture::Camera& camera, const std::vector<math::Pose>& motions) {
    const splat::ViewSpec spec{&camera, view.x0, view.y0, view.width, view.height, motions};
    const std::vector<std::uint8_t>* const target = &view.rgba;
    splat::Gradients gradients;
    engine->loss(twin.gaussians, {&spec, 1}, {&target, 1}, {}, static_cast<double>(camera.width) * camera.height,
                 &gradients);
    return std::move(gradients.link_twists.front());
  };
}

// The first picture shows whether masks have to be made.
void Tracker::Implementation::look_at_first_picture(const capture::Image8& picture) {
  masked_before = black_about(picture);
  if (*masked_before) return;
  if (auto* filter = std::get_if<estimation::Filter>(&follower)) {
    estimation::Options live_masks = estimation::options_for_live_masks(twin.tabletop);
    live_masks.doubtful_frames = masking::LiveMasks::kBackgroundFrames;
    filter->set_options(live_masks);
  }
  const std::vector<std::uint8_t> colors = twin_colors(twin);
  if (colors.empty())
    core::warn(options.name + ": is not masked, and the twin has no colors to find the rope by; what is " +
               "not black is taken for the rope");
  else
    live.emplace(cameras()[0], twin.chain, colors);
}

// As if the cameras read all rows at once, by the motion from the last frame to what is expected in this one: as it is
// where nothing is expected.
std::vector<capture::View> Tracker::Implementation::read_at_once(std::span<const capture::View> views) const {
  std::vector<capture::View> out(views.begin(), views.end());
  const double time = views[0].time;
  const std::optional<math::VectorX> here = expected(time);
  if (!here || last_theta.size() == 0) return out;
  const math::VectorX rate = (*here - last_theta) / (time - last);
  const silhouette::NodesAt nodes = [&](double at) {
    const math::Pose pose = std::visit([&](const auto& f) { return f.base_at(at); }, follower).pose;
    return chain::nodes(twin.chain, chain::link_motions(twin.chain, *here + (at - time) * rate, pose));
  };
  core::parallel_for(static_cast<std::int64_t>(out.size()), [&](std::int64_t i) {
    out[i] = silhouette::as_read_at_once(out[i], cameras()[out[i].camera], capture::Pixels::undistorted, nodes);
  });
  return out;
}

// Every tenth frame: the rope shows nearly the same side.
void Tracker::Implementation::learn_marks(const math::Pose& pose, const math::VectorX& theta) {
  constexpr int kMarksEvery = 10;  // frames
  if (!engine || !live || live->frames() % kMarksEvery != 0 || marked == live->frames()) return;
  live->learn_marks(drawn_view(*engine, twin, cameras()[0], pose, theta, masked), pose, theta);
  marked = live->frames();
}

Tracker::Tracker(const twin::Twin& twin, const std::vector<capture::Camera>& cameras, dynamics::BaseFunction base,
                 double start, const TrackerOptions& options, const std::vector<char>& unverified)
    : implementation_(std::make_unique<Implementation>(twin, cameras, unverified, std::move(base), start, options)) {}
Tracker::~Tracker() = default;
Tracker::Tracker(Tracker&&) noexcept = default;
Tracker& Tracker::operator=(Tracker&&) noexcept = default;

estimation::Estimate Tracker::update(std::span<const capture::View> views) {
  Implementation& t = *implementation_;
  if (views.empty()) throw InputError(t.options.name, "the moment has no view", "give one, which may be empty");
  for (const capture::View& view : views)
    if (view.camera < 0 || view.camera >= static_cast<int>(t.cameras().size()))
      throw InputError(t.options.name, "there is no camera " + std::to_string(view.camera), "count them from 0");
  if (!(views[0].time > t.last))
    throw InputError(t.options.name, core::exact(views[0].time) + " s is not after the frame before",
                     "give times that increase");
  std::vector<capture::View> mended;
  if (silhouette::has_rolling_shutter(t.cameras())) {
    mended = t.read_at_once(views);
    views = mended;
  }
  t.last = views[0].time;
  std::vector<const capture::View*> pointers;
  for (const capture::View& view : views) pointers.push_back(&view);
  estimation::Estimate out = std::visit([&](auto& f) { return f.update(pointers); }, t.follower);
  t.last_theta = out.theta;
  return out;
}

capture::View Tracker::mask(const capture::Image8& picture, double time) {
  Implementation& t = *implementation_;
  const capture::Camera& camera = t.cameras()[0];
  if (!t.masked_before) t.look_at_first_picture(picture);
  const auto marked = [&](capture::View view) {
    view.time = time;
    return view;
  };
  if (!t.live) return marked(bright_view(picture, camera));
  const std::optional<math::VectorX> theta = t.expected(time);
  const math::Pose pose = t.believed_base(time);
  t.live->see_from(camera.world_from_camera);
  t.learn_marks(pose, theta.value_or(t.rest()));  // marks stay on the rope wherever it lies
  capture::View view = t.live->mask(picture, pose, theta, {t.rest(), t.unsure_of_pose ? kSeemsOff : 0.0});
  t.masked = {view.x0, view.y0, view.width, view.height};
  return marked(std::move(view));
}

void Tracker::between_frames(std::optional<double> next) {
  Implementation& t = *implementation_;
  if (const std::optional<math::VectorX> theta = t.live ? t.expected(t.last) : std::nullopt)
    t.learn_marks(t.believed_base(t.last), *theta);
  if (!next || !(*next > t.last)) return;
  const std::optional<math::VectorX> theta = t.expected(*next);  // the follower keeps what it took to know them
  if (theta && t.live) {
    t.live->see_from(t.cameras()[0].world_from_camera);
    t.live->expect(t.believed_base(*next), *theta);
  }
}

const twin::Twin& Tracker::twin() const { return implementation_->twin; }
const dynamics::Model& Tracker::model() const {
  return std::visit([](const auto& f) -> const dynamics::Model& { return f.model(); }, implementation_->follower);
}
trajectory::BaseMotion Tracker::base_at(double time) const {
  return std::visit([&](const auto& f) { return f.base_at(time); }, implementation_->follower);
}
std::vector<capture::Finding> Tracker::findings() const {
  const auto* const filter = std::get_if<estimation::Filter>(&implementation_->follower);
  return filter ? filter->findings() : std::vector<capture::Finding>{};
}
const std::vector<capture::Camera>& Tracker::cameras() const { return implementation_->cameras(); }

void FollowOptions::check() const {
  if (drop < 1) throw InputError("`drop`", "must be 1 or more", "give 2 for every second frame");
  if (std::isnan(source.rate)) throw InputError("`rate`", "is not a number", "give frames a second");
}

struct Follower::Implementation {
  Implementation(const Path& folder, const FollowOptions& wanted);

  Path run;
  FollowOptions options;
  std::string source_name, base_name;
  FrameSource source;
  trajectory::Trajectory base;
  std::optional<Tracker> tracker;

  void open_base();
  void check_time(const LiveFrame& frame, bool first) const;
};

Follower::Implementation::Implementation(const Path& folder, const FollowOptions& wanted)
    : run(folder),
      options(wanted),
      source_name(name_of(wanted.source)),
      base_name(wanted.base.empty() ? source_name : wanted.base.string()) {
  options.check();
  const twin::Twin twin = load_twin(run);
  options.source.corrections = twin.corrections;
  source = open_frames(options.source);
  open_base();
  tracker.emplace(
      twin, source.cameras, [this](double time) { return base.at(time); }, base.start(),
      TrackerOptions{options.solver, options.device, source_name}, source.unverified);
}

void Follower::Implementation::open_base() {
  if (!options.base.empty()) {
    base = read_base(options.base);
  } else if (source.base) {
    base = *source.base;
  } else {
    const trajectory::Trajectory own = own_base(run);
    base = trajectory::fit({{own.start(), own.pose(own.start())}}, run.string());
    core::warn("`base`: is missing; the base is assumed to rest where the twin's capture began");
  }
}

// Whether the base's motion is known then.
void Follower::Implementation::check_time(const LiveFrame& frame, bool first) const {
  constexpr double kSlack = 1.0 / 30.0;    // s, a frame beyond the first or last sample
  if (base.samples().size() <= 1) return;  // it rests
  if (first && frame.time < base.start() - kSlack)
    core::warn(base_name + ": the base motion begins " + core::exact(base.start() - frame.time) +
               " s after the first frame; until then the base is assumed to rest where it begins");
  if (frame.time > base.end() + kSlack)
    throw WorkError(
        base_name,
        "the base motion ends at " + core::exact(base.end()) + " s, before frame " + std::to_string(frame.frame),
        "give a base motion as long as the frames; the states so far are kept");
}

Follower::Follower(const Path& run, const FollowOptions& options)
    : implementation_(std::make_unique<Implementation>(run, options)) {}
Follower::~Follower() = default;

void Follower::follow(const std::function<void(const Followed&)>& each) {
  Implementation& f = *implementation_;
  LiveFrame frame;
  std::vector<capture::View> made;
  double last = -std::numeric_limits<double>::infinity();  // s
  std::optional<double> used;                              // s, time of the frame before that was followed
  for (int read = 0; f.source.next(frame); ++read) {
    core::stop_if_requested();
    if (!(frame.time > last))
      throw WorkError(
          f.source_name,
          "frame " + std::to_string(frame.frame) + " is at " + core::exact(frame.time) + " s, not after the one before",
          "give times that increase, and near enough to 0 that a frame's interval is told; the states so "
          "far are kept");
    last = frame.time;
    if (read % f.options.drop != 0) continue;
    f.check_time(frame, read == 0);
    if (!f.source.masked) {
      made.assign(1, f.tracker->mask(frame.picture, frame.time));
      made[0].frame = frame.frame;
    }
    const std::vector<capture::View>& views = f.source.masked ? frame.views : made;
    estimation::Estimate estimate = f.tracker->update(views);
    if (f.options.base.empty() && f.source.base)
      estimate.base = estimation::base_correction(f.options.source.corrections) * estimate.base;
    each({frame, views, estimate, core::seconds_now() - frame.arrived});
    f.tracker->between_frames(used ? std::optional(2.0 * frame.time - *used) : std::nullopt);
    used = frame.time;
  }
}

const twin::Twin& Follower::twin() const { return implementation_->tracker->twin(); }
const dynamics::Model& Follower::model() const { return implementation_->tracker->model(); }
const trajectory::Trajectory& Follower::base() const { return implementation_->base; }
trajectory::BaseMotion Follower::base_at(double time) const { return implementation_->tracker->base_at(time); }
std::vector<capture::Finding> Follower::findings() const { return implementation_->tracker->findings(); }
const std::vector<capture::Camera>& Follower::cameras() const { return implementation_->tracker->cameras(); }

}  // namespace chainsplat::pipeline
