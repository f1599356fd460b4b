// address_space.cpp - what happens before the shared libraries are set up: some of them do not survive a limit on the
// address space (ulimit -v, memory limits of batch systems). They bring threads of their own, from the image reader
// down to a BLAS that the program never calls; where there is no room for these, OpenBLAS tries for ever, others abort.
#include <sys/resource.h>
#include <unistd.h>

#include <climits>
#include <cstdio>
#include <cstring>

namespace {

constexpr unsigned long long kMiB = 1 << 20;
constexpr unsigned long long kLibraries = 512 * kMiB, kOfCore = 16 * kMiB;  // measured, 455 to 505 MiB with two cores
constexpr char kQuietBlas[] = "OPENBLAS_NUM_THREADS=1";

// The C library has not been set up either: nothing here may need its locale, its streams or its environment.
void before_libraries(int, char** arguments, char** environment) {
  rlimit limit{};
  if (::getrlimit(RLIMIT_AS, &limit) != 0 || limit.rlim_cur == RLIM_INFINITY) return;
  const long cores = ::sysconf(_SC_NPROCESSORS_ONLN);
  const unsigned long long least = kLibraries + kOfCore * static_cast<unsigned long long>(cores > 0 ? cores : 1);
  if (limit.rlim_cur < least) {
    char line[200];
    const int length =
        std::snprintf(line, sizeof line,
                      "chainsplat: error: address space: its limit of %llu MiB is less than the %llu MiB "
                      "that the program's libraries take; raise it (ulimit -v)\n",
                      static_cast<unsigned long long>(limit.rlim_cur) / kMiB, least / kMiB);
    (void)!::write(STDERR_FILENO, line, static_cast<std::size_t>(length));
    ::_exit(1);
  }
  int count = 0;
  for (; environment[count]; ++count)
    if (std::strncmp(environment[count], kQuietBlas, sizeof kQuietBlas - 2) == 0) return;
  // the libraries read the environment as the system gave it to the program: it has to be given again
  char file[PATH_MAX];
  const ssize_t length = ::readlink("/proc/self/exe", file, sizeof file - 1);
  char** const more = static_cast<char**>(__builtin_alloca(sizeof(char*) * (static_cast<std::size_t>(count) + 2)));
  if (length <= 0) return;
  file[length] = '\0';
  std::memcpy(more, environment, sizeof(char*) * static_cast<std::size_t>(count));
  more[count] = const_cast<char*>(kQuietBlas);
  more[count + 1] = nullptr;
  ::execve(file, arguments, more);
}

// run by the loader before any library's own
[[gnu::section(".preinit_array"), gnu::used]] void (*first)(int, char**, char**) = before_libraries;

}  // namespace
