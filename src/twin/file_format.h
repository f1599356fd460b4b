// src/twin/file_format.h - what the writer and the reader of twin.json share.
#pragma once
#include <array>
#include <cmath>
#include <limits>
#include <utility>

#include "chainsplat/dynamics.h"

namespace chainsplat::twin {

inline constexpr const char* kFormat = "chainsplat-twin/1";
// Of twins that a program of format 1 would set in motion wrongly: with friction in bending, torsion or a payload that
// is no point.
inline constexpr const char* kNewFormat = "chainsplat-twin/2";

inline const std::pair<dynamics::Integrator, const char*> kIntegrators[] = {
    {dynamics::Integrator::rodas3, "rodas3"},
    {dynamics::Integrator::implicit_velocity_euler, "implicit_velocity_euler"},
};

// The double nearest to `guess`, within a few units in the last place, for which `holds` is true, else `guess`. This
// undoes the rounding of a number that was stored as a difference or a quotient.
template <class Predicate>
double exact_near(double guess, Predicate holds) {
  constexpr int kReach = 4;  // units in the last place
  double low = guess, high = guess;
  if (holds(guess)) return guess;
  for (int i = 0; i < kReach; ++i) {
    low = std::nextafter(low, -std::numeric_limits<double>::infinity());
    high = std::nextafter(high, std::numeric_limits<double>::infinity());
    if (holds(low)) return low;
    if (holds(high)) return high;
  }
  return guess;
}

// Inertia of a cylinder along d about its center of mass (mathematics.md 3.1): xx yy zz xy xz yz.
inline std::array<double, 6> cylinder_inertia(double mass, double length, double radius, const math::Vector3& d) {
  const double across = mass * (length * length / 12.0 + 0.25 * radius * radius), along = 0.5 * mass * radius * radius;
  const math::Matrix3 i = across * (math::Matrix3::Identity() - d * d.transpose()) + along * d * d.transpose();
  return {i(0, 0), i(1, 1), i(2, 2), i(0, 1), i(0, 2), i(1, 2)};
}

}  // namespace chainsplat::twin
