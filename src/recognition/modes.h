// modes.h - the two ways of recognition, and what they share.
#pragma once
#include "chainsplat/recognition.h"
#include "src/recognition/frames.h"
#include "src/recognition/refine_angles.h"

namespace chainsplat::recognition {

// Of the mask residual against one color channel, when angles are refined. A rope that rolls carries its pattern along,
// which a chain without twist can only follow by bending wrongly; its silhouette does not roll. Measured on the table:
// 1: 0.94 mm, 3: 0.83, 8: 0.75; in free space no difference.
constexpr double kAngleMaskWeight = 5.0;

// A Gauss-Newton step that turns no joint farther moves the free end of a 30 cm rope by less than 3 mm, a seventh of its
// width: the linearization holds, and drawing the frame again to see whether it got better is not worth its time. Of 540
// steps on the dev captures, none longer than this, 9 were refused when they were checked.
constexpr double kTrustedStep = 0.01;  // rad

// Pixels of the views whose angles are refined together: their pictures and targets must fit the buffers of the
// smallest device, and the memory.
constexpr std::size_t kPartPixels = 2u << 20;

// `fast` trains the Gaussians with these.
constexpr int kBatch = 3;                                     // views per step
constexpr splat::LossWeights kLossWeights{
    1.0f, 0.0f, 0.3f};  // without the mask black hides transparency (design.md, 'Recognition')
// `fraction`: 0 at the start, 1 at the end of all steps; rates fall by ten. `scale`: of the usual ones.
splat::AdamRates rates(double fraction, double scale);

Result recognize_fast(gpu::Device& device, const capture::Capture& capture, const Options& options);
Result recognize_paper(gpu::Device& device, const capture::Capture& capture, const Options& options);

// The chain of the capture's rope with so many joints.
chain::Chain chain_of(const capture::Capture& capture, const Options& options, chain::Bending bending, int joints);

// Everything that the result depends on, to recognize a checkpoint of another job: a line 'NAME VALUE' each.
std::string job_text(const capture::Capture& capture, const Options& options);

// Improves every frame's angles with the Gaussians held. `frames` as assigned to states.time.
solve::Summary refine_all(splat::Engine& engine, const chain::Chain& chain, const capture::Capture& capture,
                          const std::vector<FrameViews>& frames, const splat::Gaussians& gaussians,
                          const std::vector<int>& selected, int iterations, const AnglePrior& prior, chain::States& states);

}  // namespace chainsplat::recognition
