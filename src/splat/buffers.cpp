// buffers.cpp - device memory of the engine, and the transfers to and from it.
#include <algorithm>
#include <cstring>

#include "src/splat/engine.h"

namespace chainsplat::splat {

void Engine::State::need(Buffer& buffer, std::size_t bytes, const char* name) {
  constexpr std::size_t kLeast = 256, kRow = sizeof(glm::vec4);  // kernels may access the last row as a whole
  bytes = std::max((bytes + kRow - 1) / kRow * kRow, kLeast);
  if (buffer.bytes() < bytes) {
    buffer = Buffer();  // frees the old memory before the new is allocated
    buffer = Buffer(device, bytes, Domain::device, name);
  }
}

void Engine::State::release_view_buffers() {
  commands.wait();
#define ADDRESS(buffer) &(buffer),
  for (Buffer* buffer : {VIEW_BUFFERS(ADDRESS)}) *buffer = Buffer();
  instance_capacity = 0;
}

void Engine::State::write(Buffer& buffer, std::span<const std::byte> data, const char* name) {
  need(buffer, data.size(), name);
  gpu::upload(device, buffer, data.data(), data.size());
}

void Engine::State::stage(Buffer& buffer, std::span<const std::byte> data, const char* name) {
  need(buffer, data.size(), name);
  if (buffer.mapped()) return gpu::upload(device, buffer, data.data(), data.size());
  const auto same = std::find_if(uploads.begin(), uploads.end(), [&](const Upload& u) { return u.to == &buffer; });
  Upload& upload = same != uploads.end() ? *same : uploads.emplace_back();
  upload.to = &buffer;
  upload.data.assign(data.begin(), data.end());
}

void Engine::State::record_uploads() {
  std::size_t total = 0;
  for (const Upload& upload : uploads) total += upload.data.size();
  if (to_device.bytes() < total) {
    to_device = Buffer();
    to_device = Buffer(device, static_cast<std::size_t>(kGrowth * total), Domain::host, "to device");
  }
  std::size_t at = 0;
  for (const Upload& upload : uploads) {
    if (upload.data.empty()) continue;
    std::memcpy(static_cast<std::byte*>(to_device.mapped()) + at, upload.data.data(), upload.data.size());
    commands.copy(to_device, at, *upload.to, 0, upload.data.size());
    commands.no_barrier();
    at += upload.data.size();
  }
  uploads.clear();
}

void Engine::State::fill(Buffer& buffer, std::uint32_t value, std::size_t first, std::size_t count) {
  if (buffer.mapped()) {
    std::fill_n(buffer.as<std::uint32_t>().begin() + static_cast<std::ptrdiff_t>(first), count, value);
  } else {
    commands.no_barrier();
    commands.fill(buffer, value, first * sizeof value, count * sizeof value);
  }
}

const std::byte* Engine::State::record_download(const Buffer& buffer, std::size_t bytes) {
  if (buffer.mapped()) return static_cast<const std::byte*>(buffer.mapped());
  const std::size_t at = to_host_bytes;
  commands.copy(buffer, 0, to_host, at, bytes);
  to_host_bytes += bytes;
  return static_cast<const std::byte*>(to_host.mapped()) + at;
}

std::size_t Engine::State::most_placed_tiles(const RunOptions& options) const {
  // measured on lavapipe; on GPUs only for the few pictures of color_sums()
  if (!lists_may_have_places || (!options.chain && !gpu::info(device).software)) return 0;
  if (!options.backward) return kListEntries / tile_capacity;
  if (splat_capacity > kMostSplatCapacity) return 0;
  const std::size_t most_entries = range_limit / (sizeof(float) * shared::kPartial * slots);
  return std::min<std::size_t>(kListEntries, most_entries) / tile_capacity;
}

void Engine::State::set_tile_capacity(std::uint32_t capacity) {
  tile_capacity = capacity;
  std::vector<std::uint32_t> starts(kListEntries / capacity + 1);
  for (std::size_t tile = 0; tile < starts.size(); ++tile) starts[tile] = static_cast<std::uint32_t>(tile * capacity);
  const std::vector<std::uint32_t> blocks(starts.size() / shared::kScanBlock + 1, 0);
  write(list_starts, bytes_of(starts), "list starts");
  write(list_blocks, bytes_of(blocks), "list blocks");
}

}  // namespace chainsplat::splat
