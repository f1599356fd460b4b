// chainsplat/refinement.h - images and dynamics together: `--joint` (the paper's first open problem).
//
// Every frame's angles are unknowns that two sides pull at. The images say theta_k = theta_hat_k, covariance s^2
// Sigma_k: recognition's own, scaled for what it does not know of (errors that last from frame to frame). The dynamics
// says theta_k = theta_bar_k(p), the rollout of parameters p, up to an error of deviation sigma at every node. How far
// each is to be believed, s and sigma, is estimated from their disagreement, so three good cameras keep their angles
// and one camera's depth follows the dynamics. A round: s and sigma; p from the images' angles with those weights;
// every frame's most likely angles; Adam on the Gaussians with these; the images' angles again about them.
#pragma once
#include <cstdint>
#include <vector>

#include "chainsplat/identification.h"
#include "chainsplat/recognition.h"

namespace chainsplat::refinement {

struct Noise {
  double image_scale = 1.0;   // s: standard deviations of the images' angles over those that recognition states
  double model_error = 1e-3;  // sigma, m: deviation of one coordinate of a node about the rollout
};

// The most likely noise (variance components by expectation maximization). Frames far worse than the others count
// less. All sequences have the same length, `images` has covariances.
Noise estimate_noise(const chain::Chain& chain, const chain::States& images, const chain::States& rollout);

// The most likely angles between images and rollout, frame by frame, and their covariances.
chain::States combine(const chain::Chain& chain, const chain::States& images, const chain::States& rollout,
                      const Noise& noise);

struct Options {
  identification::Options identification;
  int rounds = 5;   // at most; it ends where the dynamics does not move the angles any more
  int every = 5;    // frames that train the Gaussians
  int steps = 100;  // Adam steps a round
  std::uint64_t seed = 0;
};

struct Result {
  splat::Gaussians gaussians;
  chain::States states;
  identification::Result identified;
  Noise noise;     // of the first round: later ones' images have been drawn with the dynamics' help
  int rounds = 0;  // in which the Gaussians were trained again
  // Of the rounds: step m, RMS distance by which the dynamics moves the nodes after the last; costs those of
  // `identified`, first and last.
  solve::Summary summary;
};

// From what recognition found and the rollout identified from it. Throws what recognition and identification throw.
// Reports progress in stage "joint".
Result refine(gpu::Device& device, const capture::Capture& capture, const chain::Chain& chain,
              const splat::Gaussians& gaussians, const chain::States& recognized, const chain::States& rollout,
              const Options& options);

}  // namespace chainsplat::refinement
