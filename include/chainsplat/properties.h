// chainsplat/properties.h - what people know a rope by: bending stiffness, damping ratio, mass per meter
// (mathematics.md 5.11), from the numbers of its joints and links.
#pragma once
#include <string>
#include <vector>

#include "chainsplat/dynamics.h"

namespace chainsplat::twin {

struct Property {
  std::string name, unit;  // "bending_stiffness", "N m^2"
  double value = 0.0;
  double sigma = 0.0;  // standard deviation by the estimates' covariance and, of a friction coefficient, by how much
                       // the links' own differ; NaN where that is not known
};

// Of a rope; those that it does not have are left out: damping ratio and first frequency of ropes on a table, a
// friction coefficient in free space. `known_mass`: else stiffnesses, moments and masses are per kilogram of rope.
std::vector<Property> properties(const dynamics::Model& model, const dynamics::Estimates& estimates, bool known_mass);
// A line each, as programs print them: value and standard deviation, or "(held)" where it was given and not estimated.
std::string describe(const std::vector<Property>& properties);

}  // namespace chainsplat::twin
