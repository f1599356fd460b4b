// chainsplat/gpu.h - a thin Vulkan 1.3 compute layer: device, buffers, pipelines, one-submission command lists.
//
// One queue, host-visible or device buffers, pipelines made from embedded SPIR-V with specialization constants, a
// timeline semaphore, a pipeline cache on disk, debug names, optional validation (with synchronization validation)
// whose messages are counted. Nothing here knows what is computed.
#pragma once
#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>
#include <string>
#include <string_view>
#include <vector>
#include "chainsplat/core.h"

namespace chainsplat::gpu {

struct DeviceInfo {
  int index = 0;
  std::string name, driver, type;  // type: "discrete GPU", "integrated GPU", "CPU", ...
  std::uint32_t api_version = 0, vendor = 0;
  // Every pipeline runs with subgroup_size lanes, or with more where a device with several sizes cannot fix one.
  std::uint32_t subgroup_size = 0, max_workgroup_invocations = 0, shared_memory_bytes = 0;
  std::uint32_t storage_buffers = 0;    // that one kernel may bind
  std::uint64_t max_storage_range = 0;  // bytes of the largest buffer
  std::uint64_t heap_bytes = 0;         // of the largest device-local heap
  bool software = false;                // a CPU device such as lavapipe
  bool unified_memory = false;          // the host reads and writes Domain::device at full speed: it is mapped
  bool timestamps = false;              // false: Commands::timings() is empty
  bool push_descriptors = false;        // false: Commands uses descriptor sets
  std::vector<std::string> refused;     // why it cannot be used; empty: it can
};

// All Vulkan devices, without opening one. Empty (never an exception) without loader, driver or device; `why` says why.
std::vector<DeviceInfo> list_devices(std::string* why = nullptr);
// The one that `selector` means: "" -> CHAINSPLAT_DEVICE, else first discrete GPU, integrated, CPU; a number; a part of
// its name. Throws InputError that lists the candidates and the reasons.
DeviceInfo choose_device(const std::string& selector);

// What `doctor` tells, as values; nothing throws.
struct Doctor {
  std::vector<DeviceInfo> devices;
  int chosen = -1;                   // index into devices; -1: none
  std::string reason;                // why that one, or why none and how to mend it
  std::vector<std::string> missing;  // what else is absent, one line each, and what that costs
  bool validation_layer = false;     // only tests need it
  std::string pipeline_cache;        // folder of the pipeline cache; empty: there is no home folder, nothing is kept
};
Doctor examine(const std::string& selector = "");
std::string doctor_text(const Doctor& doctor);  // several lines, for a terminal

struct DeviceOptions {
  std::string selector;
  bool validation = false;  // needs the layer; throws InputError when it is missing
  bool least = false;       // as on the least device: descriptor sets, staged transfers (for tests)
  // faults, for tests; 0: none
  std::uint64_t most_bytes = 0;    // of all buffers together: beyond it, as if the device's memory were full
  std::uint64_t most_submits = 0;  // after so many the device is lost
};

// There is no room for a buffer: the caller can try again with less work at a time.
struct OutOfMemory : WorkError {
  using WorkError::WorkError;
};

class Device;  // opened device; keep it alive longer than what was made from it
struct DeviceDeleter {
  void operator()(Device*) const;
};
using DevicePtr = std::unique_ptr<Device, DeviceDeleter>;
DevicePtr open_device(const DeviceOptions& options = {});
const DeviceInfo& info(const Device& device);
// Validation messages (errors and warnings, synchronization included) since the device was opened; 0 when it is off.
int validation_messages(const Device& device);
std::vector<std::string> validation_texts(const Device& device);

enum class Domain {
  device,  // fastest for the GPU; host access through upload() and download()
  host,    // host-visible, cached, mapped: written or read by the host, reached by the GPU
};

class Buffer {
 public:
  Buffer();
  // Its content is undefined until written. Throws OutOfMemory, or WorkError when larger than max_storage_range.
  Buffer(Device& device, std::size_t bytes, Domain domain, const char* name);
  Buffer(Buffer&&) noexcept;
  Buffer& operator=(Buffer&&) noexcept;
  ~Buffer();
  std::size_t bytes() const { return bytes_; }
  void* mapped() const { return mapped_; }  // null unless Domain::host or unified_memory
  template <class T>
  std::span<T> as() const {
    return {static_cast<T*>(mapped_), bytes_ / sizeof(T)};
  }
  bool made() const { return handles_ != nullptr; }  // false by default and after a move
  struct Handles;
  const Handles& handles() const { return *handles_; }

