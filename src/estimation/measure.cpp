#include "src/estimation/measure.h"

#include <algorithm>
#include <cmath>
#include <numeric>
#include "src/estimation/predict.h"
#include "src/math/decompositions.h"

namespace chainsplat::estimation {

using math::MatrixX;
using math::VectorX;

namespace {

constexpr double kNoSmoothness = 1e-9;  // 1/rad^2, because the filter's prior replaces the silhouette fit's own

}  // namespace

Measured measure(const State& state, const Belief& predicted, std::span<const capture::View* const> views, bool warm) {
  const int n = state.given.model.chain.angles();
  const double share = state.options.new_share;
  // the part of the state that is fitted: the angles and the shifts of these views' masks
  std::vector<int> fitted(n);
  std::iota(fitted.begin(), fitted.end(), 0);
  for (std::size_t v = 0; predicted.mean.size() > 3 * n && v < views.size(); ++v)
    for (const int axis : {0, 1}) fitted.push_back(3 * n + 2 * views[v]->camera + axis);
  const VectorX expected = predicted.mean(fitted);
  const MatrixX prior = predicted.covariance(fitted, fitted);
  const Eigen::LLT<MatrixX> factor(prior);
  if (!math::is_positive(factor))
    throw WorkError("estimate", "the predicted covariance at " + core::exact(predicted.time) + " s is not positive",
                    "check the twin's parameters and the base motion about that time");
  const MatrixX information = factor.solve(MatrixX::Identity(prior.rows(), prior.rows()));
  silhouette::Options options = state.options.silhouette;
  options.joint_smoothness = kNoSmoothness;
  options.prior.mean = expected;
  options.prior.information = information / share;
  options.edge_offset = state.edge_offset;
  options.edge_offset_deviation = std::sqrt(state.edge_offset_variance);
  const double time = views.front()->time;

  Measured out;
  // fit, and compare the innovation with its expectation
  out.fit = silhouette::fit_frame(state.given.model.chain, base_at(state, time).pose, views, state.cameras,
                                  predicted.mean.head(n), warm, options);
  MatrixX posterior = out.fit.covariance / share;
  symmetrize(posterior);
  VectorX found = expected;
  found.head(n) = out.fit.theta;
  found.tail(out.fit.mask_shift.size()) = out.fit.mask_shift;
  const VectorX change = found - expected;
  const double freedom = static_cast<double>(change.size()) - (information * posterior).trace();
  out.surprise = change.dot(information * change) / std::max(1.0, freedom);

  // rates and rest angles follow by their correlation with the fitted part
  const MatrixX gain = predicted.covariance(Eigen::all, fitted) * information;
  out.belief.time = time;
  out.belief.mean = predicted.mean + gain * change;
  out.belief.mean(fitted) = found;
  out.belief.covariance = predicted.covariance - gain * (prior - posterior) * gain.transpose();
  out.belief.by_setup = predicted.by_setup;
  out.gain = gain.leftCols(n);
  symmetrize(out.belief.covariance);
  out.belief.covariance.diagonal().array() += kLeastVariance;
  return out;
}

}  // namespace chainsplat::estimation
