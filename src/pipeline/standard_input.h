// standard_input.h - "-" in the place of a file.
#pragma once
#include "chainsplat/core.h"

namespace chainsplat::pipeline {

// The file to open: standard input where the name is "-".
inline Path input_path(const Path& name) { return name == "-" ? Path("/dev/stdin") : name; }

}  // namespace chainsplat::pipeline
