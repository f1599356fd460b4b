#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <cstring>
#include <numeric>
#include <utility>

#include "chainsplat/splat.h"
#include "shaders/shared/adam.h"
#include "shaders/shared/color.h"
#include "shaders/shared/splat.h"

namespace chainsplat::splat {

namespace {

using gpu::Buffer;
using gpu::Domain;
using shared::AdamPush;
using shared::ColorPush;
using shared::ColorView;
using shared::SplatPush;
using shared::SplatTile;
using shared::SplatView;

constexpr double kClampMargin = 1.3;               // of the half image, for the projection's Jacobian (SPEC 2.5)
constexpr int kActiveMargin = 16;                  // px around the mask that training draws and charges
constexpr int kDssimMargin = 10;                   // px around the mask that get the D-SSIM term: SSIM's reach twice
constexpr std::uint32_t kMostTiles = 60000;        // of one submission: below every device's group count limit (65535)
constexpr std::uint32_t kRankLimit = 192;          // longest tile list sorted by rank; longer ones by radix
constexpr std::uint32_t kSoftwareRankLimit = 512;  // the same on a software device, whose barriers make radix dear
constexpr std::uint32_t kTilesAPixelSlice = 4, kMostPixelSlices = 256;  // of color_pixels: enough groups for a GPU,
constexpr std::uint32_t kTilesAnEquationSlice = 16, kMostEquationSlices = 64;  // few sums to read back
constexpr std::uint32_t kListEntries = 1 << 20, kTileCapacity = 512;  // of all tiles' lists with places of their own
constexpr double kGrowth = 1.25;                                      // spare room when a capacity is raised
constexpr float kBeta1 = 0.9f, kBeta2 = 0.999f, kEpsilon = 1e-15f;    // Adam, as in 3DGS

struct SceneView {
  double fx = 0, fy = 0, cx = 0, cy = 0;  // px, of the crop
  double limit_x = 0, limit_y = 0;
  int width = 0, height = 0, tiles_x = 0, tiles_y = 0;
  math::Pose camera_from_world;
  std::vector<math::Pose> motions;
  std::size_t target = 0;             // first pixel in the target buffer
  std::vector<std::uint32_t> active;  // grid cells that are drawn and charged
  std::size_t near = 0;               // the first `near` of them get the D-SSIM term too
};

// Parameters and views that belong together: the training's, or those of one call.
struct Scene {
  int count = 0, links = 0, degree = 0;
  Buffer parameters, gradient, first_moment, second_moment, target;
  std::vector<SceneView> views;
  std::size_t parameter_count = 0;
  std::size_t target_pixels = 0;
  double normalizer = 1.0;
  int step = 0;
  std::uint64_t version = 0;  // of the parameters, of all scenes of an engine
  int coefficients() const { return (degree + 1) * (degree + 1); }
};

// Which tiles of a view are drawn and charged.
enum class Active { in_mask, near_mask, everywhere, everywhere_dssim_near_mask };

struct RunOptions {
  LossWeights weights;
  double color_scale = 0.0;  // what |I^ - I| sums are divided by
  double mask_scale = 0.0;
  bool loss = false, sums = false;  // targets are known; the tiles' sums are asked for
  bool backward = false, twists = false, depth = false, accumulate = false;
  bool held_links = false;              // no gradient by link logits
  const chain::Chain* chain = nullptr;  // not null: the normal equations of the colors, by its links; needs `depth`
};

struct ViewSums {
  double l1 = 0, mask = 0, squared = 0, object = 0, dssim = 0;
};

std::vector<float> packed(const Gaussians& g) {
  std::vector<float> all;
  all.reserve(g.mean.size() + g.rotation.size() + g.log_scale.size() + g.opacity_logit.size() + g.sh.size() +
              g.link_logits.size());
  for (const auto* part : {&g.mean, &g.rotation, &g.log_scale, &g.opacity_logit, &g.sh, &g.link_logits})
    all.insert(all.end(), part->begin(), part->end());
  return all;
}

Gaussians unpacked(const std::vector<float>& all, int count, int links, int degree) {
  Gaussians g;
  g.resize(count, links, degree);
  auto from = all.begin();
  for (auto* part : {&g.mean, &g.rotation, &g.log_scale, &g.opacity_logit, &g.sh, &g.link_logits}) {
    std::copy_n(from, part->size(), part->begin());
    from += static_cast<std::ptrdiff_t>(part->size());
  }
  return g;
}

// For every grid cell whether a mask pixel is within each of two margins (px) of it; `inner` <= `outer`.
struct Nearness {
  std::vector<bool> inner, outer;
};

Nearness near_mask(const SceneView& view, const std::vector<std::uint8_t>& rgba, int tile_width, int tile_height,
                   int inner, int outer) {
  std::vector<std::uint32_t> sum(static_cast<std::size_t>(view.width + 1) * (view.height + 1), 0);
  const auto at = [&](int x, int y) -> std::uint32_t& {
    return sum[static_cast<std::size_t>(y) * (view.width + 1) + x];
  };
  for (int y = 0; y < view.height; ++y) {
    for (int x = 0; x < view.width; ++x) {
      const std::uint32_t object = rgba[4 * (static_cast<std::size_t>(y) * view.width + x) + 3] > 0 ? 1 : 0;
      at(x + 1, y + 1) = object + at(x, y + 1) + at(x + 1, y) - at(x, y);
    }
  }
  const auto within = [&](int tx, int ty, int margin) {
    const int x0 = std::max(0, tx * tile_width - margin), y0 = std::max(0, ty * tile_height - margin);
    const int x1 = std::min(view.width, (tx + 1) * tile_width + margin);
    const int y1 = std::min(view.height, (ty + 1) * tile_height + margin);
    return at(x1, y1) - at(x0, y1) - at(x1, y0) + at(x0, y0) > 0;
  };
  Nearness out;
  for (int ty = 0; ty < view.tiles_y; ++ty) {
    for (int tx = 0; tx < view.tiles_x; ++tx) {
      out.inner.push_back(within(tx, ty, inner));
      out.outer.push_back(within(tx, ty, outer));
    }
  }
  return out;
}

// For every grid cell whether it has a mask pixel.
std::vector<bool> in_mask(const SceneView& view, const std::vector<std::uint8_t>& rgba, int tile_width,
                          int tile_height) {
  std::vector<bool> out(static_cast<std::size_t>(view.tiles_x) * view.tiles_y, false);
  std::vector<std::uint8_t> any(static_cast<std::size_t>(view.tiles_x) * tile_width);
  for (int ty = 0; ty < view.tiles_y; ++ty) {
    std::fill(any.begin(), any.end(), 0);
    const int end = std::min(view.height, (ty + 1) * tile_height);
    for (int y = ty * tile_height; y < end; ++y) {
      const std::uint8_t* const row = &rgba[4 * static_cast<std::size_t>(y) * view.width];
      for (int x = 0; x < view.width; ++x) any[x] |= row[4 * x + 3];
    }
    for (int tx = 0; tx < view.tiles_x; ++tx)
      out[static_cast<std::size_t>(ty) * view.tiles_x + tx] =
          std::any_of(&any[tx * tile_width], &any[tx * tile_width] + tile_width, [](std::uint8_t a) { return a > 0; });
  }
  return out;
}

// lavapipe gives every thread one stretch of a pass' groups. Neighbors in the list of tiles have alike work, those far
// apart do not: so that every stretch has some of all, a pass goes through the list in steps of about its golden
// section.
std::uint32_t spreading_stride(std::uint32_t count) {
  constexpr double kGoldenSection = 0.6180339887;
  auto stride = static_cast<std::uint32_t>(kGoldenSection * count);
  while (stride > 1 && std::gcd(stride, count) > 1) --stride;
  return std::max(1u, stride);
}

}  // namespace

struct Engine::State {
  gpu::Device& device;
  std::uint32_t tile_width, tile_height, pixels_per_lane, slots;
  std::uint32_t color_lanes;  // of the passes over colors: a subgroup
  bool cutoffs;
  double clamp_margin;      // of the half image
  std::size_t range_limit;  // bytes of one storage buffer

  gpu::Pipeline replicate, compact, scan_block, scan_sums, project, bin, sort, sort_long, blend, blend_depth,
      blend_backward, project_backward, gather, link_twist, adam, loss_pixel, ssim_rows, ssim_columns,
      ssim_rows_backward, ssim_columns_backward, color_pixels, color_equations;
  gpu::Commands commands;

