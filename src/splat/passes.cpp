// passes.cpp - one submission: lays out its views, makes room for them, records all passes and runs them.
#include <algorithm>
#include <array>
#include <cstring>
#include <numeric>

#include "src/splat/engine.h"

namespace chainsplat::splat {

namespace {

// Tiles per slice, and most slices of a view, of color_pixels (enough work groups for a GPU) and of color_equations
// (few sums to read back).
constexpr std::uint32_t kTilesAPixelSlice = 4, kMostPixelSlices = 256;
constexpr std::uint32_t kTilesAnEquationSlice = 16, kMostEquationSlices = 64;
constexpr std::uint32_t kFirstInstances = 8;  // first guess of the number of tiles that a splat touches
constexpr std::uint32_t kRow = 32768;         // work groups in x of a two-dimensional dispatch (Vulkan allows 65535)

// lavapipe gives each thread one contiguous range of a pass's work groups. Neighboring tiles need similar amounts of
// work, distant ones do not. A pass therefore visits the list of tiles with a stride of about its golden section, which
// gives every range some tiles of each kind.
std::uint32_t spreading_stride(std::uint32_t count) {
  constexpr double kGoldenSection = 0.6180339887;
  auto stride = static_cast<std::uint32_t>(kGoldenSection * count);
  while (stride > 1 && std::gcd(stride, count) > 1) --stride;
  return std::max(1u, stride);
}

std::uint32_t narrow(std::size_t n) { return static_cast<std::uint32_t>(n); }
std::size_t words(std::size_t n) { return n * sizeof(std::uint32_t); }
std::size_t vectors(std::size_t n) { return n * sizeof(glm::vec4); }
std::uint32_t groups(std::size_t n) { return narrow((n + shared::kGroup - 1) / shared::kGroup); }

}  // namespace

void Engine::State::scan(const Buffer& values, const Buffer& prefix, const Buffer& block, SplatPush push,
                         std::size_t most) {
  const auto groups = narrow((most + shared::kScanBlock - 1) / shared::kScanBlock);
  bindings.set("values", values);
  bindings.set("prefix", prefix);
  bindings.set("block_sum", block);
  dispatch(scan_block, push, groups);
  dispatch(scan_sums, push, 1);
}

void Engine::State::dispatch(const gpu::Pipeline& pipeline, const SplatPush& push, std::uint32_t x, std::uint32_t y) {
  commands.dispatch(pipeline, &push, sizeof push, x, y);
}

void Engine::State::dispatch_tiles(const gpu::Pipeline& pipeline, const SplatPush& push) {
  dispatch(pipeline, push, (push.tiles + group_tiles - 1) / group_tiles);
}

void Engine::State::dispatch_live(const gpu::Pipeline& pipeline, const SplatPush& push) {
  commands.dispatch_indirect(pipeline, &push, sizeof push, counters, words(shared::kCounterDispatch));
}

void Engine::State::bind(const Submission& s) {
  bindings.set("parameters", s.scene.parameters);
  bindings.set("gradient", s.scene.gradient);
  bindings.set("first_moment", s.scene.first_moment);
  bindings.set("second_moment", s.scene.second_moment);
  bindings.set("target", s.scene.target);
  bindings.set("tile_prefix", s.own_places ? list_starts : tile_prefix);
  bindings.set("tile_block", s.own_places ? list_blocks : tile_block);
}

Submission Engine::State::lay_out(Scene& scene, std::span<const int> chunk, const RunOptions& options) {
  Submission out{scene, options};
  out.views = narrow(chunk.size());
  out.replicas = static_cast<std::size_t>(scene.count) * scene.links;
  out.dssim = options.loss && options.weights.dssim > 0.0f;
  stage_tiles(out, chunk, stage_views(out, chunk));
  stage_targets(out, chunk);
  if (options.chain) stage_axes(scene, chunk, *options.chain);
  return out;
}

std::vector<SplatView> Engine::State::stage_views(Submission& s, std::span<const int> chunk) {
  std::vector<SplatView> placed;
  std::vector<glm::vec4> rows;  // three of camera_from_home for every link
  std::size_t cells = 0;        // in the tile map
  const Light& light = s.scene.light;
  chunk_pixel.clear();
  for (const int v : chunk) {
    const SceneView& view = s.scene.views[v];
    const int links = s.scene.count == 0 ? 0 : s.scene.links;  // without Gaussians there may be no motions
    CHAINSPLAT_CHECK(view.motions.size() == static_cast<std::size_t>(links) || links == 0,
                     std::to_string(view.motions.size()));
    const math::Vector3 base =
        view.motions.empty() ? math::Vector3::Zero() : view.camera_from_world * view.motions[0].translation;
    // in the axes of the camera frame
    const math::Matrix3& turn = view.camera_from_world.rotation;
    const math::Vector3 linear = turn * light.linear;
    const math::Matrix3 quadratic = turn * light.quadratic * turn.transpose();
    placed.push_back({.intrinsics = {view.fx, view.fy, view.cx, view.cy},
                      .limits = {view.limit_x, view.limit_y, s.scene.pixel_footprint, 0},
                      .moment_point = {base.x(), base.y(), base.z(), 0},
                      .gain = {view.gain.x(), view.gain.y(), view.gain.z(), view.white},
                      .bias = {view.bias.x(), view.bias.y(), view.bias.z(), 0},
                      .axis = {light.axis.x(), light.axis.y(), light.axis.z(), light.known() ? 1.0 : 0.0},
                      .light = {linear.x(), linear.y(), linear.z(), light.constant},
                      .light_squares = {quadratic(0, 0), quadratic(1, 1), quadratic(2, 2), 0},
                      .light_products = {quadratic(0, 1), quadratic(0, 2), quadratic(1, 2), 0},
                      .width = narrow(view.width),
                      .height = narrow(view.height),
                      .tiles_x = narrow(view.tiles_x),
                      .tiles_y = narrow(view.tiles_y),
                      .tile_map = narrow(cells),
                      .pixel = narrow(s.pixels),
                      .target = narrow(s.pixels),
                      .motion = narrow(rows.size() / 3)});
    chunk_pixel.push_back(s.pixels);
    cells += static_cast<std::size_t>(view.tiles_x) * view.tiles_y;
    s.pixels += static_cast<std::size_t>(view.width) * view.height;
    s.most_tiles = std::max(s.most_tiles, narrow(view.active.size()));
    for (int j = 0; j < links; ++j) {
      const math::Pose pose = view.camera_from_world * view.motions[j];
      for (int r = 0; r < 3; ++r)
        rows.emplace_back(pose.rotation(r, 0), pose.rotation(r, 1), pose.rotation(r, 2), pose.translation[r]);
    }
  }
  stage(views, bytes_of(placed), "views");
  stage(motions, bytes_of(rows), "motions");
  return placed;
}

void Engine::State::stage_targets(const Submission& s, std::span<const int> chunk) {
  std::vector<std::uint8_t> all;  // none where they are not looked at
  for (const int v : chunk) {
    const SceneView& view = s.scene.views[v];
    if (!s.options.loss && !s.options.chain) break;
    if (view.packed_target) {
      const capture::View whole = capture::unpacked(*view.packed_target);
      all.insert(all.end(), whole.rgba.begin(), whole.rgba.end());
    } else if (view.target) {
      all.insert(all.end(), view.target->begin(), view.target->end());
    }
  }
  stage(s.scene.target, bytes_of(all), "target");
}

void Engine::State::stage_tiles(Submission& s, std::span<const int> chunk, const std::vector<SplatView>& placed) {
  std::vector<std::uint32_t> map;
  for (const SplatView& view : placed) map.resize(map.size() + view.tiles_x * view.tiles_y, shared::kNoTile);
  std::vector<SplatTile> active;
  chunk_tile_view.clear();
  // those with a D-SSIM term come first, so that its passes run over a prefix of the list
  for (const bool near : {true, false}) {
    for (std::uint32_t v = 0; v < s.views; ++v) {
      const SceneView& view = s.scene.views[chunk[v]];
      for (std::size_t k = near ? 0 : view.near; k < (near ? view.near : view.active.size()); ++k) {
        const std::uint32_t cell = view.active[k];
        map[placed[v].tile_map + cell] = narrow(active.size());
        active.push_back({v, cell % placed[v].tiles_x, cell / placed[v].tiles_x, 0});
        chunk_tile_view.push_back(v);
      }
    }
    if (near) s.near_tiles = narrow(active.size());
  }
  s.tiles = narrow(active.size());
  stage(tile_map, bytes_of(map), "tile map");
  stage(tiles, bytes_of(active), "tiles");
}

void Engine::State::stage_axes(const Scene& scene, std::span<const int> chunk, const chain::Chain& chain) {
  std::vector<ColorView> colored;
  std::vector<glm::vec4> axes;
  std::uint32_t first_tile = 0;
  for (const int v : chunk) {
    const SceneView& view = scene.views[v];
    colored.push_back({first_tile, narrow(view.active.size()), narrow(axes.size() / 2), 0});
    first_tile += colored.back().tiles;
    for (int j = 0; j < scene.links; ++j) {
      const math::Pose pose = view.camera_from_world * view.motions[j];
      const math::Vector3 start = pose * math::Vector3(chain.link_start(j) * chain.direction);
      const math::Vector3 along = pose.rotation * chain.direction;
      axes.emplace_back(start.x(), start.y(), start.z(), chain.link_end(j) - chain.link_start(j));
      axes.emplace_back(along.x(), along.y(), along.z(), 0.0);
    }
  }
  stage(color_views, bytes_of(colored), "color views");
  stage(segments, bytes_of(axes), "segments");
}

bool Engine::State::make_room(Submission& s) {
  const RunOptions& options = s.options;

  // capacities: first guesses, kept within what one buffer may hold
  if (live_capacity == 0 || live_capacity > s.replicas)
    live_capacity = narrow(
        std::max<std::size_t>(1, std::min<std::size_t>(s.replicas, 2 * static_cast<std::size_t>(s.scene.count) + 256)));
  s.pairs = static_cast<std::size_t>(live_capacity) * s.views;
  const std::size_t pair_bytes = (options.backward ? shared::kGradientRows : shared::kSplatRows) * sizeof(glm::vec4);
  if (s.pairs * pair_bytes > range_limit && s.views > 1) {
    most_views = static_cast<int>(std::max<std::size_t>(1, range_limit / (pair_bytes * live_capacity)));
    return false;
  }
  if (instance_capacity == 0) instance_capacity = narrow(std::max<std::size_t>(1024, kFirstInstances * s.pairs / 2));
  // the capacity that drawing has reached may be too large for gradients; an overflow then lowers the number of views
  if (options.backward)
    instance_capacity =
        narrow(std::min<std::size_t>(instance_capacity, range_limit / (sizeof(float) * shared::kPartial * slots)));

  // buffers of the lists, the picture and the gradients
  const auto blocks = [](std::size_t n) { return n / shared::kScanBlock + 1; };
  need(replica_share, words(s.replicas), "replica share");
  need(live_flag, words(s.replicas), "live flag");
  need(live_prefix, words(s.replicas), "live prefix");
  need(live_block, words(blocks(s.replicas)), "live block");
  need(live, words(live_capacity), "live");
  need(splats, vectors(shared::kSplatRows * s.pairs), "splats");
  need(instance_count, words(s.pairs), "instance count");
  need(tile_hits, words(s.pairs), "tile hits");
  need(instance_prefix, words(s.pairs), "instance prefix");
  need(instance_block, words(blocks(s.pairs)), "instance block");
  need(tile_count, words(s.tiles), "tile count");
  need(tile_prefix, words(s.tiles), "tile prefix");
  need(tile_block, words(blocks(s.tiles)), "tile block");
  need(tile_cursor, words(s.tiles), "tile cursor");
  need(tile_used, words(s.tiles), "tile used");
  need(tile_loss, 2 * vectors(s.tiles), "tile loss");
  s.own_places =
      s.tiles <= most_placed_tiles(options) && (!options.backward || words(s.pairs * splat_capacity) <= range_limit);
  const std::uint32_t list_entries = s.own_places ? std::max(kListEntries, instance_capacity) : instance_capacity;
  need(entries, vectors(list_entries), "entries");
  need(long_tiles, words(s.tiles), "long tiles");
  need(sort_scratch, 4 * words(list_entries), "sort scratch");
  need(sorted, words(list_entries), "sorted");
  const std::size_t instances = s.own_places ? s.pairs * splat_capacity : instance_capacity;
  need(instance_place, options.backward ? words(instances) : 0, "instance place");
  need(image, vectors(s.pixels), "image");
  need(depth_image, options.depth ? words(s.pixels) : 0, "depth image");
  need(pixel_gradient, s.dssim ? vectors(s.pixels) : 0, "pixel gradient");
  if (s.dssim) {
    const std::size_t near_pixels = static_cast<std::size_t>(s.near_tiles) * tile_width * tile_height;
    need(ssim_row_sums, 12 * words(near_pixels), "ssim rows");
    need(ssim_factors, 12 * words(near_pixels), "ssim factors");
  }
  if (options.backward) {
    const std::size_t placed = s.own_places ? static_cast<std::size_t>(s.tiles) * tile_capacity : instance_capacity;
    need(partials, words(static_cast<std::size_t>(shared::kPartial) * slots * placed), "partials");
    need(records, vectors(shared::kGradientRows * s.pairs), "records");
    need(replica_gradient, words(s.replicas), "replica gradient");
    if (options.twists)
      need(link_twists, 2 * vectors(static_cast<std::size_t>(s.views) * s.scene.links), "link twists");
  }

  if (options.chain) {
    const auto slices = [&](std::uint32_t tiles_a_slice, std::uint32_t most) {
      return std::min(most, (std::max(1u, s.most_tiles) + tiles_a_slice - 1) / tiles_a_slice);
    };
    color_push.links = s.scene.links;
    color_push.pixel_slices = slices(kTilesAPixelSlice, kMostPixelSlices);
    color_push.equation_slices = slices(kTilesAnEquationSlice, kMostEquationSlices);
    need(tile_pixels, words(static_cast<std::size_t>(s.tiles) * tile_width * tile_height), "tile pixels");
    need(tile_summary, 2 * words(s.tiles), "tile summary");
    pixel_sum_bytes = vectors(shared::kColorPixelRows * color_push.pixel_slices * s.views);
    link_sum_bytes = vectors(shared::kColorRows * color_push.equation_slices * s.views * s.scene.links);
    need(pixel_sums, pixel_sum_bytes, "pixel sums");
    need(link_sums, link_sum_bytes, "link sums");
  }
  const std::size_t downloads = words(shared::kCounters) + (options.chain ? pixel_sum_bytes + link_sum_bytes : 0);
  if (!counters.mapped() && to_host.bytes() < downloads) {
    to_host = Buffer();
    to_host = Buffer(device, static_cast<std::size_t>(kGrowth * downloads), Domain::host, "to host");
  }

  SplatPush& push = s.push;
  push.gaussians = narrow(s.scene.count);
  push.links = narrow(s.scene.links);
  push.coefficients = narrow(s.scene.coefficients());
  push.views = s.views;
  push.live_capacity = live_capacity;
  push.instance_capacity = instance_capacity;
  push.tiles = s.tiles;
  push.slots = slots;
  push.near_tiles = s.near_tiles;
  push.tile_capacity = s.own_places ? tile_capacity : 0;
  push.tile_stride = gpu::info(device).software ? spreading_stride(s.tiles) : 1;
  push.weight_l1 = static_cast<float>(options.weights.l1 * options.color_scale);
  push.weight_dssim = static_cast<float>(options.weights.dssim * options.color_scale);
  push.weight_mask = static_cast<float>(options.weights.mask * options.mask_scale);
  push.background = options.weights.background;
  push.splat_capacity = splat_capacity;
  push.flags = (options.held_links ? shared::kFlagHeldLinks : 0) | (options.backward ? shared::kFlagGradients : 0);
  return true;
}

void Engine::State::record_lists(const Submission& s) {
  const Scene& scene = s.scene;
  // clear the counters; the live replicas are kept for as long as the Gaussians, or held links, do not
  // change
  const std::tuple now{s.options.held_links ? scene.link_version : scene.version, s.options.held_links, live_capacity};
  const bool replicas_kept = replicated == now;
  replicated = now;
  const auto set_counters = [&](std::uint32_t from, std::uint32_t to, std::uint32_t value) {
    fill(counters, value, from, to - from);
  };
  if (!replicas_kept) set_counters(0, shared::kCounterKept, 0);
  set_counters(shared::kCounterDispatch + 1, shared::kCounterDispatch + 2, s.views);
  set_counters(shared::kCounterDispatch + 2, shared::kCounterInstances, 1);
  set_counters(shared::kCounterInstances, shared::kCounterLongTiles + 1, 0);
  set_counters(shared::kCounterLongTiles + 1, shared::kCounterLongTiles + 3, 1);
  set_counters(shared::kCounterNotFinite, shared::kCounters, 0);
  for (Buffer* const list : {&tile_count, &tile_cursor, &tile_used}) fill(*list, 0, 0, std::max(1u, s.tiles));
  commands.stamp("clear");

  // Gaussians to live replicas
  if (!replicas_kept) {
    SplatPush push = s.push;
    dispatch(replicate, push, groups(scene.count));
    push.scan_length = narrow(s.replicas);
    push.scan_counter = shared::kCounterLive;
    scan(live_flag, live_prefix, live_block, push, s.replicas);
    const std::uint32_t replica_groups = groups(s.replicas);
    dispatch(compact, push, std::min(replica_groups, kRow), (replica_groups + kRow - 1) / kRow);
    commands.stamp("replicate");
  }

  // live replicas to splats, and splats to the lists of the tiles that they touch
  dispatch_live(project, s.push);
  commands.stamp("project");
  if (!s.own_places) {
    SplatPush scan_push = s.push;
    scan_push.scan_per_live = s.views;
    scan_push.scan_counter = shared::kCounterInstances;
    scan(instance_count, instance_prefix, instance_block, scan_push, s.pairs);
    scan_push.scan_per_live = 0;
    scan_push.scan_length = s.tiles;
    scan_push.scan_counter = shared::kCounterTiles;
    scan(tile_count, tile_prefix, tile_block, scan_push, s.tiles);
    commands.stamp("scan");
    dispatch_live(bin, s.push);
    commands.stamp("bin");
  }

  // every list by depth
  dispatch_tiles(sort, s.push);
  commands.dispatch_indirect(sort_long, &s.push, sizeof s.push, counters, words(shared::kCounterLongTiles));
  commands.stamp("sort");
}

void Engine::State::record_picture(const Submission& s) {
  dispatch_tiles(s.options.depth ? blend_depth : blend, s.push);
  commands.stamp("blend");
  if (s.options.sums) {
    dispatch(loss_pixel, s.push, s.tiles);
    commands.stamp("loss");
  }
  if (s.dssim) {
    for (const gpu::Pipeline* pass : {&ssim_rows, &ssim_columns, &ssim_rows_backward, &ssim_columns_backward})
      dispatch(*pass, s.push, s.near_tiles);
    commands.stamp("ssim");
  }
}

void Engine::State::record_gradients(const Submission& s) {
  const Scene& scene = s.scene;
  dispatch_tiles(blend_backward, s.push);
  commands.stamp("blend backward");
  dispatch_live(project_backward, s.push);
  commands.stamp("project backward");
  dispatch(s.options.accumulate ? gather_onto : gather, s.push, groups(scene.count));
  if (s.options.twists && scene.count > 0) dispatch(link_twist, s.push, narrow(scene.links), s.views);
  commands.stamp("gather");
}

void Engine::State::record_adam(const Submission& s, const AdamPush& push) {
  const std::uint32_t parameter_groups = groups((push.total + 3) / 4);
  commands.dispatch(adam, &push, sizeof push, std::min(parameter_groups, kRow), (parameter_groups + kRow - 1) / kRow);
  commands.stamp("adam");
  s.scene.version = ++versions;
  if (!s.options.held_links) s.scene.link_version = versions;
}

void Engine::State::record_colors(const Submission& s) {
  commands.dispatch(color_pixels, &color_push, sizeof color_push, color_push.pixel_slices, s.views);
  commands.stamp("color pixels");
  commands.dispatch(color_equations, &color_push, sizeof color_push, color_push.links, color_push.equation_slices,
                    s.views);
  commands.stamp("color equations");
  read_pixel_sums = record_download(pixel_sums, pixel_sum_bytes);
  read_link_sums = record_download(link_sums, link_sum_bytes);
}

bool Engine::State::has_fitted(const Submission& s, const std::byte* read_counters) {
  std::array<std::uint32_t, shared::kCounters> read{};
  std::memcpy(read.data(), read_counters, words(shared::kCounters));
  if (read[shared::kCounterTooLong] != 0)
    throw WorkError("splat", "more than " + std::to_string(shared::kLongestList) + " Gaussians cover one tile",
                    "use fewer or smaller Gaussians");
  not_finite = static_cast<int>(read[shared::kCounterNotFinite]);
  if (read[shared::kCounterOverflow] == 0) return true;
  // raise each capacity that was too small, within what one buffer may hold
  const std::size_t want_live = static_cast<std::size_t>(kGrowth * read[shared::kCounterWantLive]) + 64;
  const std::size_t want_instances = static_cast<std::size_t>(kGrowth * read[shared::kCounterWantInstances]) + 1024;
  if (read[shared::kCounterWantLive] > live_capacity)
    live_capacity = narrow(std::min<std::size_t>(want_live, s.replicas));
  if (read[shared::kCounterWantTile] > tile_capacity)
    set_tile_capacity(static_cast<std::uint32_t>(kGrowth * read[shared::kCounterWantTile]));
  if (read[shared::kCounterWantSplat] > splat_capacity)
    splat_capacity = static_cast<std::uint32_t>(kGrowth * read[shared::kCounterWantSplat]);
  if (read[shared::kCounterWantInstances] > instance_capacity) instance_capacity = narrow(want_instances);
  const std::size_t partial_bytes = words(static_cast<std::size_t>(shared::kPartial) * slots * instance_capacity);
  if (partial_bytes > range_limit) {
    if (s.views == 1)
      throw WorkError(
          "splat",
          "one view needs " + std::to_string(instance_capacity) + " tile entries, more than this device's buffers hold",
          "use fewer or smaller Gaussians");
    most_views = static_cast<int>(s.views) / 2;
    instance_capacity = 0;
  }
  return false;
}

bool Engine::State::run(Scene& scene, std::span<const int> chunk, const RunOptions& options,
                        const AdamPush* adam_push) {
  Submission s = lay_out(scene, chunk, options);
  if (!make_room(s)) return false;
  bind(s);
  commands.begin();
  to_host_bytes = 0;
  record_uploads();
  record_lists(s);
  record_picture(s);
  if (options.backward) record_gradients(s);
  if (options.backward && adam_push) record_adam(s, *adam_push);
  if (options.chain) record_colors(s);
  const std::byte* const read_counters = record_download(counters, words(shared::kCounters));
  commands.submit();
  commands.wait();
  for (const gpu::Timing& timing : commands.timings()) {
    auto same = std::find_if(timings.begin(), timings.end(), [&](const auto& t) { return t.label == timing.label; });
    if (same == timings.end()) same = timings.insert(same, {timing.label, 0.0});
    same->milliseconds += timing.milliseconds;
  }
  return has_fitted(s, read_counters);
}

}  // namespace chainsplat::splat
