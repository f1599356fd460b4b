// chainsplat/masks.h - masks for a capture that has none, as files: made by our own means (masking.h) or by another
// program, written into the capture or into a folder of their own.
#pragma once
#include <functional>
#include <string>
#include <utility>
#include <vector>

#include "chainsplat/masking.h"

namespace chainsplat::pipeline {

// Another program's mask of one recorded frame (RGB, with its lens distortion): of the same size, gray or color, whose
// alpha does not count; 255 on the object, 0 elsewhere.
using MaskCommand =
    std::function<capture::Image8(const std::string& camera, int frame, const capture::Image8& picture)>;

struct MaskOptions {
  Path output;                 // folder for CAMERA/000000.png; empty: into the capture, where its "masks" keys say, or
                               // masks/CAMERA/%06d.png, which capture.json then names
  bool force = false;          // replace masks that are there
  capture::FrameRange frames;  // all, unless there is an `output`
  MaskCommand command;         // makes every mask; empty: our own means
  masking::Hints hints;        // for our own means
  Path preview;                // PNG of some frames of every camera with their masks' outlines; empty: none

  void check() const;
};

// The score of one mask, as masking.h tells it.
struct MaskScore {
  std::string camera;
  int frame = 0;
  double score = 0.0;
};

struct MaskResult {
  Path folder;                                            // of the masks: `output`, or "masks" in the capture
  masking::Summary summary;                               // of `command` only the numbers of frames and of empty masks
  std::vector<MaskScore> scores;                          // by our own means; also in scores.csv in `folder`
  std::vector<std::pair<std::string, double>> agreement;  // by camera, with `output`: mean IoU with the masks that the
                                                          // capture has; no entry where it has none
};

// Makes the masks of the capture (its folder or capture.json). Warns of those that are probably wrong. Reports in stage
// "mask". Throws InputError before anything is written where masks are there already, where they could not be written,
// where a link leads out of the folder, and as masking::make() does; WorkError where a mask of `command` is none: then
// the masks so far are kept.
MaskResult make_masks(const Path& capture, const MaskOptions& options, const core::Listener& listener = {});

}  // namespace chainsplat::pipeline
