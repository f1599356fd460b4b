#include "chainsplat/adaptation.h"

#include <algorithm>
#include <cmath>

namespace chainsplat::adaptation {
namespace {

constexpr double kRestSpread = 0.2;   // rad of a rest angle a unit of `spread`
constexpr double kRollSpread = 0.01;  // m of a lever
constexpr double kRateSd = 1.0;       // rad/s, of the first frame's rates
constexpr int kMaxRejected = 5;       // frames in a row, after which the state starts anew
constexpr double kMaxStep = 0.3;      // of a log in one frame: beyond, the linearization is worthless

MatrixX symmetric(const MatrixX& m) { return 0.5 * (m + m.transpose()); }

}  // namespace

Adaptation::Adaptation(const chain::Chain& chain, const dynamics::Parameters& parameters,
                       const dynamics::Estimates& estimates, const Options& options)
    : chain_(chain), first_(parameters), now_(parameters), known_(estimates), options_(options) {
  const auto size = static_cast<Eigen::Index>(estimates.names.size());
  if (size == 0 || !math::is_covariance(estimates.covariance) || estimates.covariance.rows() != size)
    throw InputError("`online`", "the twin knows no covariance of its parameters", "identify it first");
  if (!(options.memory > 0.0)) throw InputError("`memory`", "is not above 0", "give seconds, for example 5");
  const auto all = dynamics::tangents(chain, parameters, estimates.names);
  for (Eigen::Index i = 0; i < size; ++i)
    if (dynamics::is_parameter(all[i])) places_.push_back(i), names_.push_back(estimates.names[i]);
  if (places_.empty()) throw InputError("`online`", "the twin has no parameter to adapt", "identify it first");
  // a diverging sensitivity of the Euler step is no use here: the variational equation needs RODAS3
  now_.integrator = dynamics::Integrator::rodas3;
  first_ = now_;

  const int n = chain.angles();
  const auto count = static_cast<Eigen::Index>(places_.size());
  change_ = VectorX::Zero(count);
  expected_.resize(count);
  for (Eigen::Index i = 0; i < count; ++i) {
    const double unit = names_[i].rfind("rest_angle", 0) == 0   ? kRestSpread
                        : names_[i].rfind("roll_lever", 0) == 0 ? kRollSpread
                                                                : 1.0;
    const double sd = options.spread * unit;
    expected_[i] = sd * sd;
  }
  covariance_ = MatrixX::Zero(2 * n + count, 2 * n + count);
  covariance_.bottomRightCorner(count, count) = symmetric(estimates.covariance(places_, places_));
}

VectorX Adaptation::sigma_of(const Observation& seen) const {
  if (seen.sigma.size() == 0) return VectorX::Constant(chain_.angles(), std::max(options_.least_sigma, 0.01));
  return (options_.inflation * seen.sigma).cwiseMax(options_.least_sigma);
}

// The state from the frame alone; the parameters stay as they are.
void Adaptation::start(const Observation& seen) {
  const int n = chain_.angles();
  theta_ = seen.theta;
  thetadot_ = seen.thetadot.size() ? seen.thetadot : VectorX::Zero(n).eval();
  time_ = seen.time;
  covariance_.topRows(2 * n).setZero();
  covariance_.leftCols(2 * n).setZero();
  covariance_.topLeftCorner(n, n) = sigma_of(seen).cwiseAbs2().asDiagonal();
  covariance_.block(n, n, n, n).diagonal().setConstant(kRateSd * kRateSd);
  started_ = true;
  rejected_in_a_row_ = 0;
}

void Adaptation::forget(double interval) {
  if (!std::isfinite(options_.memory)) return;
  const Eigen::Index count = change_.size();
  const double keep = std::exp(-interval / options_.memory);
  auto block = covariance_.bottomRightCorner(count, count);
  // in units of what is expected, the information of the eigenvector with variance v fades towards 1
  const VectorX unit = expected_.cwiseSqrt();
  const Eigen::SelfAdjointEigenSolver<MatrixX> eigen(
      symmetric(unit.cwiseInverse().asDiagonal() * block * unit.cwiseInverse().asDiagonal()));
  VectorX grown = eigen.eigenvalues();
  for (double& v : grown) {
    v = std::max(v, 1e-12);
    v = std::max(0.0, 1.0 / (keep / v + (1.0 - keep)) - v);
  }
  block += unit.asDiagonal() * eigen.eigenvectors() * grown.asDiagonal() * eigen.eigenvectors().transpose() *
           unit.asDiagonal();
}

bool Adaptation::predict(double time, const dynamics::BaseFunction& base) {
  const int n = chain_.angles();
  const Eigen::Index count = change_.size(), size = 2 * n + count;
  std::vector<dynamics::Tangent> unknowns(2 * n);
  for (int k = 0; k < n; ++k) {
    unknowns[k].theta = VectorX::Unit(n, k);
    unknowns[n + k].thetadot = VectorX::Unit(n, k);
  }
  for (dynamics::Tangent& d : dynamics::tangents(chain_, now_, names_)) unknowns.push_back(std::move(d));
  const dynamics::Model model = dynamics::make_model(chain_, now_);
  chain::States states;
  dynamics::Sensitivities slopes;
  const dynamics::BaseGrid grid = dynamics::sample_base(base, time_, {time}, now_.substeps);
  if (!dynamics::simulate(model, grid, theta_, thetadot_, states, unknowns, &slopes)) return false;
  MatrixX transition = MatrixX::Identity(size, size);
  transition.topRows(n) = slopes.theta[0];
  transition.middleRows(n, n) = slopes.thetadot[0];
  covariance_ = transition * covariance_ * transition.transpose();
  // an acceleration that is constant within a frame and unknown from frame to frame
  const double h = time - time_, a2 = options_.disturbance * options_.disturbance;
  for (int k = 0; k < n; ++k) {
    covariance_(k, k) += 0.25 * a2 * h * h * h * h;
    covariance_(n + k, n + k) += a2 * h * h;
    covariance_(k, n + k) += 0.5 * a2 * h * h * h;
    covariance_(n + k, k) += 0.5 * a2 * h * h * h;
  }
  theta_ = states.theta[0], thetadot_ = states.thetadot[0], time_ = time;
  return true;
}

bool Adaptation::observe(const Observation& seen, const dynamics::BaseFunction& base) {
  const int n = chain_.angles();
  if (seen.theta.size() != n || (seen.thetadot.size() && seen.thetadot.size() != n) ||
      (seen.sigma.size() && seen.sigma.size() != n))
    throw InputError("`online`",
                     "a frame has " + std::to_string(seen.theta.size()) + " angles, the twin " + std::to_string(n),
                     "give what 'estimate' prints for this rope");
  if (!std::isfinite(seen.time) || !seen.theta.allFinite() || !seen.thetadot.allFinite() || !seen.sigma.allFinite())
    throw InputError("`online`", "a number of the frame at " + core::exact(seen.time) + " s is not finite",
                     "leave lost frames out");
  if ((seen.sigma.array() < 0.0).any())
    throw InputError("`online`",
                     "a standard deviation of the frame at " + core::exact(seen.time) + " s is negative",
                     "give what 'estimate' prints for this rope");
  if (started_ && !(seen.time > time_))
    throw InputError("`online`", "times go backwards at " + core::exact(seen.time) + " s",
                     "give the frames in their order");
  if (!started_ || seen.time - time_ > options_.longest_gap) {
    restarts_ += started_;
    start(seen);
    return true;
  }
  forget(seen.time - time_);
  if (!predict(seen.time, base)) {
    ++restarts_;
    start(seen);
    return true;
  }

  // theta is measured: H = (I 0 0)
  const VectorX innovation = seen.theta - theta_;
  const VectorX sigma = sigma_of(seen);
  MatrixX spread = covariance_.topLeftCorner(n, n);
  spread.diagonal() += sigma.cwiseAbs2();
  for (int k = 0; k < n; ++k)
    if (!(innovation[k] * innovation[k] <= options_.gate * options_.gate * spread(k, k))) {
      ++left_out_;
      if (++rejected_in_a_row_ >= kMaxRejected) {
        ++restarts_;
        start(seen);
      }
      return false;
    }
  rejected_in_a_row_ = 0;
  const Eigen::LDLT<MatrixX> factor(spread);
  if (!math::is_positive(factor))
    throw InputError("`online`", "the standard deviations at " + core::exact(seen.time) + " s are too large",
                     "leave frames out that tell nothing");
  const MatrixX gain = factor.solve(covariance_.topRows(n)).transpose();
  const VectorX step = gain * innovation;
  theta_ += step.head(n);
  thetadot_ += step.segment(n, n);
  // Joseph's form stays positive
  MatrixX left = MatrixX::Identity(gain.rows(), gain.rows());
  left.leftCols(n) -= gain;
  covariance_ =
      symmetric(left * covariance_ * left.transpose() + gain * sigma.cwiseAbs2().asDiagonal() * gain.transpose());
  change_ += step.tail(change_.size()).cwiseMax(-kMaxStep).cwiseMin(kMaxStep);
  now_ = dynamics::moved(chain_, first_, names_, change_);
  ++used_;
  return true;
}

dynamics::Estimates Adaptation::estimates() const {
  dynamics::Estimates out = known_;
  const int n = chain_.angles();
  const auto count = static_cast<Eigen::Index>(places_.size());
  out.covariance.setZero();
  // the initial state of the old recording is what it was, and has nothing to do with the new frames
  for (Eigen::Index i = 0; i < out.covariance.rows(); ++i) out.covariance(i, i) = known_.covariance(i, i);
  for (Eigen::Index i = 0; i < count; ++i) {
    for (Eigen::Index j = 0; j < count; ++j) out.covariance(places_[i], places_[j]) = covariance_(2 * n + i, 2 * n + j);
    const double variance = covariance_(2 * n + i, 2 * n + i);
    if (places_[i] < static_cast<Eigen::Index>(out.values.size())) out.values[places_[i]] += change_[i];
    if (places_[i] < static_cast<Eigen::Index>(out.standard_errors.size()))
      out.standard_errors[places_[i]] = std::sqrt(std::max(0.0, variance));
  }
  return out;
}

}  // namespace chainsplat::adaptation
