// src/importing/calibration.h - calibrations of other programs: a camera's optics and its pose, in our conventions.
#pragma once
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "chainsplat/importing.h"
#include "lens.h"

namespace chainsplat::importing {

// Which way a pose that a file holds maps. `open`: the file does not tell, and the recording decides.
enum class Direction { world_from_camera, camera_from_world, open };

struct FoundPose {
  math::Pose matrix;  // as it stands in the file, m or whatever its unit is
  Direction direction = Direction::open;
  Axes axes = Axes::opencv;
  std::string where;  // for messages: file and key
};

struct Calibration {
  std::string format;             // "OpenCV", "Kalibr camchain", ...
  int width = 0, height = 0;      // px; 0: the file does not say
  Lens lens;                      // the center is already in our pixels (formats.md 1.3)
  bool half_pixel_added = false;  // the source counts pixel centers from (0, 0)
  std::optional<double> readout;  // s, Camera::readout
  std::optional<FoundPose> pose;
  // Cameras of one rig, whose poses are known to each other: the frame they are given in, by a name of its own.
  std::string rig;
  std::optional<math::Pose> rig_from_camera;
};

// Reads the calibration of `camera` from `source`, whose key names a part of the file. Throws InputError, for an
// unknown format with the list of those that are known.
Calibration read_calibration(const Source& source, const std::string& camera);

// Reads a pose alone: a calibration's, a 4x4 or 3x4 matrix, 'x y z qx qy qz qw' (with a stamp in front: TUM).
FoundPose read_pose(const Source& source, const std::string& camera);

// COLMAP's model in `folder`, text or binary; `image` names one of its images, or a part of its name.
bool is_colmap(const Path& folder);
Calibration read_colmap(const Path& folder, const std::string& image, const std::string& camera);

// A rotation and translation from 12 or 16 numbers; none where it is no rigid motion.
std::optional<math::Pose> rigid(const math::MatrixX& matrix);
std::optional<math::Pose> rigid(const math::Vector3& translation, const Eigen::Quaterniond& rotation);

}  // namespace chainsplat::importing
