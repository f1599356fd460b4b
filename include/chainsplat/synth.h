// chainsplat/synth.h - draws a capture from a twin, with its truth, for tests and what-if studies (formats.md 5.6). The
// result is a capture folder like that of a real recording (capture.h), which every stage can read.
#pragma once
#include <string>
#include "chainsplat/capture.h"
#include "chainsplat/render.h"
#include "chainsplat/twin.h"

namespace chainsplat::synth {

struct Options {
  std::string name = "synth";  // of the capture
  bool video = true;           // cam0.mp4, lossy like a real recording; false: cam0/000000.png
  bool depth = true;           // depth images of the Gaussians, in steps of 0.1 mm
};

// Writes capture.json, images, masks, depth, base.tum and truth/centreline.csv into `folder`, which is created. The
// truth has 49 points per frame of the first camera, in the layout that capture::load_true_centerline reads. Cameras
// with their frame times and the base are those of `scene` (loaded without images), table and gravity those of the twin
// where it has them. The frames are those that `states` cover, numbered from 0; the images are already masked: black
// outside the rope. Throws InputError if no frame of a camera is covered, WorkError if a file cannot be written.
void write(splat::Engine& engine, const twin::Twin& twin, const chain::States& states, const capture::Capture& scene,
           const Path& folder, const Options& options = {});

}  // namespace chainsplat::synth
