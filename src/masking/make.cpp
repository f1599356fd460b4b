// The masks of a whole capture: chains grown in some moments, colors and background learned from them, then masks and
// chains in turn.
#include <algorithm>
#include <atomic>
#include <cmath>

#include "chainsplat/masking.h"
#include "chainsplat/silhouette.h"
#include "src/masking/cut.h"
#include "src/masking/make_stills.h"
#include "src/masking/recording.h"
#include "src/masking/ribbon.h"

namespace chainsplat::masking {

using capture::Frame;
using capture::PackedView;
using capture::View;

namespace {

// what is learned from
constexpr int kSamples = 48;  // frames per camera from which background and colors are learned,
constexpr double kSampleBytes = 2048.0 * 1024 * 1024;  // fewer where those of all cameras would take more than this
constexpr double kLeastUncovered = 0.2;                // share of the samples that must show a pixel's background
constexpr int kLeastSamples = 4;
// the chain
constexpr double kLinkDiameters = 1.5;  // length of a link in diameters, unless the number of joints hits its bounds
constexpr int kFewestJoints = 8, kMostJoints = 16;
constexpr double kFacing = 0.5;  // cosine between view and bending axis, above which one camera sees the rope's plane
// chains grown in moments
constexpr double kLeastEvidence = 0.1;  // nats per sample in the best moment, below which there is no rope
constexpr double kUsable = 0.5;         // share of the best moment's evidence from which on a moment's chain is used
// masks and chains in turn
constexpr double kRoughPlace = 3.0;   // times the usual uncertainty of the place, as long as chains are grown ones
constexpr int kRounds = 2;            // of cutting, fitting and learning
constexpr double kCenter = 0.5;       // of the radius; pixels deeper inside than this count as the centerline
constexpr double kLeastInside = 0.4;  // mean share of the centerline in the masks, below which there is no rope

// The interpolated angles, constant beyond the ends, where the first and last frames may lie.
math::VectorX at(const chain::States& states, double time) {
  return chain::interpolate(states, std::clamp(time, states.time.front(), states.time.back()));
}

// Returns the share of the chain's centerline within the image that lies in the mask.
double share_inside(const chain::Chain& chain, const math::Pose& base, const math::VectorX& theta,
                    const capture::Camera& recorded, const View& mask) {
  capture::Camera camera = recorded;
  camera.distortion = {};  // the crop has none
  const Tube place = tube(chain, base, theta, camera, 0.0, chain.length, 0.0);
  int visible = 0, inside = 0;
  for (int y = place.box.y0; y < place.box.y1; ++y)
    for (int x = place.box.x0; x < place.box.x1; ++x)
      if (place.at(x, y) < -kCenter * place.radius) ++visible, inside += masked_at(mask, x, y);
  return visible ? inside / static_cast<double>(visible) : 1.0;
}

// The chain that masks are made about. One camera does not see depth: its chain is planar, in the rope's own plane
// where the camera sees that from the side, else in the plane through the rope's direction that faces it.
chain::Chain chain_for(const capture::Capture& scene) {
  const int joints =
      std::clamp(static_cast<int>(scene.length / (kLinkDiameters * scene.diameter)), kFewestJoints, kMostJoints);
  const bool one = scene.cameras.size() == 1 && !scene.tabletop;
  math::Vector3 axis = scene.bending_axis;
  if (one) {
    const math::Pose base = scene.base.pose(scene.times[0].empty() ? 0.0 : scene.times[0].front());
    const capture::Camera& camera = scene.cameras[0];
    const math::Vector3 view =
        base.rotation.transpose() * (base.translation - camera.world_from_camera.translation).normalized();
    const math::Vector3 facing = view - view.dot(scene.direction) * scene.direction;
    if (std::abs(view.dot(axis)) < kFacing && facing.norm() > kFacing) axis = facing.normalized();
  }
  return chain::make_chain(scene.length, scene.diameter, scene.direction, axis, joints,
                           scene.tabletop || one ? chain::Bending::planar : chain::Bending::spatial, false);
}

// Says how far the work is; several threads may tell.
class Progress {
 public:
  explicit Progress(std::int64_t all) : all_(all) {}
  void tell(const char* note, std::size_t count) {
    const std::int64_t now = done_ += static_cast<std::int64_t>(count);
    core::report({"mask", now, all_, std::nan(""), std::nan(""), note});
  }

