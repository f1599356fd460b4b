#include "src/estimation/predict.h"

#include <algorithm>
#include <cmath>

#include "chainsplat/dynamics/parametrization.h"
#include "src/estimation/setup.h"
#include "src/estimation/unknown_force.h"

namespace chainsplat::estimation {

using math::MatrixX;
using math::Pose;
using math::Vector2;
using math::Vector3;
using math::VectorX;

namespace {

constexpr double kFrame = 1.0 / 30.0;  // s, frame interval to which the options' random acceleration refers

// Standard deviations before the first frame, around the motion from rest that the twin predicts.
constexpr double kFirstAngle = 0.15;  // rad
constexpr double kFirstRate = 1.0;    // rad/s
constexpr double kFirstForce = 0.3;   // N per kilogram of rope, for a constant force such as a wrong rest shape causes

// The same of a rope that nobody touches: the errors of the twin's rest shape.
constexpr double kRestingAngle = 0.02;  // rad
constexpr double kRestingForce = 0.1;   // N per kilogram

// The masks' shift on a table, where a contact shadow may count as rope: a strip of about a pixel shifts the mask by
// half a pixel. In one camera it changes slowly while the rope lies in constant light.
constexpr double kMaskShift = 0.2;        // px, standard deviation from the shift expected from the edge offset,
constexpr double kLowerSide = 0.8;        // which is this share of the offset, downward; the rest is even on all sides
constexpr double kMaskShiftMemory = 5.0;  // s

constexpr double kLateStep = 0.01;   // s, to either side, of differences by the base's clock
constexpr double kTurnStep = 0.001;  // rad, the same by the grasp

// Returns the expected shift of each camera's masks, px in x and y. A camera above the table sees the rope's contact
// with it, and the shadow there, on the rope's lower side, so that a mask that is too wide is too wide on that side.
VectorX expected_mask_shifts(const State& state, double time) {
  VectorX out(2 * state.cameras.size());
  const Pose base = base_at(state, time).pose;
  const double step = state.given.model.chain.diameter;
  for (std::size_t c = 0; c < state.cameras.size(); ++c) {
    const capture::Camera& camera = state.cameras[c];
    const Vector3 below = base.translation - step * *state.given.table_normal;
    const Pose camera_from_world = camera.world_from_camera.inverse();
    const Vector3 a = camera_from_world * base.translation, b = camera_from_world * below;
    Vector2 down = Vector2::Zero();
    if (std::min(a.z(), b.z()) > 0.0) down = capture::project(camera, b) - capture::project(camera, a);
    // px; dividing by at least the radius lets the shift vanish for a camera right above, which sees no lower side
    const double radius = 0.5 * step * camera.fx / std::max(a.z(), step);
    out.segment<2>(2 * c) = kLowerSide * state.edge_offset * down / std::max(down.norm(), radius);
  }
  return out;
}

}  // namespace

std::pair<VectorX, VectorX> motion_from_rest(const Given& given, const dynamics::BaseFunction& base, double time) {
  const int n = given.model.chain.angles();
  if (given.identified && given.base_start < time) {
    const dynamics::BaseGrid grid =
        dynamics::sample_base(base, given.base_start, {time}, given.model.parameters.substeps);
    chain::States states;
    if (dynamics::simulate(given.model, grid, given.rest, VectorX::Zero(n), states))
      return {states.theta.back(), states.thetadot.back()};
  }
  return {given.rest, VectorX::Zero(n)};
}

Belief first_belief(const State& state, double time) {
  const Given& given = state.given;
  const int n = given.model.chain.angles();
  const int size = 3 * n + (given.table_normal ? 2 * static_cast<int>(state.cameras.size()) : 0);
  Belief belief;
  belief.time = time;
  belief.mean = VectorX::Zero(size);
  belief.by_setup = MatrixX::Zero(size, state.setup.mean.size());
  const auto [theta, thetadot] = motion_from_rest(
      given, [&](double t) { return base_at(state, t); }, time);
  belief.mean.head(n) = theta;
  belief.mean.segment(n, n) = thetadot;
  // a wide covariance around it
  belief.covariance = MatrixX::Zero(size, size);
  belief.covariance.diagonal().head(n).setConstant(kFirstAngle * kFirstAngle);
  belief.covariance.diagonal().segment(n, n).setConstant(kFirstRate * kFirstRate);
  if (given.shifts)
    belief.covariance.block(2 * n, 2 * n, n, n) =
        shift_covariance(given.model, base_at(state, time).pose, belief.mean.head(n),
                         kFirstForce * dynamics::total_mass(given.model.parameters), given.everywhere);
  belief.covariance.diagonal().tail(size - 3 * n).setConstant(kMaskShift * kMaskShift);
  belief.covariance.diagonal().array() += kLeastVariance;
  return belief;
}

Belief resting_belief(const State& state, double time) {
  const int n = state.given.model.chain.angles();
  Belief belief = first_belief(state, time);
  belief.covariance.diagonal().head(n).setConstant(kRestingAngle * kRestingAngle);
  belief.covariance.middleRows(2 * n, n) *= kRestingForce / kFirstForce;
  belief.covariance.middleCols(2 * n, n) *= kRestingForce / kFirstForce;
  return belief;
}

Motion move(const State& state, const Belief& belief, double time) {
  const Given& given = state.given;
  const int n = given.model.chain.angles();
  const double h = time - belief.time;
  Motion out;
  out.time = time;
  out.by_setup = MatrixX::Zero(2 * n, state.setup.mean.size());
  // by the dynamics and their sensitivities
  if (given.identified) {
    dynamics::Model model = given.model;
    for (int k = 0; k < n; ++k) model.parameters.rest_angle[k] += belief.mean[2 * n + k];
    std::vector<dynamics::Unknown> unknowns = dynamics::initial_state_unknowns(model.chain);
    for (int k = 0; given.shifts && k < n; ++k) unknowns.push_back({dynamics::Quantity::rest_angle, k});
    const std::vector<dynamics::Tangent> tangents = dynamics::tangents(model.chain, model.parameters, unknowns);
    const dynamics::BaseGrid grid = dynamics::sample_base([&](double t) { return base_at(state, t); }, belief.time,
                                                          {time}, model.parameters.substeps);
    chain::States states;
    dynamics::Sensitivities sensitivities;
    const VectorX theta = belief.mean.head(n), thetadot = belief.mean.segment(n, n);
    const dynamics::InitialState now{belief.time, theta, thetadot,
                                     dynamics::internal_state_in_motion(model, theta, thetadot)};
    if (dynamics::simulate(model, grid, now, states, tangents, &sensitivities)) {
      out.theta = states.theta.back();
      out.thetadot = states.thetadot.back();
      out.theta_by_state = MatrixX::Zero(n, 3 * n);
      out.thetadot_by_state = MatrixX::Zero(n, 3 * n);
      out.theta_by_state.leftCols(unknowns.size()) = sensitivities.theta.back();
      out.thetadot_by_state.leftCols(unknowns.size()) = sensitivities.thetadot.back();
      const auto moved = [&](int unknown, double step) {
        VectorX setup = state.setup.mean;
        setup[unknown] += step;
        const BaseCorrection correction = base_correction(setup);
        const dynamics::BaseGrid off =
            dynamics::sample_base([&](double t) { return corrected(given.base, correction, t); }, belief.time, {time},
                                  model.parameters.substeps);
        VectorX end(2 * n);
        chain::States moving;
        if (dynamics::simulate(model, off, now, moving))
          end << moving.theta.back(), moving.thetadot.back();
        else
          end << out.theta, out.thetadot;
        return end;
      };
      const auto differ = [&](int unknown, double step) {
        out.by_setup.col(unknown) = (moved(unknown, step) - moved(unknown, -step)) / (2.0 * step);
      };
      differ(silhouette::SetupEquations::kClock, kLateStep);
      for (int i = 0; !chain::bends_in_space(model.chain) && i < 3; ++i)
        differ(silhouette::SetupEquations::kGrasp + i, kTurnStep);
      return out;
    }
  }
  // at constant rate, without dynamics or where their integration failed
  out.theta = belief.mean.head(n) + h * belief.mean.segment(n, n);
  out.thetadot = belief.mean.segment(n, n);
  out.theta_by_state = MatrixX::Zero(n, 3 * n);
  out.theta_by_state.leftCols(n).setIdentity();
  out.theta_by_state.middleCols(n, n) = h * MatrixX::Identity(n, n);
  out.thetadot_by_state = MatrixX::Zero(n, 3 * n);
  out.thetadot_by_state.middleCols(n, n).setIdentity();
  return out;
}

Belief predict(const State& state, const Belief& belief, const Motion& motion, Contact contact) {
  const Given& given = state.given;
  const int n = given.model.chain.angles();
  const double time = motion.time, h = time - belief.time;
  const bool touched = contact != Contact::none;
  CHAINSPLAT_CHECK(h > 0.0, std::to_string(h));
  const double keep = std::exp(-h / state.options.force_memory);

  const double keep_mask_shift = std::exp(-h / kMaskShiftMemory);

  // move mean and covariance; forces decay, and mask shifts return to their expectation
  const Eigen::Index size = belief.mean.size();
  MatrixX transition = MatrixX::Zero(size, size);
  transition.topLeftCorner(n, 3 * n) = motion.theta_by_state;
  transition.block(n, 0, n, 3 * n) = motion.thetadot_by_state;
  transition.diagonal().segment(2 * n, n).setConstant(keep);
  transition.diagonal().tail(size - 3 * n).setConstant(keep_mask_shift);
  Belief out;
  out.time = time;
  out.mean.resize(size);
  out.mean << motion.theta, motion.thetadot, keep * belief.mean.segment(2 * n, n),
      keep_mask_shift * belief.mean.tail(size - 3 * n);
  if (size > 3 * n) out.mean.tail(size - 3 * n) += (1.0 - keep_mask_shift) * expected_mask_shifts(state, time);
  out.by_setup = transition * belief.by_setup;
  out.by_setup.topRows(2 * n) += motion.by_setup;
  out.covariance = transition * belief.covariance * transition.transpose();
  out.covariance.diagonal().tail(size - 3 * n).array() +=
      kMaskShift * kMaskShift * (1.0 - keep_mask_shift * keep_mask_shift);
  // add the random walk of the force, and the blows that stop a link's end
  if (given.shifts) {
    const double force = (touched ? state.options.contact_force : state.options.model_force) *
                         dynamics::total_mass(given.model.parameters) * std::sqrt(h);
    const MatrixX shift = shift_covariance(given.model, base_at(state, time).pose, motion.theta, force,
                                           touched ? state.place : given.everywhere);
    // the force changes during the step: in the mean square a third of the change acts throughout
    MatrixX noise = transition.middleCols(2 * n, n);
    noise.topRows(2 * n) *= std::sqrt(1.0 / 3.0);
    noise.middleRows(2 * n, n).setIdentity();
    out.covariance += noise * shift * noise.transpose();
    if (contact == Contact::struck) {
      const std::vector<VectorX> stops = stopping_shifts(given.model, base_at(state, time), motion.theta,
                                                         motion.thetadot, motion.thetadot_by_state.rightCols(n));
      for (std::size_t i = 0; i < stops.size(); ++i) {
        VectorX blow = std::sqrt(state.place[i]) * (transition.block(0, 2 * n, 2 * n, n) * stops[i]);
        out.covariance.topLeftCorner(2 * n, 2 * n) += blow * blow.transpose();
        // at a random time of the step it changes the angles by h/2 times the rates' change, give or take sqrt(1/3) of
        // it
        blow.head(n) *= std::sqrt(1.0 / 3.0);
        out.covariance.topLeftCorner(n, n) += blow.head(n) * blow.head(n).transpose();
      }
    }
  }
  // add an acceleration that is independent in every frame
  const bool explained = given.identified && (given.shifts || !touched);
  const double a = explained ? state.options.acceleration : state.options.blind_acceleration;
  const double rate = a * a * h * kFrame;
  for (int k = 0; k < n; ++k) {
    out.covariance(k, k) += rate * h * h / 3.0;
    out.covariance(k, n + k) += rate * h / 2.0;
    out.covariance(n + k, k) += rate * h / 2.0;
    out.covariance(n + k, n + k) += rate;
  }
  symmetrize(out.covariance);
  out.covariance.diagonal().array() += kLeastVariance;
  return out;
}

bool is_ahead(const State& state, double time) {
  constexpr double kSameTime = 1e-6;  // s, in which nothing moves; times of frames are sums that are rounded
  return state.ahead && std::abs(state.ahead->time - time) < kSameTime;
}

std::optional<VectorX> expected(State& state, double time) {
  if (!state.belief || state.lost) return std::nullopt;
  const int n = state.given.model.chain.angles();
  if (time <= state.belief->time) return state.belief->mean.head(n);
  if (!is_ahead(state, time)) state.ahead = move(state, *state.belief, time);
  return state.ahead->theta;
}

}  // namespace chainsplat::estimation
