// chainsplat/twin.h - the result of training as one value, and its run folder (formats.md 2).
//
// Recognition provides the chain, the Gaussians and the states, identification the parameters. Rollout, rendering,
// estimation, planning and export start from a twin. In the file `about` says in words what its numbers mean.
//
// twin.json ("format": "chainsplat-twin/1"); SI units, radians. Keys marked * are absent before identification.
//   grasp           direction, bending_axis: unit vectors, base frame
//   chain           scenario ("free", "tabletop"); length, diameter; gravity (world); on a table also
//                   table { point, normal } (world)
//     joints        one entry per angle, base to tip: axis [w, v] (base frame, home, space form), parent_link,
//                   child_link, stiffness*, rest_angle*, damping*; roll_lever* (m) for planar bending on a table
//     links         n_l + 1 entries, entry 0 is the base link: length; mass*, inertia* [Ixx Iyy Izz Ixy Ixz Iyz] about
//                   the center of mass, in the axes of the base frame at home, without the tip mass; center_of_mass*
//                   from the link's joint; viscous_friction* (N s/m per link), coulomb_friction*. Link 0 is held by the
//                   gripper, and its mass, inertia and friction are written as 0
//     air_drag*     linear (N s/m^2), quadratic (N s^2/m^3): per meter of rope, one number for the whole rope
//     tip_mass*, regularization* { coulomb_speed, drag_speed }, integrator* { name, substeps per 1/30 s }
//     initial_state* time, theta, thetadot
//   identification  known_mass (false: masses are relative, forces are per kilogram); names*, estimates*,
//                   standard_errors*, covariance* (by rows), held* [ { name, reason } ]; null for an unknown number;
//                   weak* [ { singular_value, direction { name: component } } ]: combinations of parameters that the
//                   data hardly determine;
//                   solver* { reason, iterations, initial_cost, final_cost, worst_step }: how the fit ended (solve.h)
//   properties*     what a rope is known by (properties.h); validity* acceleration, speed, curvature: each { value,
//   unit },
//                   the largest that the dynamics were identified from (validity.h)
//   corrections     cameras { name { rotation, translation, focal, time, mask_offset, mask_start, gain, bias;
//                   calibration } }, base { time }, grasp { translation }, object { length, diameter }: each
//                   { value, sigma, state } (corrections.h); absent where nothing was estimated
//   verdict, trusted   [ { code, subject, value, sigma, unit, corrected, trusted, frame, text } ]; false: do not trust
//   it gaussians, states, rollout   file names, each absent until the file exists provenance      version, capture,
//   capture_hash, options, seed, device, driver, durations { stage: s }
#pragma once
#include <map>
#include <optional>
#include <string>
#include <vector>
#include "chainsplat/capture.h"
#include "chainsplat/chain.h"
#include "chainsplat/core.h"
#include "chainsplat/corrections.h"
#include "chainsplat/dynamics.h"
#include "chainsplat/splat.h"
#include "chainsplat/validity.h"

namespace chainsplat::twin {

enum class Mode { fast, paper };  // of recognition and identification
std::string mode_text(Mode mode);

// How the twin was made. What later work goes by has a type of its own; absent: not known, or it does not apply.
struct Provenance {
  std::string version, capture, capture_hash, device, driver;
  std::optional<double> mass;                 // kg, of the rope without its payload
  std::optional<capture::Payload> payload;    // weighed; none: not known
  std::optional<capture::FrameRange> frames;  // of the capture that were recognized
  std::optional<int> every;                   // frames between those that trained the Gaussians
  std::optional<Mode> mode;
  std::optional<std::string> path;             // of the capture, from the run folder
  bool joint = false;                          // refined by images and dynamics together
  std::map<std::string, std::string> options;  // further ones, for a reader
  std::uint64_t seed = 0;
  std::map<std::string, double> seconds;  // per stage
};
// All options as texts, as twin.json has them under provenance.options.
std::map<std::string, std::string> option_texts(const Provenance& provenance);

struct Twin {
  bool tabletop = false;
  chain::Chain chain;
  // Of the scene. If there are `parameters`, their gravity and table normal are used and saved; load() sets both.
  math::Vector3 gravity{0, 0, -9.81};                      // m/s^2, world
  std::optional<math::Vector3> table_point, table_normal;  // m and unit, world
  std::optional<dynamics::Parameters> parameters;          // none before identification
  std::optional<dynamics::InitialState> initial;
  dynamics::Estimates estimates;
  std::optional<dynamics::Rolling> rolling;  // none: a rope that was not seen to roll
  Provenance provenance;
  std::optional<Validity> validity;  // of all recordings that the dynamics were identified from; none: not known
  bool known_mass = false;
  capture::Corrections corrections;       // of the recording, which everything later on the same cameras goes by
  std::vector<capture::Finding> verdict;  // what was found wrong or doubtful; empty: nothing
  bool trusted() const;                   // no finding says otherwise
  splat::Gaussians gaussians;             // count 0 before recognition
  chain::States states;                   // recognized, at every frame
  chain::States rollout;
};

// Writes twin.json, gaussians.ply, states.csv, rollout.csv (those that exist) and creates the folder. Each file is
// replaced atomically, twin.json last. Throws WorkError. Doubles read back exactly. twin.json does not represent all
// parameters: air drag that is not proportional to the links' lengths becomes its mean per meter of rope, and
// `table_carries_weight` reads back as true.
void save(const Twin& twin, const Path& run);
// Throws InputError that names file and key.
Twin load(const Path& run);
// The rope that a file describes, without the rest of a twin: a twin.json or its "chain" object alone, whose rope is
// held as `held` is (direction and bending axis). No parameters where it has none. Throws InputError that names file
// and key.
Twin load_chain(const Path& file, const chain::Chain& held);

// Columns 'time,theta_1,...,theta_n,thetadot_1,...,thetadot_n,roll_0,...,roll_l', without rates or rolls where there
// are none.
std::string states_csv(const chain::States& states);
// Throws InputError with file and line if the file is missing or damaged, if its times do not increase, or if it is of
// a chain with other numbers of angles and links.
chain::States read_states(const Path& file, const chain::Chain& chain);
// Columns 'time,x_0,y_0,z_0,...': chain::nodes at every state, world frame, m.
std::string centerline_csv(const chain::Chain& chain, const chain::States& states, const trajectory::Trajectory& base);
// `base`: one pose per state.
std::string centerline_csv(const chain::Chain& chain, const chain::States& states, std::span<const math::Pose> base);
// Binary little-endian PLY with the properties of 3DGS, then link_0, link_1, ... (logits). Home configuration, base
// frame, m.
std::string gaussians_ply(const splat::Gaussians& gaussians);
// Also reads 3DGS files of other programs: properties may come in any order, unknown ones are skipped, and without
// link_* `links` is 0.
splat::Gaussians read_ply(const Path& file);
// The points (3 x count) of a PLY point cloud of another program: ASCII or binary of either byte order, float or
// double. Points that are not finite are left out.
math::MatrixX read_points(const Path& file);

}  // namespace chainsplat::twin
