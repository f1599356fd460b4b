// Trajectory files in the format of the TUM RGB-D benchmark: one 'timestamp tx ty tz qx qy qz qw' per line.
#include <charconv>
#include <cmath>
#include <string>

#include "chainsplat/text.h"
#include "chainsplat/trajectory.h"

namespace chainsplat::trajectory {

namespace {

constexpr int kColumns = 8;
constexpr std::size_t kMostPoses = 1000000;    // per file, because memory and the fit's time grow with the number
constexpr double kQuaternionTolerance = 1e-2;  // of the length: files with three digits pass, swapped columns rarely do

bool separates(char c) { return c == ' ' || c == '\t' || c == ',' || c == '\r'; }

}  // namespace

std::vector<Sample> read_tum(const Path& file) {
  const std::string text = core::read_file(file);
  std::vector<Sample> samples;
  int line_number = 0;
  for (std::size_t begin = 0; begin < text.size();) {
    const std::size_t end = std::min(text.find('\n', begin), text.size());
    const std::string_view line(text.data() + begin, end - begin);
    begin = end + 1;
    ++line_number;
    const std::string where = file.string() + ":" + std::to_string(line_number);

    // read the line's numbers; a '+' before a number is allowed, which from_chars does not know
    double numbers[kColumns];
    int count = 0;
    const char* c = line.data();
    const char* const stop = line.data() + line.size();
    for (;;) {
      while (c != stop && separates(*c)) ++c;
      if (c == stop || *c == '#') break;
      if (*c == '+') ++c;
      double number = 0.0;
      const auto [after, error] = std::from_chars(c, stop, number);
      if (error != std::errc() || (after != stop && !separates(*after) && *after != '#'))
        throw InputError(where, "not a number in column " + std::to_string(count + 1),
                         "write 'timestamp tx ty tz qx qy qz qw', separated by spaces");
      if (!std::isfinite(number))
        throw InputError(where, "column " + std::to_string(count + 1) + " is not finite",
                         "remove the line or fill it from its neighbors");
      if (count < kColumns) numbers[count] = number;
      ++count;
      c = after;
    }
    if (count == 0) continue;  // blank, or a comment
    // check them and append the pose
    if (count != kColumns)
      throw InputError(where, std::to_string(count) + " numbers instead of 8",
                       "write 'timestamp tx ty tz qx qy qz qw' on every line");
    const Eigen::Quaterniond q(numbers[7], numbers[4], numbers[5], numbers[6]);
    if (std::abs(q.norm() - 1.0) > kQuaternionTolerance)
      throw InputError(where, "the quaternion has length " + core::brief(q.norm()) + ", not 1",
                       "check the columns: qx qy qz qw are the last four");
    if (samples.size() == kMostPoses)
      throw InputError(where, "is beyond the " + std::to_string(kMostPoses) + " poses that a motion has at most",
                       "sample it at a lower rate, or split the recording");
    samples.push_back({numbers[0], {q.normalized().toRotationMatrix(), {numbers[1], numbers[2], numbers[3]}}});
  }
  if (samples.empty())
    throw InputError(file.string(), "no pose in it", "write at least one line 'timestamp tx ty tz qx qy qz qw'");
  return samples;
}

std::string write_tum(const std::vector<Sample>& samples) {
  std::string text = "# timestamp tx ty tz qx qy qz qw (s, m, unit quaternion; world frame)\n";
  Eigen::Quaterniond previous = Eigen::Quaterniond::Identity();
  for (const Sample& sample : samples) {
    Eigen::Quaterniond q(sample.pose.rotation);
    q.normalize();
    if (q.dot(previous) < 0.0) q.coeffs() = -q.coeffs();  // readers that interpolate columns expect no sign flips
    previous = q;
    text += core::exact(sample.time);
    for (const double value : {sample.pose.translation.x(), sample.pose.translation.y(), sample.pose.translation.z(),
                               q.x(), q.y(), q.z(), q.w()})
      text.append(" ").append(core::exact(value));
    text += '\n';
  }
  return text;
}

}  // namespace chainsplat::trajectory
