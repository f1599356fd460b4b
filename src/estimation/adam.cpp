// adam.cpp - the paper's state estimation, for comparison.
#include "chainsplat/solve.h"
#include "src/estimation/predict.h"
#include "src/estimation/setup.h"
#include "src/estimation/state.h"

namespace chainsplat::estimation {

using math::MatrixX;
using math::VectorX;

struct AdamFollower::State {
  Given given;
  BaseCorrection correction;  // of the base: what the table tells of it
  LinkGradient gradient;
  AdamOptions options;
  VectorX theta;      // of the last frame; empty before the first
  double time = 0.0;  // s, of the last frame
};

AdamFollower::AdamFollower(const twin::Twin& twin, const std::vector<capture::Camera>& cameras,
                           dynamics::BaseFunction base, double base_start, LinkGradient gradient,
                           const AdamOptions& options)
    : state_(std::make_unique<State>()) {
  state_->given = given_by(twin, cameras, std::move(base), base_start);
  state_->correction = base_correction(first_setup(state_->given, {}).mean);
  state_->gradient = std::move(gradient);
  state_->options = options;
}

AdamFollower::~AdamFollower() = default;
AdamFollower::AdamFollower(AdamFollower&&) noexcept = default;
AdamFollower& AdamFollower::operator=(AdamFollower&&) noexcept = default;

Estimate AdamFollower::update(std::span<const capture::View* const> views) {
  CHAINSPLAT_CHECK(!views.empty(), "no view");
  State& state = *state_;
  const chain::Chain& chain = state.given.model.chain;
  const int n = chain.angles();
  const double time = views.front()->time;
  const bool first = state.theta.size() == 0;

  // where to start, and how many steps to take
  Estimate out;
  out.frame = views.front()->frame;
  out.time = time;
  for (const capture::View* const view : views) out.seen = out.seen || has_mask(*view);
  VectorX theta = state.theta;
  if (first)
    theta = motion_from_rest(
                state.given, [this](double t) { return base_at(t); }, time)
                .first;
  const int steps = !out.seen ? 0 : first ? state.options.first_steps : state.options.steps;
  solve::AdamState moments;
  for (int step = 1; step <= steps; ++step) {
    VectorX gradient = VectorX::Zero(n);
    for (const capture::View* const view : views) {
      if (view->width <= 0 || view->height <= 0) continue;
      const math::Pose base = base_at(view->time).pose;
      const MatrixX twists = state.gradient(*view, cameras().at(view->camera), chain::link_motions(chain, theta, base));
      gradient += chain::theta_gradient(chain, chain::world_axes(chain, theta, base), twists);
    }
    if (!gradient.allFinite()) throw WorkError("estimate", "the gradient is not finite", "train the twin again");
    solve::adam_step(moments, gradient, {.rate = state.options.rate}, theta);
  }
  // report, with rates by differences
  out.theta = theta;
  out.thetadot = first ? VectorX(VectorX::Zero(n)) : VectorX((theta - state.theta) / (time - state.time));
  for (const capture::View* const view : views)
    out.iou += tube_iou(chain, base_at(view->time).pose, theta, *view, cameras().at(view->camera)) /
               static_cast<double>(views.size());
  out.lost = out.seen && out.iou < kLostShare;
  state.theta = theta;
  state.time = time;
  return out;
}

std::optional<VectorX> AdamFollower::expected(double /*time*/) const {
  if (state_->theta.size() == 0) return std::nullopt;
  return state_->theta;
}

trajectory::BaseMotion AdamFollower::base_at(double time) const {
  return corrected(state_->given.base, state_->correction, time);
}

const dynamics::Model& AdamFollower::model() const { return state_->given.model; }
const std::vector<capture::Camera>& AdamFollower::cameras() const { return state_->given.cameras; }
const VectorX& AdamFollower::rest() const { return state_->given.rest; }

}  // namespace chainsplat::estimation
