// parts.h - what several formats take from a twin.
#pragma once
#include <array>
#include <string>
#include <vector>

#include "chainsplat/chain.h"
#include "chainsplat/dynamics.h"
#include "chainsplat/splat.h"
#include "chainsplat/twin.h"

namespace chainsplat::exports {

// Poses of all link frames (mathematics.md 2.2) at one time, each in its parent's frame; of link 0 in the world.
std::vector<math::Pose> local_poses(const chain::Chain& chain, const math::VectorX& theta, const math::VectorX& roll,
                                    const math::Pose& base);
// Of the k-th of some states.
std::vector<math::Pose> local_poses(const chain::Chain& chain, const chain::States& states, std::size_t k,
                                    const math::Pose& base);

constexpr double kLeastInertia = 1e-14;  // kg m^2; MuJoCo refuses less than 1e-15

// Mass, center of mass and inertia about it, of a link with the tip's mass where it is the last. Link frame, its axes
// those of the base frame at home. Links without thickness, as the paper has them, have the least inertia about
// themselves.
struct Inertia {
  double mass = 0.0;                             // kg
  math::Vector3 center = math::Vector3::Zero();  // m
  math::Matrix3 about = math::Matrix3::Zero();   // kg m^2
};
Inertia inertia_of(const chain::Chain& chain, const dynamics::Parameters& p, int link);  // link 1..

// Of a point of this mass at `arm` from where it is taken about.
math::Matrix3 point_inertia(double mass, const math::Vector3& arm);

// Without what a table carries, m/s^2, world.
math::Vector3 gravity_felt(const dynamics::Parameters& p);

// The mean color of a link's Gaussians, weighted by opacity, RGBA in 0..1 with three digits; gray without any.
std::array<double, 4> color_of_link(const splat::Gaussians& g, int link);

double linear_from_srgb(double value);  // of a color, both in 0..1

// For a comment at a file's head, without its full stop: the rope's name, escaped for XML, and the units.
std::string what_it_is(const twin::Twin& twin);

}  // namespace chainsplat::exports
