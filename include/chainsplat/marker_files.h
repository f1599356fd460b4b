// chainsplat/marker_files.h - measured marker positions as a file (formats.md 4.1).
#pragma once
#include <vector>

#include "chainsplat/identification.h"
#include "chainsplat/trajectory.h"

namespace chainsplat::identification {

struct MarkerFile {
  std::vector<trajectory::Sample> base;  // every row
  Markers markers;                       // rows, at most 30 per second
};

// '# marker NAME ARCLENGTH' lines, then 'time,bx,by,bz,bqw,bqx,bqy,bqz,NAME_x,NAME_y,NAME_z,...' and rows; empty or
// 'nan' where a marker is not seen. m, s. Throws InputError with file and line.
MarkerFile read_markers(const Path& file);

}  // namespace chainsplat::identification
