// chainsplat/silhouette.h - masks and a chain -> joint angles: the coarse step of recognition and estimation (SPEC 6).
//
// Sampled mask pixels are drawn to the projected centerline of the rope, along its normal (pixels past the free end pull
// with the whole vector), and sampled centerline points are drawn into the mask; Gauss-Newton over all views of a frame
// with a Huber weight, weak priors between neighboring joints, warm-started from the frame before. DESIGN, 'Recognition'.
#pragma once
#include <span>
#include <vector>
#include "chainsplat/capture.h"
#include "chainsplat/chain.h"

namespace chainsplat::silhouette {

struct Options {
  int max_pixels = 500;          // mask pixels used a view
  int iterations = 8;            // Gauss-Newton steps a frame
  int first_iterations = 30;     // for a frame without a warm start
  double huber_pixels = 8.0;     // px, after the first iterations
  double joint_smoothness = 0.0; // weight of (theta_j - theta_{j-1})^2, set by the implementation when 0
};

struct FrameFit {
  math::VectorX theta;
  double residual_pixels = 0.0;  // RMS distance of mask pixels from the tube's centerline along its normal, robust
  double covered = 0.0;          // share of mask pixels within the tube's half width + 2 px of the projected centerline
  math::MatrixX covariance;      // n x n of theta, from the normal equations (pixel noise 1 px)
};

// One frame: all views taken at (nearly) one time. `views` must be undistorted crops with masks.
FrameFit fit_frame(const chain::Chain& chain, const math::Pose& base, std::span<const capture::View* const> views,
                   const std::vector<capture::Camera>& cameras, const math::VectorX& start, bool warm,
                   const Options& options = {});

// Every time of the first camera, in order; other cameras' nearest frame within half an interval joins it. Frames without
// any mask pixel keep the prediction from their neighbors (and are named in one warning).
// Also tries the reverse direction and re-fits frames whose residual jumps.
struct SequenceFit {
  chain::States states;          // theta and smoothed thetadot
  std::vector<FrameFit> frames;
};
SequenceFit fit_sequence(const chain::Chain& chain, const capture::Capture& capture, const Options& options = {});

// INTERFACE 1, --bending auto: on a table planar; in free space spatial unless the out-of-plane RMS of a spatial fit is
// under 1 mm or three of its standard deviations.
struct BendingChoice {
  chain::Bending bending = chain::Bending::spatial;
  double out_of_plane_rms = 0.0;  // m; 0 when not measured
  double deviation = 0.0;         // its standard deviation, m
};
BendingChoice choose_bending(const chain::Chain& spatial_chain, const capture::Capture& capture, const SequenceFit& fit);

}  // namespace chainsplat::silhouette
