// batch.cpp - batch: runs the jobs of a job file, or hands them to Slurm; tells how far they are.
#include "chainsplat/batch.h"

#include <poll.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <csignal>
#include <cstdio>
#include <iostream>
#include <memory>
#include <nlohmann/json.hpp>
#include <sstream>

#include "chainsplat/gpu.h"
#include "chainsplat/json.h"
#include "chainsplat/run_folder.h"
#include "cli.h"
#include "command_line.h"

namespace chainsplat::tools {

namespace {

namespace fs = std::filesystem;
using Json = nlohmann::ordered_json;
using pipeline::BatchJob;
using pipeline::BatchOutcome;
using pipeline::BatchPlan;
using pipeline::JobState;
using Kind = JobState::Kind;

constexpr double kBatchRedrawSeconds = 1.0;  // a job's log has a record a second
constexpr double kBatchPlainSeconds = 30.0;  // between lines where standard error is no terminal

struct BatchRequest {
  std::string jobs, out, launcher = "local", time_limit = "1:00:00", sbatch;
  int parallel = 0;       // 0: by the device
  int warn_seconds = 60;  // before the time limit
};

// How many trainings share the device best, and the host threads of each. Measured, docs/figures.md: a training keeps
// two threads busy for part of its time only, so that on a processor as many trainings as cores with one thread each do
// more. On a GPU a training is mostly host work, and half as many as cores with two threads each do more than a quarter
// as many with four.
int best_parallel(bool software) { return software ? core::threads() : std::max(2, core::threads() / 2); }

std::string status_text(const BatchPlan& plan, const Path& folder) {
  std::array<int, 5> count{};
  std::string lines;
  for (const BatchJob& job : plan.jobs) {
    const JobState state = pipeline::state_of(folder, job);
    ++count[static_cast<std::size_t>(state.kind)];
    char head[96];
    std::snprintf(head, sizeof head, "%-8s %8.1f s  ", pipeline::kind_name(state.kind), state.seconds);
    lines += head + core::printable(job.name + (state.detail.empty() ? "" : "  " + state.detail)) + "\n";
  }
  std::string total = std::to_string(plan.jobs.size()) + " jobs";
  for (std::size_t k = 0; k < count.size(); ++k)
    if (count[k] > 0) total += ", " + std::to_string(count[k]) + " " + pipeline::kind_name(static_cast<Kind>(k));
  return lines + total + "\n";
}

std::string status_json(const BatchPlan& plan, const Path& folder) {
  Json jobs = Json::array();
  for (const BatchJob& job : plan.jobs) {
    const JobState state = pipeline::state_of(folder, job);
    jobs.push_back({{"name", job.name},
                    {"state", pipeline::kind_name(state.kind)},
                    {"detail", state.detail},
                    {"seconds", state.seconds},
                    {"capture", job.capture},
                    {"settings", job.settings},
                    {"seed", job.seed}});
  }
  return core::json_text(Json{{"folder", folder.string()}, {"jobs", jobs}}) + "\n";
}

// The lines of a batch on a terminal, redrawn in place; plain lines elsewhere.
class Board {
 public:
  // `already`: jobs that were done before, of `total`
  Board(const Path& folder, std::size_t already, std::size_t total, const Globals& globals)
      : folder_(folder),
        already_(already),
        total_(total),
        shown_(!globals.quiet && !globals.no_progress),
        terminal_(::isatty(STDERR_FILENO)) {}
  ~Board() { clear(); }
  void message(const std::string& line) {
    clear();
    say(line);
  }
  void draw(const BatchOutcome& outcome, const std::vector<const BatchJob*>& running, bool now) {
    const double time = core::seconds_now();
    if (!shown_ || (!now && time - drawn_ < (terminal_ ? kBatchRedrawSeconds : kBatchPlainSeconds))) return;
    drawn_ = time;
    clear();
    const std::size_t fresh = outcome.done + outcome.failed, ended = already_ + fresh;
    std::string line = "batch " + std::to_string(ended) + "/" + std::to_string(total_);
    if (outcome.failed > 0) line += ", " + std::to_string(outcome.failed) + " failed";
    if (fresh > 0) {
      const double left = (time - start_) / static_cast<double>(fresh) * static_cast<double>(total_ - ended);
      line += ", about " + std::to_string(static_cast<long>(left / 60.0 + 0.5)) + " min to go";
    }
    std::fprintf(stderr, "%s\n", line.c_str());
    if (!terminal_) return;
    for (const BatchJob* const job : running)
      std::fprintf(stderr, "  %.60s  %.60s\n", core::printable(job->name).c_str(),
                   core::printable(pipeline::progress_of(folder_ / job->name)).c_str());
    lines_ = 1 + running.size();
  }

