// src/calibration/start.h - where the joint fit begins: closed forms that are good to a few percent
// (mathematics.md 12.1).
#pragma once
#include <optional>
#include <vector>

#include "bundle.h"

namespace chainsplat::calibration {

// Focal length by what the board's homographies say of a camera with square pixels and its principal point in the
// middle (Zhang 2000); none where they do not tell, as without tilt.
std::optional<double> focal_length(const std::vector<const View*>& views, int width, int height);

// camera_from_board of one view, by its homography; the camera's lens is known. None for fewer than four corners or
// where they lie on a line.
std::optional<math::Pose> pose_by_homography(const View& view, const capture::Camera& camera);

// The pose to which most of the others are near: angles count as `arm` m for each radian.
math::Pose middle_pose(const std::vector<math::Pose>& poses, double arm);

// A view with its pose, for what follows.
struct Placed {
  double time = 0.0;  // s, by the camera's clock
  math::Pose camera_from_board;
};

// The clock at which the turns of the board are the robot's: they are the same in every frame, whatever the unknown
// poses are. Sought in [from, to]. None where the board hardly turns or another clock does as well.
std::optional<double> clock_by_turns(const std::vector<Placed>& views, const trajectory::Trajectory& robot, double from,
                                     double to);

// world_from_camera and flange_from_board by robot(t + clock) flange_from_board = world_from_camera camera_from_board:
// rotations by a singular value decomposition (Shah 2013), then positions by linear least squares; views that do not
// agree are left out.
struct HandEye {
  math::Pose world_from_camera, flange_from_board;
  double miss = 0.0;  // m, median distance between both sides
};
std::optional<HandEye> hand_eye(const std::vector<Placed>& views, const trajectory::Trajectory& robot, double clock);

}  // namespace chainsplat::calibration
