// chainsplat/core.h - the foundation under every module: errors, warnings, progress, files, threads, random numbers.
//
// The module depends on no other. A failure is one of two exceptions, because the two lead to different exit codes:
// InputError (2: the request or its input is wrong, nothing was written) and WorkError (1: the work failed, what exists
// is kept). The library never prints and never aborts; the program catches both and prints one line. Times are in
// seconds.
#pragma once
#include <cstdint>
#include <filesystem>
#include <functional>
#include <stdexcept>
#include <string>
#include <string_view>
#include <vector>

namespace chainsplat {

using Path = std::filesystem::path;

namespace core {
// Returns the text with control characters and bytes that are not UTF-8 written as \xNN, so that text from a file or a
// command line cannot break the line that shows it to the user.
std::string printable(std::string_view text);
}  // namespace core

// What went wrong, in three fields; what() is one line of them for the user, 'WHERE: PROBLEM; MEND', with unprintable
// bytes escaped. Where an option of a call is meant, its field stands in backquotes: `frames`.
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

// The work failed half-way (device lost, disk full, divergence); what exists is kept.
struct WorkError : Error {
  using Error::Error;
};

// Thrown by long work when stop_requested() is not 0, after it has saved a checkpoint if it keeps one.
struct Interrupted : std::runtime_error {
  explicit Interrupted(int which) : std::runtime_error("interrupted"), signal(which) {}
  int signal;  // SIGINT, SIGTERM or SIGUSR1
};

namespace core {

// Reports that the library has broken one of its own invariants, which is a defect and never the user's mistake. Throws
// std::logic_error with the file, the line, the condition and `values`.
[[noreturn]] void check_failed(const char* condition, const char* file, int line, const std::string& values);
// The file's bare name: where the source lay must not change the program's bytes.
#define CHAINSPLAT_CHECK(condition, values)                                                            \
  do {                                                                                                 \
    if (!(condition)) ::chainsplat::core::check_failed(#condition, __FILE_NAME__, __LINE__, (values)); \
  } while (false)

// One state of a long task, sent to the listener (terminal bar, log file). Numbers that do not apply are NaN.
struct Progress {
  std::string stage;      // "recognize", "identify", ...
  std::int64_t step = 0;  // of `total`
  std::int64_t total = 0;
  double loss = 0.0;
  double psnr = 0.0;  // dB, over the object's pixels
  std::string note;   // the current activity in a few words
};

// Who is told of long work, and may stop it. What is empty is not told. One thread at a time calls these; they must not
// call warn(), say(), say_more(), record() or report() themselves.
struct Listener {
  std::function<void(const std::string&)> warning;  // one line, what was assumed
  std::function<void(const Progress&)> progress;
  std::function<void(const std::string&)> message;  // one line, what was found or done
  std::function<void(const std::string&)>
      detail;  // the same for who wants to know more: seconds of a stage, the device
  std::function<void(const std::string&)> record;  // a JSON object for a log, beside progress: how a stage's fit ended
  std::function<bool()> stop;  // asked after every progress: true ends the work as SIGINT does, with a checkpoint
};
// One listener for the whole process; the default hears nothing. May be called from any thread, as those below.
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
void warn(const std::string& line);  // one line that names the assumption made
void say(const std::string& line);
void say_more(const std::string& line);
void record(const std::string& json);
void report(const Progress& progress);

// The tool's signal handler sets the request, and long work polls it between its steps.
void request_stop(int signal) noexcept;
int stop_requested() noexcept;  // the signal, or 0 when no stop is requested
void clear_stop() noexcept;
void stop_if_requested();  // throws Interrupted

// Number of host threads that parallel_for uses: the value set last, or the number of cores where none or 0 was set.
// Results never depend on it.
void set_threads(int threads);
int threads();
// Calls body(i) exactly once for each i in [0, count), on up to threads() threads, the caller's among them. After an
// exception no further i is begun, and the first exception is rethrown.
void parallel_for(std::int64_t count, const std::function<void(std::int64_t)>& body);

// Writes `bytes` as `path` in one step (temporary file in the same folder, fsync, rename), so that a reader never finds
// half a file. Throws WorkError when the disk is full or the folder cannot be written.
void write_file(const Path& path, std::string_view bytes);
// Makes a folder and those above it. Throws WorkError.
void make_folder(const Path& folder);
// Returns the whole file. Throws InputError that names `path` when the file is missing, unreadable or larger than 1 GiB
// (the bound exists because a pipe or device may never end).
std::string read_file(const Path& path);
// One line of a table of comma-separated numbers, without its line end and trailing spaces.
struct TableLine {
  int number;  // in the file, counted from 1
  std::string_view text;
};
// Returns the lines of a table that are not blank; their texts refer to `text`.
std::vector<TableLine> table_lines(std::string_view text);
// Returns the line's numbers, one per column. With `may_be_empty` an empty cell and 'nan' are read as NaN. Throws
// InputError that names the line, with the advice `mend`, for any other cell that is not a finite number and for a
// number of columns other than `columns`.
std::vector<double> table_numbers(const Path& file, const TableLine& line, std::size_t columns, const std::string& mend,
                                  bool may_be_empty = false);
// Returns the shortest decimal text that reads back as exactly this double; 'nan' for NaN.
std::string exact(double value);
// Returns seconds on a steady clock since an arbitrary origin.
double seconds_now();
// Gives memory that was freed back to the system, where it can be told to.
void trim_memory();
// 64-bit FNV-1a, which captures' hashes and checkpoints' checksums use. `hash` continues an earlier one.
std::uint64_t fnv1a(std::string_view bytes, std::uint64_t hash = 14695981039346656037ull);

// SplitMix64 random numbers: the same sequence for the same seed on every machine.
class Random {
 public:
  explicit Random(std::uint64_t seed) : state_(seed) {}
  std::uint64_t next();
  double uniform();  // [0, 1)
  double uniform(double low, double high);
  double normal();  // mean 0, standard deviation 1
 private:
  std::uint64_t state_;
};

}  // namespace core
}  // namespace chainsplat
