// joint.cpp - angles, Gaussians and dynamics refined together: what follows identification in train and identify.
#include <cstdio>

#include "chainsplat/refinement.h"
#include "chainsplat/run_folder.h"
#include "chainsplat/shutter.h"
#include "pipeline/stages.h"

namespace chainsplat::pipeline {

void check_joint(const twin::Twin& twin, const Path& run) {
  if (twin.provenance.mode == twin::Mode::paper)
    throw InputError("`joint`", "goes with `mode` fast", "leave one of them out");
  if (twin.provenance.joint)
    throw InputError(run.string(), "is refined already", "train it again with `joint` and `force`");
  if (twin.gaussians.count == 0)
    throw InputError(run.string(), "has no Gaussians to compare with images", "leave `joint` out");
  if (twin.states.covariance.empty())
    throw InputError((run / kCovarianceFile).string(), "is missing", "run 'chainsplat recognize' again");
}

solve::Summary refine(twin::Twin& twin, const capture::Capture& capture, gpu::Device& device, std::uint64_t seed) {
  const Stopwatch watch(twin, "joint");
  refinement::Options options;
  options.identification = identification_options(twin, false, seed);
  options.seed = seed;
  if (twin.provenance.every) options.every = *twin.provenance.every;
  refinement::Result found =
      refinement::refine(device, capture, twin.chain, twin.gaussians, twin.states, twin.rollout, options);
  char text[160];
  std::snprintf(text, sizeof text,
                "joint: images %.1f times as uncertain as recognized, dynamics true to %.2f mm; %d rounds",
                found.noise.image_scale, 1e3 * found.noise.model_error, found.rounds);
  core::say(text);
  tell_fit("joint", found.summary);
  if (found.summary.reason == solve::Reason::last_iteration) {
    std::snprintf(text, sizeof text,
                  "joint: stopped at its last round, in which the dynamics still moved the nodes by %.3f mm",
                  1e3 * found.summary.worst_step);
    core::warn(text);
  }
  twin.gaussians = std::move(found.gaussians);
  twin.states = std::move(found.states);
  adopt(twin, capture.base, std::move(found.identified));
  twin.provenance.joint = true;
  return found.summary;
}

capture::Capture load_own_capture(const twin::Twin& twin, const Path& run) {
  if (!twin.provenance.path)
    throw InputError(run.string(), "does not say which capture it was made from", "train it again with `joint`");
  capture::LoadOptions load;
  if (const auto& frames = twin.provenance.frames) load.first = frames->first, load.last = frames->last;
  capture::Capture capture = capture::load((run / *twin.provenance.path).lexically_normal(), load);
  if (twin.provenance.capture_hash != capture::hash_text(capture.hash))
    throw InputError(capture.folder.string(), "has changed since " + run.string() + " was made", "train it again");
  capture::apply(twin.corrections, capture);
  silhouette::read_at_once(capture, twin.chain, twin.states);
  return capture;
}

}  // namespace chainsplat::pipeline
