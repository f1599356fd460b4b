// What the names of estimated numbers mean for the parameters.
#include <algorithm>
#include <cmath>

#include "chainsplat/dynamics.h"

namespace chainsplat::dynamics {
namespace {

// The number at the end of "name_12", from 0; -1 where the name has none.
int index_of(const std::string& name, const std::string& stem) {
  if (name.size() <= stem.size() + 1 || name.compare(0, stem.size(), stem) != 0 || name[stem.size()] != '_') return -1;
  const std::string digits = name.substr(stem.size() + 1);
  if (digits.size() > 6 || !std::all_of(digits.begin(), digits.end(), [](char c) { return c >= '0' && c <= '9'; }))
    return -1;
  return std::stoi(digits) - 1;
}

double sum(const std::vector<double>& values) {
  double out = 0.0;
  for (double v : values) out += v;
  return out;
}

}  // namespace

Parameters moved(const chain::Chain& chain, const Parameters& parameters, std::span<const std::string> names,
                 const VectorX& change) {
  CHAINSPLAT_CHECK(change.size() == static_cast<Eigen::Index>(names.size()), std::to_string(names.size()));
  Parameters p = parameters;
  const int links = chain.links() - 1;
  const double mass = sum(p.link_mass) + p.tip_mass;
  for (std::size_t i = 0; i < names.size(); ++i) {
    const std::string& name = names[i];
    const double by = change[static_cast<Eigen::Index>(i)], factor = std::exp(by);
    const auto joints = [&](std::vector<double>& values, int joint) {
      for (int k = 0; k < chain.angles(); ++k)
        if (joint < 0 || chain.child_link[k] == joint + 1) values[k] *= factor;
    };
    const auto link = [&](std::vector<double>& values, const char* stem) {
      const int j = index_of(name, stem);
      if (j >= 0 && j < links) values[j] *= factor;
    };
    if (name == "log_stiffness") joints(p.stiffness, -1);
    if (name == "log_damping") joints(p.damping, -1);
    if (name == "log_grasp_stiffness_ratio" && chain.angles() > 1) p.stiffness[1] *= factor;
    if (name == "log_twist_stiffness_ratio")
      for (int k = 0; k < chain.angles(); ++k)
        if (std::abs(chain.axes[k].head<3>().dot(chain.direction)) > 0.5) p.stiffness[k] *= factor;
    if (const int j = index_of(name, "log_stiffness_joint"); j >= 0) joints(p.stiffness, j);
    if (const int j = index_of(name, "log_damping_joint"); j >= 0) joints(p.damping, j);
    link(p.link_mass, "log_mass_link");
    link(p.coulomb_friction, "log_coulomb_friction_link");
    link(p.viscous_friction, "log_viscous_friction_link");
    if (name == "log_drag")
      for (double& c : p.air_quadratic) c *= factor;
    if (name == "logit_tip_mass_fraction" && p.tip_mass > 0.0 && p.tip_mass < mass) {
      const double odds = p.tip_mass / (mass - p.tip_mass) * factor;
      p.tip_mass = mass * odds / (1.0 + odds);
    }
    if (const int k = index_of(name, "rest_angle"); k >= 0 && k < chain.angles()) p.rest_angle[k] += by;
    if (const int k = index_of(name, "roll_lever"); k >= 0 && k < static_cast<int>(p.roll_lever.size()))
      p.roll_lever[k] += by;
  }
  // the total mass is held
  const double scale = (mass - p.tip_mass) / sum(p.link_mass);
  for (double& m : p.link_mass) m *= scale;
  return p;
}

std::vector<Tangent> tangents(const chain::Chain& chain, const Parameters& parameters,
                              std::span<const std::string> names) {
  constexpr double kStep = 1e-5;  // of a log or an angle: central differences, exact to 1e-10
  const auto size = static_cast<Eigen::Index>(names.size());
  const int n = chain.angles();
  std::vector<Tangent> out(names.size());
  for (Eigen::Index i = 0; i < size; ++i) {
    Tangent& d = out[i];
    const Parameters up = moved(chain, parameters, names, kStep * VectorX::Unit(size, i)),
                     down = moved(chain, parameters, names, -kStep * VectorX::Unit(size, i));
    const auto slope = [&](std::vector<double>& to, const std::vector<double>& a, const std::vector<double>& b) {
      if (a == b) return;
      for (std::size_t k = 0; k < a.size(); ++k) to.push_back((a[k] - b[k]) / (2.0 * kStep));
    };
    slope(d.link_mass, up.link_mass, down.link_mass);
    slope(d.viscous_friction, up.viscous_friction, down.viscous_friction);
    slope(d.coulomb_friction, up.coulomb_friction, down.coulomb_friction);
    slope(d.air_linear, up.air_linear, down.air_linear);
    slope(d.air_quadratic, up.air_quadratic, down.air_quadratic);
    slope(d.stiffness, up.stiffness, down.stiffness);
    slope(d.rest_angle, up.rest_angle, down.rest_angle);
    slope(d.damping, up.damping, down.damping);
    slope(d.roll_lever, up.roll_lever, down.roll_lever);
    d.tip_mass = (up.tip_mass - down.tip_mass) / (2.0 * kStep);
    if (const int k = index_of(names[i], "theta"); k >= 0 && k < n) d.theta = VectorX::Unit(n, k);
    if (const int k = index_of(names[i], "thetadot"); k >= 0 && k < n) d.thetadot = VectorX::Unit(n, k);
  }
  return out;
}

bool is_parameter(const Tangent& d) {
  for (const auto* values : {&d.link_mass, &d.viscous_friction, &d.coulomb_friction, &d.air_linear, &d.air_quadratic,
                             &d.stiffness, &d.rest_angle, &d.damping, &d.roll_lever})
    if (!values->empty()) return true;
  return d.tip_mass != 0.0;
}

}  // namespace chainsplat::dynamics