 private:
  std::int64_t all_;
  std::atomic<std::int64_t> done_{0};
};

// Throws InputError of a point of the user's that the rope cannot reach.
void require_within_reach(const Recording& recording, const chain::Chain& chain) {
  const capture::Capture& scene = recording.capture;
  for (const Help::Point& point : recording.help.points) {
    const math::Pose base = scene.base.pose(scene.times[point.camera][point.frame]);
    const Reach where = reach(chain, base, recording.pinholes[point.camera]);
    const double away = (point.at - where.grasp).norm();
    if (where.radius <= 0.0 || away <= where.radius) continue;
    char text[120];
    std::snprintf(text, sizeof text, "lies %.0f px from the grasp, and the rope reaches %.0f px at most", away,
                  where.radius);
    throw InputError(point.text, text, "point at the rope, or check its length, the base's poses and the camera");
  }
}

// Frames that are evenly spread, and those in which the user points at the rope; by camera.
std::vector<Samples> take_samples(const Recording& recording, Progress& progress) {
  const int cameras = static_cast<int>(recording.capture.cameras.size());
  std::vector<Samples> samples(cameras);
  for (int c = 0; c < cameras; ++c) {
    const double room = kSampleBytes / (cameras * frame_bytes(recording.capture.cameras[c]));
    const int stride =
        std::max(1, frames_of(recording, c) / static_cast<int>(std::clamp<double>(room, kLeastSamples, kSamples)));
    each_block(recording, c, [&](std::vector<Frame>& frames) {
      for (Frame& frame : frames)
        if ((frame.frame - recording.first) % stride == 0 || recording.help.points_at(c, frame.frame))
          samples[c].frames.push_back(std::move(frame));
      progress.tell("samples", frames.size());
    });
  }
  return samples;
}

// A chain for each moment that shows the rope.
chain::States grown_states(const Recording& recording, const chain::Chain& chain, const std::vector<Moment>& moments) {
  const auto [grown, best] =
      grow_moments(recording, chain, moments, kLeastEvidence, [](const Moment&, int) { return Clues{}; });
  chain::States states;
  for (std::size_t i = 0; i < moments.size(); ++i)
    if (grown[i].evidence > kUsable * best) {
      states.time.push_back(moments[i].time);
      states.theta.push_back(grown[i].theta);
    }
  return states;
}

// Learns a camera's appearance from its samples, with a chain for each and, where there are any, the masks of all
// frames.
Look learn(const Recording& recording, const chain::Chain& chain, int camera, const Samples& samples,
           const chain::States& states, const std::vector<PackedView>* masks) {
  const capture::Camera& pinhole = recording.pinholes[camera];
  const auto base_at = [&](const Frame& frame) { return recording.capture.base.pose(frame.time); };
  const std::vector<Picture> pictures = samples.pictures();
  std::vector<Tube> tubes;
  for (const Frame& frame : samples.frames)
    tubes.push_back(tube(chain, base_at(frame), at(states, frame.time), pinhole, 0.0, chain.length, kAboutPixels));
  Look look;
  if (masks) look.marks = marks(pictures, tubes, chain);  // a grown chain is too inaccurate for marks
  for (std::size_t i = 0; i < tubes.size(); ++i) {
    const Frame& frame = samples.frames[i];
    View mask;
    if (masks)
      mask = capture::unpacked(*std::find_if(masks->begin(), masks->end(), [&](const PackedView& m) {
        return m.camera == camera && m.frame == frame.frame;
      }));
    count_colors(look, pictures[i], tubes[i], reach(chain, base_at(frame), pinhole), chain,
                 masks ? kFitMargin : kGrownMargin * tubes[i].radius, masks ? &mask : nullptr);
  }
  settle(look);
  const capture::Image8* const empty = recording.help.empty_of(camera);
  const int uncovered = std::max(kLeastSamples, static_cast<int>(kLeastUncovered * tubes.size()));
  look.background = empty && !pictures.empty() ? empty_scene(*empty, pictures.front())
                                               : median_background(pictures, tubes, uncovered);
  return look;
}

std::vector<Look> learn_all(const Recording& recording, const chain::Chain& chain, const std::vector<Samples>& samples,
                            const chain::States& states, const std::vector<PackedView>* masks) {
  std::vector<Look> looks;
  for (std::size_t c = 0; c < samples.size(); ++c)
    looks.push_back(learn(recording, chain, static_cast<int>(c), samples[c], states, masks));
  return looks;
}

// Cuts the masks of all frames about the chains, and passes them with their scores to `consume`, block by block.
// `place`: times the usual uncertainty of the chain's place.
void cut_all(const Recording& recording, const chain::Chain& chain, const chain::States& states,
             const std::vector<Look>& looks, double place, const std::function<void(std::size_t)>& tell,
             const std::function<void(std::vector<View>&, const std::vector<double>& scores)>& consume) {
  for (int c = 0; c < static_cast<int>(looks.size()); ++c)
    each_block(recording, c, [&](std::vector<Frame>& frames) {
      std::vector<View> views(frames.size());
      std::vector<double> scores(frames.size());
      core::parallel_for(static_cast<std::int64_t>(frames.size()), [&](std::int64_t i) {
        if (core::stop_requested()) throw Interrupted(core::stop_requested());
        Frame& frame = frames[i];
        const Picture picture = picture_of(frame);
        const math::Pose base = recording.capture.base.pose(frame.time);
        const math::VectorX theta = at(states, frame.time);
        const capture::Camera& pinhole = recording.pinholes[c];
        views[i] = cut(looks[c], picture, pinhole, chain, base, theta, place);
        views[i].camera = c, views[i].frame = frame.frame, views[i].time = frame.time;
        scores[i] = score(evidence(picture, axis(chain, base, theta, pinhole, 0.0, chain.length)));
        frame.picture = {};  // the masks of all frames are kept
        tell(1);
      });
      consume(views, scores);
    });
}

// Chains fitted to the masks. Throws InputError where too little of them lies in the masks.
chain::States fit_chains(const Recording& recording, const chain::Chain& chain, const capture::Capture& masked) {
  const bool anything =
      std::any_of(masked.views.begin(), masked.views.end(), [](const PackedView& v) { return v.width; });
  if (!anything) throw_nothing(recording);
  const silhouette::SequenceFit fit = silhouette::fit_sequence(chain, masked);
  double inside = 0.0;
  for (const silhouette::FrameFit& frame : fit.frames) inside += frame.inside;
  if (inside / static_cast<double>(fit.frames.size()) < kLeastInside) throw_nothing(recording);
  return fit.states;
}

// The masks of a video: rounds of masks, chains fitted to them, and appearance learned from both.
Summary make_video(const Recording& recording, const chain::Chain& chain, const std::vector<Samples>& samples,
                   Progress& progress, const Sink& sink) {
  const capture::Capture& scene = recording.capture;
  chain::States states = grown_states(recording, chain, moments_of(recording, samples));
  std::vector<Look> looks = learn_all(recording, chain, samples, states, nullptr);
  for (int round = 0; round < kRounds; ++round) {
    capture::Capture masked = scene;
    masked.views.clear();
    const auto tell = [&](std::size_t count) { progress.tell(round ? "cut" : "rough masks", count); };
    cut_all(recording, chain, states, looks, round ? 1.0 : kRoughPlace, tell,
            [&](std::vector<View>& views, const auto&) {
              for (const View& view : views) masked.views.push_back(capture::packed(view));
            });
    states = fit_chains(recording, chain, masked);
    looks = learn_all(recording, chain, samples, states, &masked.views);
  }
  Summary summary;
  const auto tell = [&](std::size_t count) { progress.tell("cut", count); };
  cut_all(recording, chain, states, looks, 1.0, tell, [&](std::vector<View>& views, const std::vector<double>& scores) {
    for (std::size_t i = 0; i < views.size(); ++i) {
      const View& view = views[i];
      const capture::Camera& camera = scene.cameras[view.camera];
      ++summary.frames;
      summary.inside +=
          share_inside(chain, scene.base.pose(view.time), chain::interpolate(states, view.time), camera, view);
      summary.empty += view.width == 0;
      const capture::Image8 mask = recorded_mask(view, camera);
      warn_of_missed_points(recording.help, view.camera, view.frame, mask);
      sink(view.camera, view.frame, mask, view.width ? scores[i] : 0.0);
    }
  });
  summary.inside /= summary.frames;
  return summary;
}

}  // namespace

Summary make(const Path& path, const capture::FrameRange& frames, const Hints& hints, const Sink& sink) {
  capture::LoadOptions headers;
  headers.images = false;
  const capture::Capture scene = capture::load(path, headers);
  const Help help = help_of(hints, scene, frames.first);
  Recording recording{path, scene, scene.cameras, help, frames.first, frames.last};
  for (capture::Camera& camera : recording.pinholes) camera.distortion = {};
  int total = 0, longest = 0;
  for (int c = 0; c < static_cast<int>(scene.cameras.size()); ++c) {
    total += frames_of(recording, c);
    longest = std::max(longest, frames_of(recording, c));
  }
  if (total == 0) throw InputError(path.string(), "has no frame in the range asked for", "choose frames that it has");

  const chain::Chain chain = chain_for(scene);
  require_within_reach(recording, chain);
  Progress progress(static_cast<std::int64_t>(total) * (kRounds + 2));
  const std::vector<Samples> samples = take_samples(recording, progress);
  return longest <= kStills ? make_stills(recording, chain, samples, sink)
                            : make_video(recording, chain, samples, progress, sink);
}

}  // namespace chainsplat::masking
