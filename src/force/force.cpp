#include "chainsplat/force.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

#include "chainsplat/dynamics/parametrization.h"
#include "force/track.h"
#include "src/math/decompositions.h"

namespace chainsplat::force {

using math::Pose;

namespace {

constexpr double kPushedMass = 0.06;  // kg, of the rope to which Options::force_scale refers

// `touching` means that a contact is more likely than not, and that its force exceeds this share of the rope's weight,
// since model errors cause apparent forces below it, and so many of its standard errors.
constexpr double kTouchingWeight = 0.04;
constexpr double kTouchingErrors = 2.0;

// Ratio of the times without and with a contact, where contacts are searched for and where the user names one.
constexpr double kOddsOfNone = 3.0, kOddsWhereNamed = 1.0;
constexpr double kNotSaid = -1e6;  // log likelihood of a contact where the user excludes one

// Multiple of the friction's regularization speed beyond which friction is known (mathematics.md 7).
constexpr double kMovingSpeeds = 3.0;
constexpr double kUnseenLever = 0.1;   // diameters; angles that move no link's end (twist) show on the surface alone
constexpr double kLeastTorque = 1e-6;  // of weight times length, keeps covariances invertible
constexpr double kUnknownDeviation = 0.2;  // of a joint's stiffness and damping, where identification gives none
// s of states that a live smoother uses. The size of the jerk changes with a push, so that 1 s fits it better than 4 s.
constexpr double kLiveWindow = 1.0;

// By how many of its deviations the base's clock may be off: what is tried, where it is not known.
constexpr double kClockReach = 3.0, kClockStep = 0.25;
// Relative deviation of what the clock adds to the angles, which estimation knows to first order: of ropes that were
// followed with a base 15 and 33 ms late it was off by 0.15 to 0.23 (RMS).
constexpr double kAddedDeviation = 0.2;

using Factor = Eigen::LLT<MatrixX>;

Factor factor_of(const MatrixX& covariance) {
  Factor out(covariance);
  if (!math::is_positive(out))
    throw InputError("force", "the covariance of the unexplained torque is not positive definite",
                     "check the states, their covariance and the twin's parameters");
  return out;
}

// The forces at one place, one column for each column of the residual.
struct Forces {
  MatrixX force;
  Matrix3 covariance, information;
  VectorX evidence;
};

Forces solve_each(const MatrixX& jacobian, const MatrixX& residual, const Factor& factor, const Matrix3& prior) {
  const MatrixX weighted = factor.solve(MatrixX(jacobian.transpose()));  // n x 3
  Forces out;
  out.information = jacobian * weighted + prior.inverse();
  out.covariance = out.information.inverse();
  out.force = out.covariance * (weighted.transpose() * residual);
  const double share = std::log(prior.determinant() * out.information.determinant());
  out.evidence.resize(residual.cols());
  for (Eigen::Index h = 0; h < residual.cols(); ++h)
    out.evidence[h] = 0.5 * (out.force.col(h).dot(out.information * out.force.col(h)) - share);
  return out;
}

// The data of one time: the residual torque, its covariance, and the rope's configuration.
struct Frame {
  MatrixX residual;            // one column for each of Track::clock
  MatrixX covariance;          // of each of them, with friction at rest as noise
  MatrixX sliding_covariance;  // the same without friction at rest
  Factor factor;               // of `covariance`
  MatrixX axes;
  std::vector<Pose> motions;
  std::vector<double> hidden;  // N per link, friction that may balance a force unseen
  std::vector<double> speed;   // m/s per link, of its middle over the table
  std::vector<double> slow;    // m/s per link, speed below which it is not known which way its friction acts
  std::vector<Vector3> slip;   // per link, direction of that speed; shorter than 1 below the regularization speed
  Contact named;               // the contact that the user names, valid if `is_named`
  bool is_named = false;
};

// Returns the residual for each clock that is tried.
MatrixX residuals_by_clock(const dynamics::Model& model, const dynamics::BaseFunction& base, const Motion& motion,
                           std::size_t f, const Track& track) {
  MatrixX out(model.chain.angles(), track.clock.size());
  for (Eigen::Index h = 0; h < out.cols(); ++h) {
    const double off = track.clock[h];
    double late = 0.0;                                       // s
    MatrixX added = MatrixX::Zero(model.chain.angles(), 3);  // to theta, thetadot, thetaddot
    if (!motion.clock.empty()) late = off * motion.clock[f], added = off * motion.by_clock[f];
    out.col(h) = residual_torque(model, base(motion.time[f] + late), motion.theta[f] + added.col(0),
                                 motion.thetadot[f] + added.col(1), motion.thetaddot[f] + added.col(2));
  }
  return out;
}

Frame frame_of(const dynamics::Model& model, std::span<const dynamics::Model> deviations,
               const dynamics::BaseFunction& base_at, const Motion& motion, std::size_t f, const VectorX& clock,
               const Track& track) {
  const Options& options = track.options;
  const trajectory::BaseMotion base = base_at(motion.time[f]);
  const chain::Chain& chain = model.chain;
  const dynamics::Parameters& p = model.parameters;
  const int n = chain.angles();
  const VectorX &theta = motion.theta[f], &thetadot = motion.thetadot[f], &thetaddot = motion.thetaddot[f];
  Frame out;
  // the residual and the configuration
  out.residual = residuals_by_clock(model, base_at, motion, f, track);
  VectorX slip;  // shares of friction in bending
  if (!p.bending_friction.empty())
    if (const VectorX z = dynamics::internal_state_in_motion(model, theta, thetadot); z.size() >= n) slip = z.head(n);
  for (Eigen::Index k = 0; k < slip.size(); ++k) out.residual.row(k).array() += p.bending_friction[k] * slip[k];
  const VectorX residual = out.residual.col(track.clock.size() / 2);  // by the clock as it is believed to be
  out.axes = chain::world_axes(chain, theta, base.pose);
  out.motions = chain::link_motions(chain, theta, base.pose);

  // covariance of the residual: from the states' errors,
  const dynamics::Linearization at = dynamics::linearize(model, base, math::Vector6::Zero(), theta, thetadot);
  const MatrixX* const by[] = {&at.stiffness, &at.damping, &at.mass};
  out.covariance = MatrixX::Zero(n, n);
  for (int a = 0; a < 3; ++a)
    for (int b = 0; b < 3; ++b)
      out.covariance.noalias() += motion.covariance[f](a, b) * *by[a] * motion.noise * by[b]->transpose();
  if (!motion.standing.empty())
    out.covariance.noalias() += at.stiffness * motion.standing[f] * at.stiffness.transpose();
  // from the parameters',
  for (const dynamics::Model& other : deviations) {
    const VectorX off = residual_torque(other, base, theta, thetadot, thetaddot) - residual;
    out.covariance.noalias() += off * off.transpose();
  }
  // from the base's clock, which is between those that are tried, and adds to a joint's angles about what it is said
  // to,
  if (!motion.clock.empty()) {
    VectorX added = VectorX::Zero(chain.links());  // rad^2, at the joint before each link
    for (int k = 0; k < n; ++k) added[chain.child_link[k]] += std::pow(motion.by_clock[f](k, 0), 2);
    added *= std::pow(kAddedDeviation, 2) * clock.dot(track.clock.cwiseAbs2());
    for (int k = 0; k < n; ++k)
      out.covariance.noalias() += added[chain.child_link[k]] * at.stiffness.col(k) * at.stiffness.col(k).transpose();
    const VectorX step = (out.residual.rightCols(1) - out.residual.leftCols(1)) / (track.clock.size() - 1.0);
    out.covariance.noalias() += step * step.transpose() / 12.0;
  }
  // from friction in bending, of any share that motion has not decided,
  for (Eigen::Index k = 0; k < slip.size(); ++k)
    out.covariance(k, k) += std::pow(p.bending_friction[k], 2) * std::max(0.0, 1.0 - slip[k] * slip[k]) / 3.0;
  // from the joint laws',
  const double moment = dynamics::total_mass(p) * p.gravity.norm() * chain.length;
  for (int k = 0; k < n; ++k) {
    const double spring = options.relative_deviation * p.stiffness[k] * (theta[k] - p.rest_angle[k]);
    const double damper = options.relative_deviation * p.damping[k] * thetadot[k];
    out.covariance(k, k) += spring * spring + damper * damper + std::pow(kLeastTorque * moment, 2);
  }
  // and an error that grows toward the grasp, as a small force at every joint and at the free end would cause
  const double error = options.gravity_deviation * dynamics::total_mass(p) * p.gravity.norm();
  const MatrixX nodes = chain::nodes(chain, out.motions);
  out.covariance += error * error * chain::displacement_metric(chain::link_end_jacobians(chain, out.axes, out.motions));

  out.sliding_covariance = out.covariance;
  // friction at rest balances any force up to its limit; neighbors are correlated, as they were dragged there together
  out.hidden.assign(chain.links(), 0.0);
  out.speed.assign(chain.links(), 0.0);
  out.slow.assign(chain.links(), 0.0);
  out.slip.assign(chain.links(), Vector3::Zero());
  if (p.table_normal) {
    const Vector3& normal = *p.table_normal;
    const Matrix3 across = Matrix3::Identity() - normal * normal.transpose();
    const math::Matrix3& rotation = base.pose.rotation;
    const Vector3 omega = rotation * base.velocity.head<3>(), v0 = rotation * base.velocity.tail<3>();
    std::vector<MatrixX> friction(chain.links());
    for (int link = 1; link < chain.links(); ++link) {
      const Vector3 x = 0.5 * (nodes.col(link) + nodes.col(link + 1));
      const MatrixX jacobian = chain::point_jacobian(chain, out.axes, link, x);
      const Vector3 v = across * (jacobian * thetadot + v0 + omega.cross(x - base.pose.translation));
      out.speed[link] = v.norm();
      out.slip[link] = v / std::hypot(v.norm(), p.coulomb_speed);
      // a link that may as well slide the other way: where the rope turns, the speed's error reverses its friction
      const MatrixX sliding = across * jacobian;
      const double speed_variance =
          0.5 * motion.covariance[f](1, 1) * (sliding * motion.noise * sliding.transpose()).trace();
      out.slow[link] = std::hypot(p.coulomb_speed, std::sqrt(speed_variance));
      const double limit = p.coulomb_friction[link - 1] * p.link_mass[link - 1] * std::abs(p.gravity.dot(normal));
      out.hidden[link] = limit * out.slow[link] / std::hypot(v.norm(), out.slow[link]);
      const double off = std::hypot(out.hidden[link], options.relative_deviation * limit);
      friction[link] = off * sliding;
    }
    for (int a = 1; a < chain.links(); ++a)
      for (int b = 1; b < chain.links(); ++b) {
        const double apart = std::abs(chain.link_start(a) - chain.link_start(b)) / chain.length;
        out.covariance.noalias() += std::exp(-apart / options.friction_reach) * friction[a].transpose() * friction[b];
      }
  }
  out.factor = factor_of(out.covariance);
  return out;
}

// Returns the Jacobian of the contact's point with the side effects of a force there. A rope that slides over a table
// rolls, and its side rubs at the finger that pushes it: the finger presses the rope down by a share of the push
// (Options::pressing), and a finger that brakes it lifts it. This adds to the table's friction there and impedes the
// roll: it turns the rope about itself as a force at the underside along the push would.
MatrixX felt_jacobian(const dynamics::Model& model, const Frame& frame, const Contact& contact, double pressing) {
  const chain::Chain& chain = model.chain;
  const dynamics::Parameters& p = model.parameters;
  MatrixX out = chain::point_jacobian(chain, frame.axes, contact.link, frame.motions[contact.link] * contact.home);
  if (!p.table_normal || contact.link == 0) return out;
  const Vector3& slip = frame.slip[contact.link];
  const MatrixX dragged = p.coulomb_friction[contact.link - 1] * slip * (slip.transpose() * out);
  out -= pressing * dragged;
  if (p.roll_lever.empty()) return out;
  const Vector3 axis = frame.axes.col(0).head<3>();
  const Vector3 across = axis.cross(frame.motions[contact.link].rotation * chain.direction);
  for (int k = 0; k < chain.angles(); ++k) {
    const double share = std::min(chain.link_start(chain.child_link[k]), contact.arclength) / chain.length;
    out.col(k) -= pressing * p.roll_lever[k] * share * across;
  }
  return out;
}

Contact contact_at(const chain::Chain& chain, double arclength) {
  return {chain::link_at(chain, arclength), arclength, arclength * chain.direction, 0.0};
}

// A contact with its forces by the residual and the prior.
struct Touch {
  Contact contact;
  Matrix3 prior;
  MatrixX jacobian;
  Forces fit;
};

Touch touch_at(const dynamics::Model& model, const Frame& frame, const Contact& contact, const Options& options) {
  const chain::Chain& chain = model.chain;
  const double across = options.force_scale * dynamics::total_mass(model.parameters) / kPushedMass,
               along = options.along * across;
  const Vector3 tangent = frame.motions[contact.link].rotation * chain.direction;
  Touch out;
  out.contact = contact;
  out.prior = across * across * Matrix3::Identity() + (along * along - across * across) * tangent * tangent.transpose();
  out.jacobian = felt_jacobian(model, frame, contact, options.pressing);
  out.fit = solve_each(out.jacobian, frame.residual, frame.factor, out.prior);
  return out;
}

// Returns the contact at an arclength, on the side of the rope that is pushed, where a force along the rope has the
// radius as its lever. `clock`: probabilities of Track::clock.
Touch touch_on_surface(const dynamics::Model& model, const Frame& frame, double arclength, const VectorX& clock,
                       const Options& options) {
  const chain::Chain& chain = model.chain;
  const Touch axis = touch_at(model, frame, contact_at(chain, arclength), options);
  const Vector3 push = frame.motions[axis.contact.link].rotation.transpose() * (axis.fit.force * clock);
  const Vector3 across = push - chain.direction.dot(push) * chain.direction;
  const double weight = dynamics::total_mass(model.parameters) * model.parameters.gravity.norm();
  if (across.norm() <= kTouchingWeight * weight) return axis;
  Contact contact = axis.contact;
  contact.home -= 0.5 * chain.diameter * across.normalized();
  return touch_at(model, frame, contact, options);
}

// Returns the forces at every place that is tracked: all along the rope, or the named one. `clock`: as above, before
// this time is looked at.
std::vector<Forces> fits_at(const dynamics::Model& model, const Frame& frame, const VectorX& clock, const Track& track,
                            bool automatic) {
  std::vector<Forces> out;
  if (!automatic && !frame.is_named) {
    out.emplace_back().evidence = VectorX::Constant(track.clock.size(), kNotSaid);
  } else if (!automatic) {
    out.push_back(touch_at(model, frame, frame.named, track.options).fit);
  } else {
    for (const double arclength : track.arclengths)
      out.push_back(touch_on_surface(model, frame, arclength, clock, track.options).fit);
  }
  return out;
}

// Returns the log likelihoods that likelihood() takes, relative to that of no contact and the first clock.
MatrixX logs_of(const Frame& frame, const std::vector<Forces>& fits) {
  const auto places = static_cast<Eigen::Index>(fits.size());
  const VectorX squares = frame.factor.matrixL().solve(frame.residual).colwise().squaredNorm();
  MatrixX out = (-0.5 * (squares.array() - squares[0])).matrix().transpose().replicate(places + 1, 1);
  for (Eigen::Index i = 0; i < places; ++i) out.row(1 + i) += fits[i].evidence;
  return out;
}

Track track_of(const chain::Chain& chain, bool automatic, bool clock_known, const Options& options) {
  Track out;
  out.odds = automatic ? kOddsOfNone : kOddsWhereNamed;
  out.options = options;
  const int places = automatic ? options.places : 1;
  for (int i = 1; i <= places; ++i) out.arclengths.push_back(chain.length * i / places);
  const auto steps = static_cast<Eigen::Index>(clock_known ? 0.0 : kClockReach / kClockStep);
  out.clock = VectorX::LinSpaced(2 * steps + 1, -static_cast<double>(steps), static_cast<double>(steps)) * kClockStep;
  if (clock_known) out.clock.setZero();
  return out;
}

// Returns the estimate of one time from the belief about the contact's place.
Estimate line_of(const dynamics::Model& model, double time, const Frame& frame, const std::vector<Forces>& fits,
                 const MatrixX& belief, const Track& track, bool automatic) {
  const chain::Chain& chain = model.chain;
  const dynamics::Parameters& p = model.parameters;
  Estimate e;
  e.time = time;
  // without a contact the place is the free end
  e.contact = automatic || !frame.is_named ? contact_at(chain, chain.length) : frame.named;
  if (automatic || frame.is_named) {
    e.probability = 1.0 - belief.row(0).sum();
    const MatrixX at = belief.bottomRows(belief.rows() - 1);  // by place and clock
    const VectorX at_place = at.rowwise().sum(), clock = belief.colwise().sum();
    const Eigen::Map<const VectorX> s(track.arclengths.data(), at.rows());
    const double sum = std::max(at.sum(), std::numeric_limits<double>::min());
    const double mean = at_place.dot(s) / sum;
    if (automatic) e.arclength_sigma = std::sqrt(at_place.dot((s.array() - mean).square().matrix()) / sum);
    const Touch touch = automatic
                            ? touch_on_surface(model, frame, std::clamp(mean, s[0], chain.length), clock, track.options)
                            : touch_at(model, frame, frame.named, track.options);
    // mean over places and clocks, weighted by the belief; the spread of their forces adds to each one's own error
    Vector3 force = Vector3::Zero();
    Matrix3 covariance = Matrix3::Zero();
    for (Eigen::Index i = 0; i < at.rows(); ++i) force += fits[i].force * at.row(i).transpose() / sum;
    for (Eigen::Index i = 0; i < at.rows(); ++i) {
      const MatrixX off = fits[i].force.colwise() - force;
      covariance += at_place[i] / sum * fits[i].covariance;
      covariance += off * (at.row(i).transpose() / sum).asDiagonal() * off.transpose();
    }
    e.contact = touch.contact;
    if (const auto& normal = p.table_normal) {
      // how hard the finger presses is not observed, and the friction has the same relative uncertainty
      const Matrix3 plane = Matrix3::Identity() - *normal * normal->transpose();
      const double pressed = track.options.pressing * frame.slip[e.contact.link].dot(force);
      const double unseen = normal->dot(covariance * *normal) / normal->dot(touch.prior * *normal);
      const double friction = e.contact.link > 0 ? p.coulomb_friction[e.contact.link - 1] : 0.0;
      force -= unseen * pressed * *normal;
      covariance += std::pow(friction * pressed, 2) * plane;
    }
    // a named contact is certain
    const double believed = automatic ? e.probability : 1.0;
    e.force = believed * force;
    e.covariance = covariance + believed * (1.0 - believed) * force * force.transpose();
    e.sigma = e.covariance.diagonal().cwiseSqrt();
    e.observed = (Vector3::Ones() - covariance.diagonal().cwiseQuotient(touch.prior.diagonal())).cwiseMax(0.0);
    e.touching = e.probability > 0.5 && e.force.norm() > kTouchingWeight * dynamics::total_mass(p) * p.gravity.norm() &&
                 force.dot(covariance.ldlt().solve(force)) > kTouchingErrors * kTouchingErrors;
    // friction at rest may balance any force up to its limit: bounds around the force if it balanced none
    const Fit sliding = solve(touch.jacobian, frame.residual * clock, frame.sliding_covariance, touch.prior);
    const double limit = std::accumulate(frame.hidden.begin(), frame.hidden.end(), 0.0);
    e.low = e.high = e.force;
    if (const auto& normal = p.table_normal) {
      const Vector3 most = sliding.force + normal->dot(e.force - sliding.force) * *normal;
      const Vector3 reach = limit * (Vector3::Ones() - normal->cwiseProduct(*normal)).cwiseMax(0.0).cwiseSqrt();
      e.low = e.force.cwiseMin(most - reach);
      e.high = e.force.cwiseMax(most + reach);
    }
  }
  e.point = frame.motions[e.contact.link] * e.contact.home;
  // friction is known where the links about the contact slide
  for (int link = std::max(1, e.contact.link - 1); link <= std::min(chain.links() - 1, e.contact.link + 1); ++link)
    if (frame.hidden[link] > 0.0 && frame.speed[link] < kMovingSpeeds * frame.slow[link]) e.moving = false;
  return e;
}

// The parameters of known covariance.
struct Uncertainty {
  std::vector<dynamics::Unknown> unknowns;
  MatrixX covariance;
};

// Returns the known covariance of the parameters among the estimates; none where nothing of it is known.
std::optional<Uncertainty> known_uncertainty(const dynamics::Model& model, const dynamics::Estimates& estimates) {
  const auto all = static_cast<Eigen::Index>(estimates.names.size());
  if (all == 0 || estimates.covariance.rows() != all || estimates.covariance.cols() != all) return {};
  const std::vector<dynamics::Unknown> unknowns = dynamics::unknowns_of(model.chain, estimates);
  const std::vector<Eigen::Index> of = dynamics::parameters_among(unknowns);
  const MatrixX covariance = estimates.covariance(of, of);
  const std::vector<Eigen::Index> known = math::known_part(covariance);
  Uncertainty out{{}, covariance(known, known)};
  std::string unknown;
  for (std::size_t i = 0; i < of.size(); ++i) {
    if (std::binary_search(known.begin(), known.end(), static_cast<Eigen::Index>(i)))
      out.unknowns.push_back(unknowns[of[i]]);
    else
      unknown += (unknown.empty() ? "" : ", ") + estimates.names[of[i]];
  }
  if (unknown.empty()) return out;
  core::warn(
      "twin.json: identification.covariance: has null for " + unknown + "; the forces' standard errors " +
      (known.empty() ? "assume how uncertain stiffness and damping usually are" : "leave out how uncertain that is"));
  if (known.empty()) return {};
  return out;
}

}  // namespace

MatrixX angle_covariance(const chain::Chain& chain, const VectorX& theta, const VectorX& sigma) {
  MatrixX information = chain::displacement_metric(chain::link_end_jacobians(chain, theta, Pose{}));
  information.diagonal().array() += std::pow(kUnseenLever * chain.diameter, 2);
  const Eigen::LLT<MatrixX> factor(information);
  CHAINSPLAT_CHECK(math::is_positive(factor), "angles that are not finite");
  const MatrixX covariance = factor.solve(MatrixX::Identity(sigma.size(), sigma.size()));
  const VectorX scale = sigma.cwiseQuotient(covariance.diagonal().cwiseSqrt());
  return scale.asDiagonal() * covariance * scale.asDiagonal();
}

VectorX residual_torque(const dynamics::Model& model, const trajectory::BaseMotion& base, const VectorX& theta,
                        const VectorX& thetadot, const VectorX& thetaddot) {
  return dynamics::inverse_dynamics(model, base, theta, thetadot, thetaddot) -
         dynamics::joint_law(model, theta, thetadot);
}

Fit solve(const MatrixX& jacobian, const VectorX& residual, const MatrixX& covariance, const Matrix3& prior) {
  const Forces found = solve_each(jacobian, residual, factor_of(covariance), prior);
  Fit out;
  out.covariance = found.covariance;
  out.force = found.force.col(0);
  out.explained = out.force.dot(found.information * out.force);
  out.evidence = found.evidence[0];
  return out;
}

Contact nearest_contact(const chain::Chain& chain, const splat::Gaussians& gaussians, const Pose& base,
                        const VectorX& theta, const MatrixX& points) {
  const std::vector<Pose> motions = chain::link_motions(chain, theta, base);
  Contact best;
  double least = best.distance = std::numeric_limits<double>::infinity();
  // keeps the candidate if it is nearer to a point than the best so far
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
      const int link = splat::surest_link(gaussians, i);
      const Vector3 home(gaussians.mean[3 * i], gaussians.mean[3 * i + 1], gaussians.mean[3 * i + 2]);
      offer(link, std::clamp(home.dot(chain.direction), chain.link_start(link), chain.link_end(link)), home);
    }
    return best;
  }
  // without Gaussians, points along the centerline
  constexpr int kPoints = 301;
  for (const double s : chain::equal_arclengths(chain, kPoints)) {
    const int link = chain::link_at(chain, s);
    offer(link, s, s * chain.direction);
  }
  return best;
}

