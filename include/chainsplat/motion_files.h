// chainsplat/motion_files.h - a planned base motion as files: TUM for robots and for rollouts, CSV with derivatives,
// and the plan as JSON.
#pragma once
#include <span>
#include <string>
#include <vector>

#include "chainsplat/planning.h"

namespace chainsplat::planning {

// Throws InputError that names the field `rate`, rows per second, unless it is above 0 and makes no more rows in
// `seconds` than memory is meant for. `example`: how to mend it.
void check_rate(double rate, double seconds, const char* example);
// k / rate below `end`, then `end`.
std::vector<double> row_times(double end, double rate);
std::string motion_tum(const Motion& motion, const std::vector<double>& times);
// 'time,x,y,z,vx,vy,vz,ax,ay,az,yaw,yaw_velocity,yaw_acceleration', world frame.
std::string motion_csv(const Motion& motion, const std::vector<double>& times);
// "x,y,z,yaw" or some of them. Throws InputError that names the field `axes`.
std::vector<Axis> parse_axes(const std::string& text);

const Hit& worst_hit(const Plan& plan);  // of several targets
// A plan that was played on a true chain, and what came of it.
struct Simulated {
  std::string name;  // "without_feedback", "with_feedback"
  LoopResult loop;
};
// plan.json: targets, what is missed and where, peaks beside their limits, the weights of the motion, and what was
// simulated. `horizon`: as it was asked for.
std::string plan_json(const Problem& problem, const Options& options, const Plan& plan, const std::string& horizon,
                      std::span<const Simulated> simulated = {});

}  // namespace chainsplat::planning
