// chainsplat/force.h - the external force on the rope: angles over time and a twin in; the force that the outside
// exerts on the rope, with its place and its standard error, out (mathematics.md 7).
//
// At a material point with position Jacobian J the force f solves J^T f = r, where the residual r = M ddtheta + h +
// K (theta - theta_0) + D dtheta is the generalized force that the model does not explain. Where a direction is badly
// observable (along a straight rope) or not at all (the bending axis of a planar chain), the prior keeps f small and
// the standard error is large. Forces are in N and points in m, both in the world frame.
#pragma once
#include <functional>
#include <memory>
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

// Angles with their derivatives and uncertainty. The covariance of (theta, thetadot, thetaddot) at time f is the
// Kronecker product covariance[f] x noise. In addition theta may have errors of covariance `standing` that last longer
// than the smoother's memory.
struct Motion {
  std::vector<double> time;                         // s
  std::vector<VectorX> theta, thetadot, thetaddot;  // n per time
  MatrixX noise;                                    // n x n, rad^2, of the observed angles
  std::vector<Matrix3> covariance;                  // one per time
  std::vector<MatrixX> standing;                    // n x n, rad^2, one per time, or empty
  std::vector<double> clock;                        // s, Clock::sigma, one per time, or empty: the clock is known
  std::vector<MatrixX> by_clock;                    // n x 3: what one such deviation adds to theta, thetadot, thetaddot
};

// What is not known of the base's clock at a time. A base that is later also makes the angles others: they were found
// with the base where it was believed to be. By how many of its deviations the clock is off is the same at all times.
struct Clock {
  double sigma = 0.0;  // s, standard deviation of how late the base's stamps are
  VectorX theta;       // rad/s, how the angles change with it; n, or empty: not known
};

// Smooths every angle by a Kalman filter and Rauch-Tung-Striebel smoother under random jerk. The sizes of jerk and
// noise and the correlations of the angles' errors are found by maximum likelihood; the ratio of jerk and noise is the
// same for all angles. The covariances of `states`, if any, are those of the angles' lasting errors. Throws InputError
// for fewer than three times. `clock`: one per time, or empty; where no deviation is above 0 the base's clock is known.
Motion smooth(const chain::States& states, std::span<const Clock> clock = {});

// Returns the covariance of angles of which only the standard deviations are known. Cameras observe positions: the
// errors of the links' ends are independent, so that those of neighboring angles cancel.
MatrixX angle_covariance(const chain::Chain& chain, const VectorX& theta, const VectorX& sigma);

struct Options {
  double force_scale = 0.5;          // N, the prior's deviation across a 60 g rope; scaled in proportion to the mass
  double along = 0.3;                // the deviation along the rope, where fingers slip, as a share of that across
  double relative_deviation = 0.1;   // relative model error of stiffness, damping and friction
  double gravity_deviation = 0.002;  // model error of a chain of few links: a force at every link's end, of the weight
  double friction_reach = 0.25;      // of the rope's length, over which friction at rest has about the same direction
  double pressing = 0.25;            // share of the force in the table's plane that presses the rope down as well, by
                                     // friction at the finger (0 to its coefficient, about 0.5), and its deviation
  double error_memory = 0.1;         // s, correlation time of the model's and the states' errors
  double contact_time = 1.0;         // s, mean duration of a contact
  double slide = 0.1;                // lengths of the rope per sqrt(s), random walk of a contact along it
  int places = 60;                   // number of arclengths tried for an automatic contact
};

// Returns models that together stand for the uncertainty that identification leaves: each differs from `model` by one
// standard deviation along a principal direction of the estimates' covariance. A warning names the parameters whose
// covariance is unknown (NaN). Where all is unknown, the directions are every joint's stiffness and damping.
std::vector<dynamics::Model> deviations(const dynamics::Model& model, const dynamics::Estimates& estimates);

// The force at one place.
struct Fit {
  Vector3 force = Vector3::Zero();           // N, world, on the rope
  Matrix3 covariance = Matrix3::Identity();  // N^2
  double explained = 0.0;                    // decrease of chi square by the force, prior included
  double evidence = 0.0;                     // log likelihood ratio of the residual with and without a force
};

// Returns the force (J C^-1 J^T + prior^-1)^-1 J C^-1 r. `jacobian`: 3 x n; `residual`: n; `covariance`: n x n, of the
// residual; `prior`: prior covariance of the force, N^2. Throws InputError where `covariance` is not positive definite.
Fit solve(const MatrixX& jacobian, const VectorX& residual, const MatrixX& covariance, const Matrix3& prior);

