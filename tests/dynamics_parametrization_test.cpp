#include "chainsplat/dynamics/parametrization.h"

#include <doctest/doctest.h>
#include <cmath>

using namespace chainsplat;
using namespace chainsplat::dynamics;

namespace {

struct Rope {
  const char* name;
  chain::Chain chain;
  Parameters parameters;
};

// All numbers differ and none is 0, but what only a table or only the air has.
Rope make_rope(const char* name, chain::Bending bending, bool twist, bool table) {
  Rope rope{name, chain::make_chain(0.3, 0.02, -Vector3::UnitZ(), Vector3::UnitY(), 4, bending, twist, 0.02), {}};
  core::Random random(3);
  const auto fill = [&](int count, double scale) {
    std::vector<double> values(count);
    for (double& v : values) v = scale * random.uniform(0.5, 1.5);
    return values;
  };
  const int links = rope.chain.links() - 1, n = rope.chain.angles();
  Parameters& p = rope.parameters;
  p.link_mass = fill(links, 0.015), p.tip_mass = table ? 0.0 : 0.003, p.tip_length = table ? 0.0 : 0.02;
  p.viscous_friction = fill(links, table ? 0.002 : 0.0), p.coulomb_friction = fill(links, table ? 0.3 : 0.0);
  p.air_linear = fill(links, table ? 0.0 : 5e-4), p.air_quadratic = fill(links, table ? 0.0 : 1e-3);
  p.stiffness = fill(n, 0.012), p.damping = fill(n, 4e-4), p.rest_angle = fill(n, 0.1);
  if (table) p.roll_lever = fill(n, 0.001);
  if (!table) p.bending_friction = fill(n, 0.002), p.bending_friction_angle = fill(n, 0.05);
  if (bending == chain::Bending::spatial) p.torsional_stiffness = fill(links, 0.01);
  return rope;
}

std::vector<Rope> ropes() {
  return {make_rope("planar", chain::Bending::planar, false, false),
          make_rope("spatial", chain::Bending::spatial, false, false),
          make_rope("twist", chain::Bending::spatial, true, false),
          make_rope("table", chain::Bending::planar, false, true)};
}

// Every unknown that the chain has a number for.
std::vector<Unknown> all_unknowns(const chain::Chain& chain) {
  std::vector<Unknown> out;
  for (int q = 1; q <= static_cast<int>(Quantity::friction_state); ++q)
    for (int index = 0; index < 30; ++index) {
      const Unknown unknown{static_cast<Quantity>(q), index};
      Estimates named;
      named.names = {name_of(unknown)};
      if (unknowns_of(chain, named)[0] == unknown) out.push_back(unknown);
    }
  return out;
}

constexpr std::pair<std::vector<double> Parameters::*, std::vector<double> Tangent::*> kArrays[] = {
    {&Parameters::link_mass, &Tangent::link_mass},
    {&Parameters::viscous_friction, &Tangent::viscous_friction},
    {&Parameters::coulomb_friction, &Tangent::coulomb_friction},
    {&Parameters::air_linear, &Tangent::air_linear},
    {&Parameters::air_quadratic, &Tangent::air_quadratic},
    {&Parameters::stiffness, &Tangent::stiffness},
    {&Parameters::rest_angle, &Tangent::rest_angle},
    {&Parameters::damping, &Tangent::damping},
    {&Parameters::roll_lever, &Tangent::roll_lever},
    {&Parameters::bending_friction, &Tangent::bending_friction},
    {&Parameters::bending_friction_angle, &Tangent::bending_friction_angle},
    {&Parameters::torsional_stiffness, &Tangent::torsional_stiffness}};

}  // namespace

