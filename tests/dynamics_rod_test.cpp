// The joint at the grasp of a rod under tension, against a chain of so many joints that tension does not change it.
#include "chainsplat/dynamics/rod.h"

#include <doctest/doctest.h>

#include <cmath>

#include "chainsplat/dynamics/base_wrench.h"
#include "src/math/decompositions.h"

using namespace chainsplat;
using namespace chainsplat::dynamics;
using math::Vector3;

namespace {

struct RodCase {
  double length, mass, tip, bending, first_joint;  // m, kg, kg, N m^2, m
};
constexpr double kRetardation = 0.08;  // s
constexpr double kTilt = 0.2;          // rad, of the grasp from the vertical
const RodCase kCases[] = {{0.3, 0.06, 0.0, 4.5e-4, 0.0}, {0.45, 0.09, 0.01, 4.5e-4, 0.0},
                          {0.6, 0.1, 0.05, 1e-3, 0.0},   {0.3, 0.06, 0.0, 5e-3, 0.0},
                          {0.3, 0.06, 0.0, 5e-2, 0.0},   {0.3, 0.06, 0.0, 4.5e-4, 0.01}};

Model hanging(const RodCase& rod, int joints, bool under_tension) {
  const chain::Chain chain = chain::make_chain(rod.length, 1e-3, -Vector3::UnitZ(), Vector3::UnitY(), joints,
                                               chain::Bending::planar, false, rod.first_joint);
  Parameters p;
  p.viscous_friction = p.coulomb_friction = p.air_linear = p.air_quadratic = p.rest_angle =
      std::vector<double>(joints, 0.0);
  for (int j = 1; j <= joints; ++j)
    p.link_mass.push_back(rod.mass * (chain.link_end(j) - chain.link_start(j)) / rod.length);
  p.tip_mass = rod.tip;
  const double tension = under_tension ? grasp_tension(p, p.gravity) : 0.0;
  for (int j = 1; j <= joints; ++j) {
    const RodJoint joint = rod_joint(chain, j, rod.bending, tension);
    p.stiffness.push_back(joint.stiffness);
    p.damping.push_back(kRetardation * joint.slope);
  }
  return make_model(chain, p);
}

struct Seen {
  double offset = 0.0, moment = 0.0, frequency = 0.0, ratio = 0.0;  // m, N m, Hz, of the first mode
};

// Of a rope that hangs from a tilted grasp, and of its first swing from an upright one.
Seen seen(const Model& model) {
  Seen out;
  math::Pose tilted;
  tilted.rotation = Eigen::AngleAxisd(kTilt, Vector3::UnitY()).toRotationMatrix();
  const VectorX bent = static_equilibrium(model, tilted).theta;
  const auto motions = chain::link_motions(model.chain, bent, tilted);
  out.offset = chain::centerline(model.chain, motions, {model.chain.length})(0, 0);
  out.moment = base_wrench(model, at_rest(tilted), bent, VectorX::Zero(bent.size()))[1];
  const VectorX straight = VectorX::Zero(bent.size());
  const Linearization at = linearize(model, at_rest({}), math::Vector6::Zero(), straight, straight);
  const Eigen::GeneralizedSelfAdjointEigenSolver<MatrixX> modes(
      MatrixX(0.5 * (at.stiffness + at.stiffness.transpose())), at.mass);
  const double turn = std::sqrt(modes.eigenvalues()[0]);
  const VectorX shape = modes.eigenvectors().col(0);
  out.frequency = turn / (2.0 * M_PI);
  out.ratio = shape.dot(at.damping * shape) / (2.0 * turn);
  return out;
}

}  // namespace

