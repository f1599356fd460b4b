#include "sensitivities.h"

#include <cmath>

namespace chainsplat::planning {
namespace {

constexpr double kFrame = 1.0 / 30.0;  // s, what `substeps` counts in
constexpr double kProbe = 3e-6;        // e of the second derivatives: truncation and rounding both below 1e-8
constexpr double kAngleBound = 1e3;    // rad, beyond which a motion counts as diverged
constexpr double kRateBound = 1e5;     // rad/s

// One state of the rope with the equations of motion linearized there.
struct Point {
  dynamics::Linearizer linearizer;
  dynamics::Linearization now;
  MatrixX forces;  // of the tangents

  Point(const dynamics::Model& model, const Motion& motion, Eigen::Index columns)
      : linearizer(model), forces(model.chain.angles(), columns), motion_(motion) {}

  bool place(const Coordinates& c, const VectorX& theta, const VectorX& thetadot, bool slopes) {
    math::Vector6 jerk;
    const trajectory::BaseMotion base = base_from(motion_, c, &jerk);
    return linearizer.at(base, jerk, theta, thetadot, slopes, now);
  }

  // M da = forces = base part - K S_theta - C S_rate
  void tangent_forces(const Coordinates& c, const Basis& basis, const MatrixX& slope, const MatrixX& rate_slope) {
    forces.noalias() = -now.stiffness * slope;
    forces.noalias() -= now.damping * rate_slope;
    linearizer.base_slopes(slopes_);
    const math::Matrix3 back = base_from(motion_, c).pose.rotation.transpose();
    const Vector3 up = back * motion_.up, v = back * c.col(1).head<3>(), a = back * c.col(2).head<3>();
    const Vector3 spin = c(3, 1) * up;
    for (std::size_t k = 0; k < motion_.axes.size(); ++k) {
      // what a change of the coordinate, its rate and its second derivative adds to base_from()
      Vector3 turn[3] = {Vector3::Zero(), Vector3::Zero(), Vector3::Zero()};
      math::Vector6 velocity[3] = {math::Vector6::Zero(), math::Vector6::Zero(), math::Vector6::Zero()};
      math::Vector6 acceleration[3] = {math::Vector6::Zero(), math::Vector6::Zero(), math::Vector6::Zero()};
      const bool yaw = motion_.axes[k] == Axis::yaw;
      if (yaw) {
        turn[0] = up;
        velocity[0].tail<3>() = -up.cross(v);
        acceleration[0].tail<3>() = -up.cross(a) + spin.cross(up.cross(v));
        velocity[1].head<3>() = up;
        acceleration[1].tail<3>() = -up.cross(v);
        acceleration[2].head<3>() = up;
      } else {
        const Vector3 axis = back.col(static_cast<int>(motion_.axes[k]));
        velocity[1].tail<3>() = axis;
        acceleration[1].tail<3>() = -spin.cross(axis);
        acceleration[2].tail<3>() = axis;
      }
      for (int d = yaw ? 0 : 1; d < 3; ++d) {
        force_.noalias() = slopes_.rotation * turn[d];
        force_.noalias() += slopes_.velocity * velocity[d];
        force_.noalias() += slopes_.acceleration * acceleration[d];
        forces.middleCols(static_cast<Eigen::Index>(k) * kPerAxis, kPerAxis).noalias() -=
            force_ * basis.col(d).transpose();
      }
    }
  }