// Returns the residual r of mathematics.md 7: n numbers, N m.
VectorX residual_torque(const dynamics::Model& model, const trajectory::BaseMotion& base, const VectorX& theta,
                        const VectorX& thetadot, const VectorX& thetaddot);

// The place where the rope is touched.
struct Contact {
  int link = 0;
  double arclength = 0.0;          // m
  Vector3 home = Vector3::Zero();  // m, home position of the material point, base frame
  double distance = 0.0;           // m, from the named point
};

// Returns the Gaussian nearest to any of the `points` (world, columns), on its most probable link; without Gaussians
// the nearest point of the centerline.
Contact nearest_contact(const chain::Chain& chain, const splat::Gaussians& gaussians, const math::Pose& base,
                        const VectorX& theta, const MatrixX& points);

struct Estimate {
  double time = 0.0;  // s
  Contact contact;
  Vector3 point = Vector3::Zero();       // m, place of the contact, world
  Vector3 force = Vector3::Zero();       // N, or N per kilogram of rope; times the probability of an automatic contact
  Vector3 sigma = Vector3::Zero();       // standard errors, in the unit of the force
  Matrix3 covariance = Matrix3::Zero();  // of the force, in its unit squared; sigma has the roots of its diagonal
  Vector3 low = Vector3::Zero();         // bounds of the force per component, without sigma, where friction at rest of
  Vector3 high = Vector3::Zero();        // all links together may hide a part of it (mathematics.md 7); else the force
  Vector3 observed = Vector3::Zero();    // 0 (the prior alone decides) to 1, per component
  double probability = 0.0;              // of a contact
  double arclength_sigma = 0.0;          // m, of an automatic contact; else 0
  bool touching = false;
  bool moving = true;  // false: the rope rests where it is touched, and friction there may hide forces
};

// Returns one estimate per time of `motion`. `deviations`: as returned above. `contacts`: one per time, empty where
// nothing touches; an empty span: automatic. Whether something touches, and the place of an automatic contact, are
// tracked over time. An automatic contact lies on the side of the rope that is pushed, and its force is the mean over
// its possible places. Throws InputError as solve().
std::vector<Estimate> estimate(const dynamics::Model& model, std::span<const dynamics::Model> deviations,
                               const dynamics::BaseFunction& base, const Motion& motion,
                               std::span<const std::optional<Contact>> contacts, const Options& options = {});

// What touches the rope at a time, with the angles then; none where nothing does. An empty function: automatic.
using ContactAt = std::function<std::optional<Contact>(double time, const VectorX& theta)>;

// The same as estimate() while states arrive: each estimate comes kLiveLag states after its own state, and uses these
// and earlier ones. The later states determine the acceleration; without any, a push can hardly be distinguished from a
// swing. One thread at a time.
inline constexpr std::size_t kLiveLag = 2;
class LiveForce {
 public:
  // Arguments as those of estimate().
  LiveForce(dynamics::Model model, std::vector<dynamics::Model> deviations, dynamics::BaseFunction base,
            ContactAt contact = {}, const Options& options = {});
  ~LiveForce();
  LiveForce(LiveForce&&) noexcept;
  LiveForce& operator=(LiveForce&&) noexcept;

  // Adds a state. `standing`: n x n, or empty at all times; times must increase. Returns none for the first kLiveLag
  // states.
  std::optional<Estimate> update(double time, const VectorX& theta, const MatrixX& standing, const Clock& clock = {});
  // Returns the estimates that are due after the last state; none for fewer than three states.
  std::vector<Estimate> finish();
  std::size_t taken() const;  // number of states received

 private:
  struct State;
  std::unique_ptr<State> state_;
};

// Returns false where too large numbers or a twin without mass leave no finite force.
bool is_finite(const Estimate& estimate);
// Returns the line of formats.md 3.2, without line feed; numbers that are not finite become null. `known_mass` false:
// forces are per kilogram of rope, and the line's unit is N/kg.
std::string to_json(const Estimate& estimate, bool known_mass);

// A line read back. The contact's home position and distance do not stand in it: they are zero.
struct Line {
  Estimate estimate;
  bool known_mass = true;  // false: the unit is N/kg
};
// Reads a line of to_json(), of a rope with this chain. `before`: s, time of the line before. Throws InputError with
// `where` and the field that is missing, of another type, not finite, or not what a force on this rope can have: a
// contact outside of the chain, a covariance that is none or does not belong to sigma, a time that is not after
// `before`.
Line from_json(const std::string& line, const std::string& where, const chain::Chain& chain, double before);

}  // namespace chainsplat::force
