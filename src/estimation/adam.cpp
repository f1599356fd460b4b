// The paper's state estimation, for comparison.
#include "chainsplat/solve.h"
#include "src/estimation/start.h"

namespace chainsplat::estimation {

using math::MatrixX;
using math::VectorX;

AdamFollower start_adam(const Filter& filter, LinkGradient gradient, const AdamOptions& options) {
  AdamFollower out;
  out.filter = filter;
  out.gradient = std::move(gradient);
  out.options = options;
  return out;
}

Estimate update(AdamFollower& follower, std::span<const capture::View* const> views) {
  CHAINSPLAT_CHECK(!views.empty(), "no view");
  const Filter& filter = follower.filter;
  const chain::Chain& chain = filter.model.chain;
  const int n = chain.angles();
  const double time = views.front()->time;
  const bool first = follower.theta.size() == 0;

  // where to start, and how many steps to take
  Estimate out;
  out.frame = views.front()->frame;
  out.time = time;
  for (const capture::View* const view : views) out.seen = out.seen || has_mask(*view);
  VectorX theta = first ? VectorX(first_belief(filter, time).mean.head(n)) : follower.theta;
  const int steps = !out.seen ? 0 : first ? follower.options.first_steps : follower.options.steps;
  solve::AdamState moments;
  for (int step = 1; step <= steps; ++step) {
    VectorX gradient = VectorX::Zero(n);
    for (const capture::View* const view : views) {
      if (view->width <= 0 || view->height <= 0) continue;
      const math::Pose base = base_at(filter, view->time).pose;
      const MatrixX twists = follower.gradient(*view, chain::link_motions(chain, theta, base));
      gradient += chain::theta_gradient(chain, chain::world_axes(chain, theta, base), twists);
    }
    if (!gradient.allFinite()) throw WorkError("estimate", "the gradient is not finite", "train the twin again");
    solve::adam_step(moments, gradient, {.rate = follower.options.rate}, theta);
  }
  // report, with rates by differences
  out.theta = theta;
  out.thetadot = first ? VectorX(VectorX::Zero(n)) : VectorX((theta - follower.theta) / (time - follower.time));
  for (const capture::View* const view : views)
    out.iou += tube_iou(chain, base_at(filter, view->time).pose, theta, *view, filter.cameras.at(view->camera)) /
               static_cast<double>(views.size());
  out.lost = out.seen && out.iou < kLostShare;
  follower.theta = theta;
  follower.time = time;
  return out;
}

}  // namespace chainsplat::estimation