  // Small transfers are a part of the submission that they belong to. Where the device's memory is not mapped, they go
  // through these.
  Buffer to_device, to_host;
  struct Upload {
    Buffer* to = nullptr;
    std::vector<std::byte> data;
  };
  std::vector<Upload> uploads;  // for the next submission
  std::size_t to_host_bytes = 0;

  // work buffers, grown as needed
  Buffer replica_opacity, live_flag, live_prefix, live_block, live, replica_gradient, counters;
  Buffer views, motions, tile_map, tiles;
  Buffer splats, instance_count, tile_hits, instance_prefix, instance_block, records, link_twists;
  Buffer tile_count, tile_prefix, tile_block, tile_cursor, tile_used, tile_loss;
  Buffer entries, long_tiles, sort_scratch, sorted, partials;
  Buffer image, depth_image, pixel_gradient, ssim_row_sums, ssim_factors;
  Buffer color_views, segments, tile_pixels, tile_summary, pixel_sums, link_sums;
  ColorPush color_push{};
  std::size_t pixel_sum_bytes = 0, link_sum_bytes = 0;
  const std::byte *read_pixel_sums = nullptr, *read_link_sums = nullptr;  // of the last run
  Buffer list_starts,
      list_blocks;  // stand for tile_prefix and tile_block where every tile's list has a place of its own
  std::uint32_t live_capacity = 0, instance_capacity = 0, tile_capacity = 0;
  std::uint64_t versions = 0;                            // of parameters so far, of all scenes
  std::pair<std::uint64_t, std::uint32_t> replicated{};  // version and live capacity that the live replicas are of
  int not_finite = 0;                                    // gradients of the last run that Adam left alone
  int most_views = 1 << 20;  // of one submission, lowered when a buffer would pass the device's limit
  std::vector<gpu::Timing> timings;

  Scene training, scratch;

  // of the last run, for reading back
  std::vector<std::uint32_t> chunk_tile_view;
  std::vector<std::size_t> chunk_pixel;

