// frame_source.h - where the frames of a rope being followed come from: a capture, a video file, a V4L2 device or raw
// frames on standard input.
#pragma once
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "chainsplat/capture.h"

namespace chainsplat::tools {

// One moment. A recorded capture has views, everything else a picture.
struct LiveFrame {
  int frame = 0;
  double time = 0.0;                 // s
  std::vector<capture::View> views;  // undistorted crops with masks, of one camera or several at nearly one time
  capture::Image8 picture;  // whole, RGB as recorded, of the first camera; empty for a capture unless asked for
  double arrived = 0.0;     // core::seconds_now() when it was decoded
};

struct SourceRequest {
  std::string camera;       // CAPTURE, CAPTURE:NAME; with `calibration` a video file, a device under /dev or "-"
  std::string calibration;  // camera object as in capture.json
  double rate = 0.0;        // frames a second; 0: the calibration's, else the video's
  std::string start;        // s, of the first frame, or "unix": a device's stamps in Unix time; "": the calibration's
  int first = 0, last = -1;
  bool pictures = false;  // whole frames of a capture too (its first camera)
};

struct FrameSource {
  std::vector<capture::Camera> cameras;
  std::optional<trajectory::Trajectory> base;  // a capture's own
  bool masked = false;                         // the frames have views
  // The next frame; false at the end. Throws InputError or WorkError where the frames end in another way.
  std::function<bool(LiveFrame&)> next;
};

// Throws InputError.
FrameSource open_frames(const SourceRequest& request);

// What is not black in a picture, undistorted and cropped; the mask of a video that was masked before.
capture::View bright_view(const capture::Image8& picture, const capture::Camera& camera);

}  // namespace chainsplat::tools
