#include <Eigen/Sparse>
#include <algorithm>
#include <array>
#include <cmath>

#include "chainsplat/core.h"
#include "src/silhouette/frame.h"

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

constexpr double kCommonOffsetDeviation = 0.1;  // px, of the masks' offset learned from all frames

// Smoothing over time: random angular accelerations of this size (measured on moving ropes: 3.5 to 5.2 rad/s^2 RMS over
// all joints), with heavy tails for contacts (up to 107).
constexpr double kAcceleration = 5.0;  // rad/s^2
// Share of a fit's variance that is new in every frame; the rest (a bend that straight links cannot follow, the masks'
// width) stays and would be taken for motion if the smoothing trusted the frames less.
constexpr double kIndependent = 0.4;
constexpr double kLinear = 0.3;          // rad, about a fit, that its quadratic is trusted
constexpr double kUnseenWeight = 1e-6;   // of the joint priors of a frame that nothing was seen of
constexpr double kTailDeviations = 2.0;  // beyond this many of them the penalty grows linearly
constexpr int kSmoothingRounds = 4;      // of reweighting
constexpr int kDerivativeReach = 3;      // frames on each side of a local cubic fit

// Second difference of three unevenly spaced values as an acceleration: weights of the three.
std::array<double, 3> acceleration_weights(double t0, double t1, double t2) {
  const double a = t1 - t0, b = t2 - t1;
  return {2.0 / (a * (a + b)), -2.0 / (a * b), 2.0 / (b * (a + b))};
}

// Most likely angles for every frame's quadratic and random accelerations. Frames not `seen` follow from the others.
std::vector<VectorX> smoothed(const std::vector<double>& times, const std::vector<FrameSolution>& solutions,
                              const std::vector<char>& seen) {
  constexpr double kStay = 1.0 / (kLinear * kLinear);
  const int count = static_cast<int>(times.size()), n = static_cast<int>(solutions[0].fit.theta.size());
  std::vector<VectorX> theta(count);
  for (int f = 0; f < count; ++f) theta[f] = solutions[f].fit.theta;
  if (count < 3) return theta;

  VectorX right(count * n);
  std::vector<Eigen::Triplet<double>> data;
  for (int f = 0; f < count; ++f) {
    const FrameSolution& s = solutions[f];
    const double share = seen[f] ? 1.0 / kIndependent : kUnseenWeight, stay = seen[f] ? kStay : 0.0;
    right.segment(f * n, n) = share * (s.information * s.fit.theta + s.gradient) + stay * s.fit.theta;
    for (int k = 0; k < n; ++k)
      for (int l = 0; l <= k; ++l)
        data.emplace_back(f * n + k, f * n + l, share * s.information(k, l) + (k == l ? stay : 0.0));
  }
  Eigen::SimplicialLDLT<Eigen::SparseMatrix<double>, Eigen::Lower, Eigen::NaturalOrdering<int>> solver;
  for (int round = 0; round < kSmoothingRounds; ++round) {
    std::vector<Eigen::Triplet<double>> entries = data;
    for (int f = 1; f + 1 < count; ++f) {
      const std::array<double, 3> w = acceleration_weights(times[f - 1], times[f], times[f + 1]);
      for (int k = 0; k < n; ++k) {
        const double a = w[0] * theta[f - 1][k] + w[1] * theta[f][k] + w[2] * theta[f + 1][k];
        const double size = std::abs(a) / (kTailDeviations * kAcceleration);
        const double weight = (round > 0 && size > 1.0 ? 1.0 / size : 1.0) / (kAcceleration * kAcceleration);
        for (int i = 0; i < 3; ++i)
          for (int j = 0; j <= i; ++j)
            entries.emplace_back((f - 1 + i) * n + k, (f - 1 + j) * n + k, weight * w[i] * w[j]);
      }
    }
    Eigen::SparseMatrix<double> normal(count * n, count * n);
    normal.setFromTriplets(entries.begin(), entries.end());
    if (round == 0) solver.analyzePattern(normal);
    solver.factorize(normal);
    const VectorX all = solver.solve(right);
    if (solver.info() != Eigen::Success || !all.allFinite()) break;
    for (int f = 0; f < count; ++f) theta[f] = all.segment(f * n, n);
  }
  return theta;
}

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
  const auto& views = capture.views;
  if (views.empty()) return frames;
  // all frames of the first camera between its first and last loaded one, views or not
  const int camera = views.front().camera;
  int low = views.front().frame, high = low;
  for (const capture::View& view : views) {
    if (view.camera != camera) continue;
    low = std::min(low, view.frame);
    high = std::max(high, view.frame);
  }
  const bool listed =
      camera < static_cast<int>(capture.times.size()) && high < static_cast<int>(capture.times[camera].size());
  if (listed) {
    frames.times.assign(capture.times[camera].begin() + low, capture.times[camera].begin() + high + 1);
  } else {
    for (const capture::View& view : views)
      if (view.camera == camera) frames.times.push_back(view.time);
  }
  frames.views = capture::views_at(capture, frames.times);
  return frames;
}

namespace {

// The frames of a recording while they are fitted.
struct Sequence {
  const chain::Chain& chain;
  std::vector<double> times;
  std::vector<MaskPoints> masks;              // by view of the capture
  std::vector<std::vector<FrameView>> views;  // by frame
  std::vector<char> seen;                     // by frame: a mask shows something
  std::vector<FrameSolution> solutions;       // by frame
  Options each;                               // for one frame

