#include "engine.h"

#include <algorithm>
#include <cmath>

namespace chainsplat::dynamics {

Engine::Engine(const Model& m) : model(m), angles(m.chain.angles()), link_count(m.chain.links() - 1), torsion_(m) {
  const Parameters& p = model.parameters;
  slips_ =
      std::any_of(p.bending_friction.begin(), p.bending_friction.end(), [](double moment) { return moment > 0.0; });
  table_ = p.table_normal.has_value();
  normal_ = table_ ? *p.table_normal : Vector3::Zero();
  const double normal_gravity = std::abs(p.gravity.dot(normal_));
  gravity_ = p.gravity;
  if (table_ && p.table_carries_weight) gravity_ -= normal_ * normal_.dot(p.gravity);

  int k = 0;
  for (int j = 0; j < link_count; ++j) {
    LinkConstants link{};
    const double l = model.chain.link_end(j + 1) - model.chain.link_start(j + 1), r = p.radius, mass_j = p.link_mass[j];
    const double tip = j + 1 == link_count ? p.tip_mass : 0.0;
    const Attached at_tip = attached(l, p.tip_length);
    link.length = l;
    link.mass = mass_j + tip;
    link.center = link.mass > 0.0 ? (0.5 * mass_j * l + tip * at_tip.center) / link.mass : 0.5 * l;
    link.transverse =
        mass_j * (l * l / 3.0 + 0.25 * r * r) + tip * at_tip.second - link.mass * link.center * link.center;
    link.axial = 0.5 * mass_j * r * r;
    link.viscous = table_ ? p.viscous_friction[j] : 0.0;
    link.coulomb_per_coefficient = mass_j * normal_gravity;
    link.coulomb_per_mass = p.coulomb_friction[j] * normal_gravity;
    link.coulomb = p.coulomb_friction[j] * link.coulomb_per_coefficient;
    link.air_linear = p.air_linear[j];
    link.air_quadratic = p.air_quadratic[j];
    link.first_angle = k;
    while (k < angles && model.chain.child_link[k] == j + 1) ++k;
    link.end_angle = k;
    links.push_back(link);
  }
  rolls = table_ && !p.roll_lever.empty();
  if (rolls) {
    for (VectorX* v : {&roll_friction, &roll_by_time, &roll_by_viscous, &roll_by_coulomb}) v->setZero(link_count);
    roll_torque.setZero(angles);
    roll_share.setZero(angles, link_count);
    for (MatrixX* by : {&roll_by_angle, &roll_by_rate}) by->setZero(link_count, angles);
    for (int a = 0; a < angles; ++a)
      for (int j = 0; j < link_count; ++j) {
        const double middle = 0.5 * (model.chain.link_start(j + 1) + model.chain.link_end(j + 1));
        roll_share(a, j) = std::min(model.chain.link_start(model.chain.child_link[a]), middle) / model.chain.length;
      }
    roll_map = Eigen::Map<const VectorX>(p.roll_lever.data(), angles).asDiagonal() * roll_share;
  }
  for (VectorX* v : {&torque, &bias, &force, &acceleration, &inverse, &drive_rate, &theta_, &thetadot_})
    v->setZero(angles);
  for (MatrixX* a : {&mass, &cholesky, &stiffness, &damping}) a->setZero(angles, angles);
}

void Engine::set_state(const VectorX& theta, const VectorX& thetadot) {
  theta_ = theta, thetadot_ = thetadot;
  const Parameters& p = model.parameters;
  for (int k = 0; k < angles; ++k)
    torque[k] = -p.stiffness[k] * (theta[k] - p.rest_angle[k]) - p.damping[k] * thetadot[k];
  const Eigen::Index known = internal_state.size();
  shares_ = slips_ ? std::min<Eigen::Index>(known, angles) : 0;
  if (torsion_.present) {
    settled_ = known < shares_ + torsion_.rolls;
    if (settled_)
      torsion_.settle(theta);
    else
      torsion_.place(theta, thetadot, internal_state.tail(torsion_.rolls));
    for (int k = 0; k < angles; ++k) torque[k] = torsion_.torque()[k] - p.damping[k] * thetadot[k];
  }
  for (Eigen::Index k = 0; k < shares_; ++k) torque[k] -= p.bending_friction[k] * internal_state[k];
}

void Engine::add_roll() {
  if (!rolls) return;
  roll_torque.noalias() = roll_map * roll_friction;
  bias += roll_torque;
}

void Engine::linearize_torsion() {
  if (!torsion_.present) return;
  if (settled_) return torsion_.add_settled_stiffness(stiffness);
  torsion_.linearize();
  stiffness += torsion_.stiffness(), damping += torsion_.damping();
}

void Engine::linearize_roll() {
  if (!rolls) return;
  stiffness += roll_map.lazyProduct(roll_by_angle);
  damping += roll_map.lazyProduct(roll_by_rate);
  drive_rate -= roll_map.lazyProduct(roll_by_time);
}

void Engine::joint_forces(const Tangent& d, Eigen::Ref<VectorX> column) const {
  const Parameters& p = model.parameters;
  column.setZero();
  if (torsion_.present && settled_) torsion_.add_settled_unknown(d, column);
  if (torsion_.present && !settled_) torsion_.add_unknown(d, column, nullptr);
  if (!d.stiffness.empty() && !torsion_.present)
    for (int k = 0; k < angles; ++k) column[k] -= d.stiffness[k] * (theta_[k] - p.rest_angle[k]);
  if (!d.rest_angle.empty() && !torsion_.present)
    for (int k = 0; k < angles; ++k) column[k] += p.stiffness[k] * d.rest_angle[k];
  if (!d.damping.empty())
    for (int k = 0; k < angles; ++k) column[k] -= d.damping[k] * thetadot_[k];
  if (!d.bending_friction.empty())
    for (Eigen::Index k = 0; k < shares_; ++k) column[k] -= d.bending_friction[k] * internal_state[k];
  if (!rolls) return;
  if (!d.roll_lever.empty())
    for (int k = 0; k < angles; ++k) column[k] -= d.roll_lever[k] * roll_share.row(k).dot(roll_friction);
  for (int j = 0; j < link_count; ++j) {
    double change = 0.0;
    if (!d.link_mass.empty()) change += d.link_mass[j] * links[j].coulomb_per_mass * roll_by_coulomb[j];
    if (!d.coulomb_friction.empty())
      change += d.coulomb_friction[j] * links[j].coulomb_per_coefficient * roll_by_coulomb[j];
    if (!d.viscous_friction.empty()) change += d.viscous_friction[j] * roll_by_viscous[j];
    if (change != 0.0) column -= change * roll_map.col(j);
  }
}

bool Engine::factor_mass() {
  for (int j = 0; j < angles; ++j) {
    for (int i = j; i < angles; ++i) cholesky(i, j) = mass(i, j);
    for (int k = 0; k < j; ++k) {
      const double factor = cholesky(j, k);
      for (int i = j; i < angles; ++i) cholesky(i, j) -= factor * cholesky(i, k);
    }
    const double pivot = cholesky(j, j);
    // what is left of the diagonal after rounding in a singular matrix is no inertia
    if (!(pivot > kSingular * mass(j, j))) {
      singular_angle = j;
      return false;
    }
    const double scale = 1.0 / std::sqrt(pivot);
    for (int i = j; i < angles; ++i) cholesky(i, j) *= scale;
  }
  return true;
}

void Engine::accelerate() {
  acceleration = force;
  for (int j = 0; j < angles; ++j) {
    const double x = acceleration[j] /= cholesky(j, j);
    for (int i = j + 1; i < angles; ++i) acceleration[i] -= x * cholesky(i, j);
  }
  for (int j = angles - 1; j >= 0; --j) {
    double x = acceleration[j];
    for (int i = j + 1; i < angles; ++i) x -= cholesky(i, j) * acceleration[i];
    acceleration[j] = x / cholesky(j, j);
  }
}

void Engine::solve_mass(MatrixX& x) const {
  cholesky.triangularView<Eigen::Lower>().solveInPlace(x);
  cholesky.transpose().triangularView<Eigen::Upper>().solveInPlace(x);
}

}  // namespace chainsplat::dynamics
