#include "sensitivities.h"

#include <cmath>

#include "dynamics/engine.h"

namespace chainsplat::planning {
namespace {

using dynamics::Engine;
using math::Matrix3;
using math::Vector6;

constexpr double kFrame = 1.0 / 30.0;  // s, what `substeps` counts in
constexpr double kProbe = 3e-6;        // e of the second derivatives: truncation and rounding both below 1e-8
constexpr double kAngleBound = 1e3;    // rad, beyond which a motion counts as diverged
constexpr double kRateBound = 1e5;     // rad/s
const double kGaussPoint[3] = {0.5 * (1.0 - std::sqrt(0.6)), 0.5, 0.5 * (1.0 + std::sqrt(0.6))};
constexpr double kGaussWeight[3] = {5.0 / 18.0, 8.0 / 18.0, 5.0 / 18.0};

// A change of the base motion as the placed bodies feel it (world axes, base origin): velocity u, acceleration psi.
struct BaseChange {
  Vector6 psi = Vector6::Zero(), u = Vector6::Zero();
  bool moves() const { return !u.isZero(0.0); }
};

// Forces on the joints for a unit of each basis derivative of an axis: column d of `unit[axis]` goes with the d-th.
class BaseResponse {
 public:
  BaseResponse(const Engine& engine, const Motion& motion) : engine_(engine), motion_(motion) {
    forces_.setZero(engine.angles, 3 * static_cast<Eigen::Index>(motion.axes.size()));
  }

  // Adds d(torque - tau_ID)/d(unknowns) at the placed and linearized state.
  void add(const Coordinates& c, const Basis& basis, MatrixX& out) {
    changes(c);
    respond();
    for (std::size_t a = 0; a < motion_.axes.size(); ++a)
      for (int d = 0; d < 3; ++d) {
        const Eigen::Index column = 3 * static_cast<Eigen::Index>(a) + d;
        if (!used_[column]) continue;
        out.middleCols(static_cast<Eigen::Index>(a) * kPerAxis, kPerAxis).noalias() +=
            forces_.col(column) * basis.col(d).transpose();
      }
  }

 private:
  // The rope seen in axes that turn with the yaw: a change of the yaw turns velocity and acceleration back.
  void changes(const Coordinates& c) {
    const Vector3& up = motion_.up;
    const dynamics::Parameters& p = engine_.model.parameters;
    Vector3 gravity = p.gravity;
    if (p.table_normal && p.table_carries_weight) gravity -= *p.table_normal * p.table_normal->dot(gravity);
    const Vector3 v = c.col(1).head<3>(), a = c.col(2).head<3>();
    change_.assign(3 * motion_.axes.size(), {});
    used_.assign(3 * motion_.axes.size(), true);
    for (std::size_t k = 0; k < motion_.axes.size(); ++k) {
      BaseChange *value = &change_[3 * k], *rate = value + 1, *second = value + 2;
      if (motion_.axes[k] != Axis::yaw) {
        used_[3 * k] = false;
        const Vector3 e = Vector3::Unit(static_cast<int>(motion_.axes[k]));
        rate->u.tail<3>() = e;
        second->psi.tail<3>() = e;
      } else {
        value->u.tail<3>() = -up.cross(v);
        value->psi.tail<3>() = -up.cross(a - gravity);
        rate->u.head<3>() = up;
        rate->psi.tail<3>() = -2.0 * up.cross(v);
        second->psi.head<3>() = up;
      }
    }
  }

