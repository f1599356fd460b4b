// checkpoint.h - what recognition needs to go on: written in one step, checksummed; the one before is kept.
#pragma once
#include <optional>
#include <string>

#include "chainsplat/chain.h"
#include "chainsplat/core.h"
#include "chainsplat/splat.h"
#include "src/recognition/step_watch.h"

namespace chainsplat::recognition {

struct Checkpoint {
  std::string job;       // what the result depends on, see job_text; another job's checkpoint is refused
  int stage = 0;         // rounds (fast) or iterations (paper) done
  int step = 0;          // Adam steps done of the round under way (fast); 0: none, and the snapshot is empty
  bool spatial = false;  // the bending that was chosen
  double out_of_plane_rms = 0.0, deviation = 0.0;
  std::vector<double> lift;  // of the chain
  StepWatch watch;
  chain::States states;
  splat::Gaussians gaussians;  // at the round's start (fast)
  splat::Engine::Snapshot snapshot;
  std::vector<double> extra;  // what a mode adds: angles' Adam moments (paper)
};

// As folder/recognize.bin; the one before becomes folder/recognize.before.bin. Throws WorkError (disk full).
void save_checkpoint(const Checkpoint& checkpoint, const Path& folder);
// The last one that is whole, with a warning where a damaged one is passed over. None when there is none: then all
// begins anew. Throws InputError when it is of another job, and names what differs.
std::optional<Checkpoint> load_checkpoint(const Path& folder, const std::string& job);

}  // namespace chainsplat::recognition
