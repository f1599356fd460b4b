#include "chainsplat/dynamics/parametrization.h"

#include <algorithm>
#include <cmath>

namespace chainsplat::dynamics {
namespace {

enum class Per { rope, joint, link, angle };

// How a change acts on a number of the parameters.
enum class How {
  logarithm,  // of a factor; the logarithms of all unknowns that act on a number are added up first
  factor,     // the same, multiplied on its own: it acts within a joint, where the others act from joint to joint
  addition,
  tip_logit,  // on the logit of the tip's part of the total mass
  tip_length  // a logarithm, of the one number that is no array
};

struct Array {
  std::vector<double> Parameters::*values = nullptr;
  std::vector<double> Tangent::*slopes = nullptr;
};
constexpr Array kLinkMass{&Parameters::link_mass, &Tangent::link_mass},
    kViscous{&Parameters::viscous_friction, &Tangent::viscous_friction},
    kCoulomb{&Parameters::coulomb_friction, &Tangent::coulomb_friction},
    kAirLinear{&Parameters::air_linear, &Tangent::air_linear},
    kAirQuadratic{&Parameters::air_quadratic, &Tangent::air_quadratic},
    kStiffness{&Parameters::stiffness, &Tangent::stiffness}, kRestAngle{&Parameters::rest_angle, &Tangent::rest_angle},
    kDamping{&Parameters::damping, &Tangent::damping}, kRollLever{&Parameters::roll_lever, &Tangent::roll_lever},
    kBendingFriction{&Parameters::bending_friction, &Tangent::bending_friction},
    kTorsionalStiffness{&Parameters::torsional_stiffness, &Tangent::torsional_stiffness},
    kBendingFrictionAngle{&Parameters::bending_friction_angle, &Tangent::bending_friction_angle};

// Which elements of its arrays unknown `index` of a quantity acts on.
bool every(const chain::Chain&, int, int) { return true; }
bool own(const chain::Chain&, int index, int element) { return element == index; }
bool of_joint(const chain::Chain& chain, int index, int angle) { return chain.child_link[angle] == index + 1; }
bool second(const chain::Chain& chain, int, int angle) { return angle == 1 && chain.child_link[1] == 1; }
bool twists(const chain::Chain& chain, int, int angle) { return chain::is_twist(chain, angle); }

struct Row {
  Quantity quantity = Quantity::none;
  const char *name = "", *unit = "";
  double scale = 1.0;
  Per per = Per::rope;
  How how = How::addition;
  Array arrays[2] = {};
  bool (*acts)(const chain::Chain& chain, int index, int element) = own;
  VectorX InitialState::*state = nullptr;  // instead of arrays
  VectorX Tangent::*state_slope = nullptr;
};

// clang-format off
const Row kRows[] = {
    {Quantity::none, "", "", 1.0, Per::rope},
    {Quantity::stiffness, "log_stiffness", "log(N m/rad)", 1.0, Per::rope, How::logarithm,
     {kStiffness, kTorsionalStiffness}, every},
    {Quantity::grasp_stiffness, "log_grasp_stiffness_ratio", "log", 1.0, Per::rope, How::factor, {kStiffness}, second},
    {Quantity::twist_stiffness, "log_twist_stiffness_ratio", "log", 1.0, Per::rope, How::logarithm, {kStiffness}, twists},
    {Quantity::damping, "log_damping", "log(N m s/rad)", 1.0, Per::rope, How::logarithm, {kDamping}, every},
    {Quantity::joint_stiffness, "log_stiffness_joint", "log", 1.0, Per::joint, How::logarithm, {kStiffness}, of_joint},
    {Quantity::joint_damping, "log_damping_joint", "log", 1.0, Per::joint, How::logarithm, {kDamping}, of_joint},
    {Quantity::link_mass, "log_mass_link", "log", 1.0, Per::link, How::logarithm, {kLinkMass}},
    {Quantity::coulomb_friction, "log_coulomb_friction_link", "log", 1.0, Per::link, How::logarithm, {kCoulomb}},
    {Quantity::viscous_friction, "log_viscous_friction_link", "log(N s/m)", 1.0, Per::link, How::logarithm, {kViscous}},
    {Quantity::friction, "log_friction", "log", 1.0, Per::rope, How::logarithm, {kViscous, kCoulomb}, every},
    {Quantity::drag, "log_drag", "log(N s^2/m^3)", 1.0, Per::rope, How::logarithm, {kAirLinear, kAirQuadratic}, every},
    {Quantity::tip_mass, "logit_tip_mass_fraction", "logit", 1.0, Per::rope, How::tip_logit},
    {Quantity::tip_length, "log_tip_length", "log(m)", 1.0, Per::rope, How::tip_length},
    {Quantity::rest_angle, "rest_angle", "rad", 0.2, Per::angle, How::addition, {kRestAngle}},
    {Quantity::roll_lever, "roll_lever", "m", 0.01, Per::angle, How::addition, {kRollLever}},
    {Quantity::bending_friction, "log_bending_friction", "log(N m)", 1.0, Per::rope, How::logarithm, {kBendingFriction}, every},
    {Quantity::bending_friction_angle, "log_bending_friction_angle", "log(rad)", 1.0, Per::rope, How::logarithm,
     {kBendingFrictionAngle}, every},
    {Quantity::torsional_stiffness, "log_torsional_stiffness_ratio", "log", 1.0, Per::rope, How::logarithm,
     {kTorsionalStiffness}, every},
    {Quantity::theta, "theta", "rad", 0.2, Per::angle, How::addition, {}, own, &InitialState::theta, &Tangent::theta},
    {Quantity::thetadot, "thetadot", "rad/s", 1.0, Per::angle, How::addition, {}, own, &InitialState::thetadot,
     &Tangent::thetadot},
    {Quantity::friction_state, "friction_state", "1", 0.3, Per::angle, How::addition, {}, own,
     &InitialState::internal_state, &Tangent::internal_state},
};
// clang-format on

const Row& row_of(Quantity quantity) {
  const auto at = static_cast<std::size_t>(quantity);
  CHAINSPLAT_CHECK(at < std::size(kRows) && kRows[at].quantity == quantity, std::to_string(at));
  return kRows[at];
}

int count_of(const chain::Chain& chain, Per per) {
  return per == Per::rope ? 1 : per == Per::angle ? chain.angles() : chain.links() - 1;
}

// Calls use(array, element) for every number that an unknown acts on.
template <class Use>
void for_each_element(const chain::Chain& chain, const Parameters& parameters, const Unknown& unknown, const Use& use) {
  const Row& row = row_of(unknown.quantity);
  for (const Array& array : row.arrays)
    if (array.values)
      for (std::size_t k = 0; k < (parameters.*array.values).size(); ++k)
        if (row.acts(chain, unknown.index, static_cast<int>(k))) use(array, k);
}

bool acts_on(Quantity quantity, const Array& array) { return row_of(quantity).arrays[0].values == array.values; }

double& element(Tangent& tangent, const Array& array, const Parameters& parameters, std::size_t k) {
  std::vector<double>& slopes = tangent.*array.slopes;
  if (slopes.empty()) slopes.assign((parameters.*array.values).size(), 0.0);
  return slopes[k];
}

}  // namespace

std::string name_of(const Unknown& unknown) {
  const Row& row = row_of(unknown.quantity);
  const bool numbered = row.per != Per::rope && unknown.index != kEvery;
  return numbered ? std::string(row.name) + "_" + std::to_string(unknown.index + 1) : row.name;
}

std::optional<Unknown> unknown_named(const std::string& name) {
  constexpr std::size_t kMostDigits = 6;
  const std::size_t letters = name.find_last_not_of("0123456789");
  if (letters == std::string::npos) return {};
  const bool numbered = name[letters] == '_' && letters + 1 < name.size() && name.size() <= letters + 1 + kMostDigits;
  for (const Row& row : kRows) {
    if (row.quantity == Quantity::none) continue;
    if (name == row.name) return Unknown{row.quantity, row.per == Per::rope ? 0 : kEvery};
    if (!numbered || row.per == Per::rope || name.compare(0, letters, row.name) != 0) continue;
    if (const int index = std::stoi(name.substr(letters + 1)) - 1; index >= 0) return Unknown{row.quantity, index};
  }
  return {};
}

std::vector<Unknown> unknowns_of(const chain::Chain& chain, const Estimates& estimates) {
  std::vector<Unknown> out;
  for (const std::string& name : estimates.names) {
    const std::optional<Unknown> found = unknown_named(name);
    const bool known = found && found->index >= 0 && found->index < count_of(chain, row_of(found->quantity).per);
    out.push_back(known ? *found : Unknown{});
  }
  return out;
}

const char* unit_of(Quantity quantity) { return row_of(quantity).unit; }
double scale_of(Quantity quantity) { return row_of(quantity).scale; }
bool is_parameter(Quantity quantity) { return quantity != Quantity::none && !row_of(quantity).state; }

bool has_effect(const chain::Chain& chain, const Parameters& parameters, const Unknown& unknown) {
  const How how = row_of(unknown.quantity).how;
  bool effect =
      parameters.tip_mass > 0.0 && (how == How::tip_logit || (how == How::tip_length && parameters.tip_length > 0.0));
  for_each_element(chain, parameters, unknown, [&](const Array& array, std::size_t k) {
    effect |= how == How::addition || (parameters.*array.values)[k] != 0.0;
  });
  return effect;
}

std::vector<Eigen::Index> parameters_among(std::span<const Unknown> unknowns) {
  std::vector<Eigen::Index> out;
  for (std::size_t i = 0; i < unknowns.size(); ++i)
    if (is_parameter(unknowns[i].quantity)) out.push_back(static_cast<Eigen::Index>(i));
  return out;
}

std::vector<Unknown> initial_state_unknowns(const chain::Chain& chain) {
  std::vector<Unknown> out;
  for (const Quantity quantity : {Quantity::theta, Quantity::thetadot})
    for (int k = 0; k < chain.angles(); ++k) out.push_back({quantity, k});
  return out;
}

Parameters moved(const chain::Chain& chain, const Parameters& reference, std::span<const Unknown> unknowns,
                 const VectorX& change, std::optional<double> total_mass) {
  CHAINSPLAT_CHECK(change.size() == static_cast<Eigen::Index>(unknowns.size()), std::to_string(unknowns.size()));
  Parameters p = reference;
  const double mass = total_mass ? *total_mass : dynamics::total_mass(reference);
  bool masses = total_mass.has_value();  // do they change?
  Tangent logarithms;                    // of the factors, summed
  for (std::size_t i = 0; i < unknowns.size(); ++i) {
    const Quantity quantity = unknowns[i].quantity;
    const double by = change[static_cast<Eigen::Index>(i)];
    const How how = row_of(quantity).how;
    masses |= how == How::tip_logit || acts_on(quantity, kLinkMass);
    if (how == How::tip_logit && p.tip_mass > 0.0 && p.tip_mass < mass)
      p.tip_mass = mass / (1.0 + std::exp(-(std::log(p.tip_mass / (mass - p.tip_mass)) + by)));
    if (how == How::tip_length) p.tip_length *= std::exp(by);
    for_each_element(chain, reference, unknowns[i], [&](const Array& array, std::size_t k) {
      if (how == How::logarithm)
        element(logarithms, array, reference, k) += by;
      else if (how == How::factor)
        (p.*array.values)[k] *= std::exp(by);
      else
        (p.*array.values)[k] += by;
    });
  }
  for (const Row& row : kRows)
    for (const Array& array : row.arrays) {
      if (!array.values) continue;
      std::vector<double>& sums = logarithms.*array.slopes;
      for (std::size_t k = 0; k < sums.size(); ++k) (p.*array.values)[k] *= std::exp(sums[k]);
      sums.clear();
    }
  if (!masses) return p;
  double sum = 0.0;
  for (double m : p.link_mass) sum += m;
  const double scale = (mass - p.tip_mass) / sum;
  for (double& m : p.link_mass) m *= scale;
  return p;
}

InitialState moved(const InitialState& reference, std::span<const Unknown> unknowns, const VectorX& change) {
  InitialState out = reference;
  for (std::size_t i = 0; i < unknowns.size(); ++i)
    if (const auto state = row_of(unknowns[i].quantity).state) {
      if ((out.*state).size() == 0) out.*state = VectorX::Zero(reference.theta.size());
      (out.*state)[unknowns[i].index] += change[static_cast<Eigen::Index>(i)];
    }
  return out;
}

std::vector<Tangent> tangents(const chain::Chain& chain, const Parameters& p, std::span<const Unknown> unknowns,
                              std::optional<double> total_mass) {
  const double mass = total_mass ? *total_mass : dynamics::total_mass(p), of_links = mass - p.tip_mass;
  std::vector<Tangent> out(unknowns.size());
  for (std::size_t i = 0; i < unknowns.size(); ++i) {
    const Row& row = row_of(unknowns[i].quantity);
    Tangent& d = out[i];
    for_each_element(chain, p, unknowns[i], [&](const Array& array, std::size_t k) {
      const double slope = row.how == How::addition ? 1.0 : (p.*array.values)[k];
      if (slope != 0.0) element(d, array, p, k) = slope;
    });
    if (row.state) d.*row.state_slope = VectorX::Unit(chain.angles(), unknowns[i].index);
    if (row.how == How::tip_length) d.tip_length = p.tip_length;
    if (row.how == How::tip_logit) d.tip_mass = p.tip_mass * of_links / mass;
    // what a link or the tip gets, all links give in proportion to their masses
    double gained = d.tip_mass;
    for (double m : d.link_mass) gained += m;
    if (gained == 0.0) continue;
    for (std::size_t j = 0; j < p.link_mass.size(); ++j)
      element(d, kLinkMass, p, j) += p.link_mass[j] * (-gained / of_links);
  }
  return out;
}

}  // namespace chainsplat::dynamics
