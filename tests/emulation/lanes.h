// lanes.h - emulates a device for a kernel on the host: a work group whose lanes are fibers, in subgroups of any width.
// A lane runs until an operation that others take part in, and continues when they have arrived there too. Unlike a
// device it reports lanes that meet at different operations, reads from a lane that does not take part, indices outside
// a buffer and groups that wait forever. Lanes can run in either order, so that a missing barrier is noticed.
#pragma once
#include <setjmp.h>
#include <ucontext.h>

#include <algorithm>
#include <array>
#include <cstdint>
#include <cstring>
#include <map>
#include <memory>
#include <numeric>
#include <source_location>
#include <span>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#define GLM_FORCE_SWIZZLE  // .xyz(); before any other include of GLM
#include <glm/glm.hpp>
#include <glm/packing.hpp>

namespace chainsplat::emulation {

using glm::uvec3;
using uint = std::uint32_t;

// How a device divides a work group into subgroups.
struct Layout {
  uint subgroup = 8;       // lanes per subgroup
  bool scattered = false;  // assigns invocations to lanes in another order, as devices may where subgroups are full
  bool backward = false;   // the last lane runs first
};

// Buffers, by the names that the kernel has for them, and push constants of a dispatch.
struct Bindings {
  std::map<std::string, std::span<std::byte>> buffers;
  std::span<const std::byte> push;

  template <class T>
  void bind(const std::string& name, std::vector<T>& values) {
    buffers[name] = std::as_writable_bytes(std::span(values));
  }
};

inline const Bindings* bindings = nullptr;  // of the current dispatch

[[noreturn]] inline void fail(const std::string& what) { throw std::runtime_error(what); }

template <class T>
struct Storage {  // a buffer
  std::span<T> values;
  const char* name;

  explicit Storage(const char* n) : name(n) {
    const auto found = bindings->buffers.find(name);
    if (found == bindings->buffers.end()) fail(std::string("nothing is bound to ") + name);
    values = {reinterpret_cast<T*>(found->second.data()), found->second.size() / sizeof(T)};
  }
  T& operator[](std::size_t k) const {
    if (k >= values.size())
      fail("element " + std::to_string(k) + " of the " + std::to_string(values.size()) + " of " + name);
    return values[k];
  }
};

template <class T>
struct Push {
  T value;
  Push() {
    if (bindings->push.size() != sizeof(T)) fail("push constants of another size");
    std::memcpy(&value, bindings->push.data(), sizeof(T));
  }
};

struct WorkGroupSize {
  uint x, y = 1, z = 1;
};

// Specialization constant `at`, or `otherwise` if there are fewer.
template <uint at, uint... kConstants>
constexpr uint specialized(uint otherwise) {
  constexpr std::array<uint, sizeof...(kConstants)> constants{kConstants...};
  if constexpr (at < constants.size()) {
    return constants[at];
  } else {
    return otherwise;
  }
}

enum class Waits { no, at_subgroup, at_group, at_end };

struct Lane {
  ucontext_t context{};  // where it begins
  jmp_buf at{};          // where it goes on
  bool begun = false;
  std::vector<std::byte> stack;
  uvec3 invocation{0};           // in the work group
  uint subgroup = 0, place = 0;  // its subgroup, and the lane's number in it
  Waits waits = Waits::no;
  const char* operation = "";  // where it waits
  std::uint_least32_t line = 0;
  uint offered = 0;  // the value that other lanes of the subgroup may read
};

struct Group {
  static constexpr std::size_t kStackBytes = 256 * 1024;

  std::vector<Lane> lanes;
  std::vector<uint> offers;         // [subgroup][place]: values offered in the last operation
  std::vector<std::uint8_t> there;  // [subgroup][place]: whether the lane took part in it
  uint width = 1, subgroups = 0;
  uvec3 group{0}, groups{0};
  jmp_buf scheduler{};
  Lane* now = nullptr;
  void (*body)(void*) = nullptr;
  void* kernel = nullptr;
  std::string error;