 private:
  std::unique_ptr<Handles> handles_;
  std::size_t bytes_ = 0;
  void* mapped_ = nullptr;
};

// Host to buffer and back, finished on return. No submit that touches `buffer` may be under way.
void upload(Device& device, Buffer& buffer, const void* data, std::size_t bytes, std::size_t offset = 0);
void download(Device& device, const Buffer& buffer, void* data, std::size_t bytes, std::size_t offset = 0);

// Embedded SPIR-V of shaders/<name>.comp; the build defines one function a shader through shader_code(). Throws
// std::logic_error for an unknown name.
std::span<const std::uint32_t> shader_code(std::string_view name);

class Pipeline {
 public:
  Pipeline();
  // Compute pipeline of shaders/<name>.comp with `buffers` storage buffers at set 0, bindings 0.., `push_bytes` of push
  // constants (at most 128) and specialization constants 0, 1, 2, ... = `constants` (uint). Compiled once a device: all
  // that are made alike share one.
  Pipeline(Device& device, const std::string& name, int buffers, std::size_t push_bytes,
           const std::vector<std::uint32_t>& constants);
  Pipeline(Pipeline&&) noexcept;
  Pipeline& operator=(Pipeline&&) noexcept;
  ~Pipeline();
  struct Handles;
  const Handles& handles() const { return *handles_; }

 private:
  std::shared_ptr<const Handles> handles_;
};

struct Timing {
  std::string label;
  double milliseconds = 0.0;
};

// Records work once, submits it any number of times. Dispatches are ordered: every dispatch, fill and copy is preceded
// by a full compute+transfer memory barrier unless `no_barrier()` was called since the last one; the first one also
// waits for what was submitted before. One thread at a time may use a Commands, several threads may share a device.
// A dispatch without groups, a fill or copy of 0 bytes is skipped. More than 65535 groups an axis are refused (use y).
class Commands {
 public:
  explicit Commands(Device& device);
  Commands(Commands&&) noexcept;
  Commands& operator=(Commands&&) noexcept;
  ~Commands();
  void begin();  // forget what was recorded (waits for the last submit)
  void dispatch(const Pipeline& pipeline, std::span<const Buffer* const> buffers, const void* push,
                std::size_t push_bytes, std::uint32_t x, std::uint32_t y = 1, std::uint32_t z = 1);
  // Group counts (3 uints) read from `arguments` at `offset` bytes.
  void dispatch_indirect(const Pipeline& pipeline, std::span<const Buffer* const> buffers, const void* push,
                         std::size_t push_bytes, const Buffer& arguments, std::size_t offset);
  void fill(const Buffer& buffer, std::uint32_t value, std::size_t offset, std::size_t bytes);
  void copy(const Buffer& from, std::size_t from_offset, const Buffer& to, std::size_t to_offset, std::size_t bytes);
  void no_barrier();                    // the next command may overlap the one before
  void stamp(const char* label);        // time since the last stamp is charged to `label`
  void submit();                        // waits for the last submit, starts; the device sees host writes before it
  void wait();                          // until the last submit is done; throws WorkError when the device is lost
  std::vector<Timing> timings() const;  // of the last finished submit, summed by label
  struct State;

 private:
  std::unique_ptr<State> state_;
};

}  // namespace chainsplat::gpu
