#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <system_error>

#include "gpu/device.h"

namespace chainsplat::gpu {

namespace {

constexpr std::size_t kChecksumBytes = sizeof(std::uint64_t);  // they precede the driver's data in a cache file

std::string hexadecimal(const std::uint8_t* bytes, std::size_t count) {
  constexpr char kDigits[] = "0123456789abcdef";
  std::string text;
  for (std::size_t i = 0; i < count; ++i) {
    text += kDigits[bytes[i] >> 4];
    text += kDigits[bytes[i] & 15];
  }
  return text;
}

}  // namespace

Path pipeline_cache_folder() {
  const char* cache = std::getenv("XDG_CACHE_HOME");
  if (cache && *cache == '/') return Path(cache) / "chainsplat";  // the XDG rules say to ignore a relative path
  const char* home = std::getenv("HOME");
  if (home && *home == '/') return Path(home) / ".cache" / "chainsplat";
  return {};
}

std::string with_checksum(std::string_view data) {
  const std::uint64_t checksum = core::fnv1a(data);
  std::string content(kChecksumBytes, '\0');
  std::memcpy(content.data(), &checksum, kChecksumBytes);
  return content.append(data);
}

std::string_view without_checksum(std::string_view content) {
  if (content.size() <= kChecksumBytes) return {};
  std::uint64_t checksum = 0;
  std::memcpy(&checksum, content.data(), kChecksumBytes);
  const std::string_view data = content.substr(kChecksumBytes);
  return core::fnv1a(data) == checksum ? data : std::string_view();
}

VkPipelineCache load_pipeline_cache(VkDevice device, const VkPhysicalDeviceProperties& properties, Path* file) {
  std::string content;
  const Path folder = pipeline_cache_folder();
  if (!folder.empty()) {
    *file = folder / ("pipelines-" + hexadecimal(properties.pipelineCacheUUID, VK_UUID_SIZE) + ".bin");
    try {
      std::error_code error;
      if (std::filesystem::exists(*file, error)) content = core::read_file(*file);
    } catch (const std::exception&) {
      content.clear();
    }
  }
  const std::string_view data = without_checksum(content);
  auto create = of_type<VkPipelineCacheCreateInfo>(VK_STRUCTURE_TYPE_PIPELINE_CACHE_CREATE_INFO);
  create.initialDataSize = data.size();
  create.pInitialData = data.data();
  VkPipelineCache cache = VK_NULL_HANDLE;
  return vkCreatePipelineCache(device, &create, nullptr, &cache) == VK_SUCCESS ? cache : VK_NULL_HANDLE;
}

void save_pipeline_cache(VkDevice device, VkPipelineCache cache, const Path& file) {
  if (!cache || file.empty()) return;
  std::size_t bytes = 0;
  if (vkGetPipelineCacheData(device, cache, &bytes, nullptr) != VK_SUCCESS) return;
  if (bytes <= sizeof(VkPipelineCacheHeaderVersionOne)) return;  // an empty cache
  std::string data(bytes, '\0');
  if (vkGetPipelineCacheData(device, cache, &bytes, data.data()) != VK_SUCCESS) return;
  data.resize(bytes);
  const std::string content = with_checksum(data);
  try {
    std::error_code error;
    if (std::filesystem::file_size(file, error) == content.size() && !error && core::read_file(file) == content) return;
    std::filesystem::create_directories(file.parent_path(), error);
    if (!error) core::write_file(file, content);
  } catch (const std::exception&) {
    // the cache only saves time: a full disk or a read-only home must not stop the work
  }
}

Pipeline::Handles::~Handles() {
  vkDestroyPipeline(device->handle, pipeline, nullptr);
  vkDestroyPipelineLayout(device->handle, layout, nullptr);
  vkDestroyDescriptorSetLayout(device->handle, set_layout, nullptr);
}

namespace {

// What a SPIR-V module declares: whether it has subgroup operations, and its storage buffers by ascending number. The
// numbers of instructions are those of the SPIR-V specification, section 3.
struct Interface {
  bool subgroups = false;
  std::vector<Pipeline::Handles::Binding> bindings;

