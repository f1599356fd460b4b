// src/importing/media.h - frames of a camera or its masks into a capture's folder.
#pragma once
#include <string>

#include "chainsplat/image_model.h"
#include "chainsplat/media.h"
#include "lens.h"

namespace chainsplat::importing {

// Puts the frames into `folder` and returns how capture.json names them: copies where they can stay as they are, PNG
// where a video is cut or the lens is taken out.
std::string write_frames(const Media& media, const Take& take, const Undistortion* lens, const Path& folder,
                         const std::string& name);

// What is the rope in masks: found from the values of all of them.
struct MaskRule {
  bool alpha = false;  // the alpha channel counts, else the brightest color
  int label = -1;      // this value alone is the rope; -1: from `threshold` on
  int threshold = image_model::kObjectMask;
  bool inverted = false;  // the rope is dark
  std::string note;
};
MaskRule mask_rule(const Media& media, const Take& take, const std::string& label, bool alpha);
capture::Image8 binary_mask(const capture::Image8& image, const MaskRule& rule);  // 255 where the rope is, else 0
std::string write_masks(const Media& media, const Take& take, const MaskRule& rule, const Undistortion* lens,
                        const Path& folder, const std::string& name);

}  // namespace chainsplat::importing
