#include "unknowns.h"

#include <cmath>

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

}  // namespace

Unknowns make_unknowns(const chain::Chain& chain, const Options& options, const Start& start, const Extras& extras) {
  const int n = chain.angles(), links = chain.links() - 1;
  Unknowns u;
  u.total_mass = options.mass.value_or(1.0);
  u.held.emplace_back("total_mass", options.mass ? "given: only ratios to it are observable"
                                                 : "set to 1 kg: only ratios to it are observable, forces are per kg");
  u.initial = {0.0, start.theta, start.thetadot};

  dynamics::Parameters& unit = u.reference;
  const auto all = [](int count, double value) { return std::vector<double>(count, value); };
  unit.viscous_friction = unit.coulomb_friction = unit.air_linear = unit.air_quadratic = all(links, 0.0);
  unit.stiffness = unit.rest_angle = unit.damping = all(n, 0.0);
  unit.radius = options.paper ? 0.0 : 0.5 * chain.diameter;
  unit.gravity = options.gravity;
  if (options.tabletop) unit.table_normal = options.table_normal.normalized();
  unit.integrator = options.paper ? dynamics::Integrator::implicit_velocity_euler : options.integrator;
  unit.substeps = options.paper ? 1 : options.substeps > 0 ? options.substeps : options.tabletop ? 8 : 4;
  for (int link = 1; link <= links; ++link) unit.link_mass.push_back(chain.link_end(link) - chain.link_start(link));

  // a joint is the softer the longer the piece of rope that it stands for
  const double reference = (chain.length - chain.joint_arclength[0]) / links;
  for (int k = 0; k < n; ++k)
    unit.damping[k] = options.paper ? 1.0 : reference / chain::bent_length(chain, chain.child_link[k]);

  std::vector<double> means, sds;
  struct Smooth {
    int first, count;
    double sd;
  };
  std::vector<Smooth> smooth;
  const auto add = [&](Quantity quantity, int index, double mean, double sd) {
    u.list.push_back({quantity, index});
    for (const Prior& prior : options.priors)
      if (prior.unknown == dynamics::Unknown{quantity, index} ||
          prior.unknown == dynamics::Unknown{quantity, dynamics::kEvery})
        mean = prior.mean, sd = prior.deviation;
    means.push_back(mean), sds.push_back(sd);
  };
  const auto add_many = [&](Quantity quantity, int count, double mean, double sd, double smooth_sd) {
    if (smooth_sd > 0.0) smooth.push_back({u.size(), count, smooth_sd});
    for (int i = 0; i < count; ++i) add(quantity, i, mean, sd);
  };

  const double torque = u.total_mass * options.gravity.norm() * chain.length;
  const bool stiff = options.fit_stiffness && !options.paper;
  if (stiff) {
    unit.stiffness = unit.damping;
    add(Quantity::stiffness, 0, std::log(kStiffnessPart * torque), kSharedSd);
    // two fingers hold a rope more stiffly one way than the other (a foam noodle in a gripper: 1.5)
    if (options.per_joint && n > 1 && chain.child_link[1] == 1 && !chain::is_twist(chain, 1))
      add(Quantity::grasp_stiffness, 0, 0.0, kGraspSd);
    if (chain::has_twist(chain)) add(Quantity::twist_stiffness, 0, 0.0, kTwistSd);
    if (twists_within_links(chain, options)) {
      for (int k = 0; k < n; k += 2) unit.torsional_stiffness.push_back(unit.stiffness[k]);
      add(Quantity::torsional_stiffness, 0, -std::log(1.0 + kPoissonRatio), kTorsionSd);
    }
  } else {
    u.held.emplace_back("stiffness", options.paper ? "0, as in the paper" : "held at 0 on request");
  }
  const double damping = stiff ? kRetardation * kStiffnessPart * torque : kDampingPart * torque;
  if (options.paper) {
    add_many(Quantity::joint_damping, links, std::log(damping), kViscousSd, 0.0);
    add_many(Quantity::link_mass, links, 0.0, kPaperMassSd, 0.0);
    if (options.tabletop) {
      unit.viscous_friction = all(links, 1.0);
      add_many(Quantity::viscous_friction, links, std::log(kViscousRate * u.total_mass / links), kViscousSd, 0.0);
    }
    u.held.emplace_back("tip_mass", "0, as in the paper");
    u.held.emplace_back("rest_angle", "0, as in the paper");
    u.held.emplace_back("initial_state", "the recognized one, as in the paper");
  } else {
    add(Quantity::damping, 0, std::log(damping), kSharedSd);
    if (options.per_joint) {
      if (stiff) add_many(Quantity::joint_stiffness, links, 0.0, kJointSd, kSmoothSd);
      add_many(Quantity::joint_damping, links, 0.0, kJointSd, kSmoothSd);
      add_many(Quantity::link_mass, links, 0.0, kMassSd, kSmoothSd);
    } else {
      u.held.emplace_back("link_mass", "uniform along the rope");
    }
    if (options.tabletop) {
      unit.coulomb_friction = all(links, 1.0);
      add_many(Quantity::coulomb_friction, links, std::log(kCoulombMean), kCoulombSd, 0.0);
      unit.tip_mass = options.tip_mass.value_or(0.0);
      u.held.emplace_back("tip_mass", options.tip_mass ? "given" : "0: not observable on a table beside the friction");
      u.held.emplace_back("drag", "0 on a table");
    } else {
      unit.air_quadratic = unit.link_mass;  // by length, too
      add(Quantity::drag, 0, std::log(kDragPerDiameter * std::max(chain.diameter, 1e-3)), kSharedSd);
      if (options.tip_mass && *options.tip_mass == 0.0) {
        u.held.emplace_back("tip_mass", "0: given");
      } else {
        const TipPrior prior = tip_prior(options, extras, u.total_mass);
        unit.tip_mass = 0.5 * u.total_mass;  // where the logit is 0
        add(Quantity::tip_mass, 0, std::log(prior.part / (1.0 - prior.part)), prior.deviation);
      }
    }
    if (stiff)
      add_many(Quantity::rest_angle, n, 0.0, kRestSd, 0.0);
    else
      u.held.emplace_back("rest_angle", "has no effect without stiffness");
    // a natural curvature out of the plane of kRestSd a joint, torsion as stiff as bending
    if (stiff && options.tabletop && n == links) {
      unit.roll_lever = all(n, 0.0);
      for (int k = chain.link_start(1) > 0.0 ? 0 : 1; k < n; ++k)  // at the grasp nothing rolls
        add(Quantity::roll_lever, k, 0.0, kRestSd * 0.5 * chain.diameter * chain.length / reference);
    }
    if (!extras.friction) {
      u.held.emplace_back("bending_friction",
                          options.tabletop ? "0: not told from the table's friction" : "0: the data do not ask for it");
    } else {
      unit.bending_friction = all(n, 1.0);
      for (int k = 0; k < n; ++k)  // a curvature, alike all along
        unit.bending_friction_angle.push_back(chain::bent_length(chain, chain.child_link[k]) / reference);
      add(Quantity::bending_friction, 0, std::log(kBendingFrictionPart * torque), kBendingFrictionSd);
      add(Quantity::bending_friction_angle, 0, std::log(kBendingFrictionAngle), kBendingFrictionAngleSd);
    }
    u.initial = {0.0, VectorX::Zero(n), VectorX::Zero(n)};
    for (int k = 0; k < n; ++k) add(Quantity::theta, k, start.theta[k], start.theta_sd[k]);
    for (int k = 0; k < n; ++k) add(Quantity::thetadot, k, start.thetadot[k], start.rate_sd);
    if (extras.friction) add_many(Quantity::friction_state, n, 0.0, kFrictionStateSd, 0.0);
  }

  const int size = u.size();
  u.mean = Eigen::Map<const VectorX>(means.data(), size);
  u.precision = MatrixX::Zero(size, size);
  for (int i = 0; i < size; ++i) u.precision(i, i) = 1.0 / (sds[i] * sds[i]);
  for (const Smooth& s : smooth)
    for (int i = s.first; i + 1 < s.first + s.count; ++i) {
      const double weight = 1.0 / (s.sd * s.sd);
      u.precision(i, i) += weight, u.precision(i + 1, i + 1) += weight;
      u.precision(i, i + 1) -= weight, u.precision(i + 1, i) -= weight;
    }
  if (const int coulomb = u.first(Quantity::coulomb_friction); coulomb >= 0) {
    // a rope that lies flat presses on the table with its weight: one coefficient, but where the fingers hold
    MatrixX covariance = MatrixX::Zero(links, links);
    const auto given = [&](int j) { return sds[coulomb + j] != kCoulombSd; };  // in options.priors
    for (int i = 0; i < links; ++i) {
      const bool held = chain.link_start(i + 1) < kHeldDiameters * chain.diameter;
      const double own = !options.friction_per_link ? kSameSd : held ? kHeldCoulombSd : kLinkCoulombSd;
      covariance(i, i) = given(i) ? sds[coulomb + i] * sds[coulomb + i] : own * own;
      for (int j = 0; j < links; ++j)
        if (!given(i) && !given(j)) covariance(i, j) += kCoulombSd * kCoulombSd;
    }
    const Eigen::LDLT<MatrixX> factor(covariance);
    CHAINSPLAT_CHECK(math::is_positive(factor), std::to_string(links));
    u.precision.block(coulomb, coulomb, links, links) = factor.solve(MatrixX::Identity(links, links));
  }
  return u;
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

std::vector<dynamics::Tangent> tangents(const chain::Chain& chain, const Unknowns& u, const VectorX& p) {
  return dynamics::tangents(chain, apply(chain, u, p).parameters, u.list, u.total_mass);
}

}  // namespace chainsplat::identification
