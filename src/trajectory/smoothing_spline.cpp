#include "smoothing_spline.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "chainsplat/core.h"

namespace chainsplat::trajectory {

namespace {

constexpr int kDegree = 5;
constexpr int kOrder = kDegree + 1;   // basis functions that are non-zero on one interval
constexpr int kPenalized = 3;         // order of the penalized derivative
constexpr double kKnotSpacing = 0.5;  // of the median sample interval; closer samples share a knot, for conditioning
// Smoothing strengths tried, as powers of ten in units of (median interval)^5. The amplitude response is
// 1 / (1 + lambda omega^6) with omega in radians per sample: the least passes everything below the Nyquist frequency,
// the greatest leaves a parabola of some thousand samples.
constexpr double kLeastExponent = -4.0, kGreatestExponent = 12.0, kExponentStep = 0.25;
// Poses of stills are no samples of one motion: so few, or so far apart, they are met, since what is between them does
// not matter and cross validation would take the changes from one to the next for noise.
constexpr int kFewest = 9;
constexpr double kLongestInterval = 0.2;  // s, median
constexpr double kStillsStrength = 1e-7;
// Points and weights of Gauss-Legendre quadrature on [-1, 1]; three points are exact for |f'''|^2, of degree four.
constexpr double kGaussPoint[3] = {-0.774596669241483377, 0.0, 0.774596669241483377};
constexpr double kGaussWeight[3] = {5.0 / 9, 8.0 / 9, 5.0 / 9};

// Returns the index i of the interval [knot_i, knot_i+1) that holds `time`; the end intervals hold everything outside.
int find_interval(const std::vector<double>& knots, double time) {
  const auto first = knots.begin() + kOrder, last = knots.end() - kOrder;
  return static_cast<int>(std::upper_bound(first, last, time) - knots.begin()) - 1;
}

// De Boor's algorithm: the value (a row vector) of a spline of degree `degree` at `time` from the degree + 1 control
// rows of its interval. `knots` points at the interval's left knot.
template <class Rows>
Eigen::RowVectorXd de_boor(Rows rows, int degree, const double* knots, double time) {
  for (int level = 1; level <= degree; ++level)
    for (int j = degree; j >= level; --j) {
      const double left = knots[j - degree], right = knots[j + 1 - level];
      const double a = (time - left) / (right - left);
      rows.row(j) = ((1.0 - a) * rows.row(j - 1) + a * rows.row(j)).eval();
    }
  return rows.row(degree);
}

// Returns the control rows of the derivative of a spline of degree `degree`; the rows from `degree` on are unused.
template <class Rows>
Rows differentiated(const Rows& rows, int degree, const double* knots) {
  Rows out = rows;
  for (int j = 1; j <= degree; ++j)
    out.row(j - 1) = degree * (rows.row(j) - rows.row(j - 1)) / (knots[j] - knots[j - degree]);
  return out;
}

// Returns the six basis functions of the interval at `time`, or their derivative of the given order.
Eigen::Matrix<double, 1, kOrder> basis(const std::vector<double>& knots, int interval, double time, int derivative) {
  Eigen::Matrix<double, kOrder, kOrder> rows = Eigen::Matrix<double, kOrder, kOrder>::Identity();
  const double* const left = knots.data() + interval;
  int degree = kDegree;
  for (int d = 0; d < derivative; ++d, --degree) rows = differentiated(rows, degree, left);
  return de_boor(rows, degree, left, time);
}

// Symmetric band matrix: column k of row i holds element (i, i + k).
using Band = Eigen::Matrix<double, Eigen::Dynamic, kOrder, Eigen::RowMajor>;

// Adds weight * row^T row to the block that begins at element (first, first).
void add_outer(Band& band, int first, const Eigen::Matrix<double, 1, kOrder>& row, double weight) {
  for (int i = 0; i < kOrder; ++i)
    for (int j = i; j < kOrder; ++j) band(first + i, j - i) += weight * row[i] * row[j];
}

// Factors a band matrix as L D L^T in place: column 0 then holds D, column k of row i the element (i + k, i) of L.
void factor(Band& a) {
  const int n = static_cast<int>(a.rows());
  for (int i = 0; i < n; ++i) {
    const int reach = std::min(kDegree, n - 1 - i);
    for (int j = 1; j <= reach; ++j) {
      const double l = a(i, j) / a(i, 0);
      for (int k = j; k <= reach; ++k) a(i + j, k - j) -= l * a(i, k);
    }
    a.row(i).segment(1, kDegree) /= a(i, 0);
  }
}

// Solves with the factors of factor(), in place.
void solve(const Band& factored, Points& x) {
  const int n = static_cast<int>(x.rows());
  for (int i = 0; i < n; ++i)
    for (int k = 1; k <= std::min(kDegree, n - 1 - i); ++k) x.row(i + k) -= factored(i, k) * x.row(i);
  for (int i = n - 1; i >= 0; --i) {
    x.row(i) /= factored(i, 0);
    for (int k = 1; k <= std::min(kDegree, n - 1 - i); ++k) x.row(i) -= factored(i, k) * x.row(i + k);
  }
}

// Returns trace(A^-1 B) for band matrices from the band of the inverse alone (Hutchinson & de Hoog 1985).
double trace_of_inverse_times(const Band& factored, const Band& b) {
  const int n = static_cast<int>(factored.rows());
  Band inverse = Band::Zero(n, kOrder);
  const auto element = [&](int i, int j) { return i < j ? inverse(i, j - i) : inverse(j, i - j); };
  double trace = 0.0;
  for (int i = n - 1; i >= 0; --i) {
    const int reach = std::min(kDegree, n - 1 - i);
    for (int j = reach; j >= 0; --j) {
      double sum = j == 0 ? 1.0 / factored(i, 0) : 0.0;
      for (int k = 1; k <= reach; ++k) sum -= factored(i, k) * element(i + k, i + j);
      inverse(i, j) = sum;
    }
    trace += inverse(i, 0) * b(i, 0);
    for (int j = 1; j <= reach; ++j) trace += 2.0 * inverse(i, j) * b(i, j);
  }
  return trace;
}

}  // namespace

Spline::Value Spline::at(double time) const {
  const int interval = find_interval(knots, time);
  const double* const left = knots.data() + interval;
  Eigen::Matrix<double, kOrder, 3, Eigen::RowMajor> rows = coefficients.middleRows<kOrder>(interval - kDegree);
  Value value;
  value.position = de_boor(rows, kDegree, left, time).transpose();
  rows = differentiated(rows, kDegree, left);
  value.velocity = de_boor(rows, kDegree - 1, left, time).transpose();
  rows = differentiated(rows, kDegree - 1, left);
  value.acceleration = de_boor(rows, kDegree - 2, left, time).transpose();
  return value;
}

SplineFit fit_spline(const std::vector<double>& times, const Points& values) {
  const int samples = static_cast<int>(times.size());
  CHAINSPLAT_CHECK(samples >= 3 && values.rows() == samples, "samples " + std::to_string(samples));

  // take the median interval as the unit of time, so that lambda has no dimension
  std::vector<double> intervals(samples - 1);
  for (int k = 0; k + 1 < samples; ++k) intervals[k] = times[k + 1] - times[k];
  const double unit = math::median(intervals), origin = times.front();
  const auto scaled = [&](int k) { return (times[k] - origin) / unit; };

  // place knots at the samples, except where they would be too close
  std::vector<double> knots(kOrder, 0.0);
  const double end = scaled(samples - 1);
  for (int k = 1; k + 1 < samples; ++k)
    if (scaled(k) - knots.back() >= kKnotSpacing && end - scaled(k) >= kKnotSpacing) knots.push_back(scaled(k));
  knots.insert(knots.end(), kOrder, end);
  const int count = static_cast<int>(knots.size()) - kOrder;

  // accumulate the normal matrix, its right-hand side and the penalty
  Band data = Band::Zero(count, kOrder), penalty = Band::Zero(count, kOrder);
  Points right = Points::Zero(count, 3);
  std::vector<int> first(samples);
  std::vector<Eigen::Matrix<double, 1, kOrder>> rows(samples);
  const math::Vector3 offset = values.row(0).transpose();  // subtracted, because small numbers keep more digits
  for (int k = 0; k < samples; ++k) {
    const int interval = find_interval(knots, scaled(k));
    first[k] = interval - kDegree;
    rows[k] = basis(knots, interval, scaled(k), 0);
    add_outer(data, first[k], rows[k], 1.0);
    right.middleRows<kOrder>(first[k]) += rows[k].transpose() * (values.row(k) - offset.transpose());
  }
  for (int i = kDegree; i < count; ++i) {
    const double half = 0.5 * (knots[i + 1] - knots[i]), middle = 0.5 * (knots[i + 1] + knots[i]);
    for (int g = 0; g < 3; ++g)
      add_outer(penalty, i - kDegree, basis(knots, i, middle + half * kGaussPoint[g], kPenalized),
                half * kGaussWeight[g]);
  }

  // solve for every smoothing strength and keep the one with the least cross-validation score
  SplineFit best;
  double best_score = std::numeric_limits<double>::infinity();
  const bool stills = samples < kFewest || unit >= kLongestInterval;
  const double greatest = stills ? kLeastExponent : kGreatestExponent;
  for (double exponent = kLeastExponent; exponent <= greatest; exponent += kExponentStep) {
    Band normal = data + (stills ? kStillsStrength : std::pow(10.0, exponent)) * penalty;
    factor(normal);
    Points coefficients = right;
    solve(normal, coefficients);
    double squares = 0.0;
    for (int k = 0; k < samples; ++k)
      squares +=
          (rows[k] * coefficients.middleRows<kOrder>(first[k]) - (values.row(k) - offset.transpose())).squaredNorm();
    const double freedom = trace_of_inverse_times(normal, data);
    const double left_over = samples - freedom;
    // with as many degrees of freedom as samples no residual is left to judge by; the first strength is the fallback
    const double score =
        left_over > 1e-9 * samples ? squares / (left_over * left_over) : std::numeric_limits<double>::infinity();
    if (!(score < best_score) && exponent > kLeastExponent) continue;
    best_score = score;
    best.spline.coefficients = coefficients;
    best.noise = left_over > 1e-9 * samples && !stills ? std::sqrt(squares / (3.0 * left_over)) : 0.0;
    best.degrees_of_freedom = freedom;
  }
  // return to seconds and to the values' own origin
  best.spline.coefficients.rowwise() += offset.transpose();
  for (double& knot : knots) knot = origin + unit * knot;
  best.spline.knots = std::move(knots);
  return best;
}

}  // namespace chainsplat::trajectory
