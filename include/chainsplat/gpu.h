// chainsplat/gpu.h - a thin Vulkan 1.3 compute layer: device, buffers, pipelines, one-submission command lists.
//
// The splatting engine (splat.h) does all its work on the device through this module, which knows nothing of what is
// computed. It offers one queue, buffers in host or device memory, pipelines made from embedded SPIR-V with
// specialization constants, a timeline semaphore, a pipeline cache on disk, debug names, and optional validation (with
// synchronization validation) whose messages are counted.
#pragma once
#include <cstddef>
#include <cstdint>
#include <initializer_list>
#include <map>
#include <memory>
#include <span>
#include <string>
#include <string_view>
#include <utility>
#include <vector>
#include "chainsplat/core.h"

namespace chainsplat::gpu {

struct DeviceInfo {
  int index = 0;
  std::string name, driver, type;  // type: "discrete GPU", "integrated GPU", "CPU", ...
  std::uint32_t api_version = 0, vendor = 0;
  // Subgroups of every pipeline have subgroup_size lanes, or more on a device that has not one_subgroup_size: it has
  // several sizes and cannot fix one.
  bool one_subgroup_size = false;
  std::uint32_t subgroup_size = 0, max_workgroup_invocations = 0, shared_memory_bytes = 0;
  std::uint32_t storage_buffers = 0;    // the most that one kernel may bind
  std::uint64_t max_storage_range = 0;  // bytes of the largest buffer that a kernel can bind
  std::uint64_t heap_bytes = 0;         // bytes of the largest device-local heap
  bool software = false;                // a CPU device such as lavapipe
  bool unified_memory = false;          // Domain::device is mapped: the host reads and writes it at full speed
  bool timestamps = false;              // false: Commands::timings() is empty
  std::vector<std::string> refused;     // reasons why the device cannot be used; empty if it can
};

// Lists all Vulkan devices without opening one. Without a loader, driver or device the list is empty and `why` says
// why; this is never an exception.
std::vector<DeviceInfo> list_devices(std::string* why = nullptr);
// Returns the device that `selector` names: a number, or a part of the device's name. An empty selector means the
// environment variable CHAINSPLAT_DEVICE if it is set, else the first usable device in the order discrete GPU,
// integrated GPU, others, CPU. Throws InputError that lists the candidates and why each is refused.
DeviceInfo choose_device(const std::string& selector);

// The findings of the command `doctor`, as values.
struct Doctor {
  std::vector<DeviceInfo> devices;
  int chosen = -1;                   // index into devices; -1: none
  std::string reason;                // why this device was chosen, or why none can be and how to mend that
  std::vector<std::string> missing;  // what else is absent and what that costs, one line per item
  bool validation_layer = false;     // only tests need it
  std::string pipeline_cache;        // folder of the pipeline cache; empty without a home folder: nothing is kept
};
// Never throws: what fails is reported in the result.
Doctor examine(const std::string& selector = "");
std::string doctor_text(const Doctor& doctor);  // several lines, for a terminal

struct DeviceOptions {
  std::string selector;
  bool validation = false;  // enables the validation layer; InputError when it is not installed
  bool least = false;       // for tests: use staged transfers, as on the least capable device
  // injected faults, for tests; 0: none
  std::uint64_t most_bytes = 0;    // device memory counts as full beyond this sum over all buffers
  std::uint64_t most_submits = 0;  // the device counts as lost after this number of submissions
};

// Device memory has no room for a buffer. The caller can try again with less work at a time.
struct OutOfMemory : WorkError {
  using WorkError::WorkError;
};

class Device;  // an opened device; it must outlive the buffers, pipelines and commands made from it
struct DeviceDeleter {
  void operator()(Device*) const;
};
using DevicePtr = std::unique_ptr<Device, DeviceDeleter>;
DevicePtr open_device(const DeviceOptions& options = {});
const DeviceInfo& info(const Device& device);
// Number of validation messages (errors and warnings, synchronization included) since the device was opened; 0 without
// validation.
int validation_messages(const Device& device);
std::vector<std::string> validation_texts(const Device& device);

enum class Domain {
  device,  // fastest for the GPU; the host accesses it through upload() and download()
  host,    // mapped and, where possible, cached on the host; the GPU can access it too, more slowly
};

class Buffer {
 public:
  Buffer();
  // The content is undefined until written. Throws OutOfMemory, or WorkError when `bytes` exceeds max_storage_range.
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
  bool made() const { return handles_ != nullptr; }  // false when default-constructed or moved from
  struct Handles;
  const Handles& handles() const { return *handles_; }

