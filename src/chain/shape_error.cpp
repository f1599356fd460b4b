#include "chainsplat/chain.h"

#include "chainsplat/core.h"
#include "src/math/decompositions.h"

namespace chainsplat::chain {

namespace {

// Per coordinate of every joint's position, as a share of the diameter: what a tube of constant width leaves.
constexpr double kLinkDeviation = 0.02;
// A straight link stands for an arc. Where the arc turns by an angle, the two are up to length * angle / 8 apart, half
// of it on either side of a link through the arc's middle.
constexpr double kArc = 1.0 / 16.0;
constexpr double kUnseenAngle = 0.5;  // rad, deviation of angles that move no joint (twist)

}  // namespace

std::vector<double> shape_variances(const Chain& chain, const VectorX& theta) {
  std::vector<double> variances(chain.links() - 1, 0.0);
  for (int link = 1; link < chain.links(); ++link) {
    double bend2 = 0.0;  // rad^2, mean of the squared bends at the link's two ends
    for (int k = 0; k < chain.angles(); ++k)
      if (chain.child_link[k] == link || chain.child_link[k] == link + 1) bend2 += 0.5 * theta[k] * theta[k];
    const double arc = kArc * (chain.link_end(link) - chain.link_start(link));
    const double straight = kLinkDeviation * chain.diameter;
    variances[link - 1] = straight * straight + arc * arc * bend2;
  }
  return variances;
}

MatrixX shape_covariance(const Chain& chain, const std::vector<double>& variances, const VectorX& theta) {
  const int n = chain.angles();
  VectorX weights(variances.size());
  for (std::size_t i = 0; i < variances.size(); ++i) weights[i] = 1.0 / variances[i];
  MatrixX information = displacement_metric(link_end_jacobians(chain, theta, Pose{}), weights);
  information.diagonal().array() += 1.0 / (kUnseenAngle * kUnseenAngle);
  const Eigen::LLT<MatrixX> factor(information);
  CHAINSPLAT_CHECK(math::is_positive(factor), "angles that are not finite");
  return factor.solve(MatrixX::Identity(n, n));
}

MatrixX bend_covariance(const Chain& chain, double deviation, const VectorX& theta) {
  const std::vector<MatrixX> jacobians = link_end_jacobians(chain, theta, Pose{});
  const double square = displacement_metric(jacobians).trace() / static_cast<double>(jacobians.size());  // m^2/rad^2
  return MatrixX::Identity(chain.angles(), chain.angles()) * (deviation * deviation / square);
}

}  // namespace chainsplat::chain