 private:
  void clear() {
    for (; lines_ > 0; --lines_) std::fputs("\x1b[1A\x1b[2K", stderr);
  }
  Path folder_;
  std::size_t already_, total_, lines_ = 0;
  bool shown_, terminal_;
  double drawn_ = 0.0, start_ = core::seconds_now();
};

BatchOutcome run_jobs(const Path& folder, const std::vector<const BatchJob*>& jobs, std::size_t already,
                      const pipeline::BatchOptions& options, const Globals& globals) {
  Board board(folder, already, already + jobs.size(), globals);
  pipeline::BatchListener listener;
  listener.message = [&](const std::string& line) { board.message(line); };
  listener.progress = [&](const BatchOutcome& outcome, const std::vector<const BatchJob*>& running, bool now) {
    board.draw(outcome, running, now);
  };
  return pipeline::run_jobs(folder, jobs, options, listener);
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
void submit(const BatchPlan& plan, const Path& folder, const std::vector<const BatchJob*>& todo,
            const BatchRequest& request, const Globals& globals) {
  std::string indices;
  for (const BatchJob* job : todo) indices += (indices.empty() ? "" : ",") + std::to_string(job - plan.jobs.data());
  const std::string program = fs::read_symlink("/proc/self/exe").string();
  std::string script =
      "#!/bin/bash\n# written by 'chainsplat batch --launcher slurm'; the program takes the shell's place,\n"
      "# so that the warning signal reaches it\nexec " +
      shell_quoted(program) + " batch task " + shell_quoted(folder.string()) + " --no-progress";
  if (!globals.device.empty()) script += " --device=" + shell_quoted(globals.device);
  if (globals.threads > 0) script += " --threads=" + std::to_string(globals.threads);
  core::write_file(folder / "logs/slurm.sh", script + "\n");
  std::string command = "sbatch --parsable --job-name=chainsplat --requeue --open-mode=append --array=" + indices +
                        " --time=" + shell_quoted(request.time_limit) + " --signal=B:USR1@" +
                        std::to_string(request.warn_seconds) +
                        " --output=" + shell_quoted(plain((folder / "logs").string()) + "/slurm-%a.txt");
  for (const std::string& word : words_of(request.sbatch)) command += " " + shell_quoted(word);
  command += " " + shell_quoted((folder / "logs/slurm.sh").string());
  say_more(command);
  FILE* pipe = ::popen((command + " 2>&1").c_str(), "r");
  std::string answer;
  char part[256];
  while (pipe && std::fgets(part, sizeof part, pipe)) answer += part;
  const int status = pipe ? ::pclose(pipe) : -1;
  while (!answer.empty() && answer.back() == '\n') answer.pop_back();
  if (status != 0) throw WorkError("sbatch", answer.empty() ? "failed" : answer, "see to Slurm, then run this again");
  if (globals.json)
    std::cout << core::json_text(Json{{"folder", folder.string()}, {"slurm_job", answer}, {"tasks", todo.size()}})
              << "\n";
  else
    std::cout << "slurm job " << answer << ": " << todo.size() << " tasks; 'chainsplat batch status " << folder.string()
              << "' tells how far they are\n";
}

void batch(const Globals& globals, const BatchRequest& request) {
  if (request.jobs.empty() || request.out.empty())
    throw InputError("chainsplat batch", "needs JOBS.toml and -o DIR", "see 'chainsplat batch --help'");
  const bool slurm = request.launcher == "slurm";
  const BatchPlan plan = pipeline::read_job_file(request.jobs);
  const Path folder = fs::absolute(request.out).lexically_normal();
  const bool known = fs::exists(folder / "batch.json");
  pipeline::check_output_folder(folder, known, "name another folder; this one is not of a batch");
  if (slurm && !on_path("sbatch"))
    throw InputError("--launcher slurm", "there is no 'sbatch' on the PATH",
                     "run it where Slurm is (Debian: slurm-client), or without --launcher");
  const std::vector<const BatchJob*> todo = pipeline::unfinished(plan, folder);
  watch_signals();
  core::make_folder(folder / "logs");
  const pipeline::FolderLock lock(folder / pipeline::kBatchLock);
  pipeline::save_plan(plan, folder);
  const std::size_t already = plan.jobs.size() - todo.size();
  say(std::to_string(plan.jobs.size()) + " jobs" +
      (already > 0 ? ", " + std::to_string(already) + " of them done already" : ""));
  if (slurm) {
    if (!todo.empty())
      submit(plan, folder, todo, request, globals);
    else if (globals.json)
      std::cout << status_json(plan, folder);
    return;
  }
  BatchOutcome outcome;
  if (!todo.empty()) {
    pipeline::BatchOptions options;
    options.device = globals.device;
    options.parallel = request.parallel > 0 ? request.parallel
                                            : std::min<int>(best_parallel(gpu::choose_device(globals.device).software),
                                                            static_cast<int>(todo.size()));
    options.threads = globals.threads > 0 ? globals.threads : std::max(1, core::threads() / options.parallel);
    outcome = run_jobs(folder, todo, already, options, globals);
  }
  if (outcome.signal) {
    say("stopped; the same command goes on from here");
    throw Interrupted(outcome.signal);
  }
  pipeline::collect(plan, folder);
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

// One job, as a task of Slurm. Its JSON is that of `status`, with the one job.
void task(const Globals& globals, const std::string& dir, int index) {
  const Path folder = fs::absolute(dir).lexically_normal();
  const BatchPlan plan = pipeline::load_plan(folder);
  if (index < 0)
    if (const char* given = std::getenv("SLURM_ARRAY_TASK_ID")) index = std::atoi(given);
  if (index < 0 || index >= static_cast<int>(plan.jobs.size()))
    throw InputError("batch task", "there is no job " + std::to_string(index), "give --index 0 and up");
  const BatchJob& job = plan.jobs[index];
  const auto print = [&] {
    if (globals.json) std::cout << status_json({{job}}, folder);
  };
  watch_signals();
  if (pipeline::state_of(folder, job).kind == Kind::done) return print();
  pipeline::BatchOptions options;
  options.device = globals.device;
  options.threads = core::threads();
  const BatchOutcome outcome = run_jobs(folder, {&job}, 0, options, globals);
  if (outcome.signal == SIGUSR1)
    if (const char* id = std::getenv("SLURM_JOB_ID")) {
      say("time limit near: a checkpoint was left, the task is queued again");
      const std::string command = std::string("scontrol requeue ") + shell_quoted(id);
      if (std::system(command.c_str()) != 0)
        throw WorkError("scontrol requeue", "failed", "submit the batch again, it goes on from the checkpoint");
      // Slurm ends this process now
      ::poll(nullptr, 0, 60000);
    }
  if (outcome.signal) throw Interrupted(outcome.signal);
  print();
  if (outcome.failed > 0)
    throw WorkError(job.name, pipeline::state_of(folder, job).detail,
                    "see " + pipeline::log_file(folder, job).string());
}

}  // namespace

void add_batch_command(Command app, const Globals& globals, Job& job) {
  Command command = app.add_command("batch", "Many trainings: captures x settings x seeds, unattended");
  auto request = std::make_shared<BatchRequest>();
  command
      .add_option("JOBS", request->jobs,
                  "Job file in TOML:\n"
                  "  captures = [\"captures/free_*\"]  # globs, from this file's folder\n"
                  "  seeds = [0, 1]                  # default: 0\n"
                  "  [settings]                      # any option of train; lists make a grid\n"
                  "  joints = [6, 8]\n"
                  "  mode = \"fast\"\n"
                  "[[settings]] several times: one grid each. Run again, it does what is missing or failed")
      .type_name("JOBS.toml");
  command.add_option("-o,--output", request->out, "Folder for the runs, their logs and results.html, .csv, .json")
      .type_name("DIR");
  command.add_option("--jobs", request->parallel, "Trainings at a time (default: as measured best for the device)")
      .in_range(1, 1024)
      .type_name("N");
  command.add_option("--launcher", request->launcher, "local (default) or slurm: a job array, one task a job")
      .one_of({"local", "slurm"})
      .type_name("KIND");
  command.add_option("--time-limit", request->time_limit, "Of a Slurm task (default 1:00:00)").type_name("H:MM:SS");
  command
      .add_option("--warn", request->warn_seconds,
                  "Seconds before the time limit at which a Slurm task leaves a checkpoint and is queued again\n"
                  "(default 60)")
      .in_range(1, 86400)
      .type_name("N");
  command
      .add_option("--sbatch", request->sbatch, "More options of sbatch, as one text: \"--partition=gpu --gres=gpu:1\"")
      .type_name("TEXT");
  command.callback([&globals, &job, request] {
    if (!job) job = [&globals, request] { batch(globals, *request); };
  });

  auto folder = std::make_shared<std::string>();
  const auto with_folder = [&](const char* name, const char* help) {
    Command sub = command.add_command(name, help);
    sub.add_option("DIR", *folder, "Folder of the batch").required();
    return sub;
  };
  with_folder("status", "How far each job is").callback([&globals, &job, folder] {
    job = [&globals, folder] {
      std::cout << (globals.json ? status_json(pipeline::load_plan(*folder), *folder)
                                 : status_text(pipeline::load_plan(*folder), *folder));
    };
  });
  with_folder("collect", "Metrics of all runs as DIR/results.csv, .json and .html").callback([&globals, &job, folder] {
    job = [&globals, folder] {
      pipeline::collect(pipeline::load_plan(*folder), *folder);
      if (!globals.json)
        std::cout << "results: " << (Path(*folder) / "results.html").string() << "\n";
      else
        std::cout << core::read_file(Path(*folder) / "results.json");
    };
  });
  auto index = std::make_shared<int>(-1);
  Command one = with_folder("task", "One job of the plan; what a Slurm task runs");
  one.add_option("--index", *index, "Its number in batch.json (default: SLURM_ARRAY_TASK_ID)").type_name("N");
  one.callback(
      [&globals, &job, folder, index] { job = [&globals, folder, index] { task(globals, *folder, *index); }; });
}

}  // namespace chainsplat::tools
