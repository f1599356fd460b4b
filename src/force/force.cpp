#include "chainsplat/force.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <numeric>

namespace chainsplat::force {

using math::Pose;

namespace {

constexpr double kPushedMass = 0.06;  // kg, of the rope that Options::force_scale is for

// A force is said to touch where that is more likely than not and it is larger than this share of the rope's weight,
// which model errors feign.
constexpr double kTouchingWeight = 0.04;

// How much longer nothing touches a rope than something does, where contacts are sought, and where the user names one.
constexpr double kOddsOfNone = 3.0, kOddsWhereNamed = 1.0;
constexpr double kNotSaid = -1e6;  // log likelihood of a contact where the user says that there is none

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
  MatrixX covariance;          // with friction at rest as noise,
  MatrixX sliding_covariance;  // and without
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

  out.sliding_covariance = out.covariance;
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
      const MatrixX along = across * jacobian;
      out.covariance.noalias() += std::pow(out.hidden[link], 2) * along.transpose() * along;
    }
  }
  return out;
}

Contact contact_at(const chain::Chain& chain, double arclength) {
  return {chain::link_at(chain, arclength), arclength, arclength * chain.direction, 0.0};
}

// Whether the rope is touched, and where, along time: a hidden Markov chain over 'nowhere' and the places.
struct Track {
  std::vector<double> probability;           // of being touched, a time
  std::vector<double> arclength, deviation;  // m, if touched
};

