// chainsplat/recognition.h - masked frames -> link-aware Gaussians and joint angles (paper, "Recognition";
// mathematics.md 2.9).
//
// `fast`: silhouettes give every frame's angles; Gaussians are placed along the links and then refined in turn with the
// angles (Adam on the Gaussians with angles held, Gauss-Newton on each frame's angles with Gaussians held). `paper`:
// the paper's initialization, Adam on everything, both asynchronous resets.
#pragma once
#include <optional>
#include <string>
#include <vector>
#include "chainsplat/capture.h"
#include "chainsplat/silhouette.h"
#include "chainsplat/splat.h"

namespace chainsplat::recognition {

enum class Mode { fast, paper };

enum class Background { black, white, random };  // random: another gray at every iteration

// What `paper` takes from ScrewSplat and 3DGS where the paper prints nothing, and the paper's own resets: each can be
// changed, to see what it does (figures.md, "The paper's own method").
struct PaperChoices {
  int gaussians = 2500;  // at first
  int iterations = 30000;
  Background background = Background::random;
  bool growth = true;  // of Gaussians, and pruning
  bool opacity_resets = true, link_resets = true;
};
// As `key=value,...`: background=black|white|random, growth=yes|no, resets=both|opacity|links|none, gaussians=N,
// iterations=N. The text has what differs from the default. Throws InputError, which says by `where` whose text it is.
PaperChoices read_paper_choices(const std::string& text, const std::string& where);
std::string text_of(const PaperChoices& choices);

struct Options {
  std::optional<int> joints;              // none: as many as the rope's bends ask for (silhouette::choose_joints)
  std::optional<chain::Bending> bending;  // none: auto (design.md, 'Recognition')
  bool twist = false;
  bool height = true;  // how low a rope on a table lies is fitted (silhouette::fit_height); else as its table says
  int every = 5;  // frames that train the Gaussians
  Mode mode = Mode::fast;
  std::uint64_t seed = 0;
  // Most Gaussians that train (fast); 0: 100 a diameter of the rope's length (1,500 for 30 cm of 2 cm). What no camera
  // saw gets others, as dense.
  int budget = 0;
  PaperChoices paper;
  double step = 1.0;    // of Adam's usual step sizes (fast); lowered by itself where the optimization runs away
  Path checkpoint;      // folder for checkpoints; empty: none
  bool resume = false;  // continue from the checkpoint when one is there
};

struct Result {
  chain::Chain chain;
  splat::Gaussians gaussians;
  chain::States states;  // every frame time of the first camera, with thetadot and, if known, covariances
  silhouette::BendingChoice bending;
  silhouette::JointChoice joints;  // 0 where their number was given
  // Of the last refinement of all frames' angles together: one step per frame in `fast`, checked where it is long; rad.
  solve::Summary summary;
};

// Throws WorkError (device lost, diverged), Interrupted after leaving a checkpoint. Reports progress in stage
// "recognize".
Result recognize(gpu::Device& device, const capture::Capture& capture, const Options& options);

// Throws InputError where `options` would resume from a checkpoint of another job: another capture, other frames or
// masks, other options. Writes nothing.
void check_checkpoint(const capture::Capture& capture, const Options& options);
// Removes what recognize() left in a checkpoint folder, and nothing else there.
void remove_checkpoint(const Path& folder);
bool is_checkpoint(const std::string& file_name);  // of a file of such a folder

// --- the two halves of a round of `fast`, for what goes on with a recognized twin ------------------------------------

// What is known of every frame's angles beside the pictures. Empty: nothing.
struct AnglePrior {
  std::vector<math::VectorX> mean;         // a frame
  std::vector<math::MatrixX> information;  // n x n, inverse covariance
};
// What the silhouettes know.
AnglePrior prior_of(const silhouette::SequenceFit& fit);

// Gauss-Newton on every frame's angles with the Gaussians held, from `states`, which is updated with its covariances.
// Returns how all frames ended together; rad.
solve::Summary refine_states(gpu::Device& device, const capture::Capture& capture, const chain::Chain& chain,
                             const splat::Gaussians& gaussians, const AnglePrior& prior, int iterations,
                             chain::States& states);

// Adam on the Gaussians with the angles held, views of every `every`-th frame in random batches.
void polish(gpu::Device& device, const capture::Capture& capture, const chain::Chain& chain,
            const chain::States& states, int every, int steps, std::uint64_t seed, splat::Gaussians& gaussians);

// thetadot from theta by quadratic fits over seven frames.
void differentiate(chain::States& states);

}  // namespace chainsplat::recognition
