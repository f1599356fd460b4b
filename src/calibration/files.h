// src/calibration/files.h - what a calibration leaves behind.
#pragma once
#include "bundle.h"
#include "look.h"

namespace chainsplat::calibration {

// Throws InputError where `out` is there already and may not be replaced.
void check_output(const Path& out, bool force);
// One frame of the camera, the one that fits worst, with the corners as found (green circles), as computed (red
// crosses) and their differences twenty times as long (yellow); all other corners as dots. Returns the file.
Path draw(const Path& out, const Recording& recording, const Bundle& bundle, int camera);
void write_calibration(const Path& out, const Calibration& calibration);

}  // namespace chainsplat::calibration
