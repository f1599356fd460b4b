// chainsplat/identification.h - recognized angles and the base's motion -> masses, stiffness, damping, friction
// (mathematics.md 5).
//
// The whole capture is one open-loop rollout. Its centerline, relative to the base, is fitted to the recognized one by
// Levenberg-Marquardt over a growing horizon, with priors on everything and sensitivities from the variational
// equation. From kinematics only ratios to one mass are observable: the total mass is held at `mass`, else at 1 kg.
#pragma once
#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "chainsplat/dynamics/parametrization.h"

namespace chainsplat::identification {

// Centers of the priors where nothing is known of a rope, and starts. Stiffness is relative to weight times length.
inline constexpr double kStiffnessPart = 0.1;
inline constexpr double kRetardation = 0.07;   // s, damping over stiffness
inline constexpr double kDampingPart = 0.004;  // s, damping over weight times length, where there is no stiffness
// N s^2/m^3 per meter of diameter: half the density of air times the coefficient of a cylinder across the flow
inline constexpr double kDragPerDiameter = 0.5 * 1.2 * 1.2;
inline constexpr double kTipPart = 0.03;
inline constexpr double kCoulombMean = 0.3;
inline constexpr double kViscousRate = 3.0;  // 1/s, friction over mass

// Friction in bending, where the data ask for it: of the moment weight times length; rad, of a joint that stands for
// the mean length of a link.
inline constexpr double kBendingFrictionPart = 0.02;
inline constexpr double kBendingFrictionAngle = 0.05;

// What is known of an unknown beforehand: takes the place of its prior. The index can be dynamics::kEvery.
struct Prior {
  dynamics::Unknown unknown;
  double mean = 0.0, deviation = 1e-4;  // in units of the unknown
};

struct Options {
  bool tabletop = false;                // Coulomb friction on a table, else air drag
  math::Vector3 gravity{0, 0, -9.81};   // m/s^2, world
  math::Vector3 table_normal{0, 0, 1};  // unit, world; used on a table
  std::optional<double> mass;           // kg, links and tip; none: 1 kg, forces are then per kilogram
  // kg, a payload at the free end and its standard deviation; part of `mass`, which must be there. None: a rope's bare
  // end, or where the data ask for it a payload of unknown mass.
  std::optional<double> tip_mass;
  double tip_mass_deviation = 0.0;
  std::optional<double> tip_length;  // m, how far that payload reaches; none: not known
  // Where a fit in free space leaves more than the errors of the data, friction in bending and a payload are tried, and
  // taken if the evidence is for them (mathematics.md 5.10).
  bool ask_for_more = true;
  bool fit_stiffness = true;      // else 0
  bool fit_torsion = true;        // in free space, of chains that bend in space (mathematics.md 3.11)
  bool per_joint = true;          // stiffness, damping and mass vary smoothly along the rope
  bool friction_per_link = true;  // else one Coulomb coefficient for the whole rope
  std::vector<Prior> priors;
  bool paper = false;  // kappa = 0; d_j, m_j and viscous mu_j by Adam on the angles
  dynamics::Integrator integrator = dynamics::Integrator::rodas3;  // paper: implicit_velocity_euler, one step a frame
  int substeps = 0;           // a frame of 1/30 s; 0: 4, on a table 8 (stick and slip)
  double start_factor = 1.0;  // stiffness, damping, drag and friction of the first starts, to what is usual
  std::uint64_t seed = 0;     // of further starts where the first ones fit poorly
  int max_iterations = 25;    // of Levenberg-Marquardt, a horizon
  double model_error = 1e-3;  // m, of one coordinate of a point of the chain, beside what the states' covariances say
  int adam_iterations = 300;  // paper
  // Angles times angles times frames of all recordings beyond which windows of them are fitted (mathematics.md 5.3):
  // memory grows with that number, time with the angles once more. 24 angles at 30 Hz reach it after eight minutes, 128
  // after a quarter of a minute.
  std::size_t most_numbers = 1 << 23;
};

struct Result {
  dynamics::Parameters parameters;
  dynamics::InitialState initial;  // at the first recognized time
  chain::States rollout;           // at all recognized times, under the capture's base motion
  dynamics::Estimates estimates;
  // m, rollout against recognized nodes, over nodes but the grasp and over the frames that are fitted
  double node_rms = 0.0;
  // m, the same with parameters of this recording alone. Much less: it is of another rope than the others.
  double alone_rms = 0.0;
};

// A recording of the rope: how its base moved and what was seen of it.
struct Recording {
  trajectory::Trajectory base;
  chain::States recognized;  // at least 3 times, increasing; what has covariances counts by them
};

// Measured world positions of material points on the centerline, e.g. motion-capture markers.
struct Markers {
  std::vector<double> arclengths;    // m, from the grasp
  std::vector<double> time;          // s, increasing
  std::vector<math::MatrixX> world;  // a time: 3 x markers, m; NaN where a marker is not seen
  double deviation = 5e-3;           // m, of one measured coordinate about the chain: mounts, and what the chain lacks
};

// The smoothest chain through the markers at every time: least squares with priors on bending, on its differences from
// joint to joint and from time to time, so that few markers suffice; with covariances. Throws InputError where
// arclengths, times or sizes do not fit, or a time shows no marker.
struct MarkerFit {
  chain::States states;
  solve::Summary summary;  // of all times together; rad
};
MarkerFit fit_markers(const chain::Chain& chain, const trajectory::Trajectory& base, const Markers& markers);

// The state at the first time with which `parameters` follow the first `seconds` of the markers best, rates and
// friction states included. Throws as identify().
inline constexpr double kInitialWindow = 0.5;  // s
dynamics::InitialState fit_initial(const chain::Chain& chain, const dynamics::Parameters& parameters,
                                   const trajectory::Trajectory& base, const Markers& markers,
                                   double seconds = kInitialWindow);

// Of one recording. Throws InputError for too little data, WorkError where no start gives a rollout that stays finite.
Result identify(const chain::Chain& chain, const trajectory::Trajectory& base, const chain::States& recognized,
                const Options& options);
// The same with fit_markers() as the start and the markers themselves as residuals. `node_rms` is that of the markers.
Result identify(const chain::Chain& chain, const trajectory::Trajectory& base, const Markers& markers,
                const Options& options);

// How a rope rolls on a table, from recognized states with rolls, of a planar chain whose dynamics are known
// (mathematics.md 5.12). None where the law leaves more of the rolls than it explains.
struct RollingFit {
  std::optional<dynamics::Rolling> rolling;
  solve::Summary summary;  // unknowns in deviations of their priors
};
RollingFit fit_rolling(const dynamics::Model& model, const trajectory::Trajectory& base, const chain::States& states);

// Several recordings of one rope: one set of parameters, an initial state each. A result a recording: its own initial
// state and rollout, and the estimates of the shared parameters followed by those of its initial state.
std::vector<Result> identify(const chain::Chain& chain, std::span<const Recording> recordings, const Options& options);
struct MarkerRecording {
  trajectory::Trajectory base;
  Markers markers;
};
std::vector<Result> identify(const chain::Chain& chain, std::span<const MarkerRecording> recordings,
                             const Options& options);

}  // namespace chainsplat::identification
