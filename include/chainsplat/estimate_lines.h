// chainsplat/estimate_lines.h - the JSON lines of estimation::to_json() read back: by force, and by parameters that
// follow a rope.
#pragma once
#include <functional>
#include <iosfwd>
#include <optional>
#include <string>

#include "chainsplat/corrections.h"
#include "chainsplat/trajectory.h"

namespace chainsplat::estimation {

// How a base is believed to be off that a rope is followed with.
struct BaseCorrection {
  double late = 0.0;  // s, of its stamps
  math::Pose grasp;   // of the rope in the base frame; none where the gripper holds it as it was given
};
// What a twin was made with.
BaseCorrection base_correction(const capture::Corrections& corrections);
// A base that was mended by the first is mended by the second, too.
BaseCorrection operator*(const BaseCorrection& first, const BaseCorrection& second);
BaseCorrection inverse(const BaseCorrection& correction);
// What is left of a line's correction (EstimateLine::base) for a base that is `known` to have been mended by so much.
BaseCorrection remaining(const std::optional<BaseCorrection>& said, const BaseCorrection& known);
// The base's motion at a time, mended. `given`: as it was given.
trajectory::BaseMotion corrected(const std::function<trajectory::BaseMotion(double time)>& given,
                                 const BaseCorrection& correction, double time);

// Where a line leaves something out it is empty.
struct EstimateLine {
  double time = 0.0;                     // s
  math::VectorX theta, thetadot, sigma;  // rad, rad/s, rad
  math::MatrixX covariance;              // of theta, rad^2
  // Of the base motion that the frames were given with: a capture's file, not as the twin corrects it.
  std::optional<BaseCorrection> base;
  double late_sigma = 0.0;      // s, standard deviation of base->late; 0: not told
  math::VectorX theta_by_late;  // rad/s, how theta changes with it
};

// None where the frame is lost, doubtful or settling. `before`: time of the line before. Throws InputError with `where`
// and the field that is not what a rope with so many angles can have.
std::optional<EstimateLine> read_estimate_line(const std::string& line, const std::string& where, int angles,
                                               double before);

// The next line; false at the end. Throws InputError where it is longer than any that is meant (a device may never end
// one), or cannot be read. `command`: whose output is to be given instead.
bool next_line(std::istream& in, std::string& line, const std::string& where, const std::string& command = "estimate");

}  // namespace chainsplat::estimation
