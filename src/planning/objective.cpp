#include "objective.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace chainsplat::planning {
namespace {

constexpr double kLimitWeight = 1.0;   // m^2: 1 % too fast costs as much as 10 mm
constexpr double kLimitMargin = 0.97;  // of a limit, where its cost begins: verified on a finer grid afterwards
constexpr double kClearanceWeight = 30.0;
constexpr double kNearLimit = 0.3;       // of a limit below it, as far as a step may raise a value
constexpr double kNear = 0.04;           // m beyond it, as far as a step may carry a point
constexpr double kRestTime = 0.01;       // s: 10 cm/s left on the table cost as much as 1 mm
constexpr double kNegligible = 1e-7;     // weight in the soft minimum
constexpr int kHermiteSteps = 16;        // between two nodes, for the hard minimum
constexpr double kLimitInterval = 0.02;  // s, between tests of limits and obstacles

// 3 x unknowns: a world point fixed to link `link`.
MatrixX point_slope(const Task& task, const chain::Chain& chain, const Rollout& rollout, const MatrixX& axes, int node,
                    int link, const Vector3& point) {
  MatrixX slope = chain::point_jacobian(chain, axes, link, point) * rollout.theta_slope[node];
  const Vector3 base = rollout.base[node].col(0).head<3>();
  for (std::size_t a = 0; a < task.motion.axes.size(); ++a) {
    const Axis axis = task.motion.axes[a];
    const Vector3 direction =
        axis == Axis::yaw ? task.motion.up.cross(point - base) : Vector3::Unit(static_cast<int>(axis)).eval();
    slope.middleCols(static_cast<Eigen::Index>(a) * kPerAxis, kPerAxis) +=
        direction * task.grid.basis[node].col(0).transpose();
  }
  return slope;
}

math::Pose pose_at(const Task& task, const Rollout& rollout, int node) {
  return {math::exp_so3(rollout.base[node](3, 0) * task.motion.up) * task.motion.origin.rotation,
          rollout.base[node].col(0).head<3>()};
}

// Adds weight * residual^2 with the residual's slope.
void add(Evaluation& sum, double weight, double residual, const VectorX& slope) {
  sum.value += weight * residual * residual;
  sum.gradient += 2.0 * weight * residual * slope;
  sum.curvature.selfadjointView<Eigen::Lower>().rankUpdate(slope, 2.0 * weight);
}

double box_distance(const Box& box, const Vector3& p, Vector3& outward) {
  const Vector3 center = 0.5 * (box.low + box.high), half = 0.5 * (box.high - box.low);
  const Vector3 q = (p - center).cwiseAbs() - half;
  Vector3 sign;
  for (int i = 0; i < 3; ++i) sign[i] = p[i] < center[i] ? -1.0 : 1.0;
  const Vector3 outside = q.cwiseMax(0.0);
  if (const double d = outside.norm(); d > 0.0) {
    outward = outside.cwiseProduct(sign) / d;
    return d;
  }
  int face = 0;
  const double d = q.maxCoeff(&face);
  outward = sign[face] * Vector3::Unit(face);
  return d;
}

// Calls use(link, world point, surface distance, outward normal) for all points that are watched at a node.
template <class Use>
void watch(const Task& task, const chain::Chain& chain, const std::vector<math::Pose>& motions, const Use& use) {
  const Options& options = *task.options;
  const auto test = [&](int link, const Vector3& point, double radius) {
    for (const Sphere& sphere : options.spheres) {
      const Vector3 away = point - sphere.center;
      const double distance = away.norm();
      use(link, point, distance - sphere.radius - radius, distance > 0.0 ? Vector3(away / distance) : Vector3::UnitZ());
    }
    for (const Box& box : options.boxes) {
      Vector3 outward = Vector3::Zero();
      const double distance = box_distance(box, point, outward);
      use(link, point, distance - radius, outward);
    }
  };
  test(0, motions[0].translation, options.gripper_radius);
  for (int link = 1; link < chain.links(); ++link)
    for (const double part : {0.5, 1.0}) {
      const double s = chain.link_start(link) + part * (chain.link_end(link) - chain.link_start(link));
      test(link, motions[link] * (s * chain.direction), 0.5 * chain.diameter);
    }
}

Nearest nearest_on(const chain::Chain& chain, const std::vector<math::Pose>& motions, int link, const Vector3& target) {
  const double start = chain.link_start(link), end = chain.link_end(link);
  const Vector3 a = motions[link] * (start * chain.direction), b = motions[link] * (end * chain.direction);
  const double part = std::clamp((target - a).dot(b - a) / (b - a).squaredNorm(), 0.0, 1.0);
  const Vector3 point = a + part * (b - a);
  return {link, point, (point - target).squaredNorm(), start + part * (end - start)};
}

struct Candidate {
  int node;
  Nearest nearest;
};

// The soft minimum of one model's squared distances; its derivatives are added with `scale` where `sum` is given.
struct Soft {
  double value = 0.0, miss = 0.0;
  std::vector<Candidate> candidates;
  std::vector<double> weights;
};

Soft soft_minimum(const Task& task, const dynamics::Model& model, const Rollout& rollout, double sharpness) {
  const chain::Chain& chain = model.chain;
  Soft soft;
  const int nodes = task.grid.nodes();
  for (int node = task.tabletop ? nodes - 1 : 0; node < nodes; ++node) {
    const auto motions = chain::link_motions(chain, rollout.theta[node], pose_at(task, rollout, node));
    const Vector3 target = task.target_at(task.grid.time(node));
    if (!task.tabletop || task.part != Part::rope) {
      soft.candidates.push_back({node, nearest(chain, motions, task.part, target)});
      continue;
    }
    for (int link = task.first_link; link < chain.links(); ++link)
      soft.candidates.push_back({node, nearest_on(chain, motions, link, target)});
  }
  double least = std::numeric_limits<double>::infinity(), total = 0.0;
  for (const Candidate& c : soft.candidates) least = std::min(least, c.nearest.squared);
  for (const Candidate& c : soft.candidates) {
    soft.weights.push_back(std::exp(-sharpness * (c.nearest.squared - least)));
    total += soft.weights.back();
  }
  for (double& w : soft.weights) w /= total;
  soft.value = least - std::log(total) / sharpness;
  soft.miss = std::sqrt(least);
  return soft;
}

// The sum under way.
struct Terms {
  const Task& task;
  const Sharpness& sharpness;
  bool derivatives = false;
  Evaluation sum;
  double counted = 0.0;  // of the value: what is no violation
  int stride = 1;        // nodes between tests of limits and obstacles
};

// A square that counts above zero only, and what a step may do to it: `near` is how far below zero a step may begin.
// `slope()`: of the residual, where derivatives are asked for.
template <class Slope>
void add_one_sided(Terms& t, double weight, double residual, double near, const Slope& slope) {
  if (residual <= (t.derivatives ? -near : 0.0)) return;
  if (!t.derivatives) {
    t.sum.value += weight * residual * residual;
    return;
  }
  VectorX by_unknown = slope();
  if (residual > 0.0) add(t.sum, weight, residual, by_unknown);
  for (Eigen::Index i = 0; i < by_unknown.size(); ++i)
    if (t.task.held[i]) by_unknown[i] = 0.0;
  t.sum.near.push_back({residual, weight, std::move(by_unknown)});
}

// The samples' soft minima, averaged, or their soft maximum. Returns each sample's share in it.
std::vector<double> add_misses(Terms& t, const std::vector<Soft>& soft) {
  const auto samples = static_cast<int>(soft.size());
  std::vector<double> share(samples, 1.0 / samples);
  Evaluation& sum = t.sum;
  if (t.task.options->worst_case && samples > 1) {
    double largest = -std::numeric_limits<double>::infinity(), total = 0.0;
    for (const Soft& s : soft) largest = std::max(largest, s.value);
    for (int m = 0; m < samples; ++m)
      total += share[m] = std::exp(t.sharpness.soft_minimum * (soft[m].value - largest));
    for (double& s : share) s /= total;
    sum.value = largest + std::log(total) / t.sharpness.soft_minimum;
    for (const Soft& s : soft) sum.miss = std::max(sum.miss, s.miss);
  } else {
    for (const Soft& s : soft) sum.value += s.value / samples, sum.miss += s.miss / samples;
  }
  t.counted = sum.value;
  return share;
}

// Derivatives of one sample's soft minimum.
void add_pull(Terms& t, const dynamics::Model& model, const Rollout& rollout, const Soft& soft, double share) {
  const chain::Chain& chain = model.chain;
  for (std::size_t i = 0; i < soft.candidates.size(); ++i) {
    const double weight = share * soft.weights[i];
    if (weight < kNegligible) continue;
    const auto& [node, best] = soft.candidates[i];
    const MatrixX axes = chain::world_axes(chain, rollout.theta[node], pose_at(t.task, rollout, node));
    const MatrixX slope = point_slope(t.task, chain, rollout, axes, node, best.link, best.point);
    const Vector3 apart = best.point - t.task.target_at(t.task.grid.time(node));
    t.sum.gradient += 2.0 * weight * slope.transpose() * apart;
    t.sum.curvature.selfadjointView<Eigen::Lower>().rankUpdate(slope.transpose(), 2.0 * weight);
  }
}

// At rest in the end: the speed that each joint gives to the free end.
void add_rest(Terms& t, const chain::Chain& chain, const Rollout& rollout) {
  const double weight = 1.0 / static_cast<double>(t.task.models.size() * chain.angles());
  for (int k = 0; k < chain.angles(); ++k) {
    const double arm = kRestTime * (chain.length - chain.link_start(chain.child_link[k]));
    const double residual = arm * rollout.thetadot.back()[k];
    if (t.derivatives)
      add(t.sum, weight, residual, arm * rollout.thetadot_slope.back().row(k).transpose());
    else
      t.sum.value += weight * residual * residual;
  }
}

void add_obstacles(Terms& t, const chain::Chain& chain, const Rollout& rollout) {
  const Task& task = t.task;
  const double weight = task.limit_weight * kClearanceWeight / static_cast<double>(task.models.size());
  for (int node = 0; node < task.grid.nodes(); node += t.stride) {
    const math::Pose base = pose_at(task, rollout, node);
    const auto motions = chain::link_motions(chain, rollout.theta[node], base);
    MatrixX axes;
    watch(task, chain, motions, [&](int link, const Vector3& point, double distance, const Vector3& outward) {
      add_one_sided(t, weight, t.sharpness.clearance - distance, kNear, [&] {
        if (axes.size() == 0) axes = chain::world_axes(chain, rollout.theta[node], base);
        return VectorX(-(point_slope(task, chain, rollout, axes, node, link, point).transpose() * outward));
      });
    });
  }
}

// A limit on a derivative of the base's motion, of its translation or its yaw.
void add_limit(Terms& t, const Basis& basis, const Coordinates& base, int derivative, double most, bool yaw) {
  const Task& task = t.task;
  const double value = yaw ? std::abs(base(3, derivative)) : base.col(derivative).head<3>().norm();
  add_one_sided(t, task.limit_weight * kLimitWeight, value / most - kLimitMargin, kNearLimit, [&] {
    VectorX slope = VectorX::Zero(t.sum.gradient.size());
    for (std::size_t a = 0; a < task.motion.axes.size(); ++a) {
      const Axis axis = task.motion.axes[a];
      if ((axis == Axis::yaw) != yaw) continue;
      const double direction = base(static_cast<int>(axis), derivative) / value;
      slope.segment(static_cast<Eigen::Index>(a) * kPerAxis, kPerAxis) = direction / most * basis.col(derivative);
    }
    return slope;
  });
}

void add_limits(Terms& t, const std::vector<Coordinates>& base, const VectorX& unknowns) {
  const Task& task = t.task;
  const Limits& limits = task.options->limits;
  const bool smooth = task.motion.window == Window::smooth;
  for (int node = 0; node < task.grid.nodes(); node += t.stride) {
    const Basis& b = task.grid.basis[node];
    add_limit(t, b, base[node], 1, limits.velocity, false);
    add_limit(t, b, base[node], 2, limits.acceleration, false);
    if (smooth) add_limit(t, b, base[node], 3, limits.jerk, false);
    add_limit(t, b, base[node], 1, limits.yaw_velocity, true);
    add_limit(t, b, base[node], 2, limits.yaw_acceleration, true);
    if (smooth) add_limit(t, b, base[node], 3, limits.yaw_jerk, true);
  }
  if (!smooth) return;
  const Coordinates end = moved(task.motion, unknowns, task.grid.end_basis, task.grid.end_fixed);
  add_limit(t, task.grid.end_basis, end, 3, limits.jerk, false);
  add_limit(t, task.grid.end_basis, end, 3, limits.yaw_jerk, true);
}

// Smoothness and stroke along one axis, the a-th of the motion's. `length`: m, of the rope.
void add_axis(Terms& t, const std::vector<Coordinates>& base, std::size_t a, double length) {
  const Task& task = t.task;
  const int row = static_cast<int>(task.motion.axes[a]), nodes = task.grid.nodes();
  const bool yaw = task.motion.axes[a] == Axis::yaw;
  const double scale = yaw ? length : 1.0;  // an angular acceleration counts by what it does at the rope's length
  const double weight = t.sharpness.smoothness * scale * scale / nodes;
  const auto first = static_cast<Eigen::Index>(a) * kPerAxis;
  const double origin = yaw ? 0.0 : task.motion.origin.translation[row];
  const double most = yaw ? task.options->limits.turn : task.options->limits.stroke;
  for (int node = 0; node < nodes; ++node) {
    const Basis& b = task.grid.basis[node];
    const double smoothness = weight * base[node](row, 2) * base[node](row, 2);
    t.sum.value += smoothness, t.counted += smoothness;
    if (t.derivatives) {
      t.sum.gradient.segment(first, kPerAxis) += 2.0 * weight * base[node](row, 2) * b.col(2);
      t.sum.curvature.block(first, first, kPerAxis, kPerAxis) += 2.0 * weight * b.col(2) * b.col(2).transpose();
    }
    if (node % t.stride != 0) continue;
    const double offset = base[node](row, 0) - origin;
    add_one_sided(t, task.limit_weight * kLimitWeight, std::abs(offset) / most - kLimitMargin, kNearLimit, [&] {
      VectorX slope = VectorX::Zero(t.sum.gradient.size());
      slope.segment(first, kPerAxis) = (offset < 0.0 ? -1.0 : 1.0) / most * b.col(0);
      return slope;
    });
  }
}

}  // namespace

