#include "chainsplat/adaptation.h"

#include <algorithm>
#include <cmath>

#include "chainsplat/dynamics/parametrization.h"
#include "src/math/decompositions.h"

namespace chainsplat::adaptation {
namespace {

constexpr double kRateSd = 1.0;   // rad/s, of the first frame's rates
constexpr int kMaxRejected = 5;   // frames in a row, after which the state starts anew
constexpr double kMaxStep = 0.3;  // of a log in one frame: beyond, the linearization is worthless

MatrixX symmetric(const MatrixX& m) { return 0.5 * (m + m.transpose()); }

}  // namespace

struct ParameterFilter::Belief {
  // what does not change
  chain::Chain chain;
  dynamics::Parameters first;
  dynamics::Estimates known;
  Options options;
  std::vector<Eigen::Index> places;         // of the parameters among the estimates
  std::vector<dynamics::Unknown> unknowns;  // those
  VectorX expected;                         // variance when all is forgotten

  // what is believed
  dynamics::Parameters now;
  VectorX change;      // of the parameters since the start
  MatrixX covariance;  // of (theta, thetadot, change)
  VectorX theta, thetadot;
  double time = 0.0;
  bool started = false;
  int used = 0, left_out = 0, restarts = 0, rejected_in_a_row = 0;

