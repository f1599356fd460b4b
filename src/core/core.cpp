#include "chainsplat/core.h"

#include <fcntl.h>
#include <malloc.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cerrno>
#include <charconv>
#include <chrono>
#include <cmath>
#include <csignal>
#include <cstdio>
#include <cstring>
#include <exception>
#include <fstream>
#include <mutex>
#include <sstream>
#include <thread>
#include <utility>

#include "src/core/said.h"
#include "src/core/write_parts.h"

namespace chainsplat::core {

namespace {

std::mutex listener_mutex;
Listener current_listener;
std::vector<Said>* kept_said = nullptr;  // of the SaidScope that lives
std::atomic<int> stop_signal{0};
std::atomic<int> thread_count{0};

constexpr std::size_t kLargestFile = std::size_t{1} << 30;  // bytes; a twin of a million Gaussians needs a quarter

// Tells it to the listener, and keeps it where that is asked for.
void tell(Said::Kind kind, const std::string& text) {
  std::lock_guard lock(listener_mutex);
  if (kept_said) kept_said->push_back({kind, text});
  const auto& listening = kind == Said::Kind::warning   ? current_listener.warning
                          : kind == Said::Kind::message ? current_listener.message
                          : kind == Said::Kind::detail  ? current_listener.detail
                                                        : current_listener.record;
  if (listening) listening(text);
}

// Returns the length in bytes of the UTF-8 character that `text` begins with, or 0 where it begins with none.
std::size_t utf8_length(std::string_view text) {
  const auto byte = [&](std::size_t i) { return static_cast<unsigned char>(text[i]); };
  const std::size_t length = byte(0) < 0x80                      ? 1
                             : byte(0) >= 0xc2 && byte(0) < 0xe0 ? 2
                             : byte(0) >= 0xe0 && byte(0) < 0xf0 ? 3
                             : byte(0) >= 0xf0 && byte(0) < 0xf5 ? 4
                                                                 : 0;
  if (length == 0 || length > text.size()) return 0;
  for (std::size_t i = 1; i < length; ++i)
    if ((byte(i) & 0xc0) != 0x80) return 0;
  return length;
}

}  // namespace

std::string printable(std::string_view text) {
  std::string out;
  while (!text.empty()) {
    const std::size_t length = utf8_length(text);
    const auto first = static_cast<unsigned char>(text[0]);
    // U+0080 to U+009F, which some terminals obey
    const bool c1_control = length == 2 && first == 0xc2 && static_cast<unsigned char>(text[1]) < 0xa0;
    if (length == 0 || first < 0x20 || first == 0x7f || c1_control) {
      char escaped[8];
      std::snprintf(escaped, sizeof escaped, "\\x%02x", first);
      out += escaped;
      text.remove_prefix(1);
    } else {
      out += text.substr(0, length);
      text.remove_prefix(length);
    }
  }
  return out;
}

void check_failed(const char* condition, const char* file, int line, const std::string& values) {
  std::ostringstream text;
  text << file << ":" << line << ": broken promise: " << condition << " (" << values << ")";
  throw std::logic_error(text.str());
}

void set_listener(Listener listener) {
  std::lock_guard lock(listener_mutex);
  current_listener = std::move(listener);
}

ListenerScope::ListenerScope(Listener listener) : may_stop_(static_cast<bool>(listener.stop)) {
  std::lock_guard lock(listener_mutex);
  before_ = std::exchange(current_listener, std::move(listener));
}

ListenerScope::~ListenerScope() {
  if (may_stop_) clear_stop();
  set_listener(std::move(before_));
}

void warn(const std::string& line) { tell(Said::Kind::warning, line); }
void say(const std::string& line) { tell(Said::Kind::message, line); }
void say_more(const std::string& line) { tell(Said::Kind::detail, line); }
void record(const std::string& json) { tell(Said::Kind::record, json); }

SaidScope::SaidScope(std::vector<Said>& into) {
  std::lock_guard lock(listener_mutex);
  keeps_ = !kept_said;
  if (keeps_) kept_said = &into;
}

SaidScope::~SaidScope() {
  std::lock_guard lock(listener_mutex);
  if (keeps_) kept_said = nullptr;
}

void say_again(const std::vector<Said>& said) {
  for (const Said& one : said) tell(one.kind, one.text);
}

void report(const Progress& progress) {
  std::lock_guard lock(listener_mutex);
  if (current_listener.progress) current_listener.progress(progress);
  if (current_listener.stop && current_listener.stop()) request_stop(SIGINT);
}

void request_stop(int signal) noexcept { stop_signal.store(signal); }
int stop_requested() noexcept { return stop_signal.load(); }
void clear_stop() noexcept { stop_signal.store(0); }
void stop_if_requested() {
  if (const int signal = stop_requested()) throw Interrupted(signal);
}

void trim_memory() {
#ifdef __GLIBC__
  ::malloc_trim(0);
#endif
}

void set_threads(int threads) { thread_count.store(threads); }

int threads() {
  const int asked = thread_count.load();
  return asked > 0 ? asked : std::max(1u, std::thread::hardware_concurrency());
}

void parallel_for(std::int64_t count, const std::function<void(std::int64_t)>& body) {
  const int workers = static_cast<int>(std::min<std::int64_t>(count, threads()));
  if (workers <= 1) {
    for (std::int64_t i = 0; i < count; ++i) body(i);
    return;
  }
  std::atomic<std::int64_t> next{0};
  std::mutex failure_mutex;
  std::exception_ptr failure;
  auto work = [&] {
    for (std::int64_t i = next++; i < count; i = next++) {
      try {
        body(i);
      } catch (...) {
        std::lock_guard lock(failure_mutex);
        if (!failure) failure = std::current_exception();
        next = count;
      }
    }
  };
  std::vector<std::jthread> pool;
  for (int w = 1; w < workers; ++w) pool.emplace_back(work);
  work();
  pool.clear();  // joins the threads
  if (failure) std::rethrow_exception(failure);
}

void write_file(const Path& path, std::string_view bytes) {
  write_parts(path, [&] { return std::exchange(bytes, {}); });
}

void write_parts(const Path& path, const std::function<std::string_view()>& next) {
  const Path temporary = path.string() + ".tmp" + std::to_string(::getpid());
  auto fail = [&](const char* what) {
    const std::string reason = std::strerror(errno);
    ::unlink(temporary.c_str());
    throw WorkError(path.string(), std::string(what) + " failed (" + reason + ")",
                    "make room or choose a folder that can be written");
  };
  // write all bytes to the temporary file; closing it may change errno, which the message needs
  const int file = ::open(temporary.c_str(), O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0644);
  if (file < 0) fail("opening for writing");
  for (std::string_view bytes = next(); !bytes.empty(); bytes = next()) {
    while (!bytes.empty()) {
      const ssize_t n = ::write(file, bytes.data(), bytes.size());
      if (n < 0 && errno == EINTR) continue;
      if (n <= 0) {
        const int reason = errno;
        ::close(file);
        errno = reason;
        fail("writing");
      }
      bytes.remove_prefix(static_cast<std::size_t>(n));
    }
  }
  // the bytes must be on the disk before the name refers to them
  if (::fsync(file) != 0) {
    const int reason = errno;
    ::close(file);
    errno = reason;
    fail("syncing");
  }
  ::close(file);
  if (::rename(temporary.c_str(), path.c_str()) != 0) fail("renaming");
}

void make_folder(const Path& folder) {
  std::error_code error;
  std::filesystem::create_directories(folder, error);
  if (error)
    throw WorkError(folder.string(), "cannot be made (" + error.message() + ")",
                    "make room or choose a folder that can be written");
}

std::string read_file(const Path& path) {
  std::error_code error;
  if (std::filesystem::is_directory(path, error))
    throw InputError(path.string(), "is a folder, not a file", "name a file");
  std::ifstream file(path, std::ios::binary);
  if (!file) throw InputError(path.string(), std::strerror(errno), "check the path and its permissions");
  std::string bytes;
  constexpr std::size_t kBlock = 1 << 16;
  const std::uintmax_t size = std::filesystem::file_size(path, error);  // a pipe has none
  if (!error) bytes.reserve(std::min<std::uintmax_t>(size, kLargestFile) + kBlock);
  while (file) {
    const std::size_t had = bytes.size();
    if (had > kLargestFile)
      throw InputError(path.string(), "is larger than 1 GiB",
                       "name the file that is meant; none that is read is so large");
    // doubling keeps the total time linear in the size, what is reserved the memory
    bytes.resize(std::max(had + kBlock, std::min(2 * had, bytes.capacity())));
    file.read(bytes.data() + had, static_cast<std::streamsize>(bytes.size() - had));
    bytes.resize(had + static_cast<std::size_t>(file.gcount()));
  }
  if (file.bad()) throw InputError(path.string(), "cannot be read", "check the disk");
  return bytes;
}

std::vector<TableLine> table_lines(std::string_view text) {
  std::vector<TableLine> lines;
  for (int number = 1; !text.empty(); ++number) {
    const std::size_t end = std::min(text.find('\n'), text.size());
    std::string_view line = text.substr(0, end);
    text.remove_prefix(std::min(end + 1, text.size()));
    while (!line.empty() && (line.back() == '\r' || line.back() == ' ')) line.remove_suffix(1);
    if (!line.empty()) lines.push_back({number, line});
  }
  return lines;
}

std::vector<double> table_numbers(const Path& file, const TableLine& line, std::size_t columns, const std::string& mend,
                                  bool may_be_empty) {
  const auto fail = [&](const std::string& what) {
    throw InputError(file.string() + ":" + std::to_string(line.number), what, mend);
  };
  std::vector<double> numbers;
  const char* const stop = line.text.data() + line.text.size();
  for (const char* c = line.text.data(); c <= stop; ++c) {
    while (c != stop && *c == ' ') ++c;
    double number = std::nan("");
    const char* after = c;
    if (c != stop && *c != ',') {
      const auto [end, error] = std::from_chars(c, stop, number);
      after = error == std::errc() && (std::isfinite(number) || (may_be_empty && std::isnan(number))) ? end : nullptr;
      while (after && after != stop && *after == ' ') ++after;
    } else if (!may_be_empty) {
      after = nullptr;
    }
    if (!after || (after != stop && *after != ','))
      fail("column " + std::to_string(numbers.size() + 1) + " is not a finite number");
    numbers.push_back(number);
    c = after;
  }
  if (numbers.size() != columns)
    fail(std::to_string(numbers.size()) + " columns instead of " + std::to_string(columns));
  return numbers;
}

std::string exact(double value) {
  if (std::isnan(value)) return "nan";
  char text[40];
  const auto end = std::to_chars(text, text + sizeof text, value);
  return {text, end.ptr};
}

double seconds_now() {
  return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

std::uint64_t fnv1a(std::string_view bytes, std::uint64_t hash) {
  constexpr std::uint64_t kPrime = 1099511628211ull;
  for (const char byte : bytes) hash = (hash ^ static_cast<unsigned char>(byte)) * kPrime;
  return hash;
}

std::uint64_t Random::next() {
  std::uint64_t z = (state_ += 0x9e3779b97f4a7c15ull);
  z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9ull;
  z = (z ^ (z >> 27)) * 0x94d049bb133111ebull;
  return z ^ (z >> 31);
}

double Random::uniform() { return static_cast<double>(next() >> 11) * 0x1.0p-53; }
double Random::uniform(double low, double high) { return low + (high - low) * uniform(); }

double Random::normal() {
  const double radius = std::sqrt(-2.0 * std::log(1.0 - uniform()));
  return radius * std::cos(6.283185307179586 * uniform());
}

}  // namespace chainsplat::core
