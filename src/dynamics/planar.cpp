#include "planar.h"

#include <cmath>

#include "spatial.h"

namespace chainsplat::dynamics {
namespace {

using Planar = PlanarEngine::Planar;

void add(Planar& a, const Planar& b, double scale = 1.0) {
  a.turn += scale * b.turn, a.x += scale * b.x, a.y += scale * b.y;
}
double dot(const Planar& a, const Planar& b) { return a.turn * b.turn + a.x * b.x + a.y * b.y; }
// X x Y and X x* F of spatial.h.
Planar cross(const Planar& a, const Planar& b) {
  return {0.0, b.turn * a.y - a.turn * b.y, a.turn * b.x - b.turn * a.x};
}
Planar cross_dual(const Planar& a, const Planar& f) { return {a.x * f.y - a.y * f.x, -a.turn * f.y, a.turn * f.x}; }
// Of a force at a place.
Planar wrench_at(double x, double y, double fx, double fy) { return {x * fy - y * fx, fx, fy}; }
// A unit turn about a joint.
Planar axis_at(double x, double y) { return {1.0, y, -x}; }

}  // namespace

bool is_planar(const chain::Chain& chain) {
  if (chain.angles() != chain.links() - 1) return false;
  for (const Vector6& axis : chain.axes)
    if ((axis.head<3>() - chain.bending_axis).cwiseAbs().maxCoeff() > 0.0) return false;
  return std::abs(chain.bending_axis.dot(chain.direction)) < 1e-12;
}

std::unique_ptr<Engine> make_engine(const Model& model) {
  if (is_planar(model.chain)) return std::make_unique<PlanarEngine>(model);
  return std::make_unique<SpatialEngine>(model);
}

PlanarEngine::PlanarEngine(const Model& m) : Engine(m) {
  const Vector3 d = model.chain.direction, a = model.chain.bending_axis;
  plane_ << d, a.cross(d), a;
  const std::size_t n = static_cast<std::size_t>(angles);
  for (auto* v : {&cos_, &sin_, &px_, &py_, &lift_}) v->resize(n);
  for (auto* v : {&inner_v_, &inner_a_, &v_, &a_, &turn_k_, &wrench_, &force_}) v->resize(n);
  body_.resize(n), composite_.resize(n), slope_sum_.resize(n), units_.resize(n), roll_slope_.resize(n);
  for (const LinkConstants& link : links) {
    first_moment_.push_back(link.mass * link.center);
    across_.push_back(0.5 * link.axial);  // m r^2 / 4
    second_.push_back(link.transverse + link.mass * link.center * link.center - across_.back());
  }
}

// Inertial force of a body with twist v and acceleration a, without the fields.
Planar PlanarEngine::inertial(const Body& b, const Planar& v, const Planar& a) const {
  const auto times = [&](const Planar& t) -> Planar {
    return {(b.xx + b.yy) * t.turn + b.moment_x * t.y - b.moment_y * t.x, b.mass * t.x - t.turn * b.moment_y,
            b.mass * t.y + t.turn * b.moment_x};
  };
  Planar out = times(a);
  add(out, cross_dual(v, times(v)));
  return out;
}

Planar PlanarEngine::field(const Body& b, double xx, double xy, double yy) const {
  return {b.xx * xy + b.xy * yy - b.xy * xx - b.yy * xy, xx * b.moment_x + xy * b.moment_y,
          xy * b.moment_x + yy * b.moment_y};
}

// Drag across the link. In the plane it has one direction, n, and the velocity along n and the places are linear in the
// arc length: sums of three numbers a point are enough.
void PlanarEngine::air_friction(int j, bool slopes) {
  const LinkConstants& link = links[j];
  const double ve2 = model.parameters.drag_speed * model.parameters.drag_speed;
  const double c = cos_[j], si = sin_[j], jx = px_[j], jy = py_[j];
  const Planar v = v_[j];
  // by the twist: n . u = row . v, row = (lever + along, n), which is also the wrench of the force n
  const double lever = jx * c + jy * si;
  const double across = v.turn * lever - si * v.x + c * v.y;
  const double uz0 = slide_.z() - spin_.y() * jx + spin_.x() * jy, uz1 = spin_.x() * si - spin_.y() * c;
  double drag = 0.0, moment = 0.0, by_speed[3] = {}, by_z[3] = {};  // powers of the arc length
  for (int g = 0; g < 3; ++g) {
    const double along = kGaussPoint[g] * link.length, w = across + v.turn * along, uz = uz0 + uz1 * along;
    const double speed = std::sqrt(w * w + uz * uz + ve2);
    const double rate = (link.air_linear + link.air_quadratic * speed) * kGaussWeight[g];
    drag -= rate * w, moment -= rate * w * along;
    if (slopes) {
      const double bend = link.air_quadratic / speed * kGaussWeight[g];
      const double slope = rate + bend * w * w, slope_z = bend * w * uz;
      by_speed[0] += slope, by_speed[1] += slope * along, by_speed[2] += slope * along * along;
      by_z[0] += slope_z, by_z[1] += slope_z * along, by_z[2] += slope_z * along * along;
    }
  }
  add(wrench_[j], {lever * drag + moment, -si * drag, c * drag});
  if (!slopes) return;
  Slope& s = slope_sum_[j];
  const double first = lever * by_speed[0] + by_speed[1];
  s.e[0][0] += lever * (first + by_speed[1]) + by_speed[2];
  s.e[0][1] -= si * first, s.e[1][0] -= si * first;
  s.e[0][2] += c * first, s.e[2][0] += c * first;
  s.e[1][1] += si * si * by_speed[0], s.e[2][2] += c * c * by_speed[0];
  s.e[1][2] -= c * si * by_speed[0], s.e[2][1] -= c * si * by_speed[0];
  if (spin_.x() == 0.0 && spin_.y() == 0.0 && slide_.z() == 0.0) return;  // uz = 0
  const auto z = [&](double sum0, double sum1) -> Planar { return {lever * sum0 + sum1, -si * sum0, c * sum0}; };
  const Planar z0 = z(by_z[0], by_z[1]), z1 = z(by_z[1], by_z[2]);
  add(s.z, z0), add(s.zx, z0, jx), add(s.zx, z1, c), add(s.zy, z0, jy), add(s.zy, z1, si);
}

void PlanarEngine::friction(int j, bool slopes) {
  const LinkConstants& link = links[j];
  wrench_[j] = {};
  Slope& s = slope_sum_[j];
  if (slopes) s.turn_back[0] = s.turn_back[1] = s.turn_back[2] = s.z = s.zx = s.zy = {};
  if (rolls) roll_friction[j] = 0.0, roll_slope_[j] = {};
  if (link.air_linear > 0.0 || link.air_quadratic > 0.0) air_friction(j, slopes);
  if (link.viscous > 0.0 || link.coulomb > 0.0) table_friction(j, slopes);
}

void PlanarEngine::table_friction(int j, bool slopes) {
  const LinkConstants& link = links[j];
  Slope& s = slope_sum_[j];
  const double vs2 = model.parameters.coulomb_speed * model.parameters.coulomb_speed;
  const double nx = normal_here_.x(), ny = normal_here_.y(), nz = normal_here_.z();
  const Planar v = v_[j];
  const double c = cos_[j], si = sin_[j];
  for (int g = 0; g < 3; ++g) {
    const double along = kGaussPoint[g] * link.length, x = px_[j] + along * c, y = py_[j] + along * si;
    const double ux = v.x - v.turn * y, uy = v.y + v.turn * x;
    const double uz = slide_.z() - spin_.y() * x + spin_.x() * y;
    double xx = 0.0, xy = 0.0, yy = 0.0, xz = 0.0, yz = 0.0;
    const double lift = nx * ux + ny * uy + nz * uz;
    const double tx = ux - lift * nx, ty = uy - lift * ny, tz = uz - lift * nz;
    const double speed = 1.0 / std::sqrt(tx * tx + ty * ty + tz * tz + vs2);
    const double rate = (link.viscous + link.coulomb * speed) * kGaussWeight[g];
    const double fx = -rate * tx, fy = -rate * ty;
    if (slopes) {
      const double bend = link.coulomb * speed * speed * speed * kGaussWeight[g];
      xx = bend * tx * tx - rate * (1.0 - nx * nx), xy = bend * tx * ty + rate * nx * ny;
      yy = bend * ty * ty - rate * (1.0 - ny * ny);
      xz = bend * tx * tz + rate * nx * nz, yz = bend * ty * tz + rate * ny * nz;
      // f changes with the normal by -S (N (u dN) + (N u) dN), S = bend v_t v_t^T - rate
      const auto by_normal = [&](double dx, double dy, double dz) {
        const double turned = ux * dx + uy * dy + uz * dz;
        const double wx = nx * turned + lift * dx, wy = ny * turned + lift * dy, wz = nz * turned + lift * dz;
        const double part = bend * (tx * wx + ty * wy + tz * wz);
        return wrench_at(x, y, part * tx - rate * wx, part * ty - rate * wy);  // minus df
      };
      add(s.turn_back[0], by_normal(0.0, nz, -ny));
      add(s.turn_back[1], by_normal(-nz, 0.0, nx));
      add(s.turn_back[2], by_normal(ny, -nx, 0.0));
    }
    if (rolls) {  // of the velocity in the plane
      const double slowness = 1.0 / std::sqrt(ux * ux + uy * uy + vs2), across = c * uy - si * ux;
      const double drag = (link.viscous + link.coulomb * slowness) * kGaussWeight[g];
      roll_friction[j] -= drag * across;
      if (slopes) {
        const double turned = link.coulomb * slowness * slowness * slowness * kGaussWeight[g] * across;
        const double by_x = drag * si + turned * ux, by_y = turned * uy - drag * c;
        add(roll_slope_[j], wrench_at(x, y, by_x, by_y));
      }
    }
    add(wrench_[j], wrench_at(x, y, fx, fy));
    if (slopes) {
      // by the twist: u = v + turn (-y, x)
      const double qx = xy * x - xx * y, qy = yy * x - xy * y;
      s.e[0][0] -= qy * x - qx * y, s.e[0][1] -= qx, s.e[0][2] -= qy;
      s.e[1][0] -= qx, s.e[1][1] -= xx, s.e[1][2] -= xy;
      s.e[2][0] -= qy, s.e[2][1] -= xy, s.e[2][2] -= yy;
      const Planar z = wrench_at(x, y, xz, yz);
      add(s.z, z, -1.0), add(s.zx, z, -x), add(s.zy, z, -y);
    }
  }
}

void PlanarEngine::place(const trajectory::BaseMotion& base, const VectorX& theta, const VectorX& thetadot,
                         bool slopes) {
  const Matrix3 back = plane_.transpose();
  spin_ = back * base.velocity.head<3>();
  slide_ = back * base.velocity.tail<3>();
  spin_rate_ = back * base.acceleration.head<3>();
  slide_rate_ = back * base.acceleration.tail<3>();
  gravity_here_ = back * (base.pose.rotation.transpose() * gravity());
  if (has_table()) normal_here_ = back * (base.pose.rotation.transpose() * normal());
  set_state(theta, thetadot);

  const double wx = spin_.x(), wy = spin_.y(), vz = slide_.z();
  tidal_xx_ = -wy * wy, tidal_xy_ = wx * wy, tidal_yy_ = -wx * wx;
  Planar v{spin_.z(), slide_.x(), slide_.y()};
  Planar a{spin_rate_.z(), slide_rate_.x() - gravity_here_.x() + wy * vz,
           slide_rate_.y() - gravity_here_.y() - wx * vz};
  double x = model.chain.link_end(0), y = 0.0, bend = 0.0;
  for (int j = 0; j < angles; ++j) {
    const Planar s = axis_at(x, y);
    inner_v_[j] = v, inner_a_[j] = a;
    turn_k_[j] = cross(v, s);
    add(v, s, thetadot[j]);
    add(a, turn_k_[j], thetadot[j]);
    bend += theta[j];
    const double c = cos_[j] = std::cos(bend), si = sin_[j] = std::sin(bend);
    px_[j] = x, py_[j] = y;
    v_[j] = v, a_[j] = a;
    const double m = links[j].mass, h = first_moment_[j], hx = h * c, hy = h * si;
    const double along = second_[j], across = across_[j];
    body_[j] = {m,
                m * x + hx,
                m * y + hy,
                m * x * x + 2.0 * x * hx + along * c * c + across * si * si,
                m * x * y + x * hy + y * hx + (along - across) * c * si,
                m * y * y + 2.0 * y * hy + along * si * si + across * c * c};
    if (slopes) {
      Slope& slope = slope_sum_[j];
      const Body& b = body_[j];
      slope.e[0][0] = 2.0 * (b.moment_x * v.x + b.moment_y * v.y);
      slope.e[1][0] = 2.0 * (-b.mass * v.y - v.turn * b.moment_x);
      slope.e[2][0] = 2.0 * (b.mass * v.x - v.turn * b.moment_y);
      for (auto& row : slope.e) row[1] = row[2] = 0.0;
    }
    friction(j, slopes);
    x += links[j].length * c, y += links[j].length * si;
  }

  const bool tidal = wx != 0.0 || wy != 0.0;
  for (int j = angles - 1; j >= 0; --j) {
    Body& sum = composite_[j] = body_[j];
    Planar& f = force_[j] = inertial(body_[j], v_[j], a_[j]);
    if (tidal) add(f, field(body_[j], tidal_xx_, tidal_xy_, tidal_yy_));
    add(f, wrench_[j], -1.0);
    if (j + 1 < angles) {
      const Body& out = composite_[j + 1];
      sum.mass += out.mass, sum.moment_x += out.moment_x, sum.moment_y += out.moment_y;
      sum.xx += out.xx, sum.xy += out.xy, sum.yy += out.yy;
      add(f, force_[j + 1]);
    }
    const double jx = px_[j], jy = py_[j];
    bias[j] = f.turn + jy * f.x - jx * f.y;
    // s_i^T I s_j
    const double moment = sum.xx + sum.yy - sum.moment_x * jx - sum.moment_y * jy;
    const double fx = sum.mass * jy - sum.moment_y, fy = sum.moment_x - sum.mass * jx;
    for (int i = 0; i <= j; ++i) mass(i, j) = moment + py_[i] * fx - px_[i] * fy;
  }
  for (int j = 0; j < angles; ++j)
    for (int i = 0; i < j; ++i) mass(j, i) = mass(i, j);
  add_roll();
  for (int k = 0; k < angles; ++k) force[k] = torque[k] - bias[k];
  if (slopes)
    for (int j = angles - 2; j >= 0; --j) {
      Slope& sum = slope_sum_[j];
      const Slope& out = slope_sum_[j + 1];
      for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k) sum.e[i][k] += out.e[i][k];
      for (int i = 0; i < 3; ++i) add(sum.turn_back[i], out.turn_back[i]);
      add(sum.z, out.z), add(sum.zx, out.zx), add(sum.zy, out.zy);
    }
}

