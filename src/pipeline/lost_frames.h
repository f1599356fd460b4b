// lost_frames.h - frames that cameras lost, so that the stamps after them are early (mathematics.md 6.14).
#pragma once
#include <vector>

#include "pipeline/stages.h"

namespace chainsplat::pipeline {

// Restores frames that cameras lost, one after the other, and fits `sequence`, which is that of `chain`, again after
// each. Where there are too many the recording is left as it is by then.
capture::Corrections restore_lost_frames(const chain::Chain& chain, capture::Capture& capture,
                                         silhouette::SequenceFit& sequence, std::vector<capture::Finding>& verdict);

}  // namespace chainsplat::pipeline
