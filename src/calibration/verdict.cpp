#include "verdict.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <numbers>

namespace chainsplat::calibration {

namespace {

// Where a figure is a doubt, and from where on the calibration must not be used. Half a degree and 5 mm take a twin's
// overlap with its masks from 0.96 to 0.55 (guide.md 1).
struct Limit {
  double doubt, bad;
};
constexpr Limit kResidual{0.5, 1.5};      // px
constexpr Limit kFocal{0.002, 0.01};      // relative
constexpr double kEdge = 1.0;             // px; a doubt, since the rope need not be there
constexpr Limit kPosition{0.001, 0.005};  // m
constexpr Limit kRotation{0.1, 0.5};      // degrees
constexpr Limit kRobotPosition{0.0015, 0.005};
constexpr Limit kRobotRotation{0.2, 1.0};  // degrees
constexpr double kClock = 0.003;           // s
constexpr int kFewViews = 15, kTooFewViews = 4;
constexpr double kTilted = 20.0, kTurned = 10.0;  // degrees
constexpr double kDisagree = 1.5, kApart = 0.1;   // ratio to the camera alone, and px
constexpr double kDegrees = 180.0 / std::numbers::pi;

std::string text(const char* format, auto... values) {
  char out[500];
  std::snprintf(out, sizeof out, format, values...);
  return out;
}

}  // namespace

bool Calibration::trusted() const {
  return std::none_of(findings.begin(), findings.end(), [](const Finding& f) { return f.bad; });
}

void judge(Calibration& calibration, const std::vector<Evidence>& evidence, double other_turn) {
  const auto say = [&](bool bad, const char* code, const std::string& camera, const std::string& words) {
    calibration.findings.push_back({bad, code, camera, words});
  };
  const bool one_axis = calibration.robot && other_turn * kDegrees < kTurned;
  if (one_axis)
    say(true, "one_axis", "",
        text("the flange turned about one axis only (%.0f degrees about others), which leaves the cameras' places "
             "undetermined: turn the board about two axes by 30 degrees or more",
             other_turn * kDegrees));
  for (std::size_t c = 0; c < calibration.cameras.size(); ++c) {
    const CameraResult& camera = calibration.cameras[c];
    const std::string& name = camera.camera.name;
    const Deviation& d = camera.deviation;
    if (camera.views < kFewViews)
      say(camera.views < kTooFewViews, "few_views", name,
          text("%s: %d different %s of the board: show it in 20 or more places", name.c_str(), camera.views,
               camera.views == 1 ? "view" : "views"));
    if (camera.tilt * kDegrees < kTilted)
      say(false, "no_tilt", name,
          text(
              "%s: the board was tilted by %.0f degrees at most: tilt it by 30 to 45 degrees to each side, which tells "
              "the focal length",
              name.c_str(), camera.tilt * kDegrees));
    const double focal = std::max(d.fx / camera.camera.fx, d.fy / camera.camera.fy);
    if (!(focal < kFocal.doubt))
      say(!(focal < kFocal.bad), "focal", name,
          text("%s: the focal length is known to %.2g %% only: tilt the board, and show it near and far", name.c_str(),
               100.0 * focal));
    if (!(camera.edge_deviation < kEdge)) {
      std::string regions;
      for (const std::string& region : evidence[c].uncovered) regions += (regions.empty() ? "" : ", ") + region;
      say(false, "uncovered", name,
          text("%s: a point near the image's edge is off by %.2g px (one standard deviation)%s%s", name.c_str(),
               camera.edge_deviation,
               regions.empty() ? ": show the board in all corners of the image"
                               : ": the board was never seen in the image's ",
               regions.empty() ? "" : (regions + "; hold it there").c_str()));
    }
    if (!(camera.rms < kResidual.doubt))
      say(!(camera.rms < kResidual.bad), "residual", name,
          text("%s: corners miss by %.2g px (RMS): look for a board that bends, blur, a rolling shutter, tags of "
               "another size or gap than the file says, a lens beyond the five coefficients",
               name.c_str(), camera.rms));
    if (!calibration.robot && camera.placed && calibration.cameras.size() > 1 &&
        camera.rms > kDisagree * evidence[c].alone_rms + kApart)
      say(false, "disagree", name,
          text("%s: corners miss by %.2g px together with the other cameras and by %.2g px alone: hold the board still "
               "while it is seen, or give the frames' times",
               name.c_str(), camera.rms, evidence[c].alone_rms));
    if (!camera.placed) {
      say(true, "no_pose", name,
          text("%s: has no pose, since it never saw the board together with another camera: show it to both at a time",
               name.c_str()));
      continue;
    }
    if (calibration.robot && !(d.clock < kClock))
      say(false, "clock", name,
          text("%s: its clock is known to %.2g ms only: let the robot move and turn the board while the camera sees it",
               name.c_str(), 1e3 * d.clock));
    const double position = d.position.maxCoeff(), rotation = d.rotation.maxCoeff() * kDegrees;
    if (!one_axis && !(position < kPosition.doubt && rotation < kRotation.doubt))
      say(!(position < kPosition.bad && rotation < kRotation.bad), "pose", name,
          text("%s: its pose is known to %.2g mm and %.2g degrees only: show the board nearer, in more places, %s",
               name.c_str(), 1e3 * position, rotation,
               calibration.robot ? "turned about several axes" : "to several cameras at a time"));
  }
  if (!calibration.robot) return;
  const double position = calibration.robot_position, rotation = calibration.robot_rotation * kDegrees;
  if (!(position < kRobotPosition.doubt && rotation < kRobotRotation.doubt))
    say(!(position < kRobotPosition.bad && rotation < kRobotRotation.bad), "robot", "",
        text("the robot's poses and the board's scatter by %.2g mm and %.2g degrees: look for a board that is loose on "
             "the gripper, commanded instead of measured poses, stamps that jitter, units",
             1e3 * position, rotation));
}

}  // namespace chainsplat::calibration
