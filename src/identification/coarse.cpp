#include "coarse.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace chainsplat::identification {

using dynamics::Quantity;
using math::Vector3;

namespace {

constexpr int kMany = 24;  // joints, from where on a fit of all of them takes several times as long as one of 16
constexpr int kFew = 16;   // joints, the most that recognition chooses by itself; places along the rope
constexpr double kHardlyKnown = 0.01;  // of the length: deviation of a point that is left out

// Values of one kind along the rope, which vary linearly between their arclengths and not beyond.
double interpolated(const std::vector<std::pair<double, double>>& values, double arclength) {
  const auto after = std::lower_bound(values.begin(), values.end(), std::pair(arclength, -HUGE_VAL));
  if (after == values.begin()) return after->second;
  if (after == values.end()) return values.back().second;
  const auto& [from, a] = *(after - 1);
  const auto& [to, b] = *after;
  return a + (b - a) * (arclength - from) / (to - from);
}

// Where an unknown of several lies: a joint's start, a link's middle. `axis`: which of its joint's.
struct Place {
  double arclength = 0.0;
  int axis = 0;
  double length = 1.0;  // of rope that it stands for, in mean joints, where its value is a curvature times that
};
std::optional<Place> place_of(const chain::Chain& chain, const dynamics::Unknown& unknown) {
  switch (unknown.quantity) {
    case Quantity::joint_stiffness:
    case Quantity::joint_damping:
      return Place{chain.link_start(unknown.index + 1)};
    case Quantity::link_mass:
    case Quantity::coulomb_friction:
      return Place{0.5 * (chain.link_start(unknown.index + 1) + chain.link_end(unknown.index + 1))};
    case Quantity::rest_angle:
    case Quantity::theta:
    case Quantity::thetadot:
    case Quantity::roll_lever:
    case Quantity::friction_state: {
      const int joint = chain.child_link[unknown.index];
      const auto first = std::find(chain.child_link.begin(), chain.child_link.end(), joint);
      const int axis = unknown.index - static_cast<int>(first - chain.child_link.begin());
      const bool angle = unknown.quantity != Quantity::roll_lever && unknown.quantity != Quantity::friction_state;
      return Place{chain.link_start(joint), axis,
                   angle ? chain::bent_length(chain, joint) / mean_bent_length(chain) : 1.0};
    }
    default:
      return {};
  }
}

// What stands for a mean joint stands for more or less rope: exp(p) times the length is the rope's own, or exp(p) over
// it.
double per_joint(Quantity quantity) {
  if (quantity == Quantity::stiffness || quantity == Quantity::damping) return 1.0;
  return quantity == Quantity::bending_friction_angle ? -1.0 : 0.0;
}

}  // namespace

std::optional<chain::Chain> with_few_joints(const chain::Chain& chain, const Options& options) {
  const int joints = chain.links() - 1;
  if (joints <= kMany || options.paper || chain::has_twist(chain)) return {};
  const bool spatial = chain.angles() == 2 * joints;
  if (!spatial && chain.angles() != joints) return {};
  return chain::make_chain(chain.length, chain.diameter, chain.direction, chain.bending_axis, kFew,
                           spatial ? chain::Bending::spatial : chain::Bending::planar, false, chain.link_start(1));
}

Markers centerline_markers(const chain::Chain& chain, const trajectory::Trajectory& base,
                           const chain::States& recognized, const chain::Chain& few, double deviation) {
  Markers markers;
  markers.deviation = deviation;
  for (const chain::MaterialPoint& point : chain::shape_points(few, true))
    markers.arclengths.push_back(point.home.dot(few.direction));
  const auto count = static_cast<Eigen::Index>(markers.arclengths.size());
  std::vector<chain::MaterialPoint> points;
  for (const double s : markers.arclengths) points.push_back(chain::centerline_point(chain, s));
  for (std::size_t k = 0; k < recognized.time.size(); ++k) {
    const auto motions = chain::link_motions(chain, recognized.theta[k], base.pose(recognized.time[k]));
    MatrixX world = chain::centerline(chain, motions, markers.arclengths);
    if (!recognized.covariance.empty()) {
      const MatrixX axes = chain::world_axes(chain, recognized.theta[k], base.pose(recognized.time[k]));
      const std::vector<MatrixX> jacobians = chain::point_jacobians(chain, axes, motions, points);
      for (Eigen::Index i = 0; i < count; ++i)
        if (const double variance = (jacobians[i] * recognized.covariance[k]).cwiseProduct(jacobians[i]).sum();
            !(variance < std::pow(kHardlyKnown * chain.length, 2)))
          world.col(i).setConstant(std::numeric_limits<double>::quiet_NaN());
    }
    if (world.array().isNaN().all()) continue;
    markers.time.push_back(recognized.time[k]);
    markers.world.push_back(std::move(world));
  }
  return markers;
}

