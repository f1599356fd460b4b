#include "internal_state.h"

#include "spatial.h"

namespace chainsplat::dynamics {

InternalState::InternalState(const Model& model)
    : friction_(model),
      angles_(model.chain.angles()),
      rolls_(static_cast<Eigen::Index>(model.parameters.torsional_stiffness.size())),
      factor_(static_cast<int>(rolls_)) {
  present = friction_.present || rolls_ > 0;
  size = (friction_.present ? angles_ : 0) + rolls_;
  rate_.setZero(size);
  coupled_.setZero(rolls_, angles_);
}

VectorX InternalState::start(Engine& engine, const VectorX& given, const VectorX& theta) const {
  VectorX z = VectorX::Zero(size);
  z.head(std::min(size, given.size())) = given.head(std::min(size, given.size()));
  if (rolls_ == 0) return z;
  if (given.size() == size) {
    engine.torsion().place(theta, VectorX::Zero(angles_), z.tail(rolls_));
  } else {
    engine.torsion().settle(theta);
    z.tail(rolls_) = engine.torsion().roll();
  }
  return z;
}

void InternalState::start_slopes(const Engine& engine, const VectorX& given, const MatrixX& x,
                                 std::span<const Tangent> unknowns, MatrixX& z) const {
  const Tangent none;
  for (Eigen::Index p = 0; p < z.cols(); ++p) {
    const auto i = static_cast<std::size_t>(p);
    const Tangent& unknown = i < unknowns.size() ? unknowns[i] : none;
    if (const VectorX& own = unknown.internal_state; own.size())
      z.col(p).head(std::min(size, own.size())) = own.head(std::min(size, own.size()));
    if (rolls_ > 0 && given.size() != size) z.col(p).tail(rolls_) = engine.torsion().settled_slope(x.col(p), unknown);
  }
}

void InternalState::linearize(const Engine& engine, const VectorX& thetadot, const VectorX& z) {
  if (friction_.present) {
    friction_.linearize(thetadot, z);
    rate_.head(angles_) = friction_.rate();
  }
  torsion_ = &engine.torsion();
  if (rolls_ > 0) rate_.tail(rolls_) = torsion_->rate();
}

bool InternalState::prepare(double g) {
  g_ = g;
  if (rolls_ == 0) return true;
  factor_.matrix = -torsion_->rate_by_roll();
  factor_.matrix.diagonal().array() += 1.0 / g;
  if (!factor_.factor()) return false;
  coupled_ = g * torsion_->rate_by_angle() + torsion_->rate_by_rate();
  for (Eigen::Index k = 0; k < angles_; ++k) factor_.solve(coupled_.col(k));
  return true;
}

void InternalState::add_to(MatrixX& matrix) const {
  if (friction_.present) friction_.add_to(g_, matrix);
  if (rolls_ > 0) matrix += g_ * torsion_->moment().lazyProduct(coupled_);
}

void InternalState::add_unknowns(std::span<const Tangent> unknowns, MatrixX& to) const {
  if (friction_.present) friction_.add_unknowns(unknowns, to);
  if (rolls_ == 0) return;
  VectorX torque = VectorX::Zero(angles_), rate(rolls_);
  for (std::size_t p = 0; p < unknowns.size(); ++p) {
    rate.setZero();
    torsion_->add_unknown(unknowns[p], torque, &rate);
    to.col(static_cast<Eigen::Index>(p)).tail(rolls_) += rate;
  }
}

std::vector<VectorX> internal_states(const Model& model, const std::vector<VectorX>& theta, const VectorX& before) {
  const InternalState internal(model);
  if (!internal.present) return {};
  const BendingFriction friction(model);
  const Eigen::Index n = model.chain.angles();
  SpatialEngine engine(model);
  std::vector<VectorX> out;
  VectorX shares = VectorX::Zero(friction.present ? n : 0);
  if (friction.present && before.size() >= n) shares = before.head(n);
  for (std::size_t k = 0; k < theta.size(); ++k) {
    if (friction.present && k > 0) friction.follow(theta[k - 1], theta[k], shares);
    out.push_back(internal.start(engine, shares, theta[k]));
  }
  return out;
}

VectorX internal_state_in_motion(const Model& model, const VectorX& theta, const VectorX& thetadot) {
  if (model.parameters.bending_friction.empty() && model.parameters.torsional_stiffness.empty()) return {};
  constexpr double kWhile = 0.1;  // s: a small part of a swing, and long enough for most joints to slip
  const std::vector<VectorX> states = internal_states(model, {theta - kWhile * thetadot, theta});
  return states.empty() ? VectorX() : states.back();  // a friction of zero keeps none
}

}  // namespace chainsplat::dynamics
