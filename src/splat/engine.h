// engine.h - what the sources of the splatting engine share: its scenes, its device buffers and one submission.
//
// Terms: a replica is a Gaussian on one of the links; it is live if it can be visible at all. A pair is a (view, live
// replica), an instance is a (view, live replica, tile). A tile is active if it is drawn and contributes to the loss.
#pragma once
#include <algorithm>
#include <cstddef>
#include <functional>
#include <tuple>
#include <utility>

#include "chainsplat/splat.h"
#include "shaders/shared/adam.h"
#include "shaders/shared/color.h"
#include "shaders/shared/gaussian.h"
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

constexpr double kGrowth = 1.25;  // factor of spare room when a capacity is raised
// Tile lists at fixed places: entries of all of them together, and capacity of each before any has overflowed.
constexpr std::uint32_t kListEntries = 1 << 20, kTileCapacity = 512;
// Places of a splat's instances with such lists: how many before any splat has touched more tiles, and the most; with
// more the lists are contiguous.
constexpr std::uint32_t kSplatCapacity = 16, kMostSplatCapacity = 64;

constexpr std::uint32_t kRankLimit = 192;          // longest tile list that is sorted by rank; longer ones by radix
constexpr std::uint32_t kSoftwareRankLimit = 512;  // the same on a software device, whose barriers make radix costly

// Tiles per work group on a software device, and lanes at most: lavapipe allocates memory for every work group.
constexpr std::uint32_t kSoftwareTiles = 8, kSoftwareLanes = 256;

// Layout of the passes over tiles on a device: the specialization constants of their kernels.
struct TileLanes {
  std::uint32_t tiles;       // per work group of the blending passes and of splat_sort
  std::uint32_t lanes;       // per tile of the blending passes, each with kPixels pixels
  std::uint32_t subgroup;    // lanes of a cluster, which sum a gradient by shuffles; a subgroup holds one or several
  std::uint32_t slots;       // clusters per tile: number of partial sums per entry of a tile's list
  std::uint32_t share;       // lanes that load one splat each and exchange them by shuffles; 1: every lane loads all
  std::uint32_t sort_lanes;  // per tile of the sorting passes
  std::uint32_t sort_share;  // lanes of these that load one key each and exchange them by shuffles
  std::uint32_t rank_limit;
  std::uint32_t color_lanes;                // per work group (one subgroup) of the passes over colors
  std::uint32_t color_columns, color_rows;  // part of a tile that each of them covers
};

// `tile` is the tile's side in px, `subgroup_size` the number of lanes of every subgroup, or without `one_size` the
// least.
constexpr TileLanes tile_lanes(std::uint32_t tile, std::uint32_t pixels_per_lane, std::uint32_t subgroup_size,
                               bool one_size, bool software) {
  TileLanes out{};
  subgroup_size = std::max(1u, subgroup_size);
  out.lanes = tile * tile / pixels_per_lane;
  out.subgroup = std::min(out.lanes, subgroup_size);
  out.slots = out.lanes / out.subgroup;
  // a software device loads lane by lane, so its lanes share the loads; a GPU loads one address for all lanes at once
  out.share = software ? out.subgroup : 1;
  // one subgroup per tile: no lane waits at a barrier for another subgroup
  out.sort_lanes = software ? 8 : 32;
  out.sort_share = std::min(out.sort_lanes, subgroup_size);
  // only where no subgroup would have lanes of two tiles
  const bool whole = one_size && out.lanes % subgroup_size == 0 && out.sort_lanes % subgroup_size == 0;
  const std::uint32_t most = std::max(1u, kSoftwareLanes / std::max(out.lanes, out.sort_lanes));
  out.tiles = software && whole ? std::min(kSoftwareTiles, most) : 1;
  out.rank_limit = software ? kSoftwareRankLimit : kRankLimit;
  out.color_lanes = std::min(subgroup_size, tile * tile);
  out.color_columns = std::max(1u, tile / out.color_lanes);
  out.color_rows = tile * tile / (out.color_lanes * out.color_columns);
  return out;
}