PlanarEngine::Planar PlanarEngine::inertia_row_of(int j) const {
  const Body& b = composite_[j];
  const double x = px_[j], y = py_[j];
  return {b.xx + b.yy - b.moment_x * x - b.moment_y * y, b.mass * y - b.moment_y, b.moment_x - b.mass * x};
}

PlanarEngine::Planar PlanarEngine::velocity_row_of(int j) const {
  const auto& e = slope_sum_[j].e;
  const double x = px_[j], y = py_[j];
  return {e[0][0] + y * e[1][0] - x * e[2][0], e[0][1] + y * e[1][1] - x * e[2][1],
          e[0][2] + y * e[1][2] - x * e[2][2]};
}

void PlanarEngine::linearize(const Vector6& base_jerk) {
  // the accelerations of the joints on top of what place() left
  Planar added;
  for (int j = 0; j < angles; ++j) {
    const Planar s = axis_at(px_[j], py_[j]);
    add(inner_a_[j], added);
    add(added, s, acceleration[j]);
    add(a_[j], added);
  }
  const bool tidal = spin_.x() != 0.0 || spin_.y() != 0.0;
  for (int j = angles - 1; j >= 0; --j) {
    Planar& f = force_[j] = inertial(body_[j], v_[j], a_[j]);
    if (tidal) add(f, field(body_[j], tidal_xx_, tidal_xy_, tidal_yy_));
    add(f, wrench_[j], -1.0);
    if (j + 1 < angles) add(f, force_[j + 1]);
    inverse[j] = f.turn + py_[j] * f.x - px_[j] * f.y;
  }
  if (rolls) inverse += roll_torque;

  // the base's own change in time
  const Matrix3 back = plane_.transpose();
  const Vector3 spin_second = back * base_jerk.head<3>();
  const Vector3 velocity_second = back * base_jerk.tail<3>() + spin_.cross(gravity_here_);
  const double wx = spin_.x(), wy = spin_.y(), vz = slide_.z();
  const double wx_rate = spin_rate_.x(), wy_rate = spin_rate_.y(), vz_rate = slide_rate_.z();
  const Planar base_v{spin_.z(), slide_.x(), slide_.y()};
  const Planar base_u{spin_rate_.z(), slide_rate_.x(), slide_rate_.y()};
  Planar base_psi{spin_second.z(), velocity_second.x() + wy_rate * vz + wy * vz_rate,
                  velocity_second.y() - wx_rate * vz - wx * vz_rate};
  add(base_psi, cross(base_v, base_u));
  const double rate_xx = -2.0 * wy * wy_rate, rate_xy = wx_rate * wy + wx * wy_rate, rate_yy = -2.0 * wx * wx_rate;
  // X turned back by a unit: X J - J X
  const double back_xx = 2.0 * tidal_xy_, back_xy = tidal_yy_ - tidal_xx_;

  const Parameters& p = model.parameters;
  for (int j = 0; j < angles; ++j) {
    const double x = px_[j], y = py_[j];
    const Planar s = axis_at(x, y);
    // psi: with the acceleration field's change at the joint, -X J p
    Planar psi = cross(inner_a_[j], s);
    add(psi, cross(inner_v_[j], turn_k_[j]));
    psi.x += tidal_xx_ * y - tidal_xy_ * x, psi.y += tidal_xy_ * y - tidal_yy_ * x;
    inner_a_[j] = psi;              // from here on
    lift_[j] = -(wy * y + wx * x);  // the z velocity's change at the base origin, -g J p
  }
  for (int j = 0; j < angles; ++j) {
    const Body& b = composite_[j];
    const Slope& e = slope_sum_[j];
    const double x = px_[j], y = py_[j];
    const Planar s = axis_at(x, y), u = turn_k_[j], psi = inner_a_[j];
    const Planar inertia_row = inertia_row_of(j), velocity_row = velocity_row_of(j);
    // what is the same for every inner angle: all fields turned back about the base origin
    Planar turned = e.turn_back[2];
    add(turned, field(b, back_xx, back_xy, -back_xx));
    add(turned, e.zx, wx), add(turned, e.zy, wy);  // g J = (w_x, w_y)
    const double turned_row = dot(s, turned), z_row = dot(s, e.z);

    Planar driven;
    for (int i = 0; i < 3; ++i) add(driven, e.turn_back[i], spin_[i]);  // the normal's own rate
    add(driven, field(b, rate_xx, rate_xy, rate_yy));
    add(driven, e.z, vz_rate), add(driven, e.zx, -wy_rate), add(driven, e.zy, wx_rate);
    drive_rate[j] = -(dot(inertia_row, base_psi) + dot(velocity_row, base_u) + dot(s, driven));

    for (int i = 0; i <= j; ++i) {
      const Planar& ui = turn_k_[i];
      const Planar& pi = inner_a_[i];
      stiffness(j, i) =
          dot(inertia_row, pi) + velocity_row.x * ui.x + velocity_row.y * ui.y + z_row * lift_[i] + turned_row;
      damping(j, i) = 2.0 * (inertia_row.x * ui.x + inertia_row.y * ui.y) + velocity_row.turn +
                      velocity_row.x * py_[i] - velocity_row.y * px_[i];
    }
    const auto inertia_times = [&](double tx, double ty) -> Planar {  // of a twist without turn
      return {b.moment_x * ty - b.moment_y * tx, b.mass * tx, b.mass * ty};
    };
    Planar column = inertia_times(psi.x, psi.y);
    for (int r = 0; r < 3; ++r)
      (r == 0 ? column.turn : r == 1 ? column.x : column.y) += e.e[r][1] * u.x + e.e[r][2] * u.y;
    add(column, turned), add(column, e.z, lift_[j]);
    add(column, cross_dual(s, force_[j]));
    Planar speed = inertia_times(2.0 * u.x, 2.0 * u.y);
    for (int r = 0; r < 3; ++r)
      (r == 0 ? speed.turn : r == 1 ? speed.x : speed.y) += e.e[r][0] + e.e[r][1] * y - e.e[r][2] * x;
    for (int i = 0; i < j; ++i) {
      stiffness(i, j) = column.turn + py_[i] * column.x - px_[i] * column.y;
      damping(i, j) = speed.turn + py_[i] * speed.x - px_[i] * speed.y;
    }
    stiffness(j, j) += p.stiffness[j];
    damping(j, j) += p.damping[j];
  }
  for (int j = 0; rolls && j < angles; ++j) {
    const Planar& e = roll_slope_[j];
    roll_by_time[j] = dot(e, base_u);
    for (int i = 0; i <= j; ++i)
      roll_by_angle(j, i) = dot(e, turn_k_[i]), roll_by_rate(j, i) = dot(e, axis_at(px_[i], py_[i]));
  }
  linearize_roll();
}

