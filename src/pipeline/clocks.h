// clocks.h - when each frame, and each row of it, was taken: frames that cameras lost, and rows that were read one
// after the other.
#pragma once
#include <cmath>
#include <optional>
#include <string>
#include <vector>

#include "pipeline/stages.h"

namespace chainsplat::pipeline {

// Restores frames that cameras lost, one after the other, and fits `sequence`, which is that of `chain`, again after
// each. Where there are too many the recording is left as it is by then.
capture::Corrections restore_lost_frames(const chain::Chain& chain, capture::Capture& capture,
                                         silhouette::SequenceFit& sequence, std::vector<capture::Finding>& verdict);

// A readout that all cameras have.
struct Readout {
  double value = 0.0, deviation = 0.0;  // s
};
// Whether it may be looked for: it is not given, and the base moves.
bool readout_is_open(const capture::Capture& capture, const std::vector<std::string>& fixed);
// How much longer they take than by now, where the motion of a rope that hangs shows it. `capture` is corrected in all
// else.
struct MotionReadout {
  std::optional<Readout> more;  // none: no longer, as far as the motion tells
  // m^2, what the motion leaves unexplained as it is by now, and with what it is then
  double before = INFINITY, left = INFINITY;
};
// What a readout must explain of that, since no model is right.
constexpr double kLeastExplained = 0.3;
MotionReadout readout_by_motion(const capture::Capture& capture);
// `capture`, of whose cameras none has a readout, with this one, and its views as if they read at once.
capture::Capture with_readout(const capture::Capture& capture, double readout);

}  // namespace chainsplat::pipeline
