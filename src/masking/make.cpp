// A whole capture: samples for the background, rough masks, a chain through them, then the cut; twice.
#include <algorithm>
#include <cmath>

#include "chainsplat/silhouette.h"
#include "src/masking/look.h"

namespace chainsplat::masking {

using capture::Image8;
using capture::View;
using math::Vector2;

namespace {

constexpr int kBlock = 128;              // frames of one camera held in memory at once
constexpr int kSamples = 48;             // frames of a camera that background and colors are learned from
constexpr double kOftenCovered = 0.35;   // share of the frames within a diameter: the median picture may show the rope
constexpr double kMostlyCovered = 0.6;   // and here it does, at the grasp
constexpr double kAboutPixels = 24.0;    // px about a tube that are told apart from what is far
constexpr double kLeastUncovered = 0.2;  // of the samples that must show the background
constexpr int kLeastSamples = 4;
constexpr double kSeedFrom = 1.0, kSeedTo = 2.5;  // diameters from the grasp: leaves the gripper, not yet bent much
constexpr double kLinkDiameters = 1.5;            // length of a link of the chain that is laid into the masks
constexpr int kFewestJoints = 8, kMostJoints = 16;
constexpr double kOpenEnd = 1.0;      // diameters
constexpr int kRounds = 2;            // of learning, cutting and fitting
constexpr double kCenter = 0.5;       // of the radius: deeper inside than this counts as the centerline
constexpr double kLeastInside = 0.4;  // of the centerline within the masks, mean: less was no rope

struct Recording {
  const Path& path;
  const capture::Capture& capture;
  int first, last;
};

int frames_of(const Recording& recording, int camera) {
  const int all = static_cast<int>(recording.capture.times[camera].size());
  const int last = recording.last < 0 ? all : std::min(recording.last, all);
  return std::max(0, last - std::min(recording.first, last));
}

// Whole undistorted frames of one camera, a block at a time.
void each_block(const Recording& recording, int camera, const std::function<void(std::vector<View>&)>& body) {
  const int begin = recording.first, end = begin + frames_of(recording, camera);
  for (int first = begin; first < end; first += kBlock) {
    capture::LoadOptions options;
    options.masked = false;
    options.camera = recording.capture.cameras[camera].name;
    options.first = first;
    options.last = std::min(end, first + kBlock);
    capture::Capture block = capture::load(recording.path, options);
    for (View& view : block.views) view.camera = camera;
    body(block.views);
    if (core::stop_requested()) throw Interrupted(core::stop_requested());
  }
}

Picture picture_of(const View& view) { return {view.rgba.data(), view.width, view.height, 4}; }

// Some whole frames of one camera, and what is learned from them.
struct Samples {
  std::vector<View> frames;
  std::vector<Picture> pictures() const {
    std::vector<Picture> out;
    for (const View& view : frames) out.push_back(picture_of(view));
    return out;
  }
};

// Where the grasp stays longest: the largest share of the frames that is within a diameter of one of them, and its
// time.
struct Rest {
  double share = 0.0, time = 0.0;
};
Rest rest(const Recording& recording, const chain::Chain& chain, const Samples& samples) {
  const trajectory::Trajectory& base = recording.capture.base;
  Rest out;
  for (const View& a : samples.frames) {
    int near = 0;
    for (const View& b : samples.frames)
      near += (base.pose(a.time).translation - base.pose(b.time).translation).norm() < chain.diameter;
    const double share = near / static_cast<double>(samples.frames.size());
    if (share > out.share) out = {share, a.time};
  }
  return out;
}

bool masked_at(const View& view, int x, int y) {
  x -= view.x0, y -= view.y0;
  return x >= 0 && y >= 0 && x < view.width && y < view.height &&
         view.rgba[4 * (static_cast<std::size_t>(y) * view.width + x) + 3] != 0;
}

// Share of the chain's centerline, where the camera can see it, that lies in the mask.
double share_inside(const chain::Chain& chain, const math::Pose& base, const math::VectorX& theta,
                    const capture::Camera& recorded, const View& mask) {
  capture::Camera camera = recorded;
  camera.distortion = {};  // of the crop
  const Tube place = tube(chain, base, theta, camera, 0.0, chain.length, 0.0);
  int seen = 0, inside = 0;
  for (int y = place.box.y0; y < place.box.y1; ++y)
    for (int x = place.box.x0; x < place.box.x1; ++x)
      if (place.at(x, y) < -kCenter * place.radius) ++seen, inside += masked_at(mask, x, y);
  return seen ? inside / static_cast<double>(seen) : 1.0;
}

// The picture's mask in recorded pixels.
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
  // recorded pixels that the crop may show: its outline's images, and a little
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

}  // namespace

Summary make(const Path& path, const Options& options, const Sink& sink) {
  capture::LoadOptions headers;
  headers.images = false;
  capture::Capture scene = capture::load(path, headers);
  const Recording recording{path, scene, options.first, options.last};
  const int cameras = static_cast<int>(scene.cameras.size());
  int total = 0;
  for (int c = 0; c < cameras; ++c) total += frames_of(recording, c);
  if (total == 0) throw InputError(path.string(), "has no frame in the range asked for", "choose frames that it has");

  const int joints =
      std::clamp(static_cast<int>(scene.length / (kLinkDiameters * scene.diameter)), kFewestJoints, kMostJoints);
  const chain::Chain chain =
      chain::make_chain(scene.length, scene.diameter, scene.direction, scene.bending_axis, joints,
                        scene.tabletop ? chain::Bending::planar : chain::Bending::spatial, false);

  // colors near the grasp and, where the base moves, the background
  std::vector<Samples> samples(cameras);
  std::vector<Look> looks(cameras);
  std::vector<double> open_end(cameras, 0.0);
  const std::int64_t work = static_cast<std::int64_t>(total) * (kRounds + 2);
  std::int64_t done = 0;
  const auto tell = [&](const char* note, std::size_t frames) {
    done += static_cast<std::int64_t>(frames);
    core::report({"mask", done, work, std::nan(""), std::nan(""), note});
  };
  for (int c = 0; c < cameras; ++c) {
    const int stride = std::max(1, frames_of(recording, c) / kSamples);
    each_block(recording, c, [&](std::vector<View>& views) {
      for (View& view : views)
        if ((view.frame - recording.first) % stride == 0) samples[c].frames.push_back(std::move(view));
      tell("background", views.size());
    });
    const std::vector<Picture> pictures = samples[c].pictures();
    const Rest resting = rest(recording, chain, samples[c]);
    const math::VectorX straight = math::VectorX::Zero(chain.angles());
    const auto learn = [&](Look& look, const Picture& picture, double time) {
      const math::Pose base = scene.base.pose(time);
      const Tube seed = tube(chain, base, straight, scene.cameras[c], kSeedFrom * chain.diameter,
                             kSeedTo * chain.diameter, kAboutPixels);
      count_colors(look, picture, seed, reach(chain, base, scene.cameras[c]), chain, false);
    };
    for (const View& view : samples[c].frames) learn(looks[c], picture_of(view), view.time);
    Background median = median_background(pictures, {}, 1);
    if (resting.share > kOftenCovered) {
      // The median shows the rope too: there is no background yet, and the rope's end may have other colors.
      open_end[c] = kOpenEnd * chain.diameter;
      if (resting.share > kMostlyCovered) {  // at the grasp it shows nothing that passes by: its colors are better
        Look still;
        const Picture picture{median.rgb.data(), scene.cameras[c].width, scene.cameras[c].height, 3};
        learn(still, picture, resting.time);
        looks[c].near.object = still.near.object;
      }
    } else {
      looks[c].background = std::move(median);
    }
    looks[c].far = looks[c].near;
    settle(looks[c]);
  }

  Summary summary;
  chain::States states;
  const auto masks_by = [&](bool placed, const char* note, const std::function<void(std::vector<View>&)>& take) {
    for (int c = 0; c < cameras; ++c)
      each_block(recording, c, [&](std::vector<View>& views) {
        core::parallel_for(static_cast<std::int64_t>(views.size()), [&](std::int64_t i) {
          View& view = views[i];
          std::optional<math::VectorX> theta;
          if (placed) theta = chain::interpolate(states, view.time);
          View masked =
              cut(looks[c], picture_of(view), scene.cameras[c], chain, scene.base.pose(view.time), theta, open_end[c]);
          masked.camera = c, masked.frame = view.frame, masked.time = view.time;
          view = std::move(masked);
        });
        take(views);
        tell(note, views.size());
      });
  };
  for (int round = 0; round < kRounds; ++round) {
    capture::Capture masked = scene;
    masked.views.clear();
    masks_by(round > 0, round ? "cut" : "rough masks", [&](std::vector<View>& views) {
      for (View& view : views) masked.views.push_back(std::move(view));
    });
    const bool anything = std::any_of(masked.views.begin(), masked.views.end(), [](const View& v) { return v.width; });
    silhouette::SequenceFit fit;
    if (anything) fit = silhouette::fit_sequence(chain, masked);
    summary.inside = 0.0;
    for (const silhouette::FrameFit& frame : fit.frames) summary.inside += frame.inside;
    if (!fit.frames.empty()) summary.inside /= static_cast<double>(fit.frames.size());
    if (summary.inside < kLeastInside)
      throw InputError(path.string(), "nothing like the rope is found at the grasp",
                       "check cameras, base, length and direction (chainsplat check), or use --command");
    states = fit.states;
    for (int c = 0; c < cameras; ++c) {
      looks[c] = {};
      if (round > 0) open_end[c] = 0.0;  // seen by now
      std::vector<Tube> tubes;
      for (const View& view : samples[c].frames) {
        const math::Pose base = scene.base.pose(view.time);
        tubes.push_back(tube(chain, base, chain::interpolate(states, view.time), scene.cameras[c], 0.0,
                             chain.length + open_end[c], kAboutPixels));
        const auto mask = std::find_if(masked.views.begin(), masked.views.end(),
                                       [&](const View& m) { return m.camera == c && m.frame == view.frame; });
        count_colors(looks[c], picture_of(view), tubes.back(), reach(chain, base, scene.cameras[c]), chain, true,
                     &*mask, open_end[c]);
      }
      settle(looks[c]);
      const int count = static_cast<int>(tubes.size());
      looks[c].background = median_background(samples[c].pictures(), tubes,
                                              std::max(kLeastSamples, static_cast<int>(kLeastUncovered * count)));
    }
  }
  summary.inside = 0.0;
  masks_by(true, "cut", [&](std::vector<View>& views) {
    for (const View& view : views) {
      ++summary.frames;
      summary.inside += share_inside(chain, scene.base.pose(view.time), chain::interpolate(states, view.time),
                                     scene.cameras[view.camera], view);
      summary.empty += view.width == 0;
      sink(view.camera, view.frame, recorded_mask(view, scene.cameras[view.camera]));
    }
  });
  summary.inside /= summary.frames;
  return summary;
}

}  // namespace chainsplat::masking
