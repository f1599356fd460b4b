// chainsplat/twin.h - the result as one value, and its run folder (INTERFACE 3).
//
// twin.json ("format": "chainsplat-twin/1"); SI units, radians. Keys marked * are absent before identification.
//   grasp           direction, bending_axis: unit vectors, base frame
//   chain           scenario ("free", "tabletop"); length, diameter; gravity (world); on a table
//                   table { point, normal }
//     joints        one an angle, base to tip: axis [w, v] (base frame, home, space form), parent_link, child_link,
//                   stiffness*, rest_angle*, damping*, and on a table, planar bending, roll_lever* (m)
//     links         n_l + 1, number 0 is the base link: length; mass*, inertia* [Ixx Iyy Izz Ixy Ixz Iyz] about the
//                   center of mass, axes of the base frame at home, without the tip mass; center_of_mass* from the
//                   link's joint; viscous_friction* (N s/m), coulomb_friction*. Link 0 is held: its are written as 0
//     air_drag*     linear (N s/m^2), quadratic (N s^2/m^3): per meter of rope, one number for the whole rope
//     tip_mass*, regularization* { coulomb_speed, drag_speed }, integrator* { name, substeps a 1/30 s }
//     initial_state* time, theta, thetadot
//   identification  known_mass (false: masses are relative, forces per kilogram); names*, estimates*, standard_errors*,
//                   covariance* (by rows), held* [ { name, reason } ]; null where a number is not known;
//                   weak* [ { singular_value, direction { name: component } } ]: what the data cannot tell apart
//   gaussians, states, rollout   file names, each absent until that file is there
//   provenance      version, capture, capture_hash, options, seed, device, driver, durations { stage: s }
#pragma once
#include <map>
#include <optional>
#include <string>
#include <vector>
#include "chainsplat/capture.h"
#include "chainsplat/chain.h"
#include "chainsplat/core.h"
#include "chainsplat/dynamics.h"
#include "chainsplat/splat.h"

namespace chainsplat::twin {

enum class Mode { fast, paper };  // of recognition and identification
std::string mode_text(Mode mode);

// How the twin was made. What later work goes by has a type of its own; absent: not known, or it does not apply.
struct Provenance {
  std::string version, capture, capture_hash, device, driver;
  std::optional<double> mass;                 // kg, of the rope
  std::optional<capture::FrameRange> frames;  // of the capture that were recognized
  std::optional<int> every;                   // frames between those that trained the Gaussians
  std::optional<Mode> mode;
  std::optional<std::string> path;             // of the capture, from the run folder
  bool joint = false;                          // refined by images and dynamics together
  std::map<std::string, std::string> options;  // further ones, for a reader
  std::uint64_t seed = 0;
  std::map<std::string, double> seconds;  // by stage
};
// All options as texts, as twin.json has them under provenance.options.
std::map<std::string, std::string> option_texts(const Provenance& provenance);

struct Twin {
  bool tabletop = false;
  chain::Chain chain;
  // Of the scene. With `parameters`, theirs count and are what is saved; load() sets both.
  math::Vector3 gravity{0, 0, -9.81};                      // m/s^2, world
  std::optional<math::Vector3> table_point, table_normal;  // m and unit, world
  std::optional<dynamics::Parameters> parameters;          // none before identification
  std::optional<dynamics::InitialState> initial;
  dynamics::Estimates estimates;
  Provenance provenance;
  bool known_mass = false;
  splat::Gaussians gaussians;  // count 0 before recognition
  chain::States states;        // recognized, every frame
  chain::States rollout;
};

// Writes twin.json, gaussians.ply, states.csv, rollout.csv (those that exist); makes the folder. Each file in one step,
// twin.json last. Throws WorkError. Doubles read back exactly. What twin.json has no place for: air drag that is not
// proportional to the links' lengths becomes its mean per meter of rope, `table_carries_weight` reads back as true.
void save(const Twin& twin, const Path& run);
// Throws InputError naming file and key.
Twin load(const Path& run);

// 'time,theta_1,...,theta_n,thetadot_1,...,thetadot_n'; the second half only where `thetadot` is given.
std::string states_csv(const chain::States& states);
// Throws InputError with file and line: missing, damaged, times not increasing, or not `angles` angles.
chain::States read_states(const Path& file, int angles);
// 'time,x_0,y_0,z_0,...': chain::nodes at every state, world frame, m.
std::string centerline_csv(const chain::Chain& chain, const chain::States& states, const trajectory::Trajectory& base);
// Binary little-endian, 3DGS properties, then link_0.. (logits). Home configuration, base frame, m.
std::string gaussians_ply(const splat::Gaussians& gaussians);
// Also reads other programs' 3DGS files: properties in any order, unknown ones skipped, no link_*: `links` is 0.
splat::Gaussians read_ply(const Path& file);
// x, y, z of a point cloud as other programs write it: PLY, ASCII or binary of either byte order, float or double; what
// is not finite is left out. 3 x count.
math::MatrixX read_points(const Path& file);

}  // namespace chainsplat::twin
