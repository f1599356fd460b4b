#include "base_motion.h"

#include <algorithm>
#include <cmath>

namespace chainsplat::planning {
namespace {

constexpr double kRounding = 1e-9;  // relative, of a limit that is met exactly

}  // namespace

Basis basis(Window window, double start, double duration, double time) {
  Basis out = Basis::Zero();
  const double s = (time - start) / duration;
  if (s < 0.0) return out;  // at the start itself the values from the right: the jerk jumps there
  if (s >= 1.0) {
    out(kBasisCount, 0) = 1.0;
    return out;
  }
  // window and blend with three derivatives; the windows reach 1 at s = 1/2
  double w[4], b[4];
  const double s2 = s * s, s3 = s2 * s;
  if (window == Window::smooth) {
    w[0] = 64.0 * s3 * (1.0 - s) * (1.0 - s) * (1.0 - s);
    w[1] = 64.0 * s2 * (3.0 + s * (-12.0 + s * (15.0 - 6.0 * s)));
    w[2] = 64.0 * s * (6.0 + s * (-36.0 + s * (60.0 - 30.0 * s)));
    w[3] = 64.0 * (6.0 + s * (-72.0 + s * (180.0 - 120.0 * s)));
    b[0] = s3 * (10.0 + s * (-15.0 + 6.0 * s));
    b[1] = s2 * (30.0 + s * (-60.0 + 30.0 * s));
    b[2] = s * (60.0 + s * (-180.0 + 120.0 * s));
    b[3] = 60.0 + s * (-360.0 + 360.0 * s);
  } else {
    w[0] = 16.0 * s2 * (1.0 - s) * (1.0 - s);
    w[1] = 16.0 * s * (2.0 + s * (-6.0 + 4.0 * s));
    w[2] = 16.0 * (2.0 + s * (-12.0 + 12.0 * s));
    w[3] = 16.0 * (-12.0 + 24.0 * s);
    b[0] = s2 * (3.0 - 2.0 * s);
    b[1] = 6.0 * s * (1.0 - s);
    b[2] = 6.0 - 12.0 * s;
    b[3] = -12.0;
  }
  constexpr double kSharpness = kBasisCount * kBasisCount;  // B^2 of mathematics.md 8
  for (int i = 0; i < kBasisCount; ++i) {
    const double u = s - i / (kBasisCount - 1.0), q = 2.0 * kSharpness * u;
    double f[4];
    f[0] = std::exp(-kSharpness * u * u);
    f[1] = -q * f[0];
    f[2] = (q * q - 2.0 * kSharpness) * f[0];
    f[3] = (6.0 * kSharpness - q * q) * q * f[0];
    out(i, 0) = w[0] * f[0];
    out(i, 1) = w[1] * f[0] + w[0] * f[1];
    out(i, 2) = w[2] * f[0] + 2.0 * w[1] * f[1] + w[0] * f[2];
    out(i, 3) = w[3] * f[0] + 3.0 * w[2] * f[1] + 3.0 * w[1] * f[2] + w[0] * f[3];
  }
  for (int d = 0; d < 4; ++d) out(kBasisCount, d) = b[d];
  double scale = 1.0;
  for (int d = 1; d < 4; ++d) out.col(d) *= scale /= duration;
  return out;
}

double Motion::end() const {
  double last = 0.0;
  for (const Piece& piece : pieces) last = std::max(last, piece.start + piece.duration);
  return last;
}

Coordinates coordinates(const Motion& motion, double time) {
  Coordinates c = Coordinates::Zero();
  c.col(0).head<3>() = motion.origin.translation;
  for (const Piece& piece : motion.pieces) {
    const Basis b = basis(motion.window, piece.start, piece.duration, time);
    for (std::size_t a = 0; a < motion.axes.size(); ++a) {
      const auto column = static_cast<Eigen::Index>(a);
      c.row(static_cast<int>(motion.axes[a])) += piece.weights.col(column).transpose() * b.topRows<kBasisCount>() +
                                                 piece.terminal[column] * b.row(kBasisCount);
    }
  }
  return c;
}

trajectory::BaseMotion base_from(const Motion& motion, const Coordinates& c, math::Vector6* jerk) {
  trajectory::BaseMotion out;
  out.pose.rotation = math::exp_so3(c(3, 0) * motion.up) * motion.origin.rotation;
  out.pose.translation = c.col(0).head<3>();
  const math::Matrix3 back = out.pose.rotation.transpose();
  const Vector3 axis = back * motion.up;  // constant: the base turns about it
  const Vector3 spin = c(3, 1) * axis, spin_rate = c(3, 2) * axis;
  const Vector3 v = back * c.col(1).head<3>(), a = back * c.col(2).head<3>();
  const Vector3 v_rate = a - spin.cross(v);
  out.velocity << spin, v;
  out.acceleration << spin_rate, v_rate;
  if (jerk)
    *jerk << c(3, 3) * axis, back * c.col(3).head<3>() - spin.cross(a) - spin_rate.cross(v) - spin.cross(v_rate);
  return out;
}

trajectory::BaseMotion base_at(const Motion& motion, double time) {
  return base_from(motion, coordinates(motion, time));
}

Peaks peaks(const Motion& motion, double from, double to, const Limits& limits, double step) {
  Peaks out;
  const int steps = std::max(1, static_cast<int>(std::ceil((to - from) / step)));
  const auto include = [&](double time) {
    const Coordinates c = coordinates(motion, time);
    out.velocity = std::max(out.velocity, c.col(1).head<3>().norm());
    out.acceleration = std::max(out.acceleration, c.col(2).head<3>().norm());
    out.jerk = std::max(out.jerk, c.col(3).head<3>().norm());
    out.stroke = std::max(out.stroke, (c.col(0).head<3>() - motion.origin.translation).cwiseAbs().maxCoeff());
    out.yaw_velocity = std::max(out.yaw_velocity, std::abs(c(3, 1)));
    out.yaw_acceleration = std::max(out.yaw_acceleration, std::abs(c(3, 2)));
    out.yaw_jerk = std::max(out.yaw_jerk, std::abs(c(3, 3)));
    out.turn = std::max(out.turn, std::abs(c(3, 0)));
  };
  for (int k = 0; k <= steps; ++k) include(from + (to - from) * k / steps);
  // the jerk jumps at both ends of a piece: just before, and after
  constexpr double kBefore = 1e-9;  // s
  for (const Piece& piece : motion.pieces)
    for (const double time : {piece.start, piece.start + piece.duration})
      for (const double side : {time - kBefore, time})
        if (side >= from && side <= to) include(side);
  const auto check = [&](double value, double limit, const char* name) {
    if (out.over.empty() && !(value <= limit * (1.0 + kRounding))) out.over = name;
  };
  check(out.velocity, limits.velocity, "velocity");
  check(out.acceleration, limits.acceleration, "acceleration");
  // the paper's window starts with a jump of the acceleration
  if (motion.window == Window::smooth) check(out.jerk, limits.jerk, "jerk");
  check(out.stroke, limits.stroke, "stroke");
  check(out.yaw_velocity, limits.yaw_velocity, "yaw velocity");
  check(out.yaw_acceleration, limits.yaw_acceleration, "yaw acceleration");
  if (motion.window == Window::smooth) check(out.yaw_jerk, limits.yaw_jerk, "yaw jerk");
  check(out.turn, limits.turn, "turn");
  return out;
}

}  // namespace chainsplat::planning