  int count() const { return static_cast<int>(times.size()); }
  VectorX straight() const { return VectorX::Zero(chain.angles()); }
};

Sequence make_sequence(const chain::Chain& chain, const capture::Capture& capture, const Options& options) {
  Frames frames = frames_of(capture);
  if (frames.times.empty()) throw InputError(capture.name, "no images are loaded", "check the frames asked for");
  const std::size_t count = frames.times.size();
  Sequence s{chain, std::move(frames.times), {}, {}, {}, {}, options};
  s.each.prior = {};
  s.masks.resize(capture.views.size());
  core::parallel_for(static_cast<std::int64_t>(s.masks.size()), [&](std::int64_t v) {
    const capture::View& view = capture.views[v];
    s.masks[v] = mask_points(view, capture.cameras[view.camera], options.max_pixels);
  });
  s.views.resize(count);
  s.seen.assign(count, 0);
  s.solutions.resize(count);
  for (std::size_t f = 0; f < count; ++f)
    for (const int v : frames.views[f]) {
      const capture::View& view = capture.views[v];
      s.views[f].push_back({&s.masks[v], &capture.cameras[view.camera], capture.base.pose(view.time)});
      s.seen[f] = s.seen[f] || s.masks[v].area > 0;
    }
  if (std::find(s.seen.begin(), s.seen.end(), 1) == s.seen.end())
    throw InputError(capture.name, "no mask shows the object in any frame",
                     "check the masks, or make them with `chainsplat mask`");
  return s;
}

// Fits a frame once more, and keeps what is clearly better.
void try_again(Sequence& s, int f, const VectorX& from, bool warm) {
  FrameSolution again = solve_frame(s.chain, s.views[f], from, warm, s.each);
  if (again.cost < kBetter * s.solutions[f].cost) s.solutions[f] = std::move(again);
}

// Frame after frame, each from the one before; from scratch at first and where the rope is lost.
void fit_forward(Sequence& s) {
  const int first = static_cast<int>(std::find(s.seen.begin(), s.seen.end(), 1) - s.seen.begin());
  VectorX start = s.straight();
  for (int f = 0; f < s.count(); ++f) {
    s.solutions[f] = solve_frame(s.chain, s.views[f], start, f > first, s.each);
    const FrameFit& fit = s.solutions[f].fit;
    if (f > first && s.seen[f] && (fit.covered < kLost || fit.inside < kLost)) try_again(s, f, s.straight(), false);
    if (s.seen[f]) start = s.solutions[f].fit.theta;
  }
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
  const auto bad = [&](int f) {
    const FrameFit& fit = s.solutions[f].fit;
    return s.seen[f] && (fit.covered < usual_covered - kLessCovered || fit.inside < usual_inside - kLessInside ||
                         fit.residual_pixels > kMoreResidual * usual_residual + kMoreResidualPixels);
  };
  for (int f = s.count() - 1; f >= 0; --f) {
    if (!bad(f)) continue;
    if (f + 1 < s.count()) try_again(s, f, s.solutions[f + 1].fit.theta, true);
    if (bad(f)) try_again(s, f, s.straight(), false);
  }
  for (int f = 1; f < s.count(); ++f)
    if (bad(f)) try_again(s, f, s.solutions[f - 1].fit.theta, true);
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
  for (int f = 0; f < s.count(); ++f)
    if (s.seen[f]) s.solutions[f] = solve_frame(s.chain, s.views[f], near[f], true, s.each);
}

void warn_of_unseen(const Sequence& s, const std::string& name) {
  const auto unseen = std::count(s.seen.begin(), s.seen.end(), 0);
  if (unseen == 0) return;
  const auto first = std::find(s.seen.begin(), s.seen.end(), 0) - s.seen.begin();
  const auto last = s.seen.rend() - std::find(s.seen.rbegin(), s.seen.rend(), 0) - 1;
  core::warn(name + ": " + std::to_string(unseen) + " of " + std::to_string(s.count()) +
             " frames have no mask pixel in any camera (first " + std::to_string(first) + ", last " +
             std::to_string(last) + "); their angles follow from the frames around them");
}

}  // namespace

SequenceFit fit_sequence(const chain::Chain& chain, const capture::Capture& capture, const Options& options) {
  capture::require_pixels(capture, capture::Pixels::undistorted);
  Sequence s = make_sequence(chain, capture, options);
  fit_forward(s);
  repair(s);
  share_edge_offset(s);
  warn_of_unseen(s, capture.name);

  SequenceFit out;
  std::vector<solve::Summary> summaries;
  for (int f = 0; f < s.count(); ++f) {
    out.frames.push_back(s.solutions[f].fit);
    if (s.seen[f]) summaries.push_back(s.solutions[f].fit.summary);
  }
  out.summary = solve::together(summaries);
  out.states.time = s.times;
  if (options.smooth_in_time) {
    out.states.theta = smoothed(s.times, s.solutions, s.seen);
  } else {
    for (const FrameFit& fit : out.frames) out.states.theta.push_back(fit.theta);
  }
  out.states.thetadot = derivative(s.times, out.states.theta);
  return out;
}

}  // namespace chainsplat::silhouette
