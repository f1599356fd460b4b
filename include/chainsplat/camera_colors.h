// chainsplat/camera_colors.h - how differently the cameras of a recording see the same color (mathematics.md 6.12).
//
// Exposure and white balance of two cameras are seldom equal. A point of a matte rope has one color whatever it is seen
// from, so that points which two cameras see at one time tell their difference, whatever the light is. What is common
// to all cameras nothing tells; it stays with the rope's colors.
#pragma once
#include "chainsplat/capture.h"
#include "chainsplat/chain.h"

namespace chainsplat::silhouette {

// recorded = gain * color + bias in each channel (columns: cameras), colors in 0..1. The mean over the cameras of the
// gains is 1 and that of the biases 0.
struct CameraColors {
  Eigen::Matrix3Xd gain, bias;
  Eigen::Matrix3Xd gain_deviation, bias_deviation;  // one standard deviation, by the scatter along the rope
  int patches = 0;                                  // of the rope's surface, seen by two cameras or more
};

// `capture` has its views (undistorted, with masks), with cameras and clocks as corrected; `states` are the rope's, at
// least one, and `chain` has its size. Frames whose time is far from every state's do not count. One camera, and
// cameras that see no common piece of the rope, get gain 1 and bias 0 with the prior's deviation.
CameraColors fit_camera_colors(const chain::Chain& chain, const capture::Capture& capture, const chain::States& states);

}  // namespace chainsplat::silhouette
