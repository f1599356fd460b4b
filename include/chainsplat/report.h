// chainsplat/report.h - a twin as one page for a browser: a 3-D replay, the verdict, metrics, angles, identified
// numbers, and a rope that was followed with the forces on it (formats.md 5.10).
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
#include "chainsplat/force.h"
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
// within the model. Empty where there is no covariance, for the paper's integrator, whose steps have no derivatives,
// and where angles, unknowns and times are so many that the derivatives would fill the memory.
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

// A rope that was followed (estimation.h), and what pushed it meanwhile (force.h).
struct Followed {
  chain::States states;              // time and theta of the frames in which it was followed
  std::vector<math::VectorX> sigma;  // rad, standard deviations of theta, one a state; empty: not known
  std::vector<math::Pose> base;      // world, where the grasp is believed to be, one a state
  // Whether it is what the twin was made from: the same clock and motion of the base, so that videos and the twin's own
  // motions belong beside it.
  bool own_recording = true;
  std::vector<force::Estimate> forces;  // in order, at some of the states' times; empty: not known
};

// How large a force is, in its unit.
struct ForceSize {
  double value = 0.0;
  double error = 0.0;  // one standard deviation, along the force; of a force of zero, in the worst direction
  // What it may be: two errors to either side, and beyond them what friction at rest may hide (force::Estimate::low and
  // high). At least 0.
  double least = 0.0, most = 0.0;
};
ForceSize size_of(const force::Estimate& estimate);
// The estimate with the largest force among those in which something touches the rope; null: nothing does.
const force::Estimate* largest(const std::vector<force::Estimate>& forces);

struct Contents {
  twin::Twin twin;  // with `states.covariance` where it is known
  trajectory::Trajectory base;
  // Of the capture, as corrected: the cameras and the times of their frames; none: the page has a free view only.
  std::vector<capture::Camera> cameras;
  std::vector<std::vector<double>> times;
  nlohmann::ordered_json metrics;  // as metrics.json has them; null: not evaluated
  std::vector<Video> videos;
  std::optional<Followed> followed;  // none: not given
};

// The page. The twin must have states, and with forces dynamics. Of a long stream that was followed it keeps states in
// equal steps, 10,000 at most.
std::string page(const Contents& contents);

}  // namespace chainsplat::report
