#include "unknowns.h"

#include <cmath>

namespace chainsplat::identification {
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
constexpr double kViscousSd = 1.0;
constexpr double kRestSd = 0.3;  // rad

// Centers of the priors, and starts. Stiffness is relative to M g L.
constexpr double kStiffnessPart = 0.1;
constexpr double kRetardation = 0.07;     // s, damping over stiffness
constexpr double kDampingPart = 0.004;    // s, damping over M g L, where there is no stiffness
constexpr double kDragCoefficient = 1.2;  // C_D of a cylinder across the flow
constexpr double kAirDensity = 1.2;       // kg/m^3
constexpr double kTipPart = 0.03;
constexpr double kCoulombMean = 0.3;
constexpr double kViscousRate = 3.0;  // 1/s, friction over mass

std::string numbered(const char* name, int index) { return std::string(name) + "_" + std::to_string(index + 1); }

}  // namespace

Unknowns make_unknowns(const chain::Chain& chain, const Options& options, const VectorX& theta, const VectorX& thetadot,
                       const VectorX& theta_sd, double rate_sd) {
  const int n = chain.angles(), links = chain.links() - 1;
  Unknowns u;
  u.total_mass = options.mass.value_or(1.0);
  u.held.emplace_back("total_mass", options.mass ? "given: only ratios to it are observable"
                                                 : "set to 1 kg: only ratios to it are observable, forces are per kg");
  u.first_theta = theta, u.first_thetadot = thetadot;

  dynamics::Parameters& fixed = u.fixed;
  const auto zeros = [](int count) { return std::vector<double>(count, 0.0); };
  fixed.link_mass = fixed.viscous_friction = fixed.coulomb_friction = fixed.air_linear = fixed.air_quadratic =
      zeros(links);
  fixed.stiffness = fixed.rest_angle = fixed.damping = zeros(n);
  fixed.radius = options.paper ? 0.0 : 0.5 * chain.diameter;
  fixed.gravity = options.gravity;
  if (options.tabletop) fixed.table_normal = options.table_normal.normalized();
  fixed.integrator = options.paper ? dynamics::Integrator::implicit_velocity_euler : options.integrator;
  fixed.substeps = options.paper ? 1 : options.substeps > 0 ? options.substeps : options.tabletop ? 8 : 4;

  const double reference = (chain.length - chain.joint_arclength[0]) / links;
  for (int k = 0; k < n; ++k) {
    u.compliance.push_back(options.paper ? 1.0 : reference / chain::bent_length(chain, chain.child_link[k]));
    u.twist.push_back(std::abs(chain.axes[k].head<3>().dot(chain.direction)) > 0.5);
  }

  std::vector<double> means, sds;
  struct Smooth {
    int first, count;
    double sd;
  };
  std::vector<Smooth> smooth;
  const auto add = [&](const std::string& name, double mean, double sd) {
    u.names.push_back(name);
    for (const Prior& prior : options.priors)
      if (name == prior.name || name.substr(0, name.find_last_not_of("0123456789")) == prior.name)
        mean = prior.mean, sd = prior.deviation;
    means.push_back(mean), sds.push_back(sd);
    return static_cast<int>(u.names.size()) - 1;
  };
  const auto add_many = [&](const char* name, int count, double mean, double sd, double smooth_sd) {
    const int first = u.size();
    for (int i = 0; i < count; ++i) add(numbered(name, i), mean, sd);
    if (smooth_sd > 0.0) smooth.push_back({first, count, smooth_sd});
    return first;
  };

  const double torque = u.total_mass * options.gravity.norm() * chain.length;
  const bool stiff = options.fit_stiffness && !options.paper;
  bool has_twist = false;
  for (bool t : u.twist) has_twist |= t;
  if (stiff) {
    u.stiffness = add("log_stiffness", std::log(kStiffnessPart * torque), kSharedSd);
    // two fingers hold a rope more stiffly one way than the other (a foam noodle in a gripper: 1.5)
    if (options.per_joint && n > 1 && chain.child_link[1] == 1 && !u.twist[1])
      u.grasp_stiffness = add("log_grasp_stiffness_ratio", 0.0, kGraspSd);
    if (has_twist) u.twist_stiffness = add("log_twist_stiffness_ratio", 0.0, 0.7);
  } else {
    u.held.emplace_back("stiffness", options.paper ? "0, as in the paper" : "held at 0 on request");
  }
  const double damping = stiff ? kRetardation * kStiffnessPart * torque : kDampingPart * torque;
  if (options.paper) {
    u.joint_damping = add_many("log_damping_joint", links, std::log(damping), kViscousSd, 0.0);
    u.link_mass = add_many("log_mass_link", links, 0.0, 0.3, 0.0);
    if (options.tabletop)
      u.viscous =
          add_many("log_viscous_friction_link", links, std::log(kViscousRate * u.total_mass / links), kViscousSd, 0.0);
    u.held.emplace_back("tip_mass", "0, as in the paper");
    u.held.emplace_back("rest_angle", "0, as in the paper");
    u.held.emplace_back("initial_state", "the recognized one, as in the paper");
  } else {
    u.damping = add("log_damping", std::log(damping), kSharedSd);
    if (options.per_joint) {
      if (stiff) u.joint_stiffness = add_many("log_stiffness_joint", links, 0.0, kJointSd, kSmoothSd);
      u.joint_damping = add_many("log_damping_joint", links, 0.0, kJointSd, kSmoothSd);
      u.link_mass = add_many("log_mass_link", links, 0.0, kMassSd, kSmoothSd);
    } else {
      u.held.emplace_back("link_mass", "uniform along the rope");
    }
    if (options.tabletop) {
      u.coulomb = add_many("log_coulomb_friction_link", links, std::log(kCoulombMean), kCoulombSd, 0.0);
      u.held.emplace_back("tip_mass", "0: not observable on a table beside the friction");
      u.held.emplace_back("drag", "0 on a table");
    } else {
      u.drag =
          add("log_drag", std::log(0.5 * kAirDensity * kDragCoefficient * std::max(chain.diameter, 1e-3)), kSharedSd);
      u.tip = add("logit_tip_mass_fraction", std::log(kTipPart / (1.0 - kTipPart)), kTipSd);
    }
    if (stiff)
      u.rest = add_many("rest_angle", n, 0.0, kRestSd, 0.0);
    else
      u.held.emplace_back("rest_angle", "has no effect without stiffness");
    // a natural curvature out of the plane of kRestSd a joint, torsion as stiff as bending
    if (stiff && options.tabletop && n == links) {
      u.first_roll = chain.link_start(1) > 0.0 ? 0 : 1;  // at the grasp nothing rolls
      u.roll = u.size();
      for (int k = u.first_roll; k < n; ++k)
        add(numbered("roll_lever", k), 0.0, kRestSd * 0.5 * chain.diameter * chain.length / reference);
    }
    u.theta = u.size();
    for (int k = 0; k < n; ++k) add(numbered("theta", k), theta[k], theta_sd[k]);
    u.thetadot = u.size();
    for (int k = 0; k < n; ++k) add(numbered("thetadot", k), thetadot[k], rate_sd);
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
  if (u.coulomb >= 0) {
    // a rope that lies flat presses on the table with its weight: one coefficient, but where the fingers hold
    MatrixX covariance = MatrixX::Zero(links, links);
    const auto given = [&](int j) { return sds[u.coulomb + j] != kCoulombSd; };  // in options.priors
    for (int i = 0; i < links; ++i) {
      const bool held = chain.link_start(i + 1) < kHeldDiameters * chain.diameter;
      const double own = !options.friction_per_link ? kSameSd : held ? kHeldCoulombSd : kLinkCoulombSd;
      covariance(i, i) = given(i) ? sds[u.coulomb + i] * sds[u.coulomb + i] : own * own;
      for (int j = 0; j < links; ++j)
        if (!given(i) && !given(j)) covariance(i, j) += kCoulombSd * kCoulombSd;
    }
    const Eigen::LDLT<MatrixX> factor(covariance);
    CHAINSPLAT_CHECK(math::is_positive(factor), std::to_string(links));
    u.precision.block(u.coulomb, u.coulomb, links, links) = factor.solve(MatrixX::Identity(links, links));
  }
  return u;
}

State apply(const chain::Chain& chain, const Unknowns& u, const VectorX& p) {
  const int n = chain.angles(), links = chain.links() - 1;
  State s;
  s.parameters = u.fixed;
  dynamics::Parameters& q = s.parameters;
  q.tip_mass = u.tip < 0 ? 0.0 : u.total_mass / (1.0 + std::exp(-p[u.tip]));
  double sum = 0.0;
  for (int j = 0; j < links; ++j)
    sum += q.link_mass[j] =
        (chain.link_end(j + 1) - chain.link_start(j + 1)) * (u.link_mass < 0 ? 1.0 : std::exp(p[u.link_mass + j]));
  for (int j = 0; j < links; ++j) {
    q.link_mass[j] *= (u.total_mass - q.tip_mass) / sum;
    if (u.coulomb >= 0) q.coulomb_friction[j] = std::exp(p[u.coulomb + j]);
    if (u.viscous >= 0) q.viscous_friction[j] = std::exp(p[u.viscous + j]);
    if (u.drag >= 0) q.air_quadratic[j] = std::exp(p[u.drag]) * (chain.link_end(j + 1) - chain.link_start(j + 1));
  }
  for (int k = 0; k < n; ++k) {
    const int joint = chain.child_link[k] - 1;
    if (u.stiffness >= 0)
      q.stiffness[k] = (k == 1 && u.grasp_stiffness >= 0 ? std::exp(p[u.grasp_stiffness]) : 1.0) * u.compliance[k] *
                       std::exp(p[u.stiffness] + (u.twist[k] ? p[u.twist_stiffness] : 0.0) +
                                (u.joint_stiffness < 0 ? 0.0 : p[u.joint_stiffness + joint]));
    q.damping[k] = u.compliance[k] * std::exp((u.damping < 0 ? 0.0 : p[u.damping]) +
                                              (u.joint_damping < 0 ? 0.0 : p[u.joint_damping + joint]));
    if (u.rest >= 0) q.rest_angle[k] = p[u.rest + k];
    if (u.roll >= 0) q.roll_lever.push_back(k < u.first_roll ? 0.0 : p[u.roll + k - u.first_roll]);
  }
  s.theta = u.theta < 0 ? u.first_theta : p.segment(u.theta, n).eval();
  s.thetadot = u.thetadot < 0 ? u.first_thetadot : p.segment(u.thetadot, n).eval();
  return s;
}

std::vector<dynamics::Tangent> tangents(const chain::Chain& chain, const Unknowns& u, const VectorX& p) {
  const int n = chain.angles(), links = chain.links() - 1;
  const dynamics::Parameters q = apply(chain, u, p).parameters;
  std::vector<dynamics::Tangent> out(u.size());
  const auto zeros = [](int count) { return std::vector<double>(count, 0.0); };
  const double free_mass = u.total_mass - q.tip_mass;
  if (u.stiffness >= 0) out[u.stiffness].stiffness = q.stiffness;
  if (u.grasp_stiffness >= 0) (out[u.grasp_stiffness].stiffness = zeros(n))[1] = q.stiffness[1];
  if (u.twist_stiffness >= 0) {
    auto& d = out[u.twist_stiffness].stiffness = q.stiffness;
    for (int k = 0; k < n; ++k)
      if (!u.twist[k]) d[k] = 0.0;
  }
  if (u.damping >= 0) out[u.damping].damping = q.damping;
  if (u.drag >= 0) out[u.drag].air_quadratic = q.air_quadratic;
  if (u.tip >= 0) {
    const double slope = q.tip_mass * free_mass / u.total_mass;
    out[u.tip].tip_mass = slope;
    out[u.tip].link_mass = q.link_mass;
    for (double& m : out[u.tip].link_mass) m *= -slope / free_mass;
  }
  for (int j = 0; j < links; ++j) {
    if (u.link_mass >= 0) {
      auto& d = out[u.link_mass + j].link_mass = q.link_mass;
      for (double& m : d) m *= -q.link_mass[j] / free_mass;
      d[j] += q.link_mass[j];
    }
    if (u.coulomb >= 0) (out[u.coulomb + j].coulomb_friction = zeros(links))[j] = q.coulomb_friction[j];
    if (u.viscous >= 0) (out[u.viscous + j].viscous_friction = zeros(links))[j] = q.viscous_friction[j];
    if (u.joint_stiffness >= 0) out[u.joint_stiffness + j].stiffness = zeros(n);
    if (u.joint_damping >= 0) out[u.joint_damping + j].damping = zeros(n);
  }
  for (int k = 0; k < n; ++k) {
    const int joint = chain.child_link[k] - 1;
    if (u.joint_stiffness >= 0) out[u.joint_stiffness + joint].stiffness[k] = q.stiffness[k];
    if (u.joint_damping >= 0) out[u.joint_damping + joint].damping[k] = q.damping[k];
    if (u.rest >= 0) (out[u.rest + k].rest_angle = zeros(n))[k] = 1.0;
    if (u.roll >= 0 && k >= u.first_roll) (out[u.roll + k - u.first_roll].roll_lever = zeros(n))[k] = 1.0;
    if (u.theta >= 0) out[u.theta + k].theta = VectorX::Unit(n, k);
    if (u.thetadot >= 0) out[u.thetadot + k].thetadot = VectorX::Unit(n, k);
  }
  return out;
}

}  // namespace chainsplat::identification