TEST_CASE("eight joints hang and swing as the rod under tension does") {
  for (const RodCase& rod : kCases) {
    RodCase whole = rod;  // it bends from the clamp on, also where a base link has no joint
    whole.first_joint = 0.0;
    const Seen fine = seen(hanging(whole, 240, false)), taut = seen(hanging(rod, 8, true)),
               slack = seen(hanging(rod, 8, false));
    CAPTURE(rod.length);
    CAPTURE(rod.bending);
    CAPTURE(rod.first_joint);
    // without the tension the moment at the grasp is 2 to 43 % off where the rope bends within one or two links
    CHECK(std::abs(taut.offset / fine.offset - 1.0) < 0.03);
    CHECK(std::abs(taut.moment / fine.moment - 1.0) < 0.01);
    CHECK(std::abs(taut.frequency / fine.frequency - 1.0) < 0.004);
    CHECK(std::abs(taut.ratio / fine.ratio - 1.0) < 0.02);
    if (rod.first_joint > 0.0) continue;  // there the errors of a rod without tension happen to cancel
    CHECK(std::abs(taut.moment - fine.moment) < std::abs(slack.moment - fine.moment));
    CHECK(std::abs(taut.frequency - fine.frequency) < std::abs(slack.frequency - fine.frequency));
  }
}

TEST_CASE("a rod's bending stiffness is told from a joint's, whatever the tension") {
  const chain::Chain chain =
      chain::make_chain(0.5, 0.01, -Vector3::UnitZ(), Vector3::UnitY(), 6, chain::Bending::planar, false, 0.01);
  for (const int joint : {1, 2, 6})
    for (const double tension : {0.0, 1e-9, 0.01, 1.0, 20.0})
      for (const double bending : {1e-12, 3e-4, 1e-3, 0.1, 10.0}) {
        const RodJoint at = rod_joint(chain, joint, bending, tension);
        CHECK(rod_stiffness(chain, joint, at.stiffness, tension) == doctest::Approx(bending).epsilon(1e-9));
        const double up = rod_joint(chain, joint, bending * 1.001, tension).stiffness;
        CHECK(at.slope == doctest::Approx((up - at.stiffness) / std::log(1.001)).epsilon(1e-2));
        if (tension == 0.0) CHECK(at.stiffness == bending / chain::bent_length(chain, joint));
      }
  // of a limp rope that is held at its first joint sqrt(EI T) remains, all of the rod's moment
  const chain::Chain held =
      chain::make_chain(0.5, 0.01, -Vector3::UnitZ(), Vector3::UnitY(), 6, chain::Bending::planar, false);
  CHECK(rod_joint(held, 1, 1e-12, 0.6).stiffness == doctest::Approx(std::sqrt(0.6e-12)).epsilon(1e-4));
  CHECK(rod_stiffness(chain, 1, 0.0, 1.0) == 0.0);
  CHECK(rod_joint(chain, 1, 0.0, 1.0).stiffness == 0.0);
  CHECK(std::isfinite(rod_stiffness(chain, 1, 1e-12, 1e3)));
}

TEST_CASE("a hanging rope carries its weight at the grasp, a level or a standing one and one on a table nothing") {
  const Model model = hanging({0.4, 0.08, 0.02, 1e-3, 0.0}, 4, true);
  const auto tension = [&](const Vector3& axis, double turn, const Parameters& p) {
    math::Pose base;
    base.rotation = Eigen::AngleAxisd(turn, axis).toRotationMatrix();
    return grasp_tension(p, first_direction(model.chain, VectorX::Zero(4), base));
  };
  CHECK(tension(Vector3::UnitX(), 0.0, model.parameters) == doctest::Approx(0.1 * 9.81));
  CHECK(tension(Vector3::UnitX(), M_PI / 3, model.parameters) == doctest::Approx(0.5 * 0.1 * 9.81));
  CHECK(tension(Vector3::UnitY(), 3.0, model.parameters) == 0.0);
  Parameters flat = model.parameters;
  flat.table_normal = Vector3::UnitZ();
  CHECK(tension(Vector3::UnitX(), 0.0, flat) == 0.0);
}
