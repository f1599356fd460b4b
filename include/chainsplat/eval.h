// chainsplat/eval.h - how well states and Gaussians explain a capture (SPEC 9, INTERFACE 4).
#pragma once
#include <string>
#include <vector>
#include "chainsplat/capture.h"
#include "chainsplat/render.h"
#include "chainsplat/twin.h"

namespace chainsplat::eval {

struct FrameMetrics {  // NaN where a metric does not apply (no depth, no truth, nothing in the mask)
  int camera = 0, frame = 0;
  double time = 0, psnr = 0, psnr_object = 0, ssim = 0, iou = 0, chamfer = 0, centerline_rms = 0, tip_rms = 0;
};

// dB of two equal images, and the most that any image gets: a mean needs a number.
inline constexpr double kMostPsnr = 100.0;

struct Metrics {
  FrameMetrics mean;  // over the frames where a metric applies; centerline_rms and tip_rms: root mean square
  std::vector<std::string> camera_names;
  std::vector<FrameMetrics> cameras;  // the same by camera
  std::vector<FrameMetrics> frames;
  int empty_clouds = 0;  // frames with depth whose chamfer is left out: no rendered or no true point
};

// Draws the states through every camera of the capture (loaded with undistort = false, depth when present) and
// compares. Frames that the states do not cover are left out, with a warning. Throws InputError when none is left.
Metrics evaluate(splat::Engine& engine, const splat::Gaussians& gaussians, const chain::Chain& chain,
                 const chain::States& states, const capture::Capture& recorded);

// One frame against its view (recorded pixels both): all but centerline_rms and tip_rms.
FrameMetrics compare(const render::Frame& drawn, const capture::View& view, const capture::Camera& camera);

// The M object of metrics.json as JSON text; metrics that do not apply are left out. Beside INTERFACE 4's keys
// "empty_clouds" where it is not 0.
std::string to_json(const Metrics& metrics);

// SSIM of SPEC 2.7 over a full image of which only a crop is not black in either picture; double precision, host. RGB
// interleaved, values in [0, 1]. The crop must hold everything that is not black and 5 px around it, as far as the
// image goes.
double ssim(const std::vector<float>& a_rgb, const std::vector<float>& b_rgb, int width, int height,
            double full_pixels);

// Symmetric mean distance of two clouds (columns, m), SPEC 9. NaN when one is empty.
double chamfer(const math::MatrixX& p, const math::MatrixX& q);

}  // namespace chainsplat::eval
