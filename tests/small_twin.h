// tests/small_twin.h - a twin made by hand, for tests of modules that store, draw and export twins.
#pragma once
#include <cmath>
#include <random>

#include "chainsplat/twin.h"

namespace chainsplat::test {

// Gaussians of degree 1 on a spiral around the rope at home, with colors that vary along and around it; each has one
// link with a probability of nearly 1.
inline splat::Gaussians spiral_gaussians(const chain::Chain& chain, int count) {
  splat::Gaussians g;
  g.resize(count, chain.links(), 1);
  const math::Vector3 side = chain.bending_axis, other = chain.direction.cross(side);
  core::Random random(3);
  for (int i = 0; i < count; ++i) {
    const double arclength = chain.length * (i + 0.5) / count, angle = 2.4 * i;
    const math::Vector3 normal = std::cos(angle) * side + std::sin(angle) * other;
    const math::Vector3 mean = arclength * chain.direction + 0.35 * chain.diameter * normal;
    const Eigen::Quaterniond turn(Eigen::AngleAxisd(angle, chain.direction));
    const double wxyz[4] = {turn.w(), turn.x(), turn.y(), turn.z()};
    for (int c = 0; c < 3; ++c) {
      g.mean[3 * i + c] = static_cast<float>(mean[c]);
      g.log_scale[3 * i + c] = static_cast<float>(std::log(c == 2 ? 0.006 : 0.004));
      g.sh[12 * i + c] = static_cast<float>(1.2 * std::sin(9.0 * i / count + 2.0 * c));
      for (int l = 1; l < 4; ++l) g.sh[12 * i + 3 * l + c] = static_cast<float>(random.uniform(-0.1, 0.1));
    }
    for (int c = 0; c < 4; ++c)
      g.rotation[4 * i + c] = static_cast<float>(1.3 * wxyz[c]);  // files need not be normalized
    g.opacity_logit[i] = 2.0f;
    for (int j = 0; j < g.links; ++j)
      g.link_logits[g.links * i + j] = j == chain::link_at(chain, arclength) ? 12.0f : 0.1f * static_cast<float>(j);
  }
  return g;
}

// States of a swing of `seconds` at 30 Hz about every axis, larger toward the tip.
inline chain::States swing(const chain::Chain& chain, double seconds, double start = 0.0) {
  chain::States states;
  for (int k = 0; k <= std::lround(30 * seconds); ++k) {
    const double t = start + k / 30.0;
    math::VectorX theta(chain.angles()), rate(chain.angles());
    for (int a = 0; a < chain.angles(); ++a) {
      const double size = 0.15 + 0.05 * a / chain.angles(), speed = 4.0 + 0.3 * a;
      theta[a] = size * std::sin(speed * t + 0.4 * a);
      rate[a] = size * speed * std::cos(speed * t + 0.4 * a);
    }
    states.time.push_back(t);
    states.theta.push_back(theta);
    states.thetadot.push_back(rate);
  }
  return states;
}

// The base swings along x, turns about z and is 0.55 m above the ground.
inline trajectory::Trajectory moving_base(double seconds) {
  std::vector<trajectory::Sample> samples;
  for (int k = 0; k <= std::lround(60 * seconds); ++k) {
    const double t = k / 60.0;
    samples.push_back({t, {math::exp_so3({0, 0, 0.3 * std::sin(2 * t)}), {0.1 * std::sin(2.5 * t), 0.02 * t, 0.55}}});
  }
  return trajectory::fit(std::move(samples), "moving_base");
}

inline twin::Twin small_twin(chain::Bending bending = chain::Bending::spatial, int gaussians = 300) {
  twin::Twin twin;
  // the first joint is away from the grasp, and lengths are no short decimals
  twin.chain = chain::make_chain(0.3, 0.02, {0, 0, -1}, {0, 1, 0}, 5, bending, false, 0.013);
  twin.gaussians = spiral_gaussians(twin.chain, gaussians);
  twin.states = swing(twin.chain, 1.0);
  twin.rollout = swing(twin.chain, 1.0);
  for (math::VectorX& theta : twin.rollout.theta) theta *= 1.02;
  dynamics::Parameters p;
  core::Random random(1);
  for (int j = 1; j < twin.chain.links(); ++j) {
    const double length = twin.chain.link_end(j) - twin.chain.link_start(j);
    p.link_mass.push_back(0.01 * random.uniform(0.8, 1.2));
    p.viscous_friction.push_back(0.0);
    p.coulomb_friction.push_back(random.uniform());
    p.air_linear.push_back(0.0);
    p.air_quadratic.push_back(0.0144 / 3 * length);
  }
  for (int k = 0; k < twin.chain.angles(); ++k) {
    p.stiffness.push_back(random.uniform() * 1e-3);
    p.rest_angle.push_back(random.normal() * 0.1);
    p.damping.push_back(random.uniform() * 1e-4);
  }
  p.tip_mass = 0.0013;
  p.radius = 0.5 * twin.chain.diameter;
  twin.parameters = p;
  twin.initial = dynamics::InitialState{0.1, twin.states.theta[3], twin.states.thetadot[3]};
  twin.known_mass = true;
  twin.provenance.version = CHAINSPLAT_VERSION;
  twin.provenance.capture = "small";
  return twin;
}

// A folder under the system's temporary one that is removed at the end of its lifetime.
struct TemporaryFolder {
  Path path;
  explicit TemporaryFolder(const std::string& name)
      : path(std::filesystem::temp_directory_path() /
             ("chainsplat_" + name + "_" + std::to_string(std::random_device()()))) {
    std::filesystem::create_directories(path);
  }
  ~TemporaryFolder() { std::filesystem::remove_all(path); }
  TemporaryFolder(const TemporaryFolder&) = delete;
};

}  // namespace chainsplat::test
