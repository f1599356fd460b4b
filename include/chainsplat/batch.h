// chainsplat/batch.h - many trainings: captures x settings x seeds of a job file, each one a run folder DIR/<name>.
//
// DIR/batch.json is the plan (what 'status', 'collect' and a Slurm task read), DIR/logs/<name>.txt what a training
// said, DIR/logs/<name>.json how it ended. A job's state is read from these and its run folder alone: there is no other
// record that could disagree.
#pragma once
#include <cstdint>
#include <functional>
#include <string>
#include <vector>

#include "chainsplat/core.h"

namespace chainsplat::pipeline {

struct BatchJob {
  std::string name;      // of its run folder; the capture's, and every setting that is a list in the job file
  std::string capture;   // absolute path
  std::string settings;  // the same settings for a reader, "joints=6 mode=paper"; empty: the file has no lists
  std::uint64_t seed = 0;
  std::vector<std::string> arguments;  // of the program's train, without capture, folder and seed: "--joints=6"
};

struct BatchPlan {
  std::vector<BatchJob> jobs;
};

// --- batch_plan.cpp ------------------------------------------------------------------------------
// Throws InputError: not TOML, an unknown key (with the nearest one), a value that train refuses, a glob without a
// match, two jobs with one name.
BatchPlan read_job_file(const Path& file);
void save_plan(const BatchPlan& plan, const Path& folder);
BatchPlan load_plan(const Path& folder);  // throws InputError

// --- batch_state.cpp -----------------------------------------------------------------------------
struct JobState {
  enum class Kind { done, running, stopped, failed, waiting } kind = Kind::waiting;
  std::string detail;  // failed: why; running, stopped: how far
  double seconds = 0;  // of all attempts
};
const char* kind_name(JobState::Kind kind);
JobState state_of(const Path& folder, const BatchJob& job);
std::string progress_of(const Path& run);  // "recognize 120/520", from the last record of its log

// What is known of a job's end, DIR/logs/<name>.json.
struct JobEnd {
  std::vector<std::string> arguments;  // it was made with
  int code = 0;                        // exit code; 128 + n: killed by signal n
  bool stopped = false;                // by a signal, a checkpoint was left
  double seconds = 0;
  std::string error;  // its last line of error
};
void save_end(const Path& folder, const BatchJob& job, const JobEnd& end);
bool load_end(const Path& folder, const BatchJob& job, JobEnd& end);  // false: none there

// --- batch_run.cpp -------------------------------------------------------------------------------
inline constexpr const char* kBatchLock = "logs/lock";  // FolderLock: one process at a time runs a batch

// Jobs that are missing or failed. Throws InputError where one was made with other options than the plan has now.
std::vector<const BatchJob*> unfinished(const BatchPlan& plan, const Path& folder);
Path log_file(const Path& folder, const BatchJob& job);  // what a training said

struct BatchOptions {
  Path program = "/proc/self/exe";  // chainsplat: a training is a process of its own, so that it can fail alone
  std::string device;               // of every training; empty: chosen
  int parallel = 1;                 // trainings at a time
  int threads = 1;                  // host threads of each
};
struct BatchOutcome {
  std::size_t done = 0, failed = 0;
  int signal = 0;  // that stopped it; 0: none did
};
// Told of a batch on its way.
struct BatchListener {
  std::function<void(const std::string&)> message;  // a job ended or is tried again
  // jobs that ended, with those that are running; several times a second, and at once where one has ended
  std::function<void(const BatchOutcome&, const std::vector<const BatchJob*>& running, bool at_once)> progress;
};
// Runs the jobs; one that failed at work (not by its input) is tried once more at the end, for a lost device or a full
// memory may be over then. Where a stop is requested the trainings leave checkpoints, and the same call goes on.
BatchOutcome run_jobs(const Path& folder, const std::vector<const BatchJob*>& jobs, const BatchOptions& options,
                      const BatchListener& listener);

// --- batch_collect.cpp ---------------------------------------------------------------------------
// Writes results.csv, results.json and results.html into `folder`.
void collect(const BatchPlan& plan, const Path& folder);

}  // namespace chainsplat::pipeline
