// What a rope's first fit decides of its chain: in how many directions its joints bend, and how many there are.
#include <algorithm>
#include <array>
#include <cmath>

#include "src/silhouette/frame.h"

namespace chainsplat::silhouette {

using math::MatrixX;
using math::Pose;
using math::Vector3;
using math::VectorX;

namespace {

// How well a sequence's fits explain the masks, in the median over the frames that show anything.
struct Explained {
  double residual = 0.0, covered = 0.0, inside = 0.0;
};
Explained explained_by(const SequenceFit& fit) {
  std::vector<double> residual, covered, inside;
  for (const FrameFit& frame : fit.frames) {
    if (frame.residual_pixels <= 0.0) continue;
    residual.push_back(frame.residual_pixels);
    covered.push_back(frame.covered);
    inside.push_back(frame.inside);
  }
  if (residual.empty()) return {};
  return {math::median(residual), math::median(covered), math::median(inside)};
}

// Whether a gripper carries the rope through many pictures. A rope at rest is one still, however often it is shown.
bool is_carried(const capture::Capture& capture, const SequenceFit& fit) {
  constexpr std::size_t kFrames = 20;  // that are seen
  constexpr double kWay = 0.25;        // of the length, from where the grasp was at first
  std::size_t seen = 0;
  double way = 0.0;
  const Vector3 first = capture.base.pose(fit.states.time.front()).translation;
  for (std::size_t f = 0; f < fit.frames.size(); ++f) {
    if (fit.frames[f].residual_pixels <= 0.0) continue;
    ++seen;
    way = std::max(way, (capture.base.pose(fit.states.time[f]).translation - first).norm());
  }
  return seen >= kFrames && way >= kWay * capture.length;
}

// Whether a planar fit of one camera explains so much less than one in space that the rope leaves its plane. The width
// of the masks alone tells depth, and errors of the outline that are alike along the rope look like a bend: of stills
// the planar fit must be clearly worse. Of a rope that is carried it is enough that it is worse: of ropes that left
// their plane by 50 mm it had 1.14 to 1.67 times the residual, of others at most 1.05 times.
bool explains_less(const Explained& planar, const Explained& spatial, bool carried) {
  constexpr double kClearly = 1.5, kClearlyPixels = 0.3, kClearlyShare = 0.15;
  constexpr double kWorse = 1.1, kAsMuch = 0.05;
  const double share = spatial.covered + spatial.inside - planar.covered - planar.inside;
  if (planar.residual > kClearly * spatial.residual + kClearlyPixels || share > kClearlyShare) return true;
  return carried && planar.residual > kWorse * spatial.residual && share > -kAsMuch;
}

}  // namespace

bool seen_by_one(const capture::Capture& capture) {
  const Frames frames = frames_of(capture);
  double views = 0.0, count = 0.0;
  for (const std::vector<int>& of_frame : frames.views)
    if (!of_frame.empty()) views += static_cast<double>(of_frame.size()), ++count;
  return views < kFewViews * count;
}

BendingChoice choose_bending(const chain::Chain& spatial_chain, const capture::Capture& capture,
                             const SequenceFit& fit) {
  constexpr double kSmall = 1e-3;  // m
  constexpr double kDeviations = 3.0;
  constexpr int kPoints = 97;  // along the centerline
  BendingChoice choice;
  if (capture.tabletop) {
    choice.bending = chain::Bending::planar;
    return choice;
  }
  const std::vector<double> arclengths = chain::equal_arclengths(spatial_chain, kPoints);
  double square = 0.0, variance = 0.0, weights = 0.0;  // frames that see little of the third dimension count little
  for (std::size_t f = 0; f < fit.states.theta.size(); ++f) {
    if (fit.frames[f].residual_pixels <= 0.0) continue;  // nothing was seen
    const VectorX& theta = fit.states.theta[f];
    const auto motions = chain::link_motions(spatial_chain, theta, Pose{});
    const MatrixX points = chain::centerline(spatial_chain, motions, arclengths);
    const MatrixX axes = chain::world_axes(spatial_chain, theta, Pose{});
    double frame_square = 0.0, frame_variance = 0.0;
    for (int i = 0; i < kPoints; ++i) {
      const double out_of_plane = spatial_chain.bending_axis.dot(points.col(i));
      const MatrixX jacobian =
          chain::point_jacobian(spatial_chain, axes, chain::link_at(spatial_chain, arclengths[i]), points.col(i));
      const Eigen::RowVectorXd row = spatial_chain.bending_axis.transpose() * jacobian;
      frame_square += out_of_plane * out_of_plane / kPoints;
      frame_variance += row.dot(fit.frames[f].covariance * row.transpose()) / kPoints;
    }
    const double weight = 1.0 / (frame_variance + kSmall * kSmall);
    weights += weight;
    square += weight * frame_square;
    variance += weight * frame_variance;
  }
  if (weights == 0.0) return choice;
  choice.out_of_plane_rms = std::sqrt(square / weights);
  choice.deviation = std::sqrt(variance / weights);
  if (choice.out_of_plane_rms < std::max(kSmall, kDeviations * choice.deviation)) {
    choice.bending = chain::Bending::planar;
  } else if (seen_by_one(capture)) {
    const chain::Chain& s = spatial_chain;
    const chain::Chain planar = chain::make_chain(s.length, s.diameter, s.direction, s.bending_axis, s.links() - 1,
                                                  chain::Bending::planar, false, s.joint_arclength[0]);
    const Explained with = explained_by(fit), without = explained_by(fit_sequence(planar, capture));
    if (!explains_less(without, with, is_carried(capture, fit))) choice.bending = chain::Bending::planar;
  }
  return choice;
}

JointChoice choose_joints(const chain::Chain& chain, const SequenceFit& fit) {
  constexpr std::array kCounts{8, 12, 16, 24};
  // More than 16 joints cost half as much time again in all that follows. They pay where 16 straight links would leave
  // the rope by this much, m. Of all ropes measured only those that go around their gripper bend so much.
  constexpr int kUsual = 16;
  constexpr double kWorthMore = 1e-4;
  constexpr int kPoints = 25;  // along the centerline
  std::vector<chain::MaterialPoint> points;
  for (const double arclength : chain::equal_arclengths(chain, kPoints))
    points.push_back(chain::centerline_point(chain, arclength));
  const int joints = chain.links() - 1, axes_per_joint = chain.angles() / joints;
  double bend = 0.0, variance = 0.0, frames = 0.0;
  for (std::size_t f = 0; f < fit.states.theta.size(); ++f) {
    const FrameFit& frame = fit.frames[f];
    if (frame.residual_pixels <= 0.0) continue;  // nothing was seen
    const VectorX& theta = fit.states.theta[f];
    // without the first joint, where the grasp bends the rope at once
    for (int i = axes_per_joint; i < chain.angles(); ++i)
      if (!chain::is_twist(chain, i)) bend += theta[i] * theta[i] / (joints - 1);
    const auto motions = chain::link_motions(chain, theta, Pose{});
    const MatrixX axes = chain::world_axes(chain, theta, Pose{});
    for (const MatrixX& jacobian : chain::point_jacobians(chain, axes, motions, points))
      variance += (jacobian * frame.covariance * jacobian.transpose()).trace() / kPoints;
    frames += 1.0;
  }
  JointChoice choice{kCounts.front(), joints, 0.0, 0.0};
  if (frames == 0.0) return choice;
  // an arc of angle a over a length h is a h / sqrt(720) RMS from the straight line that fits it best
  choice.bow = chain.length / joints * std::sqrt(std::max(0.0, bend / frames) / 720.0);
  choice.deviation = std::sqrt(variance) / frames;  // an error that all frames share shows where one alone would not
  for (const int count : kCounts) {
    choice.joints = count;
    const double finer = static_cast<double>(count) / joints;
    const double enough = count >= kUsual ? std::max(choice.deviation, kWorthMore) : choice.deviation;
    if (choice.bow <= enough * finer * finer) break;
  }
  return choice;
}

}  // namespace chainsplat::silhouette
