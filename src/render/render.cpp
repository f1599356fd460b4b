#include "chainsplat/render.h"

#include <algorithm>
#include <cmath>

#include "src/render/reach.h"

namespace chainsplat::render {

using math::Rectangle;
using math::Vector2;

namespace {

constexpr std::size_t kBatchPixels = 2u << 20;   // per batch: 32 MiB of float colors, several dozen frames of a rope
constexpr std::size_t kImagePixels = 32u << 20;  // of a batch's whole images, which its user may make all at once
constexpr int kBorderStep = 8;                   // px between the border points that bound a warped rectangle
constexpr double kTimeSlack = 1e-9;              // s; covers the rounding of frame times
constexpr float kSolid = 0.5f;                   // least alpha of the object (formats.md 5.4)

Rectangle image_of(const capture::Camera& camera) { return {0, 0, camera.width, camera.height}; }

// The rectangle that encloses the image of the border of `bounds` under `map`.
template <class Map>
Rectangle mapped(const Rectangle& bounds, Map map) {
  Vector2 low(1e9, 1e9), high(-1e9, -1e9);
  const auto include = [&](double x, double y) {
    const Vector2 p = map(Vector2(x, y));
    low = low.cwiseMin(p);
    high = high.cwiseMax(p);
  };
  for (int x = bounds.x0; x < bounds.x1 + kBorderStep; x += kBorderStep)
    for (const int y : {bounds.y0, bounds.y1}) include(std::min(x, bounds.x1), y);
  for (int y = bounds.y0; y < bounds.y1 + kBorderStep; y += kBorderStep)
    for (const int x : {bounds.x0, bounds.x1}) include(x, std::min(y, bounds.y1));
  return {static_cast<int>(std::floor(low.x())), static_cast<int>(std::floor(low.y())),
          static_cast<int>(std::ceil(high.x())), static_cast<int>(std::ceil(high.y()))};
}

// The position of every recorded pixel's center in the undistorted image; made once per camera.
struct Lens {
  bool active = false;
  Rectangle field_of_view;        // undistorted rectangle that encloses the whole recorded image
  std::vector<Vector2> straight;  // width x height, undistorted px
};

Lens make_lens(const capture::Camera& camera, bool undistorted) {
  Lens lens;
  lens.active = camera.distorted() && !undistorted;
  lens.field_of_view = image_of(camera);
  if (!lens.active) return lens;
  lens.field_of_view =
      grown(mapped(image_of(camera), [&](const Vector2& p) { return capture::undistort(camera, p); }), 1);
  lens.straight.resize(static_cast<std::size_t>(camera.width) * camera.height);
  core::parallel_for(camera.height, [&](std::int64_t y) {
    for (int x = 0; x < camera.width; ++x)
      lens.straight[static_cast<std::size_t>(y) * camera.width + x] =
          capture::undistort(camera, {x + 0.5, static_cast<double>(y) + 0.5});
  });
  return lens;
}

// Warps the picture of the undistorted rectangle `drawn` to the recorded pixels of `crop`. Colors are interpolated
// bilinearly, black outside; depth is that of the nearest pixel, because a mean across an edge lies on no surface.
splat::Picture warp(const splat::Picture& from, const Rectangle& drawn, const Rectangle& crop, const Lens& lens,
                    int image_width) {
  splat::Picture to;
  to.width = crop.x1 - crop.x0;
  to.height = crop.y1 - crop.y0;
  const std::size_t pixels = static_cast<std::size_t>(to.width) * to.height;
  to.rgba.assign(4 * pixels, 0.0f);
  if (!from.depth.empty()) to.depth.assign(pixels, 0.0f);
  const auto inside = [&](int x, int y) { return x >= 0 && y >= 0 && x < from.width && y < from.height; };
  for (int y = 0; y < to.height; ++y) {
    for (int x = 0; x < to.width; ++x) {
      // where the pixel lies in the drawn picture
      const Vector2& position = lens.straight[static_cast<std::size_t>(crop.y0 + y) * image_width + crop.x0 + x];
      const double u = position.x() - drawn.x0 - 0.5, v = position.y() - drawn.y0 - 0.5;
      const int x0 = static_cast<int>(std::floor(u)), y0 = static_cast<int>(std::floor(v));
      if (x0 < -1 || y0 < -1 || x0 >= from.width || y0 >= from.height) continue;
      const std::size_t out = static_cast<std::size_t>(y) * to.width + x;
      const float fx = static_cast<float>(u - x0), fy = static_cast<float>(v - y0);
      const float weights[4] = {(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy};
      for (int k = 0; k < 4; ++k) {
        const int column = x0 + k % 2, row = y0 + k / 2;
        if (!inside(column, row)) continue;
        const float* const sample = &from.rgba[4 * (static_cast<std::size_t>(row) * from.width + column)];
        for (int c = 0; c < 4; ++c) to.rgba[4 * out + c] += weights[k] * sample[c];
      }
      const int column = static_cast<int>(std::floor(u + 0.5)), row = static_cast<int>(std::floor(v + 0.5));
      if (!to.depth.empty() && inside(column, row))
        to.depth[out] = from.depth[static_cast<std::size_t>(row) * from.width + column];
    }
  }
  return to;
}

template <class Copy>  // copy(pixel of the crop, pixel of the image)
void paste(const Frame& frame, const capture::Camera& camera, Copy copy) {
  for (int y = 0; y < frame.picture.height; ++y)
    for (int x = 0; x < frame.picture.width; ++x)
      copy(static_cast<std::size_t>(y) * frame.picture.width + x,
           static_cast<std::size_t>(frame.y0 + y) * camera.width + frame.x0 + x);
}

}  // namespace

double median_interval(const std::vector<double>& times) {
  std::vector<double> intervals;
  for (std::size_t k = 1; k < times.size(); ++k) intervals.push_back(times[k] - times[k - 1]);
  return math::median(intervals);
}

bool covered(const chain::States& states, double time, double interval) {
  if (states.time.empty()) return false;
  const double slack = 0.5 * interval + kTimeSlack;
  return time >= states.time.front() - slack && time <= states.time.back() + slack;
}

void for_batches(splat::Engine& engine, const splat::Gaussians& gaussians, const chain::Chain& chain,
                 const chain::States& states, const trajectory::Trajectory& base, const capture::Camera& camera,
                 int camera_index, const std::vector<double>& times, const Options& options,
                 const std::function<void(std::vector<Frame>& batch)>& use) {
  const double interval = options.interval > 0.0 ? options.interval : median_interval(times);
  const Lens lens = make_lens(camera, options.undistorted);
  const std::vector<Replica> replicas = visible_replicas(gaussians);

  // plan every frame that the states cover: link motions and the rectangles to draw and to return
  struct Plan {
    Frame frame;
    Rectangle drawn, crop;  // undistorted and recorded pixels
    std::vector<math::Pose> motions;
  };
  std::vector<Plan> plans;
  for (std::size_t k = 0; k < times.size(); ++k) {
    if (!covered(states, times[k], interval)) continue;
    Plan plan;
    plan.frame.camera = camera_index;
    plan.frame.frame = static_cast<int>(k);
    plan.frame.time = times[k];
    plans.push_back(std::move(plan));
  }
  core::parallel_for(static_cast<std::int64_t>(plans.size()), [&](std::int64_t k) {
    Plan& plan = plans[k];
    plan.motions = chain::material_motions(chain, states, plan.frame.time, base.pose(plan.frame.time));
    const Rectangle content = intersection(reach(replicas, gaussians.pixel_footprint, plan.motions, camera),
                                           grown(lens.field_of_view, options.margin));
    if (content.empty()) return;
    const auto to_recorded = [&](const Vector2& p) { return capture::distort(camera, p); };
    plan.drawn = lens.active ? content : intersection(grown(content, options.margin), image_of(camera));
    plan.crop = lens.active ? intersection(
                                  grown(mapped(intersection(content, lens.field_of_view), to_recorded), options.margin),
                                  image_of(camera))
                            : plan.drawn;
    if (plan.crop.empty()) plan.drawn = plan.crop = {};
  });

  // draw as many frames at a time as a batch may hold
  for (std::size_t first = 0; first < plans.size();) {
    std::size_t last = first, pixels = 0;
    std::vector<splat::ViewSpec> views;
    std::vector<std::size_t> of_view;
    const std::size_t most =
        std::max<std::size_t>(1, kImagePixels / (static_cast<std::size_t>(camera.width) * camera.height));
    for (; last < std::min(plans.size(), first + most) && pixels < kBatchPixels; ++last) {
      const Plan& plan = plans[last];
      if (plan.drawn.empty()) continue;
      const int width = plan.drawn.x1 - plan.drawn.x0, height = plan.drawn.y1 - plan.drawn.y0;
      views.push_back({&camera, plan.drawn.x0, plan.drawn.y0, width, height, plan.motions});
      of_view.push_back(last);
      pixels += static_cast<std::size_t>(width) * height;
    }
    std::vector<splat::Picture> pictures;
    if (!views.empty()) pictures = engine.draw(gaussians, views, options.depth);
    std::vector<Frame> batch;
    for (std::size_t k = first; k < last; ++k) {
      plans[k].frame.x0 = plans[k].crop.x0;
      plans[k].frame.y0 = plans[k].crop.y0;
      batch.push_back(std::move(plans[k].frame));
    }
    core::parallel_for(static_cast<std::int64_t>(of_view.size()), [&](std::int64_t v) {
      const Plan& plan = plans[of_view[v]];
      splat::Picture& picture = batch[of_view[v] - first].picture;
      picture = lens.active ? warp(pictures[v], plan.drawn, plan.crop, lens, camera.width) : std::move(pictures[v]);
    });
    use(batch);
    first = last;
  }
}

std::vector<Frame> frames(splat::Engine& engine, const splat::Gaussians& gaussians, const chain::Chain& chain,
                          const chain::States& states, const trajectory::Trajectory& base,
                          const capture::Camera& camera, int camera_index, const std::vector<double>& times,
                          const Options& options) {
  std::vector<Frame> out;
  for_batches(engine, gaussians, chain, states, base, camera, camera_index, times, options,
              [&](std::vector<Frame>& batch) { std::move(batch.begin(), batch.end(), std::back_inserter(out)); });
  return out;
}

namespace {

void paste_color(const Frame& frame, const capture::Camera& camera, std::uint8_t* rgb) {
  paste(frame, camera, [&](std::size_t from, std::size_t to) {
    for (int c = 0; c < 3; ++c)
      rgb[3 * to + c] =
          static_cast<std::uint8_t>(std::lround(255.0f * std::clamp(frame.picture.rgba[4 * from + c], 0.0f, 1.0f)));
  });
}

void paste_mask(const Frame& frame, const capture::Camera& camera, std::uint8_t* mask) {
  paste(frame, camera,
        [&](std::size_t from, std::size_t to) { mask[to] = frame.picture.rgba[4 * from + 3] >= kSolid ? 255 : 0; });
}

void paste_depth(const Frame& frame, const capture::Camera& camera, float* depth) {
  if (frame.picture.depth.empty()) return;
  paste(frame, camera, [&](std::size_t from, std::size_t to) { depth[to] = frame.picture.depth[from]; });
}

}  // namespace

capture::Image8 color_image(const Frame& frame, const capture::Camera& camera) {
  capture::Image8 image{camera.width, camera.height, 3, {}};
  image.pixels.assign(3u * camera.width * camera.height, 0);
  paste_color(frame, camera, image.pixels.data());
  return image;
}

capture::Image8 mask_image(const Frame& frame, const capture::Camera& camera) {
  capture::Image8 image{camera.width, camera.height, 1, {}};
  image.pixels.assign(static_cast<std::size_t>(camera.width) * camera.height, 0);
  paste_mask(frame, camera, image.pixels.data());
  return image;
}

std::vector<float> depth_image(const Frame& frame, const capture::Camera& camera) {
  std::vector<float> image(static_cast<std::size_t>(camera.width) * camera.height, 0.0f);
  paste_depth(frame, camera, image.data());
  return image;
}

Images images(splat::Engine& engine, const splat::Gaussians& gaussians, const chain::Chain& chain,
              const chain::States& states, const trajectory::Trajectory& base, const capture::Camera& camera,
              const std::vector<double>& times, const Options& options) {
  Images out{static_cast<int>(times.size()), camera.width, camera.height, {}, {}, {}};
  const std::size_t pixels = static_cast<std::size_t>(camera.width) * camera.height;
  out.rgb.resize(3 * pixels * times.size());
  out.mask.resize(pixels * times.size());
  if (options.depth) out.depth.resize(pixels * times.size());
  for_batches(engine, gaussians, chain, states, base, camera, 0, times, options, [&](std::vector<Frame>& batch) {
    core::parallel_for(static_cast<std::int64_t>(batch.size()), [&](std::int64_t k) {
      const Frame& frame = batch[static_cast<std::size_t>(k)];
      const std::size_t first = pixels * static_cast<std::size_t>(frame.frame);
      paste_color(frame, camera, &out.rgb[3 * first]);
      paste_mask(frame, camera, &out.mask[first]);
      if (options.depth) paste_depth(frame, camera, &out.depth[first]);
    });
  });
  return out;
}

}  // namespace chainsplat::render
