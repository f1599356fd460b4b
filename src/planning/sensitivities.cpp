#include "sensitivities.h"

namespace chainsplat::planning {
namespace {

// What an instant later: derivatives as they are, the highest held.
template <class Derivatives>
Derivatives shifted(const Derivatives& x, double time) {
  Derivatives out = x;
  for (int d = 0; d < 3; ++d) out.col(d) += time * x.col(d + 1);
  return out;
}

// Torques by the unknowns of the last piece: `slopes` times what a change of each coordinate, its rate and its second
// derivative adds to base_from().
void add_torques(const Motion& motion, const Coordinates& c, const Basis& basis, const dynamics::BaseSlopes& slopes,
                 MatrixX& torques) {
  const math::Matrix3 back = base_from(motion, c).pose.rotation.transpose();
  const Vector3 up = back * motion.up, v = back * c.col(1).head<3>(), a = back * c.col(2).head<3>();
  const Vector3 spin = c(3, 1) * up;
  VectorX torque;
  for (std::size_t k = 0; k < motion.axes.size(); ++k) {
    Vector3 turn[3] = {Vector3::Zero(), Vector3::Zero(), Vector3::Zero()};
    math::Vector6 velocity[3] = {math::Vector6::Zero(), math::Vector6::Zero(), math::Vector6::Zero()};
    math::Vector6 acceleration[3] = {math::Vector6::Zero(), math::Vector6::Zero(), math::Vector6::Zero()};
    const bool yaw = motion.axes[k] == Axis::yaw;
    if (yaw) {
      turn[0] = up;
      velocity[0].tail<3>() = -up.cross(v);
      acceleration[0].tail<3>() = -up.cross(a) + spin.cross(up.cross(v));
      velocity[1].head<3>() = up;
      acceleration[1].tail<3>() = -up.cross(v);
      acceleration[2].head<3>() = up;
    } else {
      const Vector3 axis = back.col(static_cast<int>(motion.axes[k]));
      velocity[1].tail<3>() = axis;
      acceleration[1].tail<3>() = -spin.cross(axis);
      acceleration[2].tail<3>() = axis;
    }
    for (int d = yaw ? 0 : 1; d < 3; ++d) {
      torque.noalias() = slopes.rotation * turn[d];
      torque.noalias() += slopes.velocity * velocity[d];
      torque.noalias() += slopes.acceleration * acceleration[d];
      torques.middleCols(static_cast<Eigen::Index>(k) * kPerAxis, kPerAxis).noalias() +=
          torque * basis.col(d).transpose();
    }
  }
}

}  // namespace

Grid make_grid(const Motion& motion, int substeps) {
  Grid grid;
  const Piece& last = motion.pieces.back();
  const int steps = dynamics::step_count(last.duration, substeps);
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
  const auto columns = static_cast<Eigen::Index>(motion.axes.size()) * kPerAxis;
  CHAINSPLAT_CHECK(unknowns.size() == columns, std::to_string(unknowns.size()));
  if (model.parameters.integrator != dynamics::Integrator::rodas3) {  // a plan needs derivatives, which Euler's has not
    dynamics::Model other = model;
    other.parameters.integrator = dynamics::Integrator::rodas3;
    return roll_out(other, motion, grid, unknowns, initial, derivatives, out, exact);
  }
  const std::size_t nodes = grid.basis.size();
  out.base.resize(nodes);
  dynamics::BaseGrid base;
  base.nodes.resize(nodes);
  for (std::size_t k = 0; k < nodes; ++k) {
    dynamics::BaseGrid::Node& node = base.nodes[k];
    out.base[k] = moved(motion, unknowns, grid.basis[k], grid.fixed[k]);
    node.time = grid.time(static_cast<int>(k));
    node.step = k + 1 < nodes ? grid.step : 0.0;
    node.motion = base_from(motion, out.base[k], &node.jerk);
    node.output = true;
  }
  chain::States states;
  dynamics::Sensitivities slopes;
  bool good = false;
  if (derivatives) {
    dynamics::BaseUnknowns by;
    by.count = columns;
    by.motion = [&](std::size_t node, double after) { return base_from(motion, shifted(out.base[node], after)); };
    by.torques = [&](std::size_t node, double after, const dynamics::BaseSlopes& at, MatrixX& torques) {
      torques.setZero(model.chain.angles(), columns);
      add_torques(motion, shifted(out.base[node], after), shifted(grid.basis[node], after), at, torques);
    };
    good = dynamics::simulate(model, base, initial, states, by, exact, slopes);
  } else {
    good = dynamics::simulate(model, base, initial, states);
  }
  out.theta = std::move(states.theta), out.thetadot = std::move(states.thetadot);
  out.theta_slope = std::move(slopes.theta), out.thetadot_slope = std::move(slopes.thetadot);
  return good;
}

}  // namespace chainsplat::planning