TEST_CASE("names are read as they are written, and those of other chains and programs mean nothing") {
  for (const Rope& rope : ropes()) {
    CAPTURE(rope.name);
    const std::vector<Unknown> all = all_unknowns(rope.chain);
    const int n = rope.chain.angles(), links = rope.chain.links() - 1;
    CHECK(all.size() == static_cast<std::size_t>(11 + 5 * links + 5 * n));
    Estimates e;
    for (const Unknown& unknown : all) {
      e.names.push_back(name_of(unknown));
      CHECK(unknown_named(e.names.back()) == unknown);
      CHECK(std::string(unit_of(unknown.quantity)) != "");
    }
    CHECK(unknowns_of(rope.chain, e) == all);
    CHECK(parameters_among(all).size() == all.size() - 3 * static_cast<std::size_t>(n));
    CHECK(initial_state_unknowns(rope.chain) == std::vector<Unknown>(all.end() - 3 * n, all.end() - n));
  }
  CHECK(name_of({Quantity::link_mass, 2}) == "log_mass_link_3");
  CHECK(unknown_named("rest_angle") == Unknown{Quantity::rest_angle, kEvery});
  CHECK(unknown_named("log_stiffness_joint_12") == Unknown{Quantity::joint_stiffness, 11});
  const chain::Chain chain = ropes()[0].chain;
  Estimates other;
  other.names = {
      "log_mass_link_5", "log_mass_link_0", "log_mass_link_", "log_mass_link_1x", "rest_angle", "bending", "12", "",
      "theta_9999999",   "log_stiffness_1"};
  for (const Unknown& unknown : unknowns_of(chain, other)) CHECK(unknown == Unknown{});
  const Parameters p = ropes()[0].parameters;
  const Unknown nothing[] = {{}};
  CHECK(moved(chain, p, nothing, VectorX::Ones(1)).stiffness == p.stiffness);
  CHECK(tangents(chain, p, nothing)[0].stiffness.empty());
  CHECK_FALSE(has_effect(chain, p, nothing[0]));
}

TEST_CASE("tangents agree with central differences of the moved parameters, for every quantity") {
  constexpr double kStep = 1e-5;  // of a logarithm or an angle
  for (const Rope& rope : ropes()) {
    CAPTURE(rope.name);
    const std::vector<Unknown> all = all_unknowns(rope.chain);
    const auto size = static_cast<Eigen::Index>(all.size());
    // about parameters that are not the reference
    core::Random random(7);
    VectorX at(size);
    for (double& x : at) x = 0.2 * random.normal();
    const InitialState zero{0.0, VectorX::Zero(rope.chain.angles()), VectorX::Zero(rope.chain.angles())};
    const Parameters p = moved(rope.chain, rope.parameters, all, at);
    const std::vector<Tangent> found = tangents(rope.chain, p, all);
    double largest = 0.0;  // relative difference of all; not 0, or a thing is compared with itself
    for (Eigen::Index i = 0; i < size; ++i) {
      CAPTURE(name_of(all[i]));
      const VectorX step = kStep * VectorX::Unit(size, i);
      const Parameters up = moved(rope.chain, rope.parameters, all, at + step),
                       down = moved(rope.chain, rope.parameters, all, at - step);
      bool effect = false;
      const auto compare = [&](double expected, double slope, double scale) {
        largest = std::max(largest, std::abs(expected - slope) / scale);
        effect |= slope != 0.0;
        CHECK(std::abs(expected - slope) <= 1e-8 * scale);
      };
      for (const auto& [values, slopes] : kArrays) {
        const std::vector<double>& slope = found[i].*slopes;
        CHECK((slope.empty() || slope.size() == (p.*values).size()));
        for (std::size_t k = 0; k < (p.*values).size(); ++k)
          compare(((up.*values)[k] - (down.*values)[k]) / (2.0 * kStep), slope.empty() ? 0.0 : slope[k],
                  std::max((p.*values)[k], 1e-3));
      }
      compare((up.tip_mass - down.tip_mass) / (2.0 * kStep), found[i].tip_mass, std::max(p.tip_mass, 1e-3));
      compare((up.tip_length - down.tip_length) / (2.0 * kStep), found[i].tip_length, std::max(p.tip_length, 1e-3));
      CHECK(std::abs(total_mass(up) - total_mass(rope.parameters)) < 1e-15);
      const InitialState moved_up = moved(zero, all, at + step), moved_down = moved(zero, all, at - step);
      for (const auto& [value, slope] : {std::pair{&InitialState::theta, &Tangent::theta},
                                         {&InitialState::thetadot, &Tangent::thetadot},
                                         {&InitialState::internal_state, &Tangent::internal_state}}) {
        const VectorX difference = (moved_up.*value - moved_down.*value) / (2.0 * kStep);
        const VectorX& s = found[i].*slope;
        CHECK((difference - (s.size() ? s : VectorX::Zero(difference.size()).eval())).norm() < 1e-9);
      }
      CHECK(effect == has_effect(rope.chain, p, all[i]));
    }
    CHECK(largest > 0.0);
  }
}

