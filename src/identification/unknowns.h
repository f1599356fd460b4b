// Private to identification: which numbers are fitted, their priors, and what they mean for the dynamics.
#pragma once
#include <string>
#include <vector>

#include "chainsplat/identification.h"

namespace chainsplat::identification {

using math::MatrixX;
using math::VectorX;

// The unknowns p in one vector, with prior N(mean, inverse(precision)).
struct Unknowns {
  std::vector<std::string> names;
  VectorX mean;
  MatrixX precision;
  std::vector<std::pair<std::string, std::string>> held;

  // first index of each group in p, -1 where the group is held
  int stiffness = -1, twist_stiffness = -1, grasp_stiffness = -1, damping = -1, drag = -1, tip = -1, coulomb = -1,
      viscous = -1;
  int joint_stiffness = -1, joint_damping = -1, link_mass = -1, rest = -1, roll = -1, theta = -1, thetadot = -1;
  int first_roll = 0;  // the angle of unknown `roll`
  double total_mass = 1.0;
  std::vector<double> compliance;  // an angle: reference over tributary length, times the shared stiffness and damping
  std::vector<bool> twist;         // an angle: turns about the rope
  dynamics::Parameters fixed;      // everything that is not fitted
  VectorX first_theta, first_thetadot;  // used where the initial state is held

  int size() const { return static_cast<int>(names.size()); }
};

inline constexpr double kThetaSd = 0.02;   // rad, initial angles about the recognized ones without covariances
inline constexpr double kRateSd = 0.5;     // rad/s, initial velocity about the differences of the recognized angles
inline constexpr double kAtRestSd = 1e-4;  // rad/s, of a rope on a table under a base at rest: friction holds it

// Priors follow SPEC 5. `theta_sd` per angle, rad; `rate_sd` of the initial velocities, rad/s.
Unknowns make_unknowns(const chain::Chain& chain, const Options& options, const VectorX& theta, const VectorX& thetadot,
                       const VectorX& theta_sd, double rate_sd = kRateSd);

struct State {
  dynamics::Parameters parameters;
  VectorX theta, thetadot;
};
State apply(const chain::Chain& chain, const Unknowns& unknowns, const VectorX& p);
// d State / d p_i for every unknown.
std::vector<dynamics::Tangent> tangents(const chain::Chain& chain, const Unknowns& unknowns, const VectorX& p);

}  // namespace chainsplat::identification
