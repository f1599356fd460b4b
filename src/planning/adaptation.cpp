#include "adaptation.h"

#include <algorithm>
#include <cmath>

namespace chainsplat::planning {
namespace {

constexpr double kPriorSpread = 0.3;  // of the logarithms: another day, another surface
constexpr double kDrift = 0.02;       // of the logarithms from one look to the next: what one factor means changes
constexpr double kPositionError = 0.002, kSpeedError = 0.04;  // m, m/s, of what the model cannot explain
constexpr double kLargestStep = 0.5, kLargest = 1.0;          // of a logarithm: no look may break the model

void scale(std::vector<double>& values, const std::vector<double>& group, double factor) {
  if (group.empty()) return;
  for (double& value : values) value *= factor;
}

// The nominal parameters with the factors.
dynamics::Parameters scaled(const Adaptation& adaptation) {
  dynamics::Parameters p = adaptation.nominal.parameters;
  for (std::size_t g = 0; g < adaptation.groups.size(); ++g) {
    const dynamics::Tangent& group = adaptation.groups[g];
    const double factor = std::exp(adaptation.factors[static_cast<Eigen::Index>(g)]);
    scale(p.stiffness, group.stiffness, factor);
    scale(p.damping, group.damping, factor);
    scale(p.viscous_friction, group.viscous_friction, factor);
    scale(p.coulomb_friction, group.coulomb_friction, factor);
    scale(p.air_linear, group.air_linear, factor);
    scale(p.air_quadratic, group.air_quadratic, factor);
  }
  return p;
}

}  // namespace

Adaptation start_adaptation(const dynamics::Model& model) {
  Adaptation out;
  out.nominal = out.model = model;
  const dynamics::Parameters& p = model.parameters;
  const auto any = [](const std::vector<double>& values) {
    return std::any_of(values.begin(), values.end(), [](double v) { return v > 0.0; });
  };
  if (any(p.stiffness)) out.groups.emplace_back().stiffness = p.stiffness;
  if (any(p.damping)) out.groups.emplace_back().damping = p.damping;
  if (any(p.viscous_friction) || any(p.coulomb_friction)) {
    out.groups.emplace_back().viscous_friction = p.viscous_friction;
    out.groups.back().coulomb_friction = p.coulomb_friction;
  }
  if (any(p.air_linear) || any(p.air_quadratic)) {
    out.groups.emplace_back().air_linear = p.air_linear;
    out.groups.back().air_quadratic = p.air_quadratic;
  }
  const auto size = static_cast<Eigen::Index>(out.groups.size());
  out.factors = VectorX::Zero(size);
  out.covariance = kPriorSpread * kPriorSpread * MatrixX::Identity(size, size);
  return out;
}

void adapt(Adaptation& adaptation, const dynamics::BaseFunction& base, const dynamics::InitialState& before,
           const dynamics::InitialState& after, const std::vector<double>& arclengths) {
  const auto size = static_cast<Eigen::Index>(adaptation.groups.size());
  if (size == 0) return;
  const chain::Chain& chain = adaptation.model.chain;
  const double now[] = {before.time, after.time};
  const dynamics::BaseGrid grid = dynamics::sample_base(base, now[0], {now[1]}, adaptation.model.parameters.substeps);
  // the derivative by a logarithm is the group as it stands now
  std::vector<dynamics::Tangent> groups = adaptation.groups;
  for (Eigen::Index g = 0; g < size; ++g)
    for (auto* values : {&groups[g].stiffness, &groups[g].damping, &groups[g].viscous_friction,
                         &groups[g].coulomb_friction, &groups[g].air_linear, &groups[g].air_quadratic})
      scale(*values, *values, std::exp(adaptation.factors[g]));
  chain::States states;
  dynamics::Sensitivities slopes;
  if (!dynamics::simulate(adaptation.model, grid, before.theta, before.thetadot, states, groups, &slopes)) return;

  // angles count by how far they move the rope
  const math::Pose pose = base(after.time).pose;
  const auto motions = chain::link_motions(chain, after.theta, pose);
  const MatrixX axes = chain::world_axes(chain, after.theta, pose);
  MatrixX metric = MatrixX::Zero(chain.angles(), chain.angles());
  for (double s : arclengths) {
    const int link = chain::link_at(chain, s);
    const MatrixX jacobian = chain::point_jacobian(chain, axes, link, motions[link] * (s * chain.direction));
    metric += jacobian.transpose() * jacobian / static_cast<double>(arclengths.size());
  }
  const MatrixX &x = slopes.theta.back(), &y = slopes.thetadot.back();
  const VectorX theta_error = metric * (after.theta - states.theta.back());
  const VectorX rate_error = metric * (after.thetadot - states.thetadot.back());
  constexpr double kPositionWeight = 1.0 / (kPositionError * kPositionError);
  constexpr double kSpeedWeight = 1.0 / (kSpeedError * kSpeedError);
  adaptation.covariance.diagonal().array() += kDrift * kDrift;
  const MatrixX information = kPositionWeight * x.transpose() * metric * x + kSpeedWeight * y.transpose() * metric * y;
  const VectorX pull = kPositionWeight * x.transpose() * theta_error + kSpeedWeight * y.transpose() * rate_error;
  if (!information.allFinite() || !pull.allFinite()) return;
  adaptation.covariance = (adaptation.covariance.inverse() + information).inverse();
  const VectorX step = adaptation.covariance * pull;
  adaptation.factors += step.cwiseMax(-kLargestStep).cwiseMin(kLargestStep);
  adaptation.factors = adaptation.factors.cwiseMax(-kLargest).cwiseMin(kLargest);
  adaptation.model = dynamics::make_model(chain, scaled(adaptation));
}

}  // namespace chainsplat::planning
