// chainsplat/in_memory.h - a capture whose pictures are in memory, as another program has just recorded them.
//
// Everything else about it is said, and checked, as in capture.json. pipeline::train() takes one, too.
#pragma once
#include <string>
#include <vector>

#include "chainsplat/capture.h"
#include "chainsplat/trajectory.h"

namespace chainsplat::capture {

// What one camera recorded.
struct CameraFrames {
  std::vector<double> times;   // s, increasing
  std::vector<Image8> images;  // of the camera's size as recorded, RGB; one per time
  std::vector<Image8> masks;   // one channel, 128 and more: the object; none where images are black around it
};

struct InMemory {
  std::string document;  // capture.json (formats.md 1), which names no file and says no rate
  std::vector<trajectory::Sample> base;
  std::vector<CameraFrames> cameras;  // in the document's order
};

// As of a folder. Throws InputError at a problem.
Capture load(const InMemory& recording, const LoadOptions& options = {});
// For evaluation, as of a folder. `loaded` must come from the same recording and options.
Capture load_recorded(Capture loaded, const InMemory& recording, LoadOptions options = {});

}  // namespace chainsplat::capture
