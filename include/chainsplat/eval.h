// chainsplat/eval.h - metrics of how well Gaussians and states reproduce a capture (mathematics.md 9, formats.md 2.7).
//
// It draws the states through the cameras of the capture and compares the pictures with the recorded, masked images,
// and the centerlines with the truth where the capture has one. Colors are in [0, 1], distances in m.
#pragma once
#include <string>
#include <vector>
#include "chainsplat/capture.h"
#include "chainsplat/render.h"
#include "chainsplat/twin.h"

namespace chainsplat::eval {

class LpipsTrunk;  // lpips.h

struct FrameMetrics {  // a metric that does not apply is NaN (no depth, no truth, no trunk)
  int camera = 0, frame = 0;
  double time = 0, psnr = 0, psnr_object = 0, ssim = 0, lpips = 0, iou = 0, chamfer = 0, centerline_rms = 0,
         tip_rms = 0, shape_rms = 0;
};

// dB; the PSNR of two equal images, and the most that any image gets, because a mean needs a finite number.
inline constexpr double kMostPsnr = 100.0;

struct Metrics {
  FrameMetrics mean;  // over the frames to which each metric applies; centerline_rms and tip_rms: root mean square
  std::vector<std::string> camera_names;
  std::vector<FrameMetrics> cameras;  // the same per camera
  std::vector<FrameMetrics> frames;
  int empty_clouds = 0;  // number of frames with depth but without a Chamfer distance: no rendered or no true point
};

// Draws the states through every camera of the capture, whose views must have recorded pixels and, for the Chamfer
// distance, depth, and compares; with `trunk` by LPIPS, too. Frames that the states do not cover are left out with a
// warning; throws InputError if none is left, for undistorted pixels, and for cameras that are too small for LPIPS.
Metrics evaluate(splat::Engine& engine, const splat::Gaussians& gaussians, const chain::Chain& chain,
                 const chain::States& states, const capture::Capture& recorded, const LpipsTrunk* trunk = nullptr);

// All metrics of one frame but those of the centerline; both pictures in recorded pixels. LPIPS with `trunk` only.
FrameMetrics compare(const render::Frame& drawn, const capture::View& view, const capture::Camera& camera,
                     const LpipsTrunk* trunk = nullptr);

// The object M of metrics.json (formats.md 2.7) as JSON text, without metrics that do not apply; and "empty_clouds" if
// it is not 0.
std::string to_json(const Metrics& metrics);

// Mean SSIM (mathematics.md 2.7) of two images of `full_pixels` pixels, of which both are black outside a crop; on the
// host, in double. The arguments hold the crop of width x height: interleaved RGB, values in [0, 1]. It must contain
// everything that is not black and a margin of 5 px around it, except beyond the image's border.
double ssim(const std::vector<float>& a_rgb, const std::vector<float>& b_rgb, int width, int height,
            double full_pixels);

// Chamfer distance (mathematics.md 9) of two clouds, 3 x count each, in m. NaN if one is empty.
double chamfer(const math::MatrixX& p, const math::MatrixX& q);

}  // namespace chainsplat::eval
