// batch.h - many trainings: captures x settings x seeds of a job file, each one a run folder DIR/<name>.
//
// DIR/batch.json is the plan (what 'status', 'collect' and a Slurm task read), DIR/logs/<name>.txt what a training
// said, DIR/logs/<name>.json how it ended. A job's state is read from these and its run folder alone: there is no other
// record that could disagree.
#pragma once
#include <cstdint>
#include <string>
#include <vector>

#include "chainsplat/core.h"

namespace chainsplat::tools {

struct BatchJob {
  std::string name;      // of its run folder; the capture's, and every setting that is a list in the job file
  std::string capture;   // absolute path
  std::string settings;  // the same settings for a reader, "joints=6 mode=paper"; empty: the file has no lists
  std::uint64_t seed = 0;
  std::vector<std::string> arguments;  // of train, without capture, folder and seed
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

std::string status_text(const BatchPlan& plan, const Path& folder);
std::string status_json(const BatchPlan& plan, const Path& folder);

// --- batch_collect.cpp ---------------------------------------------------------------------------
// Writes results.csv, results.json and results.html into `folder`.
void collect(const BatchPlan& plan, const Path& folder);

}  // namespace chainsplat::tools
