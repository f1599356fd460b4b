// contact_file.h - where a rope is touched over time, as a table: 'time,x,y,z' a line below a head line.
#pragma once
#include <optional>
#include <vector>

#include "chainsplat/core.h"
#include "chainsplat/math.h"

namespace chainsplat::pipeline {

struct ContactPoint {
  double time = 0.0;                   // s
  std::optional<math::Vector3> point;  // m, world; none: x, y and z are empty, nothing touches
};

// One or more, with increasing times. `file`: "-" is standard input. Throws InputError.
std::vector<ContactPoint> read_contacts(const Path& file);

}  // namespace chainsplat::pipeline
