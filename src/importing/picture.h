// src/importing/picture.h - what a calibration says, drawn into the first frame: by eye one sees at once what is wrong.
#pragma once
#include "chainsplat/capture.h"

namespace chainsplat::importing {

struct Scene {
  math::Pose world_from_base;           // at the frame's time
  math::Vector3 direction;              // base frame
  double length = 0.0, diameter = 0.0;  // m
  std::optional<capture::Table> table;
};
// The image with the base frame's axes (x red, y green, z blue; a quarter of the rope long), the rope's length straight
// along its direction (yellow, with a mark at every quarter), and a grid on the table of two rope lengths (white).
capture::Image8 picture(const capture::Image8& frame, const capture::Camera& camera, const Scene& scene);

}  // namespace chainsplat::importing
