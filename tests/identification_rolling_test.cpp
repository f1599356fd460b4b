// The law by which a rope rolls, from noisy rolls of a motion, judged by another motion.
#include <doctest/doctest.h>

#include <cmath>
#include <random>

#include "chainsplat/dynamics/rolling.h"
#include "chainsplat/identification.h"

using namespace chainsplat;
using math::Vector3;
using math::VectorX;

namespace {

dynamics::Model rope_on_table() {
  constexpr int kJoints = 12;
  const chain::Chain chain =
      chain::make_chain(0.3, 0.02, Vector3::UnitX(), Vector3::UnitZ(), kJoints, chain::Bending::planar, false);
  dynamics::Parameters p;
  p.link_mass.assign(kJoints, 0.06 / kJoints);
  p.viscous_friction.assign(kJoints, 0.0), p.coulomb_friction.assign(kJoints, 0.3);
  p.air_linear.assign(kJoints, 0.0), p.air_quadratic.assign(kJoints, 0.0);
  for (int j = 1; j <= kJoints; ++j) p.stiffness.push_back(4e-4 / chain::bent_length(chain, j));
  p.rest_angle.assign(kJoints, 0.01);
  for (const double stiffness : p.stiffness) p.damping.push_back(0.05 * stiffness);
  p.radius = 0.01;
  p.table_normal = Vector3::UnitZ();
  return dynamics::make_model(chain, p);
}

// The base goes to and fro across the rope, which bends behind it.
struct Motion {
  trajectory::Trajectory base;
  chain::States states;
  explicit Motion(const chain::Chain& chain, double frequency, double along) {
    std::vector<trajectory::Sample> samples;
    for (int k = 0; k <= 300; ++k) {
      const double t = k / 60.0, at = 2.0 * M_PI * frequency * t;
      samples.push_back({t, {math::Matrix3::Identity(), {along * std::sin(2.0 * at), 0.1 * std::sin(at), 0.0}}});
    }
    base = trajectory::fit(samples, "test");
    for (int k = 0; k < 150; ++k) {
      states.time.push_back(k / 30.0);
      VectorX theta(chain.angles());
      for (int a = 0; a < chain.angles(); ++a)
        theta[a] = 0.12 * std::sin(2.0 * M_PI * frequency * states.time.back() - 0.15 * a);
      states.theta.push_back(theta);
    }
  }
};

double rms(const std::vector<VectorX>& a, const std::vector<VectorX>& b) {
  double sum = 0.0;
  for (std::size_t k = 0; k < a.size(); ++k) sum += (a[k] - b[k]).squaredNorm() / static_cast<double>(a[k].size());
  return std::sqrt(sum / static_cast<double>(a.size()));
}

}  // namespace

TEST_CASE("how a rope rolls is found again through noise, and carries over to another motion") {
  const dynamics::Model model = rope_on_table();
  const int links = model.chain.links();
  dynamics::Rolling truth{0.9, 0.4, 0.01, std::vector<double>(links - 1, 1.0), std::vector<double>(links), 0.0};
  for (int j = 0; j < links; ++j) truth.texture[j] = 0.02 * j;
  Motion recorded(model.chain, 0.4, 0.02), other(model.chain, 0.6, 0.05);
  recorded.states.roll = dynamics::rolls_along(model, truth, recorded.base, recorded.states);
  std::mt19937 random(5);
  std::normal_distribution<double> noise(0.0, 0.04);
  for (VectorX& roll : recorded.states.roll)
    for (double& value : roll) value += noise(random);

  const identification::RollingFit fit = identification::fit_rolling(model, recorded.base, recorded.states);
  CHECK(solve::converged(fit.summary));
  REQUIRE(fit.rolling);
  const dynamics::Rolling& found = *fit.rolling;
  CHECK(found.deviation == doctest::Approx(0.04).epsilon(0.15));
  const std::vector<VectorX> wanted = dynamics::rolls_along(model, truth, other.base, other.states);
  std::vector<VectorX> none(wanted.size(), VectorX::Zero(links));
  CHECK(rms(wanted, none) > 0.2);
  CHECK(rms(wanted, dynamics::rolls_along(model, found, other.base, other.states)) < 0.04);
}

TEST_CASE("rolls that have nothing to do with the motion get no law") {
  const dynamics::Model model = rope_on_table();
  Motion recorded(model.chain, 0.4, 0.02);
  std::mt19937 random(7);
  std::normal_distribution<double> noise(0.0, 0.3);
  for (std::size_t k = 0; k < recorded.states.time.size(); ++k) {
    recorded.states.roll.push_back(VectorX(model.chain.links()));
    for (double& value : recorded.states.roll.back()) value = noise(random);
  }
  CHECK_FALSE(identification::fit_rolling(model, recorded.base, recorded.states).rolling);
}