void PlanarEngine::base_slopes(BaseSlopes& slopes) const {
  slopes.acceleration.setZero(angles, 6), slopes.velocity.setZero(angles, 6), slopes.rotation.setZero(angles, 3);
  const double wx = spin_.x(), wy = spin_.y(), vz = slide_.z();
  const Planar base_v{spin_.z(), slide_.x(), slide_.y()};
  const Planar in_plane[3] = {{1.0, 0.0, 0.0}, {0.0, 1.0, 0.0}, {0.0, 0.0, 1.0}};
  constexpr int kComponent[3] = {2, 3, 4};  // of a twist in the plane's frame: turn about z, velocity along x and y
  for (int j = 0; j < angles; ++j) {
    const Body& b = composite_[j];
    const Slope& e = slope_sum_[j];
    const Planar s = axis_at(px_[j], py_[j]), inertia_row = inertia_row_of(j), velocity_row = velocity_row_of(j);
    for (int i = 0; i < 3; ++i) {
      slopes.acceleration(j, kComponent[i]) = dot(inertia_row, in_plane[i]);
      // see SpatialEngine::base_slopes
      double& by_velocity = slopes.velocity(j, kComponent[i]);
      by_velocity = dot(velocity_row, in_plane[i]) + dot(inertia_row, cross(base_v, in_plane[i]));
      for (int link = 0; rolls && link < angles; ++link)
        by_velocity += roll_map(j, link) * dot(roll_slope_[link], in_plane[i]);
    }
    // w_x, w_y and v_z: the fields o, X and g
    slopes.velocity(j, 0) = -inertia_row.y * vz + dot(s, field(b, 0.0, wy, -2.0 * wx)) + dot(s, e.zy);
    slopes.velocity(j, 1) = inertia_row.x * vz + dot(s, field(b, -2.0 * wy, wx, 0.0)) - dot(s, e.zx);
    slopes.velocity(j, 5) = inertia_row.x * wy - inertia_row.y * wx + dot(s, e.z);
    for (int c = 0; c < 3; ++c) {
      const Vector3 pull = Vector3::Unit(c).cross(gravity_here_);
      slopes.rotation(j, c) = inertia_row.x * pull.x() + inertia_row.y * pull.y() + dot(s, e.turn_back[c]);
    }
  }
  const Matrix3 back = plane_.transpose();
  for (MatrixX* m : {&slopes.acceleration, &slopes.velocity})
    for (int half : {0, 3}) m->middleCols<3>(half) *= back;
  slopes.rotation *= back;
}

