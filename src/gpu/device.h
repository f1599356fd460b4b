// gpu/device.h - what the sources of the gpu module share: the opened device, its handles and the check of VkResult.
#pragma once
#include <vulkan/vulkan.h>

#include <atomic>
#include <map>
#include <memory>
#include <mutex>
#include <string>
#include <vector>

#include "chainsplat/gpu.h"

namespace chainsplat::gpu {

// Limits that every accepted device offers: checked by list_devices, relied on everywhere.
inline constexpr std::uint32_t kMostPushBytes = 128;       // the least maxPushConstantsSize that Vulkan allows
inline constexpr std::uint32_t kMostGroups = 65535;        // the least maxComputeWorkGroupCount per axis
inline constexpr std::uint32_t kLeastInvocations = 256;    // per work group; Vulkan itself guarantees only 128
inline constexpr std::uint32_t kLeastSharedBytes = 16384;  // the least maxComputeSharedMemorySize that Vulkan allows
inline constexpr std::uint32_t kLeastStorageBuffers = 16;  // per kernel; Vulkan itself guarantees only 4

// Subgroup size requested on a device that offers several. It equals the size of the smallest work groups that use
// subgroup operations, so that none of them fills a subgroup only in part (AMD: 64 lanes by default, 32 on request).
inline constexpr std::uint32_t kWantedSubgroup = 32;

// A Vulkan struct with its type set and everything else zero.
template <class T>
T of_type(VkStructureType type) {
  T made{};
  made.sType = type;
  return made;
}

const char* result_name(VkResult result);

// The subgroups that a device's pipelines get, derived from the device's properties.
struct SubgroupChoice {
  std::uint32_t size = 0;   // least number of lanes of a subgroup
  std::uint32_t whole = 0;  // a work group of a multiple of this number of lanes consists of full subgroups
  bool fixed = false;       // pipelines must request `size`, and the device supports that
};
// `usual`: the device's default subgroup size; `control`: it supports subgroupSizeControl.
SubgroupChoice choose_subgroups(const VkPhysicalDeviceVulkan13Properties& v13, std::uint32_t usual, bool control);

struct Messages {  // of the validation layer, which may report from any thread
  std::mutex mutex;
  std::vector<std::string> texts;
};

struct Instance {
  VkInstance handle = VK_NULL_HANDLE;
  VkDebugUtilsMessengerEXT messenger = VK_NULL_HANDLE;
  std::unique_ptr<Messages> messages = std::make_unique<Messages>();
  bool debug_utils = false;
  Instance() = default;
  Instance(Instance&& other) noexcept;
  Instance& operator=(Instance&& other) noexcept;
  ~Instance();
};

bool validation_layer_present();
// Never throws for a missing loader, driver or layer: the handle is null then, and `why` states the reason.
Instance make_instance(bool validation, std::string* why);

struct Candidate {
  VkPhysicalDevice handle = VK_NULL_HANDLE;
  DeviceInfo info;
  std::uint32_t queue_family = 0, timestamp_bits = 0;
  SubgroupChoice subgroups;
  float timestamp_period = 1.0f;  // ns per tick
};

std::vector<Candidate> candidates(const Instance& instance, std::string* why);
// Index into `devices` of the one that `selector` names, and the reason; throws InputError (see choose_device).
std::size_t choose(const std::vector<DeviceInfo>& devices, const std::string& selector, const std::string& why_none,
                   std::string* reason);

// Folder of the pipeline cache; empty without a home folder.
Path pipeline_cache_folder();
// Content of a cache file: a checksum and the driver's data. Drivers check the header of their data but trust the rest,
// so a damaged file must not reach them: without_checksum returns nothing for it.
std::string with_checksum(std::string_view data);
std::string_view without_checksum(std::string_view content);
VkPipelineCache load_pipeline_cache(VkDevice device, const VkPhysicalDeviceProperties& properties, Path* file);
void save_pipeline_cache(VkDevice device, VkPipelineCache cache, const Path& file);  // failures are ignored

class Device {
 public:
  Instance instance;
  VkPhysicalDevice physical = VK_NULL_HANDLE;
  VkDevice handle = VK_NULL_HANDLE;
  VkQueue queue = VK_NULL_HANDLE;
  VkPhysicalDeviceMemoryProperties memory{};
  DeviceInfo info;
  std::uint32_t queue_family = 0;
  SubgroupChoice subgroups;
  bool full_subgroups = false;       // pipelines can request subgroups without inactive lanes
  std::uint64_t timestamp_mask = 0;  // valid bits of a timestamp; 0: no timestamps
  double timestamp_period = 1.0;     // ns per tick
  bool validation = false;
  std::uint64_t most_bytes = 0, most_submits = 0;      // see DeviceOptions
  mutable std::atomic<std::uint64_t> buffer_bytes{0};  // allocated by all live buffers
  std::atomic<std::uint64_t> buffers_made{0};

  // every submission signals the next value of the timeline, in queue order
  std::mutex queue_mutex;
  VkSemaphore timeline = VK_NULL_HANDLE;
  std::uint64_t submitted = 0;

  VkPipelineCache pipeline_cache = VK_NULL_HANDLE;
  Path pipeline_cache_file;
  std::atomic<bool> pipelines_made{false};
  // compiled pipelines by name and everything else that they depend on; they live as long as the device
  std::mutex pipelines_mutex;
  std::map<std::string, std::shared_ptr<const Pipeline::Handles>> pipelines;

  // for upload() and download() of memory that is not mapped
  std::mutex staging_mutex;
  Buffer staging;
  std::unique_ptr<Commands> staging_commands;

  PFN_vkSetDebugUtilsObjectNameEXT set_name = nullptr;

  ~Device();
  // Throws WorkError that names this device unless `result` is VK_SUCCESS; `what` is the verb after "could not".
  void check(VkResult result, const char* what) const;
  void name(VkObjectType type, std::uint64_t object, const char* text) const;
};

struct Buffer::Handles {
  const Device* device = nullptr;
  VkBuffer buffer = VK_NULL_HANDLE;
  VkDeviceMemory memory = VK_NULL_HANDLE;
  std::uint64_t allocated = 0;  // bytes
  std::uint64_t number = 0;     // from 1, of this buffer alone; VkBuffer may be that of one that is gone
  ~Handles();
};

struct Pipeline::Handles {
  const Device* device = nullptr;
  VkDescriptorSetLayout set_layout = VK_NULL_HANDLE;
  VkPipelineLayout layout = VK_NULL_HANDLE;
  VkPipeline pipeline = VK_NULL_HANDLE;
  std::string name;
  struct Binding {
    std::uint32_t number = 0;  // in descriptor set 0
    std::string buffer;        // name of its array
  };
  std::vector<Binding> bindings;
  std::uint32_t push_bytes = 0;
  ~Handles();
};

}  // namespace chainsplat::gpu
