// clocks.h - when each row of a frame was taken, where cameras read rows one after the other, and how late the base is
// by the rope's motion (mathematics.md 6.15).
#pragma once
#include <optional>
#include <string>
#include <vector>

#include "pipeline/stages.h"

namespace chainsplat::pipeline {

// A readout that all cameras have, and how late the base's clock is beside what is corrected by outlines.
struct Clocks {
  double readout = 0.0, readout_deviation = 0.0;  // s
  double late = 0.0, late_deviation = 0.0;        // s
  // s^2, of the base's clock and the readout together, beside that: where something else may be true instead
  Eigen::Matrix2d doubt = Eigen::Matrix2d::Zero();
};
// Whether they may be looked for: no camera's readout is given, time is not held, and the base moves.
bool clocks_are_open(const capture::Capture& capture, const std::vector<std::string>& fixed);
// What no readout that is found may exceed (s): no camera reads a frame longer than until its next one.
double longest_readout(const capture::Capture& capture);
// How much longer cameras take to read their rows than by now, or how much later the base is, where the motion of a
// rope that hangs shows it; none: neither, as far as it tells; a doubt alone: perhaps, but other parameters explain as
// much. `capture` is corrected in all else; `clock_was_late`: also in the base's clock.
std::optional<Clocks> more_by_motion(const capture::Capture& capture, bool clock_was_late);
// How much longer they take by the outlines of a rope on a table, where rows lie otherwise in each camera: in the place
// of the base's clock, or beside it. 0: the base's clock alone is likelier. `given`: what `found` was found from.
Clocks more_by_outlines(const capture::Capture& given, const std::vector<std::string>& fixed,
                        capture::Corrections found);
// `capture`, of whose cameras none has a readout, with this readout, a base that was as late as `clocks` says, and its
// views as if all rows were read at once.
capture::Capture with_clocks(const capture::Capture& capture, const Clocks& clocks);

}  // namespace chainsplat::pipeline
