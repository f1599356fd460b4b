// How a rope on a table rolls, from the rolls of a recording (mathematics.md 5.12).
#include <algorithm>
#include <cmath>

#include "chainsplat/dynamics/rolling.h"
#include "chainsplat/identification.h"

namespace chainsplat::identification {

namespace {

using dynamics::Rolling;
using math::MatrixX;
using math::VectorX;

constexpr int kKnots = 4;  // of the set along the rope, straight lines between them
constexpr int kUnknowns = 3 + kKnots;
constexpr double kDeviation = 0.15;  // rad, of a link's roll: it is measured to 0.04 to 0.07, as its neighbors are
// Priors: of a solid rod with Poisson's ratio 1/3 (log); as on a surface that slides (log); m/s (log); 1/m.
constexpr double kTorsion = 0.75, kTorsionDeviation = 1.0;
constexpr double kFriction = 0.5, kFrictionDeviation = 1.0;
constexpr double kSpeed = 0.02, kSpeedDeviation = 1.5;
constexpr double kSetDeviation = 5.0;
constexpr double kExplained = 0.5;  // largest share of the squares that a law may leave that is worth having
constexpr double kLongest = 60.0;   // s: a longer recording's beginning says enough

Rolling rolling_of(const chain::Chain& chain, const VectorX& x) {
  Rolling out;
  out.torsion = kTorsion * std::exp(kTorsionDeviation * x[0]);
  out.friction = kFriction * std::exp(kFrictionDeviation * x[1]);
  out.speed = kSpeed * std::exp(kSpeedDeviation * x[2]);
  for (const double arclength : chain.joint_arclength) {
    const double at = arclength / chain.length * (kKnots - 1);
    const int knot = std::min(static_cast<int>(at), kKnots - 2);
    out.set.push_back(kSetDeviation * ((knot + 1 - at) * x[3 + knot] + (at - knot) * x[4 + knot]));
  }
  out.texture.assign(chain.links(), 0.0);
  return out;
}

}  // namespace

RollingFit fit_rolling(const dynamics::Model& model, const trajectory::Trajectory& base, const chain::States& states) {
  CHAINSPLAT_CHECK(!states.roll.empty() && states.roll.size() == states.time.size(),
                   std::to_string(states.roll.size()));
  const chain::Chain& chain = model.chain;
  chain::States fitted;
  for (std::size_t k = 0; k < states.time.size() && states.time[k] <= states.time[0] + kLongest; ++k) {
    fitted.time.push_back(states.time[k]);
    fitted.theta.push_back(states.theta[k]);
  }
  const Eigen::Index frames = static_cast<Eigen::Index>(fitted.time.size()), links = chain.links();
  // predicted less measured rolls, of all links; what does not change in time is the texture's
  const auto differences = [&](const VectorX& x, VectorX* texture) {
    const std::vector<VectorX> rolls = dynamics::rolls_along(model, rolling_of(chain, x), base, fitted);
    MatrixX out(links, frames);
    for (Eigen::Index k = 0; k < frames; ++k) out.col(k) = rolls[k] - states.roll[k];
    const VectorX mean = out.rowwise().mean();
    out.colwise() -= mean;
    if (texture) *texture = mean;
    return out;
  };
  const auto evaluate = [&](const VectorX& x, solve::NormalEquations* equations) {
    constexpr double kWeight = 1.0 / (kDeviation * kDeviation), kMove = 1e-3;
    const MatrixX here = differences(x, nullptr);
    if (equations) {
      MatrixX jacobian(here.size(), kUnknowns);
      core::parallel_for(kUnknowns, [&](std::int64_t i) {
        VectorX moved = x;
        moved[i] += kMove;
        jacobian.col(i) = ((differences(moved, nullptr) - here) / kMove).reshaped();
      });
      equations->matrix = kWeight * jacobian.transpose() * jacobian + MatrixX::Identity(kUnknowns, kUnknowns);
      equations->gradient = kWeight * jacobian.transpose() * here.reshaped() + x;
    }
    return 0.5 * (kWeight * here.squaredNorm() + x.squaredNorm());
  };
  solve::Options options;
  options.trials = 25;
  options.longest = 1.0;  // deviation of a prior
  options.cost_tolerance = 1e-3;
  VectorX x = VectorX::Zero(kUnknowns);
  RollingFit out;
  out.summary =
      solve::least_squares(x, std::function<double(const VectorX&, solve::NormalEquations*)>(evaluate), options);
  VectorX texture;
  const MatrixX left = differences(x, &texture);
  MatrixX measured(links, frames);
  for (Eigen::Index k = 0; k < frames; ++k) measured.col(k) = states.roll[k];
  measured.colwise() -= VectorX(measured.rowwise().mean());
  if (!(left.squaredNorm() < kExplained * measured.squaredNorm())) return out;
  out.rolling = rolling_of(chain, x);
  out.rolling->texture.assign(texture.begin(), texture.end());
  out.rolling->deviation = std::sqrt(left.squaredNorm() / static_cast<double>(left.size()));
  return out;
}

}  // namespace chainsplat::identification
