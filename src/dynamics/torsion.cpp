#include "torsion.h"

#include <algorithm>
#include <cmath>

namespace chainsplat::dynamics {
namespace {

constexpr double kLeastRetardation = 1e-3;  // s, of twist: shorter than anything that a camera sees
constexpr double kLeastPivot = 1e-3;        // of the torsional stiffness

}  // namespace

Torsion::Torsion(const Model& model) {
  const Parameters& p = model.parameters;
  present = !p.torsional_stiffness.empty();
  if (!present) return;
  double least = p.torsional_stiffness.front();
  for (std::size_t j = 0; j < p.torsional_stiffness.size(); ++j) {
    Joint joint{};
    for (std::size_t i = 0; i < 2; ++i)
      joint.k[i] = p.stiffness[2 * j + i], joint.d[i] = p.damping[2 * j + i], joint.rest[i] = p.rest_angle[2 * j + i];
    joint.twist = p.torsional_stiffness[j];
    least = std::min(least, joint.twist);
    // a material has one retardation time, in twist as in bending
    const double stiffness = joint.k[0] + joint.k[1], damping = joint.d[0] + joint.d[1];
    const double retardation = stiffness > 0.0 ? damping / stiffness : 0.0;
    joint.twist_damping = joint.twist * std::max(retardation, kLeastRetardation);
    if (retardation > kLeastRetardation)
      joint.by_damping = joint.twist / stiffness, joint.by_stiffness = -joint.twist * retardation / stiffness;
    joints_.push_back(joint);
  }
  rolls = static_cast<Eigen::Index>(joints_.size());
  for (VectorX* v : {&roll_, &rate_, &step_}) v->setZero(rolls);
  for (VectorX* v : {&torque_, &still_}) v->setZero(2 * rolls);
  elastic_.least = kLeastPivot * least;
  for (MatrixX* m : {&stiffness_, &damping_}) m->setZero(2 * rolls, 2 * rolls);
  for (MatrixX* m : {&moment_, &viscous_moment_}) m->setZero(2 * rolls, rolls);
  for (MatrixX* m : {&rate_by_angle_, &rate_by_rate_}) m->setZero(rolls, 2 * rolls);
  rate_by_roll_.setZero(rolls, rolls);
}

void Torsion::gather(double (Joint::*of)[4][4], Tridiagonal& to) const {
  to.diagonal.setZero(rolls), to.beside.resize(rolls);
  for (Eigen::Index j = 0; j < rolls; ++j) {
    const auto& m = joints_[j].*of;
    const double own = 0.25 * m[2][2] + m[3][3];
    to.diagonal[j] += own;
    if (j > 0) to.diagonal[j - 1] += own;
    to.beside[j] = 0.25 * m[2][2] - m[3][3];
  }
  to.factor();
}

void Torsion::add_to_balance(std::size_t joint, const double (&force)[4], VectorX& to) const {
  const auto j = static_cast<Eigen::Index>(joint);
  to[j] += 0.5 * force[2] + force[3];
  if (j > 0) to[j - 1] += 0.5 * force[2] - force[3];
}

void Torsion::balance(VectorX& to) const {
  to.setZero();
  for (std::size_t j = 0; j < joints_.size(); ++j) add_to_balance(j, joints_[j].force, to);
}

void Torsion::angles_by_rolls(double (Joint::*of)[4][4], MatrixX& to) const {
  to.setZero();
  for (Eigen::Index j = 0; j < rolls; ++j)
    for (int i = 0; i < 2; ++i) {
      const double* const row = (joints_[j].*of)[i];
      to(2 * j + i, j) = 0.5 * row[2] + row[3];
      if (j > 0) to(2 * j + i, j - 1) = 0.5 * row[2] - row[3];
    }
}

void Torsion::rolls_by_angles(double (Joint::*of)[4][4], MatrixX& to) const {
  to.setZero();
  for (Eigen::Index j = 0; j < rolls; ++j)
    for (int i = 0; i < 2; ++i) {
      const auto& m = joints_[j].*of;
      to(j, 2 * j + i) = 0.5 * m[2][i] + m[3][i];
      if (j > 0) to(j - 1, 2 * j + i) = 0.5 * m[2][i] - m[3][i];
    }
}

// The twist of a joint's own rotation. A joint that is folded back has none that one could tell; where w, the square of
// the cosine of half its bend, is small, it goes to 0 and on from there.
void Torsion::bend(const VectorX& theta) {
  constexpr double kFolded = 0.05, kSmooth = 0.01;  // of w: a bend of 150 degrees, and what takes its place at 180
  for (std::size_t j = 0; j < joints_.size(); ++j) {
    Joint& joint = joints_[j];
    for (int i = 0; i < 2; ++i) joint.angle[i] = theta[static_cast<Eigen::Index>(2 * j) + i];
    const double c[2] = {std::cos(joint.angle[0]), std::cos(joint.angle[1])},
                 s[2] = {std::sin(joint.angle[0]), std::sin(joint.angle[1])};
    // tan(alpha/2) tan(beta/2) = n / (4 w), n = sin(alpha) sin(beta)
    const double w = 0.25 * (1.0 + c[0]) * (1.0 + c[1]), fade = kSmooth * std::exp(-w / kFolded);
    const double n_by[2] = {c[0] * s[1], s[0] * c[1]}, n_twice[3] = {-s[0] * s[1], c[0] * c[1], -s[0] * s[1]};
    const double w_by[2] = {-0.25 * s[0] * (1.0 + c[1]), -0.25 * (1.0 + c[0]) * s[1]};
    const double w_twice[3] = {-0.25 * c[0] * (1.0 + c[1]), 0.25 * s[0] * s[1], -0.25 * (1.0 + c[0]) * c[1]};
    const double q = 4.0 * (w + fade), q_w = 4.0 * (1.0 - fade / kFolded), q_ww = 4.0 * fade / (kFolded * kFolded);
    const double u = s[0] * s[1] / q, uu = 1.0 + u * u;
    double by[2];
    for (int i = 0; i < 2; ++i) by[i] = (n_by[i] - u * q_w * w_by[i]) / q, joint.delta[i] = 2.0 * by[i] / uu;
    for (int i = 0; i < 2; ++i)
      for (int l = i; l < 2; ++l) {
        const double twice = (n_twice[i + l] - u * (q_ww * w_by[i] * w_by[l] + q_w * w_twice[i + l]) -
                              q_w * (by[l] * w_by[i] + by[i] * w_by[l])) /
                             q;
        joint.bend[i + l] = 2.0 * twice / uu - 4.0 * u * by[i] * by[l] / (uu * uu);
      }
    joint.own = 2.0 * std::atan(u);
  }
}

// Elastic forces over the rolls, and all elastic slopes, of a rope at rest.
void Torsion::turn(const VectorX& roll) {
  for (std::size_t j = 0; j < joints_.size(); ++j) {
    Joint& joint = joints_[j];
    const auto at = static_cast<Eigen::Index>(j);
    const double before = j > 0 ? roll[at - 1] : 0.0, chi = 0.5 * (before + roll[at]);
    const double c = std::cos(chi), s = std::sin(chi);
    double(&rest)[2] = joint.rolled;
    rest[0] = c * joint.rest[0] - s * joint.rest[1], rest[1] = s * joint.rest[0] + c * joint.rest[1];
    const double x = joint.angle[0] - rest[0], y = joint.angle[1] - rest[1];
    const double tau = joint.twisted = roll[at] - before + joint.own;
    const double *k = joint.k, *delta = joint.delta, moment = joint.twist * tau;
    joint.force[0] = k[0] * x + moment * delta[0], joint.force[1] = k[1] * y + moment * delta[1];
    joint.force[2] = k[0] * x * rest[1] - k[1] * y * rest[0], joint.force[3] = moment;
    double(&slope)[4][4] = joint.slope;
    for (int i = 0; i < 2; ++i)
      for (int l = 0; l < 2; ++l)
        slope[i][l] = (i == l ? k[i] : 0.0) + joint.twist * delta[i] * delta[l] + moment * joint.bend[i + l];
    slope[0][2] = slope[2][0] = k[0] * rest[1], slope[1][2] = slope[2][1] = -k[1] * rest[0];
    for (int i = 0; i < 2; ++i) slope[i][3] = slope[3][i] = joint.twist * delta[i];
    slope[2][2] = k[0] * (x * rest[0] + rest[1] * rest[1]) + k[1] * (y * rest[1] + rest[0] * rest[0]);
    slope[2][3] = slope[3][2] = 0.0, slope[3][3] = joint.twist;
  }
}

void Torsion::place(const VectorX& theta, const VectorX& thetadot, const VectorX& roll) {
  bend(theta);
  turn(roll);
  roll_ = roll;
  // the dampers: forces of the angles' rates first, which with the elastic ones say how fast the rolls turn
  for (std::size_t j = 0; j < joints_.size(); ++j) {
    Joint& joint = joints_[j];
    const double *angle = joint.angle, *d = joint.d, *delta = joint.delta, twist = joint.twist_damping;
    for (int i = 0; i < 2; ++i) joint.rate[i] = thetadot[static_cast<Eigen::Index>(2 * j) + i];
    double(&viscous)[4][4] = joint.viscous;
    for (int i = 0; i < 2; ++i)
      for (int l = 0; l < 2; ++l) viscous[i][l] = (i == l ? d[i] : 0.0) + twist * delta[i] * delta[l];
    viscous[0][2] = viscous[2][0] = d[0] * angle[1], viscous[1][2] = viscous[2][1] = -d[1] * angle[0];
    for (int i = 0; i < 2; ++i) viscous[i][3] = viscous[3][i] = twist * delta[i];
    viscous[2][2] = d[0] * angle[1] * angle[1] + d[1] * angle[0] * angle[0];
    viscous[2][3] = viscous[3][2] = 0.0, viscous[3][3] = twist;
    for (int i = 2; i < 4; ++i) joint.force[i] += viscous[i][0] * joint.rate[0] + viscous[i][1] * joint.rate[1];
  }
  gather(&Joint::viscous, dampers_);
  balance(rate_);
  dampers_.solve(rate_);
  rate_ = -rate_;
  for (std::size_t j = 0; j < joints_.size(); ++j) {
    Joint& joint = joints_[j];
    const auto at = static_cast<Eigen::Index>(j);
    const double before = j > 0 ? rate_[at - 1] : 0.0;
    joint.turning = 0.5 * (before + rate_[at]);
    const double twisting = rate_[at] - before;
    joint.along[0] = joint.rate[0] + joint.turning * joint.angle[1];
    joint.along[1] = joint.rate[1] - joint.turning * joint.angle[0];
    joint.twisting = twisting + joint.delta[0] * joint.rate[0] + joint.delta[1] * joint.rate[1];
    for (int i = 0; i < 2; ++i) {
      for (int l = 0; l < 2; ++l) joint.force[i] += joint.viscous[i][l] * joint.rate[l];
      joint.force[i] += joint.viscous[i][2] * joint.turning + joint.viscous[i][3] * twisting;
      torque_[2 * at + i] = joint.d[i] * joint.rate[i] - joint.force[i];
    }
    joint.force[2] += joint.viscous[2][2] * joint.turning, joint.force[3] += joint.viscous[3][3] * twisting;
  }
}

double Torsion::energy() const {
  double energy = 0.0;
  for (const Joint& joint : joints_) {
    for (int i = 0; i < 2; ++i) energy += 0.5 * joint.k[i] * std::pow(joint.angle[i] - joint.rolled[i], 2);
    energy += 0.5 * joint.twist * joint.twisted * joint.twisted;
  }
  return energy;
}

void Torsion::linearize() {
  for (Joint& joint : joints_) {
    // what the dampers' forces owe to the angles at given rates
    const double *d = joint.d, *delta = joint.delta, *bend = joint.bend, twist = joint.twist_damping;
    double(&slope)[4][4] = joint.slope;
    double faster[2];  // d tau' / d angle
    for (int l = 0; l < 2; ++l) faster[l] = bend[l] * joint.rate[0] + bend[l + 1] * joint.rate[1];
    for (int l = 0; l < 2; ++l) {
      for (int i = 0; i < 2; ++i) slope[i][l] += twist * (faster[l] * delta[i] + joint.twisting * bend[i + l]);
      slope[3][l] += twist * faster[l];
    }
    slope[0][1] += d[0] * joint.turning, slope[1][0] -= d[1] * joint.turning;
    slope[2][0] += d[1] * (joint.turning * joint.angle[0] - joint.along[1]);
    slope[2][1] += d[0] * (joint.turning * joint.angle[1] + joint.along[0]);
  }
  rolls_by_angles(&Joint::slope, rate_by_angle_);
  dampers_.solve(rate_by_angle_);
  rate_by_angle_ = -rate_by_angle_;
  rolls_by_angles(&Joint::viscous, rate_by_rate_);
  dampers_.solve(rate_by_rate_);
  rate_by_rate_ = -rate_by_rate_;
  gather(&Joint::slope, elastic_);
  rate_by_roll_.setZero();
  for (Eigen::Index j = 0; j < rolls; ++j) {
    rate_by_roll_(j, j) = -elastic_.diagonal[j];
    if (j > 0) rate_by_roll_(j, j - 1) = rate_by_roll_(j - 1, j) = -elastic_.beside[j];
  }
  dampers_.solve(rate_by_roll_);
  angles_by_rolls(&Joint::slope, moment_);
  angles_by_rolls(&Joint::viscous, viscous_moment_);
  moment_.noalias() += viscous_moment_ * rate_by_roll_;
  stiffness_.noalias() = viscous_moment_ * rate_by_angle_;
  damping_.noalias() = viscous_moment_ * rate_by_rate_;
  for (Eigen::Index j = 0; j < rolls; ++j)
    for (int i = 0; i < 2; ++i)
      for (int l = 0; l < 2; ++l) {
        stiffness_(2 * j + i, 2 * j + l) += joints_[j].slope[i][l];
        damping_(2 * j + i, 2 * j + l) += joints_[j].viscous[i][l] - (i == l ? joints_[j].d[i] : 0.0);
      }
}

void Torsion::change(const Tangent& unknown, std::size_t j, double (&to)[4]) const {
  const Joint& joint = joints_[j];
  double twist = 0.0, damping = 0.0;
  for (double& value : to) value = 0.0;
  for (int i = 0; i < 2; ++i) {
    const std::size_t at = 2 * j + static_cast<std::size_t>(i);
    const double across = i == 0 ? joint.rolled[1] : -joint.rolled[0],
                 lever = i == 0 ? joint.angle[1] : -joint.angle[0];
    if (!unknown.stiffness.empty()) {
      const double by = unknown.stiffness[at], off = joint.angle[i] - joint.rolled[i];
      to[i] += by * off, to[2] += by * off * across;
      damping += joint.by_stiffness * by;
    }
    if (!unknown.damping.empty()) {
      const double by = unknown.damping[at];
      to[i] += by * (joint.along[i] - joint.rate[i]), to[2] += by * joint.along[i] * lever;
      damping += joint.by_damping * by;
    }
  }
  if (!unknown.rest_angle.empty()) {
    // their change, rolled as they are
    const double chi =
        0.5 * ((j > 0 ? roll_[static_cast<Eigen::Index>(j) - 1] : 0.0) + roll_[static_cast<Eigen::Index>(j)]);
    const double c = std::cos(chi), s = std::sin(chi), *r = &unknown.rest_angle[2 * j];
    const double p = c * r[0] - s * r[1], q = s * r[0] + c * r[1];
    const double x = joint.angle[0] - joint.rolled[0], y = joint.angle[1] - joint.rolled[1];
    to[0] -= joint.k[0] * p, to[1] -= joint.k[1] * q;
    to[2] += joint.k[0] * (x * q - p * joint.rolled[1]) - joint.k[1] * (y * p - q * joint.rolled[0]);
  }
  if (!unknown.torsional_stiffness.empty()) {
    twist = unknown.torsional_stiffness[j];
    damping += joint.twist_damping / joint.twist * twist;
  }
  const double moment = twist * joint.twisted + damping * joint.twisting;
  to[0] += moment * joint.delta[0], to[1] += moment * joint.delta[1], to[3] += moment;
}

void Torsion::add_unknown(const Tangent& unknown, Eigen::Ref<VectorX> torque, VectorX* rate) const {
  if (unknown.stiffness.empty() && unknown.damping.empty() && unknown.rest_angle.empty() &&
      unknown.torsional_stiffness.empty())
    return;
  VectorX turning = VectorX::Zero(rolls);
  double by[4];
  for (std::size_t j = 0; j < joints_.size(); ++j) {
    change(unknown, j, by);
    add_to_balance(j, by, turning);
    for (int i = 0; i < 2; ++i) torque[static_cast<Eigen::Index>(2 * j) + i] -= by[i];
  }
  dampers_.solve(turning);  // minus the change of the rolls' rates
  torque += viscous_moment_ * turning;
  if (rate) *rate -= turning;
}

void Torsion::settle(const VectorX& theta) {
  constexpr int kMostSteps = 20;
  constexpr double kConverged = 1e-13, kLongest = 0.5;  // rad
  bend(theta);
  if (!roll_.allFinite()) roll_.setZero();  // a motion before has left all bounds
  for (int i = 0; i < kMostSteps; ++i) {
    turn(roll_);
    gather(&Joint::slope, elastic_);
    balance(step_);
    elastic_.solve(step_);
    const double longest = step_.cwiseAbs().maxCoeff();
    if (!(longest < 1e300)) break;  // the motion has left all bounds
    if (longest > kLongest) step_ *= kLongest / longest;
    roll_ -= step_;
    if (longest < kConverged) break;
  }
  step_ = roll_;
  place(theta, still_, step_);
}

void Torsion::add_settled_stiffness(MatrixX& stiffness) const {
  MatrixX angles(2 * rolls, rolls), following(rolls, 2 * rolls);
  Tridiagonal elastic{elastic_.least, {}, {}, {}};
  gather(&Joint::slope, elastic);
  angles_by_rolls(&Joint::slope, angles);
  rolls_by_angles(&Joint::slope, following);
  elastic.solve(following);
  stiffness.noalias() -= angles * following;
  for (Eigen::Index j = 0; j < rolls; ++j)
    for (int i = 0; i < 2; ++i)
      for (int l = 0; l < 2; ++l) stiffness(2 * j + i, 2 * j + l) += joints_[j].slope[i][l];
}

VectorX Torsion::settled_slope(const VectorX& theta, const Tangent& unknown) const {
  VectorX slope = VectorX::Zero(rolls);
  double by[4];
  for (std::size_t j = 0; j < joints_.size(); ++j) {
    change(unknown, j, by);
    for (int i = 0; i < 4; ++i)
      for (int l = 0; l < 2 && theta.size() > 0; ++l)
        by[i] += joints_[j].slope[i][l] * theta[static_cast<Eigen::Index>(2 * j) + l];
    add_to_balance(j, by, slope);
  }
  Tridiagonal elastic{elastic_.least, {}, {}, {}};
  gather(&Joint::slope, elastic);
  elastic.solve(slope);
  return -slope;
}

void Torsion::add_settled_unknown(const Tangent& unknown, Eigen::Ref<VectorX> to) const {
  if (unknown.stiffness.empty() && unknown.rest_angle.empty() && unknown.torsional_stiffness.empty()) return;
  double by[4];
  for (std::size_t j = 0; j < joints_.size(); ++j) {
    change(unknown, j, by);
    for (int i = 0; i < 2; ++i) to[static_cast<Eigen::Index>(2 * j) + i] -= by[i];
  }
  MatrixX angles(2 * rolls, rolls);
  angles_by_rolls(&Joint::slope, angles);
  to -= angles * settled_slope({}, unknown);
}

}  // namespace chainsplat::dynamics
