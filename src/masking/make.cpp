// The masks of a whole capture: chains grown in some moments, colors and background learned from them, then masks and
// chains in turn.
#include <algorithm>
#include <atomic>
#include <cmath>

#include "chainsplat/masking.h"
#include "chainsplat/silhouette.h"
#include "src/masking/cut.h"
#include "src/masking/grow.h"
#include "src/masking/hints.h"
#include "src/masking/ribbon.h"

namespace chainsplat::masking {

using capture::Image8;
using capture::View;
using math::Vector2;

namespace {

// Memory for the whole frames of one camera that are held at once. Reaching a block of a video means decoding all
// before it, so that with small blocks the time would grow with the square of the recording's length.
constexpr double kBlockBytes = 512.0 * 1024 * 1024;
// what is learned from
constexpr int kSamples = 48;  // frames per camera from which background and colors are learned,
constexpr double kSampleBytes = 2048.0 * 1024 * 1024;  // fewer where those of all cameras would take more than this
constexpr double kAboutPixels = 24.0;                  // px around a tube whose colors count as the rope's surroundings
constexpr double kLeastUncovered = 0.2;                // share of the samples that must show a pixel's background
constexpr int kLeastSamples = 4;
// the chain
constexpr double kLinkDiameters = 1.5;  // length of a link in diameters, unless the number of joints hits its bounds
constexpr int kFewestJoints = 8, kMostJoints = 16;
// chains grown in moments
constexpr double kLeastEvidence = 0.1;  // nats per sample in the best moment, below which there is no rope
constexpr double kTrusted = 0.75;       // share of the best moment's evidence from which on colors are learned,
constexpr double kUsable = 0.5;         // and from which on a moment's chain is used
constexpr int kKnownSamples = 1000;     // number of samples per side as which the colors of other moments count
// masks and chains in turn
constexpr double kRoughPlace = 3.0;   // times the usual uncertainty of the place, as long as chains are grown ones
constexpr double kGrownMargin = 0.4;  // radii, by which the tube of a grown chain may be off,
// px, and that of a fitted chain, as pixels on its outline show both sides; a wider margin left the rope's dark
// underside and its contact shadow unlearned
constexpr double kFitMargin = 0.5;
constexpr int kRounds = 2;            // of cutting, fitting and learning
constexpr double kCenter = 0.5;       // of the radius; pixels deeper inside than this count as the centerline
constexpr double kLeastInside = 0.4;  // mean share of the centerline in the masks, below which there is no rope
// a few stills
constexpr int kStills = 8;                 // frames per camera, up to which a capture is one of stills
constexpr double kGraspDeviation = 0.006;  // m, of the grasp: hand-eye calibrations of laboratories are 3 to 14 mm off,
constexpr double kGraspScatter = 0.0025;   // m, and from still to still
constexpr double kHangingBendChange = 6.0 * M_PI / 180, kLyingBendChange = 10.0 * M_PI / 180;  // of neighboring joints
constexpr double kSureMargin = 25.0;  // nats, by which a rope must be better than those that end elsewhere; with none
constexpr double kUnsure = 0.7;       // its score is multiplied by this
constexpr double kLeastStillEvidence = 0.02;  // nats per sample
constexpr double kFacing = 0.5;  // cosine between view and bending axis, above which one camera sees the rope's plane
constexpr double kFirstWidth = 0.2, kFirstBroadWidth = 0.4,
                 kKnownWidth = 0.12;                   // deviation of the width before and after it was measured
constexpr double kBroad = 4.0;                         // px, of a radius beyond which blur hardly changes a width
constexpr double kLeastWidth = 0.6, kMostWidth = 1.7;  // of the given diameter, as far as it is believed to be wrong

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

double frame_bytes(const capture::Camera& camera) { return 4.0 * camera.width * camera.height; }

// Calls `body` with whole undistorted frames of one camera, block by block.
void each_block(const Recording& recording, int camera, const std::function<void(std::vector<View>&)>& body) {
  const int begin = recording.first, end = begin + frames_of(recording, camera);
  const int most = static_cast<int>(std::clamp(kBlockBytes / frame_bytes(recording.capture.cameras[camera]), 1.0, 1e6));
  for (int first = begin; first < end; first += most) {
    capture::LoadOptions options;
    options.masked = false;
    options.camera = recording.capture.cameras[camera].name;
    options.first = first;
    options.last = std::min(end, first + most);
    capture::Capture block = capture::load(recording.path, options);
    for (View& view : block.views) view.camera = camera;
    body(block.views);
    if (core::stop_requested()) throw Interrupted(core::stop_requested());
  }
}

Picture picture_of(const View& view) { return {view.rgba.data(), view.width, view.height, 4}; }

// Some whole frames of one camera, from which its appearance is learned.
struct Samples {
  std::vector<View> frames;
  std::vector<Picture> pictures() const {
    std::vector<Picture> out;
    for (const View& view : frames) out.push_back(picture_of(view));
    return out;
  }
};

// Pictures taken at one time.
struct Moment {
  double time = 0.0;
  std::vector<Shot> shots;
  std::vector<int> cameras;                  // by shot
  std::vector<capture::Image8> differences;  // that shots show where the empty scene is known
};

// The moments of the first camera that has samples, together with the other cameras' pictures of that moment.
std::vector<Moment> moments_of(const capture::Capture& scene, const std::vector<capture::Camera>& cameras,
                               const std::vector<Samples>& samples) {
  const auto first = std::find_if(samples.begin(), samples.end(), [](const Samples& s) { return !s.frames.empty(); });
  std::vector<Moment> moments;
  const auto times_of = [](const Samples& some) {
    std::vector<double> times;
    for (const View& view : some.frames) times.push_back(view.time);
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
      const View& view = samples[c].frames[nearest[m]];
      moments[m].shots.push_back(
          {picture_of(view), &cameras[c], cameras[c].world_from_camera.inverse() * scene.base.pose(view.time), {}, {}});
      moments[m].cameras.push_back(static_cast<int>(c));
    }
  }
  return moments;
}

[[noreturn]] void throw_nothing(const Recording& recording) {
  throw InputError(recording.path.string(), "nothing like the rope is found at the grasp",
                   "check cameras, base, length and direction (chainsplat check), or use `command`");
}

// Grows a chain in each moment of a recording. Throws InputError where no moment shows a rope.
chain::States grow_moments(const Recording& recording, const chain::Chain& chain, const std::vector<Moment>& moments) {
  // first from each moment's own colors, then also from those of the moments that show the rope best
  std::vector<Tally> known(recording.capture.cameras.size());
  std::vector<Grown> grown(moments.size());
  double best = 0.0;
  for (int pass = 0; pass < 2; ++pass) {
    core::parallel_for(static_cast<std::int64_t>(moments.size()), [&](std::int64_t i) {
      std::vector<Tally> of_shots;
      for (const int c : moments[i].cameras) of_shots.push_back(known[c]);
      grown[i] = grow(chain, moments[i].shots, of_shots);
    });
    if (core::stop_requested()) throw Interrupted(core::stop_requested());
    best = 0.0;
    for (const Grown& one : grown) best = std::max(best, one.evidence);
    if (best < kLeastEvidence) throw_nothing(recording);
    if (pass == 1) break;
    for (std::size_t i = 0; i < moments.size(); ++i)
      for (std::size_t k = 0; grown[i].evidence > kTrusted * best && k < moments[i].cameras.size(); ++k)
        add(known[moments[i].cameras[k]], grown[i].tallies[k]);
    for (Tally& tally : known) tally = scaled(tally, kKnownSamples);
  }
  // keep the moments with enough evidence
  chain::States states;
  for (std::size_t i = 0; i < moments.size(); ++i)
    if (grown[i].evidence > kUsable * best) {
      states.time.push_back(moments[i].time);
      states.theta.push_back(grown[i].theta);
    }
  return states;
}

// The interpolated angles, constant beyond the ends, where the first and last frames may lie.
math::VectorX at(const chain::States& states, double time) {
  return chain::interpolate(states, std::clamp(time, states.time.front(), states.time.back()));
}

bool masked_at(const View& view, int x, int y) {
  x -= view.x0, y -= view.y0;
  return x >= 0 && y >= 0 && x < view.width && y < view.height &&
         view.rgba[4 * (static_cast<std::size_t>(y) * view.width + x) + 3] != 0;
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

// Returns the mask of an undistorted crop as a whole image of recorded pixels.
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
    for (const View& view : samples[c].frames)
      if (picture_of(view).pixels == moment.shots[k].picture.pixels) frame = view.frame;
    for (const Help::Point& point : help.points)
      if (point.camera == c && point.frame == frame) moment.shots[k].on_rope.push_back(point.at);
    for (const Help::Region& region : help.boxes)
      if (region.camera == c && region.frame.value_or(frame) == frame) moment.shots[k].bounds = region.box;
  }
  take_away_scene(help, moment);  // last, since a shot's frame is told by its picture
}

