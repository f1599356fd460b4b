// chainsplat/estimate_lines.h - the JSON lines of estimation::to_json() read back: by force, and by parameters that
// follow a rope.
#pragma once
#include <functional>
#include <iosfwd>
#include <optional>
#include <string>

#include "chainsplat/trajectory.h"

namespace chainsplat::estimation {

// How a base is believed to be off that a rope is followed with.
struct BaseCorrection {
  double late = 0.0;                                     // s, of its stamps
  math::Vector3 grasp_rotation = math::Vector3::Zero();  // rad, rotation vector of the rope in the base frame
};
// The base's motion at a time, mended. `given`: as it was given.
trajectory::BaseMotion corrected(const std::function<trajectory::BaseMotion(double time)>& given,
                                 const BaseCorrection& correction, double time);

// Where a line leaves something out it is empty.
struct EstimateLine {
  double time = 0.0;                     // s
  math::VectorX theta, thetadot, sigma;  // rad, rad/s, rad
  math::MatrixX covariance;              // of theta, rad^2
  BaseCorrection base;
};

// None where the frame is lost or doubtful, or settling. `before`: time of the line before. Throws InputError with `where` and the field that is
// not what a rope with so many angles can have.
std::optional<EstimateLine> read_estimate_line(const std::string& line, const std::string& where, int angles,
                                               double before);

// The next line; false at the end. Throws InputError where it is longer than any that is meant (a device may never end
// one), or cannot be read.
bool next_line(std::istream& in, std::string& line, const std::string& where);

}  // namespace chainsplat::estimation
