// scene.cpp - loads Gaussians and views: decides which tiles are active and which views go into one submission.
#include <algorithm>
#include <limits>

#include "chainsplat/image_model.h"
#include "src/splat/engine.h"

namespace chainsplat::splat {

namespace {

constexpr int kActiveMargin = 16;                          // px around the mask within which training has active tiles
constexpr int kDssimMargin = 2 * image_model::kSsimReach;  // px around the mask with a D-SSIM term
constexpr std::uint32_t kMostTiles = 60000;  // per submission; below every device's limit of work groups (65535)

// Per grid cell, whether it has a mask pixel within each of two margins (px); `inner` <= `outer`.
struct Nearness {
  std::vector<bool> inner, outer;
};

Nearness near_mask(const SceneView& view, const std::vector<std::uint8_t>& rgba, int tile_width, int tile_height,
                   int inner, int outer) {
  // a summed-area table of the mask
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

// Per grid cell, whether it has a mask pixel.
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

}  // namespace

std::vector<float> packed(const Gaussians& g) {
  std::vector<float> all;
  each_section(g, [&](const std::vector<float>& values, std::size_t first) {
    all.resize(first);
    all.insert(all.end(), values.begin(), values.end());
  });
  return all;
}

Gaussians unpacked(const std::vector<float>& all, int count, int links, int degree) {
  Gaussians g;
  g.resize(count, links, degree);
  each_section(g, [&](std::vector<float>& values, std::size_t first) {
    std::copy_n(all.begin() + static_cast<std::ptrdiff_t>(first), values.size(), values.begin());
  });
  return g;
}

void Engine::State::load_gaussians(Scene& scene, const Gaussians& gaussians) {
  scene.count = gaussians.count;
  scene.links = gaussians.links;
  scene.degree = gaussians.degree;
  scene.light = gaussians.light;
  scene.pixel_footprint = gaussians.pixel_footprint;
  const std::vector<float> all = packed(gaussians);
  scene.parameter_count = all.size();
  scene.step = 0;
  scene.version = scene.link_version = ++versions;
  write(scene.parameters, bytes_of(all), "parameters");
  need(scene.gradient, all.size() * sizeof(float), "gradient");
}

double recorded_white(const capture::Camera& camera) {
  constexpr double kNone = std::numeric_limits<float>::max();
  return camera.gain == math::Vector3::Ones() && camera.bias.isZero(0.0) ? kNone : 1.0;
}

void Engine::State::load_views(Scene& scene, std::span<const ViewSpec> specs,
                               std::span<const std::vector<std::uint8_t>* const> targets,
                               std::span<const capture::PackedView* const> packed_targets, Active active) {
  scene.views.clear();
  double object_pixels = 0.0;
  for (std::size_t v = 0; v < specs.size(); ++v) {
    const ViewSpec& spec = specs[v];
    SceneView view;

    // camera of the crop, grid of tiles, target
    view.fx = spec.camera->fx;
    view.fy = spec.camera->fy;
    view.cx = spec.camera->cx - spec.x0;
    view.cy = spec.camera->cy - spec.y0;
    view.limit_x = clamp_margin * 0.5 * spec.camera->width / view.fx;
    view.limit_y = clamp_margin * 0.5 * spec.camera->height / view.fy;
    view.gain = spec.camera->gain;
    view.bias = spec.camera->bias;
    view.white = recorded_white(*spec.camera);
    view.width = spec.width;
    view.height = spec.height;
    view.tiles_x = (spec.width + static_cast<int>(tile_width) - 1) / static_cast<int>(tile_width);
    view.tiles_y = (spec.height + static_cast<int>(tile_height) - 1) / static_cast<int>(tile_height);
    view.camera_from_world = spec.camera->world_from_camera.inverse();
    view.motions = spec.motions;
    std::vector<std::uint8_t> whole;  // of a packed target, only here
    const std::vector<std::uint8_t>* target = nullptr;
    if (!targets.empty()) target = view.target = targets[v];
    if (!packed_targets.empty()) {
      view.packed_target = packed_targets[v];
      whole = capture::unpacked(*view.packed_target).rgba;
      target = &whole;
    }
    if (target) {
      CHAINSPLAT_CHECK(target->size() == 4u * spec.width * spec.height, std::to_string(target->size()));
      if (active != Active::in_mask)
        for (std::size_t k = 3; k < target->size(); k += 4)
          object_pixels += (*target)[k] >= image_model::kObjectMask ? 1.0 : 0.0;
    }

    // active tiles, those with a D-SSIM term first
    const auto cells = static_cast<std::size_t>(view.tiles_x) * view.tiles_y;
    Nearness near{std::vector<bool>(cells, true), std::vector<bool>(cells, true)};
    if (active == Active::in_mask) {
      near.inner = near.outer = in_mask(view, *target, static_cast<int>(tile_width), static_cast<int>(tile_height));
    } else if (target && active != Active::everywhere) {
      near = near_mask(view, *target, static_cast<int>(tile_width), static_cast<int>(tile_height), kDssimMargin,
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
  scene.normalizer = std::max(1.0, object_pixels / std::max<std::size_t>(1, specs.size()));
}

std::vector<std::vector<int>> Engine::State::chunks(const Scene& scene, std::span<const int> batch,
                                                    const RunOptions& options) const {
  const bool dssim = options.loss && options.weights.dssim > 0.0f;
  // Pictures without a loss do not mind how many submissions draw them, if all of a view's lists can have fixed places.
  const std::size_t most_placed = gpu::info(device).software && !options.loss ? most_placed_tiles(options) : 0;
  const std::size_t most_pixels = range_limit / sizeof(glm::vec4);
  // the row sums of D-SSIM are the largest of the buffers that are laid out tile by tile
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
        (most_placed > 0 && tile_total <= most_placed && tile_total + view.active.size() > most_placed) ||
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

}  // namespace chainsplat::splat