// The mask of what lies inside the tube.
View inside_of(const Tube& tube, const View& picture) {
  View out;
  out.camera = picture.camera, out.frame = picture.frame, out.time = picture.time;
  if (tube.box.empty()) return out;
  out.x0 = tube.box.x0, out.y0 = tube.box.y0, out.width = tube.box.width(), out.height = tube.box.height();
  out.rgba.assign(static_cast<std::size_t>(4) * out.width * out.height, 0);
  for (int y = tube.box.y0; y < tube.box.y1; ++y)
    for (int x = tube.box.x0; x < tube.box.x1; ++x) {
      if (tube.at(x, y) >= 0.0f) continue;
      std::uint8_t* const to = &out.rgba[4 * (static_cast<std::size_t>(y - out.y0) * out.width + x - out.x0)];
      std::copy_n(&picture.rgba[4 * (static_cast<std::size_t>(y) * picture.width + x)], 3, to);
      to[3] = 255;
    }
  return out;
}

// The masks of a few stills, each by itself: ribbons about chains that are grown in every moment.
Summary make_stills(const Recording& recording, const Help& help, const chain::Chain& given,
                    const std::vector<capture::Camera>& pinholes, const std::vector<Samples>& samples,
                    const Sink& sink) {
  const capture::Capture& scene = recording.capture;
  const int cameras = static_cast<int>(scene.cameras.size());
  std::vector<Moment> moments = moments_of(scene, pinholes, samples);
  for (Moment& moment : moments) add_help(help, samples, moment);
  chain::Chain chain = given;
  // grow: first each moment by itself, then with the grasp and the colors that the moments agree upon
  std::vector<Grown> grown(moments.size());
  std::vector<Tally> known(cameras);
  math::Vector3 grasp = math::Vector3::Zero();
  for (int pass = 0; pass < 2; ++pass) {
    core::parallel_for(static_cast<std::int64_t>(moments.size()), [&](std::int64_t i) {
      Clues clues;
      clues.grasp = grasp;
      clues.bend_change = scene.tabletop ? kLyingBendChange : kHangingBendChange;
      clues.grasp_deviation = pass ? kGraspScatter : kGraspDeviation;
      if (!scene.tabletop && scene.gravity.norm() > 0.0)
        clues.down = scene.base.pose(moments[i].time).rotation.transpose() * scene.gravity.normalized();
      std::vector<Tally> of_shots;
      for (const int c : moments[i].cameras) of_shots.push_back(known[c]);
      grown[i] = grow(chain, moments[i].shots, of_shots, clues);
    });
    if (core::stop_requested()) throw Interrupted(core::stop_requested());
    double best = 0.0;
    for (const Grown& one : grown) best = std::max(best, one.evidence);
    if (best < kLeastStillEvidence) throw_nothing(recording);
    if (pass == 1 || moments.size() == 1) break;
    for (int axis = 0; axis < 3; ++axis) {
      std::vector<double> values;
      for (const Grown& one : grown) values.push_back(one.shift[axis]);
      grasp[axis] = math::median(values);
    }
    for (std::size_t i = 0; i < moments.size(); ++i)
      for (std::size_t k = 0; grown[i].evidence > kTrusted * best && k < moments[i].cameras.size(); ++k)
        add(known[moments[i].cameras[k]], grown[i].tallies[k]);
    for (Tally& tally : known) tally = scaled(tally, kKnownSamples);
  }
  // what is drawn about: the moment nearest in time
  struct Still {
    const View* view;
    int moment;
    Axis along;  // of the grown chain
    Ribbon ribbon;
    bool broad;  // enough pixels across that blur hardly changes the width
  };
  std::vector<std::vector<Still>> stills(cameras);
  const auto base_at = [&](const Still& still) {
    math::Pose base = scene.base.pose(still.view->time);
    base.translation = base * grown[still.moment].shift;
    return base;
  };
  for (int c = 0; c < cameras; ++c)
    for (const View& view : samples[c].frames) {
      int nearest = 0;
      for (int i = 1; i < static_cast<int>(moments.size()); ++i)
        if (std::abs(moments[i].time - view.time) < std::abs(moments[nearest].time - view.time)) nearest = i;
      stills[c].push_back({&view, nearest, {}, {}, false});
    }
  // colors from the grown tubes, then from the ribbons; the width that the ribbons have in common
  std::vector<Look> looks(cameras);
  double width = 1.0;
  for (int round = 0; round < 3; ++round) {
    std::vector<double> widths;
    for (int c = 0; c < cameras; ++c) {
      looks[c] = {};
      if (help.empty_of(c) && !stills[c].empty())
        looks[c].background = empty_scene(*help.empty_of(c), picture_of(*stills[c].front().view));
      for (Still& still : stills[c]) {
        const View& view = *still.view;
        const bool by_ribbon = round && still.ribbon.axis.points.size() > 1;
        still.along = axis(chain, base_at(still), grown[still.moment].theta, pinholes[c], 0.0, chain.length);
        const Tube tube = masking::tube(by_ribbon ? still.ribbon.axis : still.along, view.width, view.height,
                                        std::max(kAboutPixels, 0.0));
        still.broad = tube.radius > kBroad;
        count_colors(looks[c], picture_of(view), tube, reach(chain, base_at(still), pinholes[c]), chain,
                     by_ribbon ? kFitMargin : kGrownMargin * tube.radius);
      }
      settle(looks[c]);
      core::parallel_for(static_cast<std::int64_t>(stills[c].size()), [&](std::int64_t i) {
        Still& still = stills[c][i];
        RibbonOptions ribbon;
        ribbon.width = width;
        ribbon.width_deviation = round ? kKnownWidth : still.broad ? kFirstBroadWidth : kFirstWidth;
        still.ribbon = find_ribbon(looks[c], picture_of(*still.view), still.along, chain.length, ribbon);
      });
      for (const Still& still : stills[c])
        if (!still.ribbon.axis.points.empty()) widths.push_back(still.ribbon.width);
    }
    if (widths.empty()) throw_nothing(recording);
    if (round < 2) width = std::clamp(math::median(widths), kLeastWidth, kMostWidth);
  }
  Summary summary;
  for (const Grown& one : grown)
    if (one.shift.norm() > summary.grasp.norm()) summary.grasp = one.shift;
  for (int c = 0; c < cameras; ++c)
    for (const Still& still : stills[c]) {
      const Tube tube = masking::tube(still.ribbon.axis, still.view->width, still.view->height, 0.0);
      const View view = inside_of(tube, *still.view);
      // another way from the grasp that explains the picture nearly as well: another cable that crosses, perhaps
      const double sure = std::min(1.0, kUnsure + (1.0 - kUnsure) * grown[still.moment].margin / kSureMargin);
      const Evidence seen = evidence(picture_of(*still.view), still.ribbon.axis);
      ++summary.frames;
      summary.empty += view.width == 0;
      summary.inside += view.width != 0;
      sink(c, still.view->frame, recorded_mask(view, scene.cameras[c]), sure * score(seen));
    }
  summary.inside /= summary.frames;
  return summary;
}

}  // namespace

