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

// What every device that we accept offers (checked by list_devices, relied on by everyone).
inline constexpr std::uint32_t kMostPushBytes = 128;       // the least maxPushConstantsSize of Vulkan
inline constexpr std::uint32_t kMostGroups = 65535;        // the least maxComputeWorkGroupCount of Vulkan, an axis
inline constexpr std::uint32_t kLeastInvocations = 256;    // of a work group; Vulkan itself promises 128
inline constexpr std::uint32_t kLeastSharedBytes = 16384;  // the least maxComputeSharedMemorySize of Vulkan
inline constexpr std::uint32_t kLeastStorageBuffers = 16;  // of a kernel; Vulkan itself promises 4

// What is asked for where subgroups come in several sizes: the lanes of the smallest group that works as subgroups, so
// that none is launched in part (AMD's are of 64 lanes by default, and can be of 32).
inline constexpr std::uint32_t kWantedSubgroup = 32;

// A Vulkan struct with its type set and everything else zero.
template <class T>
T of_type(VkStructureType type) {
  T made{};
  made.sType = type;
  return made;
}

const char* result_name(VkResult result);

// The subgroups of a device's pipelines, from what it says of them.
struct SubgroupChoice {
  std::uint32_t size = 0;   // lanes that each has at least
  std::uint32_t whole = 0;  // a group of a multiple of so many lanes can be whole subgroups
  bool fixed = false;       // pipelines must and can ask for `size`
};
SubgroupChoice choose_subgroups(const VkPhysicalDeviceVulkan13Properties& v13, std::uint32_t usual, bool control);

struct Messages {  // of the validation layer, from any thread
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
// Never throws for a missing loader, driver or layer: the handle is null then, and `why` says so.
Instance make_instance(bool validation, std::string* why);

struct Candidate {
  VkPhysicalDevice handle = VK_NULL_HANDLE;
  DeviceInfo info;
  std::uint32_t queue_family = 0, timestamp_bits = 0, push_descriptors = 0;
  SubgroupChoice subgroups;
  float timestamp_period = 1.0f;     // ns a tick
};

std::vector<Candidate> candidates(const Instance& instance, std::string* why);
// Index into `devices` of what `selector` means, with the reason; throws InputError (see choose_device).
std::size_t choose(const std::vector<DeviceInfo>& devices, const std::string& selector, const std::string& why_none,
                   std::string* reason);

// Folder of the pipeline cache, empty without a home folder.
Path pipeline_cache_folder();
// Content of a cache file. Drivers check the header of their data but trust the rest: a damaged file must not reach
// them, so without_checksum gives nothing then.
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
  std::uint32_t push_descriptors = 0;  // storage buffers that can be pushed; 0: use descriptor sets
  SubgroupChoice subgroups;
  bool full_subgroups = false;  // pipelines can ask for subgroups without idle lanes
  std::uint64_t timestamp_mask = 0;  // 0: no timestamps
  double timestamp_period = 1.0;     // ns a tick
  bool validation = false;
  std::uint64_t most_bytes = 0, most_submits = 0;      // see DeviceOptions
  mutable std::atomic<std::uint64_t> buffer_bytes{0};  // of all buffers there are

  // every submit signals the next value, in queue order
  std::mutex queue_mutex;
  VkSemaphore timeline = VK_NULL_HANDLE;
  std::uint64_t submitted = 0;

  VkPipelineCache pipeline_cache = VK_NULL_HANDLE;
  Path pipeline_cache_file;
  std::atomic<bool> pipelines_made{false};
  // compiled, by everything that they depend on; for as long as the device
  std::mutex pipelines_mutex;
  std::map<std::string, std::shared_ptr<const Pipeline::Handles>> pipelines;

  // upload and download of memory that is not mapped
  std::mutex staging_mutex;
  Buffer staging;
  std::unique_ptr<Commands> staging_commands;

  PFN_vkCmdPushDescriptorSetKHR push_descriptor_set = nullptr;
  PFN_vkSetDebugUtilsObjectNameEXT set_name = nullptr;

  ~Device();
  // Throws WorkError that names this device unless `result` is VK_SUCCESS.
  void check(VkResult result, const char* what) const;
  void name(VkObjectType type, std::uint64_t object, const char* text) const;
};

struct Buffer::Handles {
  const Device* device = nullptr;
  VkBuffer buffer = VK_NULL_HANDLE;
  VkDeviceMemory memory = VK_NULL_HANDLE;
  std::uint64_t allocated = 0;  // bytes
  ~Handles();
};

struct Pipeline::Handles {
  const Device* device = nullptr;
  VkDescriptorSetLayout set_layout = VK_NULL_HANDLE;
  VkPipelineLayout layout = VK_NULL_HANDLE;
  VkPipeline pipeline = VK_NULL_HANDLE;
  std::string name;
  std::uint32_t buffers = 0, push_bytes = 0;
  bool pushes_descriptors = false;
  ~Handles();
};

}  // namespace chainsplat::gpu
