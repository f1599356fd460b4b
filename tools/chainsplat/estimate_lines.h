// estimate_lines.h - lines of 'chainsplat estimate' read back, by force and by identify --online.
#pragma once
#include <optional>
#include <string>

#include "chainsplat/math.h"

namespace chainsplat::tools {

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

}  // namespace chainsplat::tools
