#include <algorithm>
#include <cmath>
#include <iterator>

#include "chainsplat/core.h"
#include "src/math/decompositions.h"
#include "src/silhouette/frame.h"
#include "src/silhouette/smooth_in_time.h"

namespace chainsplat::silhouette {

using math::MatrixX;
using math::VectorX;

namespace {

// A frame is fitted again when it is worse than most by more than this.
constexpr double kLessCovered = 0.1;         // share of the mask
constexpr double kLessInside = 0.15;         // share of the centerline
constexpr double kMoreResidual = 2.0;        // times the median, and
constexpr double kMoreResidualPixels = 0.5;  // px more
constexpr double kLost = 0.6;                // share covered or inside under which a frame is sought from scratch
constexpr double kBetter = 0.9;              // share of the old cost that a new fit must stay under
constexpr double kMuchBetter = 0.6;          // the same, where the new one leaves its neighbors and the old does not
// Way from frame to frame by which a rope leaves its neighbors: times the usual one, and share of the length.
constexpr double kJump = 3.0, kJumpShare = 0.03;
constexpr int kRecent = 30;         // frames before one that tell how far the rope goes
constexpr double kBelieved = 0.04;  // rad, deviation of an angle from that of the frame before
constexpr double kCostsMore = 1.5;  // times the cost of a fit that leaves the frame before

constexpr double kCommonOffsetDeviation = 0.1;  // px, of the masks' offset learned from all frames

constexpr int kDerivativeReach = 3;  // frames on each side of a local cubic fit

// Slopes of local cubics over the nearest 2 kDerivativeReach + 1 frames (fewer than four: of a line or parabola).
std::vector<VectorX> derivative(const std::vector<double>& times, const std::vector<VectorX>& theta) {
  const int count = static_cast<int>(times.size()), n = static_cast<int>(theta[0].size());
  std::vector<VectorX> out(count, VectorX::Zero(n));
  if (count < 2) return out;
  const int width = std::min(count, 2 * kDerivativeReach + 1), terms = std::min(width, 4);
  for (int f = 0; f < count; ++f) {
    const int first = std::clamp(f - kDerivativeReach, 0, count - width);
    const double scale = times[first + width - 1] - times[first];
    MatrixX powers(width, terms), values(width, n);
    for (int i = 0; i < width; ++i) {
      const double t = (times[first + i] - times[f]) / scale;
      for (int p = 0; p < terms; ++p) powers(i, p) = std::pow(t, p);
      values.row(i) = theta[first + i].transpose();
    }
    out[f] = powers.householderQr().solve(values).row(1).transpose() / scale;
  }
  return out;
}

}  // namespace

Frames frames_of(const capture::Capture& capture) {
  Frames frames;
  const std::vector<capture::PackedView>& views = capture.views;
  if (views.empty()) return frames;
  // all frames of the first camera between its first and last loaded one, views or not
  const int camera = views.front().camera;
  int low = views.front().frame, high = low;
  for (const capture::ViewPlace& view : views) {
    if (view.camera != camera) continue;
    low = std::min(low, view.frame);
    high = std::max(high, view.frame);
  }
  const bool listed =
      camera < static_cast<int>(capture.times.size()) && high < static_cast<int>(capture.times[camera].size());
  if (listed) {
    frames.times.assign(capture.times[camera].begin() + low, capture.times[camera].begin() + high + 1);
  } else {
    for (const capture::ViewPlace& view : views)
      if (view.camera == camera) frames.times.push_back(view.time);
  }
  frames.views = capture::views_at(capture, frames.times);
  return frames;
}

namespace {

// The frames of a recording while they are fitted.
struct Sequence {
  const chain::Chain& chain;
  const capture::Capture& capture;
  std::vector<double> times;
  std::vector<std::vector<int>> views;   // by frame, of the capture
  std::vector<char> seen;                // by frame: a mask shows something
  std::vector<FrameSolution> solutions;  // by frame
  Options each;                          // for one frame
  std::vector<double> ways = {};         // m, way_between() the frame before and this one; below 0: not known
  double far = 0.0;                      // m, way_between() that no rope goes from frame to frame; 0: not known yet

