// What a log's columns are: found by their names, or named by the user.
#include "base_log.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <map>

#include "calibration.h"
#include "chainsplat/text.h"
#include "document.h"
#include "table.h"

namespace chainsplat::importing {

using math::Matrix3;
using math::Pose;
using math::Vector3;

namespace {

constexpr double kFarPlace = 30.0;             // m from the origin; no arm stands there, so the numbers are millimeters
constexpr double kFarAngle = 7.0;              // rad, a bit more than a turn; larger ones are degrees
constexpr double kQuaternionTolerance = 1e-2;  // of the length

// A quantity's components among the columns, each with its scale to m or rad. Missing ones are absent.
using Columns = std::map<std::string, std::size_t>;

InputError wrong(const Table& table, const std::string& what, const std::string& mend) {
  return {table.file.string(), what, mend};
}

bool is_one_of(const std::string& word, std::initializer_list<const char*> words) {
  return std::any_of(words.begin(), words.end(), [&](const char* w) { return word == w; });
}

// Which component a column holds, and of what: "tcp_pose.orientation.x" is qx of "tcp pose". Empty: none.
std::pair<std::string, std::string> component_of(const ColumnName& name) {
  if (name.words.empty()) return {};
  std::vector<std::string> before(name.words.begin(), name.words.end() - 1);
  const std::string last = name.words.back();
  for (const std::string& word : before)
    if (is_one_of(word, {"velocity", "vel", "speed", "twist", "linear", "angular", "force", "torque", "wrench", "acc",
                         "accel", "acceleration", "target", "desired", "commanded", "goal", "effort", "current"}))
      return {};
  const auto group = [&] {
    std::string text;
    for (const std::string& word : before) text += (text.empty() ? "" : " ") + word;
    return text;
  };
  if (is_one_of(last, {"qx", "qy", "qz", "qw"})) return {last, group()};
  if (is_one_of(last, {"ox", "oy", "oz", "ow"})) return {"q" + last.substr(1), group()};
  if (is_one_of(last, {"px", "py", "pz", "tx", "ty", "tz"})) return {std::string(1, last[1]), group()};
  if (is_one_of(last, {"posx", "posy", "posz"})) return {std::string(1, last[3]), group()};
  if (is_one_of(last, {"rx", "ry", "rz", "rvx", "rvy", "rvz"})) return {"r" + last.substr(last.size() - 1), group()};
  if (is_one_of(last, {"roll", "pitch", "yaw"})) return {last, group()};
  if (is_one_of(last, {"a", "b", "c"})) return {last == "a" ? "yaw" : last == "b" ? "pitch" : "roll", group()};
  if (is_one_of(last, {"x", "y", "z", "w"})) {
    const std::string kind = before.empty() ? "" : before.back();
    if (is_one_of(kind, {"quat", "quaternion", "orientation", "rotation", "rot", "q", "ori", "orient"})) {
      before.pop_back();
      return {"q" + last, group()};
    }
    if (is_one_of(kind, {"position", "pos", "translation", "trans", "p", "t", "xyz"})) before.pop_back();
    if (last != "w") return {last, group()};
  }
  // a suffix instead: x_tcp, qw_ee
  const std::string first = name.words.front();
  if (name.words.size() == 2 && is_one_of(first, {"x", "y", "z", "qx", "qy", "qz", "qw", "rx", "ry", "rz"}))
    return {first, last};
  // numbered ones: actual_TCP_pose_0 to 5 is a place and a rotation vector, O_T_EE_0 to 15 a matrix by columns
  if (const auto index = number_of(last); index && *index >= 0 && *index < 16 && *index == std::floor(*index)) {
    const auto i = static_cast<std::size_t>(*index);
    const std::string text = group();
    if (text.find("pose") != std::string::npos && i < 6) return {std::array{"x", "y", "z", "rx", "ry", "rz"}[i], text};
    if (text.find("t ee") != std::string::npos || text.find("matrix") != std::string::npos ||
        text.find("transform") != std::string::npos)
      return {"m" + std::to_string(i), text};
  }
  return {};
}

bool has(const Columns& columns, std::initializer_list<const char*> names) {
  return std::all_of(names.begin(), names.end(), [&](const char* name) { return columns.count(name) > 0; });
}

// 3: place and orientation, 2: a matrix, 1: a place alone.
int completeness(const Columns& columns) {
  if (columns.count("m15")) return 2;
  if (!has(columns, {"x", "y", "z"})) return 0;
  return has(columns, {"qx", "qy", "qz", "qw"}) || has(columns, {"rx", "ry", "rz"}) ||
                 has(columns, {"roll", "pitch", "yaw"})
             ? 3
             : 1;
}

// What the user says: 'time=stamp,x=tcp_x,...'.
Columns named_columns(const Table& table, const std::string& text) {
  Columns columns;
  for (std::size_t begin = 0; begin <= text.size();) {
    const std::size_t end = std::min(text.find(',', begin), text.size());
    const std::string item = text.substr(begin, end - begin);
    begin = end + 1;
    const std::size_t equals = item.find('=');
    const std::string what = lower(item.substr(0, equals));
    if (equals == std::string::npos ||
        !is_one_of(what, {"time", "x", "y", "z", "qx", "qy", "qz", "qw", "rx", "ry", "rz", "roll", "pitch", "yaw"}))
      throw InputError("`columns`",
                       "'" + item + "' is no time, x, y, z, qx, qy, qz, qw, rx, ry, rz, roll, pitch or yaw",
                       "write time=NAME,x=NAME,...");
    const auto index = column_named(table, item.substr(equals + 1));
    if (!index) throw wrong(table, "has no column '" + item.substr(equals + 1) + "'", "it has " + list_of(table.names));
    columns[what] = *index;
  }
  return columns;
}

// The pose's columns by their names; `key` is a part of the names of those that are meant.
Columns found_columns(const Table& table, const std::string& key) {
  std::map<std::string, Columns> groups;
  for (std::size_t i = 0; i < table.names.size(); ++i) {
    if (!key.empty() && lower(table.names[i]).find(lower(key)) == std::string::npos) continue;
    const auto [component, group] = component_of(parse_column(table.names[i]));
    if (!component.empty()) groups[group].emplace(component, i);
  }
  std::vector<std::string> best;
  int most = 0;
  for (const auto& [group, columns] : groups) {
    const int here = completeness(columns);
    if (here == 0 || here < most) continue;
    if (here > most) best.clear();
    most = here;
    best.push_back(group);
  }
  if (best.size() == 1) return groups[best.front()];
  // one that is measured goes before all others
  std::vector<std::string> measured;
  for (const std::string& group : best)
    if (group.find("actual") != std::string::npos || group.find("measured") != std::string::npos)
      measured.push_back(group);
  if (measured.size() == 1) return groups[measured.front()];
  if (best.empty())
    throw wrong(table, "no columns are called like a pose",
                "say which with `columns` time=NAME,x=NAME,...,qw=NAME; it has " + list_of(table.names));
  throw wrong(table, std::to_string(best.size()) + " poses are in it: " + list_of(best), "choose one with #NAME");
}

// A rotation's way in a log, and the scale of its angles.
struct Turn {
  enum class Kind { none, quaternion, vector, rpy, matrix } kind = Kind::none;
  double scale = 1.0;
};

double scale_by(const Table& table, std::initializer_list<std::size_t> indices, const std::string& asked,
                double plausible, const char* larger, const char* what, std::vector<std::string>& notes) {
  std::string unit = asked, reason = ", as asked";
  if (unit.empty()) unit = parse_column(table.names[*indices.begin()]).unit, reason = ", by their names";
  if (unit.empty()) {
    double most = 0.0;
    for (const std::size_t i : indices)
      for (const double value : column(table, i)) most = std::max(most, std::abs(value));
    const bool large = most > plausible;
    unit = large ? larger : std::string(larger) == "mm" ? "m" : "rad";
    reason = large ? ", since they reach " + core::brief(most) : ", which is assumed";
    reason += std::string(" (`") + (std::string(larger) == "mm" ? "base" : "angle") + "_unit`)";
  }
  notes.push_back(std::string("base: ") + what + " in " + unit + reason);
  return unit_scale(unit);
}

std::vector<Pose> poses_of(const Table& table, const Columns& columns, const Options& options,
                           std::vector<std::string>& notes) {
  const std::size_t rows = table.lines.size();
  std::vector<Pose> poses(rows);
  if (columns.count("m15")) {  // a 4x4 matrix in 16 columns
    std::array<std::vector<double>, 16> m;
    for (int i = 0; i < 16; ++i) {
      const auto found = columns.find("m" + std::to_string(i));
      if (found == columns.end())
        throw wrong(table, "a matrix has 16 columns, number " + std::to_string(i) + " is missing", "add it");
      m[i] = column(table, found->second);
    }
    const bool by_columns = m[3][0] == 0 && m[7][0] == 0 && m[11][0] == 0 && m[15][0] == 1;
    notes.push_back(std::string("base: 4x4 matrices, ") + (by_columns ? "column by column" : "row by row"));
    for (std::size_t k = 0; k < rows; ++k) {
      Eigen::Matrix4d matrix;
      for (int i = 0; i < 16; ++i) (by_columns ? matrix(i % 4, i / 4) : matrix(i / 4, i % 4)) = m[i][k];
      const auto pose = rigid(matrix);
      if (!pose)
        throw InputError(table.file.string() + ":" + std::to_string(table.lines[k].number), "is no rigid motion",
                         "check the columns of the matrix");
      poses[k] = *pose;
    }
    return poses;
  }
  const auto values = [&](const char* name) { return column(table, columns.at(name)); };
  const double scale = scale_by(table, {columns.at("x"), columns.at("y"), columns.at("z")}, options.base_unit,
                                kFarPlace, "mm", "positions", notes);
  const std::vector<double> x = values("x"), y = values("y"), z = values("z");
  for (std::size_t k = 0; k < rows; ++k) poses[k].translation = scale * Vector3(x[k], y[k], z[k]);
  if (has(columns, {"qx", "qy", "qz", "qw"})) {
    const std::vector<double> qx = values("qx"), qy = values("qy"), qz = values("qz"), qw = values("qw");
    for (std::size_t k = 0; k < rows; ++k) {
      const Eigen::Quaterniond q(qw[k], qx[k], qy[k], qz[k]);
      if (std::abs(q.norm() - 1.0) > kQuaternionTolerance)
        throw InputError(table.file.string() + ":" + std::to_string(table.lines[k].number),
                         "the quaternion has length " + core::brief(q.norm()) + ", not 1",
                         "check the columns qx, qy, qz, qw");
      poses[k].rotation = q.normalized().toRotationMatrix();
    }
    notes.push_back("base: orientations from the quaternion '" + table.names[columns.at("qx")] + "' to '" +
                    table.names[columns.at("qw")] + "'");
    return poses;
  }
  const bool vector = has(columns, {"rx", "ry", "rz"}), angles = has(columns, {"roll", "pitch", "yaw"});
  if (!vector && !angles) {
    notes.push_back("base: no orientation in the log; the gripper is taken not to turn");
    return poses;
  }
  const std::array<const char*, 3> names = vector ? std::array{"rx", "ry", "rz"} : std::array{"roll", "pitch", "yaw"};
  const double turn = scale_by(table, {columns.at(names[0]), columns.at(names[1]), columns.at(names[2])},
                               options.angle_unit, kFarAngle, "deg", "angles", notes);
  const bool as_vector = vector && (options.rotation == "rotvec" || (options.rotation.empty() && turn == 1.0));
  notes.push_back(as_vector ? "base: rx, ry, rz are a rotation vector (else give `rotation` rpy)"
                            : "base: orientations are Rz(yaw) Ry(pitch) Rx(roll)");
  const std::vector<double> a = values(names[0]), b = values(names[1]), c = values(names[2]);
  for (std::size_t k = 0; k < rows; ++k)
    poses[k].rotation = as_vector ? math::exp_so3(turn * Vector3(a[k], b[k], c[k]))
                                  : Matrix3(Eigen::AngleAxisd(turn * c[k], Vector3::UnitZ()) *
                                            Eigen::AngleAxisd(turn * b[k], Vector3::UnitY()) *
                                            Eigen::AngleAxisd(turn * a[k], Vector3::UnitX()));
  return poses;
}

// The columns of the arm's joints: called as they are, or numbered in their order.
std::vector<std::size_t> joint_columns(const Table& table, const Arm& arm, const std::string& key) {
  const std::vector<std::string> joints = arm.moving();
  std::vector<std::size_t> found;
  const auto meant = [&](std::size_t i) {
    const std::string name = lower(table.names[i]);
    if (!key.empty() && name.find(lower(key)) == std::string::npos) return false;
    for (const char* other : {"vel", "effort", "torque", "current", "target", "qd", "acc"})
      if (name.find(other) != std::string::npos && key.empty()) return false;
    return true;
  };
  for (const std::string& joint : joints) {
    const std::vector<std::string> wanted = words(joint);
    for (std::size_t i = 0; i < table.names.size(); ++i) {
      if (!meant(i)) continue;
      const std::vector<std::string> there = parse_column(table.names[i]).words;
      if (std::search(there.begin(), there.end(), wanted.begin(), wanted.end()) == there.end()) continue;
      found.push_back(i);
      break;
    }
  }
  if (found.size() == joints.size()) return found;
  // q1, q2, ...; joint_0, ...; actual_q_0, ...; position[0], ...
  std::map<std::string, std::vector<std::size_t>> numbered;
  for (std::size_t i = 0; i < table.names.size(); ++i) {
    if (!meant(i)) continue;
    std::string name = lower(table.names[i]);
    const std::size_t digit = name.find_first_of("0123456789");
    if (digit != std::string::npos) numbered[name.substr(0, digit)].push_back(i);
  }
  std::vector<std::vector<std::size_t>> fitting;
  for (const auto& [name, columns] : numbered)
    if (columns.size() == joints.size()) fitting.push_back(columns);
  if (fitting.size() == 1) return fitting.front();
  throw wrong(table, "has no columns for the joints " + list_of(joints), "it has " + list_of(table.names));
}

std::vector<Pose> poses_of_arm(const Table& table, const Options& options, std::vector<std::string>& notes) {
  const Arm arm = read_urdf(options.urdf, options.flange);
  const std::vector<std::size_t> columns = joint_columns(table, arm, options.base.key);
  std::vector<std::string> names;
  std::vector<std::vector<double>> values;
  for (const std::size_t index : columns) {
    names.push_back(table.names[index]);
    values.push_back(column(table, index));
  }
  std::string unit = options.angle_unit.empty() ? parse_column(names.front()).unit : options.angle_unit;
  if (unit.empty()) {
    double most = 0.0;
    for (const auto& one : values)
      for (const double value : one) most = std::max(most, std::abs(value));
    unit = most > kFarAngle ? "deg" : "rad";
  }
  notes.push_back("base: joint angles in " + unit + " from " + list_of(names) + "; pose of '" + arm.flange + "' in '" +
                  arm.root + "' by " + options.urdf.string());
  std::vector<Pose> poses;
  math::VectorX angles(static_cast<Eigen::Index>(columns.size()));
  const std::vector<std::string> joints = arm.moving();
  for (std::size_t k = 0; k < table.lines.size(); ++k) {
    for (std::size_t j = 0; j < columns.size(); ++j) {
      const bool slides = std::any_of(arm.joints.begin(), arm.joints.end(),
                                      [&](const Arm::Joint& joint) { return joint.name == joints[j] && joint.slides; });
      angles[static_cast<Eigen::Index>(j)] = values[j][k] * (slides ? 1.0 : unit_scale(unit));
    }
    poses.push_back(forward(arm, angles));
  }
  return poses;
}

std::vector<trajectory::Sample> in_order(const std::vector<double>& times, const std::vector<Pose>& poses,
                                         const Table& table, std::vector<std::string>& notes) {
  std::vector<trajectory::Sample> samples;
  int repeated = 0;
  for (std::size_t k = 0; k < times.size(); ++k) {
    if (!samples.empty() && times[k] < samples.back().time)
      throw InputError(table.file.string() + ":" + std::to_string(table.lines[k].number),
                       "its time is before that of the line above",
                       "sort the log by time, or name another column of times");
    if (!samples.empty() && times[k] == samples.back().time)
      ++repeated;
    else
      samples.push_back({times[k], poses[k]});
  }
  if (repeated > 0) notes.push_back("base: " + std::to_string(repeated) + " rows repeat a time and are left out");
  return samples;
}

}  // namespace

std::vector<trajectory::Sample> read_base_log(const Options& options, std::vector<std::string>& notes) {
  const Path& file = options.base.file;
  const std::string ending = lower(file.extension().string());
  if (ending == ".bag" || ending == ".db3" || ending == ".mcap")
    throw InputError(file.string(), "is a ROS bag, which is not read directly", "convert it first: tools/bag_to_files");
  const Table table = read_table(file);
  std::string note;
  if (!table.named && options.columns.empty() && table.names.size() == 8 && options.urdf.empty()) {
    notes.push_back("base: TUM, 'timestamp tx ty tz qx qy qz qw', m");
    std::vector<double> times = times_of(table, 0, options.time_unit, note);
    const Columns columns{{"x", 1}, {"y", 2}, {"z", 3}, {"qx", 4}, {"qy", 5}, {"qz", 6}, {"qw", 7}};
    std::vector<std::string> told;
    Options meters = options;
    if (meters.base_unit.empty()) meters.base_unit = "m";
    return in_order(times, poses_of(table, columns, meters, told), table, notes);
  }
  if (!table.named && options.columns.empty())
    throw wrong(table, "has " + std::to_string(table.names.size()) + " columns without names",
                "say which is which with `columns` time=1,x=2,...,qw=8, or write a line of names");
  Columns columns;
  if (!options.columns.empty()) columns = named_columns(table, options.columns);
  const std::optional<std::size_t> clock =
      columns.count("time") ? std::optional(columns.at("time")) : time_column(table);
  if (!clock)
    throw wrong(table, "no column is called like a time",
                "name it with `columns` time=NAME; it has " + list_of(table.names));
  const std::vector<double> times = times_of(table, *clock, options.time_unit, note);
  notes.push_back("base: " + note);
  if (!options.urdf.empty()) return in_order(times, poses_of_arm(table, options, notes), table, notes);
  if (options.columns.empty()) columns = found_columns(table, options.base.key);
  if (completeness(columns) == 0)
    throw InputError("`columns`", "names no x, y and z", "write time=NAME,x=NAME,...,qw=NAME");
  return in_order(times, poses_of(table, columns, options, notes), table, notes);
}

}  // namespace chainsplat::importing
