#include "chainsplat/refinement.h"

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include "src/math/decompositions.h"

namespace chainsplat::refinement {

using math::MatrixX;
using math::Vector3;
using math::VectorX;

namespace {

constexpr double kLeastModelError = 5e-5;  // m: straight links do not follow a bent rope closer than this
constexpr double kSettled = 5e-5;          // m, RMS over nodes: a thirtieth of a pixel at 1 m

// Squared movement of the nodes by a change of theta, m^2/rad^2; of a chain that twists also of points of its surface.
MatrixX node_metric(const chain::Chain& chain, const VectorX& theta) {
  const auto motions = chain::link_motions(chain, theta, {});
  const MatrixX axes = chain::world_axes(chain, theta, {});
  return chain::displacement_metric(chain::point_jacobians(chain, axes, motions, chain::shape_points(chain, false)));
}

void check_sizes(const chain::States& images, const chain::States& rollout) {
  CHAINSPLAT_CHECK(images.theta.size() == images.covariance.size() && images.theta.size() == rollout.theta.size(),
                   std::to_string(images.theta.size()) + ", " + std::to_string(images.covariance.size()) + ", " +
                       std::to_string(rollout.theta.size()));
}

// RMS distance of the links' ends between two motions, to first order, m.
double node_distance(const chain::Chain& chain, const chain::States& a, const chain::States& b) {
  double squares = 0.0;
  for (std::size_t k = 0; k < a.theta.size(); ++k) {
    const VectorX change = b.theta[k] - a.theta[k];
    squares += change.dot(node_metric(chain, a.theta[k]) * change);
  }
  return std::sqrt(squares / static_cast<double>(a.theta.size() * (chain.links() - 1)));
}

}  // namespace

Noise estimate_noise(const chain::Chain& chain, const chain::States& images, const chain::States& rollout) {
  check_sizes(images, rollout);
  const std::size_t frames = images.theta.size();
  const int n = chain.angles();
  // images - rollout has covariance s^2 Sigma + sigma^2 metric^-1: diagonal for all s and sigma in the generalized
  // eigenvectors V of the two, where V^T metric^-1 V = 1 and V^T Sigma V = lambda
  std::vector<VectorX> lambda(frames), square(frames);
  core::parallel_for(static_cast<std::int64_t>(frames), [&](std::int64_t k) {
    const MatrixX inverse = node_metric(chain, rollout.theta[k]).ldlt().solve(MatrixX::Identity(n, n));
    const Eigen::GeneralizedSelfAdjointEigenSolver<MatrixX> eigen(images.covariance[k],
                                                                  0.5 * (inverse + inverse.transpose()));
    lambda[k] = eigen.eigenvalues().cwiseMax(0.0);
    square[k] = (eigen.eigenvectors().transpose() * (images.theta[k] - rollout.theta[k])).cwiseAbs2();
  });
  constexpr int kIterations = 1000;
  constexpr double kConverged = 1e-6;      // relative change of a variance
  constexpr double kMostDeviation2 = 9.0;  // mean squared deviation of a frame beyond which it counts less
  const Noise start;
  double image = start.image_scale * start.image_scale, model = start.model_error * start.model_error;
  for (int iteration = 0; iteration < kIterations; ++iteration) {
    // expectations of the squares of the images' and of the model's part of every component
    double image_sum = 0.0, model_sum = 0.0;
    for (std::size_t k = 0; k < frames; ++k) {
      const double deviation2 = (square[k].array() / (image * lambda[k].array() + model)).mean();
      const double weight = std::min(1.0, kMostDeviation2 / std::max(deviation2, kMostDeviation2));
      for (int i = 0; i < n; ++i) {
        const double total = image * lambda[k][i] + model, known = image * model / total;
        const double seen = weight * square[k][i] / (total * total);
        image_sum += image * image * lambda[k][i] * seen + known;
        model_sum += model * model * seen + known * lambda[k][i];
      }
    }
    const double count = static_cast<double>(frames) * n;
    const double next_image = image_sum / count;
    const double next_model = std::max(model_sum / count, kLeastModelError * kLeastModelError);
    const bool converged =
        std::abs(next_image - image) < kConverged * image && std::abs(next_model - model) < kConverged * model;
    image = next_image, model = next_model;
    if (converged) break;
  }
  return {std::sqrt(image), std::sqrt(model)};
}

chain::States combine(const chain::Chain& chain, const chain::States& images, const chain::States& rollout,
                      const Noise& noise) {
  check_sizes(images, rollout);
  const std::size_t frames = images.theta.size();
  const int n = chain.angles();
  chain::States out = images;
  core::parallel_for(static_cast<std::int64_t>(frames), [&](std::int64_t k) {
    const MatrixX image = noise.image_scale * noise.image_scale * images.covariance[k];
    const MatrixX model = noise.model_error * noise.model_error *
                          node_metric(chain, rollout.theta[k]).ldlt().solve(MatrixX::Identity(n, n));
    // gain of the images over the rollout: model (image + model)^-1
    const MatrixX gain = MatrixX(image + model).ldlt().solve(model).transpose();
    out.theta[k] = rollout.theta[k] + gain * (images.theta[k] - rollout.theta[k]);
    MatrixX covariance = gain * image;
    covariance = 0.5 * (covariance + covariance.transpose()).eval();
    // where the two differ by many orders of magnitude, only Joseph's form keeps small variances positive
    if (!math::is_covariance(covariance)) {
      const MatrixX rest = MatrixX::Identity(n, n) - gain;
      covariance = gain * image * gain.transpose() + rest * model * rest.transpose();
    }
    out.covariance[k] = covariance;
  });
  recognition::differentiate(out);
  return out;
}

Result refine(gpu::Device& device, const capture::Capture& capture, const chain::Chain& chain,
              const splat::Gaussians& gaussians, const chain::States& recognized, const chain::States& rollout,
              const Options& options) {
  const silhouette::SequenceFit outlines = silhouette::fit_sequence(chain, capture);
  const recognition::AnglePrior outline_prior = recognition::prior_of(outlines);
  Result result;
  result.gaussians = gaussians;
  result.identified.rollout = rollout;
  chain::States images = recognized;
  for (int round = 0;; ++round) {
    if (const int signal = core::stop_requested()) throw Interrupted(signal);
    core::report({"joint", round, options.rounds, NAN, NAN, "dynamics"});
    const Noise noise = estimate_noise(chain, images, result.identified.rollout);
    if (round == 0) result.noise = noise;
    chain::States scaled = images;
    for (MatrixX& covariance : scaled.covariance) covariance *= noise.image_scale * noise.image_scale;
    identification::Options identify = options.identification;
    identify.model_error = noise.model_error;
    result.identified = identification::identify(chain, capture.base, scaled, identify);
    result.states = combine(chain, images, result.identified.rollout, noise);
    const double moved = node_distance(chain, images, result.states);
    const double cost = result.identified.estimates.solver->final_cost;
    if (round == 0) result.summary.initial_cost = cost;
    result.summary.final_cost = cost;
    result.summary.worst_step = moved;
    result.summary.iterations = round;
    if (moved < kSettled) result.summary.reason = solve::Reason::step;
    if (round == options.rounds || moved < kSettled) break;

    core::report({"joint", round, options.rounds, NAN, NAN, "images"});
    recognition::polish(device, capture, chain, result.states, options.every, options.steps,
                        options.seed + static_cast<std::uint64_t>(round), result.gaussians);
    constexpr int kIterations = 2;  // of Gauss-Newton
    images = result.states;
    recognition::refine_states(device, capture, chain, result.gaussians, outline_prior, kIterations, images);
    result.rounds = round + 1;
  }
  return result;
}

}  // namespace chainsplat::refinement
