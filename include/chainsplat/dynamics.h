// chainsplat/dynamics.h - motion of the chain under gravity, stiffness, damping, friction, drag and a moving base (SPEC 3, 4).
//
// Twists and wrenches are (angular, linear), in the frame of their link. Equations are named by SPEC's numbers.
#pragma once
#include <functional>
#include <optional>
#include <span>
#include <string>
#include <utility>
#include <vector>
#include "chainsplat/chain.h"
#include "chainsplat/trajectory.h"

namespace chainsplat::dynamics {

using math::Matrix3;
using math::MatrixX;
using math::Vector3;
using math::Vector6;
using math::VectorX;

enum class Integrator { rodas3, implicit_velocity_euler };  // SPEC 4 [D], [P] (corrected, base motion at t_k)

// The numbers of SPEC 3.1. Arrays per moving link j = 1..n_l are indexed j - 1; per angle k = 1..n are indexed k - 1.
struct Parameters {
  std::vector<double> link_mass;          // kg
  std::vector<double> viscous_friction;   // N s/m a link, against the table
  std::vector<double> coulomb_friction;   // effective coefficient a link, -
  std::vector<double> air_linear;         // N s/m a link, across the rope
  std::vector<double> air_quadratic;      // N s^2/m^2 a link, across the rope
  std::vector<double> stiffness;          // N m/rad an angle
  std::vector<double> rest_angle;         // rad
  std::vector<double> damping;            // N m s/rad
  double tip_mass = 0.0;                  // kg, point mass at the free end
  double radius = 0.0;                    // m, of the cylinder that gives the links' inertia; 0 allowed
  Vector3 gravity{0, 0, -9.81};           // m/s^2, world
  std::optional<Vector3> table_normal;    // unit, world; none: no table
  double coulomb_speed = 0.002;           // v_s, m/s
  double drag_speed = 0.001;              // v_eps, m/s
  Integrator integrator = Integrator::rodas3;
  int substeps = 4;                       // a frame of 1/30 s
};

// State at one time: where a rollout starts.
struct InitialState {
  double time = 0.0;
  VectorX theta, thetadot;  // rad, rad/s
};

// What identification says of its numbers; one entry a fitted parameter, in the order of the covariance.
struct Estimates {
  std::vector<std::string> names;                // e.g. "log_stiffness", "rest_angle_3": a log where the name says so
  std::vector<double> values, standard_errors;   // in the units of the name
  MatrixX covariance;
  std::vector<std::pair<std::string, std::string>> held;  // name -> why it was not fitted
};

}  // namespace chainsplat::dynamics
