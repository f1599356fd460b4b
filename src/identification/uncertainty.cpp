#include "uncertainty.h"

#include <algorithm>
#include <cmath>

#include "src/math/decompositions.h"

namespace chainsplat::identification {

namespace {

constexpr int kLag = 10;  // frames over which residuals are taken to be correlated (mathematics.md 5)
constexpr double kUnknown = std::numeric_limits<double>::quiet_NaN();

// J^T G J, G the covariance of the weighted residuals: frames up to kLag apart are correlated (mathematics.md 5), every
// residual alike. The autocovariance is that of all residuals together: of one unknown's score alone, which a few
// frames may decide, it would be mostly chance.
MatrixX covariance_of_scores(const Part& part, const chain::States& states, const dynamics::Sensitivities& slopes,
                             const std::vector<MatrixX>& values, double limit) {
  const std::size_t frames = values.size();
  const std::size_t window = std::min<std::size_t>(kLag + 1, frames);
  std::vector<double> sums(window, 0.0);
  double seen = 0.0;
  std::vector<Rows> last(window);  // frame k at k % window
  for (std::size_t k = 0; k < frames; ++k) {
    VectorX& now = last[k % window].right;
    weighted_rows(part, states, nullptr, values, limit, k, last[k % window]);
    seen += static_cast<double>((now.array() != 0.0).count());  // no weight where a marker is not seen
    for (std::size_t lag = 0; lag < window && lag <= k; ++lag) sums[lag] += now.dot(last[(k - lag) % window].right);
  }
  // one product per frame: with those before it together, each with its weight, Bartlett's
  const Eigen::Index size = part.unknowns.size();
  MatrixX half = MatrixX::Zero(size, size), before;
  for (std::size_t k = 0; k < frames; ++k) {
    const Rows& now = last[k % window];
    weighted_rows(part, states, &slopes, values, limit, k, last[k % window]);
    before = 0.5 * sums[0] * now.slopes;
    for (std::size_t lag = 1; lag < window && lag <= k; ++lag)
      before += (1.0 - lag / (kLag + 1.0)) * sums[lag] * last[(k - lag) % window].slopes;
    half.noalias() += now.slopes.transpose() * before;
  }
  return (half + half.transpose()) / std::max(seen, 1.0);
}

// Adds a matrix about the shared unknowns and those of recording `index` to one about all unknowns.
void add_part(const Problem& problem, std::size_t index, const MatrixX& part, MatrixX& all) {
  const Eigen::Index shared = problem.shared, own = problem.own();
  const Eigen::Index first = shared + static_cast<Eigen::Index>(index) * own;
  all.topLeftCorner(shared, shared) += part.topLeftCorner(shared, shared);
  all.block(0, first, shared, own) += part.topRightCorner(shared, own);
  all.block(first, 0, own, shared) += part.bottomLeftCorner(own, shared);
  all.block(first, first, own, own) += part.bottomRightCorner(own, own);
}

}  // namespace

MatrixX covariance_of(const Problem& problem, const MatrixX& hessian, const Rollouts& rollouts, double limit) {
  const MatrixX& prior = problem.precision;
  MatrixX meat = prior;
  for (std::size_t i = 0; i < problem.parts.size(); ++i)
    add_part(problem, i,
             covariance_of_scores(problem.parts[i], rollouts.states[i], rollouts.slopes[i], rollouts.values[i], limit),
             meat);
  // In coordinates in which the weights alone promise the covariance 1, the sandwich is `scores`. It is itself an
  // estimate, of few independent frames: along no combination of parameters less than what the weights promise.
  const Eigen::LLT<MatrixX> factor(MatrixX(hessian + prior));
  if (factor.info() == Eigen::Success) {
    factor.matrixL().solveInPlace(meat);
    MatrixX scores = meat.transpose();
    factor.matrixL().solveInPlace(scores);
    const Eigen::SelfAdjointEigenSolver<MatrixX> eigen(MatrixX(0.5 * (scores + scores.transpose())));
    MatrixX root = eigen.eigenvectors() * eigen.eigenvalues().cwiseMax(1.0).cwiseSqrt().asDiagonal();
    factor.matrixU().solveInPlace(root);
    const MatrixX covariance = root * root.transpose();
    if (math::is_covariance(covariance)) return covariance;
  }
  core::warn("identify: the data leave the parameters' covariance without meaning; it is written as not known");
  return MatrixX::Constant(prior.rows(), prior.cols(), kUnknown);
}

std::vector<dynamics::Estimates::Weak> weak_directions(const Problem& problem, solve::ArrowEquations data) {
  const int shared = problem.shared, own = problem.own();
  for (std::size_t i = 0; i < data.local.size(); ++i) {
    const Eigen::Index first = shared + static_cast<Eigen::Index>(i) * own;
    data.local[i].matrix += problem.precision.block(first, first, own, own);
  }
  const MatrixX information = solve::reduced(data).matrix;
  const MatrixX prior = problem.precision.topLeftCorner(shared, shared);
  const VectorX deviation = prior.ldlt().solve(MatrixX::Identity(shared, shared)).diagonal().cwiseMax(0.0).cwiseSqrt();
  if (!information.allFinite()) return {};  // its covariance is said not to be known
  const Eigen::SelfAdjointEigenSolver<MatrixX> eigen(
      MatrixX(deviation.asDiagonal() * information * deviation.asDiagonal()));
  constexpr double kLarge = 0.3;  // a component that is named: a tenth of the vector's square
  std::vector<dynamics::Estimates::Weak> weak;
  for (int i = 0; i < shared && eigen.eigenvalues()[i] < 1.0; ++i) {
    dynamics::Estimates::Weak direction{std::sqrt(std::max(0.0, eigen.eigenvalues()[i])), {}};
    VectorX vector = eigen.eigenvectors().col(i);
    Eigen::Index largest = 0;
    vector.cwiseAbs().maxCoeff(&largest);
    if (vector[largest] < 0.0) vector = -vector;
    for (int k = 0; k < shared; ++k)
      if (k == largest || std::abs(vector[k]) >= kLarge)
        direction.parts.emplace_back(dynamics::name_of(problem.parts[0].unknowns.list[k]), vector[k]);
    std::stable_sort(direction.parts.begin(), direction.parts.end(),
                     [](const auto& a, const auto& b) { return std::abs(a.second) > std::abs(b.second); });
    weak.push_back(std::move(direction));
  }
  return weak;
}

}  // namespace chainsplat::identification
