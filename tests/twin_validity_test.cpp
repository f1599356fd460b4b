#include <doctest/doctest.h>
#include <cmath>

#include "chainsplat/validity.h"

using namespace chainsplat;

TEST_CASE("the extent of a motion is that of a rope carried round a circle") {
  constexpr double kRadius = 0.2, kTurn = 3.0, kLength = 0.4;  // m, rad/s, m
  constexpr int kJoints = 4;
  const chain::Chain chain = chain::make_chain(kLength, 0.01, -math::Vector3::UnitZ(), math::Vector3::UnitY(), kJoints,
                                               chain::Bending::spatial, false, 0.0);
  std::vector<trajectory::Sample> samples;
  for (int i = 0; i <= 200; ++i) {
    const double t = i / 100.0;
    samples.push_back(
        {t, {math::Matrix3::Identity(), kRadius * math::Vector3(std::cos(kTurn * t), std::sin(kTurn * t), 0.0)}});
  }
  const trajectory::Trajectory base = trajectory::fit(samples, "circle");
  chain::States states;
  for (int i = 20; i <= 180; i += 2) states.time.push_back(i / 100.0);
  math::VectorX theta = math::VectorX::Zero(2 * kJoints);
  theta[2] = 0.3, theta[3] = 0.4;  // the second joint bends by 0.5 rad, and stands for a link's length
  states.theta.assign(states.time.size(), theta);

  const twin::Validity found = twin::validity_of(chain, base, states);
  CHECK(found.acceleration == doctest::Approx(kRadius * kTurn * kTurn).epsilon(1e-2));
  CHECK(found.speed == doctest::Approx(kRadius * kTurn).epsilon(1e-2));
  CHECK(found.curvature == doctest::Approx(0.5 / (kLength / kJoints)));

  CHECK(twin::beyond(found, found) == "");
  twin::Validity faster = found;
  faster.speed *= 1.4;
  CHECK(twin::beyond(found, faster) == "");
  faster.speed *= 2.0, faster.acceleration *= 2.0;
  CHECK(twin::beyond(found, faster) == "the rope moves at 1.68 m/s, 2.8 times what the twin was identified in");
  CHECK(twin::larger(found, faster).speed == faster.speed);
  CHECK(twin::larger(faster, found).curvature == found.curvature);
}
