// chainsplat/render.h - twin + angles + camera -> color, mask and depth in a camera's pixels.
#pragma once
#include <vector>
#include "chainsplat/capture.h"
#include "chainsplat/splat.h"
#include "chainsplat/twin.h"

namespace chainsplat::render {

struct Frame {
  int camera = 0, frame = 0;
  double time = 0.0;
  int x0 = 0, y0 = 0;            // of the crop in the image; outside it everything is black
  splat::Picture picture;        // in recorded pixels (warped by the lens distortion) unless `undistorted`
};

struct Options {
  bool depth = false;
  bool undistorted = false;      // leave the lens distortion out
  int margin = 8;                // px around the projected Gaussians' three-sigma bounds
};

// The camera's frames whose times the states cover (at most half a frame beyond their ends, cubic in theta).
std::vector<Frame> frames(splat::Engine& engine, const splat::Gaussians& gaussians, const chain::Chain& chain,
                          const chain::States& states, const trajectory::Trajectory& base, const capture::Camera& camera,
                          int camera_index, const std::vector<double>& times, const Options& options = {});

}  // namespace chainsplat::render
