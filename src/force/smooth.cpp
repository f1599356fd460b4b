// Angles along time under random jerk: Kalman filter and Rauch-Tung-Striebel smoother.
#include <array>
#include <cmath>

#include "chainsplat/force.h"

namespace chainsplat::force {
namespace {

// Jerk's spectral density over the noise's variance, 1/s^5: from motions that noise hides for half a second to motions
// seen afresh in every frame of a camera. One ratio is chosen for all angles.
constexpr double kLeastRatio = 1e3, kLargestRatio = 1e9;
constexpr int kRatios = 13;
constexpr double kFirstRate = 10.0, kFirstAcceleration = 100.0;  // rad/s, rad/s^2, before anything was seen
constexpr double kLeastNoise = 1e-5;                             // rad

struct Filtered {
  std::vector<Vector3> predicted, mean;                   // theta, thetadot, thetaddot
  std::vector<Matrix3> predicted_covariance, covariance;  // for noise of 1 rad
  double noise = 0.0;                                     // rad, of the observations, found
  double log_likelihood = 0.0;
};

Matrix3 transition(double h) {
  Matrix3 f;
  f << 1, h, h * h / 2, 0, 1, h, 0, 0, 1;
  return f;
}

// Covariance of white jerk of density 1 over h.
Matrix3 jerk(double h) {
  const double h2 = h * h, h3 = h2 * h, h4 = h3 * h, h5 = h4 * h;
  Matrix3 q;
  q << h5 / 20, h4 / 8, h3 / 6, h4 / 8, h3 / 3, h2 / 2, h3 / 6, h2 / 2, h;
  return q;
}

// One angle, in units of the noise; `least_noise` bounds what is found.
Filtered filter(const std::vector<double>& time, const std::vector<VectorX>& theta, int angle, double ratio,
                double least_noise) {
  Filtered out;
  const std::size_t count = time.size();
  Vector3 mean(theta[0][angle], 0.0, 0.0);
  // far wider than any motion, in units of noise of a milliradian
  Matrix3 covariance = Vector3(1.0, std::pow(kFirstRate * 1e3, 2), std::pow(kFirstAcceleration * 1e3, 2)).asDiagonal();
  double squares = 0.0, logs = 0.0;
  int used = 0;
  for (std::size_t f = 0; f < count; ++f) {
    if (f > 0) {
      const double h = time[f] - time[f - 1];
      mean = transition(h) * mean;
      covariance = transition(h) * covariance * transition(h).transpose() + ratio * jerk(h);
    }
    out.predicted.push_back(mean);
    out.predicted_covariance.push_back(covariance);
    const double innovation = theta[f][angle] - mean[0], variance = covariance(0, 0) + 1.0;
    if (f > 2) {
      squares += innovation * innovation / variance;
      logs += std::log(variance);
      ++used;
    }
    const Vector3 gain = covariance.col(0) / variance;
    mean += gain * innovation;
    covariance -= gain * covariance.row(0);
    covariance = (0.5 * (covariance + covariance.transpose())).eval();
    out.mean.push_back(mean);
    out.covariance.push_back(covariance);
  }
  const double noise2 = std::max(least_noise * least_noise, used > 0 ? squares / used : 0.0);
  out.noise = std::sqrt(noise2);
  out.log_likelihood = -0.5 * (logs + used * std::log(noise2) + squares / noise2);
  return out;
}

}  // namespace

Motion smooth(const chain::States& states, std::span<const VectorX> sigma, bool live) {
  const std::size_t count = states.time.size();
  if (count < 3) throw InputError("states", "are fewer than three", "give more: forces need accelerations");
  const int n = static_cast<int>(states.theta[0].size());
  std::vector<Filtered> best;
  double best_likelihood = 0.0;
  for (int i = 0; i < kRatios; ++i) {
    const double ratio = kLeastRatio * std::pow(kLargestRatio / kLeastRatio, i / (kRatios - 1.0));
    std::vector<Filtered> angles;
    double likelihood = 0.0;
    for (int k = 0; k < n; ++k) {
      angles.push_back(filter(states.time, states.theta, k, ratio, kLeastNoise));
      likelihood += angles.back().log_likelihood;
    }
    if (best.empty() || likelihood > best_likelihood) {
      best = std::move(angles);
      best_likelihood = likelihood;
    }
  }
  Motion out;
  out.time = states.time;
  out.theta.assign(count, VectorX(n));
  out.thetadot.assign(count, VectorX(n));
  out.thetaddot.assign(count, VectorX(n));
  out.covariance.assign(count, std::vector<Matrix3>(n));
  for (int k = 0; k < n; ++k) {
    const Filtered& a = best[k];
    Vector3 mean = a.mean.back();
    Matrix3 covariance = a.covariance.back();
    for (std::size_t back = 0; back < count; ++back) {
      const std::size_t f = count - 1 - back;
      if (live) {
        mean = a.mean[f];
        covariance = a.covariance[f];
      } else if (back > 0) {
        const Matrix3 f_next = transition(states.time[f + 1] - states.time[f]);
        const Matrix3 gain = a.covariance[f] * f_next.transpose() * a.predicted_covariance[f + 1].inverse();
        mean = a.mean[f] + gain * (mean - a.predicted[f + 1]);
        covariance = (a.covariance[f] + gain * (covariance - a.predicted_covariance[f + 1]) * gain.transpose()).eval();
      }
      out.theta[f][k] = mean[0];
      out.thetadot[f][k] = mean[1];
      out.thetaddot[f][k] = mean[2];
      out.covariance[f][k] = a.noise * a.noise * 0.5 * (covariance + covariance.transpose());
      // errors that stay from frame to frame are not noise: they are known to the giver of the states alone
      if (!sigma.empty()) out.covariance[f][k](0, 0) += sigma[f][k] * sigma[f][k];
    }
  }
  return out;
}

}  // namespace chainsplat::force
