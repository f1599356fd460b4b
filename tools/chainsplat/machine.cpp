#include "machine.h"

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <vector>

#include "chainsplat/core.h"

namespace chainsplat::tools {

namespace {

constexpr int kRounds = 3;
constexpr int kTurns = 4000000;             // of the loop below: some 10 to 30 ms
constexpr int kSums = 10;                   // independent ones: latency times the adders of a core
constexpr std::size_t kCopied = 96u << 20;  // bytes, of all threads together: beyond the caches

// A function that runs kTurns x kSums multiply-adds of vectors with so many lanes, for the processors that `target`
// names. A macro and no template, because a compiler takes vectors apart before it puts a template into a function for
// another processor.
#define CHAINSPLAT_MULTIPLY_ADD(name, lanes, target)                                              \
  target float name(float start) {                                                                \
    using Vector = float __attribute__((vector_size(4 * (lanes))));                               \
    Vector sums[kSums], factor = Vector{} + 0.999f, term = Vector{} + start;                      \
    for (int i = 0; i < kSums; ++i) sums[i] = term + static_cast<float>(i);                       \
    for (int turn = 0; turn < kTurns; ++turn) {                                                   \
      _Pragma("GCC unroll 10") for (int i = 0; i < kSums; ++i) sums[i] = sums[i] * factor + term; \
    }                                                                                             \
    float out = 0.0f;                                                                             \
    for (int i = 0; i < kSums; ++i)                                                               \
      for (int lane = 0; lane < (lanes); ++lane) out += sums[i][lane];                            \
    return out;                                                                                   \
  }

struct Loop {
  float (*run)(float);
  int lanes;
};

CHAINSPLAT_MULTIPLY_ADD(plain, 4, )

// The program itself is compiled for every processor of its kind, but a driver like lavapipe compiles for the one at
// hand, so that the loop has to use its widest vectors, too.
#ifdef __x86_64__
CHAINSPLAT_MULTIPLY_ADD(wide, 8, __attribute__((target("avx2,fma"))))
CHAINSPLAT_MULTIPLY_ADD(widest, 16, __attribute__((target("avx512f"))))

Loop loop_of_this_processor() {
  if (__builtin_cpu_supports("avx512f")) return {widest, 16};
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) return {wide, 8};
  return {plain, 4};
}
#else
Loop loop_of_this_processor() { return {plain, 4}; }
#endif

}  // namespace

MachineRates measure_machine() {
  const int threads = core::threads();
  const Loop loop = loop_of_this_processor();
  std::vector<float> results(threads);
  const std::size_t part = kCopied / threads;
  std::vector<std::vector<char>> from(threads), to(threads);
  core::parallel_for(threads, [&](std::int64_t t) {  // pages exist before the clock runs
    from[t].assign(part, static_cast<char>(t));
    to[t].assign(part, 0);
  });
  double computing = 0.0, copying = 0.0;  // s
  for (int round = 0; round < kRounds; ++round) {
    double begun = core::seconds_now();
    core::parallel_for(threads, [&](std::int64_t t) { results[t] = loop.run(1.0f + static_cast<float>(t)); });
    computing += core::seconds_now() - begun;
    begun = core::seconds_now();
    core::parallel_for(threads, [&](std::int64_t t) { std::memcpy(to[t].data(), from[t].data(), part); });
    copying += core::seconds_now() - begun;
  }
  // what nobody looks at would not be computed
  if (std::count(results.begin(), results.end(), 0.0f) != 0 || to[0].front() != from[0].front()) return {};
  const double operations = 2.0 * kTurns * kSums * loop.lanes * threads,
               bytes = 2.0 * static_cast<double>(part) * threads;
  return {1e-9 * kRounds * operations / computing, 1e-9 * kRounds * bytes / copying};
}

}  // namespace chainsplat::tools
