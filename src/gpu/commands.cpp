#include <algorithm>
#include <array>

#include "gpu/device.h"

namespace chainsplat::gpu {

namespace {

constexpr std::uint32_t kQueriesAPool = 64;  // timestamps per query pool; a longer list makes further pools
constexpr std::uint32_t kSetsAPool = 64;     // descriptor sets per pool; likewise
constexpr std::uint32_t kMostSets = 512;     // are kept from one recording to the next; the engine needs some forty

constexpr VkPipelineStageFlags2 kWorkStages =
    VK_PIPELINE_STAGE_2_COMPUTE_SHADER_BIT | VK_PIPELINE_STAGE_2_ALL_TRANSFER_BIT;
constexpr VkAccessFlags2 kWorkWrites = VK_ACCESS_2_SHADER_WRITE_BIT | VK_ACCESS_2_TRANSFER_WRITE_BIT;
constexpr VkAccessFlags2 kWorkReads =
    VK_ACCESS_2_SHADER_READ_BIT | VK_ACCESS_2_TRANSFER_READ_BIT | VK_ACCESS_2_INDIRECT_COMMAND_READ_BIT;

void memory_barrier(VkCommandBuffer commands, VkPipelineStageFlags2 source, VkAccessFlags2 writes,
                    VkPipelineStageFlags2 target, VkAccessFlags2 accesses) {
  auto barrier = of_type<VkMemoryBarrier2>(VK_STRUCTURE_TYPE_MEMORY_BARRIER_2);
  barrier.srcStageMask = source;
  barrier.srcAccessMask = writes;
  barrier.dstStageMask = target;
  barrier.dstAccessMask = accesses;
  auto dependency = of_type<VkDependencyInfo>(VK_STRUCTURE_TYPE_DEPENDENCY_INFO);
  dependency.memoryBarrierCount = 1;
  dependency.pMemoryBarriers = &barrier;
  vkCmdPipelineBarrier2(commands, &dependency);
}

}  // namespace

struct Commands::State {
  Device& device;
  VkCommandPool pool = VK_NULL_HANDLE;
  VkCommandBuffer commands = VK_NULL_HANDLE;
  bool recording = false, recorded = false;
  bool barrier = true;          // whether one precedes the next command
  std::uint64_t submitted = 0;  // timeline value of the last submission; 0: none is in flight

  std::vector<VkQueryPool> query_pools;
  std::vector<std::string> labels;  // of timestamps 1, 2, ...; timestamp 0 marks the beginning
  std::vector<Timing> timings;
  bool timings_due = false;  // submitted, and the timestamps are not yet read

  // Descriptor sets are kept for the next recordings, most of which bind the same buffers again: pushing descriptors at
  // every dispatch made training on lavapipe 2 % slower.
  struct KnownSet {
    std::array<std::uint64_t, kLeastStorageBuffers> buffers{};  // Buffer::Handles::number; 0 after the last
    VkDescriptorSet set = VK_NULL_HANDLE;
  };
  std::map<const Pipeline::Handles*, std::vector<KnownSet>> sets;
  std::vector<VkDescriptorPool> set_pools;
  std::uint32_t sets_made = 0;

  explicit State(Device& d) : device(d) {}
  ~State() {
    if (submitted > 0) wait_for_timeline();  // a destructor cannot report a failure
    for (VkQueryPool query_pool : query_pools) vkDestroyQueryPool(device.handle, query_pool, nullptr);
    for (VkDescriptorPool set_pool : set_pools) vkDestroyDescriptorPool(device.handle, set_pool, nullptr);
    vkDestroyCommandPool(device.handle, pool, nullptr);
  }

  VkResult wait_for_timeline() const {
    auto info = of_type<VkSemaphoreWaitInfo>(VK_STRUCTURE_TYPE_SEMAPHORE_WAIT_INFO);
    info.semaphoreCount = 1;
    info.pSemaphores = &device.timeline;
    info.pValues = &submitted;
    return vkWaitSemaphores(device.handle, &info, UINT64_MAX);
  }

  void before_command() {
    CHAINSPLAT_CHECK(recording, "begin() was not called");
    if (barrier) {
      memory_barrier(commands, kWorkStages | VK_PIPELINE_STAGE_2_DRAW_INDIRECT_BIT, kWorkWrites,
                     kWorkStages | VK_PIPELINE_STAGE_2_DRAW_INDIRECT_BIT, kWorkReads | kWorkWrites);
    }
    barrier = true;
  }

