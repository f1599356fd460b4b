#include "src/masking/make_stills.h"

#include <algorithm>
#include <cmath>

#include "src/masking/cut.h"
#include "src/masking/one_rope.h"
#include "src/masking/ribbon.h"

namespace chainsplat::masking {

using capture::Frame;
using capture::View;

namespace {

// The rope hangs at rest, and the grasp may be off: hand-eye calibrations of laboratories are wrong by 3 to 14 mm.
constexpr double kGraspDeviation = 0.006;  // m, of the grasp,
constexpr double kGraspScatter = 0.0025;   // m, and from still to still
constexpr double kHangingBendChange = 6.0 * M_PI / 180, kLyingBendChange = 10.0 * M_PI / 180;  // of neighboring joints
constexpr double kSureMargin = 25.0;  // nats, by which a rope must be better than those that end elsewhere; with none
constexpr double kUnsure = 0.7;       // its score is multiplied by this
// px across the rope, below which its score is that of an unsure one: of ten such stills that looked right, four had an
// IoU of 0.24 to 0.52.
constexpr double kFewestPixels = 2.2;
// of the given diameter: narrower masks have the score of unsure ones, too. The lit middle of a cable has outlines of
// its own, a tube within the tube; nothing is like that outside of it, and given diameters are right to a fifth, masks'
// widths to some hundredths.
constexpr double kNarrow = 0.77;
constexpr double kAtPoint = 2.0;              // radii, within which a rope runs through a point of the user's
constexpr double kLeastStillEvidence = 0.02;  // nats per sample
constexpr double kFirstWidth = 0.2, kFirstBroadWidth = 0.4,
                 kKnownWidth = 0.12;                   // deviation of the width before and after it was measured
constexpr double kBroad = 4.0;                         // px, of a radius beyond which blur hardly changes a width
constexpr double kLeastWidth = 0.6, kMostWidth = 1.7;  // of the given diameter, as far as it is believed to be wrong
constexpr double kSharedWidth = 0.1;  // deviation of the width that all pictures of a moment have, about the usual one
constexpr int kRibbonRounds = 3;      // of colors and ribbons; the last keeps the width

// The mask of what lies inside the tube.
View inside_of(const Tube& tube, int camera, const Frame& frame) {
  View out;
  out.camera = camera, out.frame = frame.frame, out.time = frame.time;
  if (tube.box.empty()) return out;
  out.x0 = tube.box.x0, out.y0 = tube.box.y0, out.width = tube.box.width(), out.height = tube.box.height();
  out.rgba.assign(static_cast<std::size_t>(4) * out.width * out.height, 0);
  for (int y = tube.box.y0; y < tube.box.y1; ++y)
    for (int x = tube.box.x0; x < tube.box.x1; ++x) {
      if (tube.at(x, y) >= 0.0f) continue;
      std::uint8_t* const to = &out.rgba[4 * (static_cast<std::size_t>(y - out.y0) * out.width + x - out.x0)];
      std::copy_n(&frame.picture.pixels[3 * (static_cast<std::size_t>(y) * frame.picture.width + x)], 3, to);
      to[3] = 255;
    }
  return out;
}

// What a still shows.
struct Still {
  const Frame* frame;
  const Grown* grown;  // of the moment nearest in time
  OneRope rope;        // the grown chain, or what all pictures of the moment make of it, and the width of ribbons
  Axis along = {};     // of that rope
  Ribbon ribbon = {};
  bool broad = false;  // enough pixels across that blur hardly changes the width
};

double bend_change_of(const capture::Capture& scene) { return scene.tabletop ? kLyingBendChange : kHangingBendChange; }

// Grows every moment by itself, then with the grasp and the colors that the moments agree upon.
std::vector<Grown> grow_stills(const Recording& recording, const chain::Chain& chain,
                               const std::vector<Moment>& moments) {
  const capture::Capture& scene = recording.capture;
  math::Vector3 grasp = math::Vector3::Zero();
  const auto clues_of = [&](const Moment& moment, int pass) {
    Clues clues;
    clues.grasp = grasp;
    clues.bend_change = bend_change_of(scene);
    clues.grasp_deviation = pass ? kGraspScatter : kGraspDeviation;
    if (!scene.tabletop && scene.gravity.norm() > 0.0)
      clues.down = scene.base.pose(moment.time).rotation.transpose() * scene.gravity.normalized();
    return clues;
  };
  const auto again = [&](const std::vector<Grown>& grown) {
    if (grown.size() == 1) return false;
    for (int axis = 0; axis < 3; ++axis) {
      std::vector<double> values;
      for (const Grown& one : grown) values.push_back(one.shift[axis]);
      grasp[axis] = math::median(values);
    }
    return true;
  };
  return grow_moments(recording, chain, moments, kLeastStillEvidence, clues_of, again).grown;
}

// By camera.
std::vector<std::vector<Still>> stills_of(const std::vector<Samples>& samples, const std::vector<Moment>& moments,
                                          const std::vector<Grown>& grown) {
  std::vector<std::vector<Still>> out(samples.size());
  for (std::size_t c = 0; c < samples.size(); ++c)
    for (const Frame& frame : samples[c].frames) {
      std::size_t nearest = 0;
      for (std::size_t i = 1; i < moments.size(); ++i)
        if (std::abs(moments[i].time - frame.time) < std::abs(moments[nearest].time - frame.time)) nearest = i;
      out[c].push_back({&frame, &grown[nearest], {grown[nearest].theta, grown[nearest].shift, 1.0}});
    }
  return out;
}

math::Pose base_at(const Recording& recording, const Still& still) {
  math::Pose base = recording.capture.base.pose(still.frame->time);
  base.translation = base * still.rope.shift;
  return base;
}

// One camera's colors: from the tubes of the grown chains, or, where there are any already, from the ribbons.
Look look_of(const Recording& recording, const chain::Chain& chain, int camera, bool ribbons,
             std::vector<Still>& stills) {
  const capture::Camera& pinhole = recording.pinholes[camera];
  Look look;
  if (const capture::Image8* const empty = recording.help.empty_of(camera); empty && !stills.empty())
    look.background = empty_scene(*empty, picture_of(*stills.front().frame));
  for (Still& still : stills) {
    const Picture picture = picture_of(*still.frame);
    const bool by_ribbon = ribbons && still.ribbon.axis.points.size() > 1;
    const math::Pose base = base_at(recording, still);
    still.along = axis(chain, base, still.rope.theta, pinhole, 0.0, chain.length);
    const Tube around = tube(by_ribbon ? still.ribbon.axis : still.along, picture.width, picture.height, kAboutPixels);
    still.broad = around.radius > kBroad;
    count_colors(look, picture, around, reach(chain, base, pinhole), chain,
                 by_ribbon ? kFitMargin : kGrownMargin * around.radius);
  }
  settle(look);
  return look;
}

// What the ribbons of several pictures of one moment make of the rope.
void join_pictures(const Recording& recording, const chain::Chain& chain, std::vector<std::vector<Still>>& stills) {
  std::vector<std::vector<Still*>> moments;
  std::vector<std::vector<Outlined>> seen;
  for (std::size_t c = 0; c < stills.size(); ++c)
    for (Still& still : stills[c]) {
      if (still.ribbon.axis.points.size() < 3) continue;
      const auto same = std::find_if(moments.begin(), moments.end(), [&](const std::vector<Still*>& moment) {
        return moment.front()->grown == still.grown;
      });
      const std::size_t m = same - moments.begin();
      if (same == moments.end()) moments.emplace_back(), seen.emplace_back();
      moments[m].push_back(&still);
      seen[m].push_back(
          {&recording.pinholes[c], recording.capture.base.pose(still.frame->time), &moments[m].back()->ribbon});
    }
  core::parallel_for(static_cast<std::int64_t>(moments.size()), [&](std::int64_t m) {
    if (moments[m].size() < 2) return;
    const OneRope rope = fit_one_rope(chain, seen[m], moments[m].front()->rope,
                                      {kSharedWidth, kGraspDeviation, bend_change_of(recording.capture)});
    for (Still* const still : moments[m]) still->rope = rope;
  });
}

// Colors and ribbons in turn; the width is what the ribbons of all cameras have in common.
void find_ribbons(const Recording& recording, const chain::Chain& chain, std::vector<std::vector<Still>>& stills) {
  for (int round = 0; round < kRibbonRounds; ++round) {
    std::vector<double> widths;
    for (std::size_t c = 0; c < stills.size(); ++c) {
      const Look look = look_of(recording, chain, static_cast<int>(c), round > 0, stills[c]);
      core::parallel_for(static_cast<std::int64_t>(stills[c].size()), [&](std::int64_t i) {
        Still& still = stills[c][i];
        RibbonOptions ribbon;
        ribbon.width = std::clamp(still.rope.width, kLeastWidth, kMostWidth);
        ribbon.shadow = recording.capture.tabletop;
        ribbon.width_deviation = round ? kKnownWidth : still.broad ? kFirstBroadWidth : kFirstWidth;
        ribbon.rims = round + 1 == kRibbonRounds;
        ribbon.through = recording.help.points_in(static_cast<int>(c), still.frame->frame);
        still.ribbon = find_ribbon(look, picture_of(*still.frame), still.along, chain.length, ribbon);
      });
      for (const Still& still : stills[c])
        if (!still.ribbon.axis.points.empty()) widths.push_back(still.ribbon.width);
    }
    if (widths.empty()) throw_nothing(recording);
    if (round + 1 == kRibbonRounds) break;
    for (std::vector<Still>& of_camera : stills)
      for (Still& still : of_camera) still.rope.width = math::median(widths);
    join_pictures(recording, chain, stills);
  }
}

bool runs_through(const Axis& axis, const math::Vector2& point) {
  return std::any_of(axis.points.begin(), axis.points.end(),
                     [&](const AxisPoint& p) { return (p.at - point).norm() < kAtPoint * std::max(1.0, p.radius); });
}

double score_of(const Help& help, int camera, const Still& still) {
  // another way from the grasp that explains the picture nearly as well: another cable that crosses, perhaps
  const double sure = std::min(1.0, kUnsure + (1.0 - kUnsure) * still.grown->margin / kSureMargin);
  const Axis& axis = still.ribbon.axis;
  std::vector<double> radii;
  for (const AxisPoint& p : axis.points) radii.push_back(p.radius);
  const bool thin = radii.empty() || 2.0 * math::median(radii) < kFewestPixels;
  const bool elsewhere = std::any_of(help.points.begin(), help.points.end(), [&](const Help::Point& point) {
    return point.camera == camera && point.frame == still.frame->frame && !runs_through(axis, point.at);
  });
  const bool unsure = thin || elsewhere || still.ribbon.width < kNarrow;
  return (unsure ? std::min(sure, kUnsure) : sure) * score(evidence(picture_of(*still.frame), axis));
}

}  // namespace

Summary make_stills(const Recording& recording, const chain::Chain& chain, const std::vector<Samples>& samples,
                    const Sink& sink) {
  const std::vector<Moment> moments = moments_of(recording, samples);
  const std::vector<Grown> grown = grow_stills(recording, chain, moments);
  std::vector<std::vector<Still>> stills = stills_of(samples, moments, grown);
  find_ribbons(recording, chain, stills);

  Summary summary;
  for (const Grown& one : grown)
    if (one.shift.norm() > summary.grasp.norm()) summary.grasp = one.shift;
  for (std::size_t c = 0; c < stills.size(); ++c)
    for (const Still& still : stills[c]) {
      const Picture picture = picture_of(*still.frame);
      const Tube rope = tube(still.ribbon.axis, picture.width, picture.height, 0.0);
      const View view = inside_of(rope, static_cast<int>(c), *still.frame);
      ++summary.frames;
      summary.empty += view.width == 0;
      summary.inside += view.width != 0;
      const capture::Image8 mask = recorded_mask(view, recording.capture.cameras[c]);
      warn_of_missed_points(recording.help, static_cast<int>(c), still.frame->frame, mask);
      sink(static_cast<int>(c), still.frame->frame, mask, score_of(recording.help, static_cast<int>(c), still));
    }
  summary.inside /= summary.frames;
  return summary;
}

}  // namespace chainsplat::masking