struct SceneView {
  double fx = 0, fy = 0, cx = 0, cy = 0;  // px, of the crop
  double limit_x = 0, limit_y = 0;        // bounds of |x/z| and |y/z| in the projection's Jacobian
  math::Vector3 gain, bias;               // capture::Camera's
  double white = 0;                       // color at which its pixels are cut off
  int width = 0, height = 0, tiles_x = 0, tiles_y = 0;
  math::Pose camera_from_world;
  std::vector<math::Pose> motions;
  // what it should show, of one of the two kinds: RGBA8 of the crop, or without its black pixels; neither: not known
  const std::vector<std::uint8_t>* target = nullptr;
  const capture::PackedView* packed_target = nullptr;
  std::vector<std::uint32_t> active;  // grid cells of the active tiles
  std::size_t near = 0;               // the first `near` of them also have the D-SSIM term
};

// Parameters and views that belong together: those of the training, or those of one call.
struct Scene {
  int count = 0, links = 0, degree = 0;
  Light light;
  double pixel_footprint = 0.0;
  Buffer parameters, gradient, first_moment, second_moment, target;
  std::vector<SceneView> views;
  std::size_t parameter_count = 0;
  double normalizer = 1.0;
  int step = 0;
  // of the parameters and of the link logits among them, unique among all scenes of an engine
  std::uint64_t version = 0, link_version = 0;
  int coefficients() const { return (degree + 1) * (degree + 1); }
};

// Which tiles of a view are active.
enum class Active { in_mask, near_mask, everywhere, everywhere_dssim_near_mask };

struct RunOptions {
  LossWeights weights;
  double color_scale = 0.0;         // factor that turns sums over pixels and channels into means
  double mask_scale = 0.0;          // factor that turns sums over pixels into means
  bool loss = false, sums = false;  // there are targets; the loss is also read back
  // `accumulate` adds the gradient to that of the chunks before
  bool backward = false, twists = false, depth = false, accumulate = false;
  bool held_links = false;              // leaves out the gradient by link logits
  const chain::Chain* chain = nullptr;  // if not null, forms the normal equations of the colors; needs `depth`
};

struct ViewSums {
  double l1 = 0, mask = 0, squared = 0, object = 0, dssim = 0;
};

// One submission: a chunk of the views of a scene, laid out for the device.
struct Submission {
  Scene& scene;
  const RunOptions& options;
  std::uint32_t views = 0;
  std::uint32_t tiles = 0, near_tiles = 0;  // active tiles of all views; the first near_tiles also have a D-SSIM term
  std::uint32_t most_tiles = 0;             // largest number of active tiles of a view
  std::size_t pixels = 0;                   // of all views
  std::size_t replicas = 0, pairs = 0;      // Gaussians x links; capacity for live replicas x views
  bool own_places = false;                  // every tile's list has a fixed place; else prefix sums lay them out
  bool dssim = false;
  SplatPush push{};
};

// Calls visit(values, first) for each kind of parameter: its floats, and where they begin in the device's buffer.
template <class G, class Visit>
void each_section(G& g, const Visit& visit) {
  const auto n = static_cast<std::uint32_t>(g.count), coefficients = static_cast<std::uint32_t>(g.sh_coefficients());
  visit(g.mean, shared::at_mean(n, 0));
  visit(g.rotation, shared::at_rotation(n, 0));
  visit(g.log_scale, shared::at_log_scale(n, 0));
  visit(g.opacity_logit, shared::at_opacity(n, 0));
  visit(g.sh, shared::at_sh(n, coefficients, 0));
  visit(g.link_logits, shared::at_link(n, coefficients, static_cast<std::uint32_t>(g.links), 0));
}

// Parameters as one array, as in the device's buffer (shared/gaussian.h), and back.
std::vector<float> packed(const Gaussians& gaussians);
Gaussians unpacked(const std::vector<float>& all, int count, int links, int degree);

template <class T>
std::span<const std::byte> bytes_of(const std::vector<T>& values) {
  return std::as_bytes(std::span(values));
}

