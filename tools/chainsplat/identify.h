// identify.h - the stages of train that follow recognition: dynamics from recognized states, and the rollout.
#pragma once
#include <string>
#include <vector>

#include "chainsplat/identification.h"
#include "run_folder.h"

namespace chainsplat::tools {

inline constexpr std::size_t kLeastFrames = 3;  // that identification needs (chainsplat/identification.h)

// Measures its own life and adds it to the stage's seconds.
class Stopwatch {
 public:
  Stopwatch(twin::Twin& twin, std::string stage) : twin_(twin), stage_(std::move(stage)), start_(core::seconds_now()) {}
  ~Stopwatch();
  Stopwatch(const Stopwatch&) = delete;
  Stopwatch& operator=(const Stopwatch&) = delete;

 private:
  twin::Twin& twin_;
  std::string stage_;
  double start_;
};

// What the twin and its capture say of how to identify it.
identification::Options identification_options(const twin::Twin& twin, bool paper, std::uint64_t seed);
// `twin`: recognized. Fills in parameters, initial state, estimates and rollout.
void identify_stage(twin::Twin& twin, const trajectory::Trajectory& base, const std::vector<math::MatrixX>& covariances,
                    bool paper, std::uint64_t seed);
// Rolls the identified twin out over its recognized times. `out`: its run folder, for messages.
void rollout_stage(twin::Twin& twin, const trajectory::Trajectory& base, const Path& out);

}  // namespace chainsplat::tools