  int count() const { return static_cast<int>(times.size()); }
  VectorX straight() const { return VectorX::Zero(chain.angles()); }
};

Sequence make_sequence(const chain::Chain& chain, const capture::Capture& capture, const Options& options) {
  Frames frames = frames_of(capture);
  if (frames.times.empty()) throw InputError(capture.name, "no images are loaded", "check the frames asked for");
  const std::size_t count = frames.times.size();
  Sequence s{chain, capture, std::move(frames.times), std::move(frames.views), {}, {}, options};
  s.each.prior = {};
  s.seen.assign(count, 0);
  s.solutions.resize(count);
  s.ways.assign(count, -1.0);
  for (std::size_t f = 0; f < count; ++f)
    s.seen[f] = std::any_of(s.views[f].begin(), s.views[f].end(),
                            [&](int v) { return capture::shows_object(capture.views[v]); });
  if (std::find(s.seen.begin(), s.seen.end(), 1) == s.seen.end())
    throw InputError(capture.name, "no mask shows the object in any frame",
                     "check the masks, or make them with `chainsplat mask`");
  return s;
}

// What is fitted in one frame. It is made anew for every fit: of all frames together it would fill the memory.
struct FrameMasks {
  std::vector<MaskPoints> points;
  std::vector<FrameView> views;  // which refer to `points`
};

// Of the frames [first, last).
std::vector<FrameMasks> masks_of(const Sequence& s, int first, int last) {
  std::vector<FrameMasks> out(last - first);
  struct Part {
    FrameMasks* frame;
    std::size_t view;
  };
  std::vector<Part> parts;
  for (FrameMasks& frame : out) {
    const std::vector<int>& views = s.views[first + (&frame - out.data())];
    frame.points.resize(views.size());
    frame.views.resize(views.size());
    for (std::size_t i = 0; i < views.size(); ++i) parts.push_back({&frame, i});
  }
  core::parallel_for(static_cast<std::int64_t>(parts.size()), [&](std::int64_t i) {
    const auto [frame, at] = parts[i];
    const capture::PackedView& view = s.capture.views[s.views[first + (frame - out.data())][at]];
    const capture::Camera& camera = s.capture.cameras[view.camera];
    frame->points[at] = mask_points(capture::unpacked(view), camera, s.each.max_pixels);
    frame->views[at] = {&frame->points[at], &camera, s.capture.base.pose(view.time)};
  });
  return out;
}

// Calls fit(frame, its masks) for every frame in order. Masks are made in blocks, so that all threads have work.
template <class Fit>
void each_frame(const Sequence& s, const Fit& fit) {
  constexpr int kBlock = 32;  // frames
  for (int first = 0; first < s.count(); first += kBlock) {
    const int last = std::min(first + kBlock, s.count());
    const std::vector<FrameMasks> masks = masks_of(s, first, last);
    for (int f = first; f < last; ++f) fit(f, masks[f - first].views);
  }
}

// Whether a fit shows clearly more of the masks, and nearer to their outline. What is hidden costs a right fit more
// than one that is folded into what is seen.
bool explains_more(const FrameFit& a, const FrameFit& b) {
  return a.covered > b.covered + kLessCovered && kMoreResidual * a.residual_pixels < b.residual_pixels;
}

// m, RMS over the nodes: how far the rope goes from one shape to another, relative to the base.
double way_between(const chain::Chain& chain, const VectorX& from, const VectorX& to) {
  const auto nodes = [&](const VectorX& theta) { return chain::nodes(chain, chain::link_motions(chain, theta, {})); };
  return std::sqrt((nodes(to) - nodes(from)).colwise().squaredNorm().mean());
}

// By the ways to the frames [first, last).
double far_of(const Sequence& s, int first, int last) {
  std::vector<double> ways;
  std::copy_if(s.ways.begin() + first, s.ways.begin() + last, std::back_inserter(ways),
               [](double w) { return w >= 0.0; });
  return std::max(kJumpShare * s.chain.length, ways.empty() ? 0.0 : kJump * math::median(ways));
}

// Whether such a shape at a frame is far from those before and after it.
bool leaves_neighbors(const Sequence& s, int f, const VectorX& theta) {
  if (s.far == 0.0) return false;
  const auto is_near = [&](int other) {
    return other >= 0 && other < s.count() && s.seen[other] && s.solutions[other].fit.theta.size() > 0 &&
           way_between(s.chain, s.solutions[other].fit.theta, theta) <= s.far;
  };
  return !is_near(f - 1) && !is_near(f + 1);
}

// Fits a frame once more, and keeps what is clearly better. A rope in a loop may as well be laid the other way round
// into its masks, and where a part of it is hidden even better: not where the frames beside it say otherwise.
void try_again(Sequence& s, int f, const std::vector<FrameView>& views, const VectorX& from, bool warm) {
  FrameSolution again = solve_frame(s.chain, views, from, warm, s.each);
  FrameSolution& old = s.solutions[f];
  const bool leaves = leaves_neighbors(s, f, again.fit.theta) && !leaves_neighbors(s, f, old.fit.theta);
  const bool cheaper = again.cost < (leaves ? kMuchBetter : kBetter) * old.cost && !explains_less(again.fit, old.fit) &&
                       !explains_more(old.fit, again.fit);
  if (cheaper || explains_more(again.fit, old.fit)) old = std::move(again);
}

// A frame's fit with the belief that the rope is near these angles.
FrameSolution solve_near(const Sequence& s, const std::vector<FrameView>& views, const VectorX& theta) {
  Options believed = s.each;
  believed.prior.mean = theta;
  believed.prior.information = MatrixX::Identity(theta.size(), theta.size()) / (kBelieved * kBelieved);
  return solve_frame(s.chain, views, theta, true, believed);
}

// Where the rope leaves the frame before, whose angles are `before`: fits it once more with the belief that it does
// not, and keeps that though it costs somewhat more.
void follow(Sequence& s, int f, const std::vector<FrameView>& views, const VectorX& before) {
  FrameSolution& old = s.solutions[f];
  if (way_between(s.chain, before, old.fit.theta) <= s.far) return;
  FrameSolution again = solve_near(s, views, before);
  if (way_between(s.chain, before, again.fit.theta) <= s.far && again.cost < kCostsMore * old.cost)
    old = std::move(again);
}

// Frame after frame, each from the one before; from scratch at first and where the rope is lost.
void fit_forward(Sequence& s) {
  const int first = static_cast<int>(std::find(s.seen.begin(), s.seen.end(), 1) - s.seen.begin());
  VectorX start = s.straight();
  each_frame(s, [&](int f, const std::vector<FrameView>& views) {
    s.solutions[f] = solve_frame(s.chain, views, start, f > first, s.each);
    const FrameFit& fit = s.solutions[f].fit;
    s.far = far_of(s, std::max(0, f - kRecent), f);
    if (f > first + 1 && s.seen[f]) follow(s, f, views, start);
    if (f > first && s.seen[f] && fit.covered < kLost) try_again(s, f, views, s.straight(), false);
    if (!s.seen[f]) return;
    if (f > first && s.seen[f - 1]) s.ways[f] = way_between(s.chain, start, s.solutions[f].fit.theta);
    start = s.solutions[f].fit.theta;
  });
}

// Runs of bad frames once more: backward from the good frame after them, from scratch, and forward.
void repair(Sequence& s) {
  std::vector<double> covered, inside, residual;
  for (int f = 0; f < s.count(); ++f) {
    if (!s.seen[f]) continue;
    covered.push_back(s.solutions[f].fit.covered);
    inside.push_back(s.solutions[f].fit.inside);
    residual.push_back(s.solutions[f].fit.residual_pixels);
  }
  const double usual_covered = math::median(covered), usual_inside = math::median(inside),
               usual_residual = math::median(residual);
  const auto unexplained = [&](int f) {
    const FrameFit& fit = s.solutions[f].fit;
    return s.seen[f] && (fit.covered < usual_covered - kLessCovered ||
                         fit.residual_pixels > kMoreResidual * usual_residual + kMoreResidualPixels);
  };
  const auto bad = [&](int f) {
    return unexplained(f) || (s.seen[f] && s.solutions[f].fit.inside < usual_inside - kLessInside);
  };
  for (int f = s.count() - 1; f >= 0; --f) {
    if (!bad(f)) continue;
    const FrameMasks masks = std::move(masks_of(s, f, f + 1)[0]);
    if (f + 1 < s.count()) try_again(s, f, masks.views, s.solutions[f + 1].fit.theta, true);
    // from scratch a part that is hidden would be found where the rope is seen
    if (unexplained(f)) try_again(s, f, masks.views, s.straight(), false);
  }
  for (int f = 1; f < s.count(); ++f)
    if (bad(f)) try_again(s, f, masks_of(s, f, f + 1)[0].views, s.solutions[f - 1].fit.theta, true);
}

// No rope leaves the frames beside it, which are alike, and comes back from one to the next: where it was found so,
// something else was taken for it. It is sought near them, whatever that costs more. Where nothing is found there
// either, such a frame does not count as seen. Returns those.
std::vector<int> stay(Sequence& s) {
  std::vector<int> unseen;
  for (int f = 1; f + 1 < s.count(); ++f) {
    if (!s.seen[f - 1] || !s.seen[f] || !s.seen[f + 1]) continue;
    const VectorX &before = s.solutions[f - 1].fit.theta, &after = s.solutions[f + 1].fit.theta;
    if (!leaves_neighbors(s, f, s.solutions[f].fit.theta) || way_between(s.chain, before, after) > s.far) continue;
    const VectorX middle = 0.5 * (before + after);
    FrameSolution again = solve_near(s, masks_of(s, f, f + 1)[0].views, middle);
    if (leaves_neighbors(s, f, again.fit.theta)) {
      again = solve_frame(s.chain, {}, middle, true, s.each);
      s.seen[f] = 0;
      unseen.push_back(f);
    }
    s.solutions[f] = std::move(again);
  }
  return unseen;
}

// One camera tells depth by the width of the mask: how much wider than the rope masks are is learned from all frames,
// which are then fitted with that.
void share_edge_offset(Sequence& s) {
  std::vector<double> offsets;
  double views_a_frame = 0.0;
  for (int f = 0; f < s.count(); ++f) {
    if (!s.seen[f]) continue;
    offsets.push_back(s.solutions[f].fit.edge_offset);
    views_a_frame += s.views[f].size();
  }
  if (offsets.size() <= 1 || views_a_frame >= kFewViews * offsets.size()) return;
  s.each.edge_offset = math::median(offsets);
  s.each.edge_offset_deviation = kCommonOffsetDeviation;
  const std::vector<VectorX> near = smoothed(s.times, s.solutions, s.seen);
  each_frame(s, [&](int f, const std::vector<FrameView>& views) {
    if (s.seen[f]) s.solutions[f] = solve_frame(s.chain, views, near[f], true, s.each);
  });
}

void warn_of(const Sequence& s, const std::vector<int>& frames, const std::string& what) {
  if (frames.empty()) return;
  core::warn(s.capture.name + ": " + std::to_string(frames.size()) + " of " + std::to_string(s.count()) + " frames " +
             what + " (first " + std::to_string(frames.front()) + ", last " + std::to_string(frames.back()) +
             "); their angles follow from the frames around them");
}

}  // namespace

SequenceFit fit_sequence(const chain::Chain& chain, const capture::Capture& capture, const Options& options) {
  capture::require_pixels(capture, capture::Pixels::undistorted);
  Sequence s = make_sequence(chain, capture, options);
  fit_forward(s);
  s.far = far_of(s, 0, s.count());
  repair(s);
  std::vector<int> empty;
  for (int f = 0; f < s.count(); ++f)
    if (!s.seen[f]) empty.push_back(f);
  warn_of(s, empty, "have no mask pixel in any camera");
  warn_of(s, stay(s), "show no rope near that of the frames beside them");
  share_edge_offset(s);

  SequenceFit out;
  out.states.time = s.times;
  if (options.smooth_in_time) out.states.theta = smoothed(s.times, s.solutions, s.seen);
  std::vector<solve::Summary> summaries;
  for (int f = 0; f < s.count(); ++f) {
    if (s.seen[f]) summaries.push_back(s.solutions[f].fit.summary);
    if (!options.smooth_in_time) out.states.theta.push_back(s.solutions[f].fit.theta);
    out.frames.push_back(std::move(s.solutions[f].fit));
    s.solutions[f] = {};  // its information is as large as the fit
  }
  out.summary = solve::together(summaries);
  out.states.thetadot = derivative(s.times, out.states.theta);
  return out;
}

}  // namespace chainsplat::silhouette