Summary make(const Path& path, const capture::FrameRange& frames, const Hints& hints, const Sink& sink) {
  // the frames and the chain
  capture::LoadOptions headers;
  headers.images = false;
  capture::Capture scene = capture::load(path, headers);
  const Recording recording{path, scene, frames.first, frames.last};
  const Help help = help_of(hints, scene, frames.first);
  const int cameras = static_cast<int>(scene.cameras.size());
  int total = 0;
  for (int c = 0; c < cameras; ++c) total += frames_of(recording, c);
  if (total == 0) throw InputError(path.string(), "has no frame in the range asked for", "choose frames that it has");

  const chain::Chain chain = chain_for(scene);

  // sample frames of every camera
  std::vector<capture::Camera> pinholes = scene.cameras;  // the cameras of undistorted pictures
  for (capture::Camera& camera : pinholes) camera.distortion = {};
  std::vector<Samples> samples(cameras);
  const std::int64_t work = static_cast<std::int64_t>(total) * (kRounds + 2);
  std::atomic<std::int64_t> done{0};
  const auto tell = [&](const char* note, std::size_t count) {
    const std::int64_t now = done += static_cast<std::int64_t>(count);
    core::report({"mask", now, work, std::nan(""), std::nan(""), note});
  };
  for (int c = 0; c < cameras; ++c) {
    const double room = kSampleBytes / (cameras * frame_bytes(scene.cameras[c]));
    const int stride =
        std::max(1, frames_of(recording, c) / static_cast<int>(std::clamp<double>(room, kLeastSamples, kSamples)));
    each_block(recording, c, [&](std::vector<View>& views) {
      for (View& view : views)
        if ((view.frame - recording.first) % stride == 0 || help.points_at(c, view.frame))
          samples[c].frames.push_back(std::move(view));
      tell("samples", views.size());
    });
  }
  int longest = 0;
  for (int c = 0; c < cameras; ++c) longest = std::max(longest, frames_of(recording, c));
  if (longest <= kStills) return make_stills(recording, help, chain, pinholes, samples, sink);

  // learns every camera's appearance from its samples, with a chain for each and, if there are any, their masks
  std::vector<Look> looks(cameras);
  const auto learn = [&](const chain::States& states, const std::vector<View>* masks) {
    for (int c = 0; c < cameras; ++c) {
      looks[c] = {};
      const std::vector<Picture> pictures = samples[c].pictures();
      std::vector<Tube> tubes;
      for (const View& view : samples[c].frames)
        tubes.push_back(tube(chain, scene.base.pose(view.time), at(states, view.time), pinholes[c], 0.0, chain.length,
                             kAboutPixels));
      if (masks) looks[c].marks = marks(pictures, tubes, chain);  // a grown chain is too inaccurate for marks
      for (std::size_t i = 0; i < tubes.size(); ++i) {
        const View& view = samples[c].frames[i];
        const View* mask = nullptr;
        if (masks)
          mask = &*std::find_if(masks->begin(), masks->end(),
                                [&](const View& m) { return m.camera == c && m.frame == view.frame; });
        count_colors(looks[c], pictures[i], tubes[i], reach(chain, scene.base.pose(view.time), pinholes[c]), chain,
                     masks ? kFitMargin : kGrownMargin * tubes[i].radius, mask);
      }
      settle(looks[c]);
      looks[c].background =
          help.empty_of(c) && !pictures.empty()
              ? empty_scene(*help.empty_of(c), pictures.front())
              : median_background(pictures, tubes,
                                  std::max(kLeastSamples, static_cast<int>(kLeastUncovered * tubes.size())));
    }
  };
  Summary summary;
  std::vector<Moment> moments = moments_of(scene, pinholes, samples);
  for (Moment& moment : moments) add_help(help, samples, moment);
  chain::States states = grow_moments(recording, chain, moments);
  learn(states, nullptr);
  // cuts the masks of all frames about the chains and passes them to `consume` block by block
  using Consume = std::function<void(std::vector<View>&, const std::vector<double>& scores)>;
  const auto masks_by = [&](double place, const char* note, const Consume& consume) {
    for (int c = 0; c < cameras; ++c)
      each_block(recording, c, [&](std::vector<View>& views) {
        std::vector<double> scores(views.size());
        core::parallel_for(static_cast<std::int64_t>(views.size()), [&](std::int64_t i) {
          if (core::stop_requested()) throw Interrupted(core::stop_requested());
          View& view = views[i];
          View masked = cut(looks[c], picture_of(view), pinholes[c], chain, scene.base.pose(view.time),
                            at(states, view.time), place);
          masked.camera = c, masked.frame = view.frame, masked.time = view.time;
          scores[i] = score(evidence(picture_of(view), axis(chain, scene.base.pose(view.time), at(states, view.time),
                                                            pinholes[c], 0.0, chain.length)));
          view = std::move(masked);
          tell(note, 1);
        });
        consume(views, scores);
      });
  };
  // rounds of masks, chains fitted to them, and appearance learned from both
  for (int round = 0; round < kRounds; ++round) {
    capture::Capture masked = scene;
    masked.views.clear();
    masks_by(round ? 1.0 : kRoughPlace, round ? "cut" : "rough masks", [&](std::vector<View>& views, const auto&) {
      for (View& view : views) masked.views.push_back(std::move(view));
    });
    const bool anything = std::any_of(masked.views.begin(), masked.views.end(), [](const View& v) { return v.width; });
    silhouette::SequenceFit fit;
    if (anything) fit = silhouette::fit_sequence(chain, masked);
    summary.inside = 0.0;
    for (const silhouette::FrameFit& frame : fit.frames) summary.inside += frame.inside;
    if (!fit.frames.empty()) summary.inside /= static_cast<double>(fit.frames.size());
    if (summary.inside < kLeastInside) throw_nothing(recording);
    states = fit.states;
    learn(states, &masked.views);
  }
  summary.inside = 0.0;
  // the final masks
  masks_by(1.0, "cut", [&](std::vector<View>& views, const std::vector<double>& scores) {
    for (std::size_t i = 0; i < views.size(); ++i) {
      const View& view = views[i];
      ++summary.frames;
      summary.inside += share_inside(chain, scene.base.pose(view.time), chain::interpolate(states, view.time),
                                     scene.cameras[view.camera], view);
      summary.empty += view.width == 0;
      sink(view.camera, view.frame, recorded_mask(view, scene.cameras[view.camera]), view.width ? scores[i] : 0.0);
    }
  });
  summary.inside /= summary.frames;
  return summary;
}

}  // namespace chainsplat::masking