 private:
  const Motion& motion_;
  dynamics::BaseSlopes slopes_;
  VectorX force_;
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
  constexpr double kBefore = 1e-9;  // s
  const double before = last.start + last.duration - kBefore;
  grid.end_basis = basis(motion.window, last.start, last.duration, before);
  grid.end_fixed = coordinates(others, before);
  return grid;
}

Coordinates moved(const Motion& motion, const VectorX& unknowns, const Basis& basis, const Coordinates& fixed) {
  Coordinates out = fixed;
  for (std::size_t a = 0; a < motion.axes.size(); ++a)
    out.row(static_cast<int>(motion.axes[a])) +=
        unknowns.segment(static_cast<Eigen::Index>(a) * kPerAxis, kPerAxis).transpose() * basis;
  return out;
}

bool roll_out(const dynamics::Model& model, const Motion& motion, const Grid& grid, const VectorX& unknowns,
              const dynamics::InitialState& initial, bool derivatives, Rollout& out, bool exact) {
  const int n = model.chain.angles(), nodes = grid.nodes();
  const auto columns = static_cast<Eigen::Index>(motion.axes.size()) * kPerAxis;
  CHAINSPLAT_CHECK(unknowns.size() == columns, std::to_string(unknowns.size()));
  out.base.resize(nodes), out.theta.resize(nodes), out.thetadot.resize(nodes);
  for (int k = 0; k < nodes; ++k) out.base[k] = moved(motion, unknowns, grid.basis[k], grid.fixed[k]);
  out.theta_slope.resize(derivatives ? nodes : 0), out.thetadot_slope.resize(derivatives ? nodes : 0);

  const Eigen::Index p = derivatives ? columns : 0;
  const bool stages = derivatives && exact;  // the derivative goes through the stages
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
  constexpr double kOfThird = 8.0 / 3.0;                   // what stage 4 takes back of stage 3

  for (int k = 0; k < nodes; ++k) {
    if (!bounded(theta, rate)) return false;
    out.theta[k] = theta, out.thetadot[k] = rate;
    const bool last = k + 1 == nodes;
    const Coordinates& base = out.base[k];
    const dynamics::Linearization& here = now.now;
    if (!last || derivatives) {
      if (!now.place(base, theta, rate, true)) return false;
      matrix = here.mass + g * here.damping + (g * g) * here.stiffness;
      factor.compute(matrix);
    }
    if (derivatives) {
      if (exact || k == 0) {
        now.tangent_forces(base, grid.basis[k], slope, rate_slope);
        now_rate = now.forces;
        now.linearizer.solve_mass(now_rate);
      } else {
        // trapezoidal rule from the last node: what it had, then what the acceleration's slope here adds
        slope += g * rate_slope;
        rate_slope += g * now_rate;
        slope += g * rate_slope;
        now.tangent_forces(base, grid.basis[k], slope, rate_slope);
        now_rate = factor.solve(now.forces);
        slope += (g * g) * now_rate;
        rate_slope += g * now_rate;
      }
      out.theta_slope[k] = slope, out.thetadot_slope[k] = rate_slope;
    }
    if (last) break;
    const Coordinates& next = out.base[k + 1];

    // (1/G - J) k = (right, M^-1 work), the same for the tangents
    const auto solve = [&](int i) {
      work.noalias() -= g * (here.stiffness * right);
      work *= g;
      k_rate[i] = factor.solve(work);
      k_theta[i] = g * (right + k_rate[i]);
    };
    // d_work holds M^-1 times the change of `work`, without the second derivatives
    const auto solve_tangents = [&](int i) {
      for (const double e : {kProbe, -kProbe}) {
        const double shift = e * h * kTimeWeight[i];
        if (!other.place(shifted(base, shift), theta + e * k_theta[i], rate + e * k_rate[i], true)) return false;
        other.tangent_forces(shifted(base, shift), shifted(grid.basis[k], shift), slope, rate_slope);
        other.linearizer.solve_mass(other.forces);
        d_work += other.forces / (2.0 * e);
      }
      dk_rate[i].noalias() = here.mass * d_work;
      dk_rate[i].noalias() -= g * (here.stiffness * d_right);
      dk_rate[i] = g * factor.solve(dk_rate[i]);
      dk_theta[i] = g * (d_right + dk_rate[i]);
      return true;
    };

    right = rate;
    work.noalias() = here.mass * here.acceleration;
    work += (0.5 * h) * here.drive_rate;
    solve(0);
    if (stages) {
      d_right = rate_slope;
      d_work = now_rate;
      if (!solve_tangents(0)) return false;
    }
    right = rate + (4.0 / h) * k_theta[0];
    work.noalias() = here.mass * here.acceleration;
    work += (1.5 * h) * here.drive_rate;
    work.noalias() += (4.0 / h) * (here.mass * k_rate[0]);
    solve(1);
    if (stages) {
      d_right = rate_slope + (4.0 / h) * dk_theta[0];
      d_work = now_rate + (4.0 / h) * dk_rate[0];
      if (!solve_tangents(1)) return false;
    }
    stage_theta = theta + 2.0 * k_theta[0];
    stage_rate = rate + 2.0 * k_rate[0];
    if (stages) {
      stage_slope = slope + 2.0 * dk_theta[0];
      stage_rate_slope = rate_slope + 2.0 * dk_rate[0];
    }
    for (int i = 2; i < 4; ++i) {
      if (!bounded(stage_theta, stage_rate)) return false;
      if (!other.place(next, stage_theta, stage_rate, stages)) return false;
      right = stage_rate + (k_theta[0] - k_theta[1]) / h;
      work = other.now.acceleration + (k_rate[0] - k_rate[1]) / h;
      if (i == 3) right -= (kOfThird / h) * k_theta[2], work -= (kOfThird / h) * k_rate[2];
      work = (here.mass * work).eval();
      solve(i);
      if (stages) {
        other.tangent_forces(next, grid.basis[k + 1], stage_slope, stage_rate_slope);
        d_work = other.forces;
        other.linearizer.solve_mass(d_work);
        d_work += (dk_rate[0] - dk_rate[1]) / h;
        d_right = stage_rate_slope + (dk_theta[0] - dk_theta[1]) / h;
        if (i == 3) d_right -= (kOfThird / h) * dk_theta[2], d_work -= (kOfThird / h) * dk_rate[2];
        if (!solve_tangents(i)) return false;
        stage_slope += dk_theta[i];
        stage_rate_slope += dk_rate[i];
      }
      stage_theta += k_theta[i];
      stage_rate += k_rate[i];
    }
    theta = stage_theta, rate = stage_rate;
    if (stages) slope = stage_slope, rate_slope = stage_rate_slope;
  }
  return true;
}

}  // namespace chainsplat::planning
