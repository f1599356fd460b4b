// chainsplat/eval.h - how well states and Gaussians explain a capture (SPEC 9, INTERFACE 4).
#pragma once
#include <string>
#include <vector>
#include "chainsplat/capture.h"
#include "chainsplat/render.h"
#include "chainsplat/twin.h"

namespace chainsplat::eval {

struct FrameMetrics {           // NaN where a metric does not apply (no depth, no truth)
  int camera = 0, frame = 0;
  double time = 0, psnr = 0, psnr_object = 0, ssim = 0, iou = 0, chamfer = 0, centerline_rms = 0, tip_rms = 0;
};

struct Metrics {
  FrameMetrics mean;                        // centerline_rms and tip_rms: root mean square over frames
  std::vector<std::string> camera_names;
  std::vector<FrameMetrics> cameras;        // mean by camera
  std::vector<FrameMetrics> frames;
};

// Draws the states through every camera of the capture (loaded with undistort = false, depth when present) and compares.
Metrics evaluate(splat::Engine& engine, const splat::Gaussians& gaussians, const chain::Chain& chain,
                 const chain::States& states, const capture::Capture& recorded);

// The M object of metrics.json as JSON text.
std::string to_json(const Metrics& metrics);

// SSIM of SPEC 2.7 over a full image of which only a crop is not black in either picture; double precision, host.
double ssim(const std::vector<float>& a_rgb, const std::vector<float>& b_rgb, int width, int height, double full_pixels);

}  // namespace chainsplat::eval
