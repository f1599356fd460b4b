#include "unknowns.h"

#include <cmath>

#include "chainsplat/dynamics/rod.h"
#include "src/math/decompositions.h"

namespace chainsplat::identification {

using dynamics::Quantity;

namespace {

// Prior standard deviations; logs unless said otherwise.
constexpr double kSharedSd = 2.0;       // one stiffness, damping, drag: an order of magnitude either way
constexpr double kTipSd = 1.0;          // logit of the tip's part of the mass
constexpr double kJointSd = 0.5;        // stiffness and damping of one joint about the shared value
constexpr double kMassSd = 0.15;        // mass of one link about the mean
constexpr double kSmoothSd = 0.3;       // between neighbors, of those
constexpr double kGraspSd = 0.5;        // the second axis over the first, where the rope leaves the fingers
constexpr double kCoulombSd = 0.5;      // coefficient of the rope: 0.2 to 0.6 on most tables
constexpr double kLinkCoulombSd = 0.3;  // one link about that
constexpr double kHeldCoulombSd = 1.5;  // the same where the fingers lift the rope or press it on
constexpr double kHeldDiameters = 3.0;  // from the grasp
constexpr double kSameSd = 1e-4;        // of a link's own part where all links are to have one coefficient
constexpr double kTwistSd = 0.7;        // of all twist stiffnesses over the bending ones
// Torsional over bending stiffness: 1/(1 + Poisson's ratio) of a round rod of one material, with the ratio of most
// plastics and metals; strands that slide make it softer, a braided sheath stiffer.
constexpr double kPoissonRatio = 0.35;
constexpr double kTorsionSd = 0.5;
constexpr double kPaperMassSd = 0.3;  // mass of one link about the mean, [P]
constexpr double kViscousSd = 1.0;
constexpr double kRestSd = 0.3;  // rad
constexpr double kBendingFrictionSd = 1.5;
constexpr double kBendingFrictionAngleSd = 1.0;
constexpr double kFrictionStateSd = 0.5;  // of a share between -1 and 1
// Of an initial state that is all that is sought: the smoothest chain through a few markers, and its local slope.
constexpr double kInitialThetaSd = 0.1;  // rad
constexpr double kInitialRateSd = 1.0;   // rad/s
constexpr double kPayloadPart = 0.3;     // of the total mass: what grippers' ropes carry, 0.05 to 0.8 within two
constexpr double kPayloadSd = 1.1;       // deviations
constexpr double kLeastTipSd = 1e-3;     // logit, of a payload that was weighed
// How far a payload reaches beyond the free end: a cube of this density, between plastics and steel, and what longer
// and shorter things differ by. Where nothing has a known mass, a part of the rope's length instead.
constexpr double kPayloadDensity = 4000.0;  // kg/m^3
constexpr double kPayloadLengthSd = 0.7;
constexpr double kPayloadLengthPart = 0.1;
constexpr double kPayloadLengthPartSd = 1.0;

// Of the tip's part of the total mass; the deviation is that of its logit.
struct TipPrior {
  double part, deviation;
};

TipPrior tip_prior(const Options& options, const Extras& extras, double total_mass) {
  if (!options.tip_mass) return extras.payload ? TipPrior{kPayloadPart, kPayloadSd} : TipPrior{kTipPart, kTipSd};
  const double part = *options.tip_mass / total_mass;
  return {part, std::max(kLeastTipSd, options.tip_mass_deviation / (*options.tip_mass * (1.0 - part)))};
}

// A rope that bends in space twists where it is naturally bent. On a table it lies on its side.
bool twists_within_links(const chain::Chain& chain, const Options& options) {
  return options.fit_torsion && !options.tabletop && !chain::has_twist(chain) &&
         chain.angles() == 2 * (chain.links() - 1);
}

std::vector<double> all(int count, double value) { return std::vector<double>(count, value); }

// The unknowns in the making.
struct Draft {
  const chain::Chain& chain;
  const Options& options;
  Unknowns u = {};
  std::vector<double> means = {}, deviations = {};
  struct Smooth {  // neighbors are alike
    int first, count;
    double deviation;
  };
  std::vector<Smooth> smooth = {};
  int angles = chain.angles(), links = chain.links() - 1;
  double torque = 0.0;     // N m (or per kg), of the rope's weight at its length
  double reference = 0.0;  // mean_bent_length
  bool stiff = options.fit_stiffness && !options.paper;

