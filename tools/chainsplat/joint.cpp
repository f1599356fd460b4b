#include "joint.h"

#include <cstdio>
#include <tuple>

#include "chainsplat/refinement.h"

namespace chainsplat::tools {

void check_joint(const twin::Twin& twin, const std::vector<math::MatrixX>& covariances, const Path& run) {
  const auto& options = twin.provenance.options;
  const auto mode = options.find("mode");
  if (mode != options.end() && mode->second == "paper")
    throw InputError("--joint", "goes with --mode fast", "leave one of them out");
  if (options.count("joint"))
    throw InputError(run.string(), "is refined already", "begin again with 'chainsplat train --joint --force'");
  if (twin.gaussians.count == 0)
    throw InputError(run.string(), "has no Gaussians to compare with images", "leave --joint out");
  if (covariances.empty())
    throw InputError((run / kCovarianceFile).string(), "is missing", "run 'chainsplat recognize' again");
}

void joint_stage(twin::Twin& twin, std::vector<math::MatrixX>& covariances, const capture::Capture& capture,
                 gpu::Device& device, std::uint64_t seed) {
  const Stopwatch watch(twin, "joint");
  refinement::Options options;
  options.identification = identification_options(twin, false, seed);
  options.seed = seed;
  const auto every = twin.provenance.options.find("every");
  if (every != twin.provenance.options.end()) options.every = std::stoi(every->second);
  refinement::Result found = refinement::refine(device, capture, twin.chain, twin.gaussians, {twin.states, covariances},
                                                twin.rollout, options);
  char text[160];
  std::snprintf(text, sizeof text,
                "joint: images %.1f times as uncertain as recognized, dynamics true to %.2f mm; %d rounds",
                found.noise.image_scale, 1e3 * found.noise.model_error, found.rounds);
  say(text);
  twin.gaussians = std::move(found.gaussians);
  twin.states = std::move(found.angles.states);
  covariances = std::move(found.angles.covariances);
  twin.parameters = std::move(found.identified.parameters);
  twin.initial = std::move(found.identified.initial);
  twin.estimates = std::move(found.identified.estimates);
  twin.rollout = std::move(found.identified.rollout);
  twin.provenance.options["joint"] = "yes";
}

capture::Capture load_own_capture(const twin::Twin& twin, const Path& run) {
  const auto& options = twin.provenance.options;
  const auto path = options.find("path");
  if (path == options.end())
    throw InputError(run.string(), "does not say which capture it was made from", "use 'chainsplat train --joint'");
  capture::LoadOptions load;
  const auto frames = options.find("frames");
  if (frames != options.end()) std::tie(load.first, load.last) =
        parse_frames(frames->second, (run / "twin.json").string() + ": provenance.options.frames");
  capture::Capture capture = capture::load((run / path->second).lexically_normal(), load);
  if (twin.provenance.capture_hash != hash_text(capture.hash))
    throw InputError(capture.folder.string(), "has changed since " + run.string() + " was made", "train it again");
  return capture;
}

}  // namespace chainsplat::tools
