#include "src/masking/one_rope.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "chainsplat/solve.h"

namespace chainsplat::masking {

using math::MatrixX;
using math::Vector2;
using math::VectorX;

namespace {

constexpr double kApart = 1.0;       // radii between the places of an outline that are looked at
constexpr double kConnector = 0.15;  // share of the length: at the tip a rope may be wider, and only its middle counts
constexpr double kLeastOff = 0.5,
                 kOff = 0.06;     // px, and radii, deviation of an outline from the tube of straight links
constexpr double kForeign = 2.0;  // deviations from which on it is hardly believed to be the rope's
constexpr double kJointBend = 30.0 * M_PI / 180;              // deviation of a joint's angle
constexpr double kTurn = 1e-4, kShove = 1e-5, kWiden = 1e-4;  // differences for derivatives: rad, m, share of the width
constexpr int kMostSteps = 12;
constexpr double kSmallDecrease = 0.01;  // of half a sum of squares in deviations

// A place of an outline, or of the middle between both.
struct Place {
  Vector2 at;
  double side = 1.0;  // of the axis, seen toward the free end: 1 right in the picture, -1 left, 0 the middle
};

std::vector<Place> places_of(const Ribbon& ribbon, double length) {
  const std::vector<AxisPoint>& points = ribbon.axis.points;
  std::vector<Place> out;
  double gone = std::numeric_limits<double>::max();
  for (std::size_t i = 1; i + 1 < points.size(); ++i) {
    gone += (points[i].at - points[i - 1].at).norm();
    if (gone < kApart * points[i].radius) continue;
    gone = 0.0;
    const Vector2 along = (points[i + 1].at - points[i - 1].at).normalized(), across(-along.y(), along.x());
    if (points[i].arclength > (1.0 - kConnector) * length)
      out.push_back({points[i].at, 0.0});
    else
      for (const double side : {1.0, -1.0}) out.push_back({points[i].at + side * points[i].radius * across, side});
  }
  return out;
}

// How far a place is outside of the tube, px; one of the middle, how far beside the axis.
double beyond_tube(const Axis& axis, double width, const Place& place) {
  double nearest = std::numeric_limits<double>::max(), out = 0.0;
  for (std::size_t i = 1; i < axis.points.size(); ++i) {
    const AxisPoint &a = axis.points[i - 1], &b = axis.points[i];
    const Vector2 step = b.at - a.at, d = place.at - a.at;
    const double t = std::clamp(d.dot(step) / std::max(1e-12, step.squaredNorm()), 0.0, 1.0);
    const double distance = (d - t * step).squaredNorm();
    if (distance >= nearest) continue;
    nearest = distance;
    const double across = (d.y() * step.x() - d.x() * step.y()) / std::max(1e-9, step.norm());
    out = place.side == 0.0 ? across : place.side * across - width * (a.radius + t * (b.radius - a.radius));
  }
  return out;
}

// The unknowns are the angles, the shift and the width.
struct OneRopeFit {
  const chain::Chain& chain;
  std::span<const Outlined> seen;
  OneRope start;
  Leeway leeway;
  std::vector<std::vector<Place>> places;  // by picture
  VectorX off;                             // px, deviations of all places

  // Of all places from the tube, px.
  VectorX distances(const VectorX& x) const {
    const int angles = chain.angles();
    VectorX out(off.size());
    Eigen::Index n = 0;
    for (std::size_t v = 0; v < seen.size(); ++v) {
      math::Pose base = seen[v].base;
      base.translation = base * math::Vector3(x.segment(angles, 3));
      const Axis line = axis(chain, base, x.head(angles), *seen[v].camera, 0.0, chain.length);
      for (const Place& place : places[v]) out[n++] = beyond_tube(line, x[angles + 3], place);
    }
    return out;
  }

  MatrixX derivatives(const VectorX& x, const VectorX& at_x) const {
    MatrixX out(at_x.size(), x.size());
    for (Eigen::Index k = 0; k < x.size(); ++k) {
      const double step = k < chain.angles() ? kTurn : k + 1 < x.size() ? kShove : kWiden;
      VectorX beside = x;
      beside[k] += step;
      out.col(k) = (distances(beside) - at_x) / step;
    }
    return out;
  }

  // What is known of the rope beforehand.
  double believed(const VectorX& x, solve::NormalEquations* equations) const {
    const int angles = chain.angles(), axes = angles / (chain.links() - 1);
    double cost = 0.0;
    const auto believe = [&](int k, int other, double value, double deviation) {  // that x_k - x_other is the value
      const double weight = 1.0 / (deviation * deviation), d = x[k] - (other < 0 ? 0.0 : x[other]) - value;
      cost += 0.5 * weight * d * d;
      if (!equations) return;
      equations->matrix(k, k) += weight, equations->gradient[k] += weight * d;
      if (other < 0) return;
      equations->matrix(other, other) += weight, equations->gradient[other] -= weight * d;
      equations->matrix(k, other) -= weight, equations->matrix(other, k) -= weight;
    };
    for (int k = 0; k < angles; ++k) {
      believe(k, -1, 0.0, kJointBend);
      if (k >= 2 * axes) believe(k, k - axes, 0.0, leeway.bend_change);  // the first is where the gripper holds it
    }
    for (int k = angles; k < angles + 3; ++k) believe(k, -1, 0.0, leeway.grasp);
    believe(angles + 3, -1, start.width, leeway.width);
    return cost;
  }

  // Geman-McClure's cost: quadratic near the tube, constant far from it.
  double operator()(const VectorX& x, solve::NormalEquations* equations) const {
    const VectorX beyond = distances(x);
    VectorX weight(beyond.size());
    double cost = 0.0;
    for (Eigen::Index i = 0; i < beyond.size(); ++i) {
      const double d = beyond[i] / off[i], share = 1.0 / (1.0 + d * d / (kForeign * kForeign));
      cost += 0.5 * d * d * share;
      weight[i] = share * share / (off[i] * off[i]);
    }
    if (equations) {
      const MatrixX j = derivatives(x, beyond);
      equations->matrix = j.transpose() * weight.asDiagonal() * j;
      equations->gradient = j.transpose() * weight.asDiagonal() * beyond;
    }
    return cost + believed(x, equations);
  }
};

}  // namespace

OneRope fit_one_rope(const chain::Chain& chain, std::span<const Outlined> seen, const OneRope& start,
                     const Leeway& leeway) {
  const int angles = chain.angles();
  OneRopeFit fit{chain, seen, start, leeway, {}, {}};
  std::vector<double> off;
  for (const Outlined& one : seen) {
    fit.places.push_back(places_of(*one.ribbon, chain.length));
    double radius = 0.0;
    for (const AxisPoint& p : one.ribbon->axis.points)
      radius += p.radius / static_cast<double>(one.ribbon->axis.points.size());
    off.insert(off.end(), fit.places.back().size(), std::max(kLeastOff, kOff * radius));
  }
  fit.off = Eigen::Map<const VectorX>(off.data(), static_cast<Eigen::Index>(off.size()));

  VectorX x(angles + 4);
  x << start.theta, start.shift, start.width;
  solve::Options options;
  options.steps = kMostSteps;
  options.decrease_tolerance = kSmallDecrease;
  const std::function<double(const VectorX&, solve::NormalEquations*)> evaluate = std::cref(fit);
  solve::least_squares(x, evaluate, options);
  return {x.head(angles), x.segment(angles, 3), x[angles + 3]};
}

}  // namespace chainsplat::masking
