// rope.cpp - a twin at work inside another program.
#include "chainsplat/rope.h"

#include <algorithm>
#include <cmath>

#include "chainsplat/corrections.h"
#include "chainsplat/dynamics/rolling.h"
#include "chainsplat/estimation.h"
#include "chainsplat/identification.h"
#include "chainsplat/motion_files.h"
#include "chainsplat/run_folder.h"

namespace chainsplat::pipeline {

namespace {

constexpr double kTimeSlack = 1e-6;  // s: times in text files are rounded

// Planning needs numbers for everything: a mass of 60 g per 30 cm and the centers of identification's priors, alike at
// all joints.
dynamics::Parameters assumed_parameters(const twin::Twin& twin) {
  constexpr double kMass = 0.2;  // kg/m
  const chain::Chain& chain = twin.chain;
  dynamics::Parameters p;
  const double torque = identification::kStiffnessPart * kMass * chain.length * twin.gravity.norm() * chain.length;
  for (int link = 1; link < chain.links(); ++link) {
    const double length = chain.link_end(link) - chain.link_start(link);
    p.link_mass.push_back(kMass * length);
    p.viscous_friction.push_back(0.0);
    p.coulomb_friction.push_back(twin.tabletop ? identification::kCoulombMean : 0.0);
    p.air_linear.push_back(0.0);
    p.air_quadratic.push_back(twin.tabletop ? 0.0 : identification::kDragPerDiameter * chain.diameter * length);
  }
  p.stiffness.assign(chain.angles(), torque);
  p.rest_angle.assign(chain.angles(), 0.0);
  p.damping.assign(chain.angles(), identification::kRetardation * torque);
  p.radius = 0.5 * chain.diameter;
  p.gravity = twin.gravity;
  if (twin.tabletop) p.table_normal = twin.table_normal.value_or(math::Vector3::UnitZ());
  p.substeps = twin.tabletop ? 8 : 4;
  return p;
}

void check_state(const Rope& rope, const dynamics::InitialState& initial) {
  const int angles = rope.twin.chain.angles();
  const Eigen::Index internal = initial.internal_state.size();
  const auto rolls = static_cast<Eigen::Index>(model_of(rope).parameters.torsional_stiffness.size());
  if (initial.theta.size() != angles || initial.thetadot.size() != angles ||
      (internal != 0 && internal != angles && internal != rolls && internal != angles + rolls))
    throw InputError("`initial`", "has not " + std::to_string(angles) + " angles and rates, as the rope has",
                     "give theta and thetadot of that length");
}

template <class T>
const T& one_of(std::span<const T> list, std::int64_t i) {
  return list.size() == 1 ? list[0] : list[static_cast<std::size_t>(i)];
}

// What a displacement of the base by a translation d(t) does to its motion: V_b by R^T d', its derivative by
// R^T d'' - w x R^T d'. The pose's place itself moves nothing, since gravity and table are alike everywhere.
dynamics::BaseUnknowns displaced(const dynamics::BaseGrid& grid, const trajectory::Trajectory& base,
                                 std::span<const trajectory::Trajectory> directions) {
  dynamics::BaseUnknowns unknowns;
  unknowns.count = static_cast<Eigen::Index>(directions.size());
  unknowns.motion = [&grid, &base](std::size_t node, double after) { return base.at(grid.nodes[node].time + after); };
  unknowns.torques = [&grid, &base, directions](std::size_t node, double after, const dynamics::BaseSlopes& slopes,
                                                math::MatrixX& torques) {
    const double time = grid.nodes[node].time + after;
    const trajectory::BaseMotion now = base.at(time);
    const math::Matrix3 to_base = now.pose.rotation.transpose();
    const math::Vector3 turning = now.velocity.head<3>();
    torques.resize(slopes.velocity.rows(), static_cast<Eigen::Index>(directions.size()));
    for (std::size_t k = 0; k < directions.size(); ++k) {
      const trajectory::BaseMotion shift = directions[k].at(time);
      const math::Matrix3& turn = shift.pose.rotation;
      const math::Vector3 speed = to_base * (turn * shift.velocity.tail<3>());
      const math::Vector3 gain =
          to_base * (turn * (shift.acceleration.tail<3>() +
                             math::Vector3(shift.velocity.head<3>()).cross(math::Vector3(shift.velocity.tail<3>()))));
      torques.col(static_cast<Eigen::Index>(k)) =
          slopes.velocity.rightCols<3>() * speed + slopes.acceleration.rightCols<3>() * (gain - turning.cross(speed));
    }
  };
  return unknowns;
}

}  // namespace

Rope load_rope(const Path& run) {
  Rope rope{run, load_twin(run), own_base(run), {}};
  if (rope.twin.parameters) rope.model = dynamics::make_model(rope.twin.chain, *rope.twin.parameters);
  return rope;
}

const dynamics::Model& model_of(const Rope& rope) {
  if (!rope.model) model_of(rope.twin, rope.run);  // throws
  return *rope.model;
}

void add_rolls(const twin::Twin& twin, const trajectory::Trajectory& base, chain::States& states) {
  if (!twin.rolling) return;
  states.roll = dynamics::rolls_along(dynamics::make_model(twin.chain, *twin.parameters), *twin.rolling, base, states);
}

dynamics::InitialState rest_state(const Rope& rope, const math::Pose& base, double time) {
  return rest_state(rope.twin, model_of(rope), base, time);
}

dynamics::InitialState rest_state(const twin::Twin& twin, const dynamics::Model& model, const math::Pose& base,
                                  double time) {
  dynamics::InitialState initial;
  initial.time = time;
  initial.thetadot = math::VectorX::Zero(twin.chain.angles());
  if (!twin.tabletop)
    initial.theta = dynamics::static_equilibrium(model, base).theta;
  else if (twin.initial || !twin.states.theta.empty())
    initial.theta = twin.initial ? twin.initial->theta : twin.states.theta.front();
  else
    throw InputError("the twin", "holds no state to start from on the table", "give `initial`");
  return initial;
}

dynamics::InitialState state_at(const dynamics::Model& model, const math::Pose& base, double time,
                                const math::VectorX& theta, const math::VectorX& thetadot) {
  dynamics::InitialState initial{time, theta, thetadot, {}};
  if (model.parameters.bending_friction.empty()) return initial;  // rolls come to rest by themselves
  initial.internal_state =
      thetadot.isZero(0.0)
          ? dynamics::internal_states(model, {dynamics::static_equilibrium(model, base).theta, theta}).back()
          : dynamics::internal_state_in_motion(model, theta, thetadot);
  return initial;
}

std::vector<double> times_of(const trajectory::Trajectory& base, double start, double rate) {
  planning::check_rate(rate, std::max(0.0, base.end() - start), "give rows a second, for example 30");
  std::vector<double> times;
  for (int k = 0; start + k / rate <= base.end() + kTimeSlack; ++k) times.push_back(start + k / rate);
  return times;
}

std::vector<chain::States> rollout_batch(const Rope& rope, std::span<const dynamics::Parameters> parameters,
                                         std::span<const trajectory::Trajectory> bases,
                                         std::span<const dynamics::InitialState> initials,
                                         const std::vector<double>& times) {
  const dynamics::Model& identified = model_of(rope);
  const std::size_t count = std::max({parameters.size(), bases.size(), initials.size()});
  const auto check = [&](const char* what, std::size_t size, bool may_be_empty) {
    if (size != count && size != 1 && !(may_be_empty && size == 0))
      throw InputError(what, "has " + std::to_string(size) + " entries, another list " + std::to_string(count),
                       "give one for all, or one for each rollout");
  };
  check("`parameters`", parameters.size(), true);
  check("`bases`", bases.size(), false);
  check("`initials`", initials.size(), false);
  for (const dynamics::InitialState& initial : initials) check_state(rope, initial);
  std::vector<dynamics::Model> models;
  for (const dynamics::Parameters& each : parameters) models.push_back(dynamics::make_model(rope.twin.chain, each));
  if (models.empty()) models.push_back(identified);
  std::vector<chain::States> out(count);
  core::parallel_for(static_cast<std::int64_t>(count), [&](std::int64_t i) {
    const dynamics::Model& model = one_of<dynamics::Model>(models, i);
    const trajectory::Trajectory& base = one_of(bases, i);
    const dynamics::InitialState& initial = one_of(initials, i);
    const dynamics::BaseGrid grid = dynamics::sample_base([&base](double time) { return base.at(time); }, initial.time,
                                                          times, model.parameters.substeps);
    dynamics::simulate(model, grid, initial, out[static_cast<std::size_t>(i)]);
  });
  return out;
}

Derivatives rollout_derivatives(const Rope& rope, const trajectory::Trajectory& base,
                                const dynamics::InitialState& initial, const std::vector<double>& times,
                                std::span<const std::string> names,
                                std::span<const trajectory::Trajectory> directions) {
  const dynamics::Model& model = model_of(rope);
  check_state(rope, initial);
  if (model.parameters.integrator != dynamics::Integrator::rodas3)
    throw InputError(rope.run.string(), "is of the paper's integrator, whose steps have no derivatives",
                     "identify it without `--mode paper`");
  std::vector<dynamics::Unknown> unknowns;
  for (const std::string& name : names) {
    const std::optional<dynamics::Unknown> unknown = dynamics::unknown_named(name);
    const bool state = unknown && !dynamics::is_parameter(unknown->quantity);
    if (!unknown || unknown->quantity == dynamics::Quantity::none || unknown->index == dynamics::kEvery ||
        (state ? unknown->index >= model.chain.angles()
               : !dynamics::has_effect(model.chain, model.parameters, *unknown)))
      throw InputError("`names`", "'" + name + "' is nothing that this rope has",
                       "give names of twin.json's identification, for example log_stiffness, or theta_1");
    unknowns.push_back(*unknown);
  }
  const std::vector<dynamics::Tangent> tangents = dynamics::tangents(model.chain, model.parameters, unknowns);
  const dynamics::BaseGrid grid = dynamics::sample_base([&base](double time) { return base.at(time); }, initial.time,
                                                        times, model.parameters.substeps);
  Derivatives out;
  const auto check = [&](bool whole) {
    if (!whole || out.states.time.size() != times.size())
      throw WorkError("rollout", "leaves all bounds", "give another start, or take smaller steps (substeps)");
  };
  check(dynamics::simulate(model, grid, initial, out.states, tangents, &out.by_names));
  if (!directions.empty())
    check(dynamics::simulate(model, grid, initial, out.states, displaced(grid, base, directions), true,
                             out.by_directions));
  return out;
}

LiveBase::LiveBase(std::size_t window) : window_(std::max<std::size_t>(window, 2)) {}

void LiveBase::add(double time, const math::Pose& pose) {
  std::vector<trajectory::Sample> samples = samples_;
  if (samples.size() == window_) samples.erase(samples.begin());
  samples.push_back({time, pose});
  fitted_ = trajectory::fit(samples, "the base's pose");
  samples_ = std::move(samples);
}

trajectory::BaseMotion LiveBase::at(double time) const {
  if (samples_.empty()) throw InputError("the base's pose", "is not known yet", "give one before the first frame");
  return fitted_.at(time);
}

planning::Problem planning_problem(const Rope& rope) {
  planning::Problem problem;
  if (rope.model) {
    problem.model = *rope.model;
  } else {
    core::warn(rope.run.string() + ": its dynamics are not identified; mass, stiffness, damping and friction are " +
               "assumed, and the rope may miss by centimeters");
    problem.model = dynamics::make_model(rope.twin.chain, assumed_parameters(rope.twin));
  }
  problem.tabletop = rope.twin.tabletop;
  problem.table_point = rope.twin.table_point;
  problem.base = rope.base.pose(rope.base.start());
  problem.estimates = rope.twin.estimates;
  problem.initial = rest_state(rope.twin, problem.model, problem.base, 0.0);
  return problem;
}

FirstSight start_as_seen(const Rope& rope, const Path& capture, const std::string& camera, planning::Problem& problem) {
  capture::LoadOptions load;
  load.camera = camera;
  load.last = 1;
  capture::Capture seen = capture::load(capture, load);
  capture::apply(rope.twin.corrections, seen);
  const std::string source = "'" + capture.string() + (camera.empty() ? "'" : ":" + camera + "'");
  if (seen.cameras.size() != 1)
    throw InputError("`state_from`", source + " names no single camera", "give CAPTURE:NAME, for example CAPTURE:cam0");
  if (seen.views.empty() || seen.views[0].width == 0)
    throw InputError("`state_from`", "the first frame of " + source + " does not show the rope", "name another camera");
  const capture::View view = capture::unpacked(seen.views[0]);
  problem.base = seen.base.pose(view.time);
  estimation::Filter filter(
      rope.twin, seen.cameras, [&](double) { return dynamics::at_rest(problem.base); }, view.time);
  const capture::View* const views[] = {&view};
  const estimation::Estimate found = filter.update(views);
  if (!found.seen || found.lost || found.doubtful)
    throw InputError("`state_from`", "the rope was not surely recognized in the first frame of " + source,
                     "name another camera, or give the state with `initial`");
  problem.initial.theta = found.theta;
  return {seen.cameras[0].name, found.iou, found.residual};
}

excitation::Problem excitation_problem(const Rope& rope) {
  excitation::Problem problem;
  problem.model = model_of(rope);
  problem.tabletop = rope.twin.tabletop;
  problem.base = rope.base.pose(rope.base.start());
  problem.estimates = rope.twin.estimates;
  problem.initial = rest_state(rope.twin, problem.model, problem.base, 0.0);
  problem.recorded = [base = rope.base](double time) { return base.at(time); };
  problem.recorded_start = rope.twin.states.time.front();
  problem.recorded_end = rope.twin.states.time.back();
  return problem;
}

}  // namespace chainsplat::pipeline
