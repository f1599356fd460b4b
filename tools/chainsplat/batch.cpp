// batch.cpp - batch: runs the jobs of a job file in child processes of this program, or hands them to Slurm.
#include <fcntl.h>
#include <poll.h>
#include <sys/prctl.h>
#include <sys/wait.h>
#include <unistd.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <csignal>
#include <cstdio>
#include <deque>
#include <iostream>
#include <map>
#include <memory>
#include <sstream>
#include <thread>

#include "batch.h"
#include "chainsplat/gpu.h"
#include "cli.h"
#include "run_folder.h"

namespace chainsplat::tools {

namespace {

namespace fs = std::filesystem;
using Kind = JobState::Kind;

constexpr const char* kBatchLock = "logs/lock";
constexpr double kLookSeconds = 0.2;    // between looks at the children
constexpr double kRedrawSeconds = 1.0;  // a job's log has a record a second
// The trainings of a batch that was killed need a moment to leave their checkpoints: a job whose folder is in use lets
// others go first, at most so long.
constexpr double kPatienceSeconds = 60.0;
constexpr double kPlainSeconds = 30.0;  // between lines where standard error is no terminal

struct Request {
  std::string jobs, out, launcher = "local", time_limit = "1:00:00", sbatch;
  int parallel = 0;       // 0: by the device
  int warn_seconds = 60;  // before the time limit
};

// How many trainings share the device best, and the host threads of each. Measured on lavapipe, see README: a training
// keeps two threads busy for part of its time only, so as many trainings as cores with one thread each do more. On a
// GPU two: one has the device while the other reads, fits and writes on the host (not measured).
int best_parallel(bool software) { return software ? core::threads() : 2; }

struct Child {
  const BatchJob* job;
  double start;
};

Path log_file(const Path& folder, const BatchJob& job) { return folder / "logs" / (job.name + ".txt"); }

// The last line of error in what a training said.
std::string error_line(const Path& file) {
  constexpr std::string_view kMark = "chainsplat: error: ";
  const std::string text = core::read_file(file);
  const std::size_t at = text.rfind(kMark);
  if (at == std::string::npos) return "";
  const std::size_t end = text.find('\n', at);
  return text.substr(at + kMark.size(), end == std::string::npos ? end : end - at - kMark.size());
}

std::vector<std::string> command_line(const Path& folder, const BatchJob& job, const Globals& globals, int threads) {
  std::vector<std::string> line = {"chainsplat",    "train",
                                   job.capture,     "--output=" + (folder / job.name).string(),
                                   "--resume",      "--seed=" + std::to_string(job.seed),
                                   "--no-progress", "--threads=" + std::to_string(threads)};
  if (!globals.device.empty()) line.push_back("--device=" + globals.device);
  line.insert(line.end(), job.arguments.begin(), job.arguments.end());
  return line;
}

pid_t start(const Path& folder, const BatchJob& job, const Globals& globals, int threads) {
  std::vector<std::string> line = command_line(folder, job, globals, threads);
  std::vector<char*> arguments;
  for (std::string& word : line) arguments.push_back(word.data());
  arguments.push_back(nullptr);
  const std::string said = log_file(folder, job).string();
  const pid_t parent = ::getpid(), child = ::fork();
  if (child < 0) throw WorkError(job.name, "no process can be started", "stop other work or lower --jobs");
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
  ::execv("/proc/self/exe", arguments.data());
  ::_exit(127);
}

// The lines of a batch on a terminal, redrawn in place; plain lines elsewhere.
class Board {
 public:
  Board(const Path& folder, std::size_t total, const Globals& globals)
      : folder_(folder),
        total_(total),
        shown_(!globals.quiet && !globals.no_progress),
        terminal_(::isatty(STDERR_FILENO)) {}
  ~Board() { clear(); }
  void message(const std::string& line) {
    clear();
    say(line);
  }
  void draw(std::size_t done, std::size_t failed, const std::map<pid_t, Child>& children, bool now = false) {
    const double time = core::seconds_now();
    if (!shown_ || (!now && time - drawn_ < (terminal_ ? kRedrawSeconds : kPlainSeconds))) return;
    drawn_ = time;
    clear();
    const std::size_t ended = done + failed, fresh = ended - first_;
    std::string line = "batch " + std::to_string(ended) + "/" + std::to_string(total_);
    if (failed > 0) line += ", " + std::to_string(failed) + " failed";
    if (fresh > 0) {
      const double left = (time - start_) / static_cast<double>(fresh) * static_cast<double>(total_ - ended);
      line += ", about " + std::to_string(static_cast<long>(left / 60.0 + 0.5)) + " min to go";
    }
    if (!terminal_) {
      std::fprintf(stderr, "%s\n", line.c_str());
      return;
    }
    std::fprintf(stderr, "%s\n", line.c_str());
    for (const auto& [pid, child] : children)
      std::fprintf(stderr, "  %.60s  %.60s\n", core::printable(child.job->name).c_str(), core::printable(progress_of(folder_ / child.job->name)).c_str());
    lines_ = 1 + children.size();
  }
  void begin(std::size_t already) { first_ = already; }

