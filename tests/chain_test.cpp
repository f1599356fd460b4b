// What the material of a chain does beside its links.
#include "chainsplat/chain.h"

#include <doctest/doctest.h>

#include <cmath>

using namespace chainsplat;

TEST_CASE("material turns about its link's axis, and nowhere else") {
  const chain::Chain chain = chain::make_chain(0.3, 0.02, {0, 0.6, -0.8}, {1, 0, 0}, 4, chain::Bending::planar, false);
  const math::VectorX theta = math::VectorX::LinSpaced(4, -0.4, 0.5), roll = math::VectorX::LinSpaced(5, 0.0, 1.2);
  const math::Pose base{math::exp_so3({0.3, -0.2, 0.5}), {0.1, 0.2, 0.3}};
  const auto links = chain::link_motions(chain, theta, base),
             material = chain::material_motions(chain, theta, roll, base);
  for (int j = 0; j < chain.links(); ++j) {
    const math::Vector3 on_axis = 0.07 * chain.direction, beside = on_axis + 0.01 * chain.bending_axis;
    CHECK((material[j] * on_axis - links[j] * on_axis).norm() < 1e-15);
    const math::Vector3 turned = on_axis + 0.01 * (Eigen::AngleAxisd(roll[j], chain.direction) * chain.bending_axis);
    CHECK((material[j] * beside - links[j] * turned).norm() < 1e-15);
  }
  const auto none = chain::material_motions(chain, theta, {}, base);
  for (int j = 0; j < chain.links(); ++j)
    CHECK((none[j] * math::Vector3::Ones() - links[j] * math::Vector3::Ones()).norm() == 0.0);
}

TEST_CASE("rolls are interpolated by straight lines and stay at their ends") {
  chain::States states;
  states.time = {1.0, 1.5, 3.5};
  CHECK(chain::roll_at(states, 1.2).size() == 0);
  states.roll = {Eigen::Vector2d(0, 1), Eigen::Vector2d(0, 2), Eigen::Vector2d(0, -2)};
  CHECK(chain::roll_at(states, 0.0)[1] == 1.0);
  CHECK(chain::roll_at(states, 1.25)[1] == doctest::Approx(1.5));
  CHECK(chain::roll_at(states, 1.5)[1] == 2.0);
  CHECK(chain::roll_at(states, 2.0)[1] == doctest::Approx(1.0));
  CHECK(chain::roll_at(states, 9.0)[1] == -2.0);
}

TEST_CASE("a chain that lies beside its grasp's plane moves by the same axes") {
  chain::Chain chain = chain::make_chain(0.3, 0.02, {1, 0, 0}, {0, 0, 1}, 4, chain::Bending::planar, false);
  chain.lift = {0.0, -0.001, -0.003, -0.004, -0.004};
  const math::VectorX theta = math::VectorX::LinSpaced(4, -0.4, 0.5);
  const math::Pose base{math::exp_so3({0.3, -0.2, 0.5}), {0.1, 0.2, 0.3}};
  chain::Chain flat = chain;
  flat.lift.clear();
  const auto lifted = chain::link_motions(chain, theta, base), level = chain::link_motions(flat, theta, base);
  for (int j = 0; j < chain.links(); ++j) {
    const math::Vector3 home(0.1, 0.02, 0.03);
    CHECK((lifted[j] * home - level[j] * math::Vector3(home + chain.lift[j] * chain.bending_axis)).norm() < 1e-15);
    // derivatives by the chain's own axes against central differences
    const math::Vector3 point = lifted[j] * home;
    const math::MatrixX jacobian = chain::point_jacobian(chain, chain::world_axes(chain, theta, base), j, point);
    for (int k = 0; k < 4; ++k) {
      constexpr double kStep = 1e-6;
      math::VectorX more = theta, less = theta;
      more[k] += kStep, less[k] -= kStep;
      const math::Vector3 slope =
          (chain::link_motions(chain, more, base)[j] * home - chain::link_motions(chain, less, base)[j] * home) /
          (2.0 * kStep);
      CHECK((slope - jacobian.col(k)).norm() < 1e-9);
    }
  }
}

TEST_CASE("curvature changes little along a rope, from its clamp on") {
  const auto cost = [](const chain::Chain& chain, const math::VectorX& theta) {
    return theta.dot(chain::curvature_information(chain, 0.1) * theta);
  };
  const auto chain_of = [](int joints, chain::Bending bending) {
    return chain::make_chain(0.3, 0.02, {1, 0, 0}, {0, 0, 1}, joints, bending, false);
  };
  // of a bend that fades from the clamp, its integral over each joint's piece: the first pair costs nothing
  for (const int joints : {8, 16, 24}) {
    const chain::Chain planar = chain_of(joints, chain::Bending::planar);
    math::VectorX first_two = math::VectorX::Zero(joints);
    double at = 0.0;
    for (int j = 1; j <= 2; ++j) {
      const double to = at + chain::bent_length(planar, j), fades = 0.18 * planar.length;
      first_two[j - 1] = 20.0 * fades * (std::exp(-at / fades) - std::exp(-to / fades));
      at = to;
    }
    math::VectorX second = math::VectorX::Zero(joints);
    second[1] = first_two[1];  // alone it differs from both of its neighbors
    CHECK(cost(planar, first_two) == doctest::Approx(0.5 * cost(planar, second)).epsilon(0.02));
  }
  // in space the first joint is turned as the gripper holds the rope
  const chain::Chain spatial = chain_of(6, chain::Bending::spatial);
  CHECK(std::abs(cost(spatial, math::VectorX::Constant(12, 0.2))) < 1e-12);
  math::VectorX about_one = math::VectorX::Zero(12);
  about_one[4] = 0.3;
  CHECK(cost(spatial, about_one) == doctest::Approx(2.0 * 0.3 * 0.3 / 0.01));
}
