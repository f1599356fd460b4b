// batch_run.cpp - the jobs of a batch as child processes of the program.
#include <fcntl.h>
#include <poll.h>
#include <sys/prctl.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <csignal>
#include <cstdio>
#include <deque>
#include <map>

#include "chainsplat/batch.h"
#include "chainsplat/run_folder.h"

namespace chainsplat::pipeline {

namespace {

namespace fs = std::filesystem;

constexpr double kLookSeconds = 0.2;  // between looks at the children
// The trainings of a batch that was killed need a moment to leave their checkpoints: a job whose folder is in use lets
// others go first, at most so long.
constexpr double kPatienceSeconds = 60.0;
constexpr int kWrongInput = 2;  // exit code of the program
constexpr int kMostAttempts = 2;

struct Child {
  const BatchJob* job;
  double start;  // s
};

// A batch on its way.
struct Work {
  const Path& folder;
  const BatchOptions& options;
  const BatchListener& listener;
  std::deque<const BatchJob*> queue;
  std::map<const BatchJob*, int> attempts;
  std::map<pid_t, Child> children;
  BatchOutcome outcome;
  double begun = core::seconds_now();

  void tell(const std::string& line) const {
    if (listener.message) listener.message(line);
  }
  void show(bool at_once) const {
    if (!listener.progress) return;
    std::vector<const BatchJob*> running;
    for (const auto& [pid, child] : children) running.push_back(child.job);
    listener.progress(outcome, running, at_once);
  }
};

std::vector<std::string> command_line(const Path& folder, const BatchJob& job, const BatchOptions& options) {
  std::vector<std::string> line = {"chainsplat",    "train",
                                   job.capture,     "--output=" + (folder / job.name).string(),
                                   "--resume",      "--seed=" + std::to_string(job.seed),
                                   "--no-progress", "--threads=" + std::to_string(options.threads)};
  if (!options.device.empty()) line.push_back("--device=" + options.device);
  line.insert(line.end(), job.arguments.begin(), job.arguments.end());
  return line;
}

pid_t start(const Path& folder, const BatchJob& job, const BatchOptions& options) {
  std::vector<std::string> line = command_line(folder, job, options);
  std::vector<char*> arguments;
  for (std::string& word : line) arguments.push_back(word.data());
  arguments.push_back(nullptr);
  const std::string said = log_file(folder, job).string(), program = options.program.string();
  const pid_t parent = ::getpid(), child = ::fork();
  if (child < 0) throw WorkError(job.name, "no process can be started", "stop other work or run fewer in `parallel`");
  if (child > 0) return child;
  // only calls that are safe between fork and exec
  ::setpgid(0, 0);                     // Ctrl-C reaches the batch, which passes it on once
  ::prctl(PR_SET_PDEATHSIG, SIGTERM);  // a killed batch leaves checkpoints, not orphans
  if (::getppid() != parent) ::_exit(1);
  const int in = ::open("/dev/null", O_RDONLY), out = ::open(said.c_str(), O_WRONLY | O_CREAT | O_TRUNC, 0644);
  if (in >= 0) ::dup2(in, STDIN_FILENO);
  if (out >= 0) {
    ::dup2(out, STDOUT_FILENO);
    ::dup2(out, STDERR_FILENO);
  }
  ::execv(program.c_str(), arguments.data());
  ::_exit(127);
}

// The last line of error in what a training said.
std::string error_line(const Path& file) {
  constexpr std::string_view kMark = "chainsplat: error: ";
  const std::string text = core::read_file(file);
  const std::size_t at = text.rfind(kMark);
  if (at == std::string::npos) return "";
  const std::size_t end = text.find('\n', at);
  return text.substr(at + kMark.size(), end == std::string::npos ? end : end - at - kMark.size());
}

void pass_on_stop(Work& work) {
  const int signal = core::stop_requested();
  if (!signal || work.outcome.signal) return;
  work.outcome.signal = signal;
  work.tell("stopping: " + std::to_string(work.children.size()) + " trainings leave checkpoints");
  for (const auto& [pid, child] : work.children) ::kill(pid, signal);
}

void start_what_fits(Work& work) {
  while (!work.outcome.signal && !work.queue.empty() &&
         static_cast<int>(work.children.size()) < work.options.parallel) {
    const auto at = std::find_if(work.queue.begin(), work.queue.end(), [&](const BatchJob* job) {
      return core::seconds_now() - work.begun > kPatienceSeconds || !is_locked(work.folder / job->name / kLockFile);
    });
    if (at == work.queue.end()) return;
    const BatchJob* const job = *at;
    work.queue.erase(at);
    ++work.attempts[job];
    work.children[start(work.folder, *job, work.options)] = {job, core::seconds_now()};
  }
}

// What is known of a training that has ended with `status`, after `seconds` more.
JobEnd end_of(const Path& folder, const BatchJob& job, int status, double seconds) {
  JobEnd end, before;
  if (load_end(folder, job, before)) end.seconds = before.seconds;
  end.arguments = job.arguments;
  end.seconds += seconds;
  end.code = WIFSIGNALED(status) ? 128 + WTERMSIG(status) : WEXITSTATUS(status);
  end.stopped = !WIFSIGNALED(status) && (end.code == 128 + SIGINT || end.code == 128 + SIGTERM ||
                                         (end.code == 0 && fs::exists(folder / job.name / kCheckpointFolder)));
  if (end.code == 0 || end.stopped) return end;
  end.error = error_line(log_file(folder, job));
  if (end.error.empty())
    end.error = WIFSIGNALED(status) ? "killed by signal " + std::to_string(WTERMSIG(status))
                                    : "ended with exit code " + std::to_string(end.code);
  return end;
}

void record_end(Work& work, const BatchJob& job, const JobEnd& end) {
  char seconds[32];
  std::snprintf(seconds, sizeof seconds, " (%.0f s)", end.seconds);
  const std::string name = job.name + seconds;
  if (end.stopped) {
    work.tell("stopped  " + name);
  } else if (end.code == 0) {
    ++work.outcome.done;
    work.tell("done     " + name);
  } else if (end.code != kWrongInput && work.attempts[&job] < kMostAttempts && !work.outcome.signal) {
    work.tell("again    " + name + ": " + end.error);
    work.queue.push_back(&job);
  } else {
    ++work.outcome.failed;
    work.tell("FAILED   " + name + ": " + end.error);
  }
}

}  // namespace

Path log_file(const Path& folder, const BatchJob& job) { return folder / "logs" / (job.name + ".txt"); }

std::vector<const BatchJob*> unfinished(const BatchPlan& plan, const Path& folder) {
  std::vector<const BatchJob*> jobs;
  for (const BatchJob& job : plan.jobs) {
    JobEnd end;
    std::error_code error;
    if (load_end(folder, job, end) && end.arguments != job.arguments && fs::exists(folder / job.name, error))
      throw InputError((folder / job.name).string(), "was made with other options than the job file says now",
                       "name another folder, remove this run, or make the setting a list (it is then in the name)");
    if (state_of(folder, job).kind != JobState::Kind::done) jobs.push_back(&job);
  }
  return jobs;
}

BatchOutcome run_jobs(const Path& folder, const std::vector<const BatchJob*>& jobs, const BatchOptions& options,
                      const BatchListener& listener) {
  Work work{folder, options, listener, {jobs.begin(), jobs.end()}, {}, {}, {}};
  while (!work.children.empty() || (!work.queue.empty() && !work.outcome.signal)) {
    pass_on_stop(work);
    start_what_fits(work);
    int status = 0;
    const pid_t ended = ::waitpid(-1, &status, WNOHANG);
    if (ended <= 0) {
      work.show(false);
      ::poll(nullptr, 0, static_cast<int>(1e3 * kLookSeconds));
      continue;
    }
    const auto at = work.children.find(ended);
    if (at == work.children.end()) continue;
    const Child child = at->second;
    const JobEnd end = end_of(folder, *child.job, status, core::seconds_now() - child.start);
    save_end(folder, *child.job, end);
    record_end(work, *child.job, end);
    work.children.erase(at);
    work.show(true);
  }
  return work.outcome;
}

}  // namespace chainsplat::pipeline
