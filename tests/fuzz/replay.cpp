// replay.cpp - reads the corpora and the inputs that once crashed again, without a fuzzer: READER/* in every folder
// that the command line names, each reader in its own process.
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <csignal>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <set>
#include <string>
#include <vector>

#include "chainsplat/core.h"

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size);

namespace {

namespace fs = std::filesystem;

constexpr double kLongest = 5.0;  // s per input; tools/fuzz has the same bound

const char* current = "";  // the current input, for the message of a process that crashes

void say_which(int signal) {
  constexpr char kDied[] = "FAILED, died: ";
  [[maybe_unused]] ssize_t said = ::write(STDOUT_FILENO, kDied, sizeof kDied - 1);
  said = ::write(STDOUT_FILENO, current, std::strlen(current));
  said = ::write(STDOUT_FILENO, "\n", 1);
  std::signal(signal, SIG_DFL);
  std::raise(signal);
}

int read_all(const std::vector<fs::path>& files) {
  for (const int signal : {SIGSEGV, SIGABRT, SIGFPE, SIGBUS, SIGILL}) std::signal(signal, say_which);
  int failures = 0;
  for (const fs::path& file : files) {
    const std::string bytes = chainsplat::core::read_file(file);
    const double begun = chainsplat::core::seconds_now();
    std::string failure;
    current = file.c_str();
    try {
      LLVMFuzzerTestOneInput(reinterpret_cast<const std::uint8_t*>(bytes.data()), bytes.size());
    } catch (const std::exception& error) {
      failure = error.what();
    }
    if (chainsplat::core::seconds_now() - begun > kLongest) failure = "takes longer than 5 s";
    if (failure.empty()) continue;
    std::printf("FAILED: %s: %s\n", file.c_str(), failure.c_str());
    ++failures;
  }
  return failures;
}

}  // namespace

int main(int count, char** arguments) {
  const char* const chosen = std::getenv("CHAINSPLAT_READER");
  std::set<std::string> readers;
  for (int i = 1; i < count; ++i) {
    if (!fs::is_directory(arguments[i])) continue;  // the folder of crashes may be missing
    for (const auto& entry : fs::directory_iterator(arguments[i]))
      if (entry.is_directory()) readers.insert(entry.path().filename());
  }
  int failures = 0;
  for (const std::string& reader : readers) {
    std::vector<fs::path> files;
    for (int i = 1; i < count; ++i)
      if (fs::is_directory(fs::path(arguments[i]) / reader))
        for (const auto& entry : fs::directory_iterator(fs::path(arguments[i]) / reader)) files.push_back(entry.path());
    std::sort(files.begin(), files.end());
    if (chosen) {
      if (reader == chosen) return std::min(read_all(files), 100);
      continue;
    }
    const pid_t child = ::fork();
    if (child == 0) {
      // start the program anew, because a mere fork would lack the libraries' threads
      ::setenv("CHAINSPLAT_READER", reader.c_str(), 1);
      ::execv("/proc/self/exe", arguments);
      ::_exit(100);
    }
    int status = 0;
    ::waitpid(child, &status, 0);
    const int failed = WIFEXITED(status) ? WEXITSTATUS(status) : 1;
    if (!WIFEXITED(status)) std::printf("FAILED: %s died of signal %d\n", reader.c_str(), WTERMSIG(status));
    std::printf("%-12s %5zu inputs, %d failed\n", reader.c_str(), files.size(), failed);
    std::fflush(stdout);
    failures += failed;
  }
  return failures > 0;
}
