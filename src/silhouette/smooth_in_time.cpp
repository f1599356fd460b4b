#include "src/silhouette/smooth_in_time.h"

#include <Eigen/Sparse>
#include <algorithm>
#include <array>
#include <cmath>
#include <iterator>
#include <span>

namespace chainsplat::silhouette {

using math::VectorX;

namespace {

// Random angular accelerations of this size (measured on moving ropes: 3.5 to 5.2 rad/s^2 RMS over
// all joints), with heavy tails for contacts (up to 107).
constexpr double kAcceleration = 5.0;  // rad/s^2
// Share of a fit's variance that is new in every frame; the rest (a bend that straight links cannot follow, the masks'
// width) stays and would be taken for motion if the smoothing trusted the frames less.
constexpr double kIndependent = 0.4;
constexpr double kLinear = 0.3;          // rad, about a fit, that its quadratic is trusted
constexpr double kUnseenWeight = 1e-6;   // of the joint priors of a frame that nothing was seen of
constexpr double kTailDeviations = 2.0;  // beyond this many of them the penalty grows linearly
constexpr int kSmoothingRounds = 4;      // of reweighting

// Second difference of three unevenly spaced values as an acceleration: weights of the three.
std::array<double, 3> acceleration_weights(double t0, double t1, double t2) {
  const double a = t1 - t0, b = t2 - t1;
  return {2.0 / (a * (a + b)), -2.0 / (a * b), 2.0 / (b * (a + b))};
}

// Most likely angles for every frame's quadratic and random accelerations. Frames not `seen` follow from the others.
std::vector<VectorX> smoothed_together(std::span<const double> times, std::span<const FrameSolution> solutions,
                                       std::span<const char> seen) {
  constexpr double kStay = 1.0 / (kLinear * kLinear);
  const int count = static_cast<int>(times.size()), n = static_cast<int>(solutions[0].fit.theta.size());
  std::vector<VectorX> theta(count);
  for (int f = 0; f < count; ++f) theta[f] = solutions[f].fit.theta;
  if (count < 3) return theta;

  VectorX right(count * n);
  std::vector<Eigen::Triplet<double>> data;
  for (int f = 0; f < count; ++f) {
    const FrameSolution& s = solutions[f];
    const double share = seen[f] ? 1.0 / kIndependent : kUnseenWeight, stay = seen[f] ? kStay : 0.0;
    right.segment(f * n, n) = share * (s.information * s.fit.theta + s.gradient) + stay * s.fit.theta;
    for (int k = 0; k < n; ++k)
      for (int l = 0; l <= k; ++l)
        data.emplace_back(f * n + k, f * n + l, share * s.information(k, l) + (k == l ? stay : 0.0));
  }
  Eigen::SimplicialLDLT<Eigen::SparseMatrix<double>, Eigen::Lower, Eigen::NaturalOrdering<int>> solver;
  for (int round = 0; round < kSmoothingRounds; ++round) {
    std::vector<Eigen::Triplet<double>> entries = data;
    for (int f = 1; f + 1 < count; ++f) {
      const std::array<double, 3> w = acceleration_weights(times[f - 1], times[f], times[f + 1]);
      for (int k = 0; k < n; ++k) {
        const double a = w[0] * theta[f - 1][k] + w[1] * theta[f][k] + w[2] * theta[f + 1][k];
        const double size = std::abs(a) / (kTailDeviations * kAcceleration);
        const double weight = (round > 0 && size > 1.0 ? 1.0 / size : 1.0) / (kAcceleration * kAcceleration);
        for (int i = 0; i < 3; ++i)
          for (int j = 0; j <= i; ++j)
            entries.emplace_back((f - 1 + i) * n + k, (f - 1 + j) * n + k, weight * w[i] * w[j]);
      }
    }
    Eigen::SparseMatrix<double> normal(count * n, count * n);
    normal.setFromTriplets(entries.begin(), entries.end());
    if (round == 0) solver.analyzePattern(normal);
    solver.factorize(normal);
    const VectorX all = solver.solve(right);
    if (solver.info() != Eigen::Success || !all.allFinite()) break;
    for (int f = 0; f < count; ++f) theta[f] = all.segment(f * n, n);
  }
  return theta;
}

}  // namespace

std::vector<VectorX> smoothed(const std::vector<double>& times, const std::vector<FrameSolution>& solutions,
                              const std::vector<char>& seen, std::size_t most_unknowns) {
  constexpr std::size_t kApart = 64;  // frames from the end of a stretch; what is farther does not feel it
  const std::size_t count = times.size(), n = std::max<std::size_t>(1, solutions[0].fit.theta.size());
  const std::size_t most = std::max(4 * kApart, most_unknowns / n);
  std::vector<VectorX> out;
  while (out.size() < count) {
    const std::size_t first = out.size() < kApart ? 0 : out.size() - kApart;
    const std::size_t size = std::min(most, count - first);
    std::vector<VectorX> stretch =
        smoothed_together(std::span(times).subspan(first, size), std::span(solutions).subspan(first, size),
                          std::span(seen).subspan(first, size));
    const std::size_t kept = first + size == count ? size : size - kApart;
    std::move(stretch.begin() + static_cast<std::ptrdiff_t>(out.size() - first),
              stretch.begin() + static_cast<std::ptrdiff_t>(kept), std::back_inserter(out));
  }
  return out;
}

}  // namespace chainsplat::silhouette