  // -s_k^T (I psi + 2 B u - dW/dV u) of the outer links, for every change (see dynamics/engine.h).
  void respond() {
    const dynamics::Parameters& p = engine_.model.parameters;
    const bool table = p.table_normal.has_value();
    const Vector3 normal = table ? *p.table_normal : Vector3::Zero();
    wrench_.assign(change_.size(), Vector6::Zero());
    for (int j = engine_.link_count - 1; j >= 0; --j) {
      const dynamics::RigidInertia& body = engine_.inertia[j];
      const Vector3 w = engine_.velocity[j].head<3>(), v = engine_.velocity[j].tail<3>();
      const Vector3 momentum = body.mass * v - body.moment.cross(w);
      const double trace = body.rotational.trace();
      for (std::size_t i = 0; i < change_.size(); ++i) {
        if (!used_[i]) continue;
        wrench_[i] += body * change_[i].psi;
        const Vector3 turn = change_[i].u.head<3>();
        wrench_[i].head<3>() +=
            2.0 * w.cross(body.rotational * turn) - trace * w.cross(turn) - 2.0 * body.moment.cross(v.cross(turn));
        wrench_[i].tail<3>() -= 2.0 * momentum.cross(turn);
      }
      const dynamics::LinkConstants& link = engine_.links[j];
      const bool rubs = table && (link.viscous > 0.0 || link.coulomb > 0.0);
      const bool drags = link.air_linear > 0.0 || link.air_quadratic > 0.0;
      for (int g = 0; g < 3 && (rubs || drags); ++g) {
        const Vector3& d = engine_.direction[j];
        const Vector3 c = engine_.origin[j] + kGaussPoint[g] * link.length * d;
        const Vector3 speed = v + w.cross(c);
        Matrix3 slope = Matrix3::Zero();  // df/dv of SPEC 3.3
        if (rubs) {
          const Vector3 vt = speed - normal.dot(speed) * normal;
          const double s = std::sqrt(vt.squaredNorm() + p.coulomb_speed * p.coulomb_speed);
          slope -= (link.viscous + link.coulomb / s) * (Matrix3::Identity() - normal * normal.transpose());
          slope += link.coulomb / (s * s * s) * vt * vt.transpose();
        }
        if (drags) {
          const Vector3 vn = speed - d.dot(speed) * d;
          const double s = std::sqrt(vn.squaredNorm() + p.drag_speed * p.drag_speed);
          slope -= (link.air_linear + link.air_quadratic * s) * (Matrix3::Identity() - d * d.transpose());
          slope -= link.air_quadratic / s * vn * vn.transpose();
        }
        for (std::size_t i = 0; i < change_.size(); ++i) {
          if (!used_[i] || !change_[i].moves()) continue;
          const Vector3 f = kGaussWeight[g] * (slope * (change_[i].u.tail<3>() + change_[i].u.head<3>().cross(c)));
          wrench_[i].head<3>() -= c.cross(f);
          wrench_[i].tail<3>() -= f;
        }
      }
      for (int k = link.first_angle; k < link.end_angle; ++k)
        for (std::size_t i = 0; i < change_.size(); ++i)
          forces_(k, static_cast<Eigen::Index>(i)) = -engine_.axis[k].dot(wrench_[i]);
    }
  }

  const Engine& engine_;
  const Motion& motion_;
  std::vector<BaseChange> change_;
  std::vector<bool> used_;
  std::vector<Vector6> wrench_;
  MatrixX forces_;
};

// One state of the rope with the engine linearized there.
struct Point {
  Engine engine;
  BaseResponse response;
  MatrixX forces;  // of the tangents

  Point(const dynamics::Model& model, const Motion& motion, Eigen::Index columns)
      : engine(model), response(engine, motion), forces(model.chain.angles(), columns) {}

