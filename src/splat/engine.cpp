// engine.cpp - the functions of Engine, each a choice of options for the same passes.
#include <algorithm>
#include <array>
#include <cmath>
#include <numeric>
#include <utility>

#include "chainsplat/image_model.h"
#include "src/splat/engine.h"

namespace chainsplat::splat {

namespace {

constexpr float kBeta1 = 0.9f, kBeta2 = 0.999f, kEpsilon = 1e-15f;  // Adam, as in 3DGS

std::vector<int> everything(std::size_t count) {
  std::vector<int> all(count);
  std::iota(all.begin(), all.end(), 0);
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

Engine::State::State(gpu::Device& d, const Settings& settings) : device(d), commands(d) {
  const gpu::DeviceInfo& device_info = gpu::info(d);
  // lavapipe: one subgroup of 8 lanes per tile, with a column of 8 pixels per lane, because loads dominate the cost
  // there (design.md, 'The size of the work'); a GPU: one subgroup of 32 lanes per tile, with 2 pixels per lane
  const int tile = settings.tile > 0 ? settings.tile : 8;
  const int pixels = settings.pixels_per_lane > 0 ? settings.pixels_per_lane : device_info.software ? 8 : 2;
  CHAINSPLAT_CHECK(tile % pixels == 0, std::to_string(tile) + " " + std::to_string(pixels));
  tile_width = tile_height = static_cast<std::uint32_t>(tile);
  pixels_per_lane = static_cast<std::uint32_t>(pixels);
  const TileLanes laid_out = tile_lanes(tile_width, pixels_per_lane, device_info.subgroup_size,
                                        device_info.one_subgroup_size, device_info.software);
  const std::uint32_t lanes = laid_out.lanes, share = laid_out.share, color_lanes = laid_out.color_lanes;
  slots = laid_out.slots;
  group_tiles = laid_out.tiles;
  constexpr double kNoClamp = 1e6;
  clamp_margin = settings.projection_clamp ? image_model::kClampMargin : kNoClamp;
  range_limit = static_cast<std::size_t>(std::min<std::uint64_t>(device_info.max_storage_range, 1ull << 30));

#define NAMED(buffer) {#buffer, &(buffer)},
  // clang-format off
  bindings = {REPLICA_BUFFERS(NAMED) VIEW_BUFFERS(NAMED)  // and those that bind() and scan() set
              {"parameters", nullptr}, {"gradient", nullptr},
              {"first_moment", nullptr}, {"second_moment", nullptr}, {"target", nullptr},
              {"values", nullptr}, {"prefix", nullptr}, {"block_sum", nullptr}};
  // clang-format on

  // pipelines: splats, then losses, then colors
  const auto pass = [&](const char* shader, const std::vector<std::uint32_t>& constants,
                        std::size_t push_bytes = sizeof(SplatPush)) {
    return gpu::Pipeline(d, shader, bindings, push_bytes, constants);
  };
  const std::uint32_t cut = settings.exact_cutoffs ? 1 : 0;
  replicate = pass("splat_replicate", {cut});
  compact = pass("splat_compact", {});
  scan_block = pass("scan_block", {});
  scan_sums = pass("scan_sums", {});
  project = pass("splat_project", {cut, tile_width, tile_height, share});
  bin = pass("splat_bin", {});
  sort = pass("splat_sort",
              {laid_out.sort_lanes * group_tiles, laid_out.rank_limit, laid_out.sort_share, laid_out.sort_lanes});
  sort_long = pass("splat_sort_long", {laid_out.sort_lanes});
  blend = pass("splat_blend", {lanes * group_tiles, tile_width, tile_height, pixels_per_lane, cut, 0, share});
  blend_depth = pass("splat_blend", {lanes * group_tiles, tile_width, tile_height, pixels_per_lane, cut, 1, share});
  blend_backward = pass("splat_blend_backward",
                        {lanes * group_tiles, tile_width, tile_height, pixels_per_lane, cut, laid_out.subgroup, share});
  project_backward = pass("splat_project_backward", {share});
  gather = pass("splat_gather", {0});
  gather_onto = pass("splat_gather", {1});
  link_twist = pass("splat_link_twist", {});
  adam = pass("splat_adam", {}, sizeof(AdamPush));
  loss_pixel = pass("loss_pixel", {laid_out.sort_lanes, tile_width, tile_height});
  const std::vector<std::uint32_t> strips{lanes, tile_width, tile_height, pixels_per_lane};
  ssim_rows = pass("ssim_rows", strips);
  ssim_columns = pass("ssim_columns", strips);
  ssim_rows_backward = pass("ssim_rows_backward", strips);
  ssim_columns_backward = pass("ssim_columns_backward", strips);
  color_pixels = pass("color_pixels",
                      {color_lanes, tile_width, tile_height, color_lanes, laid_out.color_columns, laid_out.color_rows},
                      sizeof(ColorPush));
  color_equations = pass("color_equations", {color_lanes, tile_width, tile_height, color_lanes}, sizeof(ColorPush));
  need(counters, shared::kCounters * sizeof(std::uint32_t), "counters");
  set_tile_capacity(kTileCapacity);
}

void Engine::State::run_all(Scene& scene, std::span<const int> batch, const RunOptions& options,
                            const AdamPush* adam_push,
                            const std::function<void(std::span<const int>, std::size_t)>& after) {
  timings.clear();
  std::size_t done = 0;
  while (done < batch.size()) {
    // plan anew for every chunk: an overflow may have lowered most_views
    const std::vector<int> chunk = chunks(scene, batch.subspan(done), options).front();
    RunOptions with = options;
    with.accumulate = done > 0;
    const bool last = done + chunk.size() == batch.size();
    bool finished = false;
    try {
      finished = run(scene, chunk, with, last ? adam_push : nullptr);
    } catch (const gpu::OutOfMemory&) {
      // lists at fixed places hold 36 MiB, whatever is in them
      if (std::exchange(lists_may_have_places, false)) {
        release_view_buffers();
        continue;
      }
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

std::vector<Picture> Engine::State::draw(Scene& scene, std::span<const int> batch, bool depth) {
  RunOptions options;
  options.depth = depth;
  std::vector<Picture> out;
  run_all(scene, batch, options, nullptr, [&](std::span<const int> chunk, std::size_t) {
    for (Picture& picture : pictures(scene, chunk, depth)) out.push_back(std::move(picture));
  });
  return out;
}

Engine::Engine(gpu::Device& device, const Settings& settings) : state_(std::make_unique<State>(device, settings)) {}
Engine::~Engine() = default;
Engine::Engine(Engine&&) noexcept = default;

std::vector<Picture> Engine::draw(const Gaussians& gaussians, std::span<const ViewSpec> views, bool depth) {
  State& s = *state_;
  s.load_gaussians(s.scratch, gaussians);
  s.load_views(s.scratch, views, {}, {}, Active::everywhere);
  return s.draw(s.scratch, everything(views.size()), depth);
}

LossValues Engine::loss(const Gaussians& gaussians, std::span<const ViewSpec> views,
                        std::span<const std::vector<std::uint8_t>* const> targets, const LossWeights& weights,
                        double normalizer, Gradients* gradients, std::vector<Picture>* pictures) {
  State& s = *state_;
  s.load_gaussians(s.scratch, gaussians);
  s.load_views(s.scratch, views, targets, {}, Active::everywhere);
  LossValues values;
  if (gradients) gradients->link_twists.clear();
  // the means of crops of different sizes have different normalizers: one run per normalizer, summed here
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

void Engine::set_views(std::span<const ViewSpec> views, std::span<const capture::PackedView* const> targets,
                       bool everywhere) {
  state_->load_views(state_->training, views, {}, targets,
                     everywhere ? Active::everywhere_dssim_near_mask : Active::near_mask);
}

void Engine::set_motions(int view, const std::vector<math::Pose>& motions) {
  state_->training.views.at(view).motions = motions;
}

void Engine::set_gaussians(const Gaussians& gaussians) {
  const std::vector<float> zeros(packed(gaussians).size(), 0.0f);
  restore({gaussians, zeros, zeros, 0});
}

Gaussians Engine::gaussians() const {
  const Scene& scene = state_->training;
  Gaussians out = unpacked(state_->trained(scene.parameters), scene.count, scene.links, scene.degree);
  out.light = scene.light;
  out.pixel_footprint = scene.pixel_footprint;
  return out;
}

Gaussians Engine::gradient() const {
  const Scene& scene = state_->training;
  return unpacked(state_->trained(scene.gradient), scene.count, scene.links, scene.degree);
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

  // Adam's constants; held link logits are the last section of the parameters and are left out
  AdamPush push{};
  push.gaussians = static_cast<std::uint32_t>(scene.count);
  push.links = static_cast<std::uint32_t>(scene.links);
  push.coefficients = static_cast<std::uint32_t>(scene.coefficients());
  push.total = shared::at_link(push.gaussians, push.coefficients, push.links, options.held_links ? 0 : push.gaussians);
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
  return state_->draw(state_->training, batch, depth);
}

std::vector<ColorSums> Engine::color_sums(const chain::Chain& chain, std::span<const ViewSpec> views,
                                          std::span<const std::vector<std::uint8_t>* const> observed) {
  State& s = *state_;
  CHAINSPLAT_CHECK(chain.links() == s.training.links,
                   std::to_string(chain.links()) + " " + std::to_string(s.training.links));
  s.load_views(s.training, views, observed, {}, Active::in_mask);
  RunOptions options;
  options.depth = true;
  options.chain = &chain;
  std::vector<ColorSums> out;
  s.run_all(s.training, everything(views.size()), options, nullptr, [&](std::span<const int> chunk, std::size_t) {
    for (ColorSums& sums : s.colors(s.training, chunk, chain)) out.push_back(std::move(sums));
  });
  return out;
}

std::vector<Picture> Engine::draw_set(std::span<const ViewSpec> views, bool depth) {
  State& s = *state_;
  s.load_views(s.training, views, {}, {}, Active::everywhere);
  return s.draw(s.training, everything(views.size()), depth);
}

Engine::Snapshot Engine::snapshot() const {
  const Scene& scene = state_->training;
  return {gaussians(), state_->trained(scene.first_moment), state_->trained(scene.second_moment), scene.step};
}

void Engine::restore(const Snapshot& snapshot) {
  State& s = *state_;
  s.load_gaussians(s.training, snapshot.gaussians);
  CHAINSPLAT_CHECK(snapshot.first_moment.size() == s.training.parameter_count,
                   std::to_string(snapshot.first_moment.size()));
  s.write(s.training.first_moment, bytes_of(snapshot.first_moment), "first moment");
  s.write(s.training.second_moment, bytes_of(snapshot.second_moment), "second moment");
  s.training.step = snapshot.step;
}

void Engine::reset_opacity(float largest) {
  Snapshot now = snapshot();
  const float logit = std::log(largest / (1.0f - largest));
  for (float& value : now.gaussians.opacity_logit) value = std::min(value, logit);
  const auto count = static_cast<std::uint32_t>(now.gaussians.count);
  for (auto* moment : {&now.first_moment, &now.second_moment})
    std::fill_n(moment->begin() + shared::at_opacity(count, 0), count, 0.0f);
  restore(now);
}

void Engine::reset_links() {
  Snapshot now = snapshot();
  std::fill(now.gaussians.link_logits.begin(), now.gaussians.link_logits.end(), 0.0f);
  for (auto* moment : {&now.first_moment, &now.second_moment})
    std::fill(moment->end() - static_cast<std::ptrdiff_t>(now.gaussians.link_logits.size()), moment->end(), 0.0f);
  restore(now);
}

void Engine::change_gaussians(std::span<const int> kept, const Gaussians& added) {
  Snapshot now = snapshot();
  const int count = now.gaussians.count, links = now.gaussians.links, degree = now.gaussians.degree;
  CHAINSPLAT_CHECK(added.links == links && added.degree == degree, std::to_string(added.links));
  for (auto* moment : {&now.first_moment, &now.second_moment}) {
    Gaussians values = rows_of(unpacked(*moment, count, links, degree), kept, added.count);
    std::fill(values.rotation.end() - 4 * static_cast<std::ptrdiff_t>(added.count), values.rotation.end(), 0.0f);
    *moment = packed(values);
  }
  now.gaussians = rows_of(now.gaussians, kept, added.count);
  for (int i = 0; i < added.count; ++i) copy_row(added, i, now.gaussians, static_cast<int>(kept.size()) + i);
  restore(now);
}

std::vector<gpu::Timing> Engine::timings() const { return state_->timings; }

}  // namespace chainsplat::splat
