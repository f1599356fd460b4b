// joint.h - --joint: what follows identification in train and identify.
#pragma once
#include "chainsplat/gpu.h"
#include "cli.h"
#include "identify.h"

namespace chainsplat::tools {

// Throws InputError unless `twin` can be refined: recognized fast, with covariances, not refined before.
void check_joint(const twin::Twin& twin, const std::vector<math::MatrixX>& covariances, const Path& run);
// The frames that the twin in `run` was made from. Throws InputError where they are gone or have changed.
capture::Capture load_own_capture(const twin::Twin& twin, const Path& run);
// Refines an identified twin and its covariances with its capture's images (undistorted). The caller saves both.
void joint_stage(twin::Twin& twin, std::vector<math::MatrixX>& covariances, const capture::Capture& capture,
                 gpu::Device& device, std::uint64_t seed);

}  // namespace chainsplat::tools
