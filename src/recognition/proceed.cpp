// proceed.cpp - the halves of a round of `fast` by themselves, each from a recognized twin's values.
#include <algorithm>
#include <cmath>

#include "src/math/decompositions.h"
#include "src/recognition/modes.h"
#include "src/recognition/unseen.h"

namespace chainsplat::recognition {

AnglePrior prior_of(const silhouette::SequenceFit& fit) {
  constexpr double kLeastVariance = 1e-12;  // rad^2
  AnglePrior prior;
  prior.mean = fit.states.theta;
  for (const silhouette::FrameFit& frame : fit.frames) {
    const Eigen::Index n = frame.covariance.rows();
    prior.information.push_back((frame.covariance + kLeastVariance * math::MatrixX::Identity(n, n)).inverse());
  }
  return prior;
}

solve::Summary refine_states(gpu::Device& device, const capture::Capture& capture, const chain::Chain& chain,
                             const splat::Gaussians& gaussians, const AnglePrior& prior, int iterations,
                             chain::States& states) {
  const std::vector<FrameViews> frames = assign_views(capture, states.time);
  std::vector<int> seen;
  for (int k = 0; k < static_cast<int>(frames.size()); ++k)
    if (!frames[k].views.empty()) seen.push_back(k);
  splat::Engine engine(device);
  const solve::Summary summary = refine_all(engine, chain, capture, frames, gaussians, seen, iterations, prior, states);
  differentiate(states);
  return summary;
}

void polish(gpu::Device& device, const capture::Capture& capture, const chain::Chain& chain,
            const chain::States& states, int every, int steps, std::uint64_t seed, splat::Gaussians& gaussians) {
  const std::vector<FrameViews> frames = assign_views(capture, states.time);
  std::vector<splat::ViewSpec> specs;
  std::vector<const capture::PackedView*> targets;
  for (int k = 0; k < static_cast<int>(frames.size()); k += std::max(1, every)) {
    for (const int v : frames[k].views) {
      const capture::PackedView& view = capture.views[v];
      specs.push_back(
          view_spec(capture, view, view_motions(chain, capture, states, frames[k], k, states.theta[k], view)));
      targets.push_back(&view);
    }
  }
  if (specs.empty()) return;
  splat::Engine engine(device);
  engine.set_views(specs, targets);
  engine.set_gaussians(gaussians);
  core::Random random(seed * 1000003 + 7001);
  ViewDeck deck;
  for (int step = 0; step < steps; ++step) {
    if (const int signal = core::stop_requested()) throw Interrupted(signal);
    const std::vector<int> batch = draw_batch(deck, kBatch, static_cast<int>(specs.size()), random);
    engine.step(batch, kLossWeights, rates(static_cast<double>(step) / steps, 1.0), false);
  }
  splat::Gaussians trained = engine.gaussians();
  keep_guessed(gaussians, trained);  // what no camera sees has no gradient, but Adam moves it
  gaussians = std::move(trained);
}

}  // namespace chainsplat::recognition
