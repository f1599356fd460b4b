// src/capture/camera_reader.h - cameras as capture.json describes them.
#pragma once
#include <string>

#include "src/capture/manifest.h"
#include "src/capture/object_reader.h"

namespace chainsplat::capture {

// Reads a camera and where its frames lie, which are not looked at. `where`: the object's place, for later messages.
CameraSource read_camera(const ObjectReader& reader, const std::string& where, const Path& folder);
// Of a camera whose frames are in memory: where it names files or a rate, that is a problem.
CameraSource read_camera(const ObjectReader& reader, const std::string& where, const CameraFrames& frames);

}  // namespace chainsplat::capture
