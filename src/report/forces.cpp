// forces.cpp - how large a force is, and how sure that is.
#include <algorithm>
#include <cmath>

#include "chainsplat/report.h"
#include "src/math/decompositions.h"

namespace chainsplat::report {

using math::Matrix3;
using math::Vector3;

ForceSize size_of(const force::Estimate& e) {
  ForceSize out;
  out.value = e.force.norm();
  double variance = 0.0;
  if (out.value > 0.0) {
    const Vector3 along = e.force / out.value;
    variance = along.dot(e.covariance * along);
  } else {
    variance = Eigen::SelfAdjointEigenSolver<Matrix3>(e.covariance, Eigen::EigenvaluesOnly).eigenvalues().maxCoeff();
  }
  out.error = std::sqrt(std::max(0.0, variance));
  // nearest to zero and farthest from it in the box that friction at rest leaves
  const Vector3 nearest = e.low.cwiseMax(Vector3::Zero()) + e.high.cwiseMin(Vector3::Zero());
  const Vector3 farthest = e.low.cwiseAbs().cwiseMax(e.high.cwiseAbs());
  out.least = std::max(0.0, std::min(out.value, nearest.norm()) - 2.0 * out.error);
  out.most = std::max(out.value, farthest.norm()) + 2.0 * out.error;
  return out;
}

const force::Estimate* largest(const std::vector<force::Estimate>& forces) {
  const force::Estimate* out = nullptr;
  for (const force::Estimate& each : forces)
    if (each.touching && (!out || each.force.norm() > out->force.norm())) out = &each;
  return out;
}

}  // namespace chainsplat::report
