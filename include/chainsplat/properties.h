// chainsplat/properties.h - what people know a rope by: bending stiffness, damping ratio, mass per meter
// (mathematics.md 5.11), from the numbers of its joints and links.
#pragma once
#include <string>
#include <vector>

namespace chainsplat::twin {

struct Twin;

struct Property {
  std::string name, unit;  // "bending_stiffness", "N m^2"
  double value = 0.0;
  // Standard deviation by the estimates' covariance; of a friction coefficient also by how much the links' own differ,
  // of the mass per length also by what is not known of a length that was corrected. NaN where that is not known.
  double sigma = 0.0;
};

// Of a rope that has parameters; those that it does not have are left out: damping ratio and first frequency of ropes
// on a table, a friction coefficient in free space. Without a known mass stiffnesses, moments and masses are per
// kilogram of rope. Throws InputError where the parameters are no rope's.
std::vector<Property> properties(const Twin& twin);
// A line each, as programs print them: value and standard deviation, or "(held)" where it was given and not estimated.
std::string describe(const std::vector<Property>& properties);

}  // namespace chainsplat::twin
