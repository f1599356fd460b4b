// chainsplat/encode.h - pictures into files for people, one at a time: videos that need not fit into memory, and JPEG.
//
// Part of `capture`, whose Image8 it takes.
#pragma once
#include <memory>
#include <string>
#include "chainsplat/capture.h"

namespace chainsplat::capture {

// Writes a video as write_video() does, frame by frame. All throw WorkError.
class VideoWriter {
 public:
  VideoWriter(const Path& file, double rate);  // frames per second; nothing is written yet
  ~VideoWriter();                              // a file that is not finished is removed
  void add(const Image8& frame);               // RGB or RGBA, all of one size
  void finish();                               // after at least one frame: `file` is there, whole

 private:
  struct Implementation;
  std::unique_ptr<Implementation> implementation_;
};

// Returns the bytes of a JPEG file of an RGB or gray image; `quality` is from 1 to 100.
std::string jpeg(const Image8& image, int quality);

}  // namespace chainsplat::capture
