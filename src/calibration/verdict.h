// src/calibration/verdict.h - what a calibration is worth, in words.
#pragma once
#include "chainsplat/calibration.h"

namespace chainsplat::calibration {

// What only the fit knows of a camera.
struct Evidence {
  double alone_rms = 0.0;              // px, of the camera fitted by itself
  std::vector<std::string> uncovered;  // regions of the image without a corner: "upper left"
};
// `other_turn`: rad, how much the flange turned about other axes than the one that it turned about most.
void judge(Calibration& calibration, const std::vector<Evidence>& evidence, double other_turn);

}  // namespace chainsplat::calibration
