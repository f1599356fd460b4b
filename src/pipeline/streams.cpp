#include "pipeline/streams.h"

#include <fstream>
#include <limits>

#include "chainsplat/run_folder.h"

namespace chainsplat::pipeline {

void each_estimate(const Path& file, int angles, const std::function<void(const estimation::EstimateLine&)>& take) {
  const std::string name = file.string();
  std::ifstream in(input_path(file));
  if (!in) throw InputError(name, "cannot be read", "give the output of estimate, or - for standard input");
  double before = -std::numeric_limits<double>::infinity();
  std::optional<bool> known;  // whether the lines have deviations
  std::string line;
  for (int number = 1; estimation::next_line(in, line, name); ++number) {
    core::stop_if_requested();
    if (line.empty()) continue;
    const std::string where = name + ": line " + std::to_string(number);
    const std::optional<estimation::EstimateLine> read = estimation::read_estimate_line(line, where, angles, before);
    if (!read) continue;
    before = read->time;
    if (!known) known = read->sigma.size() > 0;
    if (*known != (read->sigma.size() > 0))
      throw InputError(
          where, *known ? "has no deviations, unlike the lines before" : "has deviations, unlike the lines before",
          "give the output of one run of estimate");
    take(*read);
  }
}

void check_covered(const trajectory::Trajectory& base, double first, double last, const std::string& where,
                   const std::string& mend) {
  constexpr double kSlack = 1.0 / 30.0;    // s, a frame beyond the last sample
  if (base.samples().size() <= 1) return;  // it rests
  if (first < base.start() - kSlack || last > base.end() + kSlack)
    throw InputError(where,
                     "the base motion covers " + core::exact(base.start()) + " to " + core::exact(base.end()) +
                         " s, the states " + core::exact(first) + " to " + core::exact(last) + " s",
                     mend);
}

StreamBase::StreamBase(const Path& run, const twin::Twin& twin, const Path& file)
    : named_(file.empty() ? run : file), given_(file.empty() ? own_base(run) : read_base(input_path(file))) {
  if (!file.empty()) return;
  core::warn("`base`: is missing; the base motion of the twin's own capture is assumed");
  known_ = estimation::base_correction(twin.corrections);
}

void StreamBase::mend(double time, const std::optional<estimation::BaseCorrection>& said) {
  corrections_[time] = estimation::remaining(said, known_);
}

void StreamBase::forget() { corrections_.clear(); }

trajectory::BaseMotion StreamBase::at(double time) const {
  auto last = corrections_.upper_bound(time);
  if (last != corrections_.begin()) --last;
  return estimation::corrected([this](double t) { return given_.at(t); },
                               last == corrections_.end() ? estimation::BaseCorrection{} : last->second, time);
}

void StreamBase::check_covers(double first, double last) const {
  check_covered(given_, first, last, named_.string(), "give the base motion of these states with `base`");
}

}  // namespace chainsplat::pipeline
