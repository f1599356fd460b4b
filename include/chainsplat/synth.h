// chainsplat/synth.h - a capture drawn from a twin: for tests and what-if (INTERFACE 1, 2).
#pragma once
#include <string>
#include "chainsplat/capture.h"
#include "chainsplat/render.h"
#include "chainsplat/twin.h"

namespace chainsplat::synth {

struct Options {
  std::string name = "synth";  // of the capture
  bool video = true;           // cam0.mp4, lossy as a real recording; false: cam0/000000.png
  bool depth = true;           // of the Gaussians, 0.1 mm steps
};

// Writes capture.json, images, masks, depth, base.tum and truth/centreline.csv (49 points a frame of the first camera,
// the layout that capture::load_true_centerline reads) into `folder`, which is made. Cameras and their frame times,
// base, table and gravity are those of `scene` (loaded without images); frames are those that `states` cover, numbered
// from 0. Images are masked already: black outside the rope. Throws InputError when no frame is covered, WorkError when
// it cannot write.
void write(splat::Engine& engine, const twin::Twin& twin, const chain::States& states, const capture::Capture& scene,
           const Path& folder, const Options& options = {});

}  // namespace chainsplat::synth
