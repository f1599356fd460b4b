// chainsplat/render.h - draws a twin: Gaussians, angles over time and a camera give color, mask and depth images.
//
// Rendering, evaluation and synthetic captures use it. Pictures are crops around the rope, in recorded pixels (with the
// lens distortion) unless undistorted ones are asked for; depth is the camera's z in m.
#pragma once
#include <functional>
#include <vector>
#include "chainsplat/capture.h"
#include "chainsplat/rectangle.h"
#include "chainsplat/splat.h"
#include "chainsplat/twin.h"

namespace chainsplat::render {

struct Frame {
  int camera = 0, frame = 0;  // `frame` is an index into the `times` that were asked for
  double time = 0.0;          // s
  int x0 = 0, y0 = 0;         // px, of the crop in the image; the image is black outside the crop
  splat::Picture picture;     // in recorded pixels (warped by the lens distortion) unless `undistorted`; may be 0 x 0
};

struct Options {
  bool depth = false;
  bool undistorted = false;  // do not apply the lens distortion
  int margin = 8;            // px around the reach of the Gaussians, where their alpha is below 1/255
  double interval = 0.0;     // s between the camera's frames; 0: the median difference of `times`
};

// Draws the frames at those of `times` (s) that the states cover, at most half an interval beyond their ends. Between
// states theta is interpolated by cubics.
std::vector<Frame> frames(splat::Engine& engine, const splat::Gaussians& gaussians, const chain::Chain& chain,
                          const chain::States& states, const trajectory::Trajectory& base,
                          const capture::Camera& camera, int camera_index, const std::vector<double>& times,
                          const Options& options = {});

// The same in batches, in order, so that the memory in use does not grow with the number of frames.
void for_batches(splat::Engine& engine, const splat::Gaussians& gaussians, const chain::Chain& chain,
                 const chain::States& states, const trajectory::Trajectory& base, const capture::Camera& camera,
                 int camera_index, const std::vector<double>& times, const Options& options,
                 const std::function<void(std::vector<Frame>& batch)>& use);

// Whether the states cover `time`, which may lie outside their times by half of `interval` (s).
bool covered(const chain::States& states, double time, double interval);
// Median difference of consecutive `times` (s); 0 for fewer than two.
double median_interval(const std::vector<double>& times);

// Whole images of a frame, 0 outside the crop: RGB of 8 bits (clamped, rounded); mask, 255 where alpha >= 0.5, else 0;
// depth in m, 0 = none.
capture::Image8 color_image(const Frame& frame, const capture::Camera& camera);
capture::Image8 mask_image(const Frame& frame, const capture::Camera& camera);
std::vector<float> depth_image(const Frame& frame, const capture::Camera& camera);

// Whole images of many frames in one piece of memory each, image after image, row-major: for programs that draw into
// memory. Black, 0 and no depth where nothing is drawn.
struct Images {
  int count = 0, width = 0, height = 0;
  std::vector<std::uint8_t> rgb;   // count x height x width x 3
  std::vector<std::uint8_t> mask;  // count x height x width, 255 or 0
  std::vector<float> depth;        // count x height x width, m; empty unless asked for
};
// One image for each of `times`, s, also where the states do not cover it: then nothing is drawn.
Images images(splat::Engine& engine, const splat::Gaussians& gaussians, const chain::Chain& chain,
              const chain::States& states, const trajectory::Trajectory& base, const capture::Camera& camera,
              const std::vector<double>& times, const Options& options = {});

// The pixels of the undistorted image outside which no replica's alpha reaches 1/255.
// The result is not cut to the image. `motions` are those of chain::link_motions.
math::Rectangle reach(const splat::Gaussians& gaussians, const std::vector<math::Pose>& motions, const capture::Camera& camera);

}  // namespace chainsplat::render
