// src/importing/clock.h - when a camera began to record, found from its masks: the grasp must lie where the rope is.
#pragma once
#include <optional>
#include <string>
#include <vector>

#include "media.h"

namespace chainsplat::importing {

// Rope pixels of one frame (2 x count, px, at most kMostPoints), of a recording without lens distortion.
struct SeenRope {
  double time = 0.0;  // s, from frame 0
  Eigen::Matrix2Xf pixels;
};
// Of up to kClockFrames frames, evenly spaced.
std::vector<SeenRope> seen_ropes(const Media& masks, const MaskRule& rule, double rate, const capture::Camera& camera,
                                 const Undistortion* lens);

// The time of frame 0 by the base's clock at which the projected grasp comes nearest to the masks, over all starts at
// which the base covers most of the frames. None where the motion does not tell one start from others.
struct FoundStart {
  double start = 0.0;  // s
  double miss = 0.0;   // px, RMS of the grasp's distance from the mask
};
std::optional<FoundStart> find_start(const std::vector<SeenRope>& seen, const capture::Camera& camera,
                                     const trajectory::Trajectory& base);

}  // namespace chainsplat::importing
