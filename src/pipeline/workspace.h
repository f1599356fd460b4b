// workspace.h - what one training leaves for the next in the same process.
#pragma once
#include <optional>
#include <string>
#include <vector>

#include "pipeline/stages.h"
#include "src/core/said.h"

namespace chainsplat::pipeline {

struct Workspace {
  std::string selector;  // that the device was opened with
  gpu::DevicePtr device;

  std::string capture_key;  // which capture, of which state, and what of it was read; empty: nothing is kept
  capture::Capture read;    // as given
  std::vector<core::Said> said_reading;

  // as corrected, without the views, whose pixels and places stay what they were
  std::string correction_key;  // what was taken as given; empty: not corrected
  capture::Capture mended;
  Corrected corrected;
  std::vector<core::Said> said_correcting;
};

}  // namespace chainsplat::pipeline
