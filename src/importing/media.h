// src/importing/media.h - frames of a camera or its masks, as a video or as images of any naming, into a capture's
// folder.
#pragma once
#include <functional>
#include <string>
#include <vector>

#include "chainsplat/capture.h"
#include "lens.h"

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

// Calls use(frame, image) for the frames of `take`, in order.
void for_each_frame(const Media& media, const Take& take, const std::function<void(int, const capture::Image8&)>& use);

// Puts the frames into `folder` and returns how capture.json names them: copies where they can stay as they are, PNG
// where a video is cut or the lens is taken out.
std::string write_frames(const Media& media, const Take& take, const Undistortion* lens, const Path& folder,
                         const std::string& name);

// What is the rope in masks: found from the values of all of them.
struct MaskRule {
  bool alpha = false;  // the alpha channel counts, else the brightest color
  int label = -1;      // this value alone is the rope; -1: from `threshold` on
  int threshold = 128;
  bool inverted = false;  // the rope is dark
  std::string note;
};
MaskRule mask_rule(const Media& media, const Take& take, const std::string& label, bool alpha);
capture::Image8 binary_mask(const capture::Image8& image, const MaskRule& rule);  // 255 where the rope is, else 0
std::string write_masks(const Media& media, const Take& take, const MaskRule& rule, const Undistortion* lens,
                        const Path& folder, const std::string& name);

}  // namespace chainsplat::importing