std::vector<dynamics::Model> deviations(const dynamics::Model& model, const dynamics::Estimates& estimates) {
  const chain::Chain& chain = model.chain;
  std::optional<Uncertainty> known = known_uncertainty(model, estimates);
  if (!known) {
    known.emplace();
    for (const auto quantity : {dynamics::Quantity::joint_stiffness, dynamics::Quantity::joint_damping})
      for (int joint = 0; joint + 1 < chain.links(); ++joint) known->unknowns.push_back({quantity, joint});
    const auto count = static_cast<Eigen::Index>(known->unknowns.size());
    known->covariance = kUnknownDeviation * kUnknownDeviation * MatrixX::Identity(count, count);
  }
  const auto& [unknowns, covariance] = *known;
  const Eigen::SelfAdjointEigenSolver<MatrixX> principal(covariance);
  std::vector<dynamics::Model> out;
  for (Eigen::Index i = 0; i < covariance.rows(); ++i) {
    const double variance = principal.eigenvalues()[i];
    if (!(variance > 0.0)) continue;
    const VectorX change = std::sqrt(variance) * principal.eigenvectors().col(i);
    out.push_back(dynamics::make_model(chain, dynamics::moved(chain, model.parameters, unknowns, change)));
  }
  return out;
}

std::vector<Estimate> estimate(const dynamics::Model& model, std::span<const dynamics::Model> deviations,
                               const dynamics::BaseFunction& base, const Motion& motion,
                               std::span<const std::optional<Contact>> contacts, const Options& options) {
  const std::size_t count = motion.time.size();
  const bool automatic = contacts.empty();
  CHAINSPLAT_CHECK(automatic || contacts.size() == count, std::to_string(contacts.size()));
  const Track track = track_of(model.chain, automatic, motion.clock.empty(), options);
  // forward pass of the hidden Markov chain
  std::vector<Frame> frames;
  std::vector<MatrixX> likely, belief;
  const auto interval = [&](std::size_t f) {
    return f > 0 ? motion.time[f] - motion.time[f - 1] : motion.time[1] - motion.time[0];
  };
  MatrixX step;
  double step_interval = -1.0;
  const auto step_over = [&](double h) -> const MatrixX& {
    if (std::abs(h - step_interval) > 1e-9) step = transition(track, step_interval = h);
    return step;
  };
  for (std::size_t f = 0; f < count; ++f) {
    const MatrixX before = f > 0 ? MatrixX(step_over(interval(f)) * belief[f - 1]) : first_belief(track);
    const VectorX clock = before.colwise().sum();
    frames.push_back(frame_of(model, deviations, base, motion, f, clock, track));
    if (!automatic && contacts[f]) frames[f].named = *contacts[f], frames[f].is_named = true;
    const std::vector<Forces> fits = fits_at(model, frames[f], clock, track, automatic);
    likely.push_back(likelihood(track, logs_of(frames[f], fits), interval(f)));
    belief.push_back(posterior(before, likely[f]));
  }
  // backward pass
  MatrixX later = MatrixX::Ones(belief.back().rows(), belief.back().cols());
  for (std::size_t f = count - 1; f-- > 0;) {
    later = (step_over(interval(f + 1)).transpose() * later.cwiseProduct(likely[f + 1])).eval();
    later /= later.sum();
    belief[f] = posterior(belief[f], later);
  }
  // the forces again, as they would be too many to keep
  std::vector<Estimate> out;
  for (std::size_t f = 0; f < count; ++f) {
    const std::vector<Forces> fits = fits_at(model, frames[f], belief[f].colwise().sum(), track, automatic);
    out.push_back(line_of(model, motion.time[f], frames[f], fits, belief[f], track, automatic));
  }
  return out;
}

