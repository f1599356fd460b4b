// The stacked matrices of mathematics.md 3.5 and 3.6, written as they are printed: to be read beside the paper, and a
// formulation of its own to check the recursions against.
#include <algorithm>
#include <cmath>

#include "chainsplat/dynamics.h"
#include "src/math/decompositions.h"

namespace chainsplat::dynamics {
namespace {

using math::hat;
using math::Matrix6;

// W_i and dW_i/dV_i of mathematics.md 3.3 in {i}, for link j (from 1) with body twist v; `normal` is N, zero without a
// table. `across`, and its slope by v: the friction across the link of the velocity in the plane of bending.
void link_wrench(const Model& model, int j, const Vector6& v, const Vector3& normal, double normal_gravity,
                 Vector6& wrench, Matrix6& slope, double& across_friction, Vector6& across_slope) {
  const Parameters& p = model.parameters;
  const Vector3 d = model.chain.direction;
  const double l = model.chain.link_end(j) - model.chain.link_start(j);
  const Matrix3 eye = Matrix3::Identity(), across = eye - d * d.transpose();
  const Matrix3 tangent = normal.isZero() ? Matrix3::Zero().eval() : Matrix3(eye - normal * normal.transpose());
  const double x[3] = {0.5 * (1.0 - std::sqrt(0.6)), 0.5, 0.5 * (1.0 + std::sqrt(0.6))}, weight[3] = {5, 8, 5};
  const Vector3 a = model.chain.bending_axis;
  const Matrix3 plane = eye - a * a.transpose();
  wrench.setZero(), slope.setZero(), across_slope.setZero();
  across_friction = 0.0;
  for (int i = 0; i < 3; ++i) {
    const double w = weight[i] / 18.0;
    const Vector3 c = x[i] * l * d;
    Eigen::Matrix<double, 6, 3> z;
    z << hat(c), eye;
    const Vector3 velocity = z.transpose() * v, vt = tangent * velocity, vn = across * velocity;
    const double st = std::sqrt(vt.squaredNorm() + p.coulomb_speed * p.coulomb_speed);
    const double sn = std::sqrt(vn.squaredNorm() + p.drag_speed * p.drag_speed);
    const double coulomb = p.coulomb_friction[j - 1] * p.link_mass[j - 1] * normal_gravity;
    const double mu = p.viscous_friction[j - 1], b = p.air_linear[j - 1], q = p.air_quadratic[j - 1];
    const Vector3 f = -(mu * vt + coulomb / st * vt + b * vn + q * sn * vn) * w;
    const Matrix3 df = -(mu * tangent + coulomb * (tangent / st - vt * vt.transpose() / (st * st * st)) + b * across +
                         q * across * (sn * eye + vn * vn.transpose() / sn) * across) *
                       w;
    wrench += z * f;
    slope += z * df * z.transpose();
    const Vector3 vp = plane * velocity;
    const double sp = std::sqrt(vp.squaredNorm() + p.coulomb_speed * p.coulomb_speed);
    across_friction -= w * (mu + coulomb / sp) * a.cross(d).dot(vp);
    across_slope -=
        w * z * plane * ((mu + coulomb / sp) * eye - coulomb / (sp * sp * sp) * vp * vp.transpose()) * a.cross(d);
  }
}

}  // namespace

ClosedForm closed_form(const Model& model, const trajectory::BaseMotion& base, const VectorX& theta,
                       const VectorX& thetadot) {
  const int n = model.chain.angles(), size = 6 * n;
  const Parameters& p = model.parameters;
  Vector3 gravity = p.gravity;
  if (p.table_normal && p.table_carries_weight) gravity -= *p.table_normal * p.table_normal->dot(gravity);

  MatrixX a = MatrixX::Zero(size, n), g = MatrixX::Zero(size, size), w = MatrixX::Zero(size, size);
  math::Matrix6 first;  // X_1
  for (int i = 0; i < n; ++i) {
    const math::Pose neighbor = (i == 0 ? model.home[0] : model.home[i - 1].inverse() * model.home[i]) *
                                math::exp_se3(model.axis[i] * theta[i]);
    const math::Matrix6 x = math::adjoint(neighbor.inverse());
    a.block<6, 1>(6 * i, i) = model.axis[i];
    g.block<6, 6>(6 * i, 6 * i) = model.inertia[i];
    if (i == 0)
      first = x;
    else
      w.block<6, 6>(6 * i, 6 * (i - 1)) = x;
  }
  const MatrixX l = (MatrixX::Identity(size, size) - w).inverse();
  const auto stacked = [&](const Vector6& x) {
    VectorX out = VectorX::Zero(size);
    out.head<6>() = first * x;
    return out;
  };
  Vector6 weight = Vector6::Zero();
  weight.tail<3>() = base.pose.rotation.transpose() * gravity;

  const auto bias_matrix = [&](const VectorX& v) -> MatrixX {  // Q
    MatrixX ad_turn = MatrixX::Zero(size, size), ad_v = MatrixX::Zero(size, size);
    for (int i = 0; i < n; ++i) {
      ad_turn.block<6, 6>(6 * i, 6 * i) = math::ad(model.axis[i] * thetadot[i]);
      ad_v.block<6, 6>(6 * i, 6 * i) = math::ad(v.segment<6>(6 * i));
    }
    return g * l * ad_turn + ad_v.transpose() * g;
  };

  ClosedForm out;
  const MatrixX la = l * a, projection = la.transpose();
  const VectorX turn = a * thetadot;
  const VectorX v = l * (turn + stacked(base.velocity));
  const MatrixX q = bias_matrix(v), q_fixed = bias_matrix(l * turn);
  out.mass = projection * g * la;
  out.coriolis = -projection * q_fixed * l * turn;
  out.gravity = -projection * g * l * stacked(weight);
  out.base = projection * (g * l * stacked(base.acceleration) - q * v) - out.coriolis;

  VectorX wrenches = VectorX::Zero(size);
  MatrixX wrench_slope = MatrixX::Zero(size, size);
  const bool rolls = p.table_normal && !p.roll_lever.empty();
  VectorX across = VectorX::Zero(n);
  MatrixX across_slope = MatrixX::Zero(n, size), roll = MatrixX::Zero(n, n);
  Matrix3 rotation = base.pose.rotation;
  for (int i = 0; i < n; ++i) {
    rotation = rotation * math::exp_so3(model.axis[i].head<3>() * theta[i]);
    const int link = model.chain.child_link[i];
    if (model.chain.last_angle(link) != i) continue;
    const Vector3 normal = p.table_normal ? Vector3(rotation.transpose() * *p.table_normal) : Vector3::Zero().eval();
    const double normal_gravity = p.table_normal ? std::abs(p.gravity.dot(*p.table_normal)) : 0.0;
    Vector6 wrench;
    Matrix6 link_slope;
    Vector6 roll_slope;
    link_wrench(model, link, v.segment<6>(6 * i), normal, normal_gravity, wrench, link_slope, across[i], roll_slope);
    across_slope.block<1, 6>(i, 6 * i) = roll_slope.transpose();
    wrenches.segment<6>(6 * i) = wrench;
    wrench_slope.block<6, 6>(6 * i, 6 * i) = link_slope;
  }
  for (int k = 0; rolls && k < n; ++k)
    for (int i = 0; i < n; ++i) {
      const int link = model.chain.child_link[i];
      const double middle = 0.5 * (model.chain.link_start(link) + model.chain.link_end(link));
      roll(k, i) =
          p.roll_lever[k] * std::min(model.chain.link_start(model.chain.child_link[k]), middle) / model.chain.length;
    }
  out.friction = projection * wrenches - roll * across;

  MatrixX ad_v = MatrixX::Zero(size, size), coadjoint = MatrixX::Zero(size, size);
  for (int i = 0; i < n; ++i) {
    const Vector6 twist = v.segment<6>(6 * i);
    ad_v.block<6, 6>(6 * i, 6 * i) = math::ad(twist);
    coadjoint.block<6, 6>(6 * i, 6 * i) = math::coadjoint(model.inertia[i] * twist);
  }
  MatrixX slope = projection * (wrench_slope * la + q * la - g * l * ad_v * a + coadjoint * la);
  slope -= roll * across_slope * la;
  for (int i = 0; i < n; ++i) slope(i, i) -= p.damping[i];
  out.velocity_jacobian = out.mass.ldlt().solve(slope);
  return out;
}

}  // namespace chainsplat::dynamics
