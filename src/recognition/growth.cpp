#include "src/recognition/growth.h"

#include <algorithm>
#include <cmath>

namespace chainsplat::recognition {

namespace {

// 3DGS', but for the threshold, which is ScrewSplat's.
constexpr double kThreshold = 0.0006;    // mean pull from which a Gaussian becomes two
constexpr double kSplitFrom = 0.01;      // of the extent: largest standard deviation that is only doubled
constexpr float kSplitBy = 1.6f;         // halves of a large one are smaller by this
constexpr double kLeastOpacity = 0.005;  // below it nothing is seen
constexpr double kMostPixels = 20.0;     // radius of three standard deviations
constexpr double kMostOfExtent = 0.1;

double largest_deviation(const splat::Gaussians& g, int i) {
  return std::exp(std::max({g.log_scale[3 * i], g.log_scale[3 * i + 1], g.log_scale[3 * i + 2]}));
}

// Half of Gaussian `i`: smaller, and at a random place within it.
void halve(splat::Gaussians& g, int i, core::Random& random) {
  const float* const q = &g.rotation[4 * static_cast<std::size_t>(i)];
  math::Vector3 off = math::Vector3::Zero();
  for (int c = 0; c < 3; ++c) {
    off[c] = std::exp(g.log_scale[3 * i + c]) * random.normal();
    g.log_scale[3 * i + c] -= std::log(kSplitBy);
  }
  off = Eigen::Quaterniond(q[0], q[1], q[2], q[3]).normalized() * off;
  for (int c = 0; c < 3; ++c) g.mean[3 * i + c] += static_cast<float>(off[c]);
}

}  // namespace

void add_step(const splat::Gaussians& gradient, double loss_scale, double per_meter, Pull& pull) {
  pull.sum.resize(gradient.count, 0.0);
  pull.steps.resize(gradient.count, 0);
  for (int i = 0; i < gradient.count; ++i) {
    const double norm = Eigen::Map<const Eigen::Vector3f>(&gradient.mean[3 * i]).cast<double>().norm();
    if (!(norm > 0.0)) continue;
    pull.sum[i] += norm * loss_scale / per_meter;
    ++pull.steps[i];
  }
}

Grown grow(const splat::Gaussians& gaussians, const Pull& pull, const GrowthLimits& limits, core::Random& random) {
  Grown out;
  std::vector<int> doubled, split;
  for (int i = 0; i < gaussians.count; ++i) {
    const double largest = largest_deviation(gaussians, i);
    const double opacity = 1.0 / (1.0 + std::exp(-static_cast<double>(gaussians.opacity_logit[i])));
    const bool too_large = limits.prune_large && (3.0 * largest * limits.pixels_per_meter > kMostPixels ||
                                                  largest > kMostOfExtent * limits.extent);
    if (!(opacity >= kLeastOpacity) || too_large) continue;
    const bool pulled = gaussians.count < limits.most && pull.steps[i] > 0 && pull.sum[i] > kThreshold * pull.steps[i];
    const bool large = largest > kSplitFrom * limits.extent;
    if (!pulled || !large) out.kept.push_back(i);
    if (pulled) (large ? split : doubled).push_back(i);
  }
  std::vector<int> rows = doubled;
  for (const int i : split) rows.insert(rows.end(), 2, i);
  out.added = splat::rows_of(gaussians, rows, 0);
  for (int k = static_cast<int>(doubled.size()); k < out.added.count; ++k) halve(out.added, k, random);
  return out;
}

}  // namespace chainsplat::recognition