 private:
  void clear() {
    for (; lines_ > 0; --lines_) std::fputs("\x1b[1A\x1b[2K", stderr);
  }
  Path folder_;
  std::size_t total_, first_ = 0, lines_ = 0;
  bool shown_, terminal_;
  double drawn_ = 0.0, start_ = core::seconds_now();
};

struct Outcome {
  std::size_t done = 0, failed = 0;
  int signal = 0;  // that stopped it
};

// Runs `todo` in at most `parallel` processes; a job that failed at work (not by its input) is tried once more at the
// end, for a lost device or a full memory may be over then.
Outcome run_jobs(const Path& folder, const std::vector<const BatchJob*>& todo, std::size_t already, int parallel,
                 int threads, const Globals& globals) {
  Outcome outcome;
  std::deque<const BatchJob*> queue(todo.begin(), todo.end());
  std::map<const BatchJob*, int> attempts;
  std::map<pid_t, Child> children;
  Board board(folder, already + todo.size(), globals);
  board.begin(already);
  const double begun = core::seconds_now();
  while (!children.empty() || (!queue.empty() && !outcome.signal)) {
    if (const int signal = core::stop_requested(); signal && !outcome.signal) {
      outcome.signal = signal;
      board.message("stopping: " + std::to_string(children.size()) + " trainings leave checkpoints");
      for (const auto& [pid, child] : children) ::kill(pid, signal);
    }
    while (!outcome.signal && !queue.empty() && static_cast<int>(children.size()) < parallel) {
      const auto at = std::find_if(queue.begin(), queue.end(), [&](const BatchJob* job) {
        return core::seconds_now() - begun > kPatienceSeconds || !is_locked(folder / job->name / kLockFile);
      });
      if (at == queue.end()) break;
      const BatchJob* const job = *at;
      queue.erase(at);
      ++attempts[job];
      children[start(folder, *job, globals, threads)] = {job, core::seconds_now()};
    }
    int status = 0;
    const pid_t ended = ::waitpid(-1, &status, WNOHANG);
    if (ended <= 0) {
      board.draw(already + outcome.done, outcome.failed, children);
      ::poll(nullptr, 0, static_cast<int>(1e3 * kLookSeconds));
      continue;
    }
    const auto at = children.find(ended);
    if (at == children.end()) continue;
    const BatchJob& job = *at->second.job;
    JobEnd end, before;
    if (load_end(folder, job, before)) end.seconds = before.seconds;
    end.arguments = job.arguments;
    end.seconds += core::seconds_now() - at->second.start;
    end.code = WIFSIGNALED(status) ? 128 + WTERMSIG(status) : WEXITSTATUS(status);
    end.stopped = end.code == 128 + SIGINT || end.code == 128 + SIGTERM ||
                  (end.code == 0 && fs::exists(folder / job.name / kCheckpointFolder));
    if (WIFSIGNALED(status)) end.stopped = false;
    if (end.code != 0 && !end.stopped) end.error = error_line(log_file(folder, job));
    if (end.code != 0 && end.error.empty() && !end.stopped)
      end.error = WIFSIGNALED(status) ? "killed by signal " + std::to_string(WTERMSIG(status))
                                      : "ended with exit code " + std::to_string(end.code);
    save_end(folder, job, end);
    char seconds[32];
    std::snprintf(seconds, sizeof seconds, " (%.0f s)", end.seconds);
    constexpr int kWrongInput = 2, kMostAttempts = 2;
    if (end.stopped) {
      board.message("stopped  " + job.name + seconds);
    } else if (end.code == 0) {
      ++outcome.done;
      board.message("done     " + job.name + seconds);
    } else if (end.code != kWrongInput && attempts[&job] < kMostAttempts && !outcome.signal) {
      board.message("again    " + job.name + seconds + ": " + end.error);
      queue.push_back(&job);
    } else {
      ++outcome.failed;
      board.message("FAILED   " + job.name + seconds + ": " + end.error);
    }
    children.erase(at);
    board.draw(already + outcome.done, outcome.failed, children, true);
  }
  return outcome;
}

// Those that are missing or failed. Throws InputError where a job was made with other options.
std::vector<const BatchJob*> what_is_missing(const BatchPlan& plan, const Path& folder) {
  std::vector<const BatchJob*> todo;
  for (const BatchJob& job : plan.jobs) {
    JobEnd end;
    std::error_code error;
    if (load_end(folder, job, end) && end.arguments != job.arguments && fs::exists(folder / job.name, error))
      throw InputError((folder / job.name).string(), "was made with other options than the job file says now",
                       "name another folder, remove this run, or make the setting a list (it is then in the name)");
    if (state_of(folder, job).kind != Kind::done) todo.push_back(&job);
  }
  return todo;
}

std::string quoted(const std::string& text) {
  std::string out = "'";
  for (const char letter : text) out += letter == '\'' ? std::string("'\\''") : std::string(1, letter);
  return out + "'";
}

// For a name in which Slurm fills in what follows a percent sign.
std::string plain(const std::string& text) {
  std::string out;
  for (const char letter : text) out.append(letter == '%' ? 2 : 1, letter);
  return out;
}

std::vector<std::string> words_of(const std::string& text) {
  std::istringstream stream(text);
  std::vector<std::string> words;
  for (std::string word; stream >> word;) words.push_back(word);
  return words;
}

bool on_path(const std::string& program) {
  const char* path = std::getenv("PATH");
  std::istringstream folders(path ? path : "");
  for (std::string folder; std::getline(folders, folder, ':');)
    if (::access((Path(folder) / program).c_str(), X_OK) == 0) return true;
  return false;
}

// A job array, one task a job. A task that is warned of its time limit leaves a checkpoint and asks to be queued again.
void submit(const BatchPlan& plan, const Path& folder, const std::vector<const BatchJob*>& todo, const Request& request,
            const Globals& globals) {
  std::string indices;
  for (const BatchJob* job : todo) indices += (indices.empty() ? "" : ",") + std::to_string(job - plan.jobs.data());
  const std::string program = fs::read_symlink("/proc/self/exe").string();
  std::string script =
      "#!/bin/bash\n# written by 'chainsplat batch --launcher slurm'; the program takes the shell's place,\n"
      "# so that the warning signal reaches it\nexec " +
      quoted(program) + " batch task " + quoted(folder.string()) + " --no-progress";
  if (!globals.device.empty()) script += " --device=" + quoted(globals.device);
  if (globals.threads > 0) script += " --threads=" + std::to_string(globals.threads);
  core::write_file(folder / "logs/slurm.sh", script + "\n");
  std::string command = "sbatch --parsable --job-name=chainsplat --requeue --open-mode=append --array=" + indices +
                        " --time=" + quoted(request.time_limit) + " --signal=B:USR1@" +
                        std::to_string(request.warn_seconds) +
                        " --output=" + quoted(plain((folder / "logs").string()) + "/slurm-%a.txt");
  for (const std::string& word : words_of(request.sbatch)) command += " " + quoted(word);
  command += " " + quoted((folder / "logs/slurm.sh").string());
  say_more(command);
  FILE* pipe = ::popen((command + " 2>&1").c_str(), "r");
  std::string answer;
  char part[256];
  while (pipe && std::fgets(part, sizeof part, pipe)) answer += part;
  const int status = pipe ? ::pclose(pipe) : -1;
  while (!answer.empty() && answer.back() == '\n') answer.pop_back();
  if (status != 0) throw WorkError("sbatch", answer.empty() ? "failed" : answer, "see to Slurm, then run this again");
  std::cout << "slurm job " << answer << ": " << todo.size() << " tasks; 'chainsplat batch status " << folder.string()
            << "' tells how far they are\n";
}

void batch(const Globals& globals, const Request& request) {
  if (request.jobs.empty() || request.out.empty())
    throw InputError("chainsplat batch", "needs JOBS.toml and -o DIR", "see 'chainsplat batch --help'");
  const bool slurm = request.launcher == "slurm";
  const BatchPlan plan = read_job_file(request.jobs);
  const Path folder = fs::absolute(request.out).lexically_normal();
  const bool known = fs::exists(folder / "batch.json");
  check_output_folder(folder, known, "name another folder; this one is not of a batch");
  if (slurm && !on_path("sbatch"))
    throw InputError("--launcher slurm", "there is no 'sbatch' on the PATH",
                     "run it where Slurm is (Debian: slurm-client), or without --launcher");
  const std::vector<const BatchJob*> todo = what_is_missing(plan, folder);
  watch_signals();
  make_folder(folder / "logs");
  const FolderLock lock(folder / kBatchLock);
  save_plan(plan, folder);
  const std::size_t already = plan.jobs.size() - todo.size();
  say(std::to_string(plan.jobs.size()) + " jobs" +
      (already > 0 ? ", " + std::to_string(already) + " of them done already" : ""));
  if (slurm) {
    if (!todo.empty()) submit(plan, folder, todo, request, globals);
    return;
  }
  Outcome outcome;
  if (!todo.empty()) {
    const int parallel =
        request.parallel > 0
            ? request.parallel
            : std::min<int>(best_parallel(gpu::choose_device(globals.device).software), static_cast<int>(todo.size()));
    const int threads = globals.threads > 0 ? globals.threads : std::max(1, core::threads() / parallel);
    outcome = run_jobs(folder, todo, already, parallel, threads, globals);
  }
  if (outcome.signal) {
    say("stopped; the same command goes on from here");
    throw Interrupted(outcome.signal);
  }
  collect(plan, folder);
  if (globals.json) {
    std::cout << status_json(plan, folder);
  } else {
    std::cout << already + outcome.done << " of " << plan.jobs.size()
              << " jobs done; results: " << (folder / "results.html").string() << "\n";
  }
  if (outcome.failed > 0)
    throw WorkError(folder.string(),
                    std::to_string(outcome.failed) + " of " + std::to_string(plan.jobs.size()) + " jobs failed",
                    "'chainsplat batch status' tells why; the same command tries them again");
}

// One job, as a task of Slurm.
void task(const Globals& globals, const std::string& dir, int index) {
  const Path folder = fs::absolute(dir).lexically_normal();
  const BatchPlan plan = load_plan(folder);
  if (index < 0)
    if (const char* given = std::getenv("SLURM_ARRAY_TASK_ID")) index = std::atoi(given);
  if (index < 0 || index >= static_cast<int>(plan.jobs.size()))
    throw InputError("batch task", "there is no job " + std::to_string(index), "give --index 0 and up");
  const BatchJob& job = plan.jobs[index];
  watch_signals();
  if (state_of(folder, job).kind == Kind::done) return;
  const Outcome outcome = run_jobs(folder, {&job}, 0, 1, core::threads(), globals);
  if (outcome.signal == SIGUSR1)
    if (const char* id = std::getenv("SLURM_JOB_ID")) {
      say("time limit near: a checkpoint was left, the task is queued again");
      const std::string command = std::string("scontrol requeue ") + quoted(id);
      if (std::system(command.c_str()) != 0)
        throw WorkError("scontrol requeue", "failed", "submit the batch again, it goes on from the checkpoint");
      // Slurm ends this process now
      ::poll(nullptr, 0, 60000);
    }
  if (outcome.signal) throw Interrupted(outcome.signal);
  if (outcome.failed > 0)
    throw WorkError(job.name, state_of(folder, job).detail, "see " + log_file(folder, job).string());
}

}  // namespace

void add_batch_command(CLI::App& app, const Globals& globals, Job& job) {
  CLI::App* command = app.add_subcommand("batch", "Many trainings: captures x settings x seeds, unattended");
  auto request = std::make_shared<Request>();
  command
      ->add_option("JOBS", request->jobs,
                   "Job file in TOML:\n"
                   "  captures = [\"captures/free_*\"]  # globs, from this file's folder\n"
                   "  seeds = [0, 1]                  # default: 0\n"
                   "  [settings]                      # any option of train; lists make a grid\n"
                   "  joints = [6, 8]\n"
                   "  mode = \"fast\"\n"
                   "[[settings]] several times: one grid each. Run again, it does what is missing or failed")
      ->type_name("JOBS.toml");
  command->add_option("-o,--output", request->out, "Folder for the runs, their logs and results.html, .csv, .json")
      ->type_name("DIR");
  command->add_option("--jobs", request->parallel, "Trainings at a time (default: as measured best for the device)")
      ->check(CLI::Range(1, 1024))
      ->type_name("N");
  command->add_option("--launcher", request->launcher, "local (default) or slurm: a job array, one task a job")
      ->check(CLI::IsMember({"local", "slurm"}))
      ->type_name("KIND");
  command->add_option("--time-limit", request->time_limit, "Of a Slurm task (default 1:00:00)")->type_name("H:MM:SS");
  command
      ->add_option("--warn", request->warn_seconds,
                   "Seconds before the time limit at which a Slurm task leaves a checkpoint and is queued again\n"
                   "(default 60)")
      ->check(CLI::Range(1, 86400))
      ->type_name("N");
  command
      ->add_option("--sbatch", request->sbatch, "More options of sbatch, as one text: \"--partition=gpu --gres=gpu:1\"")
      ->type_name("TEXT");
  command->callback([&globals, &job, request] {
    if (!job) job = [&globals, request] { batch(globals, *request); };
  });

  auto folder = std::make_shared<std::string>();
  const auto with_folder = [&](const char* name, const char* help) {
    CLI::App* sub = command->add_subcommand(name, help);
    sub->add_option("DIR", *folder, "Folder of the batch")->required();
    return sub;
  };
  with_folder("status", "How far each job is")->callback([&globals, &job, folder] {
    job = [&globals, folder] {
      std::cout << (globals.json ? status_json(load_plan(*folder), *folder) : status_text(load_plan(*folder), *folder));
    };
  });
  with_folder("collect", "Metrics of all runs as DIR/results.csv, .json and .html")->callback([&globals, &job, folder] {
    job = [&globals, folder] {
      collect(load_plan(*folder), *folder);
      if (!globals.json)
        std::cout << "results: " << (Path(*folder) / "results.html").string() << "\n";
      else
        std::cout << core::read_file(Path(*folder) / "results.json");
    };
  });
  auto index = std::make_shared<int>(-1);
  CLI::App* one = with_folder("task", "One job of the plan; what a Slurm task runs");
  one->add_option("--index", *index, "Its number in batch.json (default: SLURM_ARRAY_TASK_ID)")->type_name("N");
  one->callback(
      [&globals, &job, folder, index] { job = [&globals, folder, index] { task(globals, *folder, *index); }; });
}

}  // namespace chainsplat::tools
