#include "chainsplat/recognition.h"

#include <algorithm>
#include <cmath>
#include <sstream>

#include "src/recognition/modes.h"

namespace chainsplat::recognition {

Result recognize(gpu::Device& device, const capture::Capture& capture, const Options& options) {
  return options.mode == Mode::paper ? recognize_paper(device, capture, options)
                                     : recognize_fast(device, capture, options);
}

std::string job_text(const capture::Capture& capture, const Options& options) {
  std::ostringstream text;
  text << "capture " << capture.hash << " views " << capture.views.size() << " joints " << options.joints << " bending "
       << (options.bending ? (*options.bending == chain::Bending::planar ? "planar" : "spatial") : "auto") << " twist "
       << options.twist << " every " << options.every << " mode " << (options.mode == Mode::paper ? "paper" : "fast")
       << " seed " << options.seed << " budget " << options.budget << " paper " << options.paper_gaussians << " "
       << options.paper_iterations;
  return text.str();
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

std::vector<math::MatrixX> refine_all(splat::Engine& engine, const chain::Chain& chain, const capture::Capture& capture,
                                      const std::vector<FrameViews>& frames, const splat::Gaussians& gaussians,
                                      const std::vector<int>& selected, int iterations, const AnglePrior& prior,
                                      chain::States& states) {
  // the targets of one part must fit one buffer on the smallest device
  constexpr std::size_t kPartPixels = 2u << 20;
  std::vector<math::MatrixX> covariances;
  engine.set_gaussians(gaussians);
  std::size_t from = 0;
  while (from < selected.size()) {
    if (core::stop_requested()) throw Interrupted(core::stop_requested());
    std::vector<int> part, index_of(capture.views.size(), -1);
    std::vector<splat::ViewSpec> specs;
    std::vector<const std::vector<std::uint8_t>*> targets;
    std::size_t pixels = 0;
    while (from + part.size() < selected.size() && pixels < kPartPixels) {
      const int k = selected[from + part.size()];
      for (const int v : frames[k].views) {
        const capture::View& view = capture.views[v];
        index_of[v] = static_cast<int>(specs.size());
        specs.push_back(
            view_spec(capture, view, view_motions(chain, capture, states, frames[k], k, states.theta[k], view)));
        targets.push_back(&view.rgba);
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
    RefineSummary summary = refine_angles(chain, capture, frames, part, draw, refine, prior, states);
    for (auto& covariance : summary.covariances) covariances.push_back(std::move(covariance));
    from += part.size();
  }
  return covariances;
}

}  // namespace chainsplat::recognition
