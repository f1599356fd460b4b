#include <cmath>
#include <cstdio>

#include "chainsplat/identification.h"

namespace chainsplat::identification {
namespace {

using math::MatrixX;
using math::Vector3;
using math::VectorX;

constexpr double kBendSd = 0.7;      // rad, one angle about the straight rope
constexpr double kSmoothSd = 0.15;   // rad, between the same axes of neighboring joints
constexpr double kRateSd = 9.0;      // rad/s, from one time to the next
constexpr double kStretch = 0.05;    // of a rope, and
constexpr double kMountMost = 0.03;  // m, of a marker's mount: how far beyond its arclength a marker may be
constexpr int kIterations = 30;      // of Levenberg-Marquardt, a time
constexpr double kConverged = 1e-9;  // rad, largest step

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
  for (std::size_t k = 0; k < markers.time.size(); ++k) {
    const std::string at = "at " + core::exact(markers.time[k]) + " s ";
    if (!std::isfinite(markers.time[k]) || (k > 0 && !(markers.time[k] > markers.time[k - 1])))
      refuse(at + "the times do not increase", "sort them");
    if (markers.world[k].rows() != 3 || markers.world[k].cols() != static_cast<Eigen::Index>(markers.arclengths.size()))
      refuse(at + "the number of positions is another", "give one a marker, NaN where it is not seen");
    // a straight rope reaches as far as its arclength; more is another rope, another unit or another frame
    const Vector3 grasp = base.pose(markers.time[k]).translation;
    for (Eigen::Index i = 0; i < markers.world[k].cols(); ++i) {
      const double distance = (markers.world[k].col(i) - grasp).norm(), reach = markers.arclengths[i];
      if (distance > (1.0 + kStretch) * reach + kMountMost) {
        char text[120];
        std::snprintf(text, sizeof text, "marker %d is %.3g m from the grasp and its arclength is %.3g m",
                      static_cast<int>(i) + 1, distance, reach);
        refuse(at + text, "is it another rope, another unit, or the base in another frame?");
      }
    }
    bool seen = false;
    for (Eigen::Index i = 0; i < markers.world[k].cols(); ++i) seen |= markers.world[k].col(i).allFinite();
    if (!seen) refuse(at + "no marker is seen", "leave that time out");
  }
}

}  // namespace

chain::States fit_markers(const chain::Chain& chain, const trajectory::Trajectory& base, const Markers& markers,
                          std::vector<MatrixX>* covariances) {
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
  if (covariances) covariances->clear();
  chain::States states;
  VectorX theta = VectorX::Zero(n);
  for (std::size_t frame = 0; frame < markers.time.size(); ++frame) {
    const math::Pose pose = base.pose(markers.time[frame]);
    const VectorX before = theta;
    const double step_sd = frame == 0 ? 0.0 : kRateSd * (markers.time[frame] - markers.time[frame - 1]);
    const double hold = frame == 0 ? 0.0 : 1.0 / (step_sd * step_sd);
    MatrixX hessian;
    const auto cost_at = [&](const VectorX& angles, VectorX* gradient) {
      const auto motions = chain::link_motions(chain, angles, pose);
      const MatrixX axes = chain::world_axes(chain, angles, pose);
      double cost = 0.5 * angles.dot(shape * angles) + 0.5 * hold * (angles - before).squaredNorm();
      if (gradient) {
        hessian = shape;
        hessian.diagonal().array() += hold;
        *gradient = shape * angles + hold * (angles - before);
      }
      const double weight = 1.0 / (markers.deviation * markers.deviation);
      for (std::size_t i = 0; i < markers.arclengths.size(); ++i) {
        const math::Vector3 seen = markers.world[frame].col(i);
        if (!seen.allFinite()) continue;
        const int link = chain::link_at(chain, markers.arclengths[i]);
        const math::Vector3 point = motions[link] * (markers.arclengths[i] * chain.direction);
        cost += 0.5 * weight * (point - seen).squaredNorm();
        if (!gradient) continue;
        const MatrixX slope = chain::point_jacobian(chain, axes, link, point);
        hessian += weight * slope.transpose() * slope;
        *gradient += weight * slope.transpose() * (point - seen);
      }
      return cost;
    };
    double damping = 1e-3;
    for (int iteration = 0; iteration < kIterations; ++iteration) {
      VectorX gradient;
      const double cost = cost_at(theta, &gradient);
      MatrixX damped = hessian;
      damped.diagonal() *= 1.0 + damping;
      const VectorX step = damped.ldlt().solve(-gradient);
      if (cost_at(theta + step, nullptr) <= cost) {
        theta += step;
        damping = std::max(0.1 * damping, 1e-12);
      } else {
        damping *= 10.0;
      }
      if (step.cwiseAbs().maxCoeff() < kConverged) break;
    }
    states.time.push_back(markers.time[frame]);
    states.theta.push_back(theta);
    if (covariances) {
      const MatrixX inverse = hessian.ldlt().solve(MatrixX::Identity(n, n));
      covariances->push_back(0.5 * (inverse + inverse.transpose()));
    }
  }
  return states;
}

}  // namespace chainsplat::identification
