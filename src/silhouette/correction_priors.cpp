#include "src/silhouette/correction_priors.h"

#include <algorithm>
#include <cmath>
#include <limits>

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
// Share of those that begin before the grasp: there is rope only where a gripper holds it behind its end.
constexpr double kBefore = 0.02;
constexpr double kSharp = 0.0014;     // m, start_deviations() above which it is not known whether it is the cut face
constexpr double kMillimeter = 1e-3;  // m

double gaussian(double x, double deviation) {
  constexpr double kRootOf2Pi = 2.5066282746310002;
  return std::exp(-0.5 * x * x / (deviation * deviation)) / (kRootOf2Pi * deviation);
}

// What is known of where a camera's masks begin, at x m from the grasp.
struct StartPrior {
  double density;      // 1/m
  double gradient;     // 1/m, of -ln density
  double information;  // 1/m^2, of its curvature what is not negative
};

// `untold`: start_deviations(); `deviation`: of where masks begin that begin at the grasp.
StartPrior start_prior(double x, double deviation, double untold) {
  const double near = std::hypot(deviation, untold), far = std::max(near, kHidden);
  // beyond the grasp, but for kBefore of them, as well as `near` tells it
  const double u = x / near, after = kBefore + (1.0 - 2.0 * kBefore) * 0.5 * std::erfc(-u * M_SQRT1_2);
  const double rise = (1.0 - 2.0 * kBefore) * near * gaussian(x, near) / after;  // of ln after, by u
  const double at_grasp = untold > kSharp ? 0.0 : 0.5;
  const double density_near = at_grasp * gaussian(x, near),
               density_far = (1.0 - at_grasp) * 2.0 * gaussian(x, far) * after;
  // not 0 however far it is
  const double density = std::max(density_near + density_far, std::numeric_limits<double>::min());
  const double share = density_near / density;
  return {
      density, share * x / (near * near) + (1.0 - share) * (x / (far * far) - rise / near),
      share / (near * near) + (1.0 - share) * (1.0 / (far * far) + std::max(0.0, rise * (u + rise)) / (near * near))};
}

}  // namespace

SharedPrior shared_prior(const Layout& layout, const VectorX& x, Starts starts,
                         const std::vector<double>& start_deviations) {
  SharedPrior out{VectorX::Ones(layout.size), x};
  for (const Column& column : layout.columns) {
    if (column.first < 0) continue;
    if (is_mask_start(column)) {
      const double unit = column.deviation, start = unit * x[column.first];
      const double wide = std::max(unit, kHidden);
      const StartPrior known = starts == Starts::anywhere ? StartPrior{0.0, start / (wide * wide), 1.0 / (wide * wide)}
                                                          : start_prior(start, unit, start_deviations[column.camera]);
      out.information[column.first] = unit * unit * known.information;
      out.gradient[column.first] = unit * known.gradient;
      continue;
    }
    const int size = column.quantity->size;
    const double weight = 1.0 / (1.0 + x.segment(column.first, size).squaredNorm() / kTails);
    out.information.segment(column.first, size).setConstant(std::max(weight, kLeastWeight));
    out.gradient.segment(column.first, size) *= std::max(weight, kLeastWeight);
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
    const double start = column.deviation * x[column.first];
    out -= std::log(kMillimeter * start_prior(start, column.deviation, start_deviations[column.camera]).density);
  }
  return out;
}

}  // namespace chainsplat::silhouette
