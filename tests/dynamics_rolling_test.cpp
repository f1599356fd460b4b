// How far a rope rolls on a table: against what torsion and friction balance to, rolling without slipping, and energies
// that are written down here once more.
#include <doctest/doctest.h>

#include <cmath>
#include <vector>

#include "chainsplat/dynamics/rolling.h"

using namespace chainsplat;
using math::Vector3;
using math::VectorX;

namespace {

constexpr double kLength = 0.3, kRadius = 0.01, kBending = 4e-4, kMassPerLength = 0.2, kCoulomb = 0.3;

dynamics::Model rope_on_table(int joints) {
  const chain::Chain chain = chain::make_chain(kLength, 2.0 * kRadius, Vector3::UnitX(), Vector3::UnitZ(), joints,
                                               chain::Bending::planar, false);
  dynamics::Parameters p;
  const auto all = static_cast<std::size_t>(joints);
  p.link_mass.assign(all, kMassPerLength * kLength / joints);
  p.viscous_friction.assign(all, 0.0), p.coulomb_friction.assign(all, kCoulomb);
  p.air_linear.assign(all, 0.0), p.air_quadratic.assign(all, 0.0);
  for (int j = 1; j <= joints; ++j) p.stiffness.push_back(kBending / chain::bent_length(chain, j));
  p.rest_angle.assign(all, 0.0);
  for (const double stiffness : p.stiffness) p.damping.push_back(0.05 * stiffness);
  p.radius = kRadius;
  p.table_normal = Vector3::UnitZ();
  return dynamics::make_model(chain, p);
}

dynamics::Rolling rolling_of(const chain::Chain& chain, double torsion, double friction) {
  return {torsion, friction, 1e-3, std::vector<double>(chain.links() - 1, 0.0), std::vector<double>(chain.links(), 0.0),
          0.0};
}

// The rope along x, pushed along `direction` at 0.2 m/s for `seconds`, with its angles at `theta`.
VectorX pushed(const dynamics::Model& model, const dynamics::Rolling& rolling, const Vector3& direction,
               const VectorX& theta, double seconds) {
  dynamics::Roller roller(model, rolling);
  VectorX roll;
  for (int k = 0; k <= std::lround(seconds * 30.0); ++k)
    roll = roller.advance(k / 30.0, {math::Matrix3::Identity(), 0.2 * k / 30.0 * direction}, theta);
  return roll;
}

}  // namespace

TEST_CASE("friction across the rope and torsion balance to a parabola along it") {
  const dynamics::Model model = rope_on_table(40);
  const chain::Chain& chain = model.chain;
  const VectorX straight = VectorX::Zero(chain.angles());
  const dynamics::Rolling rolling = rolling_of(chain, 0.8, 0.5);
  const VectorX roll = pushed(model, rolling, Vector3::UnitY(), straight, 4.0);
  const double moment = kRadius * 0.5 * kCoulomb * kMassPerLength * 9.81;  // N m per m of rope
  const double most = moment / (0.8 * kBending) * 0.5 * kLength * kLength;
  CHECK(most > 0.3);
  for (int link = 1; link < chain.links(); ++link) {
    const double s = 0.5 * (chain.link_start(link) + chain.link_end(link));
    CHECK(roll[link] == doctest::Approx(-moment / (0.8 * kBending) * (kLength * s - 0.5 * s * s)).epsilon(0.04));
  }
  CHECK(roll[0] == 0.0);
  // to the other side it rolls the other way, along itself not at all
  CHECK((pushed(model, rolling, -Vector3::UnitY(), straight, 4.0) + roll).norm() < 1e-6);
  CHECK(pushed(model, rolling, Vector3::UnitX(), straight, 4.0).norm() < 1e-6);
}

TEST_CASE("a rope that hardly resists torsion rolls without slipping") {
  const dynamics::Model model = rope_on_table(20);
  dynamics::Rolling rolling = rolling_of(model.chain, 1e-4, 1.0);
  const VectorX roll = pushed(model, rolling, Vector3::UnitY(), VectorX::Zero(20), 0.3);
  CHECK(roll[20] == doctest::Approx(-0.2 * 0.3 / kRadius).epsilon(0.03));
  // the texture's own place is taken off
  rolling.texture.assign(21, 0.5);
  CHECK(
      (pushed(model, rolling, Vector3::UnitY(), VectorX::Zero(20), 0.3) - roll).isApprox(VectorX::Constant(21, -0.5)));
}

TEST_CASE("without friction a bent rope rolls to where its torsion and its set have the least energy") {
  const dynamics::Model base = rope_on_table(8);
  const chain::Chain& chain = base.chain;
  dynamics::Parameters p = base.parameters;
  for (int k = 0; k < 8; ++k) p.rest_angle[k] = 0.02 * k - 0.05;
  const dynamics::Model model = dynamics::make_model(chain, p);
  dynamics::Rolling rolling = rolling_of(chain, 0.8, 0.0);
  for (int k = 0; k < 8; ++k) rolling.set[k] = 4.0 - 0.3 * k;
  VectorX theta(8);
  for (int k = 0; k < 8; ++k) theta[k] = 0.25 - 0.04 * k;
  const VectorX roll = pushed(model, rolling, Vector3::Zero(), theta, 30.0);
  const auto energy = [&](const VectorX& at) {  // of bending about both axes of the material, and of torsion
    double sum = 0.0;
    for (int j = 1; j <= 8; ++j) {
      const double length = chain::bent_length(chain, j), mean = 0.5 * (at[j] + at[j - 1]);
      const double in_plane = p.rest_angle[j - 1] * std::cos(mean) + rolling.set[j - 1] * length * std::sin(mean);
      const double out_of_plane = rolling.set[j - 1] * length * std::cos(mean) - p.rest_angle[j - 1] * std::sin(mean);
      sum += 0.5 * kBending / length *
             (std::pow(theta[j - 1] - in_plane, 2) + std::pow(out_of_plane, 2) + 0.8 * std::pow(at[j] - at[j - 1], 2));
    }
    return sum;
  };
  CHECK(roll.cwiseAbs().maxCoeff() > 0.1);
  for (int link = 1; link <= 8; ++link)
    for (const double move : {-0.01, 0.01}) {
      VectorX other = roll;
      other[link] += move;
      CHECK(energy(other) > energy(roll));
    }
}
