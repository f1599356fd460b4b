// chainsplat/report.h - a twin as one page for a browser: a 3-D replay, the verdict, metrics, angles, identified
// numbers (formats.md 5.9).
//
// The page is one HTML text without anything outside of it. Its sources are src/report/page/; the data stand in it as
// JSON with binary arrays in base64. Names from files are shown as text and never become markup. It draws with the
// program's own image model, but pinhole cameras: without the distortion of a lens.
#pragma once
#include <nlohmann/json.hpp>
#include <optional>
#include <string>
#include <vector>

#include "chainsplat/capture.h"
#include "chainsplat/trajectory.h"
#include "chainsplat/twin.h"

namespace chainsplat::report {

// A number as people know it: bending stiffness instead of the logarithm of a joint's.
struct Quantity {
  std::string name, unit, note;
  double value = 0.0;           // in `unit`
  std::optional<double> error;  // one standard deviation; none: not estimated
};
// What identification found. Empty before it.
std::vector<Quantity> identified(const twin::Twin& twin);

// Standard deviations of the rollout's angles at its times, rad, by the covariance of what was identified: first order,
// within the model. Empty where there is no covariance, and for the paper's integrator, whose steps have no
// derivatives.
std::vector<math::VectorX> rollout_deviations(const twin::Twin& twin, const trajectory::Trajectory& base);

// What a camera saw, small: undistorted pictures as JPEG.
struct Video {
  std::string camera;
  std::vector<double> times;       // s
  std::vector<std::string> jpegs;  // bytes, one a time
};
// Reads the frames of a camera within the times of the twin's states; `corrections` mend their times. Throws InputError
// where the capture has no such camera.
Video read_video(const Path& capture, const std::string& camera, const twin::Twin& twin);

struct Contents {
  twin::Twin twin;  // with `states.covariance` where it is known
  trajectory::Trajectory base;
  // Of the capture, as corrected: the cameras and the times of their frames; none: the page has a free view only.
  std::vector<capture::Camera> cameras;
  std::vector<std::vector<double>> times;
  nlohmann::ordered_json metrics;  // as metrics.json has them; null: not evaluated
  std::vector<Video> videos;
};

// The page. The twin must have states.
std::string page(const Contents& contents);

}  // namespace chainsplat::report
