#include "src/estimation/color.h"

#include <algorithm>
#include <cmath>

#include "shaders/shared/color.h"

namespace chainsplat::estimation {

using math::MatrixX;
using math::VectorX;

namespace {

constexpr int kLeastPixels = 100;        // fewer pixels are not compared,
constexpr double kLeastContrast = 0.06;  // nor a rope with less contrast, the standard deviation of the drawn colors

// Returns the correlation of the drawn and the recorded colors about each channel's mean. Whatever the exposure, an
// object without marks where the twin has them is not the rope.
std::optional<double> likeness_of(const splat::ColorSums& sums) {
  if (sums.pixels < kLeastPixels) return {};
  if (sums.drawn_variance < 3.0 * sums.pixels * kLeastContrast * kLeastContrast) return {};
  return sums.covariance / std::sqrt(sums.drawn_variance * std::max(sums.seen_variance, 1e-12));
}

}  // namespace

ColorEquations color_equations(const chain::Chain& chain, const math::Pose& base, const VectorX& theta,
                               const splat::ColorSums& sums) {
  const int n = chain.angles();
  ColorEquations out;
  out.likeness = likeness_of(sums);
  out.weight = sums.weight;
  out.square = sums.square;
  out.gain = sums.gain;
  out.bias = sums.bias;
  // normal equations in the angles (mathematics.md 2.3) and, as the last two, gain and bias with their priors
  const MatrixX axes = chain::world_axes(chain, theta, base);
  MatrixX full = MatrixX::Zero(n + 2, n + 2);
  VectorX pull = VectorX::Zero(n + 2);
  MatrixX columns = MatrixX::Zero(8, n + 2);
  columns(6, n) = columns(7, n + 1) = 1.0;
  for (int j = 0; j < chain.links(); ++j) {
    const int count = chain.last_angle(j) + 1;
    columns.topLeftCorner(6, count) = axes.leftCols(count);
    full.noalias() += columns.transpose() * sums.normal[j] * columns;
    pull.noalias() += columns.transpose() * sums.right[j];
  }
  full(n, n) += shared::kColorGainWeight;
  full(n + 1, n + 1) += shared::kColorBiasWeight;
  pull[n] += shared::kColorGainWeight * (out.gain - 1.0);
  pull[n + 1] += shared::kColorBiasWeight * out.bias;
  // eliminate the exposure by the Schur complement
  const Eigen::Matrix2d exposure = full.bottomRightCorner<2, 2>().inverse();
  const MatrixX coupling = full.topRightCorner(n, 2);
  out.normal = full.topLeftCorner(n, n) - coupling * exposure * coupling.transpose();
  out.right = pull.head(n) - coupling * (exposure * pull.tail<2>());
  return out;
}

}  // namespace chainsplat::estimation
