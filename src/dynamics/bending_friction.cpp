#include "bending_friction.h"

#include <cmath>

namespace chainsplat::dynamics {

BendingFriction::BendingFriction(const Model& model) {
  const Parameters& p = model.parameters;
  if (p.bending_friction.empty()) return;
  const int n = model.chain.angles();
  for (int k = 0; k < n; ++k) {
    const int joint = model.chain.child_link[k];
    int first = k, end = k;
    while (first > 0 && model.chain.child_link[first - 1] == joint) --first;
    while (end < n && model.chain.child_link[end] == joint && !chain::is_twist(model.chain, end)) ++end;
    const bool twist = chain::is_twist(model.chain, k);
    first_.push_back(twist ? k : first), end_.push_back(twist ? k : end);
    moment_.push_back(twist ? 0.0 : p.bending_friction[k]);
    angle_.push_back(p.bending_friction_angle[k]);
    present |= moment_.back() > 0.0;
  }
  decay_.assign(n, 0.0), by_rate_.assign(n, {0.0, 0.0});
  rate_.setZero(n);
}

void BendingFriction::rate(const VectorX& thetadot, const VectorX& z, VectorX& out) const {
  for (std::size_t k = 0; k < angle_.size(); ++k) {
    double square = kBendingFrictionRate * kBendingFrictionRate;
    for (int i = first_[k]; i < end_[k]; ++i) square += thetadot[i] * thetadot[i];
    const double speed = std::sqrt(square) - kBendingFrictionRate;
    const auto row = static_cast<Eigen::Index>(k);
    out[row] = first_[k] < end_[k] ? (thetadot[row] - z[row] * speed) / angle_[k] : 0.0;
  }
}

void BendingFriction::linearize(const VectorX& thetadot, const VectorX& z) {
  rate(thetadot, z, rate_);
  for (std::size_t k = 0; k < angle_.size(); ++k) {
    double square = kBendingFrictionRate * kBendingFrictionRate;
    for (int i = first_[k]; i < end_[k]; ++i) square += thetadot[i] * thetadot[i];
    const double root = std::sqrt(square);
    const auto row = static_cast<Eigen::Index>(k);
    decay_[k] = first_[k] < end_[k] ? (root - kBendingFrictionRate) / angle_[k] : 0.0;
    for (int i = first_[k]; i < end_[k]; ++i)
      by_rate_[k][i - first_[k]] = ((i == row ? 1.0 : 0.0) - z[row] * thetadot[i] / root) / angle_[k];
  }
}

void BendingFriction::add_to(double g, MatrixX& matrix) const {
  for (std::size_t k = 0; k < angle_.size(); ++k) {
    const double scale = moment_[k] * g * g / (1.0 + g * decay_[k]);
    for (int i = first_[k]; i < end_[k]; ++i)
      matrix(static_cast<Eigen::Index>(k), i) += scale * by_rate_[k][i - first_[k]];
  }
}

void BendingFriction::add_unknowns(std::span<const Tangent> unknowns, MatrixX& to) const {
  for (std::size_t p = 0; p < unknowns.size(); ++p)
    if (const std::vector<double>& by = unknowns[p].bending_friction_angle; !by.empty())
      for (std::size_t k = 0; k < angle_.size(); ++k)
        to(static_cast<Eigen::Index>(k), static_cast<Eigen::Index>(p)) -=
            rate_[static_cast<Eigen::Index>(k)] * by[k] / angle_[k];
}

void BendingFriction::follow(const VectorX& from, const VectorX& to, VectorX& z) const {
  for (std::size_t k = 0; k < angle_.size(); ++k) {
    double square = 0.0;
    for (int i = first_[k]; i < end_[k]; ++i) square += (to[i] - from[i]) * (to[i] - from[i]);
    if (!(square > 0.0)) continue;
    const auto row = static_cast<Eigen::Index>(k);
    const double way = std::sqrt(square), direction = (to[row] - from[row]) / way;
    z[row] = direction + (z[row] - direction) * std::exp(-way / angle_[k]);
  }
}

}  // namespace chainsplat::dynamics
