// chainsplat/dynamics/rolling.h - how far a rope on a table rolls about its own axis (mathematics.md 3.14).
//
// Friction at the underside of a rope that is pushed sideways turns its material within the links; torsion, and what
// the rope is naturally bent out of the table's plane, turn it back. The motion of the links is given: rolling only
// says where their texture is. What it does to the motion is in Parameters::roll_lever.
#pragma once

#include "chainsplat/dynamics.h"

namespace chainsplat::dynamics {

// The roll along a motion of a planar chain on a table that starts without torsion, one time after the other. Steps of
// at most a sixtieth of a second, each the least of a potential.
class Roller {
 public:
  Roller(const Model& model, const Rolling& rolling);
  // rad, links() values, of the texture: what Rolling::texture leaves of the material's. Times increase; the first call
  // says where the motion starts.
  VectorX advance(double time, const math::Pose& base, const VectorX& theta);

 private:
  // Of the links, world: their middles, m, and the direction in which positive rolls move the underside.
  struct Place {
    double time = 0.0;
    VectorX theta;
    std::vector<Vector3> middle, side;
  };
  struct System;  // of the rates
  Place place_of(double time, const math::Pose& base, const VectorX& theta) const;
  double potential(const VectorX& rate, double step, System* system) const;
  void step(const Place& to, double from, double until);

  chain::Chain chain_;
  Parameters parameters_;
  VectorX texture_;
  double speed_;
  std::vector<double> friction_;                   // N per moving link
  std::vector<double> torsion_, torsion_damping_;  // N m/rad, N m s/rad per joint
  std::vector<double> set_;                        // rad per joint, out of the table's plane
  VectorX roll_, rate_;                            // of moving links, rad, rad/s
  std::optional<Place> last_;
  // of a step
  std::vector<Vector3> velocity_, side_;  // m/s, unit, per moving link
  VectorX bend_;                          // rad
};

// The same at all times of a motion: chain::States::roll.
std::vector<VectorX> rolls_along(const Model& model, const Rolling& rolling, const trajectory::Trajectory& base,
                                 const chain::States& states);

}  // namespace chainsplat::dynamics