  explicit Interface(std::span<const std::uint32_t> code) {
    constexpr unsigned kHeaderWords = 5, kBinding = 33, kStorageBuffer = 12, kGroupNonUniform = 61;
    constexpr unsigned kOpMemberName = 6, kOpCapability = 17, kOpTypePointer = 32, kOpVariable = 59, kOpDecorate = 71;
    std::map<std::uint32_t, const char*> array_of_block;  // name of the only member
    std::map<std::uint32_t, std::uint32_t> block_of_pointer, number_of_variable;
    for (std::size_t k = kHeaderWords; k < code.size(); k += code[k] >> 16) {
      const std::uint32_t *const words = &code[k], operation = words[0] & 0xffff;
      if (operation == kOpCapability && words[1] == kGroupNonUniform) subgroups = true;
      if (operation == kOpMemberName) array_of_block[words[1]] = reinterpret_cast<const char*>(words + 3);
      if (operation == kOpTypePointer) block_of_pointer[words[1]] = words[3];
      if (operation == kOpDecorate && words[2] == kBinding) number_of_variable[words[1]] = words[3];
      if (operation == kOpVariable && words[3] == kStorageBuffer)
        bindings.push_back({number_of_variable.at(words[2]), array_of_block.at(block_of_pointer.at(words[1]))});
    }
    std::sort(bindings.begin(), bindings.end(), [](const auto& a, const auto& b) { return a.number < b.number; });
  }
};

// Throws like the constructor of Pipeline.
std::shared_ptr<const Pipeline::Handles> make_handles(Device& device, const std::string& name, std::size_t push_bytes,
                                                      const std::vector<std::uint32_t>& constants) {
  const std::span<const std::uint32_t> code = shader_code(name);
  const Interface interface(code);
  auto handles = std::make_shared<Pipeline::Handles>();
  Pipeline::Handles& h = *handles;
  h.device = &device;
  CHAINSPLAT_CHECK(push_bytes <= kMostPushBytes && push_bytes % 4 == 0, name + ": " + std::to_string(push_bytes));
  CHAINSPLAT_CHECK(interface.bindings.size() <= kLeastStorageBuffers,
                   name + ": " + std::to_string(interface.bindings.size()));
  h.name = name;
  h.bindings = interface.bindings;
  h.push_bytes = static_cast<std::uint32_t>(push_bytes);

  // layout: storage buffers of set 0 and push constants
  std::vector<VkDescriptorSetLayoutBinding> bindings;
  for (const Pipeline::Handles::Binding& binding : h.bindings)
    bindings.push_back({binding.number, VK_DESCRIPTOR_TYPE_STORAGE_BUFFER, 1, VK_SHADER_STAGE_COMPUTE_BIT, nullptr});
  auto set = of_type<VkDescriptorSetLayoutCreateInfo>(VK_STRUCTURE_TYPE_DESCRIPTOR_SET_LAYOUT_CREATE_INFO);
  set.bindingCount = static_cast<std::uint32_t>(bindings.size());
  set.pBindings = bindings.data();
  device.check(vkCreateDescriptorSetLayout(device.handle, &set, nullptr, &h.set_layout), "make a descriptor layout");

  const VkPushConstantRange range{VK_SHADER_STAGE_COMPUTE_BIT, 0, h.push_bytes};
  auto layout = of_type<VkPipelineLayoutCreateInfo>(VK_STRUCTURE_TYPE_PIPELINE_LAYOUT_CREATE_INFO);
  layout.setLayoutCount = 1;
  layout.pSetLayouts = &h.set_layout;
  layout.pushConstantRangeCount = push_bytes > 0 ? 1 : 0;
  layout.pPushConstantRanges = &range;
  device.check(vkCreatePipelineLayout(device.handle, &layout, nullptr, &h.layout), "make a pipeline layout");

  // specialization constants and SPIR-V
  std::vector<VkSpecializationMapEntry> entries;
  for (std::uint32_t i = 0; i < constants.size(); ++i)
    entries.push_back({i, i * static_cast<std::uint32_t>(sizeof(std::uint32_t)), sizeof(std::uint32_t)});
  VkSpecializationInfo specialization{};
  specialization.mapEntryCount = static_cast<std::uint32_t>(entries.size());
  specialization.pMapEntries = entries.data();
  specialization.dataSize = constants.size() * sizeof(std::uint32_t);
  specialization.pData = constants.data();

  auto module_create = of_type<VkShaderModuleCreateInfo>(VK_STRUCTURE_TYPE_SHADER_MODULE_CREATE_INFO);
  module_create.codeSize = code.size_bytes();
  module_create.pCode = code.data();
  VkShaderModule module = VK_NULL_HANDLE;
  device.check(vkCreateShaderModule(device.handle, &module_create, nullptr, &module), "take a shader");

  auto subgroup = of_type<VkPipelineShaderStageRequiredSubgroupSizeCreateInfo>(
      VK_STRUCTURE_TYPE_PIPELINE_SHADER_STAGE_REQUIRED_SUBGROUP_SIZE_CREATE_INFO);
  subgroup.requiredSubgroupSize = device.info.subgroup_size;
  auto create = of_type<VkComputePipelineCreateInfo>(VK_STRUCTURE_TYPE_COMPUTE_PIPELINE_CREATE_INFO);
  create.stage = of_type<VkPipelineShaderStageCreateInfo>(VK_STRUCTURE_TYPE_PIPELINE_SHADER_STAGE_CREATE_INFO);
  create.stage.pNext = device.subgroups.fixed ? &subgroup : nullptr;
  // Kernels address other lanes of their subgroup by number, and constant 0 is the size of their work group. Vulkan
  // guarantees a numbering without gaps only for full subgroups, which can be required only of a work group that is
  // made of whole ones. Smaller work groups rely on the driver: all known ones number their lanes from 0.
  if (device.full_subgroups && interface.subgroups && !constants.empty() && constants[0] % device.subgroups.whole == 0)
    create.stage.flags = VK_PIPELINE_SHADER_STAGE_CREATE_REQUIRE_FULL_SUBGROUPS_BIT;
  create.stage.stage = VK_SHADER_STAGE_COMPUTE_BIT;
  create.stage.module = module;
  create.stage.pName = "main";
  create.stage.pSpecializationInfo = &specialization;
  create.layout = h.layout;
  const VkResult result =
      vkCreateComputePipelines(device.handle, device.pipeline_cache, 1, &create, nullptr, &h.pipeline);
  vkDestroyShaderModule(device.handle, module, nullptr);
  device.check(result, ("compile shader " + name).c_str());
  device.pipelines_made = true;
  device.name(VK_OBJECT_TYPE_PIPELINE, reinterpret_cast<std::uint64_t>(h.pipeline), name.c_str());
  return handles;
}

}  // namespace

Bindings::Bindings(std::initializer_list<std::pair<const std::string, const Buffer*>> buffers)
    : buffers_(std::make_shared<Table>(buffers)) {}

const Buffer* const* Bindings::find(std::string_view name) const {
  const auto found = buffers_->find(name);
  return found == buffers_->end() ? nullptr : &found->second;
}

void Bindings::set(std::string_view name, const Buffer& buffer) {
  const auto found = buffers_->find(name);
  CHAINSPLAT_CHECK(found != buffers_->end(), "there is no buffer '" + std::string(name) + "'");
  found->second = &buffer;
}

Pipeline::Pipeline(Device& device, const std::string& name, const Bindings& bindings, std::size_t push_bytes,
                   const std::vector<std::uint32_t>& constants)
    : bindings_(bindings) {
  std::string key = name + ' ' + std::to_string(push_bytes);
  for (const std::uint32_t constant : constants) key += ' ' + std::to_string(constant);
  const std::lock_guard lock(device.pipelines_mutex);
  std::shared_ptr<const Handles>& shared = device.pipelines[key];
  if (!shared) shared = make_handles(device, name, push_bytes, constants);
  handles_ = shared;
  for (const Handles::Binding& binding : handles_->bindings) {
    places_.push_back(bindings_.find(binding.buffer));
    CHAINSPLAT_CHECK(places_.back(), "shader '" + name + "' declares '" + binding.buffer + "', which is not bound");
  }
}

Pipeline::Pipeline() = default;
Pipeline::Pipeline(Pipeline&&) noexcept = default;
Pipeline& Pipeline::operator=(Pipeline&&) noexcept = default;
Pipeline::~Pipeline() = default;

}  // namespace chainsplat::gpu
