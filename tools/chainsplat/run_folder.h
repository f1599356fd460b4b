// run_folder.h - what the program keeps in a run folder beside the twin, and how it tells of the result.
#pragma once
#include <string>
#include <vector>

#include "chainsplat/capture.h"
#include "chainsplat/eval.h"
#include "chainsplat/twin.h"

namespace chainsplat::tools {

inline constexpr const char* kBaseFile = "base.tum";              // the capture's own base motion
inline constexpr const char* kCovarianceFile = "covariance.csv";  // of the recognized angles
inline constexpr const char* kMetricsFile = "metrics.json";
inline constexpr const char* kLogFile = "log.jsonl";
inline constexpr const char* kCheckpointFolder = "checkpoint";
inline constexpr const char* kLockFile = "checkpoint/lock";  // held by the process that trains
// All that a training leaves in its run folder, but the checkpoint folder.
inline constexpr const char* kRunFiles[] = {"twin.json",  "gaussians.ply", "states.csv", "rollout.csv",
                                            kMetricsFile, kLogFile,        kBaseFile,    kCovarianceFile};

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
// Removes what a killed process left half-written of a run's files and checkpoints (core::write_file's temporary files).
void remove_half_written(const Path& run);

// A twin that knows what the capture says of its scene, and nothing yet of the rope.
twin::Twin twin_in_scene(const capture::Capture& capture);
// The twin in `run` with something recognized in it. Throws InputError.
twin::Twin load_twin(const Path& run);
void check_drawable(const twin::Twin& twin, const Path& run);  // throws InputError where it has no Gaussians
// The base motion of `file` ("-": standard input).
trajectory::Trajectory read_base(const std::string& file);
// The base motion of the capture that the twin was made from, as kept in its folder. Throws InputError.
trajectory::Trajectory own_base(const Path& run);
// The same, for work on the states: throws InputError too where the base does not cover their times.
trajectory::Trajectory own_base(const Path& run, const chain::States& states);
dynamics::Model model_of(const twin::Twin& twin, const Path& run);  // throws InputError before identification

// 'time,c_1_1,c_2_1,c_2_2,...': the lower triangle of every frame's covariance of theta, rad^2.
std::string covariance_csv(const chain::States& states, const std::vector<math::MatrixX>& covariances);
// Empty where the file is missing. Throws InputError where it does not fit the states or holds no covariances.
std::vector<math::MatrixX> read_covariances(const Path& file, const chain::States& states);

std::string hash_text(std::uint64_t hash);

// One named row of metrics a line, with the head line; NaN as '-'.
struct MetricsRow {
  std::string name;
  eval::FrameMetrics metrics;
};
std::string metrics_table(const std::vector<MetricsRow>& rows);
// { "recognized": M, "rollout": M }; null pointers are left out.
std::string metrics_json(const eval::Metrics* recognized, const eval::Metrics* rollout);

}  // namespace chainsplat::tools