struct LiveForce::State {
  dynamics::Model model;
  std::vector<dynamics::Model> deviations;
  dynamics::BaseFunction base;
  ContactAt contact;
  Options options;
  chain::States states = {};         // of the last seconds
  std::vector<Clock> clocks = {};    // of the same
  MatrixX belief = {};               // about contact and clock at the last estimate's time; empty before the first
  std::size_t lines = 0, taken = 0;  // numbers of estimates returned and of states received

  // Returns the estimate of state `at` of the window, which ends with the newest state.
  Estimate line(std::size_t at) {
    const bool automatic = !contact;
    const Motion motion = smooth(states, clocks);
    const double time = motion.time[at];
    const Track track = track_of(model.chain, automatic, motion.clock.empty() && belief.cols() <= 1, options);
    if (belief.cols() == 1 && track.clock.size() > 1) belief = (belief * first_clock(track).transpose()).eval();
    const double interval = at > 0 ? time - motion.time[at - 1] : motion.time[at + 1] - time;
    const MatrixX before = belief.size() == 0 ? first_belief(track) : MatrixX(transition(track, interval) * belief);
    const VectorX clock = before.colwise().sum();
    Frame frame = frame_of(model, deviations, base, motion, at, clock, track);
    if (!automatic)
      if (const std::optional<Contact> touched = contact(time, motion.theta[at]))
        frame.named = *touched, frame.is_named = true;
    const std::vector<Forces> fits = fits_at(model, frame, clock, track, automatic);
    belief = posterior(before, likelihood(track, logs_of(frame, fits), interval));
    ++lines;
    return line_of(model, time, frame, fits, belief, track, automatic);
  }
};

