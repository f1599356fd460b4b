// src/capture/manifest.h - capture.json and the files it names: they are read, checked and counted, but no image is
// decoded here.
#pragma once
#include <optional>
#include <string>
#include <vector>
#include "chainsplat/capture.h"
#include "chainsplat/frame_pattern.h"
#include "chainsplat/in_memory.h"

namespace chainsplat::capture {

// The parts of an InputError.
struct Problem {
  std::string where, what, mend;
};

// What is wrong (load() throws the first problem) and what is doubtful (load() warns of each).
struct Findings {
  std::vector<Problem> problems;
  std::vector<std::string> doubts;
};

// A video, one image file per frame by a printf pattern, or pictures in memory.
struct ImageSource {
  bool video = false;
  Path file;                                      // the video
  FramePattern names;                             // paths of the image files
  const std::vector<Image8>* pictures = nullptr;  // in memory
  int frames = 0;
  Path frame_file(int frame) const { return names.file(frame); }  // the image file of a pattern
};

struct CameraSource {
  std::string where;  // for messages, like "capture.json: cameras[0]"
  Camera camera;
  ImageSource images;
  std::optional<ImageSource> masks, depth;
  double depth_scale = 0.0;  // m per unit
  double rate = 0.0;         // frames per second; 0 with timestamps
  double start = 0.0;        // s, time of the first frame
  std::optional<Path> timestamps;
  bool readout_given = false;  // and exact then
  double interval = 0.0;      // s, median time between frames
  double video_rate = 0.0;    // frames per second by the container, 0 = unknown
  std::vector<double> times;  // s, one per frame; empty after a problem
};

struct Manifest {
  Path file;                          // capture.json; in memory a name for messages
  Capture capture;                    // without views; without `base` where it could not be read
  std::vector<CameraSource> cameras;  // in the order of capture.cameras
};

// Reads as much as it can and collects the findings. `masked` false: mask files are ignored. `camera`: read only this
// one, unless empty. Throws InputError when capture.json itself cannot be read. The pictures of a recording in memory
// are referred to.
Manifest read_manifest(const Path& path, const std::string& camera, bool masked, Findings& findings);
Manifest read_manifest(const InMemory& recording, const std::string& camera, bool masked, Findings& findings);

// Throws the first problem, if there is one, with the number of the others.
void throw_first(const Findings& findings);

// Loads the views of all cameras for the frames from options.first to options.last (src/capture/views.cpp); `recorded`
// is left empty unless LoadOptions::recorded_too. Throws InputError for images that cannot be read.
void load_views(const Manifest& manifest, const LoadOptions& options, Findings& findings,
                std::vector<PackedView>& views, std::vector<PackedView>& recorded);

// Adds recorded depth to views that were loaded without it; no camera may have lens distortion.
void add_depth(const Manifest& manifest, std::vector<PackedView>& views);

}  // namespace chainsplat::capture