void PlanarEngine::unknown_forces(std::span<const Tangent> unknowns, MatrixX& forces) {
  const Parameters& parameters = model.parameters;
  const bool tidal = spin_.x() != 0.0 || spin_.y() != 0.0;
  for (int j = 0; j < angles; ++j) {
    const LinkConstants& link = links[j];
    const double l = link.length, r = parameters.radius, x0 = px_[j], y0 = py_[j], c = cos_[j], si = sin_[j];
    Unit& unit = units_[j];
    const auto of = [&](double center, double along, double across) {
      const double hx = center * c, hy = center * si;
      const Body b{1.0,
                   x0 + hx,
                   y0 + hy,
                   x0 * x0 + 2.0 * x0 * hx + along * c * c + across * si * si,
                   x0 * y0 + x0 * hy + y0 * hx + (along - across) * c * si,
                   y0 * y0 + 2.0 * y0 * hy + along * si * si + across * c * c};
      Planar out = inertial(b, v_[j], a_[j]);
      if (tidal) add(out, field(b, tidal_xx_, tidal_xy_, tidal_yy_));
      return out;
    };
    unit.mass = of(0.5 * l, l * l / 3.0, 0.25 * r * r);
    if (j + 1 == angles) {
      const auto tip = [&](double length) { return of(attached(l, length).center, attached(l, length).second, 0.0); };
      unit_tip_planar_ = tip(parameters.tip_length);
      unit_tip_length_ = tip(parameters.tip_length + l);
      add(unit_tip_length_, tip(parameters.tip_length - l), -1.0);
      for (double* part : {&unit_tip_length_.turn, &unit_tip_length_.x, &unit_tip_length_.y})
        *part *= 0.5 * parameters.tip_mass / l;
    }
    unit.viscous = unit.coulomb = unit.air_linear = unit.air_quadratic = {};
    if (rolls) roll_by_viscous[j] = roll_by_coulomb[j] = 0.0;
    for (int g = 0; g < 3; ++g) {
      const double x = x0 + kGaussPoint[g] * l * c, y = y0 + kGaussPoint[g] * l * si, w = kGaussWeight[g];
      const double ux = v_[j].x - v_[j].turn * y, uy = v_[j].y + v_[j].turn * x;
      const double uz = slide_.z() - spin_.y() * x + spin_.x() * y;
      if (has_table()) {
        const double lift = normal_here_.x() * ux + normal_here_.y() * uy + normal_here_.z() * uz;
        const double tx = ux - lift * normal_here_.x(), ty = uy - lift * normal_here_.y(),
                     tz = uz - lift * normal_here_.z();
        const Planar f = wrench_at(x, y, w * tx, w * ty);
        add(unit.viscous, f);
        add(unit.coulomb, f,
            1.0 / std::sqrt(tx * tx + ty * ty + tz * tz + parameters.coulomb_speed * parameters.coulomb_speed));
        if (rolls) {
          const double across = w * (c * uy - si * ux);
          roll_by_viscous[j] -= across;
          roll_by_coulomb[j] -=
              across / std::sqrt(ux * ux + uy * uy + parameters.coulomb_speed * parameters.coulomb_speed);
        }
      }
      const double slide = c * ux + si * uy, tx = ux - slide * c, ty = uy - slide * si;
      const Planar f = wrench_at(x, y, w * tx, w * ty);
      add(unit.air_linear, f);
      add(unit.air_quadratic, f,
          std::sqrt(tx * tx + ty * ty + uz * uz + parameters.drag_speed * parameters.drag_speed));
    }
    add(unit.mass, unit.coulomb, link.coulomb_per_mass);
    const Planar coulomb = unit.coulomb;
    unit.coulomb = {};
    add(unit.coulomb, coulomb, link.coulomb_per_coefficient);
  }
  for (std::size_t q = 0; q < unknowns.size(); ++q) {
    const Tangent& d = unknowns[q];
    auto column = forces.col(static_cast<Eigen::Index>(q));
    joint_forces(d, column);
    if (!moves_links(d)) continue;
    Planar sum;
    if (d.tip_mass != 0.0) add(sum, unit_tip_planar_, d.tip_mass);
    if (d.tip_length != 0.0) add(sum, unit_tip_length_, d.tip_length);
    for (int j = angles - 1; j >= 0; --j) {
      if (!d.link_mass.empty()) add(sum, units_[j].mass, d.link_mass[j]);
      if (!d.viscous_friction.empty()) add(sum, units_[j].viscous, d.viscous_friction[j]);
      if (!d.coulomb_friction.empty()) add(sum, units_[j].coulomb, d.coulomb_friction[j]);
      if (!d.air_linear.empty()) add(sum, units_[j].air_linear, d.air_linear[j]);
      if (!d.air_quadratic.empty()) add(sum, units_[j].air_quadratic, d.air_quadratic[j]);
      column[j] -= sum.turn + py_[j] * sum.x - px_[j] * sum.y;
    }
  }
}

}  // namespace chainsplat::dynamics