 private:
  std::unique_ptr<Handles> handles_;
  std::size_t bytes_ = 0;
  void* mapped_ = nullptr;
};

// Copy from the host to a buffer and back, and return when the copy is complete. No submission that accesses `buffer`
// may be in flight.
void upload(Device& device, Buffer& buffer, const void* data, std::size_t bytes, std::size_t offset = 0);
void download(Device& device, const Buffer& buffer, void* data, std::size_t bytes, std::size_t offset = 0);

// Embedded SPIR-V of shaders/<name>.comp (the build generates this function: shaders/shaders.cmake). Throws
// std::logic_error for an unknown name.
std::span<const std::uint32_t> shader_code(std::string_view name);

// Which buffer each name stands for. Copies are the same table. A pipeline finds its names when it is made; a dispatch
// takes the buffers that they stand for when it is recorded. Buffers must stay where they are, but may be made anew.
class Bindings {
 public:
  Bindings() = default;
  Bindings(std::initializer_list<std::pair<const std::string, const Buffer*>> buffers);
  // Lets `name` stand for another buffer. Throws std::logic_error that names it unless the constructor got that name.
  void set(std::string_view name, const Buffer& buffer);
  // Place in the table, at which the buffer stands as long as the table exists; null for a name that it has not.
  const Buffer* const* find(std::string_view name) const;

 private:
  using Table = std::map<std::string, const Buffer*, std::less<>>;  // its entries never move
  std::shared_ptr<Table> buffers_ = std::make_shared<Table>();
};

class Pipeline {
 public:
  Pipeline();
  // Makes the compute pipeline of shaders/<name>.comp with `push_bytes` of push constants (at most 128) and the
  // specialization constants 0, 1, 2, ... = `constants` (uint). Every storage buffer of the shader is bound to what
  // `bindings` has under the name of its array, as `splats` in "buffer Splats { vec4 splats[]; }"; more names than the
  // shader's are no error. Throws std::logic_error for an unknown shader, and for a name without a buffer, which it
  // gives with the shader's. Pipelines of equal shader and constants are compiled once per device and shared.
  Pipeline(Device& device, const std::string& name, const Bindings& bindings, std::size_t push_bytes,
           const std::vector<std::uint32_t>& constants);
  Pipeline(Pipeline&&) noexcept;
  Pipeline& operator=(Pipeline&&) noexcept;
  ~Pipeline();
  struct Handles;
  const Handles& handles() const { return *handles_; }
  const Buffer* buffer(std::size_t i) const { return *places_[i]; }  // for the i-th of handles().bindings

 private:
  std::shared_ptr<const Handles> handles_;
  Bindings bindings_;
  std::vector<const Buffer* const*> places_;  // in bindings_, so that no dispatch searches for a name
};

struct Timing {
  std::string label;
  double milliseconds = 0.0;
};

// A command list: recorded once, submitted any number of times. Commands are ordered: a full memory barrier (compute
// and transfer) precedes every dispatch, fill and copy unless no_barrier() was called since the last one, and the first
// barrier also waits for earlier submissions. Only one thread at a time may use a Commands; several threads may share a
// device. A dispatch of no groups and a fill or copy of 0 bytes are skipped. More than 65535 groups per axis are
// refused (spread them over y).
class Commands {
 public:
  explicit Commands(Device& device);
  Commands(Commands&&) noexcept;
  Commands& operator=(Commands&&) noexcept;
  ~Commands();
  void begin();  // starts a new recording and drops the old one; waits for the last submission
  void dispatch(const Pipeline& pipeline, const void* push, std::size_t push_bytes, std::uint32_t x,
                std::uint32_t y = 1, std::uint32_t z = 1);
  // The device reads the three group counts (uints) from `arguments` at byte `offset` (a multiple of 4).
  void dispatch_indirect(const Pipeline& pipeline, const void* push, std::size_t push_bytes, const Buffer& arguments,
                         std::size_t offset);
  void fill(const Buffer& buffer, std::uint32_t value, std::size_t offset, std::size_t bytes);
  void copy(const Buffer& from, std::size_t from_offset, const Buffer& to, std::size_t to_offset, std::size_t bytes);
  void no_barrier();                    // lets the next command overlap with the one before
  void stamp(const char* label);        // charges the device time since the last stamp to `label`
  void submit();                        // waits for the last submission, then starts this one; host writes are visible
  void wait();                          // for the last submission; throws WorkError when the device is lost
  std::vector<Timing> timings() const;  // of the last finished submission, summed by label
  struct State;

 private:
  std::unique_ptr<State> state_;
};

}  // namespace chainsplat::gpu