Part part_of(const Options& options, bool tabletop) { return options.part.value_or(tabletop ? Part::rope : Part::tip); }

Nearest nearest(const chain::Chain& chain, const std::vector<math::Pose>& motions, Part part, const Vector3& target) {
  const int last = chain.links() - 1;
  if (part == Part::tip) {
    const Vector3 tip = motions[last] * (chain.length * chain.direction);
    return {last, tip, (tip - target).squaredNorm(), chain.length};
  }
  Nearest best = nearest_on(chain, motions, last, target);
  for (int link = 1; part == Part::rope && link < last; ++link)
    if (const Nearest here = nearest_on(chain, motions, link, target); here.squared < best.squared) best = here;
  return best;
}

Evaluation evaluate(const Task& task, const VectorX& unknowns, const Sharpness& sharpness, bool derivatives) {
  const int samples = static_cast<int>(task.models.size());
  const Options& options = *task.options;
  Terms t{task, sharpness, derivatives, {}};
  t.sum.gradient.setZero(unknowns.size());
  t.sum.curvature.setZero(unknowns.size(), unknowns.size());
  t.stride = std::max(1, static_cast<int>(std::lround(kLimitInterval / task.grid.step)));

  std::vector<Rollout> rollouts(samples);
  std::vector<char> finite(samples);
  core::parallel_for(samples, [&](std::int64_t m) {
    finite[m] =
        roll_out(*task.models[m], task.motion, task.grid, unknowns, task.initial, derivatives, rollouts[m], task.exact);
  });
  if (std::find(finite.begin(), finite.end(), 0) != finite.end()) return t.sum;
  t.sum.good = true;

  std::vector<Soft> soft;
  for (int m = 0; m < samples; ++m)
    soft.push_back(soft_minimum(task, *task.models[m], rollouts[m], sharpness.soft_minimum));
  const std::vector<double> share = add_misses(t, soft);
  for (int m = 0; m < samples; ++m) {
    const chain::Chain& chain = task.models[m]->chain;
    if (derivatives) add_pull(t, *task.models[m], rollouts[m], soft[m], share[m]);
    if (task.tabletop) add_rest(t, chain, rollouts[m]);
    if (!options.spheres.empty() || !options.boxes.empty()) add_obstacles(t, chain, rollouts[m]);
  }
  // the base's motion is the same for all samples
  const std::vector<Coordinates>& base = rollouts.front().base;
  add_limits(t, base, unknowns);
  for (std::size_t a = 0; a < task.motion.axes.size(); ++a) add_axis(t, base, a, task.models.front()->chain.length);
  t.sum.violation = t.sum.value - t.counted;
  t.sum.curvature.triangularView<Eigen::StrictlyUpper>() = t.sum.curvature.transpose();
  for (Eigen::Index i = 0; derivatives && i < unknowns.size(); ++i)
    if (task.held[i]) {
      t.sum.gradient[i] = 0.0;
      t.sum.curvature.row(i).setZero(), t.sum.curvature.col(i).setZero();
    }
  return std::move(t.sum);
}

