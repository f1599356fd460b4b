#include "torsion.h"

#include <algorithm>
#include <cmath>

namespace chainsplat::dynamics {

Torsion::Torsion(const Model& model) {
  const Parameters& p = model.parameters;
  present = !p.torsional_stiffness.empty();
  if (!present) return;
  const auto count = static_cast<Eigen::Index>(p.torsional_stiffness.size());
  for (std::size_t j = 0; j < p.torsional_stiffness.size(); ++j)
    joints_.push_back({{p.stiffness[2 * j], p.stiffness[2 * j + 1]},
                       {p.rest_angle[2 * j], p.rest_angle[2 * j + 1]},
                       p.torsional_stiffness[j]});
  for (VectorX* v : {&roll_, &slope_, &diagonal_, &beside_}) v->setZero(count);
  torque_.setZero(2 * count);
}

void Torsion::evaluate(Joint& j, double before, double after) const {
  const double chi = 0.5 * (before + after), c = std::cos(chi), s = std::sin(chi);
  j.rolled[0] = c * j.rest[0] - s * j.rest[1], j.rolled[1] = s * j.rest[0] + c * j.rest[1];
  const double x = j.theta[0] - j.rolled[0], y = j.theta[1] - j.rolled[1];
  j.by_chi = j.k[0] * x * j.rolled[1] - j.k[1] * y * j.rolled[0];
  j.by_chi_twice =
      j.k[0] * (x * j.rolled[0] + j.rolled[1] * j.rolled[1]) + j.k[1] * (y * j.rolled[1] + j.rolled[0] * j.rolled[0]);
  j.mixed[0] = j.k[0] * j.rolled[1], j.mixed[1] = -j.k[1] * j.rolled[0];
  // the twist of the joint's own rotation
  const double a = std::tan(0.5 * j.theta[0]), b = std::tan(0.5 * j.theta[1]), u = a * b;
  const double aa = 1.0 + a * a, bb = 1.0 + b * b, n = 1.0 + u * u;
  j.tau = after - before + 2.0 * std::atan(u);
  j.delta[0] = b * aa / n, j.delta[1] = a * bb / n;
  j.bend[0] = b * aa * (a / n - u * b * aa / (n * n));
  j.bend[1] = aa * bb * (0.5 / n - u * u / (n * n));
  j.bend[2] = a * bb * (b / n - u * a * bb / (n * n));
}

void Torsion::gradient() {
  const auto count = roll_.size();
  slope_.setZero(), diagonal_.setZero();
  for (Eigen::Index j = 0; j < count; ++j) {
    Joint& joint = joints_[j];
    evaluate(joint, j > 0 ? roll_[j - 1] : 0.0, roll_[j]);
    slope_[j] += 0.5 * joint.by_chi + joint.twist * joint.tau;
    diagonal_[j] += 0.25 * joint.by_chi_twice + joint.twist;
    beside_[j] = 0.25 * joint.by_chi_twice - joint.twist;  // with the roll before
    if (j == 0) continue;
    slope_[j - 1] += 0.5 * joint.by_chi - joint.twist * joint.tau;
    diagonal_[j - 1] += 0.25 * joint.by_chi_twice + joint.twist;
  }
}

void Torsion::solve(VectorX& x) const {
  const auto count = x.size();
  // where the rolls have no least energy nearby (a rope that is about to flip over) the step only has to lead on
  constexpr double kLeast = 1e-3;  // of the torsional stiffness
  VectorX pivot = diagonal_;
  for (Eigen::Index j = 0; j < count; ++j) {
    if (j > 0) {
      const double factor = beside_[j] / pivot[j - 1];
      pivot[j] -= factor * beside_[j];
      x[j] -= factor * x[j - 1];
    }
    pivot[j] = std::max(pivot[j], kLeast * joints_[j].twist);
  }
  for (Eigen::Index j = count - 1; j >= 0; --j) {
    if (j + 1 < count) x[j] -= beside_[j + 1] * x[j + 1];
    x[j] /= pivot[j];
  }
}

void Torsion::place(const VectorX& theta) {
  constexpr int kMostSteps = 20;
  constexpr double kConverged = 1e-13, kLongest = 0.5;  // rad
  for (std::size_t j = 0; j < joints_.size(); ++j)
    joints_[j].theta[0] = theta[2 * j], joints_[j].theta[1] = theta[2 * j + 1];
  if (!roll_.allFinite()) roll_.setZero();  // a motion before has left all bounds
  VectorX step(roll_.size());
  for (int i = 0; i < kMostSteps; ++i) {
    gradient();
    step = slope_;
    solve(step);
    const double longest = step.cwiseAbs().maxCoeff();
    if (!(longest < 1e300)) break;  // the motion has left all bounds
    if (longest > kLongest) step *= kLongest / longest;
    roll_ -= step;
    if (longest < kConverged) break;
  }
  gradient();
  for (std::size_t j = 0; j < joints_.size(); ++j) {
    const Joint& joint = joints_[j];
    for (int i = 0; i < 2; ++i)
      torque_[2 * j + i] = -joint.k[i] * (joint.theta[i] - joint.rolled[i]) - joint.twist * joint.tau * joint.delta[i];
  }
}

double Torsion::energy() const {
  double energy = 0.0;
  for (const Joint& joint : joints_) {
    for (int i = 0; i < 2; ++i) energy += 0.5 * joint.k[i] * std::pow(joint.theta[i] - joint.rolled[i], 2);
    energy += 0.5 * joint.twist * joint.tau * joint.tau;
  }
  return energy;
}

void Torsion::add_stiffness(MatrixX& stiffness) const {
  const auto count = roll_.size();
  VectorX column(count);
  for (Eigen::Index j = 0; j < count; ++j) {
    const Joint& joint = joints_[j];
    const double moment = joint.twist * joint.tau;
    for (int i = 0; i < 2; ++i)
      for (int k = 0; k < 2; ++k)
        stiffness(2 * j + i, 2 * j + k) +=
            (i == k ? joint.k[i] : 0.0) + joint.twist * joint.delta[i] * joint.delta[k] + moment * joint.bend[i + k];
    for (int i = 0; i < 2; ++i) {
      // what this angle does to the balance of the rolls, and what they do to all angles
      column.setZero();
      column[j] = 0.5 * joint.mixed[i] + joint.twist * joint.delta[i];
      if (j > 0) column[j - 1] = 0.5 * joint.mixed[i] - joint.twist * joint.delta[i];
      solve(column);
      for (Eigen::Index l = 0; l < count; ++l) {
        const Joint& other = joints_[l];
        const double before = l > 0 ? column[l - 1] : 0.0, after = column[l];
        for (int k = 0; k < 2; ++k)
          stiffness(2 * l + k, 2 * j + i) -=
              0.5 * other.mixed[k] * (before + after) + other.twist * other.delta[k] * (after - before);
      }
    }
  }
}

void Torsion::add_unknown(const Tangent& d, Eigen::Ref<VectorX> to) const {
  if (d.stiffness.empty() && d.rest_angle.empty() && d.torsional_stiffness.empty()) return;
  const auto count = roll_.size();
  VectorX balance = VectorX::Zero(count);
  for (Eigen::Index j = 0; j < count; ++j) {
    const Joint& joint = joints_[j];
    double by_chi = 0.0, moment = 0.0;
    if (!d.stiffness.empty()) {
      const double k[2] = {d.stiffness[2 * j], d.stiffness[2 * j + 1]};
      const double x = joint.theta[0] - joint.rolled[0], y = joint.theta[1] - joint.rolled[1];
      by_chi += k[0] * x * joint.rolled[1] - k[1] * y * joint.rolled[0];
      to[2 * j] -= k[0] * x, to[2 * j + 1] -= k[1] * y;
    }
    if (!d.rest_angle.empty()) {
      // the rest angles' change, rolled as they are
      const double chi = 0.5 * ((j > 0 ? roll_[j - 1] : 0.0) + roll_[j]), c = std::cos(chi), s = std::sin(chi);
      const double p = c * d.rest_angle[2 * j] - s * d.rest_angle[2 * j + 1];
      const double q = s * d.rest_angle[2 * j] + c * d.rest_angle[2 * j + 1];
      const double x = joint.theta[0] - joint.rolled[0], y = joint.theta[1] - joint.rolled[1];
      by_chi += joint.k[0] * (x * q - p * joint.rolled[1]) - joint.k[1] * (y * p - q * joint.rolled[0]);
      to[2 * j] += joint.k[0] * p, to[2 * j + 1] += joint.k[1] * q;
    }
    if (!d.torsional_stiffness.empty()) {
      moment = d.torsional_stiffness[j] * joint.tau;
      for (int i = 0; i < 2; ++i) to[2 * j + i] -= moment * joint.delta[i];
    }
    balance[j] += 0.5 * by_chi + moment;
    if (j > 0) balance[j - 1] += 0.5 * by_chi - moment;
  }
  solve(balance);  // minus the change of the rolls
  for (Eigen::Index j = 0; j < count; ++j) {
    const Joint& joint = joints_[j];
    const double before = j > 0 ? balance[j - 1] : 0.0, after = balance[j];
    for (int i = 0; i < 2; ++i)
      to[2 * j + i] += 0.5 * joint.mixed[i] * (before + after) + joint.twist * joint.delta[i] * (after - before);
  }
}

}  // namespace chainsplat::dynamics
