#include "chainsplat/eval.h"

#include <algorithm>
#include <array>
#include <atomic>
#include <cmath>
#include <limits>
#include <nlohmann/json.hpp>

#include "chainsplat/image_model.h"
#include "chainsplat/lpips.h"
#include "src/eval/depth_image.h"

namespace chainsplat::eval {

using image_model::kSsimReach;
using math::MatrixX;
using math::Rectangle;

namespace {

constexpr double kNone = std::numeric_limits<double>::quiet_NaN();
constexpr float kSolid = 0.5f;         // least 1 - T_end of the object
constexpr int kCenterlinePoints = 97;  // mathematics.md 9
constexpr double kSameTime = 1e-6;     // s; times closer than this are equal

// What holds both, grown by the reach of SSIM's window, within the image.
Rectangle compared(const Rectangle& a, const Rectangle& b, const capture::Camera& camera) {
  if (a.empty() && b.empty()) return {};
  return intersection(grown(enclosing(a, b), kSsimReach), {0, 0, camera.width, camera.height});
}

double psnr(double squared_sum, double count) {
  return std::min(kMostPsnr, -10.0 * std::log10(std::max(squared_sum / count, std::numeric_limits<double>::min())));
}

// True points at a time: a row of the file if there is one at this time, else a cubic between rows; none outside.
std::optional<MatrixX> true_points(const capture::TrueCenterline& truth, double time) {
  const int count = static_cast<int>(truth.time.size());
  const auto above = std::lower_bound(truth.time.begin(), truth.time.end(), time - kSameTime);
  const int i = static_cast<int>(above - truth.time.begin());
  if (i == count) return std::nullopt;
  if (std::abs(truth.time[i] - time) <= kSameTime) return truth.points[i];
  if (i == 0) return std::nullopt;
  const int a = i - 1, b = i;
  const double h = truth.time[b] - truth.time[a], u = (time - truth.time[a]) / h, u2 = u * u, u3 = u2 * u;
  const auto slope = [&](int k) -> MatrixX {  // m per interval h
    const int before = std::max(k - 1, 0), after = std::min(k + 1, count - 1);
    return (truth.points[after] - truth.points[before]) * (h / (truth.time[after] - truth.time[before]));
  };
  return (2 * u3 - 3 * u2 + 1) * truth.points[a] + (u3 - 2 * u2 + u) * slope(a) + (3 * u2 - 2 * u3) * truth.points[b] +
         (u3 - u2) * slope(b);
}

// `count` points along a polyline whose points (at least 2) are equally spaced in arclength.
MatrixX resampled(const MatrixX& points, int count) {
  MatrixX out(3, count);
  for (int i = 0; i < count; ++i) {
    const double s = static_cast<double>(points.cols() - 1) * i / (count - 1);
    const Eigen::Index k = std::min<Eigen::Index>(static_cast<Eigen::Index>(s), points.cols() - 2);
    const double u = s - static_cast<double>(k);
    out.col(i) = (1.0 - u) * points.col(k) + u * points.col(k + 1);
  }
  return out;
}

void compare_centerlines(FrameMetrics& metrics, const chain::Chain& chain, const chain::States& states,
                         const trajectory::Trajectory& base, const capture::TrueCenterline& truth) {
  const auto points = true_points(truth, metrics.time);
  if (!points || points->cols() < 2) return;
  const auto motions = chain::link_motions(chain, chain::interpolate(states, metrics.time), base.pose(metrics.time));
  const MatrixX ours = chain::centerline(chain, motions, chain::equal_arclengths(chain, kCenterlinePoints));
  const MatrixX offset = ours - resampled(*points, kCenterlinePoints);
  metrics.centerline_rms = std::sqrt(offset.colwise().squaredNorm().mean());
  metrics.tip_rms = offset.col(kCenterlinePoints - 1).norm();
  metrics.shape_rms = std::sqrt((offset.colwise() - offset.col(0)).colwise().squaredNorm().mean());
}

// LPIPS of two RGB images that are black outside of `area`, where they are given.
double lpips_in(const LpipsTrunk& trunk, const std::vector<float>& a, const std::vector<float>& b,
                const Rectangle& area, const capture::Camera& camera) {
  // what is not black in one of them
  Rectangle shown;
  for (int y = area.y0, k = 0; y < area.y1; ++y)
    for (int x = area.x0; x < area.x1; ++x, k += 3)
      if (a[k] > 0.0f || a[k + 1] > 0.0f || a[k + 2] > 0.0f || b[k] > 0.0f || b[k + 1] > 0.0f || b[k + 2] > 0.0f)
        shown = enclosing(shown, {x, y, x + 1, y + 1});
  if (shown.empty()) return 0.0;

  const Rectangle crop = lpips_crop(shown, camera.width, camera.height);
  const auto cropped = [&](const std::vector<float>& rgb) {
    std::vector<float> out(3u * crop.width() * crop.height(), 0.0f);
    for (int y = shown.y0; y < shown.y1; ++y)
      std::copy_n(rgb.begin() + 3 * (static_cast<std::ptrdiff_t>(area.width()) * (y - area.y0) + shown.x0 - area.x0),
                  3 * shown.width(),
                  out.begin() + 3 * (static_cast<std::ptrdiff_t>(crop.width()) * (y - crop.y0) + shown.x0 - crop.x0));
    return out;
  };
  return lpips(trunk, cropped(a), cropped(b), crop.width(), crop.height(), camera.width, camera.height);
}

struct Metric {
  const char* name;
  double FrameMetrics::*value;
  bool squared;  // averaged as root mean square
};
constexpr std::array kMetrics{
    Metric{"psnr", &FrameMetrics::psnr, false},
    Metric{"psnr_object", &FrameMetrics::psnr_object, false},
    Metric{"ssim", &FrameMetrics::ssim, false},
    Metric{"lpips", &FrameMetrics::lpips, false},
    Metric{"iou", &FrameMetrics::iou, false},
    Metric{"chamfer", &FrameMetrics::chamfer, false},
    Metric{"centerline_rms", &FrameMetrics::centerline_rms, true},
    Metric{"tip_rms", &FrameMetrics::tip_rms, true},
    Metric{"shape_rms", &FrameMetrics::shape_rms, true},
};

// Mean over the frames of one camera; camera < 0: of all.
FrameMetrics mean_of(const std::vector<FrameMetrics>& frames, int camera) {
  FrameMetrics mean;
  mean.camera = camera;
  for (const Metric& metric : kMetrics) {
    double sum = 0.0;
    int count = 0;
    for (const FrameMetrics& frame : frames) {
      const double value = frame.*metric.value;
      if ((camera >= 0 && frame.camera != camera) || std::isnan(value)) continue;
      sum += metric.squared ? value * value : value;
      ++count;
    }
    mean.*metric.value = count == 0 ? kNone : metric.squared ? std::sqrt(sum / count) : sum / count;
  }
  return mean;
}

}  // namespace

FrameMetrics compare(const render::Frame& drawn, const capture::View& view, const capture::Camera& camera,
                     const LpipsTrunk* trunk) {
  FrameMetrics metrics;
  metrics.camera = view.camera;
  metrics.frame = view.frame;
  metrics.time = view.time;
  metrics.chamfer = metrics.centerline_rms = metrics.tip_rms = metrics.shape_rms = kNone;

  // the area outside of which both pictures are black
  const splat::Picture& picture = drawn.picture;
  const Rectangle area = compared({view.x0, view.y0, view.x0 + view.width, view.y0 + view.height},
                                  {drawn.x0, drawn.y0, drawn.x0 + picture.width, drawn.y0 + picture.height}, camera);
  const int width = area.width(), height = area.height();
  std::vector<float> recorded(3u * width * height, 0.0f), rendered(3u * width * height, 0.0f);
  double squared = 0.0, object_squared = 0.0;
  std::int64_t object = 0, both = 0, either = 0;
  DepthImage true_depth{area.x0, area.y0, width, height, std::vector<float>(static_cast<std::size_t>(width) * height)};
  DepthImage depth = true_depth;

  // collect colors, depths and the counts of the masks, pixel by pixel
  for (int y = area.y0; y < area.y1; ++y) {
    for (int x = area.x0; x < area.x1; ++x) {
      const int vx = x - view.x0, vy = y - view.y0, px = x - drawn.x0, py = y - drawn.y0;
      const bool in_view = vx >= 0 && vy >= 0 && vx < view.width && vy < view.height;
      const bool in_picture = px >= 0 && py >= 0 && px < picture.width && py < picture.height;
      if (!in_view && !in_picture) continue;
      const std::size_t out = 3 * (static_cast<std::size_t>(width) * (y - area.y0) + x - area.x0);
      const std::size_t v = static_cast<std::size_t>(view.width) * vy + vx,
                        p = static_cast<std::size_t>(picture.width) * py + px;
      const bool in_mask = in_view && view.rgba[4 * v + 3] >= image_model::kObjectMask;
      const bool solid = in_picture && picture.rgba[4 * p + 3] >= kSolid;
      double difference = 0.0;
      for (int c = 0; c < 3; ++c) {
        const double a = in_view ? view.rgba[4 * v + c] / 255.0 : 0.0;
        const double b = in_picture ? std::clamp(static_cast<double>(picture.rgba[4 * p + c]), 0.0, 1.0) : 0.0;
        recorded[out + c] = static_cast<float>(a);
        rendered[out + c] = static_cast<float>(b);
        difference += (a - b) * (a - b);
      }
      squared += difference;
      if (in_mask) object_squared += difference;
      object += in_mask;
      both += in_mask && solid;
      either += in_mask || solid;
      if (in_mask && !view.depth.empty() && view.depth[v] > 0.0f) true_depth.depth[out / 3] = view.depth[v];
      if (solid && !view.depth.empty() && !picture.depth.empty() && picture.depth[p] > 0.0f)
        depth.depth[out / 3] = picture.depth[p];
    }
  }

  // metrics; means are over the full image
  const double full = static_cast<double>(camera.width) * camera.height;
  metrics.psnr = psnr(squared, 3.0 * full);
  metrics.psnr_object = object > 0 ? psnr(object_squared, 3.0 * static_cast<double>(object)) : kNone;
  metrics.ssim = ssim(rendered, recorded, width, height, full);
  metrics.lpips = trunk ? lpips_in(*trunk, rendered, recorded, area, camera) : kNone;
  metrics.iou = either > 0 ? static_cast<double>(both) / static_cast<double>(either) : 1.0;
  metrics.chamfer = chamfer(depth, true_depth, camera);
  return metrics;
}

Metrics evaluate(splat::Engine& engine, const splat::Gaussians& gaussians, const chain::Chain& chain,
                 const chain::States& states, const capture::Capture& recorded, const LpipsTrunk* trunk) {
  capture::require_pixels(recorded, capture::Pixels::recorded);
  for (const capture::Camera& camera : recorded.cameras)
    if (trunk && std::min(camera.width, camera.height) < kLeastLpipsSide)
      throw InputError(camera.name,
                       "images of " + std::to_string(camera.width) + "x" + std::to_string(camera.height) +
                           " pixels are too small for LPIPS, which needs " + std::to_string(kLeastLpipsSide) +
                           " a side",
                       "evaluate it without");
  const auto truth = capture::load_true_centerline(recorded.folder);
  Metrics metrics;
  // LPIPS takes tenths of a second a frame: only then is there something to see, and to stop
  std::atomic<std::int64_t> compared_frames = 0;
  const auto one_more = [&] {
    core::stop_if_requested();
    core::report({"evaluate", ++compared_frames, static_cast<std::int64_t>(recorded.views.size()), kNone, kNone,
                  "comparing, with LPIPS"});
  };

  // draw and compare the frames of each camera, a batch at a time
  for (int c = 0; c < static_cast<int>(recorded.cameras.size()); ++c) {
    const capture::Camera& camera = recorded.cameras[c];
    metrics.camera_names.push_back(camera.name);
    std::vector<const capture::PackedView*> views;
    std::vector<double> times;
    render::Options options;
    for (const capture::PackedView& view : recorded.views) {
      if (view.camera != c) continue;
      views.push_back(&view);
      times.push_back(view.time);
      options.depth |= !view.depth.empty();
    }
    options.interval = render::median_interval(recorded.times[c]);
    const std::size_t before = metrics.frames.size();
    render::for_batches(engine, gaussians, chain, states, recorded.base, camera, c, times, options,
                        [&](std::vector<render::Frame>& batch) {
                          core::stop_if_requested();
                          const std::size_t first = metrics.frames.size();
                          metrics.frames.resize(first + batch.size());
                          core::parallel_for(static_cast<std::int64_t>(batch.size()), [&](std::int64_t k) {
                            FrameMetrics& frame = metrics.frames[first + k];
                            frame = compare(batch[k], capture::unpacked(*views[batch[k].frame]), camera, trunk);
                            if (truth) compare_centerlines(frame, chain, states, recorded.base, *truth);
                            if (trunk) one_more();
                          });
                          for (std::size_t k = 0; k < batch.size(); ++k)
                            metrics.empty_clouds +=
                                !views[batch[k].frame]->depth.empty() && std::isnan(metrics.frames[first + k].chamfer);
                        });
    const std::size_t used = metrics.frames.size() - before;
    if (used < views.size())
      core::warn(camera.name + ": " + std::to_string(views.size() - used) + " of " + std::to_string(views.size()) +
                 " frames lie outside the states' times and are not evaluated");
  }
  if (metrics.frames.empty())
    throw InputError(recorded.folder.string(), "no frame lies within the states' times", "give states of this capture");
  if (metrics.empty_clouds > 0)
    core::warn("chamfer leaves out " + std::to_string(metrics.empty_clouds) + " frames without rendered or true depth");
  metrics.mean = mean_of(metrics.frames, -1);
  for (int c = 0; c < static_cast<int>(recorded.cameras.size()); ++c)
    metrics.cameras.push_back(mean_of(metrics.frames, c));
  return metrics;
}

std::string to_json(const Metrics& metrics) {
  using Json = nlohmann::ordered_json;
  const auto values = [](Json out, const FrameMetrics& frame) {
    for (const Metric& metric : kMetrics)
      if (std::isfinite(frame.*metric.value)) out[metric.name] = frame.*metric.value;
    return out;
  };
  Json out{{"mean", values(Json::object(), metrics.mean)}, {"cameras", Json::object()}, {"frames", Json::array()}};
  for (std::size_t c = 0; c < metrics.cameras.size(); ++c)
    out["cameras"][metrics.camera_names[c]] = values(Json::object(), metrics.cameras[c]);
  for (const FrameMetrics& frame : metrics.frames)
    out["frames"].push_back(
        values({{"camera", metrics.camera_names[frame.camera]}, {"frame", frame.frame}, {"time", frame.time}}, frame));
  if (metrics.empty_clouds > 0) out["empty_clouds"] = metrics.empty_clouds;
  return out.dump(1);
}

}  // namespace chainsplat::eval
