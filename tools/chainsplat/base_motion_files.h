// base_motion_files.h - a planned base motion as files: TUM for robots and for rollout --base, CSV with derivatives.
#pragma once
#include <string>
#include <vector>

#include "chainsplat/planning.h"

namespace chainsplat::tools {

// Throws InputError unless `rate`, the option --rate in rows a second, is above 0 and makes no more rows in `seconds`
// than memory is meant for. `example`: how to mend it.
void check_rate(double rate, double seconds, const char* example);
// k / rate below `end`, then `end`.
std::vector<double> row_times(double end, double rate);
std::string motion_tum(const planning::Motion& motion, const std::vector<double>& times);
// 'time,x,y,z,vx,vy,vz,ax,ay,az,yaw,yaw_velocity,yaw_acceleration', world frame.
std::string motion_csv(const planning::Motion& motion, const std::vector<double>& times);
// "x,y,z,yaw" or some of them. Throws InputError.
std::vector<planning::Axis> parse_axes(const std::string& text);

}  // namespace chainsplat::tools
