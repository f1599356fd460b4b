// chainsplat/twin.h - the result as one value, and its run folder (INTERFACE 3).
#pragma once
#include <map>
#include <optional>
#include <string>
#include <vector>
#include "chainsplat/chain.h"
#include "chainsplat/core.h"
#include "chainsplat/dynamics.h"
#include "chainsplat/splat.h"

namespace chainsplat::twin {

struct Provenance {
  std::string version, capture, capture_hash, device, driver;
  std::map<std::string, std::string> options;
  std::uint64_t seed = 0;
  std::map<std::string, double> seconds;                 // by stage
};

struct Twin {
  bool tabletop = false;
  chain::Chain chain;
  std::optional<math::Vector3> table_point;
  std::optional<dynamics::Parameters> parameters;        // none before identification
  std::optional<dynamics::InitialState> initial;
  dynamics::Estimates estimates;
  Provenance provenance;
  bool known_mass = false;
  splat::Gaussians gaussians;                            // count 0 before recognition
  chain::States states;                                  // recognized, every frame
  chain::States rollout;
};

// Writes twin.json, gaussians.ply, states.csv, rollout.csv (those that exist). Each file in one step.
void save(const Twin& twin, const Path& run);
// Throws InputError naming file and key.
Twin load(const Path& run);

std::string states_csv(const chain::States& states);
chain::States read_states(const Path& file, int angles);
std::string centerline_csv(const chain::Chain& chain, const chain::States& states, const trajectory::Trajectory& base);
std::string gaussians_ply(const splat::Gaussians& gaussians);
splat::Gaussians read_ply(const Path& file);

}  // namespace chainsplat::twin
