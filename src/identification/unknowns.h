// Private to identification: which numbers are fitted, their priors, and what they mean for the dynamics.
#pragma once
#include <string>
#include <vector>

#include "chainsplat/identification.h"

namespace chainsplat::identification {

using math::MatrixX;
using math::VectorX;

// The unknowns p in one vector, with prior N(mean, inverse(precision)). Parameters of one kind stand side by side.
struct Unknowns {
  std::vector<dynamics::Unknown> list;
  VectorX mean;
  MatrixX precision;
  std::vector<std::pair<std::string, std::string>> held;
  // What p = 0 stands for: units, so that a logarithm is that of the number itself; what is not fitted, as it is.
  dynamics::Parameters reference;
  dynamics::InitialState initial;
  double total_mass = 1.0;

  int size() const { return static_cast<int>(list.size()); }
  int first(dynamics::Quantity quantity) const;  // its first index in p, -1 where it is held
  std::vector<std::string> names() const;
};

inline constexpr double kThetaSd = 0.02;   // rad, initial angles about the recognized ones without covariances
inline constexpr double kRateSd = 0.5;     // rad/s, initial velocity about the differences of the recognized angles
inline constexpr double kAtRestSd = 1e-4;  // rad/s, of a rope on a table under a base at rest: friction holds it

// What a rope can have beside what every rope has.
struct Extras {
  bool friction = false;  // in bending
  bool payload = false;   // of unknown mass
};

// The rod under tension that says how much stiffer the joint at the grasp is than the others (dynamics/rod.h). That
// ratio depends on the rod's stiffness, which the fit finds: it is fitted again about the rod that was found.
struct Rod {
  double bending_stiffness = 0.0;  // N m^2; not positive: that of the prior
  double tension = 0.0;            // N, at the grasp
};

// What is known of the initial state beforehand: rad, rad/s, and the deviations of one.
struct Start {
  VectorX theta, thetadot, theta_sd;
  double rate_sd = kRateSd;
};

// Priors follow mathematics.md 5.
Unknowns make_unknowns(const chain::Chain& chain, const Options& options, const Start& start, const Extras& extras = {},
                       const Rod& rod = {});

// m, of rope that a joint stands for in the mean: the unknowns `stiffness` and `damping` are of such a joint.
double mean_bent_length(const chain::Chain& chain);

// The rod that a fit found. `direction`: of the first link at rest, world axes.
Rod rod_of(const chain::Chain& chain, const Unknowns& unknowns, const VectorX& p, const math::Vector3& direction);
// Moves p, of unknowns about one rod, to those about another: the joint at the grasp stays as stiff and as damped, where
// it has unknowns of its own.
void keep_grasp(const Unknowns& before, const Unknowns& now, VectorX& p);

// The initial state alone, of a rope of these parameters.
Unknowns make_state_unknowns(const chain::Chain& chain, const dynamics::Parameters& parameters, const Start& start);

struct State {
  dynamics::Parameters parameters;
  dynamics::InitialState initial;
};
State apply(const chain::Chain& chain, const Unknowns& unknowns, const VectorX& p);
// d State / d p_i for every unknown.
std::vector<dynamics::Tangent> tangents(const chain::Chain& chain, const Unknowns& unknowns, const VectorX& p);

}  // namespace chainsplat::identification
