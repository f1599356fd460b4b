// chainsplat/core.h - what every module needs and no module is about: errors, warnings, progress, files, threads,
// random.
//
// Errors are two exceptions, because they decide the exit code: InputError (2: the request or its input is wrong,
// nothing was written) and WorkError (1: the work failed, what exists is kept). The library never prints and never
// aborts; the program catches both and prints one line.
#pragma once
#include <cstdint>
#include <filesystem>
#include <functional>
#include <nlohmann/json_fwd.hpp>
#include <stdexcept>
#include <string>
#include <string_view>
#include <vector>

namespace chainsplat {

using Path = std::filesystem::path;

namespace core {
// The text with control characters and bytes that are not UTF-8 written as \xNN: what comes from a file or a command
// line can then stand in a line for the user.
std::string printable(std::string_view text);
}  // namespace core

// What went wrong, in three fields; what() is one line of them for the user, WHERE: PROBLEM; MEND, in which bytes that
// cannot be printed are escaped. Where an option of a call is meant, its field stands in backquotes: `frames`.
struct Error : std::runtime_error {
  Error(const std::string& at, const std::string& wrong, const std::string& advice)
      : std::runtime_error(core::printable(at + ": " + wrong + "; " + advice)),
        where(at),
        problem(wrong),
        mend(advice) {}
  std::string where, problem, mend;
};

// The request or its input is wrong; nothing was written.
struct InputError : Error {
  using Error::Error;
};

// The work failed half-way (device lost, disk full, diverged); what exists is kept.
struct WorkError : Error {
  using Error::Error;
};

// Thrown by long work when stop_requested() turns true, after it has left a checkpoint.
struct Interrupted : std::runtime_error {
  explicit Interrupted(int which) : std::runtime_error("interrupted"), signal(which) {}
  int signal;  // SIGINT, SIGTERM or SIGUSR1
};

namespace core {

// A broken promise between our own functions: throws std::logic_error with file, line and the condition.
[[noreturn]] void check_failed(const char* condition, const char* file, int line, const std::string& values);
#define CHAINSPLAT_CHECK(condition, values)                                                       \
  do {                                                                                            \
    if (!(condition)) ::chainsplat::core::check_failed(#condition, __FILE__, __LINE__, (values)); \
  } while (false)

// One state of a long task, sent to whoever listens (terminal bar, log file). Numbers that do not apply are NaN.
struct Progress {
  std::string stage;      // "recognize", "identify", ...
  std::int64_t step = 0;  // of `total`
  std::int64_t total = 0;
  double loss = 0.0;
  double psnr = 0.0;  // dB inside the object
  std::string note;   // what is being done, a few words
};

// Who is told of long work, and may stop it. What is empty is not told. One thread at a time calls these; they must not
// call warn(), say(), say_more() or report() themselves.
struct Listener {
  std::function<void(const std::string&)> warning;  // one line, what was assumed
  std::function<void(const Progress&)> progress;
  std::function<void(const std::string&)> message;  // one line, what was found or done
  std::function<void(const std::string&)> detail;   // the same for who wants to know more: seconds of a stage, the device
  std::function<bool()> stop;  // asked after every progress: true ends the work as SIGINT does, with a checkpoint
};
// One listener for the whole process; the default hears nothing. Thread-safe.
void set_listener(Listener listener);
// Listens for as long as it lives, then the listener before does again. A stop that `listener` asked for ends with it.
class ListenerScope {
 public:
  explicit ListenerScope(Listener listener);
  ~ListenerScope();
  ListenerScope(const ListenerScope&) = delete;
  ListenerScope& operator=(const ListenerScope&) = delete;

 private:
  Listener before_;
  bool may_stop_;
};
void warn(const std::string& line);
void say(const std::string& line);
void say_more(const std::string& line);
void report(const Progress& progress);

// Set by the signal handler of the tool; long work polls it between steps.
void request_stop(int signal) noexcept;
int stop_requested() noexcept;  // 0 or the signal
void clear_stop() noexcept;
void stop_if_requested();  // throws Interrupted

// Number of host threads for parallel_for: --threads, else the number of cores. Results never depend on it.
void set_threads(int threads);
int threads();
// Calls body(i) for i in [0, count), each exactly once, on threads() threads. The first exception is rethrown.
void parallel_for(std::int64_t count, const std::function<void(std::int64_t)>& body);

// Writes `bytes` as `path` in one step (temporary file in the same folder, fsync, rename). Throws WorkError (disk full,
// ...).
void write_file(const Path& path, std::string_view bytes);
// Makes a folder and those above it. Throws WorkError.
void make_folder(const Path& folder);
// The whole file. Throws InputError naming `path` when it is missing, unreadable or larger than 1 GiB (a pipe or device
// may never end).
std::string read_file(const Path& path);
// JSON from outside, with a bound on its nesting: the library that parses it frees, copies and prints a document by
// recursion, so a file of brackets alone would overflow the stack. Throws nlohmann::json::exception where the text is no
// JSON, has a number beyond double, or is nested deeper than kDeepestJson.
constexpr int kDeepestJson = 64;
nlohmann::ordered_json parse_json(std::string_view text);
// The same without exceptions: is_discarded() where the text cannot be read.
nlohmann::ordered_json parse_json_or_discard(std::string_view text);
// A table of numbers between commas: its lines that are not blank, without line ends and trailing spaces.
struct TableLine {
  int number;  // from 1
  std::string_view text;
};
std::vector<TableLine> table_lines(std::string_view text);
// The cells of a line, `columns` of them; where `may_be_empty`, NaN for an empty one or 'nan'. Throws InputError naming
// the line for anything else that is no finite number; `mend` is its advice.
std::vector<double> table_numbers(const Path& file, const TableLine& line, std::size_t columns, const std::string& mend,
                                  bool may_be_empty = false);
// A double with the digits that read back exactly ("%.17g", shortest that round-trips).
std::string exact(double value);
// Seconds on a steady clock since an arbitrary origin.
double seconds_now();
// Gives memory that was freed back to the system, where it can be told to.
void trim_memory();
// 64-bit FNV-1a, for capture hashes and checkpoints' checksums.
std::uint64_t fnv1a(std::string_view bytes, std::uint64_t hash = 14695981039346656037ull);

// SplitMix64: small, seeded, the same on every machine.
class Random {
 public:
  explicit Random(std::uint64_t seed) : state_(seed) {}
  std::uint64_t next();
  double uniform();  // [0, 1)
  double uniform(double low, double high);
  double normal();  // mean 0, sd 1
 private:
  std::uint64_t state_;
};

}  // namespace core
}  // namespace chainsplat
