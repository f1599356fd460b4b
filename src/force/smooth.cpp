// Smoothing of angles over time under random jerk: Kalman filter and Rauch-Tung-Striebel smoother.
#include <algorithm>
#include <cmath>

#include "chainsplat/force.h"
#include "src/math/decompositions.h"

namespace chainsplat::force {
namespace {

// Ratios tried of the jerk's spectral density to the noise's variance, 1/s^5: from motions that are smoothed over half
// a second to motions that each frame of a camera measures anew. One ratio is chosen for all angles.
constexpr double kLeastRatio = 1e3, kLargestRatio = 1e9;
constexpr int kRatios = 13;
constexpr double kFirstRate = 10.0, kFirstAcceleration = 100.0;  // rad/s, rad/s^2, prior standard deviations
constexpr double kLeastNoise = 1e-5;                             // rad
constexpr double kCorrelationTimes = 2.0;  // number of times per angle that it takes to believe half of a correlation
// The noise's prior standard deviation, and the number of times as which it counts, for the first states of a stream.
constexpr double kUsualNoise = 5e-3;  // rad
constexpr double kUsualTimes = 0.5;

// The result of the filter. All angles share the gains, which depend on the ratio and the times alone, so that each
// covariance is the Kronecker product of the noise and one 3 x 3 matrix per time.
struct Filtered {
  std::vector<MatrixX> predicted, mean;                   // n x 3: theta, thetadot, thetaddot
  std::vector<Matrix3> predicted_covariance, covariance;  // for noise of 1 rad
  MatrixX noise;                                          // n x n, rad^2, estimated covariance of the observations
  double log_likelihood = 0.0;
};

Matrix3 transition(double h) {
  Matrix3 f;
  f << 1, h, h * h / 2, 0, 1, h, 0, 0, 1;
  return f;
}

// Covariance that white jerk of spectral density 1 adds over a time h.
Matrix3 jerk(double h) {
  const double h2 = h * h, h3 = h2 * h, h4 = h3 * h, h5 = h4 * h;
  Matrix3 q;
  q << h5 / 20, h4 / 8, h3 / 6, h4 / 8, h3 / 3, h2 / 2, h3 / 6, h2 / 2, h;
  return q;
}

Filtered filter(const std::vector<double>& time, const std::vector<VectorX>& theta, double ratio) {
  Filtered out;
  const std::size_t count = time.size();
  const Eigen::Index n = theta[0].size();
  MatrixX mean = MatrixX::Zero(n, 3);
  mean.col(0) = theta[0];
  // a prior far wider than any motion, in units of a noise of one milliradian
  Matrix3 covariance = Vector3(1.0, std::pow(kFirstRate * 1e3, 2), std::pow(kFirstAcceleration * 1e3, 2)).asDiagonal();
  MatrixX squares = MatrixX::Zero(n, n);
  double logs = 0.0;
  int used = 0;
  for (std::size_t f = 0; f < count; ++f) {
    if (f > 0) {
      const double h = time[f] - time[f - 1];
      const Matrix3 step = transition(h);
      mean = (mean * step.transpose()).eval();
      covariance = (step * covariance * step.transpose() + ratio * jerk(h)).eval();
    }
    // update; the first three innovations show the prior and not the noise
    out.predicted.push_back(mean);
    out.predicted_covariance.push_back(covariance);
    const VectorX innovation = theta[f] - mean.col(0);
    const double variance = covariance(0, 0) + 1.0;
    if (f > 2) {
      squares += innovation * innovation.transpose() / variance;
      logs += std::log(variance);
      ++used;
    }
    const Vector3 gain = covariance.col(0) / variance;
    mean += innovation * gain.transpose();
    covariance -= gain * covariance.row(0);
    covariance = (0.5 * (covariance + covariance.transpose())).eval();
    out.mean.push_back(mean);
    out.covariance.push_back(covariance);
  }
  // shrink the correlations, which few times do not determine, and the variances toward the usual noise
  out.noise = squares / (used + kCorrelationTimes * n);
  out.noise.diagonal() = (squares.diagonal().array() + kUsualTimes * kUsualNoise * kUsualNoise) / (used + kUsualTimes) +
                         kLeastNoise * kLeastNoise;
  const Eigen::LLT<MatrixX> factor(out.noise);
  out.log_likelihood = -0.5 * (n * logs + 2.0 * used * factor.matrixLLT().diagonal().array().log().sum() +
                               factor.solve(squares).trace());
  return out;
}

// By all times: means, n x 3, and covariance for noise of 1 rad.
struct Smoothed {
  std::vector<MatrixX> mean;
  std::vector<Matrix3> covariance;
};

Smoothed smooth_backward(const std::vector<double>& time, const Filtered& forward) {
  const std::size_t count = time.size();
  Smoothed out{std::vector<MatrixX>(count), std::vector<Matrix3>(count)};
  MatrixX mean = forward.mean.back();
  Matrix3 covariance = forward.covariance.back();
  for (std::size_t f = count; f-- > 0;) {
    if (f + 1 < count) {
      const Matrix3 step = transition(time[f + 1] - time[f]);
      const Matrix3 gain = forward.covariance[f] * step.transpose() * forward.predicted_covariance[f + 1].inverse();
      mean = (forward.mean[f] + (mean - forward.predicted[f + 1]) * gain.transpose()).eval();
      covariance =
          (forward.covariance[f] + gain * (covariance - forward.predicted_covariance[f + 1]) * gain.transpose()).eval();
    }
    out.mean[f] = mean;
    out.covariance[f] = 0.5 * (covariance + covariance.transpose());
  }
  return out;
}

}  // namespace

Motion smooth(const chain::States& states, std::span<const Clock> clock) {
  const std::size_t count = states.time.size();
  if (count < 3) throw InputError("states", "are fewer than three", "give more: forces need accelerations");
  CHAINSPLAT_CHECK(clock.empty() || clock.size() == count, std::to_string(clock.size()));
  // choose the ratio by maximum likelihood
  Filtered best;
  double best_ratio = kLeastRatio;
  for (int i = 0; i < kRatios; ++i) {
    const double ratio = kLeastRatio * std::pow(kLargestRatio / kLeastRatio, i / (kRatios - 1.0));
    Filtered tried = filter(states.time, states.theta, ratio);
    if (i > 0 && !(tried.log_likelihood > best.log_likelihood)) continue;
    best = std::move(tried);
    best_ratio = ratio;
  }
  Smoothed all = smooth_backward(states.time, best);
  Motion out;
  out.time = states.time;
  for (const MatrixX& mean : all.mean) {
    out.theta.push_back(mean.col(0));
    out.thetadot.push_back(mean.col(1));
    out.thetaddot.push_back(mean.col(2));
  }
  out.covariance = std::move(all.covariance);
  out.noise = best.noise;
  out.standing = states.covariance;
  if (std::all_of(clock.begin(), clock.end(), [](const Clock& at) { return at.sigma == 0.0; })) return out;
  // the smoother is linear: what the clock adds to the angles goes through it as they do
  std::vector<VectorX> added;
  for (std::size_t f = 0; f < count; ++f) {
    const bool known = clock[f].theta.size() > 0;
    added.push_back(known ? VectorX(clock[f].sigma * clock[f].theta) : VectorX::Zero(states.theta[f].size()));
    out.clock.push_back(clock[f].sigma);
  }
  out.by_clock = smooth_backward(states.time, filter(states.time, added, best_ratio)).mean;
  return out;
}

}  // namespace chainsplat::force
