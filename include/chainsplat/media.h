// chainsplat/media.h - frames of a camera as a laboratory has them: a video, a folder of images or a pattern, whatever
// they are called, and the times at which they were taken.
#pragma once
#include <functional>
#include <string>
#include <vector>

#include "chainsplat/capture.h"

namespace chainsplat::importing {

struct Media {
  Path source;         // for messages
  bool video = false;  // `source` is a video, else `files` are its frames in order
  std::vector<Path> files;
  int frames = 0, width = 0, height = 0, channels = 0;
  double rate = 0.0;  // frames per second by a video's header; 0: unknown
};
// A video, a folder whose images are taken in the order of the numbers in their names, or a pattern with one %d.
// Throws InputError.
Media open_media(const Path& path);

// Frames [first, last) of a recording that a capture takes.
struct Take {
  int first = 0, last = 0;
};

// Calls use(frame, image) for the frames of `take`, in order. Throws InputError where a frame is missing or damaged.
void for_each_frame(const Media& media, const Take& take, const std::function<void(int, const capture::Image8&)>& use);

// Times from a file: one per line, or a table's column of times. In s. `unit` empty: by name or size. Throws
// InputError.
std::vector<double> read_stamps(const Path& file, const std::string& key, const std::string& unit, std::string& note);

}  // namespace chainsplat::importing
