// chainsplat/pipeline.h - what the commands of the program do, each as one call.
//
// A call takes folders and an options struct, whose check() throws an InputError that names the wrong field; it reports
// to `listener` (core.h), which may stop it, and returns its results as values. One call at a time in a process: there
// is one listener. Every call throws InputError where the request or its input is wrong, and then nothing was written;
// WorkError where the work failed, and then what exists is kept; Interrupted where it was stopped. Files: run_folder.h.
#pragma once
#include <cstdint>
#include <functional>
#include <iosfwd>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "chainsplat/eval.h"
#include "chainsplat/solve.h"
#include "chainsplat/twin.h"

namespace chainsplat::capture {
struct InMemory;
}
namespace chainsplat::force {
struct Estimate;
}

namespace chainsplat::pipeline {

inline constexpr int kMostJoints = 64;
inline constexpr std::size_t kLeastFrames = 3;  // that identification needs (chainsplat/identification.h)

// --- train: recognize, identify, roll out, evaluate ------------------------------------------------------------------

enum class Stage { recognize, identify, rollout, evaluate };

struct TrainOptions {
  std::optional<int> joints;  // none: 8, 12, 16 or 24, as many as the rope's bends ask for (paper: 8)
  std::optional<chain::Bending>
      bending;         // none: planar on a table; in free space spatial unless the rope stays in a plane
  bool twist = false;  // also a twist axis per joint
  int every = 5;       // the Gaussians are trained on every n-th frame
  capture::FrameRange frames;
  twin::Mode mode = twin::Mode::fast;
  std::vector<Stage> stages;  // empty: all that are not done. A stage that is named is done again, but recognition
  bool joint = false;         // refine angles, Gaussians and dynamics together after identification
  bool resume = false;        // go on in a run folder that was left unfinished
  bool force = false;         // begin again in a run folder that is not empty
  Path picture;               // PNG of observed beside rendered frames; empty: none
  // What is taken as given instead of estimated with the angles: groups of capture::corrected_quantities(), or "all".
  std::vector<std::string> fixed;
  // What mode paper changes, to see what it does, with commas between: background=black|white|random, growth=no,
  // resets=none|opacity|links|both, gaussians=N, iterations=N.
  std::string paper;
  bool anyway = false;  // go on where the capture contradicts itself so that no twin of it is worth having
  std::uint64_t seed = 0;
  std::string device;  // Vulkan device, its number or a part of its name; empty: chosen

  void check() const;
};

struct TrainResult {
  twin::Twin twin;
  std::optional<eval::Metrics> recognized, rollout;  // none unless evaluated
  // How the fits of the stages that ran ended: "recognize", "identify", "joint".
  std::vector<std::pair<std::string, solve::Summary>> fits;
};

// What trainings in one process can hand on to the next, which is then cheaper and has the same bits: the opened device
// with its kernels, and the last capture as it was read and corrected, until a file that it names changes. It costs the
// memory of that capture's views once more; what was said about reading and correcting it is said again. One call at a
// time uses it.
struct Workspace;
std::shared_ptr<Workspace> make_workspace();

// Makes the twin of the capture (its folder or capture.json) in the folder `run`. Reports in stages "recognize",
// "identify", "joint", "rollout", "evaluate", and writes them to log.jsonl. A call that was stopped goes on with
// `resume`, with the same bits as if nothing had happened. `workspace`: what earlier calls left; null: nothing is kept.
TrainResult train(const Path& capture, const Path& run, const TrainOptions& options,
                  const core::Listener& listener = {}, Workspace* workspace = nullptr);
// The same of a capture that is in memory (in_memory.h); the run does not say where its capture lies.
TrainResult train(const capture::InMemory& capture, const Path& run, const TrainOptions& options,
                  const core::Listener& listener = {}, Workspace* workspace = nullptr);

// What of a capture was given wrongly by a little, without training: what train corrects, and what it says of it.
struct Examination {
  capture::Corrections corrections;
  std::vector<capture::Finding> verdict;
};
Examination examine(const Path& capture, const core::Listener& listener = {});

// The fields of TrainOptions that a batch may set, by name, and a value of one from its text ("true" or "false" for a
// flag, commas between stages). Throws InputError, which says by `where` whose text it is.
struct Setting {
  std::string name;
  bool flag = false;
};
const std::vector<Setting>& settings();
void set(TrainOptions& options, const std::string& name, const std::string& text, const std::string& where);
std::vector<Stage> read_stages(const std::string& text, const std::string& where);  // empty text: none
const char* stage_text(Stage stage);

// --- identify --------------------------------------------------------------------------------------------------------

struct IdentifyOptions {
  bool joint = false;  // refine angles, Gaussians and dynamics together afterwards; one run, whose capture is there
  std::optional<capture::Payload> payload;  // instead of what the twins know of it
  std::uint64_t seed = 0;
  std::string device;
};

struct IdentifyResult {
  std::vector<twin::Twin> twins;   // one per run, as saved
  std::vector<Path> lost_metrics;  // runs whose metrics.json was of the old parameters, and is removed
};

// Dynamics from recognized states; several runs of one rope get one set of parameters.
IdentifyResult identify(const std::vector<Path>& runs, const IdentifyOptions& options,
                        const core::Listener& listener = {});

struct MarkerOptions {
  bool shape_only = false;                  // fit the states, identify nothing
  std::optional<capture::Payload> payload;  // instead of what the twin knows of it
  std::uint64_t seed = 0;
};
// Dynamics from marker files (marker_files.h). The twin, which may be an empty one, keeps the motion of the first file.
IdentifyResult identify_markers(const Path& run, const std::vector<Path>& files, const MarkerOptions& options,
                                const core::Listener& listener = {});

struct OnlineOptions {
  Path base;            // the base's motion meanwhile, TUM; empty: the capture's own
  double memory = 5.0;  // s, in which old frames fade; infinite: never
};
struct OnlineResult {
  dynamics::Estimates before, now;
  double from = 0.0, to = 0.0;  // s
  int frames = 0, left_out = 0, restarts = 0;
};
// Parameters that follow the rope through the lines of estimates (estimate_lines.h) until they end or a stop is
// requested. `name`: of the lines, for messages.
OnlineResult identify_online(const Path& run, std::istream& lines, const std::string& name,
                             const OnlineOptions& options, const core::Listener& listener = {});

// The stage alone, without files: fills in parameters, initial state, estimates and rollout of a recognized twin.
// The states count by their covariances where they have them. `paper`: the paper's procedure.
void identify_states(twin::Twin& twin, const trajectory::Trajectory& base, bool paper, std::uint64_t seed);

// --- rollout, evaluate -----------------------------------------------------------------------------------------------

struct RolloutOptions {
  Path base;           // base motion, TUM; empty: the capture's own
  Path initial;        // states.csv to start from, its first row; empty: the identified state, with `base` at rest
  double rate = 30.0;  // rows per second

