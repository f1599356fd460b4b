// readout.h - when each row of a frame was taken, where cameras read them one after the other, and how late the base is
// by the rope's motion (mathematics.md 6.15).
#pragma once
#include <optional>
#include <string>
#include <vector>

#include "pipeline/stages.h"

namespace chainsplat::pipeline {

// A readout that all cameras have, and how late the base's clock is beside what is corrected by outlines.
struct Readout {
  double value = 0.0, deviation = 0.0;     // s
  double late = 0.0, late_deviation = 0.0;  // s
  // s^2, of the base's clock and the readout together, beside that: where something else may be true instead
  Eigen::Matrix2d doubt = Eigen::Matrix2d::Zero();
};
// Whether it may be looked for: it is not given, and the base moves.
bool readout_is_open(const capture::Capture& capture, const std::vector<std::string>& fixed);
// What no readout that is found may exceed (s): no camera reads a frame longer than until its next one.
double longest_readout(const capture::Capture& capture);
// How much longer they take than by now, or how much later the base is, where the motion of a rope that hangs shows it;
// none: neither, as far as it tells. `capture` is corrected in all else; `clock_was_late`: the base's clock was.
std::optional<Readout> more_by_motion(const capture::Capture& capture, bool clock_was_late);
// How much longer by the outlines of a rope on a table, where rows lie otherwise in each camera: in the place of the
// base's clock, or beside it. 0: its clock alone is likelier. `given`: what `found` was found from.
Readout more_by_outlines(const capture::Capture& given, const std::vector<std::string>& fixed,
                         capture::Corrections found);
// `capture`, of whose cameras none has a readout, with this one, a base that was as late as it says, and its views as if
// they read at once.
capture::Capture with_readout(const capture::Capture& capture, const Readout& readout);

}  // namespace chainsplat::pipeline
