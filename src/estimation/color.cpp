#include "src/estimation/color.h"

#include <algorithm>
#include <cmath>
#include <iterator>

#include "shaders/shared/color.h"
#include "src/estimation/setup.h"
#include "src/math/decompositions.h"

namespace chainsplat::estimation {

using math::MatrixX;
using math::Pose;
using math::VectorX;

namespace {

constexpr int kLeastPixels = 100;        // fewer pixels are not compared,
constexpr double kLeastContrast = 0.06;  // nor a rope with less contrast, the standard deviation of the drawn colors

constexpr double kLeastColorWeight = 100;  // pixels times channels; fewer carry too little information

// Returns the correlation of the drawn and the recorded colors about each channel's mean. Whatever the exposure, an
// object without marks where the twin has them is not the rope.
std::optional<double> likeness_of(const splat::ColorSums& sums) {
  if (sums.pixels < kLeastPixels) return {};
  if (sums.drawn_variance < 3.0 * sums.pixels * kLeastContrast * kLeastContrast) return {};
  return sums.covariance / std::sqrt(sums.drawn_variance * std::max(sums.seen_variance, 1e-12));
}

}  // namespace

ColorEquations color_equations(const chain::Chain& chain, const math::Pose& base, const VectorX& theta,
                               const splat::ColorSums& sums, const MatrixX& rope_twists) {
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
  MatrixX by_rope = MatrixX::Zero(n + 2, rope_twists.cols());
  MatrixX rope_twist_normal = MatrixX::Zero(8, 8);
  VectorX rope_pull = VectorX::Zero(8);
  MatrixX columns = MatrixX::Zero(8, n + 2);
  columns(6, n) = columns(7, n + 1) = 1.0;
  for (int j = 0; j < chain.links(); ++j) {
    const int count = chain.last_angle(j) + 1;
    columns.topLeftCorner(6, count) = axes.leftCols(count);
    full.noalias() += columns.transpose() * sums.normal[j] * columns;
    pull.noalias() += columns.transpose() * sums.right[j];
    by_rope.noalias() += columns.transpose() * (sums.normal[j].leftCols(6) * rope_twists);
    rope_twist_normal += sums.normal[j];
    rope_pull += sums.right[j];
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
  const MatrixX with_exposure = exposure * by_rope.bottomRows(2);
  out.coupling = by_rope.topRows(n) - coupling * with_exposure;
  out.shared = rope_twists.transpose() * rope_twist_normal.topLeftCorner(6, 6) * rope_twists -
               by_rope.bottomRows(2).transpose() * with_exposure;
  out.shared_right = rope_twists.transpose() * rope_pull.head(6) - with_exposure.transpose() * pull.tail<2>();
  return out;
}

void add_colors(const ColorEvidence& colors, MatrixX& by_setup, silhouette::SetupEquations& frame) {
  const Eigen::Index n = colors.right.size();
  if (n == 0) return;
  // the angles are what the belief before makes of the setup, and a difference from it, which is eliminated
  const MatrixX follows = by_setup.topRows(n);
  const MatrixX coupling = colors.coupling + colors.normal * follows;
  const MatrixX moved = colors.gain.topRows(n) * coupling;
  const MatrixX crossed = follows.transpose() * colors.coupling;
  frame.information += colors.shared + crossed + coupling.transpose() * follows - coupling.transpose() * moved;
  frame.gradient += colors.shared_right + follows.transpose() * colors.right - moved.transpose() * colors.right;
  by_setup -= colors.gain * coupling;
}

ColorEvidence look_at_colors(const State& state, std::span<const capture::View* const> views, Belief& belief,
                             Estimate& out) {
  ColorEvidence evidence;
  const chain::Chain& chain = state.given.model.chain;
  const int n = chain.angles();
  const Belief before = belief;
  const MatrixX by_angles = before.covariance.leftCols(n);
  const std::vector<MatrixX> twists = rope_twists(state, views.front()->time);
  std::vector<const capture::View*> shown;
  std::copy_if(views.begin(), views.end(), std::back_inserter(shown),
               [](const capture::View* view) { return view->width > 0 && view->height > 0; });
  // Gauss-Newton steps on the sum of the views' normal equations and the belief as prior
  for (int step = 0; step < state.options.color_steps; ++step) {
    const VectorX theta = belief.mean.head(n);
    const auto m = state.setup.mean.size();
    MatrixX information = MatrixX::Zero(n, n), coupling = MatrixX::Zero(n, m), shared = MatrixX::Zero(m, m);
    VectorX right = VectorX::Zero(n), shared_right = VectorX::Zero(m);
    double weight = 0.0, square = 0.0;
    std::vector<std::vector<Pose>> motions;
    for (const capture::View* const view : shown)
      motions.push_back(chain::material_motions(chain, theta, state.roll, base_at(state, view->time).pose));
    const std::vector<splat::ColorSums> sums = state.compare_colors(shown, state.cameras, motions);
    for (std::size_t v = 0; v < shown.size(); ++v) {
      const ColorEquations e =
          color_equations(chain, base_at(state, shown[v]->time).pose, theta, sums[v], twists[shown[v]->camera]);
      if (e.weight < kLeastColorWeight || !(e.square > 0.0)) continue;
      const double scale = state.options.color_share * e.weight / e.square;  // over this view's residual variance
      information += scale * e.normal;
      coupling += scale * e.coupling;
      shared += scale * e.shared;
      shared_right += scale * e.shared_right;
      right += scale * e.right;
      if (e.likeness) out.likeness = std::max(out.likeness.value_or(-1.0), *e.likeness);
      weight += e.weight;
      square += e.square;
      out.gain = e.gain;
      out.bias = e.bias;
    }
    if (weight == 0.0) return evidence;
    out.color_residual = std::sqrt(square / weight);
    right += information * (before.mean.head(n) - theta);  // linearized at theta, relative to the prior mean
    shared_right += coupling.transpose() * (before.mean.head(n) - theta);
    const MatrixX inverse = (MatrixX::Identity(n, n) + information * before.covariance.topLeftCorner(n, n)).inverse();
    belief.mean = before.mean - by_angles * (inverse * right);
    evidence = {information, coupling, shared, right, shared_right, by_angles * inverse};
    belief.covariance = before.covariance - by_angles * (inverse * information) * by_angles.transpose();
    symmetrize(belief.covariance);
    belief.covariance.diagonal().array() += kLeastVariance;
  }
  return evidence;
}

}  // namespace chainsplat::estimation
