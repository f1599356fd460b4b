#include "src/estimation/unknown_force.h"

#include <algorithm>
#include "src/math/decompositions.h"

namespace chainsplat::estimation {

using math::MatrixX;
using math::Pose;
using math::Vector3;
using math::VectorX;

namespace {

// A hand touches a rope at one place. The place is learned from the force estimated so far: by kPlaceRate per frame,
// with a floor for every link so that the place can move.
constexpr double kPlaceRate = 0.5;
constexpr double kPlaceFloor = 0.005;
// Ridge, as a share of the torques' mean variance, for torques that a force at few places cannot cause.
constexpr double kPlaceRidge = 1e-3;

constexpr double kContactForce = 0.05;  // share of the rope's weight

// The estimated force, distributed over the links' ends as state.place allows, and each end's share in it.
struct FoundForce {
  Vector3 sum = Vector3::Zero();  // N
  VectorX shares;
};

FoundForce found_force(const State& state, const Belief& belief) {
  const int n = state.given.model.chain.angles();
  const std::vector<MatrixX> jacobians =
      chain::link_end_jacobians(state.given.model.chain, belief.mean.head(n), base_at(state, belief.time).pose);
  VectorX torque = belief.mean.segment(2 * n, n);
  for (int k = 0; k < n; ++k) torque[k] *= state.given.model.parameters.stiffness[k];
  MatrixX covariance = chain::displacement_metric(jacobians, state.place);
  covariance.diagonal().array() += kPlaceRidge * covariance.trace() / n;
  const VectorX weighted = covariance.ldlt().solve(torque);
  FoundForce out;
  out.shares.resize(state.place.size());
  for (int i = 0; i < state.place.size(); ++i) {
    const Vector3 part = state.place[i] * (jacobians[i] * weighted);
    out.sum += part;
    out.shares[i] = part.squaredNorm();
  }
  const double total = out.shares.sum();
  out.shares = total > 0.0 ? VectorX(out.shares / total) : state.given.everywhere;
  return out;
}

}  // namespace

MatrixX shift_covariance(const dynamics::Model& model, const Pose& base, const VectorX& theta, double deviation,
                         const VectorX& place) {
  MatrixX out = chain::displacement_metric(chain::link_end_jacobians(model.chain, theta, base), place);
  out *= deviation * deviation;
  for (int k = 0; k < out.rows(); ++k) {
    out.row(k) /= model.parameters.stiffness[k];
    out.col(k) /= model.parameters.stiffness[k];
  }
  return out;
}

std::vector<VectorX> stopping_shifts(const dynamics::Model& model, const trajectory::BaseMotion& base,
                                     const VectorX& theta, const VectorX& thetadot, const MatrixX& rate_by_shift) {
  const chain::Chain& chain = model.chain;
  const std::vector<MatrixX> jacobians = chain::link_end_jacobians(chain, theta, base.pose);
  const MatrixX nodes = chain::nodes(chain, chain::link_motions(chain, theta, base.pose));
  std::vector<VectorX> shifts;
  for (std::size_t i = 0; i < jacobians.size(); ++i) {
    // the end's velocity in the world: by the rates and by the base
    const Vector3 from_base = base.pose.inverse() * Vector3(nodes.col(i + 2));
    const Vector3 carried = base.pose.rotation * (base.velocity.tail<3>() + base.velocity.head<3>().cross(from_base));
    const Vector3 velocity = jacobians[i] * thetadot + carried;
    VectorX shift = jacobians[i].transpose() * velocity;  // by a force of as many N as the velocity has m/s
    for (int k = 0; k < shift.size(); ++k) shift[k] /= model.parameters.stiffness[k];
    const double taken = velocity.dot(jacobians[i] * (rate_by_shift * shift));  // (m/s)^2, change along the velocity
    shifts.push_back(taken > 0.0 ? VectorX(-velocity.squaredNorm() / taken * shift) : VectorX(0.0 * shift));
  }
  return shifts;
}

void learn_force(State& state, double time) {
  if (!state.given.shifts) return;
  if (time > state.contact_until) {
    state.place = state.given.everywhere;
    return;
  }
  const FoundForce found = found_force(state, *state.belief);
  state.place += kPlaceRate * (found.shares - state.place);
  state.place.array() += kPlaceFloor;
  state.place /= state.place.sum();
  const double weight =
      state.given.model.parameters.gravity.norm() * dynamics::total_mass(state.given.model.parameters);
  if (found.sum.norm() > kContactForce * weight)
    state.contact_until = std::max(state.contact_until, time + kContactMemory);
}

}  // namespace chainsplat::estimation
