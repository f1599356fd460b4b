// progress.cpp - what the user sees while work is going on, and the log of it.
#include <fcntl.h>
#include <poll.h>
#include <sys/ioctl.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <iostream>
#include <mutex>
#include <nlohmann/json.hpp>
#include <optional>
#include <set>
#include <string>

#include "chainsplat/run_folder.h"
#include "cli.h"

namespace chainsplat::tools {

namespace {

constexpr double kRedrawSeconds = 0.1;  // a faster line flickers
constexpr double kPlainSeconds = 5.0;   // between lines where standard error is no terminal
constexpr int kBarCells = 12;
constexpr int kDefaultColumns = 80;

// All of the program's one terminal. core calls the listener under a lock; messages come from the main thread.
struct Screen {
  bool quiet = false, verbose = false, progress = true, terminal = false, bold = false;
  bool line_open = false;  // a redrawn line stands on the terminal
  std::string stage;
  double stage_start = 0.0, last_shown = 0.0;
  std::int64_t first_step = 0;  // of this stage in this process: a resumed one does not begin at 0
  std::optional<pipeline::ProgressLog> log;
};
Screen screen;

std::string number(const char* format, double value) {
  char text[64];
  std::snprintf(text, sizeof text, format, value);
  return text;
}

std::string clock_text(double seconds) {
  const auto whole = static_cast<long long>(std::llround(seconds));
  char text[64];
  if (whole >= 3600)
    std::snprintf(text, sizeof text, "%lld:%02lld:%02lld", whole / 3600, whole / 60 % 60, whole % 60);
  else
    std::snprintf(text, sizeof text, "%lld:%02lld", whole / 60, whole % 60);
  return text;
}

int columns() {
  winsize size{};
  return ioctl(STDERR_FILENO, TIOCGWINSZ, &size) == 0 && size.ws_col > 0 ? size.ws_col : kDefaultColumns;
}

std::string progress_line(const core::Progress& progress, double now, bool with_bar) {
  std::string line;
  const double share = progress.total > 0 ? std::clamp(double(progress.step) / double(progress.total), 0.0, 1.0) : 0.0;
  if (with_bar && progress.total > 0) {
    const int cells = static_cast<int>(share * kBarCells);
    line.append(" [").append(cells, '#').append(kBarCells - cells, '-').append("]");
  }
  if (progress.total > 0)
    line.append(" ")
        .append(std::to_string(progress.step))
        .append("/")
        .append(std::to_string(progress.total))
        .append(number(" %3.0f%%", 100 * share));
  const double elapsed = now - screen.stage_start;
  const double rate = elapsed > 0 ? double(progress.step - screen.first_step) / elapsed : 0.0;
  if (rate > 0) {
    line += number(rate < 10 ? "  %.2f/s" : "  %.0f/s", rate);
    line += "  ETA " + clock_text(std::max(0.0, double(progress.total - progress.step) / rate));
  }
  if (std::isfinite(progress.loss)) line += number("  loss %.4g", progress.loss);
  if (std::isfinite(progress.psnr)) line += number("  PSNR %.1f dB", progress.psnr);
  if (!progress.note.empty()) line += "  " + progress.note;
  return line;
}

void clear_line() {
  if (screen.line_open) std::fputs("\r\x1b[K", stderr);
  screen.line_open = false;
}

void show(const core::Progress& progress, double now, bool last) {
  if (!screen.progress) return;
  if (now - screen.last_shown < (screen.terminal ? kRedrawSeconds : kPlainSeconds) && !(last && screen.terminal))
    return;
  screen.last_shown = now;
  std::string line = progress_line(progress, now, screen.terminal);
  if (!screen.terminal) {
    std::fprintf(stderr, "%s%s\n", progress.stage.c_str(), line.c_str());
    return;
  }
  const int room = std::max(0, columns() - 1 - static_cast<int>(progress.stage.size()));
  line.resize(std::min<std::size_t>(line.size(), room));
  clear_line();
  std::fprintf(stderr, "%s%s%s%s", screen.bold ? "\x1b[1m" : "", progress.stage.c_str(), screen.bold ? "\x1b[0m" : "",
               line.c_str());
  std::fflush(stderr);
  screen.line_open = true;
}

void on_progress(const core::Progress& progress) {
  const double now = core::seconds_now();
  const bool fresh = progress.stage != screen.stage;
  if (fresh) {
    end_progress();
    screen.stage = progress.stage;
    screen.stage_start = now;
    screen.first_step = progress.step;
    screen.last_shown = 0.0;
  }
  show(progress, now, progress.total > 0 && progress.step >= progress.total);
  if (screen.log) screen.log->write(progress);
}

constexpr double kOneSignal = 0.1;  // s; timeout(1) and schedulers send to the process and to its group: twice at once
std::atomic<bool> nothing_to_keep{false};
std::atomic<double> first_signal{0.0};  // core::seconds_now(), of the first that asks to end

extern "C" void on_signal(int signal) {
  if (nothing_to_keep) _exit(signal == SIGUSR1 ? 0 : 128 + signal);
  if (signal != SIGUSR1) {
    const double now = core::seconds_now();
    if (first_signal == 0.0) first_signal = now;
    if (now - first_signal > kOneSignal) _exit(128 + signal);
  }
  core::request_stop(signal);
}

// Does nothing, but unlike SIG_IGN it is not inherited by the programs that are started.
extern "C" void on_closed_pipe(int) {}

}  // namespace

void start_listening(const Globals& globals) {
  const char* kind = std::getenv("TERM");
  screen.quiet = globals.quiet;
  screen.verbose = globals.verbose;
  screen.progress = !globals.quiet && !globals.no_progress;
  screen.terminal = isatty(STDERR_FILENO) && !(kind && std::string(kind) == "dumb");
  screen.bold = screen.terminal && !std::getenv("NO_COLOR");
  core::set_listener(terminal());
}

core::Listener terminal() {
  core::Listener listener;
  listener.warning = [](const std::string& line) {
    // a capture may be opened several times; its doubts are told once
    static std::mutex mutex;
    static std::set<std::string> told;
    {
      const std::lock_guard lock(mutex);
      if (!told.insert(line).second) return;
    }
    clear_line();
    std::fprintf(stderr, "chainsplat: warning: %s\n", core::printable(with_options(line)).c_str());
  };
  listener.progress = on_progress;
  listener.message = say;
  listener.detail = say_more;
  listener.record = [](const std::string& json) {
    if (screen.log) screen.log->write(json);
  };
  return listener;
}

void log_to(const Path& file) { screen.log.emplace(file); }

void end_progress() {
  if (screen.line_open) std::fputc('\n', stderr);
  screen.line_open = false;
}

void say(const std::string& line) {
  if (screen.quiet) return;
  end_progress();
  std::fprintf(stderr, "%s\n", core::printable(with_options(line)).c_str());
}

void say_more(const std::string& line) {
  if (screen.verbose) say(line);
}

void watch_signals(bool keep_nothing) {
  nothing_to_keep = keep_nothing;
  struct sigaction action {};
  action.sa_handler = on_signal;
  sigemptyset(&action.sa_mask);
  action.sa_flags = SA_RESTART;
  for (const int signal : {SIGINT, SIGTERM, SIGUSR1}) sigaction(signal, &action, nullptr);
}

void prepare_output() {
  // a stream that is closed would be taken by the next file that is opened; like this, it cannot be read or written.
  // open() gives the lowest number that is free
  for (const int standard : {STDIN_FILENO, STDOUT_FILENO, STDERR_FILENO})
    if (::fcntl(standard, F_GETFD) < 0) (void)!::open("/dev/null", standard == STDIN_FILENO ? O_WRONLY : O_RDONLY);
  struct sigaction action {};
  action.sa_handler = on_closed_pipe;
  sigemptyset(&action.sa_mask);
  action.sa_flags = SA_RESTART;
  sigaction(SIGPIPE, &action, nullptr);
}

void flush_output() {
  std::cout.flush();
  if (std::cout) return;
  pollfd output{STDOUT_FILENO, 0, 0};
  if (::poll(&output, 1, 0) == 1 && output.revents & POLLERR) throw Interrupted(SIGPIPE);
  throw WorkError("standard output", "writing failed", "make room or name another file");
}

}  // namespace chainsplat::tools
