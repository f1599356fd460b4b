#include "chainsplat/marker_files.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <sstream>

namespace chainsplat::identification {

namespace {

constexpr double kMarkerRate = 30.0;  // 1/s, rows that are compared; ropes move more slowly than half of that

std::vector<std::string> cells_of(const std::string& line) {
  std::vector<std::string> cells;
  std::istringstream row(line);
  for (std::string cell; std::getline(row, cell, ',');) {
    const std::size_t first = cell.find_first_not_of(" \t\r"), last = cell.find_last_not_of(" \t\r");
    cells.push_back(first == std::string::npos ? "" : cell.substr(first, last - first + 1));
  }
  if (!line.empty() && line.back() == ',') cells.emplace_back();
  return cells;
}

}  // namespace

MarkerFile read_markers(const Path& file) {
  const std::string text = core::read_file(file);
  int number = 0;
  const auto refuse = [&](const std::string& what, const std::string& mend) {
    throw InputError(file.string() + ":" + std::to_string(number), what, mend);
  };
  std::vector<std::pair<std::string, double>> named;
  std::map<std::string, std::size_t> column;
  std::size_t columns = 0;
  std::vector<std::size_t> base_columns, marker_columns;
  MarkerFile out;
  double next = -std::numeric_limits<double>::infinity();
  for (const core::TableLine& line : core::table_lines(text)) {
    number = line.number;
    if (line.text[0] == '#') {
      std::istringstream words(std::string(line.text.substr(1)));
      std::string kind, name;
      double arclength = 0.0;
      if (!(words >> kind) || kind != "marker") continue;
      if (!(words >> name >> arclength)) refuse("is no marker line", "write '# marker NAME ARCLENGTH'");
      named.emplace_back(name, arclength);
      continue;
    }
    if (column.empty()) {
      const std::vector<std::string> cells = cells_of(std::string(line.text));
      columns = cells.size();
      for (std::size_t i = 0; i < columns; ++i)
        if (!column.emplace(cells[i], i).second && !cells[i].empty())
          refuse("there are two columns '" + cells[i] + "'", "give every column its own name");
      const auto find = [&](const std::string& name) {
        const auto at = column.find(name);
        if (at == column.end())
          refuse("there is no column '" + name + "'", "give it in the header, see formats.md 4.1");
        return at->second;
      };
      for (const char* name : {"time", "bx", "by", "bz", "bqw", "bqx", "bqy", "bqz"})
        base_columns.push_back(find(name));
      if (named.empty()) refuse("no marker is named above the header", "write '# marker NAME ARCLENGTH' lines");
      for (const auto& [name, arclength] : named) {
        out.markers.arclengths.push_back(arclength);
        for (const char* axis : {"_x", "_y", "_z"}) marker_columns.push_back(find(name + axis));
      }
      continue;
    }
    const std::vector<double> row = core::table_numbers(file, line, columns, "correct it", true);
    double pose[8];
    for (int i = 0; i < 8; ++i) pose[i] = row[base_columns[i]];
    if (std::any_of(pose, pose + 8, [](double x) { return std::isnan(x); }))
      refuse("has no pose of the base", "give it");
    if (!out.base.empty() && !(pose[0] > out.base.back().time)) refuse("the times do not increase", "sort the rows");
    const Eigen::Quaterniond turn(pose[4], pose[5], pose[6], pose[7]);
    if (std::abs(turn.norm() - 1.0) > 1e-2) refuse("the quaternion is not of unit length", "write bqw,bqx,bqy,bqz");
    out.base.push_back({pose[0], {turn.normalized().toRotationMatrix(), {pose[1], pose[2], pose[3]}}});
    constexpr double kRounding = 1e-6;  // s, of times in files
    if (pose[0] < next - kRounding) continue;
    math::MatrixX world(3, out.markers.arclengths.size());
    bool seen = false;
    for (Eigen::Index i = 0; i < world.cols(); ++i) {
      for (int axis = 0; axis < 3; ++axis) world(axis, i) = row[marker_columns[3 * i + axis]];
      seen |= world.col(i).allFinite();
    }
    if (!seen) continue;
    // multiples of the interval from the first row, whatever the file's rate
    next = out.markers.time.empty() ? pose[0] + 1.0 / kMarkerRate : next + 1.0 / kMarkerRate;
    if (next <= pose[0]) next = pose[0] + 1.0 / kMarkerRate;
    out.markers.time.push_back(pose[0]);
    out.markers.world.push_back(world);
  }
  if (out.markers.time.size() < 3) refuse("fewer than 3 rows show a marker", "give a longer recording");
  return out;
}

}  // namespace chainsplat::identification