  void write_timestamp() {
    if (device.timestamp_mask == 0) return;
    const auto at = static_cast<std::uint32_t>(labels.size());
    if (at / kQueriesAPool >= query_pools.size()) {
      auto create = of_type<VkQueryPoolCreateInfo>(VK_STRUCTURE_TYPE_QUERY_POOL_CREATE_INFO);
      create.queryType = VK_QUERY_TYPE_TIMESTAMP;
      create.queryCount = kQueriesAPool;
      VkQueryPool made = VK_NULL_HANDLE;
      device.check(vkCreateQueryPool(device.handle, &create, nullptr, &made), "make a query pool");
      query_pools.push_back(made);
    }
    vkCmdWriteTimestamp2(commands, VK_PIPELINE_STAGE_2_ALL_COMMANDS_BIT, query_pools[at / kQueriesAPool],
                         at % kQueriesAPool);
  }

  void read_timings() {
    timings.clear();
    timings_due = false;
    if (device.timestamp_mask == 0 || labels.empty()) return;
    std::vector<std::uint64_t> ticks(labels.size() + 1);
    for (std::size_t p = 0; p * kQueriesAPool < ticks.size(); ++p) {
      const std::size_t first = p * kQueriesAPool, count = std::min<std::size_t>(kQueriesAPool, ticks.size() - first);
      device.check(vkGetQueryPoolResults(device.handle, query_pools[p], 0, static_cast<std::uint32_t>(count),
                                         count * sizeof(std::uint64_t), &ticks[first], sizeof(std::uint64_t),
                                         VK_QUERY_RESULT_64_BIT | VK_QUERY_RESULT_WAIT_BIT),
                   "read timestamps");
    }
    constexpr double kMillisecondsANanosecond = 1e-6;
    for (std::size_t i = 0; i < labels.size(); ++i) {
      const std::uint64_t passed = (ticks[i + 1] - ticks[i]) & device.timestamp_mask;  // right also when it wraps
      const double milliseconds = static_cast<double>(passed) * device.timestamp_period * kMillisecondsANanosecond;
      auto same = std::find_if(timings.begin(), timings.end(), [&](const Timing& t) { return t.label == labels[i]; });
      if (same == timings.end()) same = timings.insert(same, {labels[i], 0.0});
      same->milliseconds += milliseconds;
    }
  }

  VkDescriptorSet allocate_set(VkDescriptorSetLayout layout) {
    const std::uint32_t at = sets_made++;
    if (at / kSetsAPool >= set_pools.size()) {
      const VkDescriptorPoolSize size{VK_DESCRIPTOR_TYPE_STORAGE_BUFFER, kSetsAPool * kLeastStorageBuffers};
      auto create = of_type<VkDescriptorPoolCreateInfo>(VK_STRUCTURE_TYPE_DESCRIPTOR_POOL_CREATE_INFO);
      create.maxSets = kSetsAPool;
      create.poolSizeCount = 1;
      create.pPoolSizes = &size;
      VkDescriptorPool made = VK_NULL_HANDLE;
      device.check(vkCreateDescriptorPool(device.handle, &create, nullptr, &made), "make a descriptor pool");
      set_pools.push_back(made);
    }
    auto allocate = of_type<VkDescriptorSetAllocateInfo>(VK_STRUCTURE_TYPE_DESCRIPTOR_SET_ALLOCATE_INFO);
    allocate.descriptorPool = set_pools[at / kSetsAPool];
    allocate.descriptorSetCount = 1;
    allocate.pSetLayouts = &layout;
    VkDescriptorSet set = VK_NULL_HANDLE;
    device.check(vkAllocateDescriptorSets(device.handle, &allocate, &set), "make a descriptor set");
    return set;
  }

