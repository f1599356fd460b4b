// identified.cpp - what identification found, in the units that people know, with first-order errors.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <map>
#include <numbers>

#include "chainsplat/dynamics/parametrization.h"
#include "chainsplat/properties.h"
#include "chainsplat/report.h"

namespace chainsplat::report {

using dynamics::Parameters;
using math::MatrixX;
using math::VectorX;

namespace {

constexpr double kAirDensity = 1.2;  // kg/m^3, at 20 degrees C; only tells the drag as a coefficient

std::string text(const char* format, double first, double second) {
  char out[160];
  std::snprintf(out, sizeof out, format, first, second);
  return out;
}

// One standard deviation of sum slope * estimate over the named estimates; none where one of them is not known.
std::optional<double> deviation(const dynamics::Estimates& e, const std::map<std::string, double>& slopes) {
  VectorX g = VectorX::Zero(static_cast<Eigen::Index>(e.names.size()));
  bool any = false;
  for (std::size_t i = 0; i < e.names.size(); ++i)
    if (const auto at = slopes.find(e.names[i]); at != slopes.end()) {
      g[static_cast<Eigen::Index>(i)] = at->second;
      any = true;
    }
  if (!any || e.covariance.rows() != g.size()) return {};
  double sum = 0.0;  // unknown entries of the covariance are NaN, and count where they have a slope only
  for (Eigen::Index i = 0; i < g.size(); ++i)
    for (Eigen::Index j = 0; j < g.size(); ++j)
      if (g[i] != 0.0 && g[j] != 0.0) sum += g[i] * e.covariance(i, j) * g[j];
  if (!(sum >= 0.0)) return {};
  return std::sqrt(sum);
}

std::optional<double> times(double factor, std::optional<double> error) {
  return error ? std::optional<double>(std::abs(factor) * *error) : std::nullopt;
}

std::optional<double> estimate(const dynamics::Estimates& e, const std::string& name) {
  const auto at = std::find(e.names.begin(), e.names.end(), name);
  return at == e.names.end() ? std::nullopt : std::optional<double>(e.values[at - e.names.begin()]);
}

const twin::Property* property(const std::vector<twin::Property>& properties, const char* name) {
  for (const twin::Property& each : properties)
    if (each.name == name) return &each;
  return nullptr;
}

std::optional<double> error_of(const twin::Property& property) {
  return std::isfinite(property.sigma) ? std::optional<double>(property.sigma) : std::nullopt;
}

void add_masses(const twin::Twin& twin, std::vector<Quantity>& out) {
  const Parameters& p = *twin.parameters;
  const double total = dynamics::total_mass(p), fraction = p.tip_mass / total;
  const char* const of = twin.known_mass ? "as given" : "not known: counts as 1 kg";
  out.push_back({"mass", "kg", of, total, {}});
  out.push_back({"mass per length", "kg/m", "without the tip's", (total - p.tip_mass) / twin.chain.length, {}});
  if (p.tip_mass > 0.0)
    out.push_back(
        {"extra mass at the tip", "kg", text("%.1f %% of all", 100.0 * fraction, 0.0), p.tip_mass,
         times(total * fraction * (1.0 - fraction), deviation(twin.estimates, {{"logit_tip_mass_fraction", 1.0}}))});
  if (p.tip_length > 0.0)
    out.push_back({"which reaches beyond the rope by",
                   "m",
                   {},
                   p.tip_length,
                   times(p.tip_length, deviation(twin.estimates, {{"log_tip_length", 1.0}}))});
}

void add_bending(const twin::Twin& twin, const std::vector<twin::Property>& properties, std::vector<Quantity>& out) {
  const chain::Chain& chain = twin.chain;
  const Parameters& p = *twin.parameters;
  const dynamics::Estimates& e = twin.estimates;
  const auto stiffness = estimate(e, "log_stiffness"), damping = estimate(e, "log_damping");
  if (const twin::Property* bending = property(properties, "bending_stiffness"); bending && stiffness)
    out.push_back({"bending stiffness EI", "N m\u00b2", "mean of the joints", bending->value, error_of(*bending)});
  if (stiffness && damping) {
    const double retardation = std::exp(*damping - *stiffness);
    out.push_back({"retardation time", "s", "damping over stiffness", retardation,
                   times(retardation, deviation(e, {{"log_damping", 1.0}, {"log_stiffness", -1.0}}))});
  }
  double square = 0.0;
  for (int k = 0; k < chain.angles(); ++k) square += p.rest_angle[k] * p.rest_angle[k];
  if (square > 0.0) {
    constexpr double kDegrees = 180.0 / std::numbers::pi;
    std::map<std::string, double> slopes;
    const double rms = std::sqrt(square / chain.angles());
    for (int k = 0; k < chain.angles(); ++k)
      slopes["rest_angle_" + std::to_string(k + 1)] = p.rest_angle[k] / (chain.angles() * rms);
    out.push_back({"natural bend of a joint", "deg", "RMS of the rest angles", kDegrees * rms,
                   times(kDegrees, deviation(e, slopes))});
  }
}

// Of the rope that hangs from a base at rest; none on a table, or where it hangs nowhere.
void add_swing(const std::vector<twin::Property>& properties, std::vector<Quantity>& out) {
  if (const twin::Property* frequency = property(properties, "first_frequency"))
    out.push_back(
        {"slowest swing", "Hz", "hanging from a base at rest, small", frequency->value, error_of(*frequency)});
  if (const twin::Property* ratio = property(properties, "damping_ratio"))
    out.push_back({"its damping ratio", "", "without drag, which is quadratic", ratio->value, error_of(*ratio)});
}

void add_resistance(const twin::Twin& twin, std::vector<Quantity>& out) {
  const chain::Chain& chain = twin.chain;
  const Parameters& p = *twin.parameters;
  double quadratic = 0.0, weight = 0.0, friction = 0.0, low = INFINITY, high = 0.0;
  for (std::size_t j = 0; j < p.link_mass.size(); ++j) {
    quadratic += p.air_quadratic[j];
    weight += p.link_mass[j];
    friction += p.link_mass[j] * p.coulomb_friction[j];
    low = std::min(low, p.coulomb_friction[j]), high = std::max(high, p.coulomb_friction[j]);
  }
  if (!twin.tabletop && quadratic > 0.0) {
    const double drag = quadratic / (chain.length - chain.link_start(1));
    const auto relative = deviation(twin.estimates, {{"log_drag", 1.0}});
    out.push_back({"air drag", "N s\u00b2/m\u00b3", "quadratic, per meter", drag, times(drag, relative)});
    const double coefficient = 2.0 * drag / (kAirDensity * chain.diameter);
    out.push_back({"drag coefficient", "", "for air of 1.2 kg/m\u00b3", coefficient, times(coefficient, relative)});
  }
  if (twin.tabletop && friction > 0.0) {
    std::map<std::string, double> slopes;
    for (std::size_t j = 0; j < p.link_mass.size(); ++j)
      slopes["log_coulomb_friction_link_" + std::to_string(j + 1)] = p.link_mass[j] * p.coulomb_friction[j] / weight;
    out.push_back({"friction coefficient", "", text("mean; %.2g to %.2g from link to link", low, high),
                   friction / weight, deviation(twin.estimates, slopes)});
  }
}

}  // namespace

std::vector<Quantity> identified(const twin::Twin& twin) {
  std::vector<Quantity> out;
  if (!twin.parameters) return out;
  const std::vector<twin::Property> properties = twin::properties(twin);
  add_masses(twin, out);
  add_bending(twin, properties, out);
  add_swing(properties, out);
  add_resistance(twin, out);
  return out;
}

std::vector<VectorX> rollout_deviations(const twin::Twin& twin, const trajectory::Trajectory& base) {
  const dynamics::Estimates& e = twin.estimates;
  if (!twin.parameters || !twin.initial || twin.rollout.time.empty() || !e.covariance.allFinite() ||
      e.covariance.rows() == 0 || twin.parameters->integrator != dynamics::Integrator::rodas3 ||
      twin.rollout.time.front() < twin.initial->time)
    return {};
  // derivatives of all frames' angles; 16 joints of two axes reach it after three minutes at 60 Hz
  constexpr std::int64_t kMostSlopes = std::int64_t{1} << 26;
  if (e.covariance.rows() * twin.chain.angles() * static_cast<std::int64_t>(twin.rollout.time.size()) > kMostSlopes) {
    core::say_more("report: of so many angles over so long a time the rollout has no band");
    return {};
  }
  const dynamics::Model model = dynamics::make_model(twin.chain, *twin.parameters);
  const std::vector<dynamics::Unknown> unknowns = dynamics::unknowns_of(twin.chain, e);
  const std::vector<dynamics::Tangent> tangents = dynamics::tangents(twin.chain, *twin.parameters, unknowns);
  const dynamics::BaseGrid grid = dynamics::sample_base([&](double t) { return base.at(t); }, twin.initial->time,
                                                        twin.rollout.time, twin.parameters->substeps);
  chain::States states;
  dynamics::Sensitivities slopes;
  if (!dynamics::simulate(model, grid, twin.initial->theta, twin.initial->thetadot, states, tangents, &slopes))
    return {};
  std::vector<VectorX> out;
  for (const MatrixX& slope : slopes.theta)
    out.push_back((slope * e.covariance * slope.transpose()).diagonal().cwiseMax(0.0).cwiseSqrt());
  return out;
}

}  // namespace chainsplat::report
