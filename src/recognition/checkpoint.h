// checkpoint.h - what recognition needs to go on: written in one step, checksummed, refused when damaged.
#pragma once
#include <optional>
#include <string>

#include "chainsplat/chain.h"
#include "chainsplat/core.h"
#include "chainsplat/splat.h"

namespace chainsplat::recognition {

struct Checkpoint {
  std::string job;       // options that the result depends on; another job's checkpoint is refused
  int stage = 0;         // rounds (fast) or iterations (paper) done
  bool spatial = false;  // the bending that was chosen
  double out_of_plane_rms = 0.0, deviation = 0.0;
  chain::States states;
  splat::Engine::Snapshot snapshot;
  std::vector<double> extra;  // what a mode adds: angles' Adam moments (paper)
};

void save_checkpoint(const Checkpoint& checkpoint, const Path& folder);
// None when there is no file. Throws InputError when it is damaged or of another job.
std::optional<Checkpoint> load_checkpoint(const Path& folder, const std::string& job);

}  // namespace chainsplat::recognition
