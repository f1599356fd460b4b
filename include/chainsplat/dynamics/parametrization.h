// chainsplat/dynamics/parametrization.h - what the unknowns of fits and filters mean for a rope's parameters.
//
// An unknown is a coordinate: the logarithm of a factor of stiffness, an angle that is added to a rest angle. One table
// in src/dynamics/parametrization.cpp says of every quantity its name in files, its unit, on which numbers it acts and
// how. Names, parameters and derivatives follow from that table alone: a new quantity is an entry of Quantity and a
// row.
#pragma once
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "chainsplat/dynamics.h"

namespace chainsplat::dynamics {

// In the order of the table.
enum class Quantity {
  none,  // a name that the table does not have, or of a joint that the chain does not have: it changes nothing
  stiffness,
  grasp_stiffness,  // of the second axis at the grasp over the first
  twist_stiffness,  // of all axes along the rope over the others
  damping,
  joint_stiffness,  // of one joint over that of all
  joint_damping,
  link_mass,  // one link's part; the total mass stays
  coulomb_friction,
  viscous_friction,
  friction,  // all links' friction against the table
  drag,
  tip_mass,    // the tip's part of the total mass, which stays
  tip_length,  // of what hangs there; only where the parameters have one
  rest_angle,
  roll_lever,
  bending_friction,  // the moment of all joints; only where the parameters have some
  bending_friction_angle,
  torsional_stiffness,  // of all joints over what bending would have it
  theta,                // of the initial state
  thetadot,
  friction_state
};

inline constexpr int kEvery = -1;
struct Unknown {
  Quantity quantity = Quantity::none;
  int index = 0;  // joint, link or angle, from 0; 0 for what the whole rope has once; kEvery: all of a kind, in priors

  bool operator==(const Unknown&) const = default;
};

// "log_stiffness", "log_mass_link_3": the quantity's name in files and, where there are several, the number from 1.
std::string name_of(const Unknown& unknown);
// The opposite; kEvery where a quantity of several has no number. None for other names.
std::optional<Unknown> unknown_named(const std::string& name);
// In the order of the estimates. Names that `chain` has no number for are Quantity::none.
std::vector<Unknown> unknowns_of(const chain::Chain& chain, const Estimates& estimates);

const char* unit_of(Quantity quantity);  // of the values: "log(N m/rad)", "rad"
double scale_of(Quantity quantity);      // a large change, in that unit: 1 for every logarithm
bool is_parameter(Quantity quantity);    // changes parameters; not of the initial state
// Whether a change of this unknown changes these parameters, to first order.
bool has_effect(const chain::Chain& chain, const Parameters& parameters, const Unknown& unknown);
// Where the parameters are among `unknowns`.
std::vector<Eigen::Index> parameters_among(std::span<const Unknown> unknowns);
// The unknowns theta_1..n, then thetadot_1..n. Not friction_state: filters take it as it is.
std::vector<Unknown> initial_state_unknowns(const chain::Chain& chain);

// `reference` after its unknowns have changed by `change`: the parameters, and the initial state. `total_mass` in kg is
// what links and tip keep together, and none: what they have in `reference`. With one, the link masses of `reference`
// count as ratios only. No unknown may be of kEvery.
Parameters moved(const chain::Chain& chain, const Parameters& reference, std::span<const Unknown> unknowns,
                 const VectorX& change, std::optional<double> total_mass = {});
InitialState moved(const InitialState& reference, std::span<const Unknown> unknowns, const VectorX& change);
// The derivatives of both at the moved `parameters`, exact.
std::vector<Tangent> tangents(const chain::Chain& chain, const Parameters& parameters,
                              std::span<const Unknown> unknowns, std::optional<double> total_mass = {});

}  // namespace chainsplat::dynamics