VectorX start_from(const chain::Chain& few, const Unknowns& few_unknowns, const VectorX& found,
                   const chain::Chain& chain, const Unknowns& unknowns) {
  const double cut = std::log(mean_bent_length(few) / mean_bent_length(chain));
  VectorX start = unknowns.mean;
  for (int i = 0; i < unknowns.size(); ++i) {
    const dynamics::Unknown& unknown = unknowns.list[i];
    if (!dynamics::is_parameter(unknown.quantity)) continue;
    const std::optional<Place> at = place_of(chain, unknown);
    std::vector<std::pair<double, double>> values;
    for (int k = 0; k < few_unknowns.size(); ++k) {
      const dynamics::Unknown& other = few_unknowns.list[k];
      if (other.quantity != unknown.quantity) continue;
      const std::optional<Place> there = place_of(few, other);
      if (!at)
        start[i] = found[k] + per_joint(unknown.quantity) * cut;
      else if (there && there->axis == at->axis)
        values.emplace_back(there->arclength, found[k] / there->length);
    }
    // a mean joint of the few bends more than one of the many
    const double bend = unknown.quantity == Quantity::rest_angle ? std::exp(-cut) : 1.0;
    if (!values.empty()) start[i] = bend * at->length * interpolated(values, at->arclength);
  }
  return start;
}

MatrixX smooth_modes(const chain::Chain& chain, const Unknowns& unknowns) {
  MatrixX modes = MatrixX::Zero(unknowns.size(), 0);
  const auto append = [&] {
    modes.conservativeResizeLike(MatrixX::Zero(modes.rows(), modes.cols() + 1));
    return modes.cols() - 1;
  };
  for (int i = 0; i < unknowns.size(); ++i) {
    const std::optional<Place> at = place_of(chain, unknowns.list[i]);
    if (!at) {
      modes(i, append()) = 1.0;
      continue;
    }
    // all of this kind and axis, at the first of them
    std::vector<std::pair<int, Place>> all;
    bool first = true;
    for (int k = 0; k < unknowns.size(); ++k) {
      if (unknowns.list[k].quantity != unknowns.list[i].quantity) continue;
      const Place place = *place_of(chain, unknowns.list[k]);
      if (place.axis != at->axis) continue;
      first &= k >= i;
      all.emplace_back(k, place);
    }
    if (!first) continue;
    const int places = std::min(kFew, static_cast<int>(all.size()));
    const double from = all.front().second.arclength, to = all.back().second.arclength;
    for (int node = 0; node < places; ++node) {
      const Eigen::Index mode = append();
      for (const auto& [k, place] : all) {
        const double x = places > 1 ? (place.arclength - from) / (to - from) * (places - 1) : 0.0;
        modes(k, mode) = place.length * std::max(0.0, 1.0 - std::abs(x - node));
      }
    }
  }
  return modes;
}

std::vector<dynamics::Tangent> along(std::span<const dynamics::Tangent> tangents, const MatrixX& modes) {
  using dynamics::Tangent;
  const auto add_all = [](double weight, const auto& from, auto& to) {
    if (from.size() == 0) return;
    if (to.size() == 0) to = from, std::fill(to.begin(), to.end(), 0.0);
    for (decltype(from.size()) k = 0; k < from.size(); ++k) to[k] += weight * from[k];
  };
  std::vector<Tangent> out(static_cast<std::size_t>(modes.cols()));
  for (Eigen::Index mode = 0; mode < modes.cols(); ++mode)
    for (Eigen::Index i = 0; i < modes.rows(); ++i) {
      const double weight = modes(i, mode);
      if (weight == 0.0) continue;
      const Tangent& from = tangents[static_cast<std::size_t>(i)];
      Tangent& to = out[static_cast<std::size_t>(mode)];
      for (auto values :
           {&Tangent::link_mass, &Tangent::viscous_friction, &Tangent::coulomb_friction, &Tangent::air_linear,
            &Tangent::air_quadratic, &Tangent::stiffness, &Tangent::rest_angle, &Tangent::damping, &Tangent::roll_lever,
            &Tangent::bending_friction, &Tangent::bending_friction_angle, &Tangent::torsional_stiffness})
        add_all(weight, from.*values, to.*values);
      for (auto values : {&Tangent::theta, &Tangent::thetadot, &Tangent::internal_state})
        add_all(weight, from.*values, to.*values);
      to.tip_mass += weight * from.tip_mass;
      to.tip_length += weight * from.tip_length;
    }
  return out;
}

}  // namespace chainsplat::identification
