// chainsplat/estimate_lines.h - the JSON lines of estimation::to_json() read back: by force, and by parameters that
// follow a rope.
#pragma once
#include <iosfwd>
#include <optional>
#include <string>

#include "chainsplat/math.h"

namespace chainsplat::estimation {

// Where a line leaves something out it is empty.
struct EstimateLine {
  double time = 0.0;                     // s
  math::VectorX theta, thetadot, sigma;  // rad, rad/s, rad
  math::MatrixX covariance;              // of theta, rad^2
};

// None where the frame is lost. `before`: time of the line before. Throws InputError with `where` and the field that is
// not what a rope with so many angles can have.
std::optional<EstimateLine> read_estimate_line(const std::string& line, const std::string& where, int angles,
                                               double before);

// The next line; false at the end. Throws InputError where it is longer than any that is meant (a device may never end
// one), or cannot be read.
bool next_line(std::istream& in, std::string& line, const std::string& where);

}  // namespace chainsplat::estimation
