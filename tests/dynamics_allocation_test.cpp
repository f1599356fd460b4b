// No allocation inside a step: every allocation of the program goes through the malloc below and is counted.
#include <doctest/doctest.h>
#include <cstdlib>

#include "chainsplat/dynamics.h"

// where a sanitizer has taken malloc, its own is left alone
#if defined(__has_feature)  // Clang's way to say so
#if __has_feature(address_sanitizer) || __has_feature(thread_sanitizer)
#define CHAINSPLAT_SANITIZED
#endif
#elif defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
#define CHAINSPLAT_SANITIZED
#endif
#if defined(__GLIBC__) && !defined(CHAINSPLAT_SANITIZED)

namespace {
thread_local long allocations = 0;
}
extern "C" {
void* __libc_malloc(std::size_t size);
void* malloc(std::size_t size) {
  ++allocations;
  return __libc_malloc(size);
}
}

using namespace chainsplat;
using namespace chainsplat::dynamics;
using math::Vector3;
using math::VectorX;

namespace {

Model rope(chain::Bending bending, bool table) {
  const chain::Chain chain = chain::make_chain(0.3, 0.02, -Vector3::UnitZ(), Vector3::UnitY(), 8, bending, false);
  const auto fill = [](int count, double value) { return std::vector<double>(count, value); };
  Parameters p;
  p.link_mass = fill(8, 0.0075), p.viscous_friction = fill(8, 0.002), p.coulomb_friction = fill(8, 0.05);
  p.air_linear = fill(8, 0.0005), p.air_quadratic = fill(8, 5e-4);
  p.stiffness = fill(chain.angles(), 0.012), p.rest_angle = fill(chain.angles(), 0.03);
  p.damping = fill(chain.angles(), 3.6e-4);
  p.tip_mass = 0.002, p.radius = 0.01;
  if (table) p.table_normal = Vector3(0.1, 0.2, 1.0).normalized();
  return make_model(chain, p);
}

trajectory::BaseMotion base_at(double time) {
  trajectory::BaseMotion base;
  base.pose.translation.x() = 0.1 * time * time;
  base.velocity[3] = 0.2 * time;
  base.acceleration[3] = 0.2;
  return base;
}

}  // namespace

TEST_CASE("the counter counts") {
  const long before = allocations;
  VectorX some = VectorX::Zero(50);
  CHECK(some.size() == 50);
  CHECK(allocations > before);
}

TEST_CASE("no allocation inside a step") {
  for (const chain::Bending bending : {chain::Bending::planar, chain::Bending::spatial})
    for (const Integrator integrator : {Integrator::rodas3, Integrator::implicit_velocity_euler}) {
      Model model = rope(bending, true);
      model.parameters.integrator = integrator;
      const BaseGrid grid = sample_base(base_at, 0.0, {0.2}, 4);
      VectorX theta = VectorX::Zero(model.chain.angles()), thetadot = theta;
      Stepper stepper(model);
      const long before = allocations;
      for (std::size_t k = 0; k + 1 < grid.nodes.size(); ++k)
        stepper.step(grid.nodes[k], grid.nodes[k + 1].motion, theta, thetadot);
      stepper.acceleration(grid.nodes[0].motion, theta, thetadot);
      CHECK(allocations == before);
      CHECK(theta.norm() > 0.0);
    }
}

TEST_CASE("a rollout with sensitivities allocates as often for 40 frames as for 20") {
  const Model model = rope(chain::Bending::spatial, true);
  std::vector<Tangent> unknowns(3);
  unknowns[0].stiffness.assign(16, 0.01);
  unknowns[1].link_mass.assign(8, 0.01);
  unknowns[2].coulomb_friction.assign(8, 0.1);
  const VectorX rest = VectorX::Zero(16);
  const auto count = [&](int frames) {
    std::vector<double> times;
    for (int k = 1; k <= frames; ++k) times.push_back(k / 30.0);
    const BaseGrid grid = sample_base(base_at, 0.0, times, 4);
    chain::States states;
    Sensitivities slopes;
    REQUIRE(simulate(model, grid, rest, rest, states, unknowns, &slopes));
    const long before = allocations;
    REQUIRE(simulate(model, grid, rest, rest, states, unknowns, &slopes));  // its results have their place now
    return allocations - before;
  };
  CHECK(count(40) == count(20));
}

#endif
