#include "chainsplat/recognition.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <sstream>

#include "src/math/decompositions.h"
#include "src/recognition/checkpoint.h"
#include "src/recognition/modes.h"

namespace chainsplat::recognition {

Result recognize(gpu::Device& device, const capture::Capture& capture, const Options& options) {
  capture::require_pixels(capture, capture::Pixels::undistorted);
  return options.mode == Mode::paper ? recognize_paper(device, capture, options)
                                     : recognize_fast(device, capture, options);
}

chain::Chain chain_of(const capture::Capture& capture, const Options& options, chain::Bending bending, int joints) {
  return chain::make_chain(capture.length, capture.diameter, capture.direction, capture.bending_axis, joints, bending,
                           options.twist);
}

std::string job_text(const capture::Capture& capture, const Options& options) {
  // what was recorded, view by view, and as it was loaded: masks and frames can be others than of the same capture.json
  const auto hashed = [](const auto& values, std::uint64_t hash) {
    return core::fnv1a({reinterpret_cast<const char*>(values.data()), values.size() * sizeof values[0]}, hash);
  };
  std::vector<std::uint64_t> pictures(capture.views.size());
  core::parallel_for(static_cast<std::int64_t>(pictures.size()), [&](std::int64_t v) {
    const capture::PackedView& view = capture.views[v];
    const std::uint64_t crop = hashed(std::array{view.x0, view.y0, view.width, view.height}, core::fnv1a(""));
    pictures[v] = hashed(view.rgba, hashed(view.runs, crop));
  });
  std::vector<double> times;
  std::vector<std::string> ranges;  // of each camera, as --frames names them
  for (std::size_t v = 0; v < capture.views.size(); ++v) {
    const capture::ViewPlace& view = capture.views[v];
    times.push_back(view.time);
    if (v == 0 || capture.views[v - 1].camera != view.camera) ranges.push_back(std::to_string(view.frame));
    if (v + 1 == capture.views.size() || capture.views[v + 1].camera != view.camera)
      ranges.back() += ":" + std::to_string(view.frame + 1);
  }
  ranges.erase(std::unique(ranges.begin(), ranges.end()), ranges.end());
  std::string frames;
  for (const std::string& range : ranges) frames += (frames.empty() ? "" : ",") + range;
  const char* const bending = !options.bending                             ? "auto"
                              : *options.bending == chain::Bending::planar ? "planar"
                                                                           : "spatial";
  std::vector<double> geometry{capture.length, capture.diameter};  // which may have been corrected
  for (const capture::Camera& camera : capture.cameras) {
    const math::Pose& pose = camera.world_from_camera;
    geometry.insert(geometry.end(), pose.rotation.data(), pose.rotation.data() + pose.rotation.size());
    geometry.insert(geometry.end(), {pose.translation.x(), pose.translation.y(), pose.translation.z(), camera.fx});
  }
  std::ostringstream text;
  text << "capture " << capture.hash << "\nframes " << frames << "\n--joints "
       << (options.joints ? std::to_string(*options.joints) : "auto") << "\n--bending " << bending << "\n--twist "
       << (options.twist ? "yes" : "no") << "\nheight " << (options.height ? "yes" : "no") << "\n--every "
       << options.every << "\n--mode " << (options.mode == Mode::paper ? "paper" : "fast") << "\n--seed "
       << options.seed << "\nbudget " << options.budget << "\nstep " << core::exact(options.step) << "\n--paper "
       << text_of(options.paper) << "\ntimes of frames " << hashed(times, core::fnv1a("")) << "\ncameras and size "
       << hashed(geometry, core::fnv1a("")) << "\nimages and masks " << hashed(pictures, core::fnv1a("")) << "\n";
  return text.str();
}

void check_checkpoint(const capture::Capture& capture, const Options& options) {
  if (options.resume && !options.checkpoint.empty()) load_checkpoint(options.checkpoint, job_text(capture, options));
}

void differentiate(chain::States& states) {
  constexpr int kHalf = 3;  // frames on each side: 0.1 s at 30 Hz, short against the rope's 0.9 s swing
  const int count = static_cast<int>(states.time.size());
  states.thetadot.assign(count, math::VectorX());
  for (int k = 0; k < count; ++k) {
    const int first = std::max(0, k - kHalf), last = std::min(count - 1, k + kHalf), rows = last - first + 1;
    const int order = std::min(2, rows - 1);
    math::MatrixX design(rows, order + 1), values(rows, states.theta[k].size());
    for (int r = 0; r < rows; ++r) {
      const double t = states.time[first + r] - states.time[k];
      for (int c = 0; c <= order; ++c) design(r, c) = std::pow(t, c);
      values.row(r) = states.theta[first + r].transpose();
    }
    const math::MatrixX fit = design.colPivHouseholderQr().solve(values);
    states.thetadot[k] =
        order >= 1 ? math::VectorX(fit.row(1).transpose()) : math::VectorX::Zero(states.theta[k].size());
  }
}

solve::Summary refine_all(splat::Engine& engine, const chain::Chain& chain, const capture::Capture& capture,
                          const std::vector<FrameViews>& frames, const splat::Gaussians& gaussians,
                          const std::vector<int>& selected, int iterations, const AnglePrior& prior,
                          chain::States& states) {
  states.covariance.assign(states.time.size(), math::MatrixX::Identity(chain.angles(), chain.angles()));
  std::vector<solve::Summary> summaries;
  engine.set_gaussians(gaussians);
  std::vector<int> index_of(capture.views.size(), -1);  // in the part that is drawn
  std::size_t from = 0;
  while (from < selected.size()) {
    if (core::stop_requested()) throw Interrupted(core::stop_requested());
    std::vector<int> part;
    std::vector<splat::ViewSpec> specs;
    std::vector<const capture::PackedView*> targets;
    std::size_t pixels = 0;
    while (from + part.size() < selected.size() && pixels < kPartPixels) {
      const int k = selected[from + part.size()];
      for (const int v : frames[k].views) {
        const capture::PackedView& view = capture.views[v];
        index_of[v] = static_cast<int>(specs.size());
        specs.push_back(
            view_spec(capture, view, view_motions(chain, capture, states, frames[k], k, states.theta[k], view)));
        targets.push_back(&view);
        pixels += static_cast<std::size_t>(view.width) * view.height;
      }
      part.push_back(k);
    }
    engine.set_views(specs, targets);
    const Draw draw = [&](std::span<const int> views, std::span<const std::vector<math::Pose>> motions) {
      std::vector<int> batch;
      for (std::size_t v = 0; v < views.size(); ++v) {
        batch.push_back(index_of[views[v]]);
        engine.set_motions(batch.back(), motions[v]);
      }
      return engine.draw_views(batch, true);
    };
    RefineOptions refine;
    refine.iterations = iterations;
    refine.mask_weight = kAngleMaskWeight;
    refine.trusted = kTrustedStep;
    Refined refined = refine_angles(chain, capture, frames, part, draw, refine, prior, states);
    for (std::size_t i = 0; i < part.size(); ++i) states.covariance[part[i]] = std::move(refined.covariances[i]);
    summaries.push_back(refined.summary);
    from += part.size();
  }
  return solve::together(summaries);
}

}  // namespace chainsplat::recognition
