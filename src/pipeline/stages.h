// stages.h - the stages of train and identify, on a twin in memory.
#pragma once
#include <string>
#include <vector>

#include "chainsplat/gpu.h"
#include "chainsplat/identification.h"
#include "chainsplat/pipeline.h"
#include "chainsplat/silhouette.h"
#include "chainsplat/solve.h"

namespace chainsplat::pipeline {

// Measures its own life and adds it to the seconds of the stage.
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

// The rope's outlines fitted by a chain of many joints, before anything of the capture is corrected.
struct FirstFit {
  chain::Chain chain;
  silhouette::SequenceFit sequence;
};
constexpr int kFirstJoints = 16;  // with eight, the clamp's bend is taken for a wrong length (design.md, 'Corrections')
FirstFit first_fit(const capture::Capture& capture, int joints = kFirstJoints);

// Views of cameras with a rolling shutter as if they had been read at once, by the motion that they show
// (chainsplat/shutter.h).
void read_at_once(capture::Capture& capture);

// Estimates what `capture` was given wrongly, mends it, and says so in the verdict. `fixed`: groups taken as given.
// Joints and bending are its own, so that what the twin's chain cannot follow is not taken for a fault of the capture.
// Where a finding is `impossible` nothing is estimated, unless `anyway`.
struct Corrected {
  capture::Corrections corrections;
  math::MatrixX covariance;  // silhouette::CorrectionFit's; empty where nothing was surely wrong
  std::vector<capture::Finding> verdict;
};
Corrected correct(capture::Capture& capture, const std::vector<std::string>& fixed, bool anyway);

// What the recording says of the groups in `fixed`, which may be "all", where it says something else than was given:
// findings that are not corrected. With "all" what is impossible, too.
std::vector<capture::Finding> contradictions(capture::Capture capture, const std::vector<std::string>& fixed);

// What the twin and its capture say of how to identify it.
identification::Options identification_options(const twin::Twin& twin, bool paper, std::uint64_t seed);
// Adds to the verdict what the views left open about the plane that a planar twin bends in, where that is much.
void judge_bending(twin::Twin& twin, const silhouette::BendingChoice& choice);
// Adds that to the states' covariances, as far as ropes do leave their plane (mathematics.md 6.11): seen from the side,
// what leaves the plane looks like bends.
void widen_by_unseen_bends(twin::Twin& twin, const silhouette::BendingChoice& choice);
// Adds to the verdict where the recognized rope is in no camera's mask, as behind a gripper: what is recognized there
// is a guess. `capture`: its views.
void judge_hidden(twin::Twin& twin, const capture::Capture& capture);
// What the verdict says of the identified motion (twin.rollout) beside the recognized one (twin.states), anew.
void judge_motion(twin::Twin& twin, const trajectory::Trajectory& base);

// Takes what identification found; `base`: of the recording, for the twin's validity.
void adopt(twin::Twin& twin, const trajectory::Trajectory& base, identification::Result found);

// Tells the listener how a stage's fit ended: a record {"stage", "solver"} and a detail.
void tell_fit(const std::string& stage, const solve::Summary& summary);

// covariance_csv() into a file, row by row: of many angles over a long time all of it would fill the memory.
void write_covariances(const Path& file, const chain::States& states);

// Rolls the identified twin out over its recognized times. `run`: its folder, for messages.
void roll_out(twin::Twin& twin, const trajectory::Trajectory& base, const Path& run);

// Writes the run's report.html from what stands in its folder.
void write_report(const Path& run);

// Throws InputError unless `twin` can be refined: recognized fast, with covariances, not refined before.
void check_joint(const twin::Twin& twin, const Path& run);
// The frames that the twin in `run` was made from. Throws InputError where they are gone or have changed.
capture::Capture load_own_capture(const twin::Twin& twin, const Path& run);
// Refines an identified twin, the covariances of its states too, with its capture's images (undistorted). The caller
// saves both.
solve::Summary refine(twin::Twin& twin, const capture::Capture& capture, gpu::Device& device, std::uint64_t seed);

}  // namespace chainsplat::pipeline
