// chainsplat/render.h - twin + angles + camera -> color, mask and depth in a camera's pixels.
#pragma once
#include <functional>
#include <vector>
#include "chainsplat/capture.h"
#include "chainsplat/splat.h"
#include "chainsplat/twin.h"

namespace chainsplat::render {

struct Frame {
  int camera = 0, frame = 0;  // `frame` is the index into the `times` that were asked for
  double time = 0.0;
  int x0 = 0, y0 = 0;      // of the crop in the image; outside it everything is black
  splat::Picture picture;  // in recorded pixels (warped by the lens distortion) unless `undistorted`; may be 0 x 0
};

struct Options {
  bool depth = false;
  bool undistorted = false;  // leave the lens distortion out
  int margin = 8;            // px around what the Gaussians can reach (where their alpha falls below 1/255: SPEC 2.6)
  double interval = 0.0;     // s between the camera's frames; 0: the median of `times`
};

// The camera's frames whose times the states cover (at most half a frame beyond their ends, cubic in theta).
std::vector<Frame> frames(splat::Engine& engine, const splat::Gaussians& gaussians, const chain::Chain& chain,
                          const chain::States& states, const trajectory::Trajectory& base,
                          const capture::Camera& camera, int camera_index, const std::vector<double>& times,
                          const Options& options = {});

// The same, a batch of some frames at a time, in order: what is in memory does not grow with the number of frames.
void for_batches(splat::Engine& engine, const splat::Gaussians& gaussians, const chain::Chain& chain,
                 const chain::States& states, const trajectory::Trajectory& base, const capture::Camera& camera,
                 int camera_index, const std::vector<double>& times, const Options& options,
                 const std::function<void(std::vector<Frame>& batch)>& use);

// Whether the states reach `time`: at most half of `interval` outside them.
bool covered(const chain::States& states, double time, double interval);
// Median difference of `times`; 0 for fewer than two.
double median_interval(const std::vector<double>& times);

// The whole image of a frame, black outside the crop: 8 bits RGB (clamped, rounded); 255 where alpha >= 0.5, else 0;
// depth in meters, 0 = none.
capture::Image8 color_image(const Frame& frame, const capture::Camera& camera);
capture::Image8 mask_image(const Frame& frame, const capture::Camera& camera);
std::vector<float> depth_image(const Frame& frame, const capture::Camera& camera);

// Pixel rectangle [x0, x1) x [y0, y1) of the undistorted image outside which no replica's alpha reaches 1/255.
struct Bounds {
  int x0 = 0, y0 = 0, x1 = 0, y1 = 0;
  bool empty() const { return x1 <= x0 || y1 <= y0; }
};
// Not cut to the image. `motions` as chain::link_motions.
Bounds reach(const splat::Gaussians& gaussians, const std::vector<math::Pose>& motions, const capture::Camera& camera);

}  // namespace chainsplat::render
