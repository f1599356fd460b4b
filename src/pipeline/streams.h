// streams.h - the lines of `estimate` read from a file, and the base motion under the states that they tell.
#pragma once
#include <functional>
#include <map>
#include <optional>
#include <string>

#include "chainsplat/core.h"
#include "chainsplat/estimate_lines.h"
#include "chainsplat/trajectory.h"
#include "chainsplat/twin.h"

namespace chainsplat::pipeline {

// Gives every line that tells where the rope is to `take`, as soon as it is there. `file`: "-" is standard input.
// Throws InputError with the line, also where some have deviations and some have none.
void each_estimate(const Path& file, int angles, const std::function<void(const estimation::EstimateLine&)>& take);

// Throws InputError where `base` does not cover the states, which go from `first` to `last`, s.
void check_covered(const trajectory::Trajectory& base, double first, double last, const std::string& where,
                   const std::string& mend);

// The base motion under a stream's states: as a file gives it, mended by what the states say of it.
class StreamBase {
 public:
  // `file`: TUM; empty: that of the twin's own capture, as the twin corrects it, with a warning. Throws InputError.
  StreamBase(const Path& run, const twin::Twin& twin, const Path& file);

  // What a state says of the base as it was given; it holds from its time on, the first one's before it, too.
  void mend(double time, const std::optional<estimation::BaseCorrection>& said);
  void forget();  // what was said so far

  trajectory::BaseMotion at(double time) const;
  void check_covers(double first, double last) const;  // s; throws InputError
  const trajectory::Trajectory& given() const { return given_; }

 private:
  Path named_;  // for messages
  trajectory::Trajectory given_;
  estimation::BaseCorrection known_;                          // how that was mended before
  std::map<double, estimation::BaseCorrection> corrections_;  // by time
};

}  // namespace chainsplat::pipeline