  // A set that binds the buffers that the pipeline's names stand for now: one that was made before, or a new one.
  VkDescriptorSet set_for(const Pipeline& pipeline) {
    const Pipeline::Handles& h = pipeline.handles();
    const auto count = static_cast<std::uint32_t>(h.bindings.size());
    std::array<std::uint64_t, kLeastStorageBuffers> numbers{};
    for (std::uint32_t i = 0; i < count; ++i) {
      const Buffer* const buffer = pipeline.buffer(i);
      CHAINSPLAT_CHECK(buffer && buffer->made(), "buffer '" + h.bindings[i].buffer + "' of shader '" + h.name + "'");
      numbers[i] = buffer->handles().number;
    }
    std::vector<KnownSet>& known = sets[&h];
    for (const KnownSet& one : known)
      if (one.buffers == numbers) return one.set;

    const VkDescriptorSet set = allocate_set(h.set_layout);
    std::array<VkDescriptorBufferInfo, kLeastStorageBuffers> infos{};
    std::array<VkWriteDescriptorSet, kLeastStorageBuffers> writes{};
    for (std::uint32_t i = 0; i < count; ++i) {
      infos[i] = {pipeline.buffer(i)->handles().buffer, 0, VK_WHOLE_SIZE};
      writes[i] = of_type<VkWriteDescriptorSet>(VK_STRUCTURE_TYPE_WRITE_DESCRIPTOR_SET);
      writes[i].dstSet = set;
      writes[i].dstBinding = h.bindings[i].number;
      writes[i].descriptorCount = 1;
      writes[i].descriptorType = VK_DESCRIPTOR_TYPE_STORAGE_BUFFER;
      writes[i].pBufferInfo = &infos[i];
    }
    vkUpdateDescriptorSets(device.handle, count, writes.data(), 0, nullptr);
    known.push_back({numbers, set});
    return set;
  }