struct Engine::State {
  gpu::Device& device;
  std::uint32_t tile_width, tile_height, pixels_per_lane;
  std::uint32_t group_tiles, slots;  // TileLanes::tiles, slots
  double clamp_margin;               // of the projection's Jacobian, as a multiple of the half image
  std::size_t range_limit;           // bytes of one storage buffer

  // gather_onto adds to the gradient of the chunks before
  gpu::Pipeline replicate, compact, scan_block, scan_sums, project, bin, sort, sort_long, blend, blend_depth,
      blend_backward, project_backward, gather, gather_onto, link_twist, adam, loss_pixel, ssim_rows, ssim_columns,
      ssim_rows_backward, ssim_columns_backward, color_pixels, color_equations;
  gpu::Commands commands;
  gpu::Bindings bindings;  // of the pipelines to the buffers below; bind() and scan() change what some names stand for

  // Small transfers are recorded into the submission that they belong to. Where device memory is not mapped, they go
  // through these two buffers.
  Buffer to_device, to_host;
  struct Upload {
    Buffer* to = nullptr;
    std::vector<std::byte> data;
  };
  std::vector<Upload> uploads;  // for the next submission
  std::size_t to_host_bytes = 0;

  // Work buffers, grown as needed. The shaders declare them by the names of these members; those of the second list
  // have a size that depends on the number of views in a submission.
  // clang-format off
#define REPLICA_BUFFERS(X) \
  X(counters) X(replica_share) X(live_flag) X(live_prefix) X(live_block) X(live) X(replica_gradient)
#define VIEW_BUFFERS(X)                                                                             \
  X(views) X(motions) X(tile_map) X(tiles)                                                          \
  X(splats) X(instance_count) X(tile_hits) X(instance_prefix) X(instance_block) X(records)          \
  X(link_twists) X(tile_count) X(tile_prefix) X(tile_block) X(tile_cursor) X(tile_used)             \
  X(tile_loss) X(entries) X(long_tiles) X(sort_scratch) X(sorted) X(instance_place) X(partials)     \
  X(image) X(depth_image) X(pixel_gradient) X(ssim_row_sums) X(ssim_factors) X(color_views) X(segments)      \
  X(tile_pixels) X(tile_summary) X(pixel_sums) X(link_sums)
#define MEMBER(buffer) Buffer buffer;
  REPLICA_BUFFERS(MEMBER) VIEW_BUFFERS(MEMBER)
      // clang-format on
      ColorPush color_push{};
  std::size_t pixel_sum_bytes = 0, link_sum_bytes = 0;
  const std::byte *read_pixel_sums = nullptr, *read_link_sums = nullptr;  // of the last run
  Buffer list_starts, list_blocks;  // replace tile_prefix and tile_block where every list has a fixed place
  std::uint32_t live_capacity = 0, instance_capacity = 0, tile_capacity = 0;
  std::uint32_t splat_capacity = kSplatCapacity;
  bool lists_may_have_places = true;                            // false: memory is too short for that
  std::uint64_t versions = 0;                                   // number of parameter versions so far, of all scenes
  std::tuple<std::uint64_t, bool, std::uint32_t> replicated{};  // version, held links and capacity of the live replicas
  int not_finite = 0;                                           // gradients of the last run that Adam skipped
  int most_views = 1 << 20;  // per submission; lowered when a buffer would exceed the device's limit
  std::vector<gpu::Timing> timings;

  Scene training, scratch;

  // of the last run, for reading back
  std::vector<std::uint32_t> chunk_tile_view;
  std::vector<std::size_t> chunk_pixel;

  State(gpu::Device& d, const Settings& settings);

