#include <algorithm>
#include <cstring>
#include <utility>

#include "gpu/device.h"

namespace chainsplat::gpu {

namespace {

constexpr std::size_t kStagingBytes = 16u << 20;  // larger transfers go in parts, which bounds the pinned host memory
constexpr std::size_t kBufferAlignment = 4;       // Vulkan fills whole words

// Index of the first memory type allowed by `bits` with all of `flags` and none of `without`, or -1. The first is the
// best: drivers list the faster type first.
int memory_type(const Device& d, std::uint32_t bits, VkMemoryPropertyFlags flags, VkMemoryPropertyFlags without = 0) {
  for (std::uint32_t i = 0; i < d.memory.memoryTypeCount; ++i) {
    const VkMemoryPropertyFlags has = d.memory.memoryTypes[i].propertyFlags;
    if ((bits >> i & 1u) && (has & flags) == flags && (has & without) == 0) return static_cast<int>(i);
  }
  return -1;
}

int memory_type_for(const Device& d, std::uint32_t bits, Domain domain) {
  constexpr VkMemoryPropertyFlags kMapped = VK_MEMORY_PROPERTY_HOST_VISIBLE_BIT | VK_MEMORY_PROPERTY_HOST_COHERENT_BIT;
  constexpr VkMemoryPropertyFlags kCached = kMapped | VK_MEMORY_PROPERTY_HOST_CACHED_BIT;
  constexpr VkMemoryPropertyFlags kLocal = VK_MEMORY_PROPERTY_DEVICE_LOCAL_BIT;
  int type = -1;
  if (domain == Domain::host) {
    type = memory_type(d, bits, kCached);
    return type >= 0 ? type : memory_type(d, bits, kMapped);
  }
  if (d.info.unified_memory) type = memory_type(d, bits, kLocal | kCached);
  if (type < 0) type = memory_type(d, bits, kLocal, VK_MEMORY_PROPERTY_HOST_VISIBLE_BIT);
  if (type < 0) type = memory_type(d, bits, kLocal);
  return type >= 0 ? type : memory_type(d, bits, 0);
}

std::string mebibytes(std::uint64_t bytes) { return std::to_string((bytes + (1u << 20) - 1) >> 20) + " MiB"; }

// Splits a transfer of `bytes` into parts that fit the staging buffer and calls transfer(commands, offset, part bytes)
// for each. Holds the staging lock throughout.
template <class Transfer>
void in_parts(Device& device, std::size_t bytes, Transfer transfer) {
  std::lock_guard lock(device.staging_mutex);
  if (!device.staging_commands) {
    device.staging = Buffer(device, kStagingBytes, Domain::host, "staging");
    device.staging_commands = std::make_unique<Commands>(device);
  }
  for (std::size_t done = 0; done < bytes; done += kStagingBytes) {
    transfer(*device.staging_commands, done, std::min(kStagingBytes, bytes - done));
  }
}

}  // namespace

Buffer::Handles::~Handles() {
  vkDestroyBuffer(device->handle, buffer, nullptr);
  vkFreeMemory(device->handle, memory, nullptr);  // also unmaps it
  device->buffer_bytes -= allocated;
}

Buffer::Buffer(Device& device, std::size_t bytes, Domain domain, const char* name)
    : handles_(std::make_unique<Handles>()), bytes_(bytes) {
  handles_->device = &device;
  handles_->number = ++device.buffers_made;
  const std::string where = "device " + device.info.name;
  if (bytes > device.info.max_storage_range) {
    throw WorkError(where,
                    std::string("buffer '") + name + "' needs " + mebibytes(bytes) + ", the device binds at most " +
                        mebibytes(device.info.max_storage_range),
                    "use a smaller picture, fewer Gaussians or fewer views at a time");
  }
  auto create = of_type<VkBufferCreateInfo>(VK_STRUCTURE_TYPE_BUFFER_CREATE_INFO);
  create.size = std::max(kBufferAlignment, (bytes + kBufferAlignment - 1) / kBufferAlignment * kBufferAlignment);
  create.usage = VK_BUFFER_USAGE_STORAGE_BUFFER_BIT | VK_BUFFER_USAGE_INDIRECT_BUFFER_BIT |
                 VK_BUFFER_USAGE_TRANSFER_SRC_BIT | VK_BUFFER_USAGE_TRANSFER_DST_BIT;
  device.check(vkCreateBuffer(device.handle, &create, nullptr, &handles_->buffer), "make a buffer");
  device.name(VK_OBJECT_TYPE_BUFFER, reinterpret_cast<std::uint64_t>(handles_->buffer), name);

  // allocate memory of the best type, or fail as if the device were full (DeviceOptions::most_bytes)
  VkMemoryRequirements needs{};
  vkGetBufferMemoryRequirements(device.handle, handles_->buffer, &needs);
  const int type = memory_type_for(device, needs.memoryTypeBits, domain);
  CHAINSPLAT_CHECK(type >= 0, where);
  auto allocate = of_type<VkMemoryAllocateInfo>(VK_STRUCTURE_TYPE_MEMORY_ALLOCATE_INFO);
  allocate.allocationSize = needs.size;
  allocate.memoryTypeIndex = static_cast<std::uint32_t>(type);
  const bool room = device.most_bytes == 0 || device.buffer_bytes + needs.size <= device.most_bytes;
  const VkResult result =
      room ? vkAllocateMemory(device.handle, &allocate, nullptr, &handles_->memory) : VK_ERROR_OUT_OF_DEVICE_MEMORY;
  if (result != VK_SUCCESS) {
    throw OutOfMemory(
        where,
        std::string("no ") + mebibytes(needs.size) + " left for buffer '" + name + "' (" + result_name(result) + ")",
        "use a smaller picture, fewer Gaussians or a device with more memory");
  }
  handles_->allocated = needs.size;
  device.buffer_bytes += needs.size;
  device.check(vkBindBufferMemory(device.handle, handles_->buffer, handles_->memory, 0), "bind memory");

  // map coherent memory for the buffer's whole life
  if (domain == Domain::host || device.info.unified_memory) {
    const VkMemoryPropertyFlags flags = device.memory.memoryTypes[type].propertyFlags;
    if (flags & VK_MEMORY_PROPERTY_HOST_COHERENT_BIT) {
      device.check(vkMapMemory(device.handle, handles_->memory, 0, VK_WHOLE_SIZE, 0, &mapped_), "map memory");
    }
  }
}

Buffer::Buffer() = default;
Buffer::Buffer(Buffer&& other) noexcept
    : handles_(std::move(other.handles_)),
      bytes_(std::exchange(other.bytes_, 0)),
      mapped_(std::exchange(other.mapped_, nullptr)) {}

Buffer& Buffer::operator=(Buffer&& other) noexcept {
  handles_ = std::move(other.handles_);
  bytes_ = std::exchange(other.bytes_, 0);
  mapped_ = std::exchange(other.mapped_, nullptr);
  return *this;
}

Buffer::~Buffer() = default;

void upload(Device& device, Buffer& buffer, const void* data, std::size_t bytes, std::size_t offset) {
  CHAINSPLAT_CHECK(offset + bytes <= buffer.bytes(),
                   std::to_string(offset) + " + " + std::to_string(bytes) + ", " + std::to_string(buffer.bytes()));
  if (bytes == 0) return;
  if (buffer.mapped()) {
    std::memcpy(static_cast<char*>(buffer.mapped()) + offset, data, bytes);
    return;
  }
  in_parts(device, bytes, [&](Commands& commands, std::size_t done, std::size_t part) {
    std::memcpy(device.staging.mapped(), static_cast<const char*>(data) + done, part);
    commands.begin();
    commands.copy(device.staging, 0, buffer, offset + done, part);
    commands.submit();
    commands.wait();
  });
}

void download(Device& device, const Buffer& buffer, void* data, std::size_t bytes, std::size_t offset) {
  CHAINSPLAT_CHECK(offset + bytes <= buffer.bytes(),
                   std::to_string(offset) + " + " + std::to_string(bytes) + ", " + std::to_string(buffer.bytes()));
  if (bytes == 0) return;
  if (buffer.mapped()) {
    std::memcpy(data, static_cast<const char*>(buffer.mapped()) + offset, bytes);
    return;
  }
  in_parts(device, bytes, [&](Commands& commands, std::size_t done, std::size_t part) {
    commands.begin();
    commands.copy(buffer, offset + done, device.staging, 0, part);
    commands.submit();
    commands.wait();
    std::memcpy(static_cast<char*>(data) + done, device.staging.mapped(), part);
  });
}

}  // namespace chainsplat::gpu
