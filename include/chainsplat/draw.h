// chainsplat/draw.h - a twin drawn into files through the cameras of a capture: a folder of pictures, or a video.
#pragma once
#include <string>
#include <utility>
#include <vector>

#include "chainsplat/layout.h"

namespace chainsplat::pipeline {

struct DrawOptions {
  Path output;         // folder for CAMERA/000000.png, or a video that ends in .mp4
  std::string camera;  // of the capture, this one alone; empty: all, but a video shows one
  Path states;         // motion, states.csv, or "-" for standard input; empty: the recognized states
  Path base;           // its base motion, TUM; empty: the capture's own
  render::Layout layout = render::Layout::drawn;
  bool mask = false;         // also 000000.mask.png; no video
  bool depth = false;        // also 000000.depth.exr; no video
  bool undistorted = false;  // leave the lens distortion out; `layout` drawn only
  bool force = false;        // write into a folder that is not empty
  std::string device;        // Vulkan device, its number or a part of its name; empty: chosen

  void check() const;
};

struct DrawResult {
  std::vector<std::pair<std::string, int>> frames;  // by camera: how many were written
};

// Draws the twin in `run` at the times of the capture's cameras that the states cover. A motion with a base of its own
// is drawn until it ends, also after the recording, and one of quite other times from its beginning on. Reports in
// stages "write CAMERA". Throws InputError before anything is written where the states cover no frame of a camera.
DrawResult draw(const Path& run, const Path& capture, const DrawOptions& options, const core::Listener& listener = {});

}  // namespace chainsplat::pipeline