TEST_CASE("changes add up, and do what the names say") {
  for (const Rope& rope : ropes()) {
    CAPTURE(rope.name);
    const std::vector<Unknown> all = all_unknowns(rope.chain);
    core::Random random(11);
    VectorX a(all.size()), b(all.size());
    for (double& x : a) x = 0.3 * random.normal();
    for (double& x : b) x = 0.3 * random.normal();
    const Parameters once = moved(rope.chain, rope.parameters, all, a + b),
                     twice = moved(rope.chain, moved(rope.chain, rope.parameters, all, a), all, b);
    for (const auto& [values, slopes] : kArrays)
      for (std::size_t k = 0; k < (once.*values).size(); ++k)
        CHECK((once.*values)[k] == doctest::Approx((twice.*values)[k]).epsilon(1e-12));
    CHECK(once.tip_mass == doctest::Approx(twice.tip_mass).epsilon(1e-12));
  }
  const Rope rope = ropes()[2];  // three angles a joint: bending, bending, twist
  const Parameters& p = rope.parameters;
  const auto change = [&](Unknown unknown, double by) {
    return moved(rope.chain, p, {&unknown, 1}, VectorX::Constant(1, by));
  };
  for (int k = 0; k < rope.chain.angles(); ++k) {
    const auto factor = [&](Unknown unknown) { return change(unknown, std::log(2.0)).stiffness[k] / p.stiffness[k]; };
    CHECK(factor({Quantity::stiffness}) == doctest::Approx(2.0));
    CHECK(factor({Quantity::grasp_stiffness}) == doctest::Approx(k == 1 ? 2.0 : 1.0));
    CHECK(factor({Quantity::twist_stiffness}) == doctest::Approx(k % 3 == 2 ? 2.0 : 1.0));
    CHECK(factor({Quantity::joint_stiffness, 1}) == doctest::Approx(k / 3 == 1 ? 2.0 : 1.0));
    CHECK(factor({Quantity::damping}) == 1.0);
  }
  const double mass = total_mass(p), odds = p.tip_mass / (mass - p.tip_mass);
  const double tip = change({Quantity::tip_mass}, std::log(3.0)).tip_mass;
  CHECK(tip / (mass - tip) == doctest::Approx(3.0 * odds));
  const Parameters heavy = change({Quantity::link_mass, 0}, std::log(2.0));
  CHECK(heavy.link_mass[0] / heavy.link_mass[1] == doctest::Approx(2.0 * p.link_mass[0] / p.link_mass[1]));
  CHECK(heavy.tip_mass == p.tip_mass);
  // a total mass that is held makes ratios of the reference's
  const Parameters scaled = moved(rope.chain, p, {}, VectorX(), 1.0);
  CHECK(total_mass(scaled) == doctest::Approx(1.0));
  CHECK(scaled.link_mass[2] / scaled.link_mass[1] == doctest::Approx(p.link_mass[2] / p.link_mass[1]));
}
