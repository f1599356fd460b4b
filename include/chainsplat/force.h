// chainsplat/force.h - angles over time and a twin -> the force that the outside exerts on the rope (SPEC 7).
//
// At a material point with position Jacobian J the force f solves J^T f = r, with the generalized force that the model
// does not explain, r = M ddtheta + h + K (theta - theta_0) + D dtheta. Where J sees a direction badly (along a
// straight rope) or not at all (the bending axis of a planar chain) the prior keeps f small and the standard error says
// so.
#pragma once
#include <functional>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "chainsplat/dynamics.h"
#include "chainsplat/splat.h"
#include "chainsplat/twin.h"

namespace chainsplat::force {

using math::Matrix3;
using math::MatrixX;
using math::Vector3;
using math::VectorX;

// Angles with their derivatives, and how sure they are: the covariance of (theta, thetadot, thetaddot) at time f is the
// Kronecker product covariance[f] x noise; theta may be off by `standing` besides, for longer than the smoother sees.
struct Motion {
  std::vector<double> time;                         // s
  std::vector<VectorX> theta, thetadot, thetaddot;  // n
  MatrixX noise;                                    // n x n, rad^2, of the angles that were given
  std::vector<Matrix3> covariance;                  // a time
  std::vector<MatrixX> standing;                    // n x n, rad^2, a time, or empty
};

// Kalman filter and Rauch-Tung-Striebel smoother of every angle under random jerk. How large jerk and noise are, and
// how the angles' errors hang together, is found by maximum likelihood; the ratio of jerk and noise is one for all
// angles. The covariances of `states`, if any, are those of the angles' lasting errors: `standing`. Throws InputError for
// fewer than three times.
Motion smooth(const chain::States& states);

// Covariance of angles of which only the standard deviations are known. Cameras see where the rope is: errors of the
// links' ends are independent, so those of neighboring angles cancel.
MatrixX angle_covariance(const chain::Chain& chain, const VectorX& theta, const VectorX& sigma);

struct Options {
  double force_scale = 0.5;          // N a 60 g rope is pushed with, in proportion to the mass: the prior's deviation
  double along = 0.3;                // of the force across: the same along the rope, where fingers slip
  double relative_deviation = 0.1;   // of stiffness and damping torques and of friction: what their laws lack
  double gravity_deviation = 0.002;  // of the rope's weight times its length: torque that a chain of few links lacks
  double friction_reach = 0.25;      // of the rope's length, over which friction at rest has about one direction
  double pressing = 0.25;            // of the force in the table's plane: how hard it presses the rope down besides, as
                                     // friction at a finger does (0 to its coefficient, about 0.5), and its deviation
  double error_memory = 0.1;         // s, in which the model's and the states' errors stay the same
  double contact_time = 1.0;         // s, a contact lasts in the mean
  double slide = 0.1;                // lengths of the rope in 1/sqrt(s), a contact wanders along it
  int places = 60;                   // arclengths tried for an automatic contact
};

// What identification leaves open, as models as likely as `model`: one standard deviation away along every principal
// direction of the estimates' covariance; a warning names the parameters whose covariance is not known (NaN). Without
// any, every joint's stiffness and damping alone.
std::vector<dynamics::Model> deviations(const dynamics::Model& model, const dynamics::Estimates& estimates);

// The force at one place.
struct Fit {
  Vector3 force = Vector3::Zero();           // N, world, on the rope
  Matrix3 covariance = Matrix3::Identity();  // N^2
  double explained = 0.0;                    // fall of chi square by the force, prior included
  double evidence = 0.0;                     // log likelihood of the residual over that without any force
};

// (J C^-1 J^T + prior^-1)^-1 J C^-1 r. `jacobian` 3 x n, `residual` n, `covariance` n x n of the residual; `prior`:
// covariance of the force before it was felt, N^2. Throws InputError where `covariance` is not positive definite.
Fit solve(const MatrixX& jacobian, const VectorX& residual, const MatrixX& covariance, const Matrix3& prior);

// r of SPEC 7. n, N m.
VectorX residual_torque(const dynamics::Model& model, const trajectory::BaseMotion& base, const VectorX& theta,
                        const VectorX& thetadot, const VectorX& thetaddot);

// Where the rope is touched.
struct Contact {
  int link = 0;
  double arclength = 0.0;          // m
  Vector3 home = Vector3::Zero();  // of the material point, base frame, m
  double distance = 0.0;           // m, from where a hand was said to be
};

// The Gaussian nearest to any of the `points` (world, columns), on its most probable link; without Gaussians the
// nearest point of the centerline.
Contact nearest_contact(const chain::Chain& chain, const splat::Gaussians& gaussians, const math::Pose& base,
                        const VectorX& theta, const MatrixX& points);

struct Estimate {
  double time = 0.0;
  Contact contact;
  Vector3 point = Vector3::Zero();     // of the contact, world, m
  Vector3 force = Vector3::Zero();     // N, or N a kilogram of rope; times the probability of an automatic contact
  Vector3 sigma = Vector3::Zero();     // standard errors
  Vector3 low = Vector3::Zero();       // what the force may be where friction at rest, of all links together, hides
  Vector3 high = Vector3::Zero();      // a part of it (SPEC 7), by component; else the force. Without its sigma
  Vector3 observed = Vector3::Zero();  // 0 (only the prior speaks) .. 1, by component
  double probability = 0.0;            // that something touches
  double arclength_sigma = 0.0;        // m, of an automatic contact; else 0
  bool touching = false;
  bool moving = true;  // false: the rope rests where it is touched, and friction there may hide forces
};

// One line a time of `motion`. `deviations`: as above. `contacts`: a time each, empty where nothing is said to touch;
// an empty span: automatic. Whether something touches, and an automatic contact's place, are followed over time. An
// automatic contact lies on the side of the rope that is pushed, and its force is the mean over the places that it may
// have.
std::vector<Estimate> estimate(const dynamics::Model& model, std::span<const dynamics::Model> deviations,
                               const dynamics::BaseFunction& base, const Motion& motion,
                               std::span<const std::optional<Contact>> contacts, const Options& options = {});

// The same while states come in: a line is given kLiveLag states after its own, from these and earlier ones. What an
// acceleration is, the states after it tell: with none of them a push is hardly told from a swing.
inline constexpr std::size_t kLiveLag = 2;
struct Live {
  dynamics::Model model;
  std::vector<dynamics::Model> deviations;
  dynamics::BaseFunction base;
  // what touches at a time, given the angles then; empty: automatic
  std::function<std::optional<Contact>(double time, const VectorX& theta)> contact;
  Options options;
  chain::States states;  // of the last seconds
  VectorX belief;  // where it is touched, at the last line's time; empty before the first
  std::size_t lines = 0, taken = 0;
};
// Takes a state in. `standing` n x n, or empty at all times; times must increase. No line for the first states.
std::optional<Estimate> update(Live& live, double time, const VectorX& theta, const MatrixX& standing);
// The lines that are still due after the last state; none for fewer than three states.
std::vector<Estimate> finish(Live& live);

// False where numbers too large or a twin without mass left no force to tell.
bool is_finite(const Estimate& estimate);
// The line of INTERFACE 5, without line feed; what is not finite is null. `known_mass` false: forces are per kilogram
// of rope, and the line says so.
std::string to_json(const Estimate& estimate, bool known_mass);

}  // namespace chainsplat::force