  bool place(const Motion& motion, const Coordinates& c, const VectorX& theta, const VectorX& thetadot, bool slopes) {
    Vector6 jerk;
    const trajectory::BaseMotion base = base_from(motion, c, &jerk);
    engine.place(base, theta, thetadot, slopes);
    if (!engine.factor_mass()) return false;
    engine.accelerate();
    if (slopes) engine.linearize(jerk);
    return true;
  }
  // M da = forces = base part - K S_theta - C S_rate
  void tangent_forces(const Coordinates& c, const Basis& basis, const MatrixX& slope, const MatrixX& rate_slope) {
    forces.noalias() = -engine.stiffness * slope;
    forces.noalias() -= engine.damping * rate_slope;
    response.add(c, basis, forces);
  }
  void solve_mass(MatrixX& x) const {
    engine.cholesky.triangularView<Eigen::Lower>().solveInPlace(x);
    engine.cholesky.triangularView<Eigen::Lower>().transpose().solveInPlace(x);
  }
};

// What an instant later: derivatives as they are, the highest held.
template <class Derivatives>
Derivatives shifted(const Derivatives& x, double time) {
  Derivatives out = x;
  for (int d = 0; d < 3; ++d) out.col(d) += time * x.col(d + 1);
  return out;
}

bool bounded(const VectorX& theta, const VectorX& thetadot) {
  return theta.cwiseAbs().maxCoeff() < kAngleBound && thetadot.cwiseAbs().maxCoeff() < kRateBound &&
         theta.allFinite() && thetadot.allFinite();
}

}  // namespace

Grid make_grid(const Motion& motion, int substeps) {
  Grid grid;
  const Piece& last = motion.pieces.back();
  // rounding of a horizon such as 0.1 s must not add a step
  const int steps = std::max(1, static_cast<int>(std::ceil(last.duration / kFrame * substeps - 1e-6)));
  grid.start = last.start;
  grid.step = last.duration / steps;
  Motion others = motion;
  others.pieces.pop_back();
  for (int k = 0; k <= steps; ++k) {
    grid.basis.push_back(basis(motion.window, last.start, last.duration, grid.time(k)));
    grid.fixed.push_back(coordinates(others, grid.time(k)));
  }
  return grid;
}

bool roll_out(const dynamics::Model& model, const Motion& motion, const Grid& grid, const VectorX& unknowns,
              const dynamics::InitialState& initial, bool derivatives, Rollout& out, bool exact) {
  const int n = model.chain.angles(), nodes = grid.nodes();
  const auto columns = static_cast<Eigen::Index>(motion.axes.size()) * kPerAxis;
  CHAINSPLAT_CHECK(unknowns.size() == columns, std::to_string(unknowns.size()));
  out.base.resize(nodes), out.theta.resize(nodes), out.thetadot.resize(nodes);
  for (int k = 0; k < nodes; ++k) {
    out.base[k] = grid.fixed[k];
    for (std::size_t a = 0; a < motion.axes.size(); ++a)
      out.base[k].row(static_cast<int>(motion.axes[a])) +=
          unknowns.segment(static_cast<Eigen::Index>(a) * kPerAxis, kPerAxis).transpose() * grid.basis[k];
  }
  out.theta_slope.resize(derivatives ? nodes : 0), out.thetadot_slope.resize(derivatives ? nodes : 0);

  const Eigen::Index p = derivatives ? columns : 0;
  Point now(model, motion, p), other(model, motion, p);
  VectorX theta = initial.theta, rate = initial.thetadot;
  MatrixX slope = MatrixX::Zero(n, p), rate_slope = MatrixX::Zero(n, p);
  VectorX k_theta[4], k_rate[4], right(n), work(n), stage_theta(n), stage_rate(n);
  MatrixX dk_theta[4], dk_rate[4], d_right(n, p), d_work(n, p), now_rate(n, p), stage_slope(n, p),
      stage_rate_slope(n, p);
  Eigen::PartialPivLU<MatrixX> factor(n);
  MatrixX matrix(n, n);
  const double h = grid.step, g = 0.5 * h;
  constexpr double kTimeWeight[4] = {0.5, 1.5, 0.0, 0.0};  // gamma_i

  for (int k = 0; k < nodes; ++k) {
    if (!bounded(theta, rate)) return false;
    out.theta[k] = theta, out.thetadot[k] = rate;
    if (derivatives) out.theta_slope[k] = slope, out.thetadot_slope[k] = rate_slope;
    if (k + 1 == nodes) break;
    const Coordinates &base = out.base[k], &next = out.base[k + 1];
    if (!now.place(motion, base, theta, rate, true)) return false;
    Engine& engine = now.engine;
    matrix = engine.mass + g * engine.damping + (g * g) * engine.stiffness;
    factor.compute(matrix);
    if (derivatives) {
      now.tangent_forces(base, grid.basis[k], slope, rate_slope);
      now_rate = now.forces;
      now.solve_mass(now_rate);
    }

    // (1/G - J) k = (right, M^-1 work), the same for the tangents
    const auto solve = [&](int i) {
      work.noalias() -= g * (engine.stiffness * right);
      work *= g;
      k_rate[i] = factor.solve(work);
      k_theta[i] = g * (right + k_rate[i]);
    };
    // d_work holds M^-1 times the change of `work`, without the second derivatives
    const auto solve_tangents = [&](int i) {
      if (exact) {
        for (const double e : {kProbe, -kProbe}) {
          const double shift = e * h * kTimeWeight[i];
          if (!other.place(motion, shifted(base, shift), theta + e * k_theta[i], rate + e * k_rate[i], true))
            return false;
          other.tangent_forces(shifted(base, shift), shifted(grid.basis[k], shift), slope, rate_slope);
          other.solve_mass(other.forces);
          d_work += other.forces / (2.0 * e);
        }
      }
      dk_rate[i].noalias() = engine.mass * d_work;
      dk_rate[i].noalias() -= g * (engine.stiffness * d_right);
      dk_rate[i] = g * factor.solve(dk_rate[i]);
      dk_theta[i] = g * (d_right + dk_rate[i]);
      return true;
    };

    right = rate;
    work = engine.force + (0.5 * h) * engine.drive_rate;
    solve(0);
    if (derivatives) {
      d_right = rate_slope;
      d_work = now_rate;
      if (!solve_tangents(0)) return false;
    }
    right = rate + (4.0 / h) * k_theta[0];
    work = engine.force + (1.5 * h) * engine.drive_rate;
    work.noalias() += (4.0 / h) * (engine.mass * k_rate[0]);
    solve(1);
    if (derivatives) {
      d_right = rate_slope + (4.0 / h) * dk_theta[0];
      d_work = now_rate + (4.0 / h) * dk_rate[0];
      if (!solve_tangents(1)) return false;
    }
    stage_theta = theta + 2.0 * k_theta[0];
    stage_rate = rate + 2.0 * k_rate[0];
    if (derivatives) {
      stage_slope = slope + 2.0 * dk_theta[0];
      stage_rate_slope = rate_slope + 2.0 * dk_rate[0];
    }
    for (int i = 2; i < 4; ++i) {
      const double last = i == 3 ? -8.0 / 3.0 : 0.0;
      if (!bounded(stage_theta, stage_rate)) return false;
      if (!other.place(motion, next, stage_theta, stage_rate, derivatives)) return false;
      right = stage_rate + (k_theta[0] - k_theta[1]) / h;
      work = other.engine.acceleration + (k_rate[0] - k_rate[1]) / h;
      if (i == 3) right += (last / h) * k_theta[2], work += (last / h) * k_rate[2];
      work = (engine.mass * work).eval();
      solve(i);
      if (derivatives) {
        other.tangent_forces(next, grid.basis[k + 1], stage_slope, stage_rate_slope);
        d_work = other.forces;
        other.solve_mass(d_work);
        d_work += (dk_rate[0] - dk_rate[1]) / h;
        d_right = stage_rate_slope + (dk_theta[0] - dk_theta[1]) / h;
        if (i == 3) d_right += (last / h) * dk_theta[2], d_work += (last / h) * dk_rate[2];
        if (!solve_tangents(i)) return false;
        stage_slope += dk_theta[i];
        stage_rate_slope += dk_rate[i];
      }
      stage_theta += k_theta[i];
      stage_rate += k_rate[i];
    }
    theta = stage_theta, rate = stage_rate;
    if (derivatives) slope = stage_slope, rate_slope = stage_rate_slope;
  }
  return true;
}

}  // namespace chainsplat::planning
