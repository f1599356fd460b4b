#include "chainsplat/estimation.h"

#include <algorithm>
#include <charconv>
#include <cmath>
#include <cstdio>
#include <iterator>
#include <nlohmann/json.hpp>
#include <numeric>

#include "chainsplat/dynamics/parametrization.h"
#include "chainsplat/image_model.h"
#include "src/estimation/color.h"
#include "src/estimation/setup.h"
#include "src/estimation/start.h"

namespace chainsplat::estimation {

using math::MatrixX;
using math::Pose;
using math::Vector2;
using math::Vector3;
using math::Vector6;
using math::VectorX;

namespace {

constexpr double kFrame = 1.0 / 30.0;  // s, frame interval to which the options' random acceleration refers

// Standard deviations before the first frame, around the motion from rest that the twin predicts.
constexpr double kFirstAngle = 0.15;  // rad
constexpr double kFirstRate = 1.0;    // rad/s
constexpr double kFirstForce = 0.3;   // N per kilogram of rope, for a constant force such as a wrong rest shape causes

// A frame whose innovation exceeds kSurprise times the model's expectation is processed again with the force free to
// change, and so are the following frames, for a while and as long as the estimated force is a share of the rope's
// weight. Where this does not explain the frame either, the rope was struck: a swinging rope that meets a finger loses
// its velocity in one frame, by a force of many times its weight. Such forces act along the rope's path, so that the
// motion that one camera sees determines the motion along its rays, which it does not see.
constexpr double kSurprise = 1.5;
constexpr double kContactMemory = 0.5;  // s
constexpr double kContactForce = 0.05;  // share of the rope's weight

// A hand touches a rope at one place. The place is learned from the force estimated so far: by kPlaceRate per frame,
// with a floor for every link so that the place can move.
constexpr double kPlaceRate = 0.5;
constexpr double kPlaceFloor = 0.005;
// Ridge, as a share of the torques' mean variance, for torques that a force at few places cannot cause.
constexpr double kPlaceRidge = 1e-3;

constexpr double kLongUnseen = 0.5;  // s without a mask, after which the rope counts as lost
// Standard deviations that are added for the search of a lost rope.
constexpr double kLostAngle = 0.5;      // rad
constexpr double kLostRate = 5.0;       // rad/s
constexpr double kNoSmoothness = 1e-9;  // 1/rad^2, because the filter's prior replaces the silhouette fit's own

// Standard deviation of the masks' edge offset, at first and at best, and the number of frames over which it is
// learned.
constexpr double kOffsetDeviation = 0.5, kLeastOffsetDeviation = 0.05;  // px
constexpr double kOffsetFrames = 30.0;

// The masks' shift on a table, where a contact shadow may count as rope: a strip of about a pixel shifts the mask by
// half a pixel. In one camera it changes slowly while the rope lies in constant light.
constexpr double kMaskShift = 0.2;        // px, standard deviation from the shift expected from the edge offset,
constexpr double kLowerSide = 0.8;        // which is this share of the offset, downward; the rest is even on all sides
constexpr double kMaskShiftMemory = 5.0;  // s

constexpr double kUnlike = 0.5;  // likeness of drawn and recorded colors, below which the object is not the rope
// Share of the rope that the masks must show of what they should show: less, and they end too early. The rope would be
// laid double into them, or be turned toward the camera.
constexpr double kShown = 0.7;
constexpr double kLongHidden = 2.0;  // s after which a rope that was never seen whole is followed as it is seen
constexpr int kFirstRounds = 3;      // of masks and setup in turn, in the first frame
// Share of the masks that the rope covers, below which something else is in them, and the rope is sought elsewhere,
// too; there it must cover so much more.
constexpr double kUnexplained = 0.8, kBetter = 0.1;
constexpr double kDoubtAngle = 0.15;  // rad, added to the deviations of a doubtful rope's angles
constexpr double kLongUnlike = 0.2;   // s of such frames, after which the rope counts as lost

constexpr double kLeastColorWeight = 100;  // pixels times channels; fewer carry too little information

constexpr double kLeastVariance = 1e-12;  // rad^2, keeps covariances invertible

// Whether the unknown force is estimated: shifts of the rest angles stand for it only where every joint has stiffness,
// and a twin of another integrator (the paper's) is followed without.
bool identified_shifts(const dynamics::Parameters& parameters) {
  return parameters.integrator == dynamics::Integrator::rodas3 &&
         std::all_of(parameters.stiffness.begin(), parameters.stiffness.end(), [](double k) { return k > 0.0; });
}

// Returns the covariance of the shifts of the rest angles that stand for a random force of `deviation` N on the rope,
// which acts at the links' ends with the shares `place`.
MatrixX shift_covariance(const Filter& filter, const Pose& base, const VectorX& theta, double deviation,
                         const VectorX& place) {
  MatrixX out = chain::displacement_metric(chain::link_end_jacobians(filter.model.chain, theta, base), place);
  out *= deviation * deviation;
  for (int k = 0; k < out.rows(); ++k) {
    out.row(k) /= filter.model.parameters.stiffness[k];
    out.col(k) /= filter.model.parameters.stiffness[k];
  }
  return out;
}

// The estimated force, distributed over the links' ends as filter.place allows, and each end's share in it.
struct FoundForce {
  Vector3 sum = Vector3::Zero();  // N
  VectorX shares;
};

FoundForce found_force(const Filter& filter, const Belief& belief) {
  const int n = filter.model.chain.angles();
  const std::vector<MatrixX> jacobians =
      chain::link_end_jacobians(filter.model.chain, belief.mean.head(n), base_at(filter, belief.time).pose);
  VectorX torque = belief.mean.segment(2 * n, n);
  for (int k = 0; k < n; ++k) torque[k] *= filter.model.parameters.stiffness[k];
  MatrixX covariance = chain::displacement_metric(jacobians, filter.place);
  covariance.diagonal().array() += kPlaceRidge * covariance.trace() / n;
  const VectorX weighted = covariance.ldlt().solve(torque);
  FoundForce out;
  out.shares.resize(filter.place.size());
  for (int i = 0; i < filter.place.size(); ++i) {
    const Vector3 part = filter.place[i] * (jacobians[i] * weighted);
    out.sum += part;
    out.shares[i] = part.squaredNorm();
  }
  const double total = out.shares.sum();
  out.shares = total > 0.0 ? VectorX(out.shares / total) : filter.everywhere;
  return out;
}

// Returns the standard deviation of the centerline in m, RMS over the rope: by the angles' `covariance` and by the
// shape variances, which include directions in which no angle moves a link.
double centerline_deviation(const chain::Chain& chain, const VectorX& theta, const MatrixX& covariance,
                            const std::vector<double>& shape) {
  const std::vector<MatrixX> jacobians = chain::link_end_jacobians(chain, theta, Pose{});
  // a link's end stands for half of each adjacent link
  double variance = 0.0;
  for (std::size_t i = 0; i < jacobians.size(); ++i) {
    const int link = static_cast<int>(i) + 1;
    const double next = link + 1 < chain.links() ? chain.link_end(link + 1) - chain.link_start(link + 1) : 0.0;
    const double share = 0.5 * (chain.link_end(link) - chain.link_start(link) + next) / chain.length;
    variance += share * ((jacobians[i] * covariance * jacobians[i].transpose()).trace() + 3.0 * shape[i]);
  }
  return std::sqrt(variance);
}

// After a frame, learns where the unknown force acts and whether the contact continues.
void learn_force(Filter& filter, double time) {
  if (!filter.shifts) return;
  if (time > filter.contact_until) {
    filter.place = filter.everywhere;
    return;
  }
  const FoundForce found = found_force(filter, *filter.belief);
  filter.place += kPlaceRate * (found.shares - filter.place);
  filter.place.array() += kPlaceFloor;
  filter.place /= filter.place.sum();
  const double weight = filter.model.parameters.gravity.norm() * dynamics::total_mass(filter.model.parameters);
  if (found.sum.norm() > kContactForce * weight)
    filter.contact_until = std::max(filter.contact_until, time + kContactMemory);
}

// Returns, per link, the shift of the rest angles that stands for a blow which stops the link's end in the world: a
// force against the end's velocity throughout the step. `rate_by_shift`: n x n, derivative of the predicted rates.
std::vector<VectorX> stopping_shifts(const Filter& filter, const trajectory::BaseMotion& base, const VectorX& theta,
                                     const VectorX& thetadot, const MatrixX& rate_by_shift) {
  const chain::Chain& chain = filter.model.chain;
  const std::vector<MatrixX> jacobians = chain::link_end_jacobians(chain, theta, base.pose);
  const MatrixX nodes = chain::nodes(chain, chain::link_motions(chain, theta, base.pose));
  std::vector<VectorX> shifts;
  for (std::size_t i = 0; i < jacobians.size(); ++i) {
    // the end's velocity in the world: by the rates and by the base
    const Vector3 from_base = base.pose.inverse() * Vector3(nodes.col(i + 2));
    const Vector3 carried = base.pose.rotation * (base.velocity.tail<3>() + base.velocity.head<3>().cross(from_base));
    const Vector3 velocity = jacobians[i] * thetadot + carried;
    VectorX shift = jacobians[i].transpose() * velocity;  // by a force of as many N as the velocity has m/s
    for (int k = 0; k < shift.size(); ++k) shift[k] /= filter.model.parameters.stiffness[k];
    const double taken = velocity.dot(jacobians[i] * (rate_by_shift * shift));  // (m/s)^2, change along the velocity
    shifts.push_back(taken > 0.0 ? VectorX(-velocity.squaredNorm() / taken * shift) : VectorX(0.0 * shift));
  }
  return shifts;
}

// Returns the expected shift of each camera's masks, px in x and y. A camera above the table sees the rope's contact
// with it, and the shadow there, on the rope's lower side, so that a mask that is too wide is too wide on that side.
VectorX expected_mask_shifts(const Filter& filter, double time) {
  VectorX out(2 * filter.cameras.size());
  const Pose base = base_at(filter, time).pose;
  const double step = filter.model.chain.diameter;
  for (std::size_t c = 0; c < filter.cameras.size(); ++c) {
    const capture::Camera& camera = filter.cameras[c];
    const Vector3 below = base.translation - step * *filter.table_normal;
    const Pose camera_from_world = camera.world_from_camera.inverse();
    const Vector3 a = camera_from_world * base.translation, b = camera_from_world * below;
    Vector2 down = Vector2::Zero();
    if (std::min(a.z(), b.z()) > 0.0) down = capture::project(camera, b) - capture::project(camera, a);
    // px; dividing by at least the radius lets the shift vanish for a camera right above, which sees no lower side
    const double radius = 0.5 * step * camera.fx / std::max(a.z(), step);
    out.segment<2>(2 * c) = kLowerSide * filter.edge_offset * down / std::max(down.norm(), radius);
  }
  return out;
}

void symmetrize(MatrixX& matrix) { matrix = (0.5 * (matrix + matrix.transpose())).eval(); }

// The mean of a belief moved in time, and its derivatives with respect to the mean before.
struct Motion {
  VectorX theta, thetadot;
  MatrixX theta_by_state, thetadot_by_state;  // n x 3 n
};

Motion move(const Filter& filter, const Belief& belief, double time) {
  const int n = filter.model.chain.angles();
  const double h = time - belief.time;
  Motion out;
  // by the dynamics and their sensitivities
  if (filter.identified) {
    dynamics::Model model = filter.model;
    for (int k = 0; k < n; ++k) model.parameters.rest_angle[k] += belief.mean[2 * n + k];
    std::vector<dynamics::Unknown> unknowns = dynamics::initial_state_unknowns(model.chain);
    for (int k = 0; filter.shifts && k < n; ++k) unknowns.push_back({dynamics::Quantity::rest_angle, k});
    const std::vector<dynamics::Tangent> tangents = dynamics::tangents(model.chain, model.parameters, unknowns);
    const dynamics::BaseGrid grid = dynamics::sample_base([&](double t) { return base_at(filter, t); }, belief.time,
                                                          {time}, model.parameters.substeps);
    chain::States states;
    dynamics::Sensitivities sensitivities;
    const VectorX theta = belief.mean.head(n), thetadot = belief.mean.segment(n, n);
    const dynamics::InitialState now{belief.time, theta, thetadot,
                                     dynamics::internal_state_in_motion(model, theta, thetadot)};
    if (dynamics::simulate(model, grid, now, states, tangents, &sensitivities)) {
      out.theta = states.theta.back();
      out.thetadot = states.thetadot.back();
      out.theta_by_state = MatrixX::Zero(n, 3 * n);
      out.thetadot_by_state = MatrixX::Zero(n, 3 * n);
      out.theta_by_state.leftCols(unknowns.size()) = sensitivities.theta.back();
      out.thetadot_by_state.leftCols(unknowns.size()) = sensitivities.thetadot.back();
      return out;
    }
  }
  // at constant rate, without dynamics or where their integration failed
  out.theta = belief.mean.head(n) + h * belief.mean.segment(n, n);
  out.thetadot = belief.mean.segment(n, n);
  out.theta_by_state = MatrixX::Zero(n, 3 * n);
  out.theta_by_state.leftCols(n).setIdentity();
  out.theta_by_state.middleCols(n, n) = h * MatrixX::Identity(n, n);
  out.thetadot_by_state = MatrixX::Zero(n, 3 * n);
  out.thetadot_by_state.middleCols(n, n).setIdentity();
  return out;
}

struct Measured {
  silhouette::FrameFit fit;
  Belief belief;          // posterior
  double surprise = 0.0;  // squared innovation over its expectation
};

// Updates `predicted` with the views' silhouettes. Only a share of the fit's variance is independent of earlier frames:
// the prior is tightened in proportion, which gives the same angles as weakening the data, and the covariance is
// widened again.
Measured measure(const Filter& filter, const Belief& predicted, std::span<const capture::View* const> views,
                 bool warm) {
  const int n = filter.model.chain.angles();
  const double share = filter.options.new_share;
  // the part of the state that is fitted: the angles and the shifts of these views' masks
  std::vector<int> fitted(n);
  std::iota(fitted.begin(), fitted.end(), 0);
  for (std::size_t v = 0; predicted.mean.size() > 3 * n && v < views.size(); ++v)
    for (const int axis : {0, 1}) fitted.push_back(3 * n + 2 * views[v]->camera + axis);
  const VectorX expected = predicted.mean(fitted);
  const MatrixX prior = predicted.covariance(fitted, fitted);
  const Eigen::LLT<MatrixX> factor(prior);
  if (!math::is_positive(factor))
    throw WorkError("estimate", "the predicted covariance at " + core::exact(predicted.time) + " s is not positive",
                    "check the twin's parameters and the base motion about that time");
  const MatrixX information = factor.solve(MatrixX::Identity(prior.rows(), prior.rows()));
  silhouette::Options options = filter.options.silhouette;
  options.joint_smoothness = kNoSmoothness;
  options.prior.mean = expected;
  options.prior.information = information / share;
  options.edge_offset = filter.edge_offset;
  options.edge_offset_deviation = std::sqrt(filter.edge_offset_variance);
  const double time = views.front()->time;

  Measured out;
  // fit, and compare the innovation with its expectation
  out.fit = silhouette::fit_frame(filter.model.chain, base_at(filter, time).pose, views, filter.cameras,
                                  predicted.mean.head(n), warm, options);
  MatrixX posterior = out.fit.covariance / share;
  symmetrize(posterior);
  VectorX found = expected;
  found.head(n) = out.fit.theta;
  found.tail(out.fit.mask_shift.size()) = out.fit.mask_shift;
  const VectorX change = found - expected;
  const double freedom = static_cast<double>(change.size()) - (information * posterior).trace();
  out.surprise = change.dot(information * change) / std::max(1.0, freedom);

  // rates and rest angles follow by their correlation with the fitted part
  const MatrixX gain = predicted.covariance(Eigen::all, fitted) * information;
  out.belief.time = time;
  out.belief.mean = predicted.mean + gain * change;
  out.belief.mean(fitted) = found;
  out.belief.covariance = predicted.covariance - gain * (prior - posterior) * gain.transpose();
  symmetrize(out.belief.covariance);
  out.belief.covariance.diagonal().array() += kLeastVariance;
  return out;
}

// Updates the belief with the colors inside the masks. The drawn rope must be within a stripe's width of the real one.
void look_at_colors(const Filter& filter, std::span<const capture::View* const> views, Belief& belief, Estimate& out) {
  const chain::Chain& chain = filter.model.chain;
  const int n = chain.angles();
  const Belief before = belief;
  const MatrixX by_angles = before.covariance.leftCols(n);
  std::vector<const capture::View*> shown;
  std::copy_if(views.begin(), views.end(), std::back_inserter(shown),
               [](const capture::View* view) { return view->width > 0 && view->height > 0; });
  // Gauss-Newton steps on the sum of the views' normal equations and the belief as prior
  for (int step = 0; step < filter.options.color_steps; ++step) {
    const VectorX theta = belief.mean.head(n);
    MatrixX information = MatrixX::Zero(n, n);
    VectorX right = VectorX::Zero(n);
    double weight = 0.0, square = 0.0;
    std::vector<std::vector<Pose>> motions;
    for (const capture::View* const view : shown)
      motions.push_back(chain::link_motions(chain, theta, base_at(filter, view->time).pose));
    const std::vector<splat::ColorSums> sums = filter.compare_colors(shown, motions);
    for (std::size_t v = 0; v < shown.size(); ++v) {
      const ColorEquations e = color_equations(chain, base_at(filter, shown[v]->time).pose, theta, sums[v]);
      if (e.weight < kLeastColorWeight || !(e.square > 0.0)) continue;
      const double scale = filter.options.color_share * e.weight / e.square;  // over this view's residual variance
      information += scale * e.normal;
      right += scale * e.right;
      if (e.likeness) out.likeness = std::max(out.likeness.value_or(-1.0), *e.likeness);
      weight += e.weight;
      square += e.square;
      out.gain = e.gain;
      out.bias = e.bias;
    }
    if (weight == 0.0) return;
    out.color_residual = std::sqrt(square / weight);
    right += information * (before.mean.head(n) - theta);  // linearized at theta, relative to the prior mean
    const MatrixX inverse = (MatrixX::Identity(n, n) + information * before.covariance.topLeftCorner(n, n)).inverse();
    belief.mean = before.mean - by_angles * (inverse * right);
    belief.covariance = before.covariance - by_angles * (inverse * information) * by_angles.transpose();
    symmetrize(belief.covariance);
    belief.covariance.diagonal().array() += kLeastVariance;
  }
}

// Rounds to nine digits, because most of a line is its covariance.
double rounded(double value) {
  char text[32];
  const int size = std::snprintf(text, sizeof text, "%.9g", value);
  std::from_chars(text, text + size, value);
  return value;
}

// Image area of the tube, px, every link by itself: where the chain lies on itself it counts twice. `wider`: px on each
// side.
double tube_area(const chain::Chain& chain, const Pose& base, const VectorX& theta, const capture::Camera& camera,
                 double wider) {
  const MatrixX nodes = chain::nodes(chain, chain::link_motions(chain, theta, base));
  const Pose camera_from_world = camera.world_from_camera.inverse();
  double area = 0.0;
  for (Eigen::Index i = 0; i + 1 < nodes.cols(); ++i) {
    const Vector3 a = camera_from_world * Vector3(nodes.col(i)), b = camera_from_world * Vector3(nodes.col(i + 1));
    if (std::min(a.z(), b.z()) < image_model::kNear) continue;
    const double width = chain.diameter * (camera.fx + camera.fy) / (a.z() + b.z()) + 2.0 * wider;
    area += width * (capture::project(camera, b) - capture::project(camera, a)).norm();
  }
  return area;
}

// The masks' area over that of the tube at theta, in the view where it is most: a rope may point at one camera or cross
// itself there, but not in all views.
double shown_share(const Filter& filter, std::span<const capture::View* const> views, const VectorX& theta,
                   double edge_offset) {
  double most = 0.0;
  for (const capture::View* const view : views) {
    int pixels = 0;
    for (std::size_t i = 3; i < view->rgba.size(); i += 4) pixels += view->rgba[i] >= image_model::kObjectMask;
    const double tube = tube_area(filter.model.chain, base_at(filter, view->time).pose, theta,
                                  filter.cameras.at(view->camera), edge_offset);
    if (tube > 0.0) most = std::max(most, pixels / tube);
  }
  return most;
}

// The share of the masks that is not the rope's: what lies apart from a rope that is seen nearly whole.
double foreign_share(const silhouette::FrameFit& fit) { return fit.inside >= kUnexplained ? fit.foreign : 0.0; }

bool explains(const silhouette::FrameFit& fit) {
  return fit.covered >= kLostShare * (1.0 - foreign_share(fit)) && fit.theta.allFinite();
}

// Whether there is something in the masks that cannot be told from the rope.
bool has_more(const silhouette::FrameFit& fit) { return fit.covered < kUnexplained * (1.0 - foreign_share(fit)); }

}  // namespace

Options options_for_live_masks(bool tabletop) {
  Options options;
  if (tabletop) return options;
  // with the usual shares a pushed rope in free space was lost
  options.new_share = 0.1;
  options.color_share = 0.01;
  return options;
}

Filter start(const twin::Twin& twin, const std::vector<capture::Camera>& cameras, dynamics::BaseFunction base,
             double base_start, const Options& options, const std::vector<char>& unverified) {
  Filter filter;
  filter.identified = twin.parameters.has_value();
  if (filter.identified) {
    filter.model = dynamics::make_model(twin.chain, *twin.parameters);
    filter.shifts = identified_shifts(*twin.parameters);
    // sensitivities come from the variational equation of this integrator only
    filter.model.parameters.integrator = dynamics::Integrator::rodas3;
  } else {
    filter.model.chain = twin.chain;
  }
  filter.everywhere = VectorX::Constant(twin.chain.links() - 1, 1.0 / (twin.chain.links() - 1));
  filter.place = filter.everywhere;
  filter.cameras = cameras;
  filter.base = std::move(base);
  filter.base_start = base_start;
  filter.options = options;
  if (twin.tabletop) filter.table_normal = twin.table_normal.value_or(Vector3::UnitZ()).normalized();
  filter.edge_offset_variance = kOffsetDeviation * kOffsetDeviation;
  filter.setup = first_setup(filter, unverified);
  if (twin.tabletop || !filter.identified) {
    filter.rest = twin.initial                ? twin.initial->theta
                  : twin.states.theta.empty() ? VectorX::Zero(twin.chain.angles())
                                              : twin.states.theta.front();
  } else {
    filter.rest = dynamics::static_equilibrium(filter.model, base_at(filter, base_start).pose).theta;
  }
  return filter;
}

Belief first_belief(const Filter& filter, double time) {
  const int n = filter.model.chain.angles();
  const int size = 3 * n + (filter.table_normal ? 2 * static_cast<int>(filter.cameras.size()) : 0);
  Belief belief;
  belief.time = time;
  belief.mean = VectorX::Zero(size);
  belief.mean.head(n) = filter.rest;
  // the mean by simulation from rest, where the dynamics are known
  if (filter.identified && filter.base_start < time) {
    const dynamics::BaseGrid grid = dynamics::sample_base([&](double t) { return base_at(filter, t); },
                                                          filter.base_start, {time}, filter.model.parameters.substeps);
    chain::States states;
    if (dynamics::simulate(filter.model, grid, filter.rest, VectorX::Zero(n), states)) {
      belief.mean.head(n) = states.theta.back();
      belief.mean.segment(n, n) = states.thetadot.back();
    }
  }
  // a wide covariance around it
  belief.covariance = MatrixX::Zero(size, size);
  belief.covariance.diagonal().head(n).setConstant(kFirstAngle * kFirstAngle);
  belief.covariance.diagonal().segment(n, n).setConstant(kFirstRate * kFirstRate);
  if (filter.shifts)
    belief.covariance.block(2 * n, 2 * n, n, n) =
        shift_covariance(filter, base_at(filter, time).pose, belief.mean.head(n),
                         kFirstForce * dynamics::total_mass(filter.model.parameters), filter.everywhere);
  belief.covariance.diagonal().tail(size - 3 * n).setConstant(kMaskShift * kMaskShift);
  belief.covariance.diagonal().array() += kLeastVariance;
  return belief;
}

bool has_mask(const capture::View& view) {
  for (std::size_t i = 3; i < view.rgba.size(); i += 4)
    if (view.rgba[i] >= image_model::kObjectMask) return true;
  return false;
}

Belief predict(const Filter& filter, const Belief& belief, double time, Contact contact) {
  const int n = filter.model.chain.angles();
  const double h = time - belief.time;
  const bool touched = contact != Contact::none;
  CHAINSPLAT_CHECK(h > 0.0, std::to_string(h));
  const Motion motion = move(filter, belief, time);
  const double keep = std::exp(-h / filter.options.force_memory);

  const double keep_mask_shift = std::exp(-h / kMaskShiftMemory);

  // move mean and covariance; forces decay, and mask shifts return to their expectation
  const Eigen::Index size = belief.mean.size();
  MatrixX transition = MatrixX::Zero(size, size);
  transition.topLeftCorner(n, 3 * n) = motion.theta_by_state;
  transition.block(n, 0, n, 3 * n) = motion.thetadot_by_state;
  transition.diagonal().segment(2 * n, n).setConstant(keep);
  transition.diagonal().tail(size - 3 * n).setConstant(keep_mask_shift);
  Belief out;
  out.time = time;
  out.mean.resize(size);
  out.mean << motion.theta, motion.thetadot, keep * belief.mean.segment(2 * n, n),
      keep_mask_shift * belief.mean.tail(size - 3 * n);
  if (size > 3 * n) out.mean.tail(size - 3 * n) += (1.0 - keep_mask_shift) * expected_mask_shifts(filter, time);
  out.covariance = transition * belief.covariance * transition.transpose();
  out.covariance.diagonal().tail(size - 3 * n).array() +=
      kMaskShift * kMaskShift * (1.0 - keep_mask_shift * keep_mask_shift);
  // add the random walk of the force, and the blows that stop a link's end
  if (filter.shifts) {
    const double force = (touched ? filter.options.contact_force : filter.options.model_force) *
                         dynamics::total_mass(filter.model.parameters) * std::sqrt(h);
    const MatrixX shift = shift_covariance(filter, base_at(filter, time).pose, motion.theta, force,
                                           touched ? filter.place : filter.everywhere);
    // the force changes during the step: in the mean square a third of the change acts throughout
    MatrixX noise = transition.middleCols(2 * n, n);
    noise.topRows(2 * n) *= std::sqrt(1.0 / 3.0);
    noise.middleRows(2 * n, n).setIdentity();
    out.covariance += noise * shift * noise.transpose();
    if (contact == Contact::struck) {
      const std::vector<VectorX> stops = stopping_shifts(filter, base_at(filter, time), motion.theta, motion.thetadot,
                                                         motion.thetadot_by_state.rightCols(n));
      for (std::size_t i = 0; i < stops.size(); ++i) {
        VectorX blow = std::sqrt(filter.place[i]) * (transition.block(0, 2 * n, 2 * n, n) * stops[i]);
        out.covariance.topLeftCorner(2 * n, 2 * n) += blow * blow.transpose();
        // at a random time of the step it changes the angles by h/2 times the rates' change, give or take sqrt(1/3) of
        // it
        blow.head(n) *= std::sqrt(1.0 / 3.0);
        out.covariance.topLeftCorner(n, n) += blow.head(n) * blow.head(n).transpose();
      }
    }
  }
  // add an acceleration that is independent in every frame
  const bool explained = filter.identified && (filter.shifts || !touched);
  const double a = explained ? filter.options.acceleration : filter.options.blind_acceleration;
  const double rate = a * a * h * kFrame;
  for (int k = 0; k < n; ++k) {
    out.covariance(k, k) += rate * h * h / 3.0;
    out.covariance(k, n + k) += rate * h / 2.0;
    out.covariance(n + k, k) += rate * h / 2.0;
    out.covariance(n + k, n + k) += rate;
  }
  symmetrize(out.covariance);
  out.covariance.diagonal().array() += kLeastVariance;
  return out;
}

std::optional<VectorX> expected(const Filter& filter, double time) {
  if (!filter.belief || filter.lost) return std::nullopt;
  const int n = filter.model.chain.angles();
  if (time <= filter.belief->time) return filter.belief->mean.head(n);
  return move(filter, *filter.belief, time).theta;
}

trajectory::BaseMotion base_at(const Filter& filter, double time) {
  return corrected(filter.base, base_correction(filter.setup), time);
}

namespace {

struct Attempt {
  Belief predicted;
  Measured measured;
};

// Predicts and measures; where the model does not explain the frame, again with a force that may change, and then with
// a blow; where the masks are not explained, or not all of them, from a wide belief.
Attempt measure_frame(Filter& filter, Belief predicted, std::span<const capture::View* const> views) {
  const double time = views.front()->time;
  const bool first = !filter.belief, in_contact = time <= filter.contact_until;
  const auto surprising = [](const Measured& m) { return m.surprise > kSurprise || !explains(m.fit); };
  Attempt out{std::move(predicted), {}};
  out.measured = measure(filter, out.predicted, views, !first);
  if (!first && surprising(out.measured)) {
    filter.contact_until = time + kContactMemory;
    const auto try_with = [&](Contact contact) {
      out.predicted = predict(filter, *filter.belief, time, contact);
      out.measured = measure(filter, out.predicted, views, true);
    };
    if (!in_contact) try_with(Contact::touched);
    if (filter.shifts && surprising(out.measured)) try_with(Contact::struck);
  }
  if (!explains(out.measured.fit) || has_more(out.measured.fit)) {
    const int n = filter.model.chain.angles();
    Belief wide = first_belief(filter, time);
    wide.covariance.diagonal().head(n).array() += kLostAngle * kLostAngle;
    wide.covariance.diagonal().segment(n, n).array() += kLostRate * kLostRate;
    Measured again = measure(filter, wide, views, false);
    if (explains(again.fit) && again.fit.covered > out.measured.fit.covered + kBetter) out.measured = std::move(again);
  }
  return out;
}

// Whether the frame is believed: its masks are explained, and by a rope that is seen as a whole.
bool judge(Filter& filter, std::span<const capture::View* const> views, const Attempt& attempt, Estimate& out) {
  const silhouette::FrameFit& fit = attempt.measured.fit;
  out.lost = !explains(fit);
  out.residual = fit.residual_pixels;
  out.surprise = attempt.measured.surprise;
  const bool folded =
      shown_share(filter, views, fit.theta, fit.edge_offset) * fit.covered < kShown * std::max(fit.inside, kLostShare);
  // a first mask that shows less rope than there is must not be believed: any shape that fits it is wrong
  const int n = filter.model.chain.angles();
  if (!filter.whole && !out.lost && !folded)
    filter.whole = shown_share(filter, views, attempt.predicted.mean.head(n), filter.edge_offset) > kShown;
  if (!filter.whole && filter.hidden_since == kNever) filter.hidden_since = out.time;
  const bool hidden = !filter.whole && out.time - filter.hidden_since < kLongHidden;
  out.doubtful = !filter.whole || folded || has_more(fit);
  const bool believed = !out.lost && !folded && !hidden;
  if (!out.lost && !believed) filter.last_like = filter.last_seen = out.time;  // something of the rope is there
  return believed;
}

// Takes state, colors, force, clock and the masks' edge offset from a frame that is explained.
void learn(Filter& filter, std::span<const capture::View* const> views, const Attempt& attempt, bool first,
           Estimate& out) {
  filter.last_seen = out.time;
  filter.belief = attempt.measured.belief;
  if (filter.compare_colors) look_at_colors(filter, views, *filter.belief, out);
  if (first || out.likeness.value_or(1.0) >= kUnlike) filter.last_like = out.time;
  learn_force(filter, out.time);
  learn_setup(filter, views, attempt.predicted, attempt.measured.fit.theta);
  const double gain = 1.0 / kOffsetFrames;
  filter.edge_offset += gain * (attempt.measured.fit.edge_offset - filter.edge_offset);
  filter.edge_offset_variance =
      std::max(kLeastOffsetDeviation * kLeastOffsetDeviation, filter.edge_offset_variance * (1.0 - gain));
}

// What is believed, with the uncertainty of the model's shape.
void report(const Filter& filter, std::span<const capture::View* const> views, Estimate& out) {
  const int n = filter.model.chain.angles();
  out.base = base_correction(filter.setup);
  out.theta = filter.belief->mean.head(n);
  out.thetadot = filter.belief->mean.segment(n, n);
  out.covariance = filter.belief->covariance.topLeftCorner(2 * n, 2 * n);
  if (out.doubtful) out.covariance.diagonal().head(n).array() += kDoubtAngle * kDoubtAngle;
  std::vector<double> shape = chain::shape_variances(filter.model.chain, out.theta);
  out.covariance.topLeftCorner(n, n) += filter.setup.angles;
  out.centerline_sigma = centerline_deviation(filter.model.chain, out.theta, out.covariance.topLeftCorner(n, n), shape);
  out.covariance.topLeftCorner(n, n) += chain::shape_covariance(filter.model.chain, shape, out.theta);
  for (const capture::View* const v : views)
    out.iou +=
        tube_iou(filter.model.chain, base_at(filter, out.time).pose, out.theta, *v, filter.cameras.at(v->camera)) /
        static_cast<double>(views.size());
}

}  // namespace

Estimate update(Filter& filter, std::span<const capture::View* const> views) {
  CHAINSPLAT_CHECK(!views.empty(), "no view");
  const capture::View& view = *views.front();
  const bool first = !filter.belief;
  Belief predicted = first ? first_belief(filter, view.time)
                           : predict(filter, *filter.belief, view.time,
                                     view.time <= filter.contact_until ? Contact::touched : Contact::none);
  if (first) filter.last_seen = view.time;

  Estimate out;
  out.frame = view.frame;
  out.time = view.time;
  out.seen = std::any_of(views.begin(), views.end(), [](const capture::View* v) { return has_mask(*v); });
  bool believed = false;
  if (out.seen) {
    Attempt attempt = measure_frame(filter, predicted, views);
    // at first masks of cameras that are off bend the rope toward them; where they stand is learned from these, and
    // counts once
    for (int round = 0; first && round < kFirstRounds && explains(attempt.measured.fit); ++round) {
      const Setup before = filter.setup;
      learn_setup(filter, views, attempt.predicted, attempt.measured.fit.theta);
      filter.setup.information = before.information;
      filter.setup.right = before.right;
      filter.setup.frames = before.frames;
      attempt = measure_frame(filter, predicted, views);
    }
    believed = judge(filter, views, attempt, out);
    if (believed) learn(filter, views, attempt, first, out);
    predicted = attempt.predicted;
  }
  if (!believed) {
    filter.belief = std::move(predicted);
    out.lost = out.lost || view.time - filter.last_seen > kLongUnseen;
  } else if (view.time - filter.last_like > kLongUnlike) {  // search again where the twin alone would be
    filter.belief = first_belief(filter, view.time);
    out.lost = true;
  }
  out.doubtful = !out.lost && (out.doubtful || out.likeness.value_or(1.0) < kUnlike);
  out.settling = view.time < filter.setup.settling_until;
  filter.setup.last = view.time;
  if (out.lost) filter.whole = false, filter.hidden_since = kNever;
  filter.lost = out.lost;
  report(filter, views, out);
  return out;
}

double tube_iou(const chain::Chain& chain, const Pose& base, const VectorX& theta, const capture::View& view,
                const capture::Camera& camera) {
  // project the nodes, and bound the tube and the mask
  const MatrixX nodes = chain::nodes(chain, chain::link_motions(chain, theta, base));
  const Pose camera_from_world = camera.world_from_camera.inverse();
  const double focal = 0.5 * (camera.fx + camera.fy);
  struct Point {
    Vector2 pixel;
    double radius;  // px
  };
  std::vector<Point> points;
  double x0 = view.x0, y0 = view.y0, x1 = view.x0 + view.width, y1 = view.y0 + view.height;
  for (int i = 0; i < nodes.cols(); ++i) {
    const Vector3 x = camera_from_world * Vector3(nodes.col(i));
    if (x.z() < image_model::kNear) return 0.0;
    points.push_back({capture::project(camera, x), 0.5 * chain.diameter * focal / x.z()});
    x0 = std::min(x0, points.back().pixel.x() - points.back().radius);
    y0 = std::min(y0, points.back().pixel.y() - points.back().radius);
    x1 = std::max(x1, points.back().pixel.x() + points.back().radius);
    y1 = std::max(y1, points.back().pixel.y() + points.back().radius);
  }
  const int left = std::max(0, static_cast<int>(std::floor(x0))), top = std::max(0, static_cast<int>(std::floor(y0)));
  const int right = std::min(camera.width, static_cast<int>(std::ceil(x1)));
  const int bottom = std::min(camera.height, static_cast<int>(std::ceil(y1)));
  if (right <= left || bottom <= top) return 0.0;
  const int width = right - left, height = bottom - top;
  // mark the pixels within each segment's radius; joints are round
  std::vector<char> tube(static_cast<std::size_t>(width) * height, 0);
  for (std::size_t i = 0; i + 1 < points.size(); ++i) {
    const Point &a = points[i], &b = points[i + 1];
    const Vector2 step = b.pixel - a.pixel;
    const double length2 = step.squaredNorm();
    if (length2 <= 0.0) continue;
    const bool last = i + 2 == points.size();  // its end, the free end, is flat
    const double reach = std::max(a.radius, b.radius);
    const int ax = std::max(left, static_cast<int>(std::min(a.pixel.x(), b.pixel.x()) - reach));
    const int bx = std::min(right - 1, static_cast<int>(std::max(a.pixel.x(), b.pixel.x()) + reach));
    const int ay = std::max(top, static_cast<int>(std::min(a.pixel.y(), b.pixel.y()) - reach));
    const int by = std::min(bottom - 1, static_cast<int>(std::max(a.pixel.y(), b.pixel.y()) + reach));
    for (int y = ay; y <= by; ++y)
      for (int x = ax; x <= bx; ++x) {
        const Vector2 p(x + 0.5, y + 0.5);
        double t = (p - a.pixel).dot(step) / length2;
        if ((last && t > 1.0) || (i == 0 && t < 0.0)) continue;
        t = std::clamp(t, 0.0, 1.0);
        const double radius = a.radius + t * (b.radius - a.radius);
        if ((p - a.pixel - t * step).squaredNorm() <= radius * radius)
          tube[static_cast<std::size_t>(y - top) * width + x - left] = 1;
      }
  }
  // compare with the mask
  long both = 0, either = 0;
  for (int y = top; y < bottom; ++y)
    for (int x = left; x < right; ++x) {
      const int u = x - view.x0, v = y - view.y0;
      const bool in_mask = u >= 0 && v >= 0 && u < view.width && v < view.height &&
                           view.rgba[4 * (static_cast<std::size_t>(v) * view.width + u) + 3] >= image_model::kObjectMask;
      const bool in_tube = tube[static_cast<std::size_t>(y - top) * width + x - left] != 0;
      both += in_mask && in_tube;
      either += in_mask || in_tube;
    }
  return either > 0 ? static_cast<double>(both) / either : 0.0;
}

const char* status(const Estimate& estimate) {
  return estimate.lost ? "lost" : estimate.doubtful ? "doubtful" : "following";
}

std::string to_json(const Estimate& estimate, double latency, bool rates) {
  using Json = nlohmann::ordered_json;
  const auto list = [](const VectorX& values) { return Json(std::vector<double>(values.begin(), values.end())); };
  const int n = static_cast<int>(estimate.theta.size());
  Json covariance = Json::array();
  const Eigen::Index rows = std::min<Eigen::Index>(estimate.covariance.rows(), rates ? 2 * n : n);
  for (Eigen::Index row = 0; row < rows; ++row)
    for (Eigen::Index column = 0; column <= row; ++column)
      covariance.push_back(rounded(estimate.covariance(row, column)));
  VectorX variance;  // none by Adam
  if (estimate.covariance.size() > 0) variance = estimate.covariance.diagonal().head(n);
  const Json line{{"frame", estimate.frame},
                  {"time", estimate.time},
                  {"theta", list(estimate.theta)},
                  {"thetadot", list(estimate.thetadot)},
                  {"sigma", list(variance.cwiseSqrt())},
                  {"centerline_sigma", rows > 0 ? Json(estimate.centerline_sigma) : Json()},
                  {"iou", estimate.iou},
                  {"residual", estimate.residual},
                  {"color_residual", estimate.color_residual},
                  {"surprise", estimate.surprise},
                  {"covariance", std::move(covariance)},
                  {"lost", estimate.lost},
                  {"status", status(estimate)},
                  {"base_late", estimate.base.late},
                  {"grasp_rotation", list(math::log_so3(estimate.base.grasp.rotation))},
                  {"grasp_shift", list(estimate.base.grasp.translation)},
                  {"settling", estimate.settling},
                  {"latency_ms", std::round(1e6 * latency) / 1e3}};
  return line.dump();
}

}  // namespace chainsplat::estimation
