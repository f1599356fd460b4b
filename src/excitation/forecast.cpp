#include <algorithm>
#include <cmath>

#include "chainsplat/excitation.h"
#include "src/math/decompositions.h"

namespace chainsplat::excitation {
namespace {

// As identification weighs them: two points per link, and neighbors in space and time err alike (mathematics.md 5).
constexpr double kShare = 1.0 / 9.0;
constexpr double kThetaSd = 0.02;  // rad, of the recognized initial angles
constexpr double kRateSd = 0.5;    // rad/s

}  // namespace

Forecast forecast(const dynamics::Model& model, std::span<const dynamics::Unknown> parameters,
                  const MatrixX& covariance, const dynamics::BaseFunction& base, const dynamics::InitialState& initial,
                  const std::vector<double>& times, double noise) {
  const chain::Chain& chain = model.chain;
  const int n = chain.angles();
  const auto size = static_cast<Eigen::Index>(parameters.size());
  CHAINSPLAT_CHECK(covariance.rows() == size && covariance.cols() == size, std::to_string(covariance.rows()));
  std::vector<dynamics::Unknown> unknowns(parameters.begin(), parameters.end());
  for (const dynamics::Unknown& state : dynamics::initial_state_unknowns(chain)) unknowns.push_back(state);
  const std::vector<dynamics::Tangent> tangents = dynamics::tangents(chain, model.parameters, unknowns);
  Forecast out;
  dynamics::Sensitivities slopes;
  const dynamics::BaseGrid grid = dynamics::sample_base(base, initial.time, times, model.parameters.substeps);
  if (!dynamics::simulate(model, grid, initial, out.states, tangents, &slopes)) return out;

  const std::vector<chain::MaterialPoint> points = chain::shape_points(chain, true);
  MatrixX sum = MatrixX::Zero(size + 2 * n, size + 2 * n);
  for (int k = 0; k < n; ++k) {
    sum(size + k, size + k) = 1.0 / (kThetaSd * kThetaSd);
    sum(size + n + k, size + n + k) = 1.0 / (kRateSd * kRateSd);
  }
  double spread = 0.0;  // m^2
  for (std::size_t k = 0; k < out.states.theta.size(); ++k) {
    const auto poses = chain::link_motions(chain, out.states.theta[k], {});
    const MatrixX axes = chain::world_axes(chain, out.states.theta[k], {});
    const MatrixX by_angle = chain::displacement_metric(chain::point_jacobians(chain, axes, poses, points));
    const MatrixX told = slopes.theta[k].transpose() * by_angle * slopes.theta[k];
    sum += kShare / (noise * noise) * told;
    spread = std::max(
        spread, told.topLeftCorner(size, size).cwiseProduct(covariance).sum() / static_cast<double>(points.size()));
  }
  const MatrixX cross = sum.topRightCorner(size, 2 * n);
  out.information = sum.topLeftCorner(size, size) -
                    cross * MatrixX(sum.bottomRightCorner(2 * n, 2 * n)).ldlt().solve(MatrixX(cross.transpose()));
  out.spread = std::sqrt(spread);
  return out;
}

}  // namespace chainsplat::excitation
