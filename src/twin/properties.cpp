#include "chainsplat/properties.h"

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <exception>
#include <limits>

#include "chainsplat/dynamics/parametrization.h"
#include "chainsplat/dynamics/rod.h"
#include "chainsplat/text.h"
#include "chainsplat/twin.h"
#include "src/math/decompositions.h"

namespace chainsplat::twin {
namespace {

using math::MatrixX;
using math::VectorX;

// First mode about the shape in which the rope hangs from a base at rest; left out where it has none.
void add_first_mode(const dynamics::Model& model, const VectorX& hanging, std::vector<Property>& out) {
  dynamics::Linearization at;
  try {
    at = dynamics::linearize(model, dynamics::at_rest(math::Pose()), math::Vector6::Zero(), hanging,
                             VectorX::Zero(hanging.size()));
  } catch (const std::exception&) {  // a joint has no inertia
    return;
  }
  const MatrixX stiffness = 0.5 * (at.stiffness + at.stiffness.transpose());
  const Eigen::GeneralizedSelfAdjointEigenSolver<MatrixX> modes(stiffness, at.mass);
  const double square = modes.eigenvalues()[0];
  if (!(square > 0.0)) return;
  const VectorX shape = modes.eigenvectors().col(0);  // its modal mass is 1
  const double turn = std::sqrt(square);
  out.push_back({"damping_ratio", "1", shape.dot(at.damping * shape) / (2.0 * turn)});
  out.push_back({"first_frequency", "Hz", turn / (2.0 * M_PI)});
}

// The shape in which the rope hangs from a base at rest, found from `near` on; empty on a table, and where it hangs
// nowhere.
VectorX hanging_from(const dynamics::Model& model, const VectorX& near) {
  if (model.parameters.table_normal) return {};
  try {
    return dynamics::static_equilibrium(model, math::Pose(), near).theta;
  } catch (const std::exception&) {
    return {};
  }
}

// What is not known of the length, as a share of it; 0 where nothing was corrected and it is as given.
double relative_length_deviation(const Twin& twin) {
  const capture::Correction* const length = capture::find(twin.corrections, "object", "length");
  return length && capture::any_correction(twin.corrections) ? length->deviation[0] / twin.chain.length : 0.0;
}

// Each with the deviation that the estimates' covariance cannot know of, mostly 0. `relative_length`: that of the
// length. `near`: the shape at rest, of a rope that is much the same; empty: not known.
std::vector<Property> values(const dynamics::Model& model, bool known_mass, VectorX& near, double relative_length) {
  const dynamics::Parameters& p = model.parameters;
  const chain::Chain& chain = model.chain;
  const std::string per_mass = known_mass ? "" : "/kg";
  double bending = 0.0, twisting = 0.0, friction = 0.0, mass = 0.0, length = 0.0, held = 0.0;
  int bends = 0;
  const VectorX hanging = hanging_from(model, near);
  if (hanging.size() > 0) near = hanging;
  const double tension =
      hanging.size() == 0 ? 0.0 : dynamics::grasp_tension(p, dynamics::first_direction(chain, hanging, math::Pose()));
  for (int k = 0; k < chain.angles(); ++k) {
    if (chain::is_twist(chain, k)) continue;
    bending += dynamics::rod_stiffness(chain, chain.child_link[k], p.stiffness[k], tension);
    if (!p.bending_friction.empty()) friction += p.bending_friction[k];
    ++bends;
  }
  for (std::size_t j = 0; j < p.torsional_stiffness.size(); ++j)
    twisting += p.torsional_stiffness[j] * chain::bent_length(chain, static_cast<int>(j) + 1);
  for (std::size_t j = 0; j < p.link_mass.size(); ++j) {
    const int link = static_cast<int>(j) + 1;
    mass += p.link_mass[j], length += chain.link_end(link) - chain.link_start(link);
    held += p.link_mass[j] * p.coulomb_friction[j];
  }
  std::vector<Property> out;
  out.push_back({"bending_stiffness", "N m^2" + per_mass, bending / bends});
  if (!p.torsional_stiffness.empty())
    out.push_back(
        {"torsional_stiffness", "N m^2" + per_mass, twisting / static_cast<double>(p.torsional_stiffness.size())});
  if (!p.bending_friction.empty()) out.push_back({"bending_friction", "N m" + per_mass, friction / bends});
  if (hanging.size() > 0) add_first_mode(model, hanging, out);
  out.push_back({"mass_per_length", known_mass ? "kg/m" : "1/m", mass / length, relative_length * mass / length});
  if (p.table_normal) {
    // one coefficient belongs to the two materials: what the links' differ by is error
    const double mean = held / mass;
    double square = 0.0;
    for (std::size_t j = 0; j < p.link_mass.size(); ++j)
      square += p.link_mass[j] * std::pow(p.coulomb_friction[j] - mean, 2);
    out.push_back({"friction_coefficient", "1", mean, std::sqrt(square / mass)});
  }
  out.push_back({"tip_mass", known_mass ? "kg" : "1", p.tip_mass});
  if (p.tip_length > 0.0) out.push_back({"tip_length", "m", p.tip_length});
  return out;
}

}  // namespace

std::vector<Property> properties(const Twin& twin) {
  const dynamics::Model model = dynamics::make_model(twin.chain, *twin.parameters);
  const dynamics::Estimates& estimates = twin.estimates;
  VectorX near;
  std::vector<Property> out = values(model, twin.known_mass, near, relative_length_deviation(twin));
  const std::vector<dynamics::Unknown> all = dynamics::unknowns_of(model.chain, estimates);
  const std::vector<Eigen::Index> known = dynamics::parameters_among(all);
  const bool told = estimates.covariance.rows() == static_cast<Eigen::Index>(all.size()) && !known.empty() &&
                    estimates.covariance(known, known).allFinite();
  if (!told) {
    for (Property& property : out) property.sigma = std::numeric_limits<double>::quiet_NaN();
    return out;
  }
  // by central differences; the initial state has no part in it
  constexpr double kStep = 1e-4;  // of a logarithm, in units of the quantity's scale
  MatrixX slopes(out.size(), known.size());
  for (std::size_t i = 0; i < known.size(); ++i) {
    const dynamics::Unknown& unknown = all[known[i]];
    const double step = kStep * dynamics::scale_of(unknown.quantity);
    const auto moved = [&](double by) {
      const dynamics::Parameters p =
          dynamics::moved(model.chain, model.parameters, {&unknown, 1}, VectorX::Constant(1, by));
      VectorX start = near;
      return values(dynamics::make_model(model.chain, p), twin.known_mass, start, 0.0);
    };
    const std::vector<Property> up = moved(step), down = moved(-step);
    for (std::size_t k = 0; k < out.size(); ++k)
      slopes(k, i) =
          up.size() == out.size() && down.size() == out.size() ? (up[k].value - down[k].value) / (2.0 * step) : 0.0;
  }
  const MatrixX covariance = slopes * estimates.covariance(known, known) * slopes.transpose();
  for (std::size_t k = 0; k < out.size(); ++k)
    out[k].sigma = std::hypot(out[k].sigma, std::sqrt(std::max(0.0, covariance.diagonal()[static_cast<int>(k)])));
  return out;
}

std::string describe(const std::vector<Property>& properties) {
  constexpr int kNames = 22, kNumbers = 26;  // columns
  constexpr double kRounding = 1e-9;         // relative: what is known so well was given, and no data tell of it
  std::string out;
  for (const Property& p : properties) {
    std::string line = p.name;
    line.append(std::max<int>(1, kNames - static_cast<int>(line.size())), ' ');
    line += p.sigma <= kRounding * std::abs(p.value) ? core::brief(p.value) + " (held)"
                                                     : core::with_error(p.value, p.sigma);
    if (p.unit != "1") {
      line.append(std::max<int>(1, kNames + kNumbers - static_cast<int>(line.size())), ' ');
      line += p.unit;
    }
    out += line + "\n";
  }
  return out;
}

}  // namespace chainsplat::twin
