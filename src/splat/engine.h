// engine.h - what the parts of the splatting engine share: its scenes, its device buffers and one submission.
#pragma once
#include <algorithm>
#include <cstddef>
#include <functional>
#include <initializer_list>
#include <utility>

#include "chainsplat/splat.h"
#include "shaders/shared/adam.h"
#include "shaders/shared/color.h"
#include "shaders/shared/splat.h"

namespace chainsplat::splat {

using gpu::Buffer;
using gpu::Domain;
using shared::AdamPush;
using shared::ColorPush;
using shared::ColorView;
using shared::SplatPush;
using shared::SplatTile;
using shared::SplatView;

constexpr double kGrowth = 1.25;                                      // spare room when a capacity is raised
constexpr std::uint32_t kListEntries = 1 << 20, kTileCapacity = 512;  // of all tiles' lists with places of their own

constexpr std::uint32_t kRankLimit = 192;          // longest tile list sorted by rank; longer ones by radix
constexpr std::uint32_t kSoftwareRankLimit = 512;  // the same on a software device, whose barriers make radix dear

// How the passes over tiles are laid out on a device: what their kernels are specialized with. `subgroup_size`: lanes
// that every subgroup has at least.
struct TileLanes {
  std::uint32_t lanes;       // of a group of the blending passes, kPixels pixels each
  std::uint32_t subgroup;    // of them add up a gradient: all in one subgroup, which may hold several such clusters
  std::uint32_t slots;       // clusters of a group: sums of one entry of a tile's list
  std::uint32_t share;       // lanes that load a splat each and hand them round
  std::uint32_t sort_lanes;  // of a group of the sorting passes,
  std::uint32_t sort_share;  // of which so many load a key each and hand them round
  std::uint32_t rank_limit;
  std::uint32_t color_lanes;                // of a group of the passes over colors, all of one subgroup,
  std::uint32_t color_columns, color_rows;  // and the part of a tile that each sees to
};

constexpr TileLanes tile_lanes(std::uint32_t tile, std::uint32_t pixels_per_lane, std::uint32_t subgroup_size,
                               bool software) {
  TileLanes out{};
  subgroup_size = std::max(1u, subgroup_size);
  out.lanes = tile * tile / pixels_per_lane;
  out.subgroup = std::min(out.lanes, subgroup_size);
  out.slots = out.lanes / out.subgroup;
  // a software device loads lane by lane, so that its lanes share the work; a GPU loads at once what all lanes want
  out.share = software ? out.subgroup : 1;
  // as many lanes a tile as a subgroup of the device: no lane waits at the barriers for another subgroup
  out.sort_lanes = software ? 8 : 32;
  out.sort_share = std::min(out.sort_lanes, subgroup_size);
  out.rank_limit = software ? kSoftwareRankLimit : kRankLimit;
  out.color_lanes = std::min(subgroup_size, tile * tile);
  out.color_columns = std::max(1u, tile / out.color_lanes);
  out.color_rows = tile * tile / (out.color_lanes * out.color_columns);
  return out;
}

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

// One submission: some views of a scene, laid out for the device.
struct Submission {
  Scene& scene;
  const RunOptions& options;
  std::uint32_t views = 0;
  std::uint32_t tiles = 0, near_tiles = 0;  // of all views; the first ones have a D-SSIM term too
  std::uint32_t most_tiles = 0;             // of a view
  std::size_t pixels = 0;                   // of all views
  std::size_t replicas = 0, pairs = 0;      // Gaussians x links; live replicas, as far as there is room, x views
  bool own_places = false;                  // every tile's list has a place of its own
  bool dssim = false;
  SplatPush push{};
};

// Parameters one after the other, as on the device.
std::vector<float> packed(const Gaussians& gaussians);
Gaussians unpacked(const std::vector<float>& all, int count, int links, int degree);

struct Engine::State {
  gpu::Device& device;
  std::uint32_t tile_width, tile_height, pixels_per_lane, slots;  // slots: as TileLanes
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
  Buffer list_starts, list_blocks;  // stand for tile_prefix and tile_block where every list has a place of its own
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

  // buffers.cpp
  void need(Buffer& buffer, std::size_t bytes, const char* name);  // at least so large; what it held is lost with it
  void release_view_buffers();  // all whose size follows the number of views in a submission
  void write(Buffer& buffer, const void* data, std::size_t bytes, const char* name);
  void stage(Buffer& buffer, const void* data, std::size_t bytes, const char* name);  // in the next submission
  void record_uploads();
  // Where `bytes` of a buffer can be read once the submission is done. Room in `to_host` has been made.
  const std::byte* record_download(const Buffer& buffer, std::size_t bytes);
  void set_tile_capacity(std::uint32_t capacity);

  // scene.cpp
  void load_gaussians(Scene& scene, const Gaussians& gaussians);
  void load_views(Scene& scene, std::span<const ViewSpec> specs,
                  std::span<const std::vector<std::uint8_t>* const> targets, Active active);
  // Views that go into one submission: bounded by buffer ranges and group counts of the device, never by time.
  std::vector<std::vector<int>> chunks(const Scene& scene, std::span<const int> batch, bool dssim) const;

  // passes.cpp: one submission, in this order
  Submission lay_out(Scene& scene, std::span<const int> chunk, const RunOptions& options);
  bool make_room(Submission& submission);             // false: these are too many views at once
  void record_lists(const Submission& submission);    // which splats are in which tile, front to back
  void record_picture(const Submission& submission);  // and its loss
  void record_gradients(const Submission& submission);
  void record_adam(const Submission& submission, const AdamPush& push);
  void record_colors(const Submission& submission);
  bool has_fitted(const Submission& submission, const std::byte* read_counters);  // else capacities have been raised
  // All that. False: something was too small; that has been raised, plan and run again.
  bool run(Scene& scene, std::span<const int> chunk, const RunOptions& options, const AdamPush* adam_push);
  void scan(const Buffer& values, const Buffer& prefix, const Buffer& block, SplatPush push, std::size_t most);
  void dispatch(const gpu::Pipeline& pipeline, std::initializer_list<const Buffer*> buffers, const SplatPush& push,
                std::uint32_t x, std::uint32_t y = 1);
  // As many groups as there are live splats: a counter of the device.
  void dispatch_live(const gpu::Pipeline& pipeline, std::initializer_list<const Buffer*> buffers,
                     const SplatPush& push);

  // `after` gets the chunk that was run and how many views of the batch were before it.
  void run_all(Scene& scene, std::span<const int> batch, const RunOptions& options, const AdamPush* adam_push,
               const std::function<void(std::span<const int> chunk, std::size_t done)>& after);

  // read_back.cpp: of the last submission
  std::vector<ViewSums> sums(std::size_t chunk_views);
  std::vector<Picture> pictures(const Scene& scene, std::span<const int> chunk, bool depth);
  std::vector<math::MatrixX> twists(const Scene& scene, std::span<const int> chunk);
  std::vector<ColorSums> colors(const Scene& scene, std::span<const int> chunk, const chain::Chain& chain);
};

}  // namespace chainsplat::splat