  void wait(Waits at, const char* operation, std::uint_least32_t line) {
    now->waits = at;
    now->operation = operation;
    now->line = line;
    // swapcontext() would ask the system for the mask of signals each time, which takes longer than the kernels do
    if (_setjmp(now->at) == 0) _longjmp(scheduler, 1);
  }
  // Runs a lane until it waits.
  void let_run(Lane& lane) {
    now = &lane;
    if (_setjmp(scheduler) != 0) return;
    if (lane.begun) _longjmp(lane.at, 1);
    lane.begun = true;
    setcontext(&lane.context);
  }
};

inline Group* running = nullptr;

inline void lane_main() {
  Group& group = *running;
  try {
    group.body(group.kernel);
  } catch (const std::exception& error) {
    group.error = error.what();
  }
  group.now->waits = Waits::at_end;
  _longjmp(group.scheduler, 1);
}

// Lets the lanes `chosen` (indices) continue if all of them wait at the same operation of the kind `at`; false if not.
// Lanes that have ended do not take part in a subgroup's operation, but a barrier needs every lane.
inline bool release(Group& group, std::span<const std::size_t> chosen, Waits at) {
  const Lane* first = nullptr;
  for (const std::size_t k : chosen) {
    const Lane& lane = group.lanes[k];
    if (lane.waits == Waits::at_end && at == Waits::at_subgroup) continue;
    if (lane.waits != at) return false;
    if (first && (std::strcmp(first->operation, lane.operation) != 0 || first->line != lane.line))
      fail(std::string("lanes of one subgroup or group at ") + first->operation + " and at " + lane.operation);
    first = &lane;
  }
  if (!first) return false;
  for (const std::size_t k : chosen) {
    Lane& lane = group.lanes[k];
    if (at == Waits::at_subgroup) {
      const std::size_t slot = lane.subgroup * static_cast<std::size_t>(group.width) + lane.place;
      group.there[slot] = lane.waits == at;
      group.offers[slot] = lane.offered;
    }
    if (lane.waits == at) lane.waits = Waits::no;
  }
  return true;
}

// Runs `body(kernel)` in every lane of one work group.
inline void run_group(Group& group, const Layout& layout, uint size) {
  group.width = layout.subgroup;
  group.subgroups = (size + layout.subgroup - 1) / layout.subgroup;
  group.lanes.resize(size);
  group.offers.assign(group.subgroups * static_cast<std::size_t>(layout.subgroup), 0);
  group.there.assign(group.offers.size(), 0);
  group.error.clear();
  std::vector<std::vector<std::size_t>> members(group.subgroups);
  std::vector<std::size_t> everyone(size);
  std::iota(everyone.begin(), everyone.end(), 0u);
  for (uint k = 0; k < size; ++k) {
    Lane& lane = group.lanes[k];
    lane.invocation = {k, 0, 0};
    constexpr uint kOdd = 5;  // coprime to every power of two, so that this permutes the lanes
    const bool full = size % layout.subgroup == 0;
    const uint at = layout.scattered && full ? (kOdd * k + 3) % size : k;
    lane.subgroup = at / layout.subgroup;
    lane.place = at % layout.subgroup;
    lane.waits = Waits::no;
    members[lane.subgroup].push_back(k);
    lane.stack.resize(Group::kStackBytes);
    lane.begun = false;
    getcontext(&lane.context);
    lane.context.uc_stack.ss_sp = lane.stack.data();
    lane.context.uc_stack.ss_size = lane.stack.size();
    lane.context.uc_link = nullptr;
    makecontext(&lane.context, lane_main, 0);
  }
  running = &group;
  for (;;) {
    for (uint k = 0; k < size; ++k) {
      Lane& lane = group.lanes[layout.backward ? size - 1 - k : k];
      if (lane.waits != Waits::no) continue;
      group.let_run(lane);
      if (!group.error.empty()) fail(group.error);
    }
    bool moved = release(group, everyone, Waits::at_group), left = false;
    for (const auto& subgroup : members) moved = release(group, subgroup, Waits::at_subgroup) || moved;
    for (const Lane& lane : group.lanes) left = left || lane.waits != Waits::at_end;
    if (!left) return;
    if (!moved) fail("lanes wait for each other for ever");
  }
}

// Runs all work groups of a kernel, one after the other.
template <class Kernel>
void dispatch(const Layout& layout, const Bindings& bound, uint x, uint y = 1, uint z = 1) {
  bindings = &bound;
  Group group;
  group.groups = {x, y, z};
  group.body = [](void* kernel) { static_cast<Kernel*>(kernel)->main(); };
  for (uint k = 0; k < x * y * z; ++k) {
    const auto kernel = std::make_unique<Kernel>();  // its members are the shared memory of the work group
    group.kernel = kernel.get();
    group.group = {k % x, k / x % y, k / (x * y)};
    run_group(group, layout, Kernel::gl_WorkGroupSize.x);
  }
  running = nullptr;
  bindings = nullptr;
}

}  // namespace chainsplat::emulation