LiveForce::LiveForce(dynamics::Model model, std::vector<dynamics::Model> deviations, dynamics::BaseFunction base,
                     ContactAt contact, const Options& options)
    : state_(std::make_unique<State>(
          State{std::move(model), std::move(deviations), std::move(base), std::move(contact), options})) {}

LiveForce::~LiveForce() = default;
LiveForce::LiveForce(LiveForce&&) noexcept = default;
LiveForce& LiveForce::operator=(LiveForce&&) noexcept = default;

std::optional<Estimate> LiveForce::update(double time, const VectorX& theta, const MatrixX& standing,
                                          const Clock& clock) {
  State& live = *state_;
  live.states.time.push_back(time);
  live.states.theta.push_back(theta);
  if (standing.size() > 0) live.states.covariance.push_back(standing);
  live.clocks.push_back(clock);
  ++live.taken;
  // the window keeps the states that the next estimate and the speed before it need
  std::size_t old = 0;
  while (live.states.time.size() - old > kLiveLag + 3 && live.states.time[old] < time - kLiveWindow) ++old;
  live.states.time.erase(live.states.time.begin(), live.states.time.begin() + old);
  live.states.theta.erase(live.states.theta.begin(), live.states.theta.begin() + old);
  if (!live.states.covariance.empty())
    live.states.covariance.erase(live.states.covariance.begin(), live.states.covariance.begin() + old);
  live.clocks.erase(live.clocks.begin(), live.clocks.begin() + old);
  if (live.taken <= kLiveLag) return {};
  return live.line(live.states.time.size() - 1 - kLiveLag);
}

std::vector<Estimate> LiveForce::finish() {
  State& live = *state_;
  std::vector<Estimate> out;
  if (live.taken < 3) return out;
  while (live.lines < live.taken) out.push_back(live.line(live.states.time.size() - (live.taken - live.lines)));
  return out;
}

std::size_t LiveForce::taken() const { return state_->taken; }

}  // namespace chainsplat::force
