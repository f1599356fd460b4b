#include "problem.h"

#include <algorithm>
#include <cmath>

#include "chainsplat/dynamics/rod.h"
#include "src/math/decompositions.h"

namespace chainsplat::identification {

using dynamics::BaseGrid;
using dynamics::Quantity;
using math::Vector3;

namespace {

// Of the length: open-loop error of a few links. Ropes of 0.3 m: 0.1 to 0.5 %; a foam noodle of 1.9 m: 2 %. Larger
// values let the priors hold what two markers cannot tell, smaller ones make the loss rough.
constexpr double kMarkerModelShare = 5e-3;

// Local quadratic over the first frames: angle and velocity at the first time. Returns the standard deviation of one
// velocity, rad/s.
double initial_motion(const chain::States& states, VectorX& theta, VectorX& thetadot) {
  constexpr double kWindow = 0.21;  // s
  std::size_t count = 0;
  while (count < states.time.size() && states.time[count] <= states.time[0] + kWindow) ++count;
  count = std::max<std::size_t>(count, std::min<std::size_t>(3, states.time.size()));
  const int order = count >= 5 ? 2 : 1;
  MatrixX design(count, order + 1);
  MatrixX values(count, states.theta[0].size());
  for (std::size_t k = 0; k < count; ++k) {
    const double t = states.time[k] - states.time[0];
    for (int i = 0; i <= order; ++i) design(k, i) = std::pow(t, i);
    values.row(k) = states.theta[k].transpose();
  }
  const MatrixX fit = design.colPivHouseholderQr().solve(values);
  theta = fit.row(0).transpose();
  thetadot = fit.row(1).transpose();
  // shrink the velocity by its share of noise: a rope at rest seen with noise starts at rest
  const MatrixX residual = values - design * fit;
  const double freedom = std::max<double>(1.0, static_cast<double>(count) - order - 1.0);
  const double unit = (design.transpose() * design).inverse()(1, 1);
  const double noise = residual.squaredNorm() / freedom * unit;
  const double signal = thetadot.squaredNorm();
  if (signal > 0.0 && std::isfinite(noise)) thetadot *= std::max(0.0, signal - noise) / signal;
  return std::sqrt(noise / static_cast<double>(thetadot.size()));
}

}  // namespace

void place_points(const Part& part, const VectorX& theta, MatrixX& points, std::vector<MatrixX>* slopes) {
  const auto motions = chain::link_motions(part.chain, theta, {});
  points.resize(3, part.points.size());
  for (std::size_t i = 0; i < part.points.size(); ++i)
    points.col(i) = motions[part.points[i].link] * part.points[i].home;
  if (slopes)
    *slopes = chain::point_jacobians(part.chain, chain::world_axes(part.chain, theta, {}), motions, part.points);
}

BaseGrid prefix(const Part& part, std::size_t frames, bool fine) {
  BaseGrid grid;
  const auto& nodes = part.grids[fine].nodes;
  grid.nodes.assign(nodes.begin(), nodes.begin() + part.nodes[fine][frames - 1] + 1);
  grid.nodes.back().step = 0.0;
  return grid;
}

std::size_t frames_within(const Part& part, double horizon) {
  std::size_t count = 0;
  while (count < part.times.size() && part.times[count] <= part.times[0] + horizon + 1e-9) ++count;
  return std::clamp<std::size_t>(count, 3, part.times.size());
}

Part make_part(const chain::Chain& chain, const trajectory::Trajectory& base, const chain::States& recognized,
               const Options& options, const Markers* markers) {
  const std::vector<MatrixX>& covariances = recognized.covariance;
  const std::size_t frames = recognized.time.size();
  if (frames < kLeastTimes || recognized.theta.size() != frames)
    throw InputError("identify", std::to_string(frames) + " recognized states", "give at least 3 with their times");
  for (const VectorX& theta : recognized.theta)
    if (theta.size() != chain.angles() || !theta.allFinite())
      throw InputError("identify", "a recognized state is not finite or of another chain", "recognize again");
  CHAINSPLAT_CHECK(covariances.empty() || covariances.size() == frames, std::to_string(covariances.size()));

  Part part{chain, {}, recognized.time, {}, {}, recognized.theta, {}, {}, {}};
  for (std::size_t k = 1; k < frames; ++k)  // angles are known up to whole turns: the nearest to the frame before
    for (Eigen::Index i = 0; i < part.theta[k].size(); ++i)
      part.theta[k][i] -= 2.0 * M_PI * std::round((part.theta[k][i] - part.theta[k - 1][i]) / (2.0 * M_PI));
  part.has_markers = markers != nullptr;
  for (std::size_t k = 0; k < frames; ++k)
    part.direction +=
        dynamics::first_direction(chain, part.theta[k], base.pose(recognized.time[k])) / static_cast<double>(frames);
  if (!markers) part.points = chain::shape_points(chain, true);
  for (std::size_t i = 0; markers && i < markers->arclengths.size(); ++i)
    part.points.push_back(chain::centerline_point(chain, markers->arclengths[i]));
  const std::size_t points = part.points.size();
  std::vector<MatrixX> jacobians, weights;
  for (std::size_t k = 0; k < frames; ++k) {
    if (markers) {
      MatrixX target = MatrixX::Zero(3, points), whitening = MatrixX::Zero(3, 3 * points);
      const math::Pose base_from_world = base.pose(recognized.time[k]).inverse();
      for (std::size_t i = 0; i < points; ++i) {
        const Vector3 seen = markers->world[k].col(i);
        if (!seen.allFinite()) continue;
        target.col(i) = base_from_world * seen;
        whitening.middleCols<3>(3 * i) =
            math::Matrix3::Identity() /
            std::sqrt(kCorrelated * (std::pow(markers->deviation, 2) + std::pow(kMarkerModelShare * chain.length, 2)));
      }
      part.target.push_back(target);
      weights.push_back(whitening);
      continue;
    }
    MatrixX target;
    place_points(part, recognized.theta[k], target, &jacobians);
    // what the model's error of the points is in angles, and the recognized angles' own
    const MatrixX normal = chain::displacement_metric(jacobians);
    const MatrixX unit = MatrixX::Identity(chain.angles(), chain.angles());
    const Eigen::LDLT<MatrixX> by_points(normal);
    MatrixX covariance = kCorrelated * options.model_error * options.model_error * by_points.solve(unit);
    if (!covariances.empty()) covariance += covariances[k];
    const Eigen::LLT<MatrixX> factor(covariance);
    if (!math::is_positive(by_points) || !math::is_positive(factor))
      throw InputError("identify",
                       "the covariance of the angles at " + core::exact(recognized.time[k]) + " s is not positive",
                       "recognize again, or leave the covariances out: the frames then count the same");
    part.target.push_back(target);
    weights.push_back(factor.matrixL().solve(unit));
  }

  part.whitening = std::make_shared<const std::vector<MatrixX>>(std::move(weights));
  VectorX theta, thetadot, theta_sd = VectorX::Constant(chain.angles(), kThetaSd);
  const double thetadot_sd = initial_motion({part.times, part.theta, {}, {}}, theta, thetadot);
  if (!theta.allFinite() || !thetadot.allFinite() || !std::isfinite(thetadot_sd))
    throw InputError("identify", "the first times tell no velocity: they are too near or too far from each other",
                     "give frames of a video");
  if (options.paper) theta = recognized.theta[0];
  if (!covariances.empty()) theta_sd = (covariances[0].diagonal().array() + 0.25 * kThetaSd * kThetaSd).sqrt();
  // Friction soon stops a rope on a table: under a base at rest it is at rest, and what looks like motion is noise. As
  // an unknown its velocity would be worse than idle: where every link comes to a stop, and so the loss, jumps with it.
  constexpr double kBaseAtRest = 0.01;  // m/s and rad/s
  constexpr double kRopeAtRest = 1.0;   // rad/s: dry friction stops that within a frame or two
  constexpr double kSignificant = 4.0;  // standard deviations of a velocity
  const bool at_rest = options.tabletop && !options.paper && base.at(part.times[0]).velocity.norm() < kBaseAtRest &&
                       thetadot.cwiseAbs().maxCoeff() < std::max(kRopeAtRest, kSignificant * thetadot_sd);
  if (at_rest) thetadot.setZero();
  part.start = {theta, thetadot, theta_sd, at_rest ? kAtRestSd : kRateSd};
  part.unknowns = make_unknowns(chain, options, part.start);
  const int substeps = part.unknowns.reference.substeps;
  for (bool fine : {false, true}) {
    BaseGrid& grid = part.grids[fine];
    grid = dynamics::sample_base([&](double t) { return base.at(t); }, recognized.time[0], recognized.time,
                                 fine ? substeps : std::max(1, substeps / 2));
    for (std::size_t i = 0; i < grid.nodes.size(); ++i)
      if (grid.nodes[i].output) part.nodes[fine].push_back(i);
  }
  return part;
}

Problem make_problem(const chain::Chain& chain, std::vector<Part> parts) {
  const Unknowns& first = parts.front().unknowns;
  // an initial state alone is one block, too
  const int theta = first.first(Quantity::theta), shared = theta <= 0 ? first.size() : theta;
  Problem problem{chain, std::move(parts), shared, {}, {}};
  const int own = problem.own();
  const Eigen::Index size = shared + own * static_cast<Eigen::Index>(problem.parts.size());
  problem.mean.resize(size);
  problem.precision = MatrixX::Zero(size, size);
  for (std::size_t i = 0; i < problem.parts.size(); ++i) {
    const Unknowns& u = problem.parts[i].unknowns;  // no prior links the shared ones with an initial state
    const Eigen::Index at = shared + static_cast<Eigen::Index>(i) * own;
    problem.mean.head(shared) = u.mean.head(shared);
    problem.mean.segment(at, own) = u.mean.tail(own);
    problem.precision.topLeftCorner(shared, shared) = u.precision.topLeftCorner(shared, shared);
    problem.precision.block(at, at, own, own) = u.precision.bottomRightCorner(own, own);
  }
  return problem;
}

double rms_of(const Part& part, const chain::States& rollout) {
  double sum = 0.0;
  std::size_t count = 0;
  MatrixX points;
  for (std::size_t k = 0; k < part.times.size(); ++k) {
    place_points(part, rollout.theta[k], points, nullptr);
    const int stop = part.has_markers ? static_cast<int>(points.cols()) : 2 * (part.chain.links() - 1);
    for (int i = part.has_markers ? 0 : 1; i < stop; i += part.has_markers ? 1 : 2) {           // odd: the links' ends
      if (part.has_markers && (*part.whitening)[k].middleCols<3>(3 * i).isZero(0.0)) continue;  // not seen
      ++count;
      sum += (points.col(i) - part.target[k].col(i)).squaredNorm();
    }
  }
  return std::sqrt(sum / static_cast<double>(count));
}

}  // namespace chainsplat::identification
