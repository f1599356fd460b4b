// chainsplat/run_folder.h - what is kept in a run folder beside the twin: base motion, covariances, metrics, log, lock.
#pragma once
#include <fstream>
#include <optional>
#include <string>
#include <vector>

#include "chainsplat/capture.h"
#include "chainsplat/eval.h"
#include "chainsplat/twin.h"

namespace chainsplat::pipeline {

inline constexpr const char* kBaseFile = "base.tum";              // the capture's own base motion
inline constexpr const char* kCovarianceFile = "covariance.csv";  // of the recognized angles
inline constexpr const char* kMetricsFile = "metrics.json";
inline constexpr const char* kLogFile = "log.jsonl";
inline constexpr const char* kReportFile = "report.html";
inline constexpr const char* kCheckpointFolder = "checkpoint";
inline constexpr const char* kLockFile = "checkpoint/lock";  // held by the process that trains
// All that a training leaves in its run folder, but the checkpoint folder.
inline constexpr const char* kRunFiles[] = {"twin.json", "gaussians.ply", "states.csv",    "rollout.csv", kMetricsFile,
                                            kLogFile,    kBaseFile,       kCovarianceFile, kReportFile};

// One process at a time in a folder: the lock ends with the process, however that ends.
class FolderLock {
 public:
  // Makes `file` and locks it. Throws InputError when another process has it; warns where the file system has no locks.
  explicit FolderLock(const Path& file);
  ~FolderLock();
  FolderLock(const FolderLock&) = delete;
  FolderLock& operator=(const FolderLock&) = delete;

 private:
  int file_ = -1;
};
bool is_locked(const Path& file);  // by any process; makes nothing

// Throws InputError where something else stands in the place of a run's files, so that they could not be written.
void check_run_files(const Path& run);
// Removes a run's files; their names are ours, and nothing else is touched.
void remove_run_files(const Path& run);
// Removes the checkpoint folder and what is ours in it; it stays where somebody else's files are.
void remove_checkpoint_folder(const Path& run);
// Removes what a killed process left half-written of a run's files and checkpoints (core::write_file's temporary
// files).
void remove_half_written(const Path& run);

// The log of a run: a JSON record per interval with stage, iteration, total, loss, psnr and the seconds since it was
// opened. Lines are added to a file that exists.
class ProgressLog {
 public:
  explicit ProgressLog(const Path& file);  // throws InputError where it cannot be opened
  void write(const core::Progress& progress);
  void write(const std::string& json);  // an object, at once, with the seconds

 private:
  std::ofstream file_;
  std::string stage_;
  double opened_ = core::seconds_now(), last_ = 0.0;
};

// A twin that knows what the capture says of its scene, and nothing yet of the rope.
twin::Twin twin_in_scene(const capture::Capture& capture);
// The twin in `run` with something recognized in it. Throws InputError.
twin::Twin load_twin(const Path& run);
void check_drawable(const twin::Twin& twin, const Path& run);  // throws InputError where it has no Gaussians
Path input_path(const Path& name);                             // the file to open: standard input for "-"
trajectory::Trajectory read_base(const Path& file);            // a TUM file as a fitted motion; throws InputError
// The base motion of the capture that the twin was made from, as kept in its folder. Throws InputError.
trajectory::Trajectory own_base(const Path& run);
// The same, for work on the states: throws InputError too where the base does not cover their times.
trajectory::Trajectory own_base(const Path& run, const chain::States& states);
// Cameras, clocks and base of the capture that the twin was made from, as corrected, without its frames. `moved`: where
// it is now; empty: where the twin says. None where it is not there any more; throws InputError where it is another
// one.
std::optional<capture::Capture> own_recording(const twin::Twin& twin, const Path& run, const Path& moved = {});
dynamics::Model model_of(const twin::Twin& twin, const Path& run);  // throws InputError before identification

// 'time,c_1_1,c_2_1,c_2_2,...': the lower triangle of every frame's covariance of theta, rad^2.
std::string covariance_csv(const chain::States& states);
// Empty where the file is missing. Throws InputError where it does not fit the states or holds no covariances.
std::vector<math::MatrixX> read_covariances(const Path& file, const chain::States& states);

// { "recognized": M, "rollout": M }; null pointers are left out.
std::string metrics_json(const eval::Metrics* recognized, const eval::Metrics* rollout);

// --- where results may go --------------------------------------------------------------------------------------------

// Throws InputError unless `folder` can be filled: it is absent or empty, or `overwrite`. Makes nothing.
void check_output_folder(const Path& folder, bool overwrite, const std::string& mend);
// Throws InputError where `folder`, that results go to, is the folder of the capture they are made from.
void check_not_capture(const Path& folder, const Path& capture);
// Throws InputError unless `file` can be made: its folder exists and it is no folder itself. "-": standard output.
void check_output_file(const std::string& file);
// What an error is once work has begun, an input's fault too; `kept` says what there is.
WorkError broken_off(const Error& error, const std::string& kept);

}  // namespace chainsplat::pipeline
