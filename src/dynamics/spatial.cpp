#include "spatial.h"

#include <cmath>

namespace chainsplat::dynamics {
namespace {

void add_skew(Matrix3& m, double scale, const Vector3& w) {
  m(0, 1) -= scale * w.z(), m(1, 0) += scale * w.z();
  m(2, 0) -= scale * w.y(), m(0, 2) += scale * w.y();
  m(1, 2) -= scale * w.x(), m(2, 1) += scale * w.x();
}

double dot(const Vector6& x, const Vector6& y) {
  return x[0] * y[0] + x[1] * y[1] + x[2] * y[2] + x[3] * y[3] + x[4] * y[4] + x[5] * y[5];
}

}  // namespace

RigidInertia world_inertia(double mass, double center, double transverse, double axial, const Vector3& origin,
                           const Vector3& direction) {
  const Vector3 c = origin + center * direction;
  RigidInertia out;
  out.mass = mass;
  out.moment = mass * c;
  out.rotational = (axial - transverse) * direction * direction.transpose() - mass * c * c.transpose();
  out.rotational.diagonal().array() += transverse + mass * c.squaredNorm();
  return out;
}

SpatialEngine::SpatialEngine(const Model& m) : Engine(m) {
  for (const Vector6& a : model.axis) local_axis_.push_back(a.head<3>());
  for (auto* v : {&axis, &inner_velocity, &inner_acceleration, &turn, &psi_, &weighted_axis_}) v->resize(angles);
  rotation.resize(angles);
  origin.resize(link_count), direction.resize(link_count);
  for (auto* v : {&velocity, &link_acceleration, &wrench, &body_force}) v->resize(link_count);
  inertia.resize(link_count), composite_inertia_.resize(link_count);
  unit_.resize(link_count), slope_.resize(link_count), turning_.resize(link_count);
  if (rolls) roll_slope_.resize(link_count);
}

// W_j (mathematics.md 3.3) in world axes; with `slopes`, subtracts dW/dV from slope_[j] and sets turning_[j] =
// (dW/dN)[N].
void SpatialEngine::friction(int j, bool slopes) {
  const LinkConstants& link = links[j];
  wrench[j].setZero();
  if (slopes) turning_[j].setZero();
  if (rolls) roll_friction[j] = 0.0, roll_slope_[j].setZero();
  const bool table = link.viscous > 0.0 || link.coulomb > 0.0;
  const bool air = link.air_linear > 0.0 || link.air_quadratic > 0.0;
  if (!table && !air) return;
  const double vs2 = model.parameters.coulomb_speed * model.parameters.coulomb_speed;
  const double ve2 = model.parameters.drag_speed * model.parameters.drag_speed;
  const Vector3 w = velocity[j].head<3>();
  const Vector3& d = direction[j];
  for (int g = 0; g < 3; ++g) {
    const Vector3 c = origin[j] + kGaussPoint[g] * link.length * d;
    const Vector3 v = velocity[j].tail<3>() + w.cross(c);
    Vector3 f = Vector3::Zero();
    Matrix3 df = Matrix3::Zero(), turning = Matrix3::Zero();
    if (table) {
      const double along = normal().dot(v);
      const Vector3 vt = v - along * normal();
      const double s = std::sqrt(vt.squaredNorm() + vs2);
      const double rate = (link.viscous + link.coulomb / s) * kGaussWeight[g];
      f -= rate * vt;
      if (slopes) {
        // df/dv_t, symmetric, and its composition with dv_t/dv = I - N N^T and dv_t/dN [N] = -(N v^T + (N.v) I)[N]
        const double bend = link.coulomb / (s * s * s) * kGaussWeight[g];
        Matrix3 slope = bend * vt * vt.transpose();
        slope.diagonal().array() -= rate;
        df += slope;
        df += rate * normal() * normal().transpose();  // v_t is perpendicular to N: slope N = -rate N
        Matrix3 skew = Matrix3::Zero();
        add_skew(skew, 1.0, normal());
        turning = -slope * (normal() * v.cross(normal()).transpose() + along * skew);
      }
      if (rolls) {  // of the velocity in the plane of bending
        const Vector3 across = bending_axis_.cross(d), vp = v - bending_axis_.dot(v) * bending_axis_;
        const double slowness = 1.0 / std::sqrt(vp.squaredNorm() + vs2);
        const double drag = (link.viscous + link.coulomb * slowness) * kGaussWeight[g];
        roll_friction[j] -= drag * across.dot(v);
        if (slopes) {
          const double bend = link.coulomb * slowness * slowness * slowness * kGaussWeight[g];
          const Vector3 slope = bend * across.dot(v) * vp - drag * across;
          roll_slope_[j].head<3>() += c.cross(slope);
          roll_slope_[j].tail<3>() += slope;
        }
      }
    }
    if (air) {
      const Vector3 vn = v - d.dot(v) * d;
      const double s = std::sqrt(vn.squaredNorm() + ve2);
      const double rate = (link.air_linear + link.air_quadratic * s) * kGaussWeight[g];
      f -= rate * vn;
      if (slopes) {
        df -= (link.air_quadratic / s * kGaussWeight[g]) * vn * vn.transpose();
        df += rate * d * d.transpose();
        df.diagonal().array() -= rate;
      }
    }
    wrench[j].head<3>() += c.cross(f);
    wrench[j].tail<3>() += f;
    if (slopes) {
      Matrix3 arm = Matrix3::Zero();
      add_skew(arm, 1.0, c);
      const Matrix3 moment = arm * df;
      slope_[j].topLeftCorner<3, 3>() += moment * arm;  // -[c] df [c]^T
      slope_[j].topRightCorner<3, 3>() -= moment;
      slope_[j].bottomLeftCorner<3, 3>() -= moment.transpose();
      slope_[j].bottomRightCorner<3, 3>() -= df;
      if (table) {
        turning_[j].topRows<3>() += arm * turning;
        turning_[j].bottomRows<3>() += turning;
      }
    }
  }
}

void SpatialEngine::place(const trajectory::BaseMotion& base, const VectorX& theta, const VectorX& thetadot,
                          bool slopes) {
  const Matrix3& r0 = base.pose.rotation;
  base_rotation_ = r0;
  bending_axis_ = r0 * model.chain.bending_axis;
  base_velocity_ << r0 * base.velocity.head<3>(), r0 * base.velocity.tail<3>();
  base_turn_ << r0 * base.acceleration.head<3>(), r0 * base.acceleration.tail<3>();
  base_acceleration_ << base_turn_.head<3>(), base_turn_.tail<3>() - gravity();
  set_state(theta, thetadot);

  Matrix3 r = r0;
  Vector3 position = model.chain.link_end(0) * (r0 * model.chain.direction);
  Vector6 v = base_velocity_, a = base_acceleration_;
  for (int j = 0; j < link_count; ++j) {
    const LinkConstants& link = links[j];
    for (int k = link.first_angle; k < link.end_angle; ++k) {
      const Vector3 w = r * local_axis_[k];
      axis[k] << w, position.cross(w);
      inner_velocity[k] = v;
      inner_acceleration[k] = a;
      turn[k] = cross(v, axis[k]);
      v += axis[k] * thetadot[k];
      a += turn[k] * thetadot[k];
      // r exp([axis] theta)
      const Vector3& n = local_axis_[k];
      const double s = std::sin(theta[k]), c = std::cos(theta[k]);
      Matrix3 e = (1.0 - c) * n * n.transpose();
      e.diagonal().array() += c;
      add_skew(e, s, n);
      r = (r * e).eval();
      rotation[k] = r;
    }
    origin[j] = position;
    direction[j] = r * model.chain.direction;
    velocity[j] = v;
    link_acceleration[j] = a;
    inertia[j] = world_inertia(link.mass, link.center, link.transverse, link.axial, position, direction[j]);
    if (slopes) {
      const Vector3 w = v.head<3>(), u = v.tail<3>();
      const Matrix3& inertia3 = inertia[j].rotational;
      Matrix3 skew = Matrix3::Zero(), moment = Matrix3::Zero(), speed = Matrix3::Zero();
      add_skew(skew, 1.0, w), add_skew(moment, 1.0, inertia[j].moment), add_skew(speed, 1.0, u);
      Matrix3 t = 2.0 * skew * inertia3 - inertia3.trace() * skew - 2.0 * moment * speed;
      const Vector3 momentum = inertia[j].mass * u - inertia[j].moment.cross(w);
      Matrix3 bottom = Matrix3::Zero();
      add_skew(bottom, -2.0, momentum);
      slope_[j].setZero();
      slope_[j].topLeftCorner<3, 3>() = t;
      slope_[j].bottomLeftCorner<3, 3>() = bottom;
    }
    friction(j, slopes);
    position += link.length * direction[j];
  }

  // inward: composite inertia and force
  for (int j = link_count - 1; j >= 0; --j) {
    composite_inertia_[j] = inertia[j];
    body_force[j] = inertia[j] * link_acceleration[j] + cross_dual(velocity[j], inertia[j] * velocity[j]) - wrench[j];
    if (j + 1 < link_count) {
      composite_inertia_[j] += composite_inertia_[j + 1];
      body_force[j] += body_force[j + 1];
      if (slopes) {
        slope_[j] += slope_[j + 1];
        turning_[j] += turning_[j + 1];
      }
    }
    for (int k = links[j].first_angle; k < links[j].end_angle; ++k) {
      bias[k] = dot(axis[k], body_force[j]);
      weighted_axis_[k] = composite_inertia_[j] * axis[k];
      for (int i = 0; i <= k; ++i) mass(k, i) = dot(weighted_axis_[k], axis[i]);
    }
  }
  for (int k = 0; k < angles; ++k)
    for (int i = 0; i < k; ++i) mass(i, k) = mass(k, i);
  add_roll();
  force = torque - bias;
}

void SpatialEngine::inverse_torque() {
  Vector6 added = Vector6::Zero();
  for (int j = 0; j < link_count; ++j) {
    for (int k = links[j].first_angle; k < links[j].end_angle; ++k) {
      inner_acceleration[k] += added;
      psi_[k] = cross(inner_acceleration[k], axis[k]) + cross(inner_velocity[k], turn[k]);
      added += axis[k] * acceleration[k];
    }
    link_acceleration[j] += added;
  }
  for (int j = link_count - 1; j >= 0; --j) {
    body_force[j] = inertia[j] * link_acceleration[j] + cross_dual(velocity[j], inertia[j] * velocity[j]) - wrench[j];
    if (j + 1 < link_count) body_force[j] += body_force[j + 1];
    for (int k = links[j].first_angle; k < links[j].end_angle; ++k) inverse[k] = dot(axis[k], body_force[j]);
  }
  if (rolls) inverse += roll_torque;
}

void SpatialEngine::linearize(const Vector6& base_jerk) {
  inverse_torque();
  // the base moves like one more angle: it turns with its own velocity while its components change at their rates
  const Vector6& base_turn = base_turn_;
  Vector6 base_change;
  base_change << base_rotation_ * base_jerk.head<3>(),
      base_rotation_ * base_jerk.tail<3>() + base_velocity_.head<3>().cross(gravity());
  base_change += cross(base_velocity_, base_turn);
  const Vector3 base_spin = base_velocity_.head<3>();
  const Parameters& p = model.parameters;

  for (int j = 0; j < link_count; ++j) {
    const Matrix6& e = slope_[j];
    for (int k = links[j].first_angle; k < links[j].end_angle; ++k) {
      const Vector6 velocity_row = e.transpose() * axis[k];
      const Vector6& inertia_row = weighted_axis_[k];
      const Vector3 normal_row = has_table() ? Vector3(turning_[j].transpose() * axis[k]) : Vector3::Zero().eval();
      drive_rate[k] = -(dot(inertia_row, base_change) + dot(velocity_row, base_turn) - normal_row.dot(base_spin));
      // outer angle k (row) against inner or own angle i (column)
      for (int i = 0; i <= k; ++i) {
        double own = dot(inertia_row, psi_[i]) + dot(velocity_row, turn[i]);
        if (has_table()) own -= normal_row.dot(axis[i].head<3>());
        stiffness(k, i) = own;
        damping(k, i) = 2.0 * dot(inertia_row, turn[i]) + dot(velocity_row, axis[i]);
      }
      Vector6 column = composite_inertia_[j] * psi_[k] + e * turn[k] + cross_dual(axis[k], body_force[j]);
      if (has_table()) column -= turning_[j] * axis[k].head<3>();
      const Vector6 speed_column = composite_inertia_[j] * (2.0 * turn[k]) + e * axis[k];
      for (int i = 0; i < k; ++i) {
        stiffness(i, k) = dot(axis[i], column);
        damping(i, k) = dot(axis[i], speed_column);
      }
      if (!torsion().present) stiffness(k, k) += p.stiffness[k];
      damping(k, k) += p.damping[k];
    }
  }
  linearize_torsion();
  for (int j = 0; rolls && j < link_count; ++j) {
    roll_by_time[j] = dot(roll_slope_[j], base_turn);
    for (int i = 0; i < links[j].end_angle; ++i)
      roll_by_angle(j, i) = dot(roll_slope_[j], turn[i]), roll_by_rate(j, i) = dot(roll_slope_[j], axis[i]);
  }
  linearize_roll();
}

void SpatialEngine::base_slopes(BaseSlopes& slopes) const {
  slopes.acceleration.resize(angles, 6), slopes.velocity.resize(angles, 6), slopes.rotation.resize(angles, 3);
  const Matrix3& r = base_rotation_;
  for (int j = 0; j < link_count; ++j)
    for (int k = links[j].first_angle; k < links[j].end_angle; ++k) {
      const Vector6 velocity_row = slope_[j].transpose() * axis[k];
      const Vector6& inertia_row = weighted_axis_[k];
      for (int c = 0; c < 6; ++c) {
        Vector6 unit = Vector6::Zero();
        unit.segment<3>(c < 3 ? 0 : 3) = r.col(c % 3);
        slopes.acceleration(k, c) = dot(inertia_row, unit);
        // E u has the acceleration I (u x V) of bodies that carry the base's own velocity along; here dV_0 stays
        slopes.velocity(k, c) = dot(velocity_row, unit) + dot(inertia_row, cross(base_velocity_, unit));
        for (int link = 0; rolls && link < link_count; ++link)
          slopes.velocity(k, c) += roll_map(k, link) * dot(roll_slope_[link], unit);
      }
      for (int c = 0; c < 3; ++c) {
        // with everything turned but gravity and the table
        const Vector3 spin = r.col(c);
        slopes.rotation(k, c) = inertia_row.tail<3>().dot(spin.cross(gravity()));
        if (has_table()) slopes.rotation(k, c) -= axis[k].dot(turning_[j] * spin);
      }
    }
}

void SpatialEngine::unknown_forces(std::span<const Tangent> unknowns, MatrixX& forces) {
  const Parameters& parameters = model.parameters;
  // wrenches of a unit of each link parameter, as they enter F_i (external ones with a minus)
  for (int j = 0; j < link_count; ++j) {
    const LinkConstants& link = links[j];
    const double l = link.length, r = parameters.radius;
    UnitWrenches& unit = unit_[j];
    const auto inertial = [&](const RigidInertia& body) -> Vector6 {
      return body * link_acceleration[j] + cross_dual(velocity[j], body * velocity[j]);
    };
    unit.mass =
        inertial(world_inertia(1.0, 0.5 * l, l * l / 12.0 + 0.25 * r * r, 0.5 * r * r, origin[j], direction[j]));
    if (j + 1 == link_count) {
      const auto tip = [&](double length) {
        const Attached at = attached(l, length);
        return inertial(world_inertia(1.0, at.center, at.second - at.center * at.center, 0.0, origin[j], direction[j]));
      };
      unit_tip_ = tip(parameters.tip_length);
      unit_tip_length_ =
          (0.5 * parameters.tip_mass / l) * (tip(parameters.tip_length + l) - tip(parameters.tip_length - l));
    }
    for (Vector6* w : {&unit.viscous, &unit.coulomb, &unit.air_linear, &unit.air_quadratic}) w->setZero();
    if (rolls) roll_by_viscous[j] = roll_by_coulomb[j] = 0.0;
    for (int g = 0; g < 3; ++g) {
      const Vector3 c = origin[j] + kGaussPoint[g] * l * direction[j];
      const Vector3 v = velocity[j].tail<3>() + velocity[j].head<3>().cross(c);
      const auto add = [&](Vector6& w, double scale, const Vector3& f) {
        w.head<3>() += scale * kGaussWeight[g] * c.cross(f);
        w.tail<3>() += scale * kGaussWeight[g] * f;
      };
      if (rolls) {
        const double across = kGaussWeight[g] * bending_axis_.cross(direction[j]).dot(v);
        const double along = bending_axis_.dot(v);
        roll_by_viscous[j] -= across;
        roll_by_coulomb[j] -=
            across / std::sqrt(v.squaredNorm() - along * along + parameters.coulomb_speed * parameters.coulomb_speed);
      }
      if (has_table()) {
        const Vector3 vt = v - normal().dot(v) * normal();
        add(unit.viscous, 1.0, vt);
        add(unit.coulomb, 1.0 / std::sqrt(vt.squaredNorm() + parameters.coulomb_speed * parameters.coulomb_speed), vt);
      }
      const Vector3 vn = v - direction[j].dot(v) * direction[j];
      add(unit.air_linear, 1.0, vn);
      add(unit.air_quadratic, std::sqrt(vn.squaredNorm() + parameters.drag_speed * parameters.drag_speed), vn);
    }
    unit.mass += link.coulomb_per_mass * unit.coulomb;
    unit.coulomb *= link.coulomb_per_coefficient;
  }
  for (std::size_t p = 0; p < unknowns.size(); ++p) {
    const Tangent& d = unknowns[p];
    auto column = forces.col(static_cast<Eigen::Index>(p));
    joint_forces(d, column);
    if (!moves_links(d)) continue;
    Vector6 sum = Vector6::Zero();
    if (d.tip_mass != 0.0) sum += d.tip_mass * unit_tip_;
    if (d.tip_length != 0.0) sum += d.tip_length * unit_tip_length_;
    for (int j = link_count - 1; j >= 0; --j) {
      if (!d.link_mass.empty()) sum += d.link_mass[j] * unit_[j].mass;
      if (!d.viscous_friction.empty()) sum += d.viscous_friction[j] * unit_[j].viscous;
      if (!d.coulomb_friction.empty()) sum += d.coulomb_friction[j] * unit_[j].coulomb;
      if (!d.air_linear.empty()) sum += d.air_linear[j] * unit_[j].air_linear;
      if (!d.air_quadratic.empty()) sum += d.air_quadratic[j] * unit_[j].air_quadratic;
      for (int k = links[j].first_angle; k < links[j].end_angle; ++k) column[k] -= dot(axis[k], sum);
    }
  }
}

// mathematics.md 3.4, in world axes: X = I, and the massless bodies of a joint take part with zero own inertia.
bool SpatialEngine::articulated_acceleration() {
  std::vector<Vector6> u_vector(angles);
  VectorX pivot(angles), u(angles);
  Matrix6 articulated = Matrix6::Zero();
  Vector6 bias_force = Vector6::Zero();
  for (int j = link_count - 1; j >= 0; --j) {
    const RigidInertia& body = inertia[j];
    Matrix3 moment = Matrix3::Zero();
    add_skew(moment, 1.0, body.moment);
    articulated.topLeftCorner<3, 3>() += body.rotational;
    articulated.topRightCorner<3, 3>() += moment;
    articulated.bottomLeftCorner<3, 3>() -= moment;
    articulated.bottomRightCorner<3, 3>().diagonal().array() += body.mass;
    bias_force += cross_dual(velocity[j], body * velocity[j]) - wrench[j];
    for (int k = links[j].end_angle - 1; k >= links[j].first_angle; --k) {
      u_vector[k] = articulated * axis[k];
      pivot[k] = dot(axis[k], u_vector[k]);
      if (!(pivot[k] > kSingular * mass(k, k))) {
        singular_angle = k;
        return false;
      }
      u[k] = torque[k] - (rolls ? roll_torque[k] : 0.0) - dot(axis[k], bias_force);
      articulated -= u_vector[k] * u_vector[k].transpose() / pivot[k];
      bias_force += articulated * (turn[k] * rates()[k]) + u_vector[k] * (u[k] / pivot[k]);
    }
  }
  Vector6 a = base_acceleration_;
  for (int k = 0; k < angles; ++k) {
    a += turn[k] * rates()[k];
    acceleration[k] = (u[k] - dot(u_vector[k], a)) / pivot[k];
    a += axis[k] * acceleration[k];
  }
  return true;
}

}  // namespace chainsplat::dynamics