  State(gpu::Device& d, const Settings& settings);
  void need(Buffer& buffer, std::size_t bytes, const char* name);
  void release_view_buffers();
  void write(Buffer& buffer, const void* data, std::size_t bytes, const char* name);
  void stage(Buffer& buffer, const void* data, std::size_t bytes, const char* name);
  void record_uploads();
  const std::byte* record_download(const Buffer& buffer, std::size_t bytes);
  void load_gaussians(Scene& scene, const Gaussians& gaussians);
  void load_views(Scene& scene, std::span<const ViewSpec> specs,
                  std::span<const std::vector<std::uint8_t>* const> targets, Active active);
  std::vector<std::vector<int>> chunks(const Scene& scene, std::span<const int> batch, bool dssim) const;
  bool run(Scene& scene, std::span<const int> chunk, const RunOptions& options, const AdamPush* adam_push);
  template <class AfterChunk>
  void run_all(Scene& scene, std::span<const int> batch, const RunOptions& options, const AdamPush* adam_push,
               AfterChunk after);
  void scan(const Buffer& values, const Buffer& prefix, const Buffer& block, SplatPush push, std::size_t most);
  void set_tile_capacity(std::uint32_t capacity);
  std::vector<ViewSums> sums(std::size_t chunk_views);
  std::vector<Picture> pictures(const Scene& scene, std::span<const int> chunk, bool depth);
  std::vector<math::MatrixX> twists(const Scene& scene, std::span<const int> chunk);
  std::vector<ColorSums> colors(const Scene& scene, std::span<const int> chunk, const chain::Chain& chain);
};

Engine::State::State(gpu::Device& d, const Settings& settings) : device(d), commands(d) {
  const gpu::DeviceInfo& device_info = gpu::info(d);
  // lavapipe: one subgroup of 8 lanes a tile, a column of 8 pixels each (loads are what costs there: DESIGN, 'The size
  // of the work'); a GPU: one subgroup of 32 a tile, 2 pixels each
  const int tile = settings.tile > 0 ? settings.tile : 8;
  const int pixels = settings.pixels_per_lane > 0 ? settings.pixels_per_lane : device_info.software ? 8 : 2;
  CHAINSPLAT_CHECK(tile % pixels == 0, std::to_string(tile) + " " + std::to_string(pixels));
  tile_width = tile_height = static_cast<std::uint32_t>(tile);
  pixels_per_lane = static_cast<std::uint32_t>(pixels);
  const std::uint32_t lanes = tile_width * tile_height / pixels_per_lane;
  slots = std::max(1u, lanes / std::max(1u, device_info.subgroup_size));
  cutoffs = settings.exact_cutoffs;
  constexpr double kNoClamp = 1e6;
  clamp_margin = settings.projection_clamp ? kClampMargin : kNoClamp;
  range_limit = static_cast<std::size_t>(std::min<std::uint64_t>(device_info.max_storage_range, 1ull << 30));
  const std::uint32_t cut = cutoffs ? 1 : 0;
  const std::size_t push = sizeof(SplatPush);
  replicate = gpu::Pipeline(d, "splat_replicate", 3, push, {cut});
  compact = gpu::Pipeline(d, "splat_compact", 4, push, {});
  scan_block = gpu::Pipeline(d, "scan_block", 4, push, {});
  scan_sums = gpu::Pipeline(d, "scan_sums", 2, push, {});
  project = gpu::Pipeline(d, "splat_project", 12, push, {cut, tile_width, tile_height});
  bin = gpu::Pipeline(d, "splat_bin", 12, push, {});
  // as many lanes a tile as a subgroup of the device: no lane waits at the barriers for another subgroup
  const std::uint32_t tile_lanes = device_info.software ? 8 : 32;
  sort = gpu::Pipeline(d, "splat_sort", 7, push,
                       {tile_lanes, device_info.software ? kSoftwareRankLimit : kRankLimit,
                        std::min(tile_lanes, std::max(1u, device_info.subgroup_size))});
  sort_long = gpu::Pipeline(d, "splat_sort_long", 7, push, {tile_lanes});
  const std::uint32_t subgroup = std::min(lanes, std::max(1u, device_info.subgroup_size));
  // a software device loads lane by lane, so that its lanes share the work; a GPU loads at once what all lanes want
  const std::uint32_t share = device_info.software ? subgroup : 1;
  blend = gpu::Pipeline(d, "splat_blend", 11, push, {lanes, tile_width, tile_height, pixels_per_lane, cut, 0, share});
  blend_depth =
      gpu::Pipeline(d, "splat_blend", 11, push, {lanes, tile_width, tile_height, pixels_per_lane, cut, 1, share});
  blend_backward = gpu::Pipeline(d, "splat_blend_backward", 13, push,
                                 {lanes, tile_width, tile_height, pixels_per_lane, cut, subgroup, share});
  project_backward = gpu::Pipeline(d, "splat_project_backward", 11, push, {});
  gather = gpu::Pipeline(d, "splat_gather", 11, push, {});
  link_twist = gpu::Pipeline(d, "splat_link_twist", 5, push, {});
  adam = gpu::Pipeline(d, "splat_adam", 5, sizeof(AdamPush), {});
  const std::vector<std::uint32_t> tile_constants{tile_lanes, tile_width, tile_height};
  loss_pixel = gpu::Pipeline(d, "loss_pixel", 5, push, tile_constants);
  const std::vector<std::uint32_t> strip_constants{lanes, tile_width, tile_height, pixels_per_lane};
  ssim_rows = gpu::Pipeline(d, "ssim_rows", 6, push, strip_constants);
  ssim_columns = gpu::Pipeline(d, "ssim_columns", 6, push, strip_constants);
  ssim_rows_backward = gpu::Pipeline(d, "ssim_rows_backward", 5, push, strip_constants);
  ssim_columns_backward = gpu::Pipeline(d, "ssim_columns_backward", 7, push, strip_constants);
  const std::uint32_t tile_area = tile_width * tile_height;
  color_lanes = std::min(std::max(1u, device_info.subgroup_size), tile_area);
  const std::uint32_t columns = std::max(1u, tile_width / color_lanes);  // of a lane
  color_pixels =
      gpu::Pipeline(d, "color_pixels", 10, sizeof(ColorPush),
                    {color_lanes, tile_width, tile_height, color_lanes, columns, tile_area / (color_lanes * columns)});
  color_equations =
      gpu::Pipeline(d, "color_equations", 11, sizeof(ColorPush), {color_lanes, tile_width, tile_height, color_lanes});
  need(counters, shared::kCounters * sizeof(std::uint32_t), "counters");
}

void Engine::State::need(Buffer& buffer, std::size_t bytes, const char* name) {
  constexpr std::size_t kLeast = 256, kRow = sizeof(glm::vec4);  // kernels may take its last row as a whole
  bytes = std::max((bytes + kRow - 1) / kRow * kRow, kLeast);
  if (buffer.bytes() < bytes) {
    buffer = Buffer();  // the old one goes first
    buffer = Buffer(device, bytes, Domain::device, name);
  }
}

// All whose size follows the number of views in a submission; run() makes them again.
void Engine::State::release_view_buffers() {
  commands.wait();
  for (Buffer* buffer :
       {&views,           &motions,        &tile_map,      &tiles,        &splats,     &instance_count, &tile_hits,
        &instance_prefix, &instance_block, &records,       &link_twists,  &tile_count, &tile_prefix,    &tile_block,
        &tile_cursor,     &tile_used,      &tile_loss,     &entries,      &sorted,     &partials,       &image,
        &depth_image,     &pixel_gradient, &ssim_row_sums, &ssim_factors, &long_tiles, &sort_scratch,   &color_views,
        &segments,        &tile_pixels,    &tile_summary,  &pixel_sums,   &link_sums})
    *buffer = Buffer();
  instance_capacity = 0;
}

void Engine::State::write(Buffer& buffer, const void* data, std::size_t bytes, const char* name) {
  need(buffer, bytes, name);
  if (bytes == 0) return;
  if (buffer.mapped()) {
    std::memcpy(buffer.mapped(), data, bytes);
  } else {
    gpu::upload(device, buffer, data, bytes);
  }
}

// As write(), but in the next submission.
void Engine::State::stage(Buffer& buffer, const void* data, std::size_t bytes, const char* name) {
  need(buffer, bytes, name);
  if (buffer.mapped()) {
    if (bytes > 0) std::memcpy(buffer.mapped(), data, bytes);
    return;
  }
  const auto same = std::find_if(uploads.begin(), uploads.end(), [&](const Upload& u) { return u.to == &buffer; });
  Upload& upload = same != uploads.end() ? *same : uploads.emplace_back();
  const auto* const first = static_cast<const std::byte*>(data);
  upload.to = &buffer;
  upload.data.assign(first, first + bytes);
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

// Where `bytes` of a buffer can be read once the submission is done. Room in `to_host` has been made.
const std::byte* Engine::State::record_download(const Buffer& buffer, std::size_t bytes) {
  if (buffer.mapped()) return static_cast<const std::byte*>(buffer.mapped());
  const std::size_t at = to_host_bytes;
  commands.copy(buffer, 0, to_host, at, bytes);
  to_host_bytes += bytes;
  return static_cast<const std::byte*>(to_host.mapped()) + at;
}

void Engine::State::load_gaussians(Scene& scene, const Gaussians& gaussians) {
  scene.count = gaussians.count;
  scene.links = gaussians.links;
  scene.degree = gaussians.degree;
  const std::vector<float> all = packed(gaussians);
  scene.parameter_count = all.size();
  scene.step = 0;
  scene.version = ++versions;
  write(scene.parameters, all.data(), all.size() * sizeof(float), "parameters");
  need(scene.gradient, all.size() * sizeof(float), "gradient");
}

void Engine::State::load_views(Scene& scene, std::span<const ViewSpec> specs,
                               std::span<const std::vector<std::uint8_t>* const> targets, Active active) {
  scene.views.clear();
  scene.target_pixels = 0;
  double object_pixels = 0.0;
  std::vector<std::uint8_t> all_targets;
  for (std::size_t v = 0; v < specs.size(); ++v) {
    const ViewSpec& spec = specs[v];
    SceneView view;
    view.fx = spec.camera->fx;
    view.fy = spec.camera->fy;
    view.cx = spec.camera->cx - spec.x0;
    view.cy = spec.camera->cy - spec.y0;
    view.limit_x = clamp_margin * 0.5 * spec.camera->width / view.fx;
    view.limit_y = clamp_margin * 0.5 * spec.camera->height / view.fy;
    view.width = spec.width;
    view.height = spec.height;
    view.tiles_x = (spec.width + static_cast<int>(tile_width) - 1) / static_cast<int>(tile_width);
    view.tiles_y = (spec.height + static_cast<int>(tile_height) - 1) / static_cast<int>(tile_height);
    view.camera_from_world = spec.camera->world_from_camera.inverse();
    view.motions = spec.motions;
    if (!targets.empty()) {
      const std::vector<std::uint8_t>& target = *targets[v];
      CHAINSPLAT_CHECK(target.size() == 4u * spec.width * spec.height, std::to_string(target.size()));
      view.target = all_targets.size() / 4;
      all_targets.insert(all_targets.end(), target.begin(), target.end());
      if (active != Active::in_mask)
        for (std::size_t k = 3; k < target.size(); k += 4) object_pixels += target[k] >= 128 ? 1.0 : 0.0;
    }
    const auto cells = static_cast<std::size_t>(view.tiles_x) * view.tiles_y;
    Nearness near{std::vector<bool>(cells, true), std::vector<bool>(cells, true)};
    if (active == Active::in_mask) {
      near.inner = near.outer = in_mask(view, *targets[v], static_cast<int>(tile_width), static_cast<int>(tile_height));
    } else if (!targets.empty() && active != Active::everywhere) {
      near = near_mask(view, *targets[v], static_cast<int>(tile_width), static_cast<int>(tile_height), kDssimMargin,
                       kActiveMargin);
      if (active == Active::everywhere_dssim_near_mask) near.outer.assign(cells, true);
    }
    for (std::size_t cell = 0; cell < cells; ++cell)
      if (near.inner[cell]) view.active.push_back(static_cast<std::uint32_t>(cell));
    view.near = view.active.size();
    for (std::size_t cell = 0; cell < cells; ++cell)
      if (near.outer[cell] && !near.inner[cell]) view.active.push_back(static_cast<std::uint32_t>(cell));
    scene.views.push_back(std::move(view));
  }
  scene.target_pixels = all_targets.size() / 4;
  scene.normalizer = std::max(1.0, object_pixels / std::max<std::size_t>(1, specs.size()));
  if (active == Active::in_mask)
    stage(scene.target, all_targets.data(), all_targets.size(), "target");
  else
    write(scene.target, all_targets.data(), all_targets.size(), "target");
}

// Views that go into one submission: bounded by buffer ranges and group counts of the device, never by time.
std::vector<std::vector<int>> Engine::State::chunks(const Scene& scene, std::span<const int> batch, bool dssim) const {
  const std::size_t most_pixels = range_limit / sizeof(glm::vec4);
  // the row sums of D-SSIM are the largest of what lies tile by tile
  const std::size_t most_tiles =
      dssim ? std::min<std::size_t>(kMostTiles, range_limit / (12 * sizeof(float) * tile_width * tile_height))
            : kMostTiles;
  std::vector<std::vector<int>> out;
  std::size_t pixels = 0, tile_total = 0;
  for (const int v : batch) {
    const SceneView& view = scene.views[v];
    const std::size_t view_pixels = static_cast<std::size_t>(view.width) * view.height;
    if (view_pixels > most_pixels || view.active.size() > most_tiles)
      throw WorkError("splat",
                      "an image of " + std::to_string(view.width) + "x" + std::to_string(view.height) +
                          " pixels does not fit this device's buffers",
                      "use smaller images or another device");
    if (out.empty() || pixels + view_pixels > most_pixels || tile_total + view.active.size() > most_tiles ||
        static_cast<int>(out.back().size()) >= most_views) {
      out.emplace_back();
      pixels = tile_total = 0;
    }
    out.back().push_back(v);
    pixels += view_pixels;
    tile_total += view.active.size();
  }
  return out;
}

void Engine::State::scan(const Buffer& values, const Buffer& prefix, const Buffer& block, SplatPush push,
                         std::size_t most) {
  const auto groups = static_cast<std::uint32_t>((most + shared::kScanBlock - 1) / shared::kScanBlock);
  const std::array block_buffers{&values, &prefix, &block, static_cast<const Buffer*>(&counters)};
  commands.dispatch(scan_block, block_buffers, &push, sizeof push, groups);
  const std::array sum_buffers{&block, static_cast<const Buffer*>(&counters)};
  commands.dispatch(scan_sums, sum_buffers, &push, sizeof push, 1);
}

void Engine::State::set_tile_capacity(std::uint32_t capacity) {
  tile_capacity = capacity;
  std::vector<std::uint32_t> starts(kListEntries / capacity + 1);
  for (std::size_t tile = 0; tile < starts.size(); ++tile) starts[tile] = static_cast<std::uint32_t>(tile * capacity);
  const std::vector<std::uint32_t> blocks(starts.size() / shared::kScanBlock + 1, 0);
  write(list_starts, starts.data(), starts.size() * sizeof(std::uint32_t), "list starts");
  write(list_blocks, blocks.data(), blocks.size() * sizeof(std::uint32_t), "list blocks");
}

// Records and runs all passes for one chunk. False: a capacity was too small; it has been raised, run again.
bool Engine::State::run(Scene& scene, std::span<const int> chunk, const RunOptions& options,
                        const AdamPush* adam_push) {
  const auto count = static_cast<std::uint32_t>(scene.count), links = static_cast<std::uint32_t>(scene.links);
  const auto view_count = static_cast<std::uint32_t>(chunk.size());
  const std::size_t replicas = static_cast<std::size_t>(count) * links;

  // the chunk's views, tiles and poses
  std::vector<SplatView> gpu_views(view_count);
  std::vector<glm::vec4> rows(static_cast<std::size_t>(view_count) * links * 3);
  std::vector<std::uint32_t> map;
  std::vector<SplatTile> active;
  std::vector<ColorView> colored;
  std::vector<glm::vec4> axes;
  chunk_tile_view.clear();
  chunk_pixel.assign(view_count, 0);
  std::size_t pixels = 0;
  for (std::uint32_t v = 0; v < view_count; ++v) {
    const SceneView& view = scene.views[chunk[v]];
    CHAINSPLAT_CHECK(view.motions.size() == links || count == 0, std::to_string(view.motions.size()));
    SplatView& out = gpu_views[v];
    out.intrinsics = {view.fx, view.fy, view.cx, view.cy};
    out.limits = {view.limit_x, view.limit_y, 0, 0};
    const math::Vector3 base =
        view.motions.empty() ? math::Vector3::Zero() : view.camera_from_world * view.motions[0].translation;
    out.moment_point = {base.x(), base.y(), base.z(), 0};
    out.width = static_cast<std::uint32_t>(view.width);
    out.height = static_cast<std::uint32_t>(view.height);
    out.tiles_x = static_cast<std::uint32_t>(view.tiles_x);
    out.tiles_y = static_cast<std::uint32_t>(view.tiles_y);
    out.tile_map = static_cast<std::uint32_t>(map.size());
    out.pixel = static_cast<std::uint32_t>(pixels);
    out.target = static_cast<std::uint32_t>(view.target);
    out.motion = v * links;
    chunk_pixel[v] = pixels;
    pixels += static_cast<std::size_t>(view.width) * view.height;
    map.resize(map.size() + static_cast<std::size_t>(view.tiles_x) * view.tiles_y, shared::kNoTile);
    for (std::uint32_t j = 0; j < std::min<std::size_t>(links, view.motions.size()); ++j) {
      const math::Pose pose = view.camera_from_world * view.motions[j];
      for (int r = 0; r < 3; ++r)
        rows[3 * (out.motion + j) + r] = {pose.rotation(r, 0), pose.rotation(r, 1), pose.rotation(r, 2),
                                          pose.translation[r]};
    }
    if (!options.chain) continue;
    const chain::Chain& chain = *options.chain;
    const std::uint32_t first_tile = colored.empty() ? 0 : colored.back().first_tile + colored.back().tiles;
    colored.push_back({first_tile, static_cast<std::uint32_t>(view.active.size()), v * links, 0});
    for (std::uint32_t j = 0; j < links; ++j) {
      const math::Pose pose = view.camera_from_world * view.motions[j];
      const math::Vector3 start = pose * math::Vector3(chain.link_start(j) * chain.direction);
      const math::Vector3 along = pose.rotation * chain.direction;
      axes.emplace_back(start.x(), start.y(), start.z(), chain.link_end(j) - chain.link_start(j));
      axes.emplace_back(along.x(), along.y(), along.z(), 0.0);
    }
  }
  // tiles with a D-SSIM term first, so that its passes run over a prefix of the list
  std::uint32_t near_total = 0;
  for (const bool near : {true, false}) {
    for (std::uint32_t v = 0; v < view_count; ++v) {
      const SceneView& view = scene.views[chunk[v]];
      for (std::size_t k = near ? 0 : view.near; k < (near ? view.near : view.active.size()); ++k) {
        const std::uint32_t cell = view.active[k];
        map[gpu_views[v].tile_map + cell] = static_cast<std::uint32_t>(active.size());
        active.push_back({v, cell % gpu_views[v].tiles_x, cell / gpu_views[v].tiles_x, 0});
        chunk_tile_view.push_back(v);
      }
    }
    if (near) near_total = static_cast<std::uint32_t>(active.size());
  }
  const auto tile_total = static_cast<std::uint32_t>(active.size());
  stage(views, gpu_views.data(), gpu_views.size() * sizeof(SplatView), "views");
  stage(motions, rows.data(), rows.size() * sizeof(glm::vec4), "motions");
  stage(tile_map, map.data(), map.size() * sizeof(std::uint32_t), "tile map");
  stage(tiles, active.data(), active.size() * sizeof(SplatTile), "tiles");
  if (options.chain) {
    stage(color_views, colored.data(), colored.size() * sizeof(ColorView), "color views");
    stage(segments, axes.data(), axes.size() * sizeof(glm::vec4), "segments");
  }

  // room
  if (live_capacity == 0 || live_capacity > replicas)
    live_capacity =
        static_cast<std::uint32_t>(std::max<std::size_t>(1, std::min<std::size_t>(replicas, 2 * count + 256)));
  constexpr std::uint32_t kFirstInstances = 8;  // tiles a splat touches, first guess
  const std::size_t pairs = static_cast<std::size_t>(live_capacity) * view_count;
  const std::size_t pair_bytes = (options.backward ? shared::kGradientRows : shared::kSplatRows) * sizeof(glm::vec4);
  if (pairs * pair_bytes > range_limit && view_count > 1) {
    most_views = static_cast<int>(std::max<std::size_t>(1, range_limit / (pair_bytes * live_capacity)));
    return false;
  }
  if (instance_capacity == 0)
    instance_capacity = static_cast<std::uint32_t>(std::max<std::size_t>(1024, kFirstInstances * pairs / 2));
  // what drawing had grown can be more than gradients have room for; an overflow then takes fewer views
  if (options.backward)
    instance_capacity = static_cast<std::uint32_t>(
        std::min<std::size_t>(instance_capacity, range_limit / (sizeof(glm::vec4) * shared::kPartialRows * slots)));
  const auto words = [](std::size_t n) { return n * sizeof(std::uint32_t); };
  const auto vectors = [](std::size_t n) { return n * sizeof(glm::vec4); };
  const auto blocks = [](std::size_t n) { return n / shared::kScanBlock + 1; };
  need(replica_opacity, words(replicas), "replica opacity");
  need(live_flag, words(replicas), "live flag");
  need(live_prefix, words(replicas), "live prefix");
  need(live_block, words(blocks(replicas)), "live block");
  need(live, words(live_capacity), "live");
  need(splats, vectors(shared::kSplatRows * pairs), "splats");
  need(instance_count, words(pairs), "instance count");
  need(tile_hits, words(pairs), "tile hits");
  need(instance_prefix, words(pairs), "instance prefix");
  need(instance_block, words(blocks(pairs)), "instance block");
  need(tile_count, words(tile_total), "tile count");
  need(tile_prefix, words(tile_total), "tile prefix");
  need(tile_block, words(blocks(tile_total)), "tile block");
  need(tile_cursor, words(tile_total), "tile cursor");
  need(tile_used, words(tile_total), "tile used");
  need(tile_loss, 2 * vectors(tile_total), "tile loss");
  // a list at a place of its own needs no instances, which only gradients are summed by
  if (options.chain && tile_capacity == 0) set_tile_capacity(kTileCapacity);
  const bool own_places = options.chain && static_cast<std::size_t>(tile_total) * tile_capacity <= kListEntries;
  const std::uint32_t list_entries = own_places ? std::max(kListEntries, instance_capacity) : instance_capacity;
  need(entries, vectors(list_entries), "entries");
  need(long_tiles, words(tile_total), "long tiles");
  need(sort_scratch, 4 * words(list_entries), "sort scratch");
  need(sorted, 2 * words(list_entries), "sorted");
  const Buffer &starts = own_places ? list_starts : tile_prefix, &blocks_before = own_places ? list_blocks : tile_block;
  need(image, vectors(pixels), "image");
  need(depth_image, options.depth ? words(pixels) : 0, "depth image");
  const bool dssim = options.loss && options.weights.dssim > 0.0f;
  need(pixel_gradient, dssim ? vectors(pixels) : 0, "pixel gradient");
  if (dssim) {
    const std::size_t near_pixels = static_cast<std::size_t>(near_total) * tile_width * tile_height;
    need(ssim_row_sums, 12 * words(near_pixels), "ssim rows");
    need(ssim_factors, 12 * words(near_pixels), "ssim factors");
  }
  if (options.backward) {
    need(partials, vectors(static_cast<std::size_t>(shared::kPartialRows) * slots * instance_capacity), "partials");
    need(records, vectors(shared::kGradientRows * pairs), "records");
    need(replica_gradient, words(replicas), "replica gradient");
    if (options.twists) need(link_twists, 2 * vectors(static_cast<std::size_t>(view_count) * links), "link twists");
  }

  if (options.chain) {
    std::uint32_t most_tiles = 1;
    for (const ColorView& view : colored) most_tiles = std::max(most_tiles, view.tiles);
    const auto slices = [&](std::uint32_t tiles_a_slice, std::uint32_t most) {
      return std::min(most, (most_tiles + tiles_a_slice - 1) / tiles_a_slice);
    };
    color_push.links = links;
    color_push.pixel_slices = slices(kTilesAPixelSlice, kMostPixelSlices);
    color_push.equation_slices = slices(kTilesAnEquationSlice, kMostEquationSlices);
    need(tile_pixels, words(static_cast<std::size_t>(tile_total) * tile_width * tile_height), "tile pixels");
    need(tile_summary, 2 * words(tile_total), "tile summary");
    pixel_sum_bytes = vectors(shared::kColorPixelRows * color_push.pixel_slices * view_count);
    link_sum_bytes = vectors(shared::kColorRows * color_push.equation_slices * view_count * links);
    need(pixel_sums, pixel_sum_bytes, "pixel sums");
    need(link_sums, link_sum_bytes, "link sums");
  }
  const std::size_t downloads = words(shared::kCounters) + (options.chain ? pixel_sum_bytes + link_sum_bytes : 0);
  if (!counters.mapped() && to_host.bytes() < downloads) {
    to_host = Buffer();
    to_host = Buffer(device, static_cast<std::size_t>(kGrowth * downloads), Domain::host, "to host");
  }

  SplatPush push{};
  push.gaussians = count;
  push.links = links;
  push.coefficients = static_cast<std::uint32_t>(scene.coefficients());
  push.views = view_count;
  push.live_capacity = live_capacity;
  push.instance_capacity = instance_capacity;
  push.tiles = tile_total;
  push.slots = slots;
  push.near_tiles = near_total;
  push.tile_capacity = own_places ? tile_capacity : 0;
  push.tile_stride = gpu::info(device).software ? spreading_stride(tile_total) : 1;
  push.weight_l1 = static_cast<float>(options.weights.l1 * options.color_scale);
  push.weight_dssim = static_cast<float>(options.weights.dssim * options.color_scale);
  push.weight_mask = static_cast<float>(options.weights.mask * options.mask_scale);
  push.flags = (options.accumulate ? shared::kFlagAccumulate : 0) | (options.held_links ? shared::kFlagHeldLinks : 0);
  const auto dispatch = [&](const gpu::Pipeline& pipeline, std::initializer_list<const Buffer*> buffers,
                            std::uint32_t x, std::uint32_t y = 1) {
    commands.dispatch(pipeline, {buffers.begin(), buffers.size()}, &push, sizeof push, x, y);
  };
  const auto dispatch_live = [&](const gpu::Pipeline& pipeline, std::initializer_list<const Buffer*> buffers) {
    commands.dispatch_indirect(pipeline, {buffers.begin(), buffers.size()}, &push, sizeof push, counters,
                               words(shared::kCounterDispatch));
  };
  const auto groups = [](std::size_t n) {
    return static_cast<std::uint32_t>((n + shared::kGroup - 1) / shared::kGroup);
  };

  commands.begin();
  to_host_bytes = 0;
  record_uploads();
  // what is live is known for as long as the Gaussians stay
  const std::pair now{scene.version, live_capacity};
  const bool replicas_kept = replicated == now;
  replicated = now;
  const auto set_counters = [&](std::uint32_t from, std::uint32_t to, std::uint32_t value) {
    commands.fill(counters, value, words(from), words(to - from));
    commands.no_barrier();
  };
  if (!replicas_kept) set_counters(0, shared::kCounterKept, 0);
  set_counters(shared::kCounterDispatch + 1, shared::kCounterDispatch + 2, view_count);
  set_counters(shared::kCounterDispatch + 2, shared::kCounterInstances, 1);
  set_counters(shared::kCounterInstances, shared::kCounterLongTiles + 1, 0);
  set_counters(shared::kCounterLongTiles + 1, shared::kCounterLongTiles + 3, 1);
  set_counters(shared::kCounterNotFinite, shared::kCounters, 0);
  commands.fill(tile_count, 0, 0, words(std::max(1u, tile_total)));
  commands.no_barrier();
  commands.fill(tile_cursor, 0, 0, words(std::max(1u, tile_total)));
  commands.no_barrier();
  commands.fill(tile_used, 0, 0, words(std::max(1u, tile_total)));
  commands.stamp("clear");
  constexpr std::uint32_t kRow = 32768;  // groups in x of a two-dimensional dispatch
  if (!replicas_kept) {
    dispatch(replicate, {&scene.parameters, &replica_opacity, &live_flag}, groups(count));
    push.scan_length = static_cast<std::uint32_t>(replicas);
    push.scan_counter = shared::kCounterLive;
    scan(live_flag, live_prefix, live_block, push, replicas);
    const std::uint32_t replica_groups = groups(replicas);
    dispatch(compact, {&live_flag, &live_prefix, &live_block, &live}, std::min(replica_groups, kRow),
             (replica_groups + kRow - 1) / kRow);
    commands.stamp("replicate");
  }
  dispatch_live(project, {&scene.parameters, &replica_opacity, &live, &views, &motions, &tile_map, &counters, &splats,
                          &instance_count, &tile_count, &tile_hits, &entries});
  commands.stamp("project");
  if (!own_places) {
    SplatPush scan_push = push;
    scan_push.scan_per_live = view_count;
    scan_push.scan_counter = shared::kCounterInstances;
    scan(instance_count, instance_prefix, instance_block, scan_push, pairs);
    scan_push.scan_per_live = 0;
    scan_push.scan_length = tile_total;
    scan_push.scan_counter = shared::kCounterTiles;
    scan(tile_count, tile_prefix, tile_block, scan_push, tile_total);
    commands.stamp("scan");
    dispatch_live(bin, {&live, &views, &tile_map, &counters, &splats, &instance_prefix, &instance_block, &tile_prefix,
                        &tile_block, &tile_cursor, &tile_hits, &entries});
    commands.stamp("bin");
  }
  dispatch(sort, {&starts, &blocks_before, &tile_count, &entries, &long_tiles, &sorted, &counters}, tile_total);
  const std::array long_buffers = {static_cast<const Buffer*>(&starts),     static_cast<const Buffer*>(&blocks_before),
                                   static_cast<const Buffer*>(&tile_count), static_cast<const Buffer*>(&entries),
                                   static_cast<const Buffer*>(&long_tiles), static_cast<const Buffer*>(&sort_scratch),
                                   static_cast<const Buffer*>(&sorted)};
  commands.dispatch_indirect(sort_long, long_buffers, &push, sizeof push, counters, words(shared::kCounterLongTiles));
  commands.stamp("sort");
  dispatch(options.depth ? blend_depth : blend,
           {&tiles, &views, &starts, &blocks_before, &tile_count, &sorted, &splats, &counters, &image, &tile_used,
            &depth_image},
           tile_total);
  commands.stamp("blend");
  if (options.sums) {
    dispatch(loss_pixel, {&tiles, &views, &image, &scene.target, &tile_loss}, tile_total);
    commands.stamp("loss");
  }
  if (dssim) {
    dispatch(ssim_rows, {&tiles, &views, &tile_map, &image, &scene.target, &ssim_row_sums}, near_total);
    dispatch(ssim_columns, {&tiles, &views, &tile_map, &ssim_row_sums, &ssim_factors, &tile_loss}, near_total);
    dispatch(ssim_rows_backward, {&tiles, &views, &tile_map, &ssim_factors, &ssim_row_sums}, near_total);
    dispatch(ssim_columns_backward, {&tiles, &views, &tile_map, &ssim_row_sums, &image, &scene.target, &pixel_gradient},
             near_total);
    commands.stamp("ssim");
  }
  if (options.backward) {
    dispatch(blend_backward,
             {&tiles, &views, &tile_prefix, &tile_block, &tile_count, &sorted, &splats, &counters, &image, &tile_used,
              &scene.target, &pixel_gradient, &partials},
             tile_total);
    commands.stamp("blend backward");
    dispatch_live(project_backward, {&scene.parameters, &live, &views, &motions, &counters, &splats, &instance_count,
                                     &instance_prefix, &instance_block, &partials, &records});
    commands.stamp("project backward");
    dispatch(gather,
             {&scene.parameters, &replica_opacity, &live_flag, &live_prefix, &live_block, &views, &motions, &counters,
              &records, &scene.gradient, &replica_gradient},
             groups(count));
    if (options.twists && count > 0)
      dispatch(link_twist, {&live_prefix, &live_block, &counters, &records, &link_twists}, links, view_count);
    commands.stamp("gather");
    if (adam_push) {
      const std::array buffers{static_cast<const Buffer*>(&scene.parameters),
                               static_cast<const Buffer*>(&scene.gradient),
                               static_cast<const Buffer*>(&scene.first_moment),
                               static_cast<const Buffer*>(&scene.second_moment), static_cast<const Buffer*>(&counters)};
      const std::uint32_t parameter_groups = groups((adam_push->total + 3) / 4);
      commands.dispatch(adam, buffers, adam_push, sizeof *adam_push, std::min(parameter_groups, kRow),
                        (parameter_groups + kRow - 1) / kRow);
      commands.stamp("adam");
      scene.version = ++versions;
    }
  }
  if (options.chain) {
    const auto dispatch_colors = [&](const gpu::Pipeline& pipeline, std::initializer_list<const Buffer*> buffers,
                                     std::uint32_t x, std::uint32_t y, std::uint32_t z) {
      commands.dispatch(pipeline, {buffers.begin(), buffers.size()}, &color_push, sizeof color_push, x, y, z);
    };
    dispatch_colors(color_pixels,
                    {&tiles, &views, &color_views, &segments, &image, &depth_image, &scene.target, &tile_pixels,
                     &tile_summary, &pixel_sums},
                    color_push.pixel_slices, view_count, 1);
    commands.stamp("color pixels");
    dispatch_colors(color_equations,
                    {&tiles, &views, &color_views, &segments, &image, &depth_image, &scene.target, &tile_pixels,
                     &tile_summary, &pixel_sums, &link_sums},
                    links, color_push.equation_slices, view_count);
    commands.stamp("color equations");
    read_pixel_sums = record_download(pixel_sums, pixel_sum_bytes);
    read_link_sums = record_download(link_sums, link_sum_bytes);
  }
  const std::byte* const read_counters = record_download(counters, words(shared::kCounters));
  commands.submit();
  commands.wait();
  for (const gpu::Timing& timing : commands.timings()) {
    const auto same =
        std::find_if(timings.begin(), timings.end(), [&](const auto& t) { return t.label == timing.label; });
    if (same == timings.end()) {
      timings.push_back(timing);
    } else {
      same->milliseconds += timing.milliseconds;
    }
  }

  std::array<std::uint32_t, shared::kCounters> read{};
  std::memcpy(read.data(), read_counters, words(shared::kCounters));
  if (read[shared::kCounterTooLong] != 0)
    throw WorkError("splat", "more than " + std::to_string(shared::kLongestList) + " Gaussians cover one tile",
                    "use fewer or smaller Gaussians");
  not_finite = static_cast<int>(read[shared::kCounterNotFinite]);
  if (read[shared::kCounterOverflow] == 0) return true;
  // raise what was too small, as far as one buffer may reach
  const std::size_t want_live = static_cast<std::size_t>(kGrowth * read[shared::kCounterWantLive]) + 64;
  const std::size_t want_instances = static_cast<std::size_t>(kGrowth * read[shared::kCounterWantInstances]) + 1024;
  if (read[shared::kCounterWantLive] > live_capacity)
    live_capacity = static_cast<std::uint32_t>(std::min<std::size_t>(want_live, replicas));
  if (read[shared::kCounterWantTile] > tile_capacity)
    set_tile_capacity(static_cast<std::uint32_t>(kGrowth * read[shared::kCounterWantTile]));
  if (read[shared::kCounterWantInstances] > instance_capacity)
    instance_capacity = static_cast<std::uint32_t>(want_instances);
  const std::size_t partial_bytes = vectors(static_cast<std::size_t>(shared::kPartialRows) * slots * instance_capacity);
  if (partial_bytes > range_limit) {
    if (view_count == 1)
      throw WorkError(
          "splat",
          "one view needs " + std::to_string(instance_capacity) + " tile entries, more than this device's buffers hold",
          "use fewer or smaller Gaussians");
    most_views = static_cast<int>(view_count) / 2;
    instance_capacity = 0;
  }
  return false;
}

template <class AfterChunk>
void Engine::State::run_all(Scene& scene, std::span<const int> batch, const RunOptions& options,
                            const AdamPush* adam_push, AfterChunk after) {
  const bool dssim = options.loss && options.weights.dssim > 0.0f;
  timings.clear();
  std::size_t done = 0;
  while (done < batch.size()) {
    // planned anew after every chunk: an overflow may have lowered most_views
    const std::vector<int> chunk = chunks(scene, batch.subspan(done), dssim).front();
    RunOptions with = options;
    with.accumulate = done > 0;
    const bool last = done + chunk.size() == batch.size();
    bool finished = false;
    try {
      finished = run(scene, chunk, with, last ? adam_push : nullptr);
    } catch (const gpu::OutOfMemory&) {
      if (chunk.size() == 1) throw;
      most_views = static_cast<int>(chunk.size()) / 2;
      release_view_buffers();
      core::warn("device memory is short: at most " + std::to_string(most_views) +
                 (most_views == 1 ? " view" : " views") + " in one submission from now on");
    }
    if (!finished) continue;
    after(std::span<const int>(chunk), done);
    done += chunk.size();
  }
}

std::vector<ViewSums> Engine::State::sums(std::size_t chunk_views) {
  std::vector<ViewSums> out(chunk_views);
  std::vector<glm::vec4> rows(2 * chunk_tile_view.size());
  if (!rows.empty()) gpu::download(device, tile_loss, rows.data(), rows.size() * sizeof(glm::vec4));
  for (std::size_t t = 0; t < chunk_tile_view.size(); ++t) {
    ViewSums& view = out[chunk_tile_view[t]];
    view.l1 += rows[2 * t].x;
    view.mask += rows[2 * t].y;
    view.squared += rows[2 * t].z;
    view.object += rows[2 * t].w;
    view.dssim += rows[2 * t + 1].x;
  }
  return out;
}

std::vector<Picture> Engine::State::pictures(const Scene& scene, std::span<const int> chunk, bool depth) {
  std::vector<Picture> out(chunk.size());
  const auto fetch = [&](std::int64_t v) {
    const SceneView& view = scene.views[chunk[v]];
    Picture& picture = out[v];
    picture.width = view.width;
    picture.height = view.height;
    const std::size_t pixels = static_cast<std::size_t>(view.width) * view.height;
    picture.rgba.resize(4 * pixels);
    if (pixels == 0) return;
    gpu::download(device, image, picture.rgba.data(), 4 * pixels * sizeof(float), chunk_pixel[v] * sizeof(glm::vec4));
    if (depth) {
      picture.depth.resize(pixels);
      gpu::download(device, depth_image, picture.depth.data(), pixels * sizeof(float), chunk_pixel[v] * sizeof(float));
    }
    // what was not drawn holds pixels of an earlier batch
    std::vector<bool> drawn(static_cast<std::size_t>(view.tiles_x) * view.tiles_y, false);
    for (const std::uint32_t cell : view.active) drawn[cell] = true;
    for (std::size_t cell = 0; cell < drawn.size(); ++cell) {
      if (drawn[cell]) continue;
      const int x0 = static_cast<int>(cell % view.tiles_x * tile_width),
                y0 = static_cast<int>(cell / view.tiles_x * tile_height);
      const int x1 = std::min(view.width, x0 + static_cast<int>(tile_width)),
                y1 = std::min(view.height, y0 + static_cast<int>(tile_height));
      for (int y = y0; y < y1; ++y) {
        const std::size_t first = static_cast<std::size_t>(y) * view.width + x0;
        std::fill_n(picture.rgba.begin() + static_cast<std::ptrdiff_t>(4 * first), 4 * (x1 - x0), 0.0f);
        if (depth) std::fill_n(picture.depth.begin() + static_cast<std::ptrdiff_t>(first), x1 - x0, 0.0f);
      }
    }
  };
  const auto count = static_cast<std::int64_t>(chunk.size());
  if (image.mapped()) {
    core::parallel_for(count, fetch);
  } else {  // through one staging buffer
    for (std::int64_t v = 0; v < count; ++v) fetch(v);
  }
  return out;
}

// Device: moment about the view's base origin, camera frame. Out: world twist about the world origin (SPEC 2.3).
std::vector<math::MatrixX> Engine::State::twists(const Scene& scene, std::span<const int> chunk) {
  std::vector<glm::vec4> rows(2 * chunk.size() * scene.links, glm::vec4(0.0f));
  if (scene.count > 0) gpu::download(device, link_twists, rows.data(), rows.size() * sizeof(glm::vec4));
  std::vector<math::MatrixX> out;
  for (std::size_t v = 0; v < chunk.size(); ++v) {
    const SceneView& view = scene.views[chunk[v]];
    const math::Matrix3 world_from_camera = view.camera_from_world.rotation.transpose();
    math::MatrixX twist = math::MatrixX::Zero(6, scene.links);
    for (int j = 0; j < scene.links && scene.count > 0; ++j) {
      const glm::vec4 m = rows[2 * (v * scene.links + j)], f = rows[2 * (v * scene.links + j) + 1];
      const math::Vector3 force = world_from_camera * math::Vector3(f.x, f.y, f.z);
      twist.col(j).head<3>() =
          world_from_camera * math::Vector3(m.x, m.y, m.z) + view.motions[0].translation.cross(force);
      twist.col(j).tail<3>() = force;
    }
    out.push_back(std::move(twist));
  }
  return out;
}

// Device: rows about the links' starts, camera frame. Out: world twists about the world origin.
std::vector<ColorSums> Engine::State::colors(const Scene& scene, std::span<const int> chunk,
                                             const chain::Chain& chain) {
  const auto floats = [](const std::byte* bytes, std::size_t size) {
    std::vector<float> values(size / sizeof(float));
    std::memcpy(values.data(), bytes, size);
    return values;
  };
  const std::vector<float> of_pixels = floats(read_pixel_sums, pixel_sum_bytes);
  const std::vector<float> of_links = floats(read_link_sums, link_sum_bytes);
  const auto sum = [](const std::vector<float>& all, std::size_t at, std::size_t slices, std::size_t rows) {
    math::VectorX total = math::VectorX::Zero(static_cast<Eigen::Index>(4 * rows));
    for (std::size_t k = 0; k < slices; ++k)
      total += Eigen::Map<const Eigen::VectorXf>(&all[(at * slices + k) * 4 * rows], total.size()).cast<double>();
    return total;
  };
  std::vector<ColorSums> out;
  for (std::size_t v = 0; v < chunk.size(); ++v) {
    const SceneView& view = scene.views[chunk[v]];
    ColorSums sums;
    const math::VectorX p = sum(of_pixels, v, color_push.pixel_slices, shared::kColorPixelRows);
    sums.pixels = static_cast<int>(p[5]);
    if (sums.pixels > 0) {
      const math::Vector3 drawn = p.segment<3>(8), seen = p.segment<3>(12);
      sums.covariance = p[6] - drawn.dot(seen) / sums.pixels;
      sums.drawn_variance = p[7] - drawn.squaredNorm() / sums.pixels;
      sums.seen_variance = p[11] - seen.squaredNorm() / sums.pixels;
    }
    const math::Matrix3 world_from_camera = view.camera_from_world.rotation.transpose();
    for (int j = 0; j < scene.links; ++j) {
      const std::size_t at = v * scene.links + j;
      const math::VectorX s = sum(of_links, at, color_push.equation_slices, shared::kColorRows);
      const float* const exposure = &of_links[4 * shared::kColorRows * color_push.equation_slices * at];
      sums.gain = exposure[shared::kColorExposure];
      sums.bias = exposure[shared::kColorExposure + 1];
      ColorSums::Matrix8 normal;
      ColorSums::Vector8 right;
      for (int row = 0, k = shared::kColorTwist; row < 6; ++row)
        for (int column = row; column < 6; ++column, ++k) normal(row, column) = normal(column, row) = s[k];
      normal.block<6, 1>(0, 6) = s.segment<6>(shared::kColorByGain);
      normal.block<6, 1>(0, 7) = s.segment<6>(shared::kColorByBias);
      normal.block<2, 6>(6, 0) = normal.block<6, 2>(0, 6).transpose();
      const math::Vector6 e = s.segment<6>(shared::kColorGain2);
      normal.bottomRightCorner<2, 2>() << e[0], e[1], e[1], e[2];
      right << s.segment<6>(shared::kColorRight), e[3], e[4];
      sums.weight += e[2];
      sums.square += e[5];
      // about the world origin: moment + start x force
      const math::Vector3 start = view.motions[j] * math::Vector3(chain.link_start(j) * chain.direction);
      ColorSums::Matrix8 world = ColorSums::Matrix8::Identity();
      world.block<3, 3>(0, 0) = world.block<3, 3>(3, 3) = world_from_camera;
      world.block<3, 3>(0, 3) = math::hat(start) * world_from_camera;
      sums.normal.emplace_back(world * normal * world.transpose());
      sums.right.emplace_back(world * right);
    }
    out.push_back(std::move(sums));
  }
  return out;
}

namespace {

std::vector<int> everything(std::size_t count) {
  std::vector<int> all(count);
  for (std::size_t k = 0; k < count; ++k) all[k] = static_cast<int>(k);
  return all;
}

void append(LossValues& values, const std::vector<ViewSums>& sums, const LossWeights& weights, double normalizer) {
  for (const ViewSums& sum : sums) {
    const double l1 = sum.l1 / (3.0 * normalizer), mask = sum.mask / normalizer, dssim = sum.dssim / (3.0 * normalizer);
    values.l1.push_back(l1);
    values.mask.push_back(mask);
    values.ssim.push_back(1.0 - dssim);
    values.psnr_object.push_back(-10.0 * std::log10(std::max(1e-12, sum.squared / std::max(1.0, 3.0 * sum.object))));
    values.total += weights.l1 * l1 + weights.mask * mask + weights.dssim * dssim;
  }
}

}  // namespace

Engine::Engine(gpu::Device& device, const Settings& settings) : state_(std::make_unique<State>(device, settings)) {}
Engine::~Engine() = default;
Engine::Engine(Engine&&) noexcept = default;

std::vector<Picture> Engine::draw(const Gaussians& gaussians, std::span<const ViewSpec> views, bool depth) {
  State& s = *state_;
  s.load_gaussians(s.scratch, gaussians);
  s.load_views(s.scratch, views, {}, Active::everywhere);
  RunOptions options;
  options.depth = depth;
  std::vector<Picture> out;
  s.run_all(s.scratch, everything(views.size()), options, nullptr, [&](std::span<const int> chunk, std::size_t) {
    for (Picture& picture : s.pictures(s.scratch, chunk, depth)) out.push_back(std::move(picture));
  });
  return out;
}

LossValues Engine::loss(const Gaussians& gaussians, std::span<const ViewSpec> views,
                        std::span<const std::vector<std::uint8_t>* const> targets, const LossWeights& weights,
                        double normalizer, Gradients* gradients, std::vector<Picture>* pictures) {
  State& s = *state_;
  s.load_gaussians(s.scratch, gaussians);
  s.load_views(s.scratch, views, targets, Active::everywhere);
  LossValues values;
  if (gradients) {
    gradients->gaussians = unpacked(std::vector<float>(s.scratch.parameter_count, 0.0f), gaussians.count,
                                    gaussians.links, gaussians.degree);
    std::fill(gradients->gaussians.rotation.begin(), gradients->gaussians.rotation.end(), 0.0f);
    gradients->link_twists.clear();
  }
  // crops of different size have different means: one call a normalizer, summed here
  std::vector<float> total(s.scratch.parameter_count, 0.0f), part(s.scratch.parameter_count);
  const auto run_batch = [&](std::span<const int> batch, double pixels) {
    RunOptions options;
    options.weights = weights;
    options.color_scale = 1.0 / (3.0 * pixels);
    options.mask_scale = 1.0 / pixels;
    options.loss = options.sums = true;
    options.backward = options.twists = gradients != nullptr;
    s.run_all(s.scratch, batch, options, nullptr, [&](std::span<const int> chunk, std::size_t) {
      append(values, s.sums(chunk.size()), weights, pixels);
      if (gradients)
        for (math::MatrixX& twist : s.twists(s.scratch, chunk)) gradients->link_twists.push_back(std::move(twist));
      if (pictures)
        for (Picture& picture : s.pictures(s.scratch, chunk, false)) pictures->push_back(std::move(picture));
    });
    if (gradients && !part.empty()) {
      gpu::download(s.device, s.scratch.gradient, part.data(), part.size() * sizeof(float));
      for (std::size_t k = 0; k < part.size(); ++k) total[k] += part[k];
    }
  };
  if (pictures) pictures->clear();
  if (normalizer > 0.0) {
    run_batch(everything(views.size()), normalizer);
  } else {
    for (int v = 0; v < static_cast<int>(views.size()); ++v) {
      const std::array one{v};
      run_batch(one, std::max(1.0, static_cast<double>(views[v].width) * views[v].height));
    }
  }
  if (gradients) gradients->gaussians = unpacked(total, gaussians.count, gaussians.links, gaussians.degree);
  return values;
}

void Engine::set_views(std::span<const ViewSpec> views, std::span<const std::vector<std::uint8_t>* const> targets,
                       bool everywhere) {
  state_->load_views(state_->training, views, targets,
                     everywhere ? Active::everywhere_dssim_near_mask : Active::near_mask);
}

void Engine::set_motions(int view, const std::vector<math::Pose>& motions) {
  state_->training.views.at(view).motions = motions;
}

void Engine::set_gaussians(const Gaussians& gaussians) {
  State& s = *state_;
  s.load_gaussians(s.training, gaussians);
  const std::vector<float> zero(s.training.parameter_count, 0.0f);
  s.write(s.training.first_moment, zero.data(), zero.size() * sizeof(float), "first moment");
  s.write(s.training.second_moment, zero.data(), zero.size() * sizeof(float), "second moment");
}

Gaussians Engine::gaussians() const {
  const Scene& scene = state_->training;
  std::vector<float> all(scene.parameter_count);
  if (!all.empty()) gpu::download(state_->device, scene.parameters, all.data(), all.size() * sizeof(float));
  return unpacked(all, scene.count, scene.links, scene.degree);
}

LossValues Engine::step(std::span<const int> batch, const LossWeights& weights, const AdamRates& rates,
                        bool read_losses, std::vector<math::MatrixX>* twists) {
  State& s = *state_;
  Scene& scene = s.training;
  RunOptions options;
  options.weights = weights;
  options.mask_scale = 1.0 / (scene.normalizer * static_cast<double>(batch.size()));
  options.color_scale = options.mask_scale / 3.0;
  options.loss = options.backward = true;
  options.sums = read_losses;
  options.held_links = rates.link_logits == 0.0f;
  options.twists = twists != nullptr;
  if (twists) twists->clear();
  ++scene.step;
  AdamPush push{};
  push.gaussians = static_cast<std::uint32_t>(scene.count);
  push.links = static_cast<std::uint32_t>(scene.links);
  push.coefficients = static_cast<std::uint32_t>(scene.coefficients());
  push.total = static_cast<std::uint32_t>(
      scene.parameter_count - (options.held_links ? scene.count * static_cast<std::size_t>(scene.links) : 0));
  push.mean = rates.mean;
  push.rotation = rates.rotation;
  push.log_scale = rates.log_scale;
  push.opacity = rates.opacity;
  push.sh0 = rates.sh0;
  push.sh_rest = rates.sh_rest;
  push.link_logits = rates.link_logits;
  push.epsilon = kEpsilon;
  push.beta1 = kBeta1;
  push.beta2 = kBeta2;
  push.correction1 = static_cast<float>(1.0 / (1.0 - std::pow(kBeta1, scene.step)));
  push.correction2 = static_cast<float>(1.0 / (1.0 - std::pow(kBeta2, scene.step)));
  LossValues values;
  s.run_all(scene, batch, options, &push, [&](std::span<const int> chunk, std::size_t) {
    if (read_losses) append(values, s.sums(chunk.size()), weights, scene.normalizer);
    if (twists)
      for (math::MatrixX& twist : s.twists(scene, chunk)) twists->push_back(std::move(twist));
  });
  values.not_finite = s.not_finite;
  return values;
}

std::vector<Picture> Engine::draw_views(std::span<const int> batch, bool depth) {
  State& s = *state_;
  RunOptions options;
  options.depth = depth;
  std::vector<Picture> out;
  s.run_all(s.training, batch, options, nullptr, [&](std::span<const int> chunk, std::size_t) {
    for (Picture& picture : s.pictures(s.training, chunk, depth)) out.push_back(std::move(picture));
  });
  return out;
}

std::vector<ColorSums> Engine::color_sums(const chain::Chain& chain, std::span<const ViewSpec> views,
                                          std::span<const std::vector<std::uint8_t>* const> seen) {
  State& s = *state_;
  CHAINSPLAT_CHECK(chain.links() == s.training.links,
                   std::to_string(chain.links()) + " " + std::to_string(s.training.links));
  s.load_views(s.training, views, seen, Active::in_mask);
  RunOptions options;
  options.depth = true;
  options.chain = &chain;
  std::vector<ColorSums> out;
  s.run_all(s.training, everything(views.size()), options, nullptr, [&](std::span<const int> chunk, std::size_t) {
    for (ColorSums& sums : s.colors(s.training, chunk, chain)) out.push_back(std::move(sums));
  });
  return out;
}

Engine::Snapshot Engine::snapshot() const {
  const Scene& scene = state_->training;
  Snapshot out;
  out.gaussians = gaussians();
  out.step = scene.step;
  for (const auto& [buffer, values] :
       {std::pair{&scene.first_moment, &out.first_moment}, std::pair{&scene.second_moment, &out.second_moment}}) {
    values->resize(scene.parameter_count);
    if (!values->empty()) gpu::download(state_->device, *buffer, values->data(), values->size() * sizeof(float));
  }
  return out;
}

void Engine::restore(const Snapshot& snapshot) {
  State& s = *state_;
  s.load_gaussians(s.training, snapshot.gaussians);
  CHAINSPLAT_CHECK(snapshot.first_moment.size() == s.training.parameter_count,
                   std::to_string(snapshot.first_moment.size()));
  s.write(s.training.first_moment, snapshot.first_moment.data(), snapshot.first_moment.size() * sizeof(float),
          "first moment");
  s.write(s.training.second_moment, snapshot.second_moment.data(), snapshot.second_moment.size() * sizeof(float),
          "second moment");
  s.training.step = snapshot.step;
}

void Engine::reset_opacity(float largest) {
  Snapshot now = snapshot();
  const float logit = std::log(largest / (1.0f - largest));
  for (float& value : now.gaussians.opacity_logit) value = std::min(value, logit);
  const std::size_t first = 10u * now.gaussians.count;
  for (auto* moment : {&now.first_moment, &now.second_moment})
    std::fill_n(moment->begin() + first, now.gaussians.count, 0.0f);
  restore(now);
}

void Engine::reset_links() {
  Snapshot now = snapshot();
  std::fill(now.gaussians.link_logits.begin(), now.gaussians.link_logits.end(), 0.0f);
  for (auto* moment : {&now.first_moment, &now.second_moment})
    std::fill(moment->end() - static_cast<std::ptrdiff_t>(now.gaussians.link_logits.size()), moment->end(), 0.0f);
  restore(now);
}

std::vector<gpu::Timing> Engine::timings() const { return state_->timings; }

}  // namespace chainsplat::splat
