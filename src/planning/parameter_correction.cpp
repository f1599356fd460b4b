#include "parameter_correction.h"

#include <cmath>
#include "src/math/decompositions.h"

namespace chainsplat::planning {
namespace {

constexpr double kPriorSpread = 0.3;  // of the logarithms: another day, another surface
constexpr double kDrift = 0.02;       // of the logarithms from one look to the next: what one factor means changes
constexpr double kPositionError = 0.002, kSpeedError = 0.04;  // m, m/s, of what the model cannot explain
constexpr double kLargestStep = 0.5, kLargest = 1.0;          // of a logarithm: no look may break the model

}  // namespace

ParameterCorrection start_correction(const dynamics::Model& model) {
  using dynamics::Quantity;
  ParameterCorrection out;
  out.nominal = model;
  out.nominal.parameters.integrator = dynamics::Integrator::rodas3;  // for derivatives
  out.model = out.nominal;
  for (const Quantity quantity : {Quantity::stiffness, Quantity::damping, Quantity::friction, Quantity::drag})
    if (dynamics::has_effect(model.chain, model.parameters, {quantity})) out.unknowns.push_back({quantity});
  const auto size = static_cast<Eigen::Index>(out.unknowns.size());
  out.change = VectorX::Zero(size);
  out.covariance = kPriorSpread * kPriorSpread * MatrixX::Identity(size, size);
  return out;
}

void correct(ParameterCorrection& correction, const dynamics::BaseFunction& base, const dynamics::InitialState& before,
             const dynamics::InitialState& after, const std::vector<double>& arclengths) {
  if (correction.unknowns.empty()) return;
  const chain::Chain& chain = correction.model.chain;
  const dynamics::Parameters& parameters = correction.model.parameters;
  const dynamics::BaseGrid grid = dynamics::sample_base(base, before.time, {after.time}, parameters.substeps);
  const std::vector<dynamics::Tangent> tangents = dynamics::tangents(chain, parameters, correction.unknowns);
  chain::States states;
  dynamics::Sensitivities slopes;
  dynamics::InitialState start = before;
  if (start.internal_state.size() == 0)
    start.internal_state = dynamics::internal_state_in_motion(correction.model, before.theta, before.thetadot);
  if (!dynamics::simulate(correction.model, grid, start, states, tangents, &slopes)) return;

  // angles count by how far they move the rope
  const math::Pose pose = base(after.time).pose;
  const auto motions = chain::link_motions(chain, after.theta, pose);
  const MatrixX axes = chain::world_axes(chain, after.theta, pose);
  std::vector<chain::MaterialPoint> points;
  for (double s : arclengths) points.push_back(chain::centerline_point(chain, s));
  const VectorX shares = VectorX::Constant(static_cast<Eigen::Index>(points.size()), 1.0 / points.size());
  const MatrixX metric = chain::displacement_metric(chain::point_jacobians(chain, axes, motions, points), shares);
  const MatrixX &x = slopes.theta.back(), &y = slopes.thetadot.back();
  const VectorX theta_error = metric * (after.theta - states.theta.back());
  const VectorX rate_error = metric * (after.thetadot - states.thetadot.back());
  constexpr double kPositionWeight = 1.0 / (kPositionError * kPositionError);
  constexpr double kSpeedWeight = 1.0 / (kSpeedError * kSpeedError);
  correction.covariance.diagonal().array() += kDrift * kDrift;
  const MatrixX information = kPositionWeight * x.transpose() * metric * x + kSpeedWeight * y.transpose() * metric * y;
  const VectorX pull = kPositionWeight * x.transpose() * theta_error + kSpeedWeight * y.transpose() * rate_error;
  if (!information.allFinite() || !pull.allFinite()) return;
  correction.covariance = (correction.covariance.inverse() + information).inverse();
  const VectorX step = correction.covariance * pull;
  correction.change += step.cwiseMax(-kLargestStep).cwiseMin(kLargestStep);
  correction.change = correction.change.cwiseMax(-kLargest).cwiseMin(kLargest);
  correction.model = dynamics::make_model(
      chain, dynamics::moved(chain, correction.nominal.parameters, correction.unknowns, correction.change));
}

}  // namespace chainsplat::planning