  VectorX sigma_of(const Observation& seen) const;
  void start(const Observation& seen);
  void forget(double interval);
  bool predict(double later, const dynamics::BaseFunction& base);
  bool observe(const Observation& seen, const dynamics::BaseFunction& base);
};

ParameterFilter::~ParameterFilter() = default;

ParameterFilter::ParameterFilter(const chain::Chain& chain, const dynamics::Parameters& parameters,
                                 const dynamics::Estimates& estimates, const Options& options)
    : belief_(std::make_unique<Belief>()) {
  const auto size = static_cast<Eigen::Index>(estimates.names.size());
  if (size == 0 || !math::is_covariance(estimates.covariance) || estimates.covariance.rows() != size)
    throw InputError("`online`", "the twin knows no covariance of its parameters", "identify it first");
  if (!(options.memory > 0.0)) throw InputError("`memory`", "is not above 0", "give seconds, for example 5");
  const std::vector<dynamics::Unknown> all = dynamics::unknowns_of(chain, estimates);
  const std::vector<Eigen::Index> places = dynamics::parameters_among(all);
  if (places.empty()) throw InputError("`online`", "the twin has no parameter to adapt", "identify it first");
  Belief& b = *belief_;
  b.chain = chain, b.known = estimates, b.options = options, b.places = places;
  b.now = parameters;
  // a diverging sensitivity of the Euler step is no use here: the variational equation needs RODAS3
  b.now.integrator = dynamics::Integrator::rodas3;
  b.first = b.now;

  const int n = chain.angles();
  const auto count = static_cast<Eigen::Index>(places.size());
  b.change = VectorX::Zero(count);
  b.expected.resize(count);
  for (Eigen::Index i = 0; i < count; ++i) {
    b.unknowns.push_back(all[places[i]]);
    const double sd = options.spread * dynamics::scale_of(b.unknowns[i].quantity);
    b.expected[i] = sd * sd;
  }
  b.covariance = MatrixX::Zero(2 * n + count, 2 * n + count);
  b.covariance.bottomRightCorner(count, count) = symmetric(estimates.covariance(places, places));
}

VectorX ParameterFilter::Belief::sigma_of(const Observation& seen) const {
  if (seen.sigma.size() == 0) return VectorX::Constant(chain.angles(), std::max(options.least_sigma, 0.01));
  return (options.inflation * seen.sigma).cwiseMax(options.least_sigma);
}

// The state from the frame alone; the parameters stay as they are.
void ParameterFilter::Belief::start(const Observation& seen) {
  const int n = chain.angles();
  theta = seen.theta;
  thetadot = seen.thetadot.size() ? seen.thetadot : VectorX::Zero(n).eval();
  time = seen.time;
  covariance.topRows(2 * n).setZero();
  covariance.leftCols(2 * n).setZero();
  covariance.topLeftCorner(n, n) = sigma_of(seen).cwiseAbs2().asDiagonal();
  covariance.block(n, n, n, n).diagonal().setConstant(kRateSd * kRateSd);
  started = true;
  rejected_in_a_row = 0;
}

void ParameterFilter::Belief::forget(double interval) {
  if (!std::isfinite(options.memory)) return;
  const Eigen::Index count = change.size();
  const double keep = std::exp(-interval / options.memory);
  auto block = covariance.bottomRightCorner(count, count);
  // in units of what is expected, the information of the eigenvector with variance v fades towards 1
  const VectorX unit = expected.cwiseSqrt();
  const Eigen::SelfAdjointEigenSolver<MatrixX> eigen(
      MatrixX(symmetric(unit.cwiseInverse().asDiagonal() * block * unit.cwiseInverse().asDiagonal())));
  VectorX grown = eigen.eigenvalues();
  for (double& v : grown) {
    v = std::max(v, 1e-12);
    v = std::max(0.0, 1.0 / (keep / v + (1.0 - keep)) - v);
  }
  block += unit.asDiagonal() * eigen.eigenvectors() * grown.asDiagonal() * eigen.eigenvectors().transpose() *
           unit.asDiagonal();
}

bool ParameterFilter::Belief::predict(double later, const dynamics::BaseFunction& base) {
  const int n = chain.angles();
  const Eigen::Index count = change.size(), size = 2 * n + count;
  std::vector<dynamics::Unknown> all = dynamics::initial_state_unknowns(chain);
  all.insert(all.end(), unknowns.begin(), unknowns.end());
  const std::vector<dynamics::Tangent> tangents = dynamics::tangents(chain, now, all);
  const dynamics::Model model = dynamics::make_model(chain, now);
  chain::States states;
  dynamics::Sensitivities slopes;
  const dynamics::BaseGrid grid = dynamics::sample_base(base, time, {later}, now.substeps);
  const dynamics::InitialState state{time, theta, thetadot, dynamics::internal_state_in_motion(model, theta, thetadot)};
  if (!dynamics::simulate(model, grid, state, states, tangents, &slopes)) return false;
  MatrixX transition = MatrixX::Identity(size, size);
  transition.topRows(n) = slopes.theta[0];
  transition.middleRows(n, n) = slopes.thetadot[0];
  covariance = transition * covariance * transition.transpose();
  // an acceleration that is constant within a frame and unknown from frame to frame
  const double h = later - time, a2 = options.disturbance * options.disturbance;
  for (int k = 0; k < n; ++k) {
    covariance(k, k) += 0.25 * a2 * h * h * h * h;
    covariance(n + k, n + k) += a2 * h * h;
    covariance(k, n + k) += 0.5 * a2 * h * h * h;
    covariance(n + k, k) += 0.5 * a2 * h * h * h;
  }
  theta = states.theta[0], thetadot = states.thetadot[0], time = later;
  return true;
}

bool ParameterFilter::Belief::observe(const Observation& seen, const dynamics::BaseFunction& base) {
  const int n = chain.angles();
  if (seen.theta.size() != n || (seen.thetadot.size() && seen.thetadot.size() != n) ||
      (seen.sigma.size() && seen.sigma.size() != n))
    throw InputError("`online`",
                     "a frame has " + std::to_string(seen.theta.size()) + " angles, the twin " + std::to_string(n),
                     "give what 'estimate' prints for this rope");
  if (!std::isfinite(seen.time) || !seen.theta.allFinite() || !seen.thetadot.allFinite() || !seen.sigma.allFinite())
    throw InputError("`online`", "a number of the frame at " + core::exact(seen.time) + " s is not finite",
                     "leave lost frames out");
  if ((seen.sigma.array() < 0.0).any())
    throw InputError("`online`", "a standard deviation of the frame at " + core::exact(seen.time) + " s is negative",
                     "give what 'estimate' prints for this rope");
  if (started && !(seen.time > time))
    throw InputError("`online`", "times go backwards at " + core::exact(seen.time) + " s",
                     "give the frames in their order");
  if (!started || seen.time - time > options.longest_gap) {
    restarts += started;
    start(seen);
    return true;
  }
  forget(seen.time - time);
  if (!predict(seen.time, base)) {
    ++restarts;
    start(seen);
    return true;
  }

  // theta is measured: H = (I 0 0)
  const VectorX innovation = seen.theta - theta;
  const VectorX sigma = sigma_of(seen);
  MatrixX spread = covariance.topLeftCorner(n, n);
  spread.diagonal() += sigma.cwiseAbs2();
  for (int k = 0; k < n; ++k)
    if (!(innovation[k] * innovation[k] <= options.gate * options.gate * spread(k, k))) {
      ++left_out;
      if (++rejected_in_a_row >= kMaxRejected) {
        ++restarts;
        start(seen);
      }
      return false;
    }
  rejected_in_a_row = 0;
  const Eigen::LDLT<MatrixX> factor(spread);
  if (!math::is_positive(factor))
    throw InputError("`online`", "the standard deviations at " + core::exact(seen.time) + " s are too large",
                     "leave frames out that tell nothing");
  const MatrixX gain = factor.solve(covariance.topRows(n)).transpose();
  const VectorX step = gain * innovation;
  theta += step.head(n);
  thetadot += step.segment(n, n);
  // Joseph's form stays positive
  MatrixX left = MatrixX::Identity(gain.rows(), gain.rows());
  left.leftCols(n) -= gain;
  covariance =
      symmetric(left * covariance * left.transpose() + gain * sigma.cwiseAbs2().asDiagonal() * gain.transpose());
  change += step.tail(change.size()).cwiseMax(-kMaxStep).cwiseMin(kMaxStep);
  now = dynamics::moved(chain, first, unknowns, change);
  ++used;
  return true;
}

bool ParameterFilter::observe(const Observation& seen, const dynamics::BaseFunction& base) {
  return belief_->observe(seen, base);
}

Result ParameterFilter::result() const {
  const Belief& b = *belief_;
  Result out{b.now, b.known, {b.time, b.theta, b.thetadot}, b.used, b.left_out, b.restarts};
  dynamics::Estimates& e = out.estimates;
  const int n = b.chain.angles();
  e.solver.reset();  // it is of another fit
  e.covariance.setZero();
  // the initial state of the old recording is what it was, and has nothing to do with the new frames
  e.covariance.diagonal() = b.known.covariance.diagonal();
  const auto count = static_cast<Eigen::Index>(b.places.size());
  e.covariance(b.places, b.places) = b.covariance.bottomRightCorner(count, count);
  for (Eigen::Index i = 0; i < count; ++i) {
    const auto place = static_cast<std::size_t>(b.places[i]);
    const double variance = b.covariance(2 * n + i, 2 * n + i);
    if (place < e.values.size()) e.values[place] += b.change[i];
    if (place < e.standard_errors.size()) e.standard_errors[place] = std::sqrt(std::max(0.0, variance));
  }
  return out;
}

}  // namespace chainsplat::adaptation
