// chainsplat/rope.h - a twin at work inside another program: loaded once, then everything is in memory.
//
// What a planner, a controller or a learner needs beside the modules: the rope with all that a call on it starts from,
// a rollout that starts at rest, many rollouts at once, derivatives, the base's motion as its poses come, and whole
// problems for planning, excitation and forces. A Rope that nobody changes may be used by several threads.
#pragma once
#include <functional>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "chainsplat/dynamics/parametrization.h"
#include "chainsplat/excitation.h"
#include "chainsplat/force.h"
#include "chainsplat/planning.h"
#include "chainsplat/twin.h"

namespace chainsplat::pipeline {

struct Rope {
  Path run;  // folder that it was loaded from, for messages
  twin::Twin twin;
  trajectory::Trajectory base;           // of its own recording
  std::optional<dynamics::Model> model;  // none before identification
};
// Throws InputError for a folder without a twin, and for one without recognized states or its base motion.
Rope load_rope(const Path& run);
// Throws InputError before identification.
const dynamics::Model& model_of(const Rope& rope);

// The rope at rest at `time`, s, under a base at rest in `base`: in free space it hangs in its equilibrium, on a table
// it lies as it was recognized first.
dynamics::InitialState rest_state(const Rope& rope, const math::Pose& base, double time);
// The same of an identified twin, whose model is given, without its folder.
dynamics::InitialState rest_state(const twin::Twin& twin, const dynamics::Model& model, const math::Pose& base,
                                  double time);
// Sets the rolls of a motion of the twin under `base` that starts without torsion, where it is known how the rope
// rolls.
void add_rolls(const twin::Twin& twin, const trajectory::Trajectory& base, chain::States& states);
// A rope in this state at `time`, s, under a base in `base`. Friction in bending is of the past, and is guessed: at
// rest it has built up on the way from the equilibrium, in motion the joints have moved on at their present rates until
// here.
dynamics::InitialState state_at(const dynamics::Model& model, const math::Pose& base, double time,
                                const math::VectorX& theta, const math::VectorX& thetadot);
// Times from `start` on, `rate` a second, that `base` covers; s. Throws InputError that names `rate`.
std::vector<double> times_of(const trajectory::Trajectory& base, double start, double rate);

// --- many rollouts, and their derivatives ----------------------------------------------------------------------------

// Rollout i starts at initials[i] under bases[i] with parameters[i]; a list of one entry counts for all, and an empty
// one of parameters means the identified. Runs on all cores (core::set_threads()); a result depends on its own inputs
// only. One that diverges has fewer states than `times`. Throws InputError where the lists do not fit.
std::vector<chain::States> rollout_batch(const Rope& rope, std::span<const dynamics::Parameters> parameters,
                                         std::span<const trajectory::Trajectory> bases,
                                         std::span<const dynamics::InitialState> initials,
                                         const std::vector<double>& times);

// A rollout with its derivatives by parameters and initial state, named as in twin.json: "log_stiffness",
// "rest_angle_3", "theta_1", "thetadot_1"; and by displacements of the base in the world, m: derivative k is by the
// amplitude of directions[k], whose poses' translations are added to the base's (rotations are not looked at). Columns
// come in the order of `names`, then of `directions`. From the variational equation, which is of second order in the
// step; RODAS3 only.
struct Derivatives {
  chain::States states;
  dynamics::Sensitivities by_names, by_directions;  // n x names and n x directions at every time
};
// Throws InputError for a name that this rope does not have and for the paper's integrator, WorkError where it
// diverges.
Derivatives rollout_derivatives(const Rope& rope, const trajectory::Trajectory& base,
                                const dynamics::InitialState& initial, const std::vector<double>& times,
                                std::span<const std::string> names,
                                std::span<const trajectory::Trajectory> directions = {});

// --- the base's motion as its poses come -----------------------------------------------------------------------------

// Keeps the last poses of a base that a robot reports while it moves, and fits them (trajectory.h), so that twist and
// acceleration are known at the last of them. Not to be changed while another thread reads it.
class LiveBase {
 public:
  // `window`: poses that are kept.
  explicit LiveBase(std::size_t window = 24);
  // Times increase, s. Throws InputError where they do not, and for a pose that is none.
  void add(double time, const math::Pose& pose);
  // At rest before the first pose and after the last. Throws InputError before the first.
  trajectory::BaseMotion at(double time) const;
  bool empty() const { return samples_.empty(); }

 private:
  std::size_t window_;
  std::vector<trajectory::Sample> samples_;
  trajectory::Trajectory fitted_;
};

// --- whole problems --------------------------------------------------------------------------------------------------

// Where a plan for this rope starts: at rest where its recording began, without targets. Of a rope without dynamics the
// usual are assumed, and a warning says so.
planning::Problem planning_problem(const Rope& rope);
// Lets the problem start as one camera of a capture shows the rope in its first frame, with the base where it is then,
// at rest, since one image shows no speed. Returns by which camera, and how well that explains it: the overlap of mask
// and rope, and the outline's RMS distance, px. Throws InputError where the camera does not surely show the rope.
struct FirstSight {
  std::string camera;
  double iou = 0.0, residual = 0.0;
};
FirstSight start_as_seen(const Rope& rope, const Path& capture, const std::string& camera, planning::Problem& problem);

// What to record next (excitation.h): a motion from rest where this rope's recording began, compared with one more
// recording of the old motion. Throws InputError before identification.
excitation::Problem excitation_problem(const Rope& rope);

// The force from outside along `states` under `base`, one a time: where it acts is found, or it acts at what is nearest
// to `contact`, m, world. Throws InputError for fewer than three states, and for times that the base does not cover.
std::vector<force::Estimate> forces(const Rope& rope, const chain::States& states, const trajectory::Trajectory& base,
                                    const std::optional<math::Vector3>& contact = {});

}  // namespace chainsplat::pipeline
