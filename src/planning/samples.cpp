// Parameter sets drawn from what identification knows (mathematics.md 8, robustness).
#include "chainsplat/dynamics/parametrization.h"
#include "chainsplat/planning.h"
#include "src/math/decompositions.h"

namespace chainsplat::planning {

std::vector<dynamics::Parameters> draw_parameters(const chain::Chain& chain, const dynamics::Parameters& parameters,
                                                  const dynamics::Estimates& estimates, int count, std::uint64_t seed) {
  const auto size = static_cast<Eigen::Index>(estimates.names.size());
  if (size == 0 || estimates.covariance.rows() != size || estimates.covariance.cols() != size ||
      !estimates.covariance.allFinite())
    throw InputError("`samples`", "the twin knows no covariance of its parameters",
                     "identify it again or leave `samples` out");
  // a covariance that was written and read may be off positive by rounding
  const Eigen::SelfAdjointEigenSolver<MatrixX> eigen(
      MatrixX(0.5 * (estimates.covariance + estimates.covariance.transpose())));
  const MatrixX root = eigen.eigenvectors() * eigen.eigenvalues().cwiseMax(0.0).cwiseSqrt().asDiagonal();
  const std::vector<dynamics::Unknown> unknowns = dynamics::unknowns_of(chain, estimates);
  core::Random random(seed);
  std::vector<dynamics::Parameters> out;
  for (int sample = 0; sample < count; ++sample) {
    VectorX z(size);
    for (Eigen::Index i = 0; i < size; ++i) z[i] = random.normal();
    out.push_back(dynamics::moved(chain, parameters, unknowns, root * z));
  }
  return out;
}

}  // namespace chainsplat::planning
