#include <algorithm>
#include <cmath>
#include <cstdio>

#include "chainsplat/identification.h"
#include "src/math/decompositions.h"

namespace chainsplat::identification {
namespace {

using math::MatrixX;
using math::Vector3;
using math::VectorX;

constexpr double kBendSd = 1.0;        // rad, one angle about the straight rope
constexpr double kSmoothSd = 0.3;      // rad, between the same axes of neighboring joints
constexpr double kMarkerRateSd = 9.0;  // rad/s, from one time to the next
constexpr double kStretch = 0.05;      // of a rope, and
constexpr double kMountMost = 0.03;    // m, of a marker's mount: how far beyond its arclength a marker may be
constexpr int kIterations = 30;        // of Levenberg-Marquardt, per time
constexpr double kConverged = 1e-9;    // rad, largest step
constexpr double kFarthest = 1e4;      // m, from the grasp: no slip of a tracker, but damage
constexpr double kDoubt = 0.5;       // deviations: markers farther off, RMS, may mean that the rope was folded wrongly
constexpr int kAimIterations = 8;    // of Gauss-Newton, per joint,
constexpr double kAimDamping = 0.1;  // with this added to squared sines: full steps stay below a right angle

void check(const chain::Chain& chain, const trajectory::Trajectory& base, const Markers& markers) {
  const auto refuse = [](const std::string& what, const std::string& mend) { throw InputError("markers", what, mend); };
  if (markers.arclengths.empty()) refuse("there are none", "give at least one with its arclength");
  for (double s : markers.arclengths)
    if (!(s >= 0.0 && s <= chain.length))
      refuse("arclength " + core::exact(s) + " is not on a rope of " + core::exact(chain.length) + " m",
             "correct the arclength or the twin's length; is it another rope?");
  if (markers.time.size() < 3 || markers.world.size() != markers.time.size())
    refuse(std::to_string(markers.time.size()) + " times", "give at least 3, each with its positions");
  if (!(markers.deviation > 0.0)) refuse("their deviation is not positive", "give a number > 0 in meters");
  std::vector<int> seen_at(markers.arclengths.size(), 0), beyond = seen_at;
  std::vector<double> first(markers.arclengths.size(), 0.0);
  for (std::size_t k = 0; k < markers.time.size(); ++k) {
    const std::string at = "at " + core::exact(markers.time[k]) + " s ";
    if (!std::isfinite(markers.time[k]) || (k > 0 && !(markers.time[k] > markers.time[k - 1])))
      refuse(at + "the times do not increase", "sort them");
    if (markers.world[k].rows() != 3 || markers.world[k].cols() != static_cast<Eigen::Index>(markers.arclengths.size()))
      refuse(at + "the number of positions is another", "give one a marker, NaN where it is not seen");
    const Vector3 grasp = base.pose(markers.time[k]).translation;
    for (Eigen::Index i = 0; i < markers.world[k].cols(); ++i) {
      if (!markers.world[k].col(i).allFinite()) continue;
      const double distance = (markers.world[k].col(i) - grasp).norm();
      if (!(distance < kFarthest))
        refuse(at + "marker " + std::to_string(i + 1) + " is " + core::exact(distance) + " m from the grasp",
               "leave it empty where it is not seen");
      ++seen_at[i];
      if (distance > (1.0 + kStretch) * markers.arclengths[i] + kMountMost && ++beyond[i] == 1) first[i] = distance;
    }
    bool seen = false;
    for (Eigen::Index i = 0; i < markers.world[k].cols(); ++i) seen |= markers.world[k].col(i).allFinite();
    if (!seen) refuse(at + "no marker is seen", "leave that time out");
  }
  // A straight rope reaches as far as its arclength. Single markers beyond are slips of the tracker, which the robust
  // loss bears; half of them are another rope, another unit or another frame.
  for (std::size_t i = 0; i < beyond.size(); ++i)
    if (2 * beyond[i] > seen_at[i]) {
      char text[120];
      std::snprintf(text, sizeof text, "marker %d is %.3g m from the grasp and its arclength is %.3g m",
                    static_cast<int>(i) + 1, first[i], markers.arclengths[i]);
      refuse(text, "is it another rope, another unit, or the base in another frame?");
    }
}

// Angles that lay the chain along the polygon of the markers that are seen, one joint after the other from the grasp.
VectorX along_polygon(const chain::Chain& chain, const math::Pose& pose, const Markers& markers, std::size_t frame) {
  std::vector<std::pair<double, Vector3>> corners{{0.0, pose.translation}};
  for (std::size_t i = 0; i < markers.arclengths.size(); ++i)
    if (markers.world[frame].col(i).allFinite())
      corners.emplace_back(markers.arclengths[i], markers.world[frame].col(i));
  std::stable_sort(corners.begin(), corners.end(), [](const auto& a, const auto& b) { return a.first < b.first; });
  const auto corner_at = [&](double s) {
    std::size_t i = 1;
    while (i + 1 < corners.size() && corners[i].first < s) ++i;
    const auto& [from, a] = corners[i - 1];
    const auto& [to, b] = corners[i];
    return to > from ? Vector3(a + (s - from) / (to - from) * (b - a)) : b;
  };
  VectorX theta = VectorX::Zero(chain.angles());
  if (corners.size() < 2) return theta;
  for (int link = 1; link < chain.links(); ++link) {
    const double begin = chain.link_start(link), end = chain.link_end(link);
    const Vector3 aim = (corner_at(end) - corner_at(begin)).normalized();
    if (!aim.allFinite()) continue;
    const int last = chain.last_angle(link);
    int count = 0;
    while (last - count >= 0 && chain.child_link[last - count] == link) ++count;
    const auto evaluate = [&](const VectorX& joint, solve::NormalEquations* equations) {
      theta.segment(last - count + 1, count) = joint;
      const math::Pose motion = chain::link_motions(chain, theta, pose)[link];
      const Vector3 off = motion.rotation * chain.direction - aim;
      const MatrixX axes = chain::world_axes(chain, theta, pose);
      MatrixX slope(3, count);
      for (int c = 0; c < count; ++c)
        slope.col(c) = axes.col(last - count + 1 + c).head<3>().cross(motion.rotation * chain.direction);
      *equations = {slope.transpose() * slope, slope.transpose() * off};
      return 0.5 * off.squaredNorm();
    };
    VectorX joint = theta.segment(last - count + 1, count);
    solve::least_squares(joint, evaluate,
                         {.steps = kAimIterations,
                          .checked = false,
                          .damping = {.rule = solve::Damping::Rule::fixed, .first = kAimDamping}});
    theta.segment(last - count + 1, count) = joint;
  }
  return theta;
}

}  // namespace

MarkerFit fit_markers(const chain::Chain& chain, const trajectory::Trajectory& base, const Markers& markers) {
  check(chain, base, markers);
  const int n = chain.angles();
  MatrixX shape = MatrixX::Identity(n, n) / (kBendSd * kBendSd);
  for (int i = 0; i < n; ++i)
    for (int k = i + 1; k < n; ++k) {
      const bool neighbors = chain.child_link[k] == chain.child_link[i] + 1;
      if (!neighbors || !chain.axes[i].head<3>().isApprox(chain.axes[k].head<3>())) continue;
      const double weight = 1.0 / (kSmoothSd * kSmoothSd);
      shape(i, i) += weight, shape(k, k) += weight, shape(i, k) -= weight, shape(k, i) -= weight;
    }
  MarkerFit out;
  std::vector<solve::Summary> summaries;
  solve::Options options;
  options.steps = options.trials = kIterations;
  options.ties = true;
  options.step_tolerance = kConverged;
  VectorX theta = VectorX::Zero(n);
  for (std::size_t frame = 0; frame < markers.time.size(); ++frame) {
    const math::Pose pose = base.pose(markers.time[frame]);
    const VectorX before = theta;
    const double step_sd = frame == 0 ? 0.0 : kMarkerRateSd * (markers.time[frame] - markers.time[frame - 1]);
    const double hold = frame == 0 ? 0.0 : 1.0 / (step_sd * step_sd);
    double squares = 0.0;  // m^2, of the markers that are seen
    const auto evaluate = [&](const VectorX& angles, solve::NormalEquations* equations) {
      const auto motions = chain::link_motions(chain, angles, pose);
      const MatrixX axes = chain::world_axes(chain, angles, pose);
      double cost = 0.5 * angles.dot(shape * angles) + 0.5 * hold * (angles - before).squaredNorm();
      if (equations) {
        *equations = {shape, shape * angles + hold * (angles - before)};
        equations->matrix.diagonal().array() += hold;
      }
      squares = 0.0;
      const double weight = 1.0 / (markers.deviation * markers.deviation);
      for (std::size_t i = 0; i < markers.arclengths.size(); ++i) {
        const math::Vector3 seen = markers.world[frame].col(i);
        if (!seen.allFinite()) continue;
        const int link = chain::link_at(chain, markers.arclengths[i]);
        const math::Vector3 point = motions[link] * (markers.arclengths[i] * chain.direction);
        squares += (point - seen).squaredNorm();
        if (!equations) continue;
        const MatrixX slope = chain::point_jacobian(chain, axes, link, point);
        equations->matrix += weight * slope.transpose() * slope;
        equations->gradient += weight * slope.transpose() * (point - seen);
      }
      return cost + 0.5 * weight * squares;
    };
    summaries.push_back(solve::least_squares(theta, evaluate, options));
    const double cost = evaluate(theta, nullptr);
    const double seen = static_cast<double>(markers.world[frame].array().isFinite().count());
    if (squares > kDoubt * kDoubt * markers.deviation * markers.deviation * seen) {
      VectorX other = along_polygon(chain, pose, markers, frame);
      const solve::Summary summary = solve::least_squares(other, evaluate, options);
      if (evaluate(other, nullptr) < cost) theta = other, summaries.back() = summary;
    }
    solve::NormalEquations found;
    evaluate(theta, &found);
    out.states.time.push_back(markers.time[frame]);
    out.states.theta.push_back(theta);
    const Eigen::LDLT<MatrixX> factor(found.matrix);
    if (!math::is_positive(factor))
      throw InputError("markers", "at " + core::exact(markers.time[frame]) + " s they tell no shape of the rope",
                       "correct their positions there");
    const MatrixX inverse = factor.solve(MatrixX::Identity(n, n));
    out.states.covariance.push_back(0.5 * (inverse + inverse.transpose()));
  }
  out.summary = solve::together(summaries);
  const auto unfinished = std::count_if(summaries.begin(), summaries.end(), [](const solve::Summary& summary) {
    return summary.reason == solve::Reason::last_iteration;
  });
  if (unfinished > 0)
    core::warn("markers: at " + std::to_string(unfinished) + " of " + std::to_string(summaries.size()) +
               " times the fit of the chain stopped at its last iteration (" + std::to_string(kIterations) +
               "); all together: cost " + core::exact(out.summary.final_cost));
  return out;
}

}  // namespace chainsplat::identification
