#include "gpu/device.h"

#include <algorithm>
#include <array>
#include <atomic>
#include <cctype>
#include <charconv>
#include <cstdlib>
#include <cstring>
#include <utility>

namespace chainsplat::gpu {

namespace {

constexpr char kValidationLayer[] = "VK_LAYER_KHRONOS_validation";

bool instance_extension_present(const char* layer, const char* name) {
  std::uint32_t count = 0;
  if (vkEnumerateInstanceExtensionProperties(layer, &count, nullptr) != VK_SUCCESS) return false;
  std::vector<VkExtensionProperties> all(count);
  if (vkEnumerateInstanceExtensionProperties(layer, &count, all.data()) != VK_SUCCESS) return false;
  return std::any_of(all.begin(), all.end(), [&](const auto& e) { return std::strcmp(e.extensionName, name) == 0; });
}

VKAPI_ATTR VkBool32 VKAPI_CALL on_message(VkDebugUtilsMessageSeverityFlagBitsEXT, VkDebugUtilsMessageTypeFlagsEXT,
                                          const VkDebugUtilsMessengerCallbackDataEXT* data, void* user) {
  auto* messages = static_cast<Messages*>(user);
  std::lock_guard lock(messages->mutex);
  messages->texts.emplace_back(data->pMessage ? data->pMessage : "");
  return VK_FALSE;
}

// Messages of type GENERAL are left out: the loader uses them for remarks on drivers and layers, not for our faults.
VkDebugUtilsMessengerCreateInfoEXT messenger_info(Messages* messages) {
  auto info = of_type<VkDebugUtilsMessengerCreateInfoEXT>(VK_STRUCTURE_TYPE_DEBUG_UTILS_MESSENGER_CREATE_INFO_EXT);
  info.messageSeverity =
      VK_DEBUG_UTILS_MESSAGE_SEVERITY_WARNING_BIT_EXT | VK_DEBUG_UTILS_MESSAGE_SEVERITY_ERROR_BIT_EXT;
  info.messageType = VK_DEBUG_UTILS_MESSAGE_TYPE_VALIDATION_BIT_EXT | VK_DEBUG_UTILS_MESSAGE_TYPE_PERFORMANCE_BIT_EXT;
  info.pfnUserCallback = on_message;
  info.pUserData = messages;
  return info;
}

const char* type_name(VkPhysicalDeviceType type) {
  switch (type) {
    case VK_PHYSICAL_DEVICE_TYPE_DISCRETE_GPU: return "discrete GPU";
    case VK_PHYSICAL_DEVICE_TYPE_INTEGRATED_GPU: return "integrated GPU";
    case VK_PHYSICAL_DEVICE_TYPE_VIRTUAL_GPU: return "virtual GPU";
    case VK_PHYSICAL_DEVICE_TYPE_CPU: return "CPU";
    default: return "other";
  }
}

// Rank by which devices are preferred; smaller is better.
int rank(const std::string& type) {
  constexpr std::array kOrder = {"discrete GPU", "integrated GPU", "virtual GPU", "other", "CPU"};
  return static_cast<int>(std::find(kOrder.begin(), kOrder.end(), type) - kOrder.begin());
}

std::string version_text(std::uint32_t version) {
  return std::to_string(VK_API_VERSION_MAJOR(version)) + "." + std::to_string(VK_API_VERSION_MINOR(version));
}

std::string lower(std::string text) {
  std::transform(text.begin(), text.end(), text.begin(), [](unsigned char c) { return std::tolower(c); });
  return text;
}

std::string join(const std::vector<std::string>& parts, const char* between) {
  std::string all;
  for (const std::string& part : parts) all += (all.empty() ? "" : between) + part;
  return all;
}

std::string list_text(const std::vector<DeviceInfo>& devices) {
  std::vector<std::string> parts;
  for (const DeviceInfo& d : devices) {
    std::string part = std::to_string(d.index) + " = " + d.name + " (" + d.type + ")";
    if (!d.refused.empty()) part += " unusable: " + join(d.refused, ", ");
    parts.push_back(part);
  }
  return join(parts, "; ");
}

struct Features {  // the chain of feature structs that are queried and enabled
  VkPhysicalDeviceFeatures2 all{};
  VkPhysicalDeviceVulkan12Features v12{};
  VkPhysicalDeviceVulkan13Features v13{};
  Features() {
    all.sType = VK_STRUCTURE_TYPE_PHYSICAL_DEVICE_FEATURES_2;
    v12.sType = VK_STRUCTURE_TYPE_PHYSICAL_DEVICE_VULKAN_1_2_FEATURES;
    v13.sType = VK_STRUCTURE_TYPE_PHYSICAL_DEVICE_VULKAN_1_3_FEATURES;
    all.pNext = &v12;
    v12.pNext = &v13;
  }
  Features(const Features&) = delete;
};

Candidate examine_device(VkPhysicalDevice physical, int index) {
  Candidate c;
  c.handle = physical;
  DeviceInfo& info = c.info;
  info.index = index;

  // limits that every Vulkan version reports; a device before 1.3 is described no further
  VkPhysicalDeviceProperties basic{};
  vkGetPhysicalDeviceProperties(physical, &basic);
  info.name = basic.deviceName;
  info.type = type_name(basic.deviceType);
  info.software = basic.deviceType == VK_PHYSICAL_DEVICE_TYPE_CPU;
  info.api_version = basic.apiVersion;
  info.vendor = basic.vendorID;
  info.max_workgroup_invocations = basic.limits.maxComputeWorkGroupInvocations;
  info.shared_memory_bytes = basic.limits.maxComputeSharedMemorySize;
  info.storage_buffers = basic.limits.maxPerStageDescriptorStorageBuffers;
  info.max_storage_range = basic.limits.maxStorageBufferRange;
  if (basic.apiVersion < VK_API_VERSION_1_3) {
    info.refused.push_back("has Vulkan " + version_text(basic.apiVersion) + ", 1.3 is needed");
    return c;
  }

  auto properties = of_type<VkPhysicalDeviceProperties2>(VK_STRUCTURE_TYPE_PHYSICAL_DEVICE_PROPERTIES_2);
  auto driver = of_type<VkPhysicalDeviceDriverProperties>(VK_STRUCTURE_TYPE_PHYSICAL_DEVICE_DRIVER_PROPERTIES);
  auto subgroup = of_type<VkPhysicalDeviceSubgroupProperties>(VK_STRUCTURE_TYPE_PHYSICAL_DEVICE_SUBGROUP_PROPERTIES);
  auto v13 = of_type<VkPhysicalDeviceVulkan13Properties>(VK_STRUCTURE_TYPE_PHYSICAL_DEVICE_VULKAN_1_3_PROPERTIES);
  properties.pNext = &driver;
  driver.pNext = &subgroup;
  subgroup.pNext = &v13;
  vkGetPhysicalDeviceProperties2(physical, &properties);
  info.driver = std::string(driver.driverName) + " " + driver.driverInfo;

  // features and limits without which the device is refused
  Features features;
  vkGetPhysicalDeviceFeatures2(physical, &features.all);
  const auto need = [&](bool there, const std::string& what) {
    if (!there) info.refused.push_back("lacks " + what);
  };
  need(features.v12.timelineSemaphore, "timeline semaphores");
  need(features.v12.hostQueryReset, "host query reset");
  need(features.v13.synchronization2, "synchronization2");
  need(features.v13.maintenance4, "maintenance4");
  constexpr VkSubgroupFeatureFlags kOperations = VK_SUBGROUP_FEATURE_BASIC_BIT | VK_SUBGROUP_FEATURE_SHUFFLE_BIT;
  need((subgroup.supportedStages & VK_SHADER_STAGE_COMPUTE_BIT) &&
           (subgroup.supportedOperations & kOperations) == kOperations,
       "subgroup shuffles in compute shaders");
  const auto need_size = [&](std::uint64_t there, std::uint64_t least, const std::string& what) {
    need(there >= least, std::to_string(least) + " " + what + " (has " + std::to_string(there) + ")");
  };
  need_size(info.max_workgroup_invocations, kLeastInvocations, "invocations a work group");
  need_size(info.shared_memory_bytes, kLeastSharedBytes, "bytes of shared memory");
  need_size(info.storage_buffers, kLeastStorageBuffers, "storage buffers a shader");

  c.subgroups = choose_subgroups(v13, subgroup.subgroupSize, features.v13.subgroupSizeControl);
  info.subgroup_size = c.subgroups.size;
  info.one_subgroup_size = c.subgroups.fixed || v13.minSubgroupSize == v13.maxSubgroupSize;

  // the first queue family that can compute
  std::uint32_t count = 0;
  vkGetPhysicalDeviceQueueFamilyProperties(physical, &count, nullptr);
  std::vector<VkQueueFamilyProperties> families(count);
  vkGetPhysicalDeviceQueueFamilyProperties(physical, &count, families.data());
  const auto family = std::find_if(families.begin(), families.end(),
                                   [](const auto& f) { return (f.queueFlags & VK_QUEUE_COMPUTE_BIT) != 0; });
  need(family != families.end(), "a compute queue");
  if (family != families.end()) {
    c.queue_family = static_cast<std::uint32_t>(family - families.begin());
    c.timestamp_bits = family->timestampValidBits;
    c.timestamp_period = basic.limits.timestampPeriod;
    info.timestamps = c.timestamp_bits > 0;
  }

  // memory; a discrete GPU may also expose device memory to the host, but host reads from it are very slow
  VkPhysicalDeviceMemoryProperties memory{};
  vkGetPhysicalDeviceMemoryProperties(physical, &memory);
  for (std::uint32_t i = 0; i < memory.memoryHeapCount; ++i) {
    const VkMemoryHeap& heap = memory.memoryHeaps[i];
    if (heap.flags & VK_MEMORY_HEAP_DEVICE_LOCAL_BIT) info.heap_bytes = std::max(info.heap_bytes, heap.size);
  }
  constexpr VkMemoryPropertyFlags kBoth = VK_MEMORY_PROPERTY_DEVICE_LOCAL_BIT | VK_MEMORY_PROPERTY_HOST_VISIBLE_BIT |
                                          VK_MEMORY_PROPERTY_HOST_COHERENT_BIT | VK_MEMORY_PROPERTY_HOST_CACHED_BIT;
  const bool shared = info.software || basic.deviceType == VK_PHYSICAL_DEVICE_TYPE_INTEGRATED_GPU;
  for (std::uint32_t i = 0; i < memory.memoryTypeCount; ++i) {
    if (shared && (memory.memoryTypes[i].propertyFlags & kBoth) == kBoth) info.unified_memory = true;
  }
  return c;
}

std::vector<DeviceInfo> infos(const std::vector<Candidate>& all) {
  std::vector<DeviceInfo> result;
  for (const Candidate& c : all) result.push_back(c.info);
  return result;
}

}  // namespace

const char* result_name(VkResult result) {
  switch (result) {
    case VK_SUCCESS: return "success";
    case VK_TIMEOUT: return "timeout";
    case VK_ERROR_OUT_OF_HOST_MEMORY: return "out of host memory";
    case VK_ERROR_OUT_OF_DEVICE_MEMORY: return "out of device memory";
    case VK_ERROR_INITIALIZATION_FAILED: return "initialization failed";
    case VK_ERROR_DEVICE_LOST: return "device lost";
    case VK_ERROR_MEMORY_MAP_FAILED: return "memory map failed";
    case VK_ERROR_LAYER_NOT_PRESENT: return "layer not present";
    case VK_ERROR_EXTENSION_NOT_PRESENT: return "extension not present";
    case VK_ERROR_FEATURE_NOT_PRESENT: return "feature not present";
    case VK_ERROR_INCOMPATIBLE_DRIVER: return "no compatible driver";
    case VK_ERROR_TOO_MANY_OBJECTS: return "too many objects";
    case VK_ERROR_OUT_OF_POOL_MEMORY: return "out of pool memory";
    case VK_ERROR_FRAGMENTED_POOL: return "fragmented pool";
    default: return "an unexpected Vulkan result";
  }
}

// Where sizes vary, one is fixed if the device can, so that callers can size their per-subgroup memory; else they have
// to reckon with the smallest.
SubgroupChoice choose_subgroups(const VkPhysicalDeviceVulkan13Properties& v13, std::uint32_t usual, bool control) {
  if (v13.minSubgroupSize == v13.maxSubgroupSize) return {usual, usual, false};
  const std::uint32_t wanted = std::clamp(kWantedSubgroup, v13.minSubgroupSize, v13.maxSubgroupSize);
  const bool fixed = control && (v13.requiredSubgroupSizeStages & VK_SHADER_STAGE_COMPUTE_BIT) != 0 &&
                     v13.maxComputeWorkgroupSubgroups * wanted >= kLeastInvocations;
  return fixed ? SubgroupChoice{wanted, wanted, true} : SubgroupChoice{v13.minSubgroupSize, v13.maxSubgroupSize, false};
}

Instance::Instance(Instance&& other) noexcept { *this = std::move(other); }

Instance& Instance::operator=(Instance&& other) noexcept {
  std::swap(handle, other.handle);
  std::swap(messenger, other.messenger);
  std::swap(messages, other.messages);
  std::swap(debug_utils, other.debug_utils);
  return *this;
}

Instance::~Instance() {
  if (!handle) return;
  if (messenger) {
    const auto destroy = reinterpret_cast<PFN_vkDestroyDebugUtilsMessengerEXT>(
        vkGetInstanceProcAddr(handle, "vkDestroyDebugUtilsMessengerEXT"));
    destroy(handle, messenger, nullptr);
  }
  // The first one without layers stays until the process ends and keeps the drivers loaded: NVIDIA's (580.159) takes
  // memory whenever it is loaded that it never gives back, and the 31st time in one process it finds none.
  static std::atomic<VkInstance> kept{VK_NULL_HANDLE};
  VkInstance none = VK_NULL_HANDLE;
  if (messenger || !kept.compare_exchange_strong(none, handle)) vkDestroyInstance(handle, nullptr);
}

bool validation_layer_present() {
  std::uint32_t count = 0;
  if (vkEnumerateInstanceLayerProperties(&count, nullptr) != VK_SUCCESS) return false;
  std::vector<VkLayerProperties> all(count);
  if (vkEnumerateInstanceLayerProperties(&count, all.data()) != VK_SUCCESS) return false;
  return std::any_of(all.begin(), all.end(),
                     [](const auto& layer) { return std::strcmp(layer.layerName, kValidationLayer) == 0; });
}

Instance make_instance(bool validation, std::string* why) {
  Instance instance;
  auto application = of_type<VkApplicationInfo>(VK_STRUCTURE_TYPE_APPLICATION_INFO);
  application.pApplicationName = "chainsplat";
  application.apiVersion = VK_API_VERSION_1_3;

  // debug names and messages, where the extension exists
  std::vector<const char*> extensions;
  instance.debug_utils =
      instance_extension_present(nullptr, VK_EXT_DEBUG_UTILS_EXTENSION_NAME) ||
      (validation && instance_extension_present(kValidationLayer, VK_EXT_DEBUG_UTILS_EXTENSION_NAME));
  if (instance.debug_utils) extensions.push_back(VK_EXT_DEBUG_UTILS_EXTENSION_NAME);

  // the validation layer with synchronization validation, when asked for
  auto create = of_type<VkInstanceCreateInfo>(VK_STRUCTURE_TYPE_INSTANCE_CREATE_INFO);
  create.pApplicationInfo = &application;
  VkDebugUtilsMessengerCreateInfoEXT messenger = messenger_info(instance.messages.get());
  auto features = of_type<VkValidationFeaturesEXT>(VK_STRUCTURE_TYPE_VALIDATION_FEATURES_EXT);
  const VkValidationFeatureEnableEXT synchronization = VK_VALIDATION_FEATURE_ENABLE_SYNCHRONIZATION_VALIDATION_EXT;
  const char* const layers[] = {kValidationLayer};
  const bool watch = validation && instance.debug_utils;
  if (validation) {
    create.enabledLayerCount = 1;
    create.ppEnabledLayerNames = layers;
    if (instance_extension_present(kValidationLayer, VK_EXT_VALIDATION_FEATURES_EXTENSION_NAME)) {
      extensions.push_back(VK_EXT_VALIDATION_FEATURES_EXTENSION_NAME);
      features.enabledValidationFeatureCount = 1;
      features.pEnabledValidationFeatures = &synchronization;
      create.pNext = &features;
    }
    if (watch) {  // also reports faults of vkCreateInstance itself
      messenger.pNext = create.pNext;
      create.pNext = &messenger;
    }
  }
  create.enabledExtensionCount = static_cast<std::uint32_t>(extensions.size());
  create.ppEnabledExtensionNames = extensions.data();

  const VkResult result = vkCreateInstance(&create, nullptr, &instance.handle);
  if (result != VK_SUCCESS) {
    instance.handle = VK_NULL_HANDLE;
    if (why) *why = std::string("no Vulkan driver was found (") + result_name(result) + ")";
    return instance;
  }
  if (watch) {
    const auto make = reinterpret_cast<PFN_vkCreateDebugUtilsMessengerEXT>(
        vkGetInstanceProcAddr(instance.handle, "vkCreateDebugUtilsMessengerEXT"));
    messenger.pNext = nullptr;
    if (make) make(instance.handle, &messenger, nullptr, &instance.messenger);
  }
  return instance;
}

std::vector<Candidate> candidates(const Instance& instance, std::string* why) {
  std::vector<Candidate> all;
  if (!instance.handle) return all;
  std::uint32_t count = 0;
  VkResult result = vkEnumeratePhysicalDevices(instance.handle, &count, nullptr);
  std::vector<VkPhysicalDevice> devices(count);
  if (result == VK_SUCCESS && count > 0) result = vkEnumeratePhysicalDevices(instance.handle, &count, devices.data());
  if (result != VK_SUCCESS || count == 0) {
    if (why) *why = result == VK_SUCCESS ? "the Vulkan drivers show no device"
                                         : std::string("no Vulkan device answers (") + result_name(result) + ")";
    return all;
  }
  for (std::uint32_t i = 0; i < count; ++i) all.push_back(examine_device(devices[i], static_cast<int>(i)));
  return all;
}

std::size_t choose(const std::vector<DeviceInfo>& devices, const std::string& selector, const std::string& why_none,
                   std::string* reason) {
  const char* variable = std::getenv("CHAINSPLAT_DEVICE");
  const bool from_variable = selector.empty() && variable && *variable;
  const std::string wanted = from_variable ? variable : selector;
  const std::string where = from_variable ? "CHAINSPLAT_DEVICE" : wanted.empty() ? "device" : "`device`";
  if (devices.empty()) {
    throw InputError("device", why_none.empty() ? "there is no Vulkan device" : why_none,
                     "install a Vulkan 1.3 driver (Debian: mesa-vulkan-drivers brings a CPU device)");
  }

  // nothing is named: take the usable device of the best rank
  std::size_t best = devices.size();
  if (wanted.empty()) {
    for (std::size_t i = 0; i < devices.size(); ++i) {
      if (!devices[i].refused.empty()) continue;
      if (best == devices.size() || rank(devices[i].type) < rank(devices[best].type)) best = i;
    }
    if (best == devices.size()) {
      throw InputError(where, "no device can be used: " + list_text(devices), "install or update a Vulkan 1.3 driver");
    }
    if (reason) *reason = "first usable " + devices[best].type + " (discrete before integrated GPU before CPU)";
    return best;
  }

  // an index, or a part of a name; a number that is no index may still be part of a name ("4090")
  int index = -1;
  const auto [end, error] = std::from_chars(wanted.data(), wanted.data() + wanted.size(), index);
  const bool is_number = error == std::errc() && end == wanted.data() + wanted.size();
  std::string how;
  if (is_number && index >= 0 && index < static_cast<int>(devices.size())) {
    best = static_cast<std::size_t>(index);
    how = "number " + wanted;
  } else {
    how = "name contains '" + wanted + "'";
    for (std::size_t i = 0; i < devices.size(); ++i) {
      if (lower(devices[i].name).find(lower(wanted)) == std::string::npos) continue;
      // a usable device wins over an unusable one whose name also matches
      if (best == devices.size() || (!devices[best].refused.empty() && devices[i].refused.empty())) best = i;
    }
  }
  if (best == devices.size()) {
    throw InputError(where, "no device is '" + wanted + "'", "choose one of: " + list_text(devices));
  }
  if (!devices[best].refused.empty()) {
    throw InputError(where, devices[best].name + " cannot be used: " + join(devices[best].refused, ", "),
                     "choose one of: " + list_text(devices));
  }
  if (reason) *reason = how + ", from " + (from_variable ? "CHAINSPLAT_DEVICE" : "`device`");
  return best;
}

std::vector<DeviceInfo> list_devices(std::string* why) {
  if (why) why->clear();
  const Instance instance = make_instance(false, why);
  return infos(candidates(instance, why));
}

DeviceInfo choose_device(const std::string& selector) {
  std::string why;
  const std::vector<DeviceInfo> devices = list_devices(&why);
  return devices[choose(devices, selector, why, nullptr)];
}

void Device::check(VkResult result, const char* what) const {
  if (result == VK_SUCCESS) return;
  const std::string where = "device " + info.name;
  if (result == VK_ERROR_DEVICE_LOST) {
    throw WorkError(where, std::string("was lost while it should ") + what,
                    "run again (`resume` continues); the usual cause is a driver that stops long work, or its fault");
  }
  throw WorkError(where, std::string("could not ") + what + " (" + result_name(result) + ")",
                  result == VK_ERROR_OUT_OF_DEVICE_MEMORY || result == VK_ERROR_OUT_OF_HOST_MEMORY
                      ? "use a smaller picture, fewer Gaussians or a device with more memory"
                      : "choose another device with `device`, or update the driver");
}

void Device::name(VkObjectType type, std::uint64_t object, const char* text) const {
  if (!set_name || !text) return;
  auto object_name = of_type<VkDebugUtilsObjectNameInfoEXT>(VK_STRUCTURE_TYPE_DEBUG_UTILS_OBJECT_NAME_INFO_EXT);
  object_name.objectType = type;
  object_name.objectHandle = object;
  object_name.pObjectName = text;
  set_name(handle, &object_name);
}

Device::~Device() {
  if (!handle) return;
  vkDeviceWaitIdle(handle);
  staging_commands.reset();
  staging = Buffer();
  pipelines.clear();
  if (pipelines_made) save_pipeline_cache(handle, pipeline_cache, pipeline_cache_file);
  vkDestroyPipelineCache(handle, pipeline_cache, nullptr);
  vkDestroySemaphore(handle, timeline, nullptr);
  vkDestroyDevice(handle, nullptr);
}

void DeviceDeleter::operator()(Device* device) const { delete device; }

DevicePtr open_device(const DeviceOptions& options) {
  if (options.validation && !validation_layer_present()) {
    throw InputError("device", std::string("the layer ") + kValidationLayer + " is not installed",
                     "install it (Debian: vulkan-validationlayers) or turn validation off");
  }
  // choose the physical device and keep what is known about it
  DevicePtr device(new Device);
  std::string why;
  Instance instance = make_instance(options.validation, &why);
  if (options.validation && instance.handle && !instance.messenger) {
    throw InputError("device", "the validation layer cannot report (no VK_EXT_debug_utils)", "turn validation off");
  }
  const std::vector<Candidate> all = candidates(instance, &why);
  const Candidate& c = all[choose(infos(all), options.selector, why, nullptr)];
  Device& d = *device;
  d.instance = std::move(instance);
  d.physical = c.handle;
  d.info = c.info;
  d.queue_family = c.queue_family;
  d.info.unified_memory = c.info.unified_memory && !options.least;
  d.subgroups = c.subgroups;
  d.timestamp_mask = c.timestamp_bits >= 64 ? ~0ull : (1ull << c.timestamp_bits) - 1;
  d.timestamp_period = c.timestamp_period;
  d.validation = options.validation;
  d.most_bytes = options.most_bytes;
  d.most_submits = options.most_submits;
  vkGetPhysicalDeviceMemoryProperties(d.physical, &d.memory);

  // enable the required features and, where there, control over subgroup sizes
  Features there, wanted;
  vkGetPhysicalDeviceFeatures2(d.physical, &there.all);
  wanted.v12.timelineSemaphore = VK_TRUE;
  wanted.v12.hostQueryReset = VK_TRUE;
  wanted.v13.synchronization2 = VK_TRUE;
  wanted.v13.maintenance4 = VK_TRUE;
  wanted.v13.subgroupSizeControl = there.v13.subgroupSizeControl;
  wanted.v13.computeFullSubgroups = there.v13.computeFullSubgroups;
  d.full_subgroups = there.v13.computeFullSubgroups;

  const float priority = 1.0f;
  auto queue = of_type<VkDeviceQueueCreateInfo>(VK_STRUCTURE_TYPE_DEVICE_QUEUE_CREATE_INFO);
  queue.queueFamilyIndex = d.queue_family;
  queue.queueCount = 1;
  queue.pQueuePriorities = &priority;
  auto create = of_type<VkDeviceCreateInfo>(VK_STRUCTURE_TYPE_DEVICE_CREATE_INFO);
  create.pNext = &wanted.all;
  create.queueCreateInfoCount = 1;
  create.pQueueCreateInfos = &queue;
  d.check(vkCreateDevice(d.physical, &create, nullptr, &d.handle), "be opened");
  vkGetDeviceQueue(d.handle, d.queue_family, 0, &d.queue);
  if (d.instance.debug_utils) {
    d.set_name = reinterpret_cast<PFN_vkSetDebugUtilsObjectNameEXT>(
        vkGetInstanceProcAddr(d.instance.handle, "vkSetDebugUtilsObjectNameEXT"));
  }

  // the timeline that submissions signal, and the pipelines of earlier runs
  auto timeline = of_type<VkSemaphoreTypeCreateInfo>(VK_STRUCTURE_TYPE_SEMAPHORE_TYPE_CREATE_INFO);
  timeline.semaphoreType = VK_SEMAPHORE_TYPE_TIMELINE;
  auto semaphore = of_type<VkSemaphoreCreateInfo>(VK_STRUCTURE_TYPE_SEMAPHORE_CREATE_INFO);
  semaphore.pNext = &timeline;
  d.check(vkCreateSemaphore(d.handle, &semaphore, nullptr, &d.timeline), "make a semaphore");

  VkPhysicalDeviceProperties properties{};
  vkGetPhysicalDeviceProperties(d.physical, &properties);
  d.pipeline_cache = load_pipeline_cache(d.handle, properties, &d.pipeline_cache_file);
  return device;
}

const DeviceInfo& info(const Device& device) { return device.info; }

int validation_messages(const Device& device) {
  std::lock_guard lock(device.instance.messages->mutex);
  return static_cast<int>(device.instance.messages->texts.size());
}

std::vector<std::string> validation_texts(const Device& device) {
  std::lock_guard lock(device.instance.messages->mutex);
  return device.instance.messages->texts;
}

}  // namespace chainsplat::gpu
