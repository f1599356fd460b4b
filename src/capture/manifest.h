// src/capture/manifest.h - capture.json and what it names: read, checked, counted; no image is decoded here.
#pragma once
#include <optional>
#include <string>
#include <vector>
#include "chainsplat/capture.h"

namespace chainsplat::capture {

struct Problem {  // the parts of an InputError
  std::string where, what, mend;
};

// What is wrong (load() throws the first) and what is odd (load() warns).
struct Findings {
  std::vector<Problem> problems;
  std::vector<std::string> doubts;
};

// A video, or one image file a frame by a printf pattern.
struct ImageSource {
  bool video = false;
  Path file;                   // the video
  std::string prefix, suffix;  // of an image's path
  int digits = 0;              // at least so many, with zeros in front
  int frames = 0;
  Path frame_file(int frame) const;  // of a pattern
};

struct CameraSource {
  std::string where;  // "capture.json: cameras[0]"
  Camera camera;
  ImageSource images;
  std::optional<ImageSource> masks, depth;
  double depth_scale = 0.0;  // m a unit
  double rate = 0.0;         // frames a second; 0 with timestamps
  double start = 0.0;        // s
  std::optional<Path> timestamps;
  double interval = 0.0;    // s, median between frames
  double video_rate = 0.0;  // frames a second as the container says, 0 = unknown
  std::vector<double> times;
};

struct Manifest {
  Path file;                          // capture.json
  Capture capture;                    // all but views; `base` when it could be read
  std::vector<CameraSource> cameras;  // as capture.cameras
};

// Reads as far as it can. `masked` false: masks are not looked for. `camera`: only this one when not empty.
Manifest read_manifest(const Path& path, const std::string& camera, bool masked, Findings& findings);

// src/capture/views.cpp: the views of all cameras for options.first, options.last.
// Throws InputError for images that cannot be read.
void load_views(const Manifest& manifest, const LoadOptions& options, Findings& findings, std::vector<View>& views);

// Recorded depth into views that were loaded without; no camera has lens distortion.
void add_depth(const Manifest& manifest, std::vector<View>& views);

}  // namespace chainsplat::capture
