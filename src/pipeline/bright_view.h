#pragma once
#include "chainsplat/capture.h"

namespace chainsplat::pipeline {

// What is not black in a picture, undistorted and cropped; the mask of a video that was masked before.
capture::View bright_view(const capture::Image8& picture, const capture::Camera& camera);

}  // namespace chainsplat::pipeline
