#include "chainsplat/force.h"

#include <algorithm>
#include <cmath>
#include <cstdio>

namespace chainsplat::force {

using math::Pose;

namespace {

constexpr double kPushedMass = 0.06;  // kg, of the rope that Options::force_scale is for

// A force is said to touch where it explains this much chi square (three components: beyond 99.9 %) and is larger than
// this share of the rope's weight, which model errors feign.
constexpr double kTouching = 16.3;
constexpr double kTouchingWeight = 0.04;

// Nothing touches a rope most of the time: without evidence an automatic contact is so much less likely than none.
constexpr double kOddsOfNone = 3.0;

constexpr double kMovingSpeeds =
    3.0;                              // of the friction's regularization speed, beyond which friction is known (SPEC 7)
constexpr double kUnseenLever = 0.1;  // diameters; angles that move no link's end (twist) are seen on the surface alone
constexpr double kLeastTorque = 1e-6;  // of weight times length, keeps covariances invertible

double total_mass(const dynamics::Parameters& parameters) {
  double mass = parameters.tip_mass;
  for (const double m : parameters.link_mass) mass += m;
  return mass;
}

// What one frame contributes: the unexplained torque, how sure it is, and where the rope is.
struct Frame {
  VectorX residual;
  MatrixX covariance;
  MatrixX axes;
  std::vector<Pose> motions;
  std::vector<double> hidden;  // N a link, friction that may balance a force unseen
  std::vector<double> speed;   // m/s a link, of its middle, across the table
};

// Of the joints after the first and the free end: the ends of the links 1.. .
std::vector<MatrixX> link_end_jacobians(const chain::Chain& chain, const MatrixX& axes,
                                        const std::vector<Pose>& motions) {
  const MatrixX nodes = chain::nodes(chain, motions);
  std::vector<MatrixX> jacobians;
  for (int link = 1; link < chain.links(); ++link)
    jacobians.push_back(chain::point_jacobian(chain, axes, link, nodes.col(link + 1)));
  return jacobians;
}

Frame frame_of(const dynamics::Model& model, const trajectory::BaseMotion& base, const Motion& motion, std::size_t f,
               const Options& options) {
  const chain::Chain& chain = model.chain;
  const dynamics::Parameters& p = model.parameters;
  const int n = chain.angles();
  const VectorX &theta = motion.theta[f], &thetadot = motion.thetadot[f], &thetaddot = motion.thetaddot[f];
  Frame out;
  out.residual = residual_torque(model, base, theta, thetadot, thetaddot);
  out.axes = chain::world_axes(chain, theta, base.pose);
  out.motions = chain::link_motions(chain, theta, base.pose);

  const dynamics::Linearization at = dynamics::linearize(model, base, math::Vector6::Zero(), theta, thetadot);
  const MatrixX* const by[] = {&at.stiffness, &at.damping, &at.mass};
  out.covariance = MatrixX::Zero(n, n);
  for (int a = 0; a < 3; ++a)
    for (int b = 0; b < 3; ++b)
      out.covariance.noalias() += motion.covariance[f](a, b) * *by[a] * motion.noise * by[b]->transpose();
  const std::vector<MatrixX> jacobians = link_end_jacobians(chain, out.axes, out.motions);
  if (!motion.standing.empty())
    out.covariance.noalias() += at.stiffness * motion.standing[f] * at.stiffness.transpose();
  const double moment = total_mass(p) * p.gravity.norm() * chain.length;
  for (int k = 0; k < n; ++k) {
    const double spring = options.relative_deviation * p.stiffness[k] * (theta[k] - p.rest_angle[k]);
    const double damper = options.relative_deviation * p.damping[k] * thetadot[k];
    out.covariance(k, k) += spring * spring + damper * damper + std::pow(kLeastTorque * moment, 2);
  }
  // weight that is somewhere else than thought: an error that grows toward the grasp, as a small force at every joint
  // and at the free end would make it
  const double error = options.gravity_deviation * total_mass(p) * p.gravity.norm();
  const MatrixX nodes = chain::nodes(chain, out.motions);
  for (const MatrixX& jacobian : jacobians) out.covariance.noalias() += error * error * jacobian.transpose() * jacobian;

  // friction at rest balances anything up to its limit
  out.hidden.assign(chain.links(), 0.0);
  out.speed.assign(chain.links(), 0.0);
  if (p.table_normal) {
    const Vector3& normal = *p.table_normal;
    const Matrix3 across = Matrix3::Identity() - normal * normal.transpose();
    const math::Matrix3& rotation = base.pose.rotation;
    const Vector3 omega = rotation * base.velocity.head<3>(), v0 = rotation * base.velocity.tail<3>();
    for (int link = 1; link < chain.links(); ++link) {
      const Vector3 x = 0.5 * (nodes.col(link) + nodes.col(link + 1));
      const MatrixX jacobian = chain::point_jacobian(chain, out.axes, link, x);
      const Vector3 v = across * (jacobian * thetadot + v0 + omega.cross(x - base.pose.translation));
      out.speed[link] = v.norm();
      const double limit = p.coulomb_friction[link - 1] * p.link_mass[link - 1] * std::abs(p.gravity.dot(normal));
      out.hidden[link] = limit * p.coulomb_speed / std::hypot(v.norm(), p.coulomb_speed);
      const MatrixX tangential = across * jacobian;
      out.covariance.noalias() += std::pow(out.hidden[link], 2) * tangential.transpose() * tangential;
    }
  }
  return out;
}

Contact contact_at(const chain::Chain& chain, double arclength) {
  return {chain::link_at(chain, arclength), arclength, arclength * chain.direction};
}

}  // namespace

MatrixX angle_covariance(const chain::Chain& chain, const VectorX& theta, const VectorX& sigma) {
  const MatrixX axes = chain::world_axes(chain, theta, Pose{});
  MatrixX information = MatrixX::Zero(sigma.size(), sigma.size());
  for (const MatrixX& jacobian : link_end_jacobians(chain, axes, chain::link_motions(chain, theta, Pose{})))
    information.noalias() += jacobian.transpose() * jacobian;
  information.diagonal().array() += std::pow(kUnseenLever * chain.diameter, 2);
  const MatrixX covariance = information.llt().solve(MatrixX::Identity(sigma.size(), sigma.size()));
  const VectorX scale = sigma.cwiseQuotient(covariance.diagonal().cwiseSqrt());
  return scale.asDiagonal() * covariance * scale.asDiagonal();
}

VectorX residual_torque(const dynamics::Model& model, const trajectory::BaseMotion& base, const VectorX& theta,
                        const VectorX& thetadot, const VectorX& thetaddot) {
  return dynamics::inverse_dynamics(model, base, theta, thetadot, thetaddot) -
         dynamics::joint_law(model, theta, thetadot);
}

Fit solve(const MatrixX& jacobian, const VectorX& residual, const MatrixX& covariance, const Matrix3& prior) {
  const Eigen::LLT<MatrixX> factor(covariance);
  const MatrixX weighted = factor.solve(jacobian.transpose());  // n x 3
  const Matrix3 information = jacobian * weighted + prior.inverse();
  Fit out;
  out.covariance = information.inverse();
  out.force = out.covariance * (weighted.transpose() * residual);
  out.explained = out.force.dot(information * out.force);
  out.evidence = 0.5 * (out.explained - std::log(prior.determinant() * information.determinant()));
  return out;
}

Contact nearest_contact(const chain::Chain& chain, const splat::Gaussians& gaussians, const Pose& base,
                        const VectorX& theta, const MatrixX& points) {
  const std::vector<Pose> motions = chain::link_motions(chain, theta, base);
  Contact best;
  double least = 1e300;
  const auto offer = [&](int link, double arclength, const Vector3& home) {
    const Vector3 x = motions[link] * home;
    for (Eigen::Index i = 0; i < points.cols(); ++i) {
      const double distance = (points.col(i) - x).squaredNorm();
      if (distance >= least) continue;
      least = distance;
      best = {link, arclength, home};
    }
  };
  if (gaussians.count > 0 && gaussians.links == chain.links()) {
    for (int i = 0; i < gaussians.count; ++i) {
      const float* const logits = &gaussians.link_logits[static_cast<std::size_t>(i) * gaussians.links];
      const int link = static_cast<int>(std::max_element(logits, logits + gaussians.links) - logits);
      const Vector3 home(gaussians.mean[3 * i], gaussians.mean[3 * i + 1], gaussians.mean[3 * i + 2]);
      offer(link, std::clamp(home.dot(chain.direction), chain.link_start(link), chain.link_end(link)), home);
    }
    return best;
  }
  constexpr int kPoints = 301;
  for (const double s : chain::equal_arclengths(chain, kPoints)) {
    const int link = chain::link_at(chain, s);
    offer(link, s, s * chain.direction);
  }
  return best;
}

std::vector<Estimate> estimate(const dynamics::Model& model, const dynamics::BaseFunction& base, const Motion& motion,
                               std::span<const std::optional<Contact>> contacts, bool live, const Options& options) {
  const chain::Chain& chain = model.chain;
  const std::size_t count = motion.time.size();
  const bool automatic = contacts.empty();
  CHAINSPLAT_CHECK(automatic || contacts.size() == count, std::to_string(contacts.size()));
  const double mass = total_mass(model.parameters), weight = mass * model.parameters.gravity.norm();
  const double across = options.force_scale * mass / kPushedMass, along = options.along * across;
  const auto solve_at = [&](const Frame& frame, const Contact& contact) {
    const Vector3 tangent = frame.motions[contact.link].rotation * chain.direction;
    const Matrix3 prior =
        across * across * Matrix3::Identity() + (along * along - across * across) * tangent * tangent.transpose();
    const MatrixX jacobian =
        chain::point_jacobian(chain, frame.axes, contact.link, frame.motions[contact.link] * contact.home);
    return std::pair(solve(jacobian, frame.residual, frame.covariance, prior), prior);
  };
  std::vector<Frame> frames;
  for (std::size_t f = 0; f < count; ++f) frames.push_back(frame_of(model, base(motion.time[f]), motion, f, options));

  // how much better a force at each place explains each time than none does
  std::vector<double> arclengths;
  MatrixX evidence;
  if (automatic) {
    for (int i = 1; i <= options.places; ++i) arclengths.push_back(chain.length * i / options.places);
    evidence.resize(options.places, static_cast<Eigen::Index>(count));
    for (std::size_t f = 0; f < count; ++f)
      for (int i = 0; i < options.places; ++i)
        evidence(i, f) = solve_at(frames[f], contact_at(chain, arclengths[i])).first.evidence;
  }

  std::vector<Estimate> out;
  for (std::size_t f = 0; f < count; ++f) {
    const Frame& frame = frames[f];
    Estimate e;
    e.time = motion.time[f];
    e.contact = contact_at(chain, chain.length);
    bool said = true;
    double probability = 1.0;
    if (automatic) {
      // neighboring times see nearly the same contact, and their errors are nearly the same too: the mean, not the sum
      VectorX mean = VectorX::Zero(options.places);
      double used = 0.0;
      for (std::size_t g = 0; g < count; ++g) {
        if (std::abs(motion.time[g] - e.time) > options.window || (live && g > f)) continue;
        mean += evidence.col(g);
        used += 1.0;
      }
      mean /= used;
      Eigen::Index at = 0;
      mean.maxCoeff(&at);
      double s = arclengths[at];
      const double step = chain.length / options.places;
      e.arclength_sigma = chain.length;
      if (at > 0 && at + 1 < options.places) {
        const double curvature = 2.0 * mean[at] - mean[at - 1] - mean[at + 1];
        if (curvature > 0.0) {
          s += 0.5 * step * (mean[at + 1] - mean[at - 1]) / curvature;
          e.arclength_sigma = std::min(chain.length, step / std::sqrt(curvature));
        }
      }
      e.contact = contact_at(chain, std::clamp(s, 0.0, chain.length));
      probability = 1.0 / (1.0 + kOddsOfNone * std::exp(-evidence(at, f)));
    } else if (contacts[f]) {
      e.contact = *contacts[f];
    } else {
      said = false;
    }
    e.point = frame.motions[e.contact.link] * e.contact.home;
    if (said) {
      const auto [fit, prior] = solve_at(frame, e.contact);
      e.force = probability * fit.force;
      e.sigma = fit.covariance.diagonal().cwiseSqrt();
      e.explained = fit.explained;
      e.observed = (Vector3::Ones() - fit.covariance.diagonal().cwiseQuotient(prior.diagonal())).cwiseMax(0.0);
      e.touching = e.explained > kTouching && e.force.norm() > kTouchingWeight * weight;
    }
    // friction is known where the links about the contact slide
    for (int link = std::max(1, e.contact.link - 1); link <= std::min(chain.links() - 1, e.contact.link + 1); ++link)
      if (frame.hidden[link] > 0.0 && frame.speed[link] < kMovingSpeeds * model.parameters.coulomb_speed)
        e.moving = false;
    out.push_back(e);
  }
  return out;
}

std::string to_json(const Estimate& e, bool known_mass) {
  const auto list = [](const Vector3& v) {
    return "[" + core::exact(v.x()) + "," + core::exact(v.y()) + "," + core::exact(v.z()) + "]";
  };
  const auto truth = [](bool value) { return value ? "true" : "false"; };
  return "{\"time\":" + core::exact(e.time) + ",\"link\":" + std::to_string(e.contact.link) +
         ",\"arclength\":" + core::exact(e.contact.arclength) + ",\"point\":" + list(e.point) +
         ",\"force\":" + list(e.force) + ",\"sigma\":" + list(e.sigma) + ",\"touching\":" + truth(e.touching) +
         ",\"observed\":" + list(e.observed) + ",\"arclength_sigma\":" + core::exact(e.arclength_sigma) +
         ",\"moving\":" + truth(e.moving) + ",\"unit\":\"" + (known_mass ? "N" : "N/kg") + "\"}";
}

}  // namespace chainsplat::force