Hit measure(const Task& task, const dynamics::Model& model, const Rollout& rollout) {
  const chain::Chain& chain = model.chain;
  Hit hit;
  double least = std::numeric_limits<double>::infinity();
  const auto consider = [&](double time, const VectorX& theta, const math::Pose& base) {
    const Nearest best = nearest(chain, chain::link_motions(chain, theta, base), task.part, task.target_at(time));
    if (best.squared < least)
      least = best.squared, hit.time = time, hit.point = best.point, hit.arclength = best.arclength;
    return best.squared;
  };
  const int last = task.grid.nodes() - 1;
  if (task.tabletop) {
    consider(task.grid.time(last), rollout.theta[last], pose_at(task, rollout, last));
  } else {
    // every interval whose ends could hide a smaller distance than the best node's
    std::vector<double> distance(last + 1);
    double best = std::numeric_limits<double>::infinity();
    for (int k = 0; k <= last; ++k) {
      distance[k] = std::sqrt(consider(task.grid.time(k), rollout.theta[k], pose_at(task, rollout, k)));
      best = std::min(best, distance[k]);
    }
    Motion motion = task.motion;
    const double h = task.grid.step;
    for (int k = 0; k < last; ++k) {
      const double travel = std::abs(distance[k + 1] - distance[k]);
      if (std::min(distance[k], distance[k + 1]) > best + std::max(travel, 0.02)) continue;
      for (int i = 1; i < kHermiteSteps; ++i) {
        const double s = double(i) / kHermiteSteps;
        const double a = (1 + 2 * s) * (1 - s) * (1 - s), b = s * (1 - s) * (1 - s), c = s * s * (3 - 2 * s),
                     d = s * s * (s - 1);
        const VectorX theta = a * rollout.theta[k] + b * h * rollout.thetadot[k] + c * rollout.theta[k + 1] +
                              d * h * rollout.thetadot[k + 1];
        Coordinates base = a * rollout.base[k] + c * rollout.base[k + 1];
        base.col(0) += h * (b * rollout.base[k].col(1) + d * rollout.base[k + 1].col(1));
        consider(task.grid.time(k) + s * h, theta, base_from(motion, base).pose);
      }
    }
  }
  hit.miss = hit.mean_miss = hit.worst_miss = std::sqrt(least);
  return hit;
}

double clearance(const Task& task, const dynamics::Model& model, const Rollout& rollout) {
  double least = std::numeric_limits<double>::infinity();
  for (int node = 0; node < task.grid.nodes(); ++node)
    watch(task, model.chain, chain::link_motions(model.chain, rollout.theta[node], pose_at(task, rollout, node)),
          [&](int, const Vector3&, double distance, const Vector3&) { least = std::min(least, distance); });
  return least;
}

}  // namespace chainsplat::planning