  void hold(const char* name, const char* reason) { u.held.emplace_back(name, reason); }
  void add(Quantity quantity, int index, double mean, double deviation) {
    u.list.push_back({quantity, index});
    for (const Prior& prior : options.priors)
      if (prior.unknown == dynamics::Unknown{quantity, index} ||
          prior.unknown == dynamics::Unknown{quantity, dynamics::kEvery})
        mean = prior.mean, deviation = prior.deviation;
    means.push_back(mean), deviations.push_back(deviation);
  }
  void add_many(Quantity quantity, int count, double mean, double deviation, double smooth_deviation = 0.0) {
    if (smooth_deviation > 0.0) smooth.push_back({u.size(), count, smooth_deviation});
    for (int i = 0; i < count; ++i) add(quantity, i, mean, deviation);
  }
};

Draft begin(const chain::Chain& chain, const Options& options, const Start& start) {
  Draft d{chain, options};
  d.u.total_mass = options.mass.value_or(1.0);
  d.hold("total_mass", options.mass ? "given: only ratios to it are observable"
                                    : "set to 1 kg: only ratios to it are observable, forces are per kg");
  d.u.initial = {0.0, start.theta, start.thetadot};
  d.torque = d.u.total_mass * options.gravity.norm() * chain.length;
  d.reference = mean_bent_length(chain);

  dynamics::Parameters& unit = d.u.reference;
  unit.viscous_friction = unit.coulomb_friction = unit.air_linear = unit.air_quadratic = all(d.links, 0.0);
  unit.stiffness = unit.rest_angle = unit.damping = all(d.angles, 0.0);
  unit.radius = options.paper ? 0.0 : 0.5 * chain.diameter;
  unit.gravity = options.gravity;
  if (options.tabletop) unit.table_normal = options.table_normal.normalized();
  unit.integrator = options.paper ? dynamics::Integrator::implicit_velocity_euler : options.integrator;
  unit.substeps = options.paper ? 1 : options.substeps > 0 ? options.substeps : options.tabletop ? 8 : 4;
  for (int link = 1; link <= d.links; ++link) unit.link_mass.push_back(chain.link_end(link) - chain.link_start(link));
  // a joint is the softer the longer the piece of rope that it stands for
  for (int k = 0; k < d.angles; ++k)
    unit.damping[k] = options.paper ? 1.0 : d.reference / chain::bent_length(chain, chain.child_link[k]);
  return d;
}

// The joint at the grasp is that of the rod under tension.
void hold_as_rod(Draft& d, const Rod& rod) {
  const double prior = std::exp(d.means.back()) * d.reference;
  const double bending = rod.bending_stiffness > 0.0 ? rod.bending_stiffness : prior;
  const double slack = dynamics::rod_joint(d.chain, 1, bending, 0.0).stiffness;
  const dynamics::RodJoint taut = dynamics::rod_joint(d.chain, 1, bending, rod.tension);
  for (int k = 0; k < d.angles && d.chain.child_link[k] == 1; ++k) {
    if (chain::is_twist(d.chain, k)) continue;
    d.u.reference.stiffness[k] *= taut.stiffness / slack;
    d.u.reference.damping[k] *= taut.slope / slack;
  }
}

void add_stiffness(Draft& d, const Rod& rod) {
  dynamics::Parameters& unit = d.u.reference;
  if (!d.stiff) return d.hold("stiffness", d.options.paper ? "0, as in the paper" : "held at 0 on request");
  unit.stiffness = unit.damping;
  d.add(Quantity::stiffness, 0, std::log(kStiffnessPart * d.torque), kSharedSd);
  if (twists_within_links(d.chain, d.options))
    for (int k = 0; k < d.angles; k += 2) unit.torsional_stiffness.push_back(unit.stiffness[k]);
  hold_as_rod(d, rod);
  // two fingers hold a rope more stiffly one way than the other (a foam noodle in a gripper: 1.5)
  if (d.options.per_joint && d.angles > 1 && d.chain.child_link[1] == 1 && !chain::is_twist(d.chain, 1))
    d.add(Quantity::grasp_stiffness, 0, 0.0, kGraspSd);
  if (chain::has_twist(d.chain)) d.add(Quantity::twist_stiffness, 0, 0.0, kTwistSd);
  if (!unit.torsional_stiffness.empty())
    d.add(Quantity::torsional_stiffness, 0, -std::log(1.0 + kPoissonRatio), kTorsionSd);
}

// Damping of the usual size: a logarithm.
double usual_damping(const Draft& d) {
  return std::log((d.stiff ? kRetardation * kStiffnessPart : kDampingPart) * d.torque);
}

// What the paper fits: a damping and a mass per link, and on a table its viscous friction.
void add_as_in_paper(Draft& d) {
  d.add_many(Quantity::joint_damping, d.links, usual_damping(d), kViscousSd);
  d.add_many(Quantity::link_mass, d.links, 0.0, kPaperMassSd);
  if (d.options.tabletop) {
    d.u.reference.viscous_friction = all(d.links, 1.0);
    d.add_many(Quantity::viscous_friction, d.links, std::log(kViscousRate * d.u.total_mass / d.links), kViscousSd);
  }
  d.hold("tip_mass", "0, as in the paper");
  d.hold("rest_angle", "0, as in the paper");
  d.hold("initial_state", "the recognized one, as in the paper");
}

void add_damping_and_masses(Draft& d) {
  d.add(Quantity::damping, 0, usual_damping(d), kSharedSd);
  if (!d.options.per_joint) return d.hold("link_mass", "uniform along the rope");
  if (d.stiff) d.add_many(Quantity::joint_stiffness, d.links, 0.0, kJointSd, kSmoothSd);
  d.add_many(Quantity::joint_damping, d.links, 0.0, kJointSd, kSmoothSd);
  d.add_many(Quantity::link_mass, d.links, 0.0, kMassSd, kSmoothSd);
}

// The table's friction, or the air's drag and the tip's mass.
void add_surroundings(Draft& d, const Extras& extras) {
  const Options& options = d.options;
  dynamics::Parameters& unit = d.u.reference;
  if (options.tabletop) {
    unit.coulomb_friction = all(d.links, 1.0);
    d.add_many(Quantity::coulomb_friction, d.links, std::log(kCoulombMean), kCoulombSd);
    unit.tip_mass = options.tip_mass.value_or(0.0), unit.tip_length = options.tip_length.value_or(0.0);
    d.hold("tip_mass", options.tip_mass ? "given" : "0: not observable on a table beside the friction");
    d.hold("drag", "0 on a table");
    return;
  }
  unit.air_quadratic = unit.link_mass;  // by length, too
  d.add(Quantity::drag, 0, std::log(kDragPerDiameter * std::max(d.chain.diameter, 1e-3)), kSharedSd);
  if (options.tip_mass && *options.tip_mass == 0.0) return d.hold("tip_mass", "0: given");
  const TipPrior prior = tip_prior(options, extras, d.u.total_mass);
  unit.tip_mass = 0.5 * d.u.total_mass;  // where the logit is 0
  d.add(Quantity::tip_mass, 0, std::log(prior.part / (1.0 - prior.part)), prior.deviation);
  if (!options.tip_mass && !extras.payload) return d.hold("tip_length", "0: a rope's bare end");
  if (options.tip_length) {
    unit.tip_length = *options.tip_length;
    return d.hold("tip_length", "given");
  }
  unit.tip_length = 1.0;  // where the logarithm is 0
  if (options.mass)
    d.add(Quantity::tip_length, 0, std::log(prior.part * d.u.total_mass / kPayloadDensity) / 3.0, kPayloadLengthSd);
  else
    d.add(Quantity::tip_length, 0, std::log(kPayloadLengthPart * d.chain.length), kPayloadLengthPartSd);
}

void add_natural_shape(Draft& d) {
  if (!d.stiff) return d.hold("rest_angle", "has no effect without stiffness");
  d.add_many(Quantity::rest_angle, d.angles, 0.0, kRestSd);
  // a natural curvature out of the plane of kRestSd a joint, torsion as stiff as bending
  if (!d.options.tabletop || d.angles != d.links) return;
  d.u.reference.roll_lever = all(d.angles, 0.0);
  for (int k = d.chain.link_start(1) > 0.0 ? 0 : 1; k < d.angles; ++k)  // at the grasp nothing rolls
    d.add(Quantity::roll_lever, k, 0.0, kRestSd * 0.5 * d.chain.diameter * d.chain.length / d.reference);
}

void add_bending_friction(Draft& d, const Extras& extras) {
  if (!extras.friction)
    return d.hold("bending_friction",
                  d.options.tabletop ? "0: not told from the table's friction" : "0: the data do not ask for it");
  dynamics::Parameters& unit = d.u.reference;
  unit.bending_friction = all(d.angles, 1.0);
  for (int k = 0; k < d.angles; ++k)  // a curvature, alike all along
    unit.bending_friction_angle.push_back(chain::bent_length(d.chain, d.chain.child_link[k]) / d.reference);
  d.add(Quantity::bending_friction, 0, std::log(kBendingFrictionPart * d.torque), kBendingFrictionSd);
  d.add(Quantity::bending_friction_angle, 0, std::log(kBendingFrictionAngle), kBendingFrictionAngleSd);
}

void add_initial_state(Draft& d, const Start& start, const Extras& extras) {
  const int n = d.angles;
  d.u.initial = {0.0, VectorX::Zero(n), VectorX::Zero(n)};
  for (int k = 0; k < n; ++k) d.add(Quantity::theta, k, start.theta[k], start.theta_sd[k]);
  for (int k = 0; k < n; ++k) d.add(Quantity::thetadot, k, start.thetadot[k], start.rate_sd);
  if (extras.friction) d.add_many(Quantity::friction_state, n, 0.0, kFrictionStateSd);
}

// A rope that lies flat presses on the table with its weight: one coefficient, but where the fingers hold.
MatrixX table_friction_precision(const Draft& d, int first) {
  MatrixX covariance = MatrixX::Zero(d.links, d.links);
  const auto by_options = [&](int j) { return d.deviations[first + j] != kCoulombSd; };  // options.priors
  for (int i = 0; i < d.links; ++i) {
    const bool held = d.chain.link_start(i + 1) < kHeldDiameters * d.chain.diameter;
    const double own = !d.options.friction_per_link ? kSameSd : held ? kHeldCoulombSd : kLinkCoulombSd;
    covariance(i, i) = by_options(i) ? d.deviations[first + i] * d.deviations[first + i] : own * own;
    for (int j = 0; j < d.links; ++j)
      if (!by_options(i) && !by_options(j)) covariance(i, j) += kCoulombSd * kCoulombSd;
  }
  const Eigen::LDLT<MatrixX> factor(covariance);
  CHAINSPLAT_CHECK(math::is_positive(factor), std::to_string(d.links));
  return factor.solve(MatrixX::Identity(d.links, d.links));
}

Unknowns finish(Draft d) {
  const int size = d.u.size();
  d.u.mean = Eigen::Map<const VectorX>(d.means.data(), size);
  MatrixX& precision = d.u.precision;
  precision = MatrixX::Zero(size, size);
  for (int i = 0; i < size; ++i) precision(i, i) = 1.0 / (d.deviations[i] * d.deviations[i]);
  for (const Draft::Smooth& s : d.smooth)
    for (int i = s.first; i + 1 < s.first + s.count; ++i) {
      const double weight = 1.0 / (s.deviation * s.deviation);
      precision(i, i) += weight, precision(i + 1, i + 1) += weight;
      precision(i, i + 1) -= weight, precision(i + 1, i) -= weight;
    }
  if (const int coulomb = d.u.first(Quantity::coulomb_friction); coulomb >= 0)
    precision.block(coulomb, coulomb, d.links, d.links) = table_friction_precision(d, coulomb);
  return std::move(d.u);
}

}  // namespace

double mean_bent_length(const chain::Chain& chain) {
  return (chain.length - chain.joint_arclength[0]) / (chain.links() - 1);
}

Unknowns make_unknowns(const chain::Chain& chain, const Options& options, const Start& start, const Extras& extras,
                       const Rod& rod) {
  Draft d = begin(chain, options, start);
  add_stiffness(d, rod);
  if (options.paper) {
    add_as_in_paper(d);
  } else {
    add_damping_and_masses(d);
    add_surroundings(d, extras);
    add_natural_shape(d);
    add_bending_friction(d, extras);
    add_initial_state(d, start, extras);
  }
  return finish(std::move(d));
}

Unknowns make_state_unknowns(const chain::Chain& chain, const dynamics::Parameters& parameters, const Start& start) {
  const int n = chain.angles();
  Unknowns u;
  u.reference = parameters;
  u.total_mass = dynamics::total_mass(parameters);
  u.initial = {0.0, VectorX::Zero(n), VectorX::Zero(n)};
  std::vector<double> means, sds;
  const auto add = [&](Quantity quantity, double mean, double sd, int k) {
    u.list.push_back({quantity, k});
    means.push_back(mean), sds.push_back(sd);
  };
  for (int k = 0; k < n; ++k) add(Quantity::theta, start.theta[k], kInitialThetaSd, k);
  for (int k = 0; k < n; ++k) add(Quantity::thetadot, start.thetadot[k], kInitialRateSd, k);
  for (int k = 0; k < n && !parameters.bending_friction.empty(); ++k)
    add(Quantity::friction_state, 0.0, kFrictionStateSd, k);
  u.mean = Eigen::Map<const VectorX>(means.data(), u.size());
  u.precision = Eigen::Map<const VectorX>(sds.data(), u.size()).cwiseAbs2().cwiseInverse().asDiagonal();
  return u;
}

int Unknowns::first(Quantity quantity) const {
  for (int i = 0; i < size(); ++i)
    if (list[i].quantity == quantity) return i;
  return -1;
}

std::vector<std::string> Unknowns::names() const {
  std::vector<std::string> out;
  for (const dynamics::Unknown& unknown : list) out.push_back(dynamics::name_of(unknown));
  return out;
}

State apply(const chain::Chain& chain, const Unknowns& u, const VectorX& p) {
  return {dynamics::moved(chain, u.reference, u.list, p, u.total_mass), dynamics::moved(u.initial, u.list, p)};
}

Rod rod_of(const chain::Chain& chain, const Unknowns& u, const VectorX& p, const math::Vector3& direction) {
  const int stiffness = u.first(Quantity::stiffness);
  return {stiffness < 0 ? 0.0 : std::exp(p[stiffness]) * mean_bent_length(chain),
          dynamics::grasp_tension(apply(chain, u, p).parameters, direction)};
}

void keep_grasp(const Unknowns& before, const Unknowns& now, VectorX& p) {
  const auto keep = [&](Quantity quantity, std::vector<double> dynamics::Parameters::*values) {
    const int first = now.first(quantity);
    if (first >= 0) p[first] += std::log((before.reference.*values)[0] / (now.reference.*values)[0]);
  };
  keep(Quantity::joint_stiffness, &dynamics::Parameters::stiffness);
  keep(Quantity::joint_damping, &dynamics::Parameters::damping);
}

std::vector<dynamics::Tangent> tangents(const chain::Chain& chain, const Unknowns& u, const VectorX& p) {
  return dynamics::tangents(chain, apply(chain, u, p).parameters, u.list, u.total_mass);
}

}  // namespace chainsplat::identification