// `evidence`: places x times, log likelihood of a force there over that of none. `odds`: of none over a contact, before
// anything was seen. Backward from the future unless `live`.
Track follow(const MatrixX& evidence, const std::vector<double>& time, const std::vector<double>& arclengths,
             double odds, double slide, bool live, const Options& options) {
  const Eigen::Index places = evidence.rows(), count = evidence.cols();
  // likelihoods a time, row 0 of 'nowhere'; errors last, so what is near in time is in part the same news
  MatrixX likely(places + 1, count);
  for (Eigen::Index f = 0; f < count; ++f) {
    const double h = f > 0 ? time[f] - time[f - 1] : count > 1 ? time[1] - time[0] : options.error_memory;
    VectorX column(places + 1);
    column << 0.0, std::min(1.0, h / options.error_memory) * evidence.col(f);
    likely.col(f) = (column.array() - column.maxCoeff()).exp();
  }
  const auto transition = [&](double h) {  // column: from
    MatrixX out = MatrixX::Zero(places + 1, places + 1);
    const double leave = 1.0 - std::exp(-h / options.contact_time), come = leave / odds;
    out(0, 0) = 1.0 - come;
    out.col(0).tail(places).setConstant(come / places);
    for (Eigen::Index i = 0; i < places; ++i) {
      VectorX to(places);
      for (Eigen::Index k = 0; k < places; ++k)
        to[k] = std::exp(-0.5 * std::pow(arclengths[k] - arclengths[i], 2) / (slide * slide * h));
      out(0, 1 + i) = leave;
      out.col(1 + i).tail(places) = (1.0 - leave) / to.sum() * to;
    }
    return out;
  };
  MatrixX step;
  double step_time = 0.0;
  const auto over = [&](double h) -> const MatrixX& {
    if (step.size() == 0 || std::abs(h - step_time) > 1e-9) step = transition(step_time = h);
    return step;
  };
  MatrixX belief(places + 1, count);
  for (Eigen::Index f = 0; f < count; ++f) {
    VectorX before(places + 1);
    if (f == 0) {
      before.setConstant(1.0 / (places * (1.0 + odds)));
      before[0] = odds / (1.0 + odds);
    } else {
      before = over(time[f] - time[f - 1]) * belief.col(f - 1);
    }
    belief.col(f) = before.cwiseProduct(likely.col(f));
    belief.col(f) /= belief.col(f).sum();
  }
  if (!live) {
    VectorX later = VectorX::Ones(places + 1);
    for (Eigen::Index f = count - 1; f-- > 0;) {
      later = over(time[f + 1] - time[f]).transpose() * later.cwiseProduct(likely.col(f + 1));
      later /= later.sum();
      belief.col(f) = belief.col(f).cwiseProduct(later).eval();
      belief.col(f) /= belief.col(f).sum();
    }
  }
  Track out;
  const Eigen::Map<const VectorX> s(arclengths.data(), places);
  for (Eigen::Index f = 0; f < count; ++f) {
    const VectorX at = belief.col(f).tail(places);
    out.probability.push_back(1.0 - belief(0, f));
    const double mean = at.sum() > 0.0 ? at.dot(s) / at.sum() : s.mean();
    out.arclength.push_back(mean);
    out.deviation.push_back(at.sum() > 0.0 ? std::sqrt(at.dot((s.array() - mean).square().matrix()) / at.sum())
                                           : s.maxCoeff() - s.minCoeff());
  }
  return out;
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
      best = {link, arclength, home, std::sqrt(distance)};
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
  const auto jacobian_at = [&](const Frame& frame, const Contact& contact) {
    return chain::point_jacobian(chain, frame.axes, contact.link, frame.motions[contact.link] * contact.home);
  };
  const auto prior_at = [&](const Frame& frame, const Contact& contact) {
    const Vector3 tangent = frame.motions[contact.link].rotation * chain.direction;
    return Matrix3(across * across * Matrix3::Identity() +
                   (along * along - across * across) * tangent * tangent.transpose());
  };
  const auto evidence_at = [&](const Frame& frame, const Contact& contact) {
    return solve(jacobian_at(frame, contact), frame.residual, frame.covariance, prior_at(frame, contact)).evidence;
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
        evidence(i, f) = evidence_at(frames[f], contact_at(chain, arclengths[i]));
  } else {
    arclengths.push_back(chain.length);
    evidence.resize(1, static_cast<Eigen::Index>(count));
    for (std::size_t f = 0; f < count; ++f)
      evidence(0, f) = contacts[f] ? evidence_at(frames[f], *contacts[f]) : kNotSaid;
  }
  const Track track = follow(evidence, motion.time, arclengths, automatic ? kOddsOfNone : kOddsWhereNamed,
                             options.slide * chain.length, live, options);

  std::vector<Estimate> out;
  for (std::size_t f = 0; f < count; ++f) {
    const Frame& frame = frames[f];
    Estimate e;
    e.time = motion.time[f];
    e.contact = contact_at(chain, chain.length);
    if (automatic) {
      e.contact = contact_at(chain, track.arclength[f]);
      e.arclength_sigma = track.deviation[f];
    } else if (contacts[f]) {
      e.contact = *contacts[f];
    }
    e.point = frame.motions[e.contact.link] * e.contact.home;
    if (automatic || contacts[f]) {
      e.probability = track.probability[f];
      const MatrixX jacobian = jacobian_at(frame, e.contact);
      const Matrix3 prior = prior_at(frame, e.contact);
      const Fit fit = solve(jacobian, frame.residual, frame.covariance, prior);
      const Vector3 variance = fit.covariance.diagonal();
      // a contact that was named is believed
      const double believed = automatic ? e.probability : 1.0;
      e.force = believed * fit.force;
      e.sigma = (variance + believed * (1.0 - believed) * fit.force.cwiseProduct(fit.force)).cwiseSqrt();
      e.observed = (Vector3::Ones() - variance.cwiseQuotient(prior.diagonal())).cwiseMax(0.0);
      e.touching = e.probability > 0.5 && e.force.norm() > kTouchingWeight * weight;
      // friction at rest may balance any force up to its limit: about what the rope would feel if it balanced none
      const Fit fit_sliding = solve(jacobian, frame.residual, frame.sliding_covariance, prior);
      const double limit = std::accumulate(frame.hidden.begin(), frame.hidden.end(), 0.0);
      e.low = e.high = e.force;
      if (const auto& normal = model.parameters.table_normal) {
        const Vector3 reach = limit * (Vector3::Ones() - normal->cwiseProduct(*normal)).cwiseMax(0.0).cwiseSqrt();
        e.low = e.force.cwiseMin(fit_sliding.force - reach);
        e.high = e.force.cwiseMax(fit_sliding.force + reach);
      }
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
         ",\"probability\":" + core::exact(e.probability) + ",\"observed\":" + list(e.observed) +
         ",\"low\":" + list(e.low) + ",\"high\":" + list(e.high) +
         ",\"arclength_sigma\":" + core::exact(e.arclength_sigma) + ",\"moving\":" + truth(e.moving) + ",\"unit\":\"" +
         (known_mass ? "N" : "N/kg") + "\"}";
}

}  // namespace chainsplat::force
