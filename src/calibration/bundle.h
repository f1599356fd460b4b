// src/calibration/bundle.h - the joint problem: cameras, the board on the flange and the board's pose at every moment,
// as least squares in arrow form (mathematics.md 12.2). It sees corners and times, no images.
#pragma once
#include <optional>
#include <vector>

#include "chainsplat/calibration.h"
#include "chainsplat/solve.h"
#include "chainsplat/trajectory.h"
#include "tags.h"

namespace chainsplat::calibration {

// One corner of the board in one image.
struct Seen {
  math::Vector3 point;     // board's frame, m
  math::Vector2 pixel;     // recorded
  double deviation = 1.0;  // px, before the camera's own scale
};

struct View {
  int camera = 0, frame = 0;
  double time = 0.0;  // s, by the camera's clock
  std::vector<Seen> corners;
};

// What several cameras saw at one time.
struct Moment {
  std::vector<View> views;
  // Without a robot world_from_board; with one, how far the flange was from where the robot says, in the flange's
  // frame.
  math::Pose pose;
};

struct Bundle {
  std::vector<capture::Camera> cameras;  // with their poses
  std::vector<double> clocks;            // s, one per camera, added to the views' times
  std::vector<double> scales;            // one per camera: how much corners scatter more than their deviations
  std::vector<Moment> moments;
  math::Pose flange_from_board;
  const trajectory::Trajectory* robot = nullptr;          // world_from_flange; none: the board is moved by hand
  double robot_position = 1e-3, robot_rotation = 0.0015;  // m, rad: prior of Moment::pose, with a robot
  int held_camera = 0;  // without a robot: whose pose is the world, -1: the board's at `held_moment`
  int held_moment = -1;
};

// Unknowns of one camera in the shared part: fx fy cx cy k1 k2 p1 p2 k3, rotation (3), position (3), clock; behind all
// cameras those of the board on the flange: rotation, position. Those of a moment: rotation, position.
constexpr int kLensUnknowns = 9, kCameraUnknowns = 16, kPoseUnknowns = 6;

math::Pose board_in_world(const Bundle& bundle, const Moment& moment, const View& view);
// Recorded pixel of a point in the camera's frame; none behind it, or where the lens cannot see.
std::optional<math::Vector2> pixel_of(const capture::Camera& camera, const math::Vector3& point);
// The same with derivatives by the point (2x3) and by the lens unknowns (2x9).
std::optional<math::Vector2> pixel_of(const capture::Camera& camera, const math::Vector3& point,
                                      Eigen::Matrix<double, 2, 3>& by_point,
                                      Eigen::Matrix<double, 2, kLensUnknowns>& by_lens);

// Changes everything in `bundle` but scales and priors to fit the corners.
solve::Summary fit(Bundle& bundle, int steps);
// Sets the scales from the corners' scatter: by its median, or by its mean square where it is known how many degrees of
// freedom the unknowns take (`absorbed`).
void set_scales(Bundle& bundle, std::optional<double> absorbed = {});
// Covariance of the shared unknowns at the bundle's place, and how much of it each moment adds to the robot's errors:
// the mean over the moments of the squares of position and rotation, each axis, their covariance included.
struct Certainty {
  math::MatrixX covariance;
  double position_square = 0.0, rotation_square = 0.0;  // m^2, rad^2
  double absorbed = 0.0;                                // degrees of freedom of the corners that all unknowns take
};
Certainty certainty(const Bundle& bundle);

// Residuals of one view, px, 2 x corners; NaN where a corner is behind the camera. `depths`: of its corners, m.
math::MatrixX residuals(const Bundle& bundle, const Moment& moment, const View& view, std::vector<double>* depths);

}  // namespace chainsplat::calibration