  // buffers.cpp
  void need(Buffer& buffer, std::size_t bytes, const char* name);  // grows it if too small, which loses its content
  void release_view_buffers();  // frees all buffers whose size depends on the number of views in a submission
  void write(Buffer& buffer, std::span<const std::byte> data, const char* name);
  void stage(Buffer& buffer, std::span<const std::byte> data, const char* name);  // as part of the next submission
  void record_uploads();
  // Sets `count` 32-bit words from word `first` on: by the host where the buffer is mapped, else by a recorded command
  // that the next dispatch waits for.
  void fill(Buffer& buffer, std::uint32_t value, std::size_t first, std::size_t count);
  // Returns where the first `bytes` of a buffer can be read after the submission; `to_host` must be large enough.
  const std::byte* record_download(const Buffer& buffer, std::size_t bytes);
  void set_tile_capacity(std::uint32_t capacity);
  // Tiles that one submission may have if every list is to have a fixed place; 0: lists are always contiguous.
  std::size_t most_placed_tiles(const RunOptions& options) const;

  // scene.cpp
  void load_gaussians(Scene& scene, const Gaussians& gaussians);
  void load_views(Scene& scene, std::span<const ViewSpec> specs,
                  std::span<const std::vector<std::uint8_t>* const> targets,
                  std::span<const capture::PackedView* const> packed_targets, Active active);
  // Splits a batch into chunks of one submission each, bounded by the device's buffer ranges and group counts.
  std::vector<std::vector<int>> chunks(const Scene& scene, std::span<const int> batch, const RunOptions& options) const;

  // passes.cpp: the steps of one submission, in this order
  Submission lay_out(Scene& scene, std::span<const int> chunk, const RunOptions& options);
  // Parts of lay_out(): cameras, link motions and places in the buffers; targets; active tiles; axes of the links, for
  // colors.
  std::vector<SplatView> stage_views(Submission& submission, std::span<const int> chunk);
  void stage_targets(const Submission& submission, std::span<const int> chunk);
  void stage_tiles(Submission& submission, std::span<const int> chunk, const std::vector<SplatView>& placed);
  void stage_axes(const Scene& scene, std::span<const int> chunk, const chain::Chain& chain);
  bool make_room(Submission& submission);             // false: too many views for one submission
  void bind(const Submission& submission);            // the buffers of its scene and of its lists
  void record_lists(const Submission& submission);    // the splats of every tile, front to back
  void record_picture(const Submission& submission);  // the pictures and their loss
  void record_gradients(const Submission& submission);
  void record_adam(const Submission& submission, const AdamPush& push);
  void record_colors(const Submission& submission);
  bool has_fitted(const Submission& submission, const std::byte* read_counters);  // false: it raised the capacities
  // Runs all these steps. False: a capacity was too small and has been raised; the caller plans and runs again.
  bool run(Scene& scene, std::span<const int> chunk, const RunOptions& options, const AdamPush* adam_push);
  void scan(const Buffer& values, const Buffer& prefix, const Buffer& block, SplatPush push, std::size_t most);
  void dispatch(const gpu::Pipeline& pipeline, const SplatPush& push, std::uint32_t x, std::uint32_t y = 1);
  // One after the other of all tiles, group_tiles of them in a work group.
  void dispatch_tiles(const gpu::Pipeline& pipeline, const SplatPush& push);
  // One invocation per (live replica, view): the group counts are counters of the device.
  void dispatch_live(const gpu::Pipeline& pipeline, const SplatPush& push);

  // Runs a batch in chunks; `after` gets each chunk that was run and the number of views of the batch before it.
  void run_all(Scene& scene, std::span<const int> batch, const RunOptions& options, const AdamPush* adam_push,
               const std::function<void(std::span<const int> chunk, std::size_t done)>& after);
  std::vector<Picture> draw(Scene& scene, std::span<const int> batch, bool depth);

  // read_back.cpp: results of the last submission
  std::vector<float> trained(const Buffer& buffer) const;  // the training's parameters, or a moment of all of them
  std::vector<ViewSums> sums(std::size_t chunk_views);
  std::vector<Picture> pictures(const Scene& scene, std::span<const int> chunk, bool depth);
  std::vector<math::MatrixX> twists(const Scene& scene, std::span<const int> chunk);
  std::vector<ColorSums> colors(const Scene& scene, std::span<const int> chunk, const chain::Chain& chain);
};

}  // namespace chainsplat::splat