  void bind(const Pipeline& pipeline, const void* push, std::size_t push_bytes) {
    const Pipeline::Handles& h = pipeline.handles();
    CHAINSPLAT_CHECK(push_bytes == h.push_bytes, h.name + " takes " + std::to_string(h.push_bytes) +
                                                     " bytes of push constants, got " + std::to_string(push_bytes));
    vkCmdBindPipeline(commands, VK_PIPELINE_BIND_POINT_COMPUTE, h.pipeline);
    if (!h.bindings.empty()) {
      const VkDescriptorSet set = set_for(pipeline);
      vkCmdBindDescriptorSets(commands, VK_PIPELINE_BIND_POINT_COMPUTE, h.layout, 0, 1, &set, 0, nullptr);
    }
    if (push_bytes > 0) vkCmdPushConstants(commands, h.layout, VK_SHADER_STAGE_COMPUTE_BIT, 0, h.push_bytes, push);
  }
};

Commands::Commands(Device& device) : state_(std::make_unique<State>(device)) {
  auto pool = of_type<VkCommandPoolCreateInfo>(VK_STRUCTURE_TYPE_COMMAND_POOL_CREATE_INFO);
  pool.queueFamilyIndex = device.queue_family;
  device.check(vkCreateCommandPool(device.handle, &pool, nullptr, &state_->pool), "make a command pool");
  auto allocate = of_type<VkCommandBufferAllocateInfo>(VK_STRUCTURE_TYPE_COMMAND_BUFFER_ALLOCATE_INFO);
  allocate.commandPool = state_->pool;
  allocate.level = VK_COMMAND_BUFFER_LEVEL_PRIMARY;
  allocate.commandBufferCount = 1;
  device.check(vkAllocateCommandBuffers(device.handle, &allocate, &state_->commands), "make a command buffer");
}

Commands::Commands(Commands&&) noexcept = default;
Commands& Commands::operator=(Commands&&) noexcept = default;
Commands::~Commands() = default;

void Commands::begin() {
  State& s = *state_;
  wait();
  s.device.check(vkResetCommandPool(s.device.handle, s.pool, 0), "reset commands");
  if (s.sets_made > kMostSets) {
    for (VkDescriptorPool set_pool : s.set_pools) vkResetDescriptorPool(s.device.handle, set_pool, 0);
    s.sets.clear();
    s.sets_made = 0;
  }
  s.labels.clear();
  const VkCommandBufferBeginInfo info{VK_STRUCTURE_TYPE_COMMAND_BUFFER_BEGIN_INFO, nullptr, 0, nullptr};
  s.device.check(vkBeginCommandBuffer(s.commands, &info), "record commands");
  s.recording = true;
  s.recorded = false;
  s.barrier = true;
  s.write_timestamp();
}

void Commands::dispatch(const Pipeline& pipeline, const void* push, std::size_t push_bytes, std::uint32_t x,
                        std::uint32_t y, std::uint32_t z) {
  CHAINSPLAT_CHECK(x <= kMostGroups && y <= kMostGroups && z <= kMostGroups,
                   pipeline.handles().name + ": " + std::to_string(x) + " x " + std::to_string(y) + " x " +
                       std::to_string(z) + " groups; at most 65535 an axis, spread them over y");
  state_->before_command();  // also without groups: the next command may skip its own barrier and rely on this one
  if (x == 0 || y == 0 || z == 0) return;
  state_->bind(pipeline, push, push_bytes);
  vkCmdDispatch(state_->commands, x, y, z);
}

void Commands::dispatch_indirect(const Pipeline& pipeline, const void* push, std::size_t push_bytes,
                                 const Buffer& arguments, std::size_t offset) {
  CHAINSPLAT_CHECK(
      offset % 4 == 0 && offset + sizeof(VkDispatchIndirectCommand) <= arguments.bytes(),
      pipeline.handles().name + ": " + std::to_string(offset) + " of " + std::to_string(arguments.bytes()));
  state_->before_command();
  state_->bind(pipeline, push, push_bytes);
  vkCmdDispatchIndirect(state_->commands, arguments.handles().buffer, offset);
}

void Commands::fill(const Buffer& buffer, std::uint32_t value, std::size_t offset, std::size_t bytes) {
  CHAINSPLAT_CHECK(offset % 4 == 0 && bytes % 4 == 0 && offset + bytes <= buffer.bytes(),
                   std::to_string(offset) + " + " + std::to_string(bytes) + " of " + std::to_string(buffer.bytes()));
  state_->before_command();
  if (bytes > 0) vkCmdFillBuffer(state_->commands, buffer.handles().buffer, offset, bytes, value);
}

void Commands::copy(const Buffer& from, std::size_t from_offset, const Buffer& to, std::size_t to_offset,
                    std::size_t bytes) {
  CHAINSPLAT_CHECK(from_offset + bytes <= from.bytes() && to_offset + bytes <= to.bytes(),
                   std::to_string(bytes) + " from " + std::to_string(from_offset) + " of " +
                       std::to_string(from.bytes()) + " to " + std::to_string(to_offset) + " of " +
                       std::to_string(to.bytes()));
  state_->before_command();
  if (bytes == 0) return;
  const VkBufferCopy region{from_offset, to_offset, bytes};
  vkCmdCopyBuffer(state_->commands, from.handles().buffer, to.handles().buffer, 1, &region);
}

void Commands::no_barrier() { state_->barrier = false; }

void Commands::stamp(const char* label) {
  State& s = *state_;
  CHAINSPLAT_CHECK(s.recording, "begin() was not called");
  s.labels.emplace_back(label);
  s.write_timestamp();
}

void Commands::submit() {
  State& s = *state_;
  CHAINSPLAT_CHECK(s.recording || s.recorded, "nothing was recorded");
  wait();
  if (s.recording) {
    // make the list's writes visible to the host after wait()
    memory_barrier(s.commands, kWorkStages, kWorkWrites, VK_PIPELINE_STAGE_2_HOST_BIT,
                   VK_ACCESS_2_HOST_READ_BIT | VK_ACCESS_2_HOST_WRITE_BIT);
    s.device.check(vkEndCommandBuffer(s.commands), "record commands");
    s.recording = false;
    s.recorded = true;
  }
  for (VkQueryPool query_pool : s.query_pools) vkResetQueryPool(s.device.handle, query_pool, 0, kQueriesAPool);

  // submit under the queue's lock, so that timeline values rise in queue order
  auto commands = of_type<VkCommandBufferSubmitInfo>(VK_STRUCTURE_TYPE_COMMAND_BUFFER_SUBMIT_INFO);
  commands.commandBuffer = s.commands;
  auto signal = of_type<VkSemaphoreSubmitInfo>(VK_STRUCTURE_TYPE_SEMAPHORE_SUBMIT_INFO);
  signal.semaphore = s.device.timeline;
  signal.stageMask = VK_PIPELINE_STAGE_2_ALL_COMMANDS_BIT;
  auto info = of_type<VkSubmitInfo2>(VK_STRUCTURE_TYPE_SUBMIT_INFO_2);
  info.commandBufferInfoCount = 1;
  info.pCommandBufferInfos = &commands;
  info.signalSemaphoreInfoCount = 1;
  info.pSignalSemaphoreInfos = &signal;
  std::lock_guard lock(s.device.queue_mutex);
  if (s.device.most_submits > 0 && s.device.submitted >= s.device.most_submits)
    s.device.check(VK_ERROR_DEVICE_LOST, "start work");
  signal.value = s.device.submitted + 1;
  s.device.check(vkQueueSubmit2(s.device.queue, 1, &info, VK_NULL_HANDLE), "start work");
  s.submitted = ++s.device.submitted;
  s.timings_due = true;
}

void Commands::wait() {
  State& s = *state_;
  if (s.submitted == 0) return;
  s.device.check(s.wait_for_timeline(), "finish work");
  s.submitted = 0;
  if (s.timings_due) s.read_timings();
}

std::vector<Timing> Commands::timings() const { return state_->timings; }

}  // namespace chainsplat::gpu
