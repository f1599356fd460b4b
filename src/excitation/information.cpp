#include <cmath>

#include "chainsplat/excitation.h"

namespace chainsplat::excitation {
namespace {

// As identification weighs them: two points per link, and neighbors in space and time err alike (mathematics.md 5).
constexpr double kShare = 1.0 / 9.0;
constexpr double kThetaSd = 0.02;  // rad, of the recognized initial angles
constexpr double kRateSd = 0.5;    // rad/s

}  // namespace

MatrixX information(const dynamics::Model& model, std::span<const dynamics::Unknown> parameters,
                    const dynamics::BaseFunction& base, const dynamics::InitialState& initial,
                    const std::vector<double>& times, double noise, chain::States* states) {
  const chain::Chain& chain = model.chain;
  const int n = chain.angles();
  const auto size = static_cast<Eigen::Index>(parameters.size());
  std::vector<dynamics::Unknown> unknowns(parameters.begin(), parameters.end());
  for (const dynamics::Unknown& state : dynamics::initial_state_unknowns(chain)) unknowns.push_back(state);
  const std::vector<dynamics::Tangent> tangents = dynamics::tangents(chain, model.parameters, unknowns);
  chain::States rolled;
  chain::States& motion = states ? *states : rolled;
  dynamics::Sensitivities slopes;
  const dynamics::BaseGrid grid = dynamics::sample_base(base, initial.time, times, model.parameters.substeps);
  if (!dynamics::simulate(model, grid, initial, motion, tangents, &slopes)) return {};

  const std::vector<chain::MaterialPoint> points = chain::shape_points(chain, true);
  MatrixX sum = MatrixX::Zero(size + 2 * n, size + 2 * n);
  for (int k = 0; k < n; ++k) {
    sum(size + k, size + k) = 1.0 / (kThetaSd * kThetaSd);
    sum(size + n + k, size + n + k) = 1.0 / (kRateSd * kRateSd);
  }
  for (std::size_t k = 0; k < motion.theta.size(); ++k) {
    const auto poses = chain::link_motions(chain, motion.theta[k], {});
    const MatrixX axes = chain::world_axes(chain, motion.theta[k], {});
    const MatrixX by_angle = chain::displacement_metric(chain::point_jacobians(chain, axes, poses, points));
    sum += kShare / (noise * noise) * slopes.theta[k].transpose() * by_angle * slopes.theta[k];
  }
  const MatrixX cross = sum.topRightCorner(size, 2 * n);
  return sum.topLeftCorner(size, size) - cross * sum.bottomRightCorner(2 * n, 2 * n).ldlt().solve(cross.transpose());
}

}  // namespace chainsplat::excitation
