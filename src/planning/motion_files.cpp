#include "chainsplat/motion_files.h"

#include <cmath>
#include <sstream>

namespace chainsplat::planning {

void check_rate(double rate, double seconds, const char* example) {
  if (!(rate > 0.0) || !std::isfinite(rate)) throw InputError("`rate`", "must be above 0", example);
  constexpr int kMostRows = 1000000;  // some 400 bytes each in memory, more as text
  if (rate * seconds > kMostRows)
    throw InputError("`rate`",
                     core::exact(rate) + " rows a second for " + core::exact(seconds) + " s are more than the " +
                         std::to_string(kMostRows) + " rows that are written at most, since all are held in memory",
                     example);
}

std::vector<double> row_times(double end, double rate) {
  constexpr double kSlack = 1e-6;  // s
  std::vector<double> times;
  for (int k = 0; k / rate < end - kSlack; ++k) times.push_back(k / rate);
  times.push_back(end);
  return times;
}

std::string motion_tum(const Motion& motion, const std::vector<double>& times) {
  std::vector<trajectory::Sample> samples;
  for (double time : times) samples.push_back({time, base_at(motion, time).pose});
  return trajectory::write_tum(samples);
}

std::string motion_csv(const Motion& motion, const std::vector<double>& times) {
  std::string csv = "time,x,y,z,vx,vy,vz,ax,ay,az,yaw,yaw_velocity,yaw_acceleration\n";
  for (double time : times) {
    const Coordinates c = coordinates(motion, time);
    csv += core::exact(time);
    const auto field = [&csv](double value) {
      csv += ',';
      csv += core::exact(value);
    };
    for (int d = 0; d < 3; ++d)
      for (int i = 0; i < 3; ++i) field(c(i, d));
    for (int d = 0; d < 3; ++d) field(c(3, d));
    csv += "\n";
  }
  return csv;
}

std::vector<Axis> parse_axes(const std::string& text) {
  std::vector<Axis> out;
  std::istringstream words(text);
  std::string word;
  while (std::getline(words, word, ','))
    if (word == "x")
      out.push_back(Axis::x);
    else if (word == "y")
      out.push_back(Axis::y);
    else if (word == "z")
      out.push_back(Axis::z);
    else if (word == "yaw")
      out.push_back(Axis::yaw);
    else
      throw InputError("`axes`", "'" + word + "' is no axis", "give some of x,y,z,yaw");
  return out;
}

}  // namespace chainsplat::planning
