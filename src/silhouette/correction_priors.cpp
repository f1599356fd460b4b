#include "src/silhouette/correction_priors.h"

#include <algorithm>
#include <cmath>

#include "src/math/decompositions.h"

namespace chainsplat::silhouette {

using math::MatrixX;
using math::VectorX;

namespace {

// The priors' penalty is kTails / 2 ln(1 + |y|^2 / kTails) in units of their deviation: nearly a Gaussian's for what a
// careful laboratory gets wrong, and for a fault ten times that nearly flat.
constexpr double kTails = 2.0;
// Least information of these priors, in that unit: beyond seven deviations they are Gaussian again, five times as wide.
// Without it three cameras over a table went 4 degrees astray in a recording that was right, since straight links fit
// the outlines better by a tenth from there.
constexpr double kLeastWeight = 0.04;
// m, deviation of where masks begin in a camera before which the fingers hold the rope, or which takes them for it;
// every second camera does. In the others they begin at the grasp.
constexpr double kHidden = 0.01;
constexpr double kSharp = 0.0014;     // m, start_deviations() above which it is not known whether it is the cut face
constexpr double kMillimeter = 1e-3;  // m

// Information, 1/m^2, about where a camera's masks begin, at x m: of a mixture of two Gaussians.
double start_information(double x, double deviation, Starts starts) {
  const double narrow = 1.0 / (deviation * deviation), wide = std::min(narrow, 1.0 / (kHidden * kHidden));
  if (starts == Starts::anywhere) return wide;
  const double at_grasp = 1.0 / (1.0 + std::sqrt(wide / narrow) * std::exp(0.5 * x * x * (narrow - wide)));
  return at_grasp * narrow + (1.0 - at_grasp) * wide;
}

}  // namespace

VectorX prior_weights(const Layout& layout, const VectorX& x, Starts starts,
                      const std::vector<double>& start_deviations) {
  VectorX out = VectorX::Ones(layout.size);
  for (const Column& column : layout.columns) {
    if (column.first < 0) continue;
    if (is_mask_start(column)) {
      const double unit = column.deviation, untold = start_deviations[column.camera];
      out[column.first] = unit * unit *
                          start_information(unit * x[column.first], std::hypot(unit, untold),
                                            untold > kSharp ? Starts::anywhere : starts);
      continue;
    }
    const int size = column.quantity->size;
    const double weight = 1.0 / (1.0 + x.segment(column.first, size).squaredNorm() / kTails);
    out.segment(column.first, size).setConstant(std::max(weight, kLeastWeight));
  }
  return out;
}

Followed cost_of_change(const Layout& layout, const MatrixX& information) {
  Followed out{MatrixX::Zero(information.rows(), information.cols()), {}, {}, {}};
  auto& [cost, follow, starts, others] = out;
  for (const Column& column : layout.columns)
    for (int i = 0; column.first >= 0 && i < column.quantity->size; ++i)
      (is_mask_start(column) ? starts : others).push_back(column.first + i);
  cost(others, others) = MatrixX(information(others, others));
  if (starts.empty()) return out;
  const MatrixX pull = information(starts, others), own = information(starts, starts);
  follow = -own.completeOrthogonalDecomposition().solve(pull);
  cost(others, others) += pull.transpose() * follow;
  return out;
}

double surprise_of(const Layout& layout, const MatrixX& directions, const MatrixX& cost, const VectorX& x,
                   const std::vector<double>& start_deviations) {
  const MatrixX known = directions.transpose() * cost * directions;
  double out = 0.5 * std::log((MatrixX::Identity(known.rows(), known.cols()) + known).determinant());
  for (const Column& column : layout.columns) {
    if (column.first < 0) continue;
    if (!is_mask_start(column)) {
      out += 0.5 * kTails * std::log1p(x.segment(column.first, column.quantity->size).squaredNorm() / kTails);
      continue;
    }
    const double start = column.deviation * x[column.first], untold = start_deviations[column.camera];
    const double narrow = std::hypot(column.deviation, untold), wide = std::max(narrow, kHidden);
    const auto density = [&](double deviation) {
      return kMillimeter / deviation * std::exp(-0.5 * start * start / (deviation * deviation));
    };
    out -= std::log(untold > kSharp ? density(wide) : 0.5 * (density(narrow) + density(wide)));
  }
  return out;
}

}  // namespace chainsplat::silhouette
