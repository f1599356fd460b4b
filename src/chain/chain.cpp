#include "chainsplat/chain.h"

#include <algorithm>
#include <cmath>

#include "chainsplat/core.h"

namespace chainsplat::chain {

int Chain::last_angle(int link) const {
  const auto end = std::upper_bound(child_link.begin(), child_link.end(), link);
  return static_cast<int>(end - child_link.begin()) - 1;
}

Chain make_chain(double length, double diameter, const Vector3& direction, const Vector3& bending_axis, int joints,
                 Bending bending, bool twist, double first_joint) {
  CHAINSPLAT_CHECK(joints >= 1 && length > first_joint, std::to_string(joints));
  Chain chain;
  chain.length = length;
  chain.diameter = diameter;
  chain.direction = direction.normalized();
  chain.bending_axis = (bending_axis - bending_axis.dot(chain.direction) * chain.direction).normalized();
  std::vector<Vector3> turns{chain.bending_axis};
  if (bending == Bending::spatial) turns.push_back(chain.direction.cross(chain.bending_axis));
  if (twist) turns.push_back(chain.direction);
  for (int j = 0; j < joints; ++j) {
    const double arclength = first_joint + j * (length - first_joint) / joints;
    chain.joint_arclength.push_back(arclength);
    const Vector3 point = arclength * chain.direction;
    for (const Vector3& turn : turns) {
      Vector6 axis;
      axis << turn, -turn.cross(point);
      chain.axes.push_back(axis);
      chain.child_link.push_back(j + 1);
    }
  }
  return chain;
}

double bent_length(const Chain& chain, int joint) {
  const double behind = 0.5 * (chain.link_end(joint) - chain.link_start(joint));
  const double before = chain.link_end(joint - 1) - chain.link_start(joint - 1);
  return behind + (joint == 1 ? before : 0.5 * before);
}

std::vector<Pose> link_motions(const Chain& chain, const VectorX& theta, const Pose& base) {
  CHAINSPLAT_CHECK(theta.size() == chain.angles(), std::to_string(theta.size()));
  std::vector<Pose> motions(chain.links());
  Pose motion = base;
  motions[0] = base;
  int k = 0;
  for (int link = 1; link < chain.links(); ++link) {
    for (; k < chain.angles() && chain.child_link[k] == link; ++k)
      motion = motion * math::exp_se3(chain.axes[k] * theta[k]);
    motions[link] = motion;
    if (!chain.lift.empty()) motions[link].translation += chain.lift[link] * (motion.rotation * chain.bending_axis);
  }
  return motions;
}

MatrixX world_axes(const Chain& chain, const VectorX& theta, const Pose& base) {
  MatrixX axes(6, chain.angles());
  Pose motion = base;
  for (int k = 0; k < chain.angles(); ++k) {
    axes.col(k) = math::transform_twist(motion, chain.axes[k]);
    motion = motion * math::exp_se3(chain.axes[k] * theta[k]);
  }
  return axes;
}

MatrixX point_jacobian(const Chain& chain, const MatrixX& world_axes, int link, const Vector3& world_point) {
  MatrixX jacobian = MatrixX::Zero(3, chain.angles());
  for (int k = 0; k <= chain.last_angle(link); ++k) {
    const Vector3 w = world_axes.col(k).head<3>();
    jacobian.col(k) = w.cross(world_point) + world_axes.col(k).tail<3>();
  }
  return jacobian;
}

MaterialPoint centerline_point(const Chain& chain, double arclength) {
  return {link_at(chain, arclength), arclength * chain.direction};
}

std::vector<MaterialPoint> shape_points(const Chain& chain, bool middles) {
  std::vector<MaterialPoint> points;
  for (int link = 1; link < chain.links(); ++link) {
    if (middles) points.push_back({link, 0.5 * (chain.link_start(link) + chain.link_end(link)) * chain.direction});
    points.push_back({link, chain.link_end(link) * chain.direction});
  }
  for (int link = 1; has_twist(chain) && link < chain.links(); ++link)
    points.push_back({link, chain.link_end(link) * chain.direction + 0.5 * chain.diameter * chain.bending_axis});
  return points;
}

std::vector<MatrixX> point_jacobians(const Chain& chain, const MatrixX& world_axes, const std::vector<Pose>& motions,
                                     const std::vector<MaterialPoint>& points) {
  std::vector<MatrixX> jacobians;
  for (const MaterialPoint& point : points)
    jacobians.push_back(point_jacobian(chain, world_axes, point.link, motions[point.link] * point.home));
  return jacobians;
}

std::vector<MatrixX> link_end_jacobians(const Chain& chain, const MatrixX& world_axes,
                                        const std::vector<Pose>& motions) {
  const MatrixX ends = nodes(chain, motions).rightCols(chain.links() - 1);
  std::vector<MatrixX> jacobians;
  for (int link = 1; link < chain.links(); ++link)
    jacobians.push_back(point_jacobian(chain, world_axes, link, ends.col(link - 1)));
  return jacobians;
}

std::vector<MatrixX> link_end_jacobians(const Chain& chain, const VectorX& theta, const Pose& base) {
  return link_end_jacobians(chain, chain::world_axes(chain, theta, base), link_motions(chain, theta, base));
}

MatrixX displacement_metric(const std::vector<MatrixX>& jacobians, const VectorX& weights) {
  CHAINSPLAT_CHECK(!jacobians.empty(), "no points");
  MatrixX sum = MatrixX::Zero(jacobians[0].cols(), jacobians[0].cols());
  for (std::size_t i = 0; i < jacobians.size(); ++i)
    sum.noalias() += (weights.size() ? weights[i] : 1.0) * jacobians[i].transpose() * jacobians[i];
  return sum;
}

bool is_twist(const Chain& chain, int angle) {
  return std::abs(chain.axes[angle].head<3>().dot(chain.direction)) > 0.5;
}

namespace {

constexpr double kSameAxis = 0.5;  // cosine; the axes of a joint are perpendicular, so anything between 0 and 1

// Index of the angle before k about the same axis, -1 for the first.
int angle_before(const Chain& chain, int k) {
  for (int l = k - 1; l >= 0; --l)
    if (std::abs(chain.axes[l].head<3>().dot(chain.axes[k].head<3>())) > kSameAxis) return l;
  return -1;
}

}  // namespace

bool has_twist(const Chain& chain) {
  for (int k = 0; k < chain.angles(); ++k)
    if (is_twist(chain, k)) return true;
  return false;
}

bool bends_in_space(const Chain& chain) { return chain.angles() >= chain.links(); }

double neighbor_difference(const Chain& chain, double of_eight) {
  const double finer = 8.0 / (chain.links() - 1);
  return of_eight * finer * finer;
}

MatrixX curvature_information(const Chain& chain, double deviation) {
  // Of the length: over it a bend at the clamp fades by e. Of five ropes that are dragged over a table 0.12 to 0.26.
  constexpr double kFades = 0.18;
  const int n = chain.angles();
  const double difference = 1.0 / (deviation * deviation), equal = chain.length / (chain.links() - 1);
  const double at_clamp = bent_length(chain, 1);
  const double less = std::exp(-(equal - 0.5 * at_clamp) / (kFades * chain.length));  // curvature at the second joint
  MatrixX information = MatrixX::Zero(n, n);
  for (int k = 0; k < n; ++k) {
    const int before = angle_before(chain, k);
    if (before < 0) continue;
    const bool clamped = chain.child_link[before] == 1 && !bends_in_space(chain);
    const double ratio = clamped ? less * equal / at_clamp : 1.0;  // of the two angles
    information(k, k) += difference;
    information(before, before) += ratio * ratio * difference;
    information(k, before) -= ratio * difference;
    information(before, k) -= ratio * difference;
  }
  return information;
}

int link_at(const Chain& chain, double arclength) {
  const auto end = std::upper_bound(chain.joint_arclength.begin(), chain.joint_arclength.end(), arclength);
  return static_cast<int>(end - chain.joint_arclength.begin());
}

MatrixX centerline(const Chain& chain, const std::vector<Pose>& motions, const std::vector<double>& arclengths) {
  MatrixX points(3, arclengths.size());
  for (std::size_t i = 0; i < arclengths.size(); ++i)
    points.col(i) = motions[link_at(chain, arclengths[i])] * (arclengths[i] * chain.direction);
  return points;
}

MatrixX nodes(const Chain& chain, const std::vector<Pose>& motions) {
  std::vector<double> arclengths{0.0};
  arclengths.insert(arclengths.end(), chain.joint_arclength.begin(), chain.joint_arclength.end());
  arclengths.push_back(chain.length);
  return centerline(chain, motions, arclengths);
}

std::vector<double> equal_arclengths(const Chain& chain, int count) {
  std::vector<double> arclengths(count);
  for (int i = 0; i < count; ++i) arclengths[i] = chain.length * i / (count - 1);
  return arclengths;
}

VectorX theta_gradient(const Chain& chain, const MatrixX& world_axes, const MatrixX& link_twist_gradient) {
  VectorX gradient(chain.angles());
  Vector6 outer = Vector6::Zero();  // sum over the links that the angle moves
  int link = chain.links() - 1;
  for (int k = chain.angles() - 1; k >= 0; --k) {
    for (; link >= chain.child_link[k]; --link) outer += link_twist_gradient.col(link);
    gradient[k] = world_axes.col(k).dot(outer);
  }
  return gradient;
}

VectorX interpolate(const States& states, double time) {
  const int count = static_cast<int>(states.time.size());
  CHAINSPLAT_CHECK(count > 0 && states.theta.size() == states.time.size(), std::to_string(count));
  if (count == 1) return states.theta[0];
  const auto above = std::upper_bound(states.time.begin(), states.time.end(), time);
  const int i = std::clamp(static_cast<int>(above - states.time.begin()) - 1, 0, count - 2);
  const double h = states.time[i + 1] - states.time[i];
  const double u = std::clamp((time - states.time[i]) / h, -1.0, 2.0);
  auto slope = [&](int k) -> VectorX {  // rad an interval h
    const int a = std::max(k - 1, 0), b = std::min(k + 1, count - 1);
    return (states.theta[b] - states.theta[a]) * (h / (states.time[b] - states.time[a]));
  };
  const VectorX m0 = slope(i), m1 = slope(i + 1);
  if (u < 0.0) return states.theta[i] + u * m0;
  if (u > 1.0) return states.theta[i + 1] + (u - 1.0) * m1;
  const double u2 = u * u, u3 = u2 * u;
  return (2 * u3 - 3 * u2 + 1) * states.theta[i] + (u3 - 2 * u2 + u) * m0 + (3 * u2 - 2 * u3) * states.theta[i + 1] +
         (u3 - u2) * m1;
}

VectorX roll_at(const States& states, double time) {
  if (states.roll.empty()) return {};
  CHAINSPLAT_CHECK(states.roll.size() == states.time.size(), std::to_string(states.roll.size()));
  const auto above = std::upper_bound(states.time.begin(), states.time.end(), time);
  if (above == states.time.begin()) return states.roll.front();
  if (above == states.time.end()) return states.roll.back();
  const auto i = above - states.time.begin();
  const double u = (time - states.time[i - 1]) / (states.time[i] - states.time[i - 1]);
  return (1.0 - u) * states.roll[i - 1] + u * states.roll[i];
}

std::vector<Pose> material_motions(const Chain& chain, const VectorX& theta, const VectorX& roll, const Pose& base) {
  std::vector<Pose> motions = link_motions(chain, theta, base);
  if (roll.size() == 0) return motions;
  CHAINSPLAT_CHECK(roll.size() == chain.links(), std::to_string(roll.size()));
  for (int link = 0; link < chain.links(); ++link)
    motions[link].rotation = motions[link].rotation * math::exp_so3(roll[link] * chain.direction);
  return motions;
}

std::vector<Pose> material_motions(const Chain& chain, const States& states, double time, const Pose& base) {
  return material_motions(chain, interpolate(states, time), roll_at(states, time), base);
}

}  // namespace chainsplat::chain
