// refine_angles.h - Gauss-Newton on each frame's joint angles with the Gaussians held (design.md, 'Recognition').
//
// A drawn rope moves in the image with its surface: where pixel p shows the surface point x of link j, a twist xi of
// that link moves the picture by the flow du = dpi/dx (w x x + v), so dI^/dxi = -grad I^ . du. Color and mask residuals
// of a view become a 6x6 normal matrix and a 6-vector a link in twist space; the space Jacobian takes their sum to
// theta.
#pragma once
#include <functional>
#include <span>
#include <vector>

#include "chainsplat/capture.h"
#include "chainsplat/chain.h"
#include "chainsplat/recognition.h"
#include "chainsplat/solve.h"
#include "chainsplat/splat.h"
#include "src/recognition/frames.h"

namespace chainsplat::recognition {

struct LinkEquations {                // of one view; world twists about the world origin
  std::vector<math::Matrix6> normal;  // a link: J^T W J
  std::vector<math::Vector6> right;   // a link: J^T W r
  double cost = 0.0;                  // robust cost of color and mask residuals
};

// `picture` drawn with depth at `motions`. `mask_weight` scales the mask residual against one color channel.
LinkEquations link_equations(const chain::Chain& chain, const capture::Camera& camera, const capture::View& view,
                             const std::vector<math::Pose>& motions, const splat::Picture& picture, double mask_weight);

struct RefineOptions {
  int iterations = 3;
  double mask_weight = 1.0;
  double smooth_sigma = 0.15;  // rad, prior of neighboring joints (chain::neighbor_difference)
  double trusted = 0.0;  // rad: a step that changes no angle by more is a frame's last and not drawn to be checked
};

struct Refined {
  solve::Summary summary;                  // of all frames together; steps in rad
  int steps = 0;                           // that were taken, of all frames
  std::vector<math::MatrixX> covariances;  // of each refined frame
};

// Draws the capture's views of these indices with these link motions, with depth, in order.
using Draw = std::function<std::vector<splat::Picture>(std::span<const int> views,
                                                       std::span<const std::vector<math::Pose>> motions)>;

// Improves states.theta of the `selected` frames, each on its own (Levenberg-Marquardt, all frames drawn together).
Refined refine_angles(const chain::Chain& chain, const capture::Capture& capture, const std::vector<FrameViews>& frames,
                      std::span<const int> selected, const Draw& draw, const RefineOptions& options,
                      const AnglePrior& prior, chain::States& states);

}  // namespace chainsplat::recognition