  void check() const;
};
struct RolloutResult {
  twin::Twin twin;
  trajectory::Trajectory base;
  chain::States states;
};
RolloutResult rollout(const Path& run, const RolloutOptions& options, const core::Listener& listener = {});

struct EvaluateOptions {
  capture::FrameRange frames;
  Path picture;  // PNG of observed beside rendered frames; empty: none
  std::string device;
  Path lpips;  // trunk for LPIPS (lpips.h); empty: without
};
struct Evaluation {
  std::optional<eval::Metrics> recognized, rollout;
};
// How well the twin explains a capture: its own, or another one of the same rope (the rollout only, from rest).
Evaluation evaluate(const Path& run, const Path& capture, const EvaluateOptions& options,
                    const core::Listener& listener = {});

// --- force -----------------------------------------------------------------------------------------------------------

struct ForceOptions {
  // The angles over time, one of the two; "-" is standard input, here and below.
  Path states;    // states.csv
  Path estimate;  // lines of estimates (estimate_lines.h), which also tell how the base is off
  Path base;      // base motion, TUM; empty: the capture's own
  // What touches the rope, at most one of these; none: where it is touched is found. What is farther from the rope than
  // three diameters does not touch it.
  std::optional<math::Vector3> contact;  // m, world, at all times
  Path contacts;                         // 'time,x,y,z' a line below a head line; x, y, z empty: nothing touches
  Path hand;                             // point cloud (PLY), m, world, at all times
  bool live = false;  // while states come in: an estimate is told two states after its own, from these and earlier ones

  void check() const;
};
struct ForceResult {
  std::int64_t states = 0, touching = 0;  // that were told, and those among them in which something touches
  bool known_mass = true;                 // false: forces are per kilogram of rope
};
using EachForce = std::function<void(const force::Estimate& estimate, bool known_mass)>;
// The force from outside, told to `each` for every state in order: live as soon as it is known, else when all are. The
// end of a live stream in an error is a WorkError once something has been told.
ForceResult forces(const Path& run, const ForceOptions& options, const EachForce& each,
                   const core::Listener& listener = {});

// --- report ----------------------------------------------------------------------------------------------------------

struct ReportOptions {
  Path capture;  // that the twin was made from; empty: where the twin says that it is, if it is there
  std::vector<std::string> videos;  // cameras whose frames, made small, become a part of the page
  // A rope that was followed; "-" is standard input, for one of the three.
  Path estimate;  // lines of estimates (estimate_lines.h), which also tell how the base is off; empty: none
  Path forces;    // lines of forces (force.h) at times of these estimates; empty: none
  Path base;      // base motion of the estimates, TUM; empty: the capture's own

  void check() const;
};
// The page of a run (report.h), as `train` writes it to report.html, but with videos and what was followed where asked.
std::string report(const Path& run, const ReportOptions& options, const core::Listener& listener = {});

}  // namespace chainsplat::pipeline
