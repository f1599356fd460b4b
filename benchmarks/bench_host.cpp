// bench_host - times of the dynamics on one core, beside MuJoCo in the same process where it is installed.
//
// The chain of DYNAMICS in the README: 30 cm, 60 g, hinges (planar) or crossed pairs of hinges (spatial), stiff and
// damped joints, no contacts. Run: build/bench/bench_host [--benchmark_filter=REGEX].
#include <benchmark/benchmark.h>

#include <cmath>
#include <string>

#include "chainsplat/dynamics.h"
#include "chainsplat/identification.h"

#ifdef CHAINSPLAT_WITH_MUJOCO
#include <mujoco/mujoco.h>

#include <cstdio>
#include <filesystem>
#include <stdexcept>
#endif

namespace {

using namespace chainsplat;
using math::Vector3;
using math::VectorX;

constexpr double kLength = 0.3, kDiameter = 0.02, kMass = 0.06;          // m, m, kg
constexpr double kStiffness = 0.012, kDamping = 3.6e-4, kDrag = 0.0144;  // N m/rad, N m s/rad, N s^2/m^2 a meter

// What is inside of the rope's equations beside joints and inertia.
enum class Surroundings { none, air, table };

dynamics::Model rope(int joints, chain::Bending bending, Surroundings around) {
  const bool table = around == Surroundings::table;
  const chain::Chain chain = chain::make_chain(kLength, kDiameter, table ? Vector3(0, 1, 0) : Vector3(0, 0, -1),
                                               table ? Vector3(0, 0, 1) : Vector3(0, 1, 0), joints, bending, false);
  dynamics::Parameters p;
  const auto filled = [](int count, double value) { return std::vector<double>(count, value); };
  const int n = chain.angles();
  p.link_mass = filled(joints, kMass / joints);
  p.viscous_friction = filled(joints, 0.0);
  p.coulomb_friction = filled(joints, table ? 0.35 : 0.0);
  p.air_linear = filled(joints, 0.0);
  p.air_quadratic = filled(joints, around == Surroundings::air ? kDrag * kLength / joints : 0.0);
  p.stiffness = filled(n, kStiffness);
  p.rest_angle = filled(n, 0.0);
  p.damping = filled(n, kDamping);
  p.radius = 0.5 * kDiameter;
  if (table) p.table_normal = Vector3(0, 0, 1);
  return dynamics::make_model(chain, p);
}

// 15 cm along x and back at 0.4 Hz.
trajectory::BaseMotion base_at(double time) {
  constexpr double kAmplitude = 0.075, kRate = 2.0 * M_PI * 0.4;
  trajectory::BaseMotion base;
  base.pose.translation.x() = kAmplitude * (1.0 - std::cos(kRate * time));
  base.velocity[3] = kAmplitude * kRate * std::sin(kRate * time);
  base.acceleration[3] = kAmplitude * kRate * kRate * std::cos(kRate * time);
  return base;
}

std::vector<double> frame_times(int frames) {
  std::vector<double> times(frames);
  for (int k = 0; k < frames; ++k) times[k] = k / 30.0;
  return times;
}

VectorX bent(int angles) {
  VectorX theta(angles);
  for (int k = 0; k < angles; ++k) theta[k] = 0.2 * std::sin(1.0 + k);
  return theta;
}

chain::Bending bending_of(const benchmark::State& state) {
  return state.range(1) == 1 ? chain::Bending::planar : chain::Bending::spatial;
}

// Arguments of the chains: joints, axes a joint.
void chains(benchmark::internal::Benchmark* b) {
  b->ArgNames({"joints", "axes"})->Args({8, 1})->Args({8, 2})->Args({32, 1});
}

void forward_dynamics(benchmark::State& state) {
  const dynamics::Model model = rope(static_cast<int>(state.range(0)), bending_of(state), Surroundings::none);
  dynamics::Stepper stepper(model);
  const trajectory::BaseMotion base = base_at(0.3);
  VectorX theta = bent(model.chain.angles());
  const VectorX thetadot = -theta;
  for (auto _ : state) {
    theta[0] += 1e-9;
    benchmark::DoNotOptimize(stepper.acceleration(base, theta, thetadot)[0]);
  }
}
BENCHMARK(forward_dynamics)->Apply(chains);

void step(benchmark::State& state, dynamics::Integrator integrator) {
  dynamics::Model model = rope(static_cast<int>(state.range(0)), bending_of(state), Surroundings::none);
  model.parameters.integrator = integrator;
  dynamics::Stepper stepper(model);
  dynamics::BaseGrid grid = dynamics::sample_base(base_at, 0.3, {0.3 + 1.0 / 120.0}, 4);
  const VectorX theta0 = bent(model.chain.angles()), thetadot0 = -theta0;
  VectorX theta, thetadot;
  for (auto _ : state) {
    theta = theta0, thetadot = thetadot0;
    if (!stepper.step(grid.nodes[0], grid.nodes[1].motion, theta, thetadot)) state.SkipWithError("diverged");
    benchmark::DoNotOptimize(theta[0]);
  }
}
BENCHMARK_CAPTURE(step, implicit_velocity, dynamics::Integrator::implicit_velocity_euler)->Apply(chains);
BENCHMARK_CAPTURE(step, rodas3, dynamics::Integrator::rodas3)->Apply(chains);

void rollout(benchmark::State& state, dynamics::Integrator integrator, int substeps, chain::Bending bending,
             Surroundings around) {
  dynamics::Model model = rope(8, bending, around);
  model.parameters.integrator = integrator;
  const dynamics::BaseGrid grid = dynamics::sample_base(base_at, 0.0, frame_times(151), substeps);
  const VectorX rest = VectorX::Zero(model.chain.angles());
  chain::States states;
  for (auto _ : state)
    if (!dynamics::simulate(model, grid, rest, rest, states)) state.SkipWithError("diverged");
}
BENCHMARK_CAPTURE(rollout, paper_150_steps, dynamics::Integrator::implicit_velocity_euler, 1, chain::Bending::planar,
                  Surroundings::none)
    ->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(rollout, rodas3_600_steps, dynamics::Integrator::rodas3, 4, chain::Bending::planar,
                  Surroundings::none)
    ->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(rollout, rodas3_600_steps_air, dynamics::Integrator::rodas3, 4, chain::Bending::planar,
                  Surroundings::air)
    ->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(rollout, rodas3_600_steps_table, dynamics::Integrator::rodas3, 4, chain::Bending::planar,
                  Surroundings::table)
    ->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(rollout, rodas3_600_steps_16_angles_air, dynamics::Integrator::rodas3, 4, chain::Bending::spatial,
                  Surroundings::air)
    ->Unit(benchmark::kMillisecond);

// Stiffness and damping of every joint and the mass of every link: 24.
std::vector<dynamics::Tangent> unknowns_of(const dynamics::Model& model) {
  const dynamics::Parameters& p = model.parameters;
  std::vector<dynamics::Tangent> unknowns;
  for (int j = 0; j + 1 < model.chain.links(); ++j) {
    dynamics::Tangent stiffness, damping, mass;
    stiffness.stiffness.assign(p.stiffness.size(), 0.0);
    damping.damping.assign(p.damping.size(), 0.0);
    for (int k = 0; k < model.chain.angles(); ++k)
      if (model.chain.child_link[k] == j + 1)
        stiffness.stiffness[k] = p.stiffness[k], damping.damping[k] = p.damping[k];
    mass.link_mass.assign(p.link_mass.size(), 0.0);
    mass.link_mass[j] = p.link_mass[j];
    for (const auto& unknown : {stiffness, damping, mass}) unknowns.push_back(unknown);
  }
  return unknowns;
}

void sensitivities(benchmark::State& state, chain::Bending bending, Surroundings around) {
  const dynamics::Model model = rope(8, bending, around);
  const auto unknowns = unknowns_of(model);
  const dynamics::BaseGrid grid = dynamics::sample_base(base_at, 0.0, frame_times(151), 4);
  const VectorX rest = VectorX::Zero(model.chain.angles());
  chain::States states;
  dynamics::Sensitivities slopes;
  for (auto _ : state)
    if (!dynamics::simulate(model, grid, rest, rest, states, unknowns, &slopes)) state.SkipWithError("diverged");
}
BENCHMARK_CAPTURE(sensitivities, planar_24, chain::Bending::planar, Surroundings::none)->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(sensitivities, planar_24_table, chain::Bending::planar, Surroundings::table)
    ->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(sensitivities, spatial_24_air, chain::Bending::spatial, Surroundings::air)
    ->Unit(benchmark::kMillisecond);

void identification(benchmark::State& state, chain::Bending bending, Surroundings around) {
  const dynamics::Model truth = rope(8, bending, around);
  const int n = truth.chain.angles();
  std::vector<trajectory::Sample> samples;
  for (int k = 0; k <= 500; ++k) samples.push_back({k / 100.0, base_at(k / 100.0).pose});
  const trajectory::Trajectory base = trajectory::fit(samples, "benchmark");
  chain::States seen = dynamics::rollout(truth, base, {0.0, VectorX::Zero(n), VectorX::Zero(n)}, frame_times(150));
  core::Random random(1);
  for (VectorX& theta : seen.theta)
    for (double& angle : theta) angle += 0.5 * M_PI / 180.0 * random.normal();
  seen.thetadot.clear();
  identification::Options options;
  options.mass = kMass;
  options.tabletop = around == Surroundings::table;
  core::set_threads(1);
  double rms = 0.0;
  for (auto _ : state) rms = identification::identify(truth.chain, base, seen, options).node_rms;
  state.counters["node_rms_mm"] = 1e3 * rms;
}
BENCHMARK_CAPTURE(identification, planar_air, chain::Bending::planar, Surroundings::air)
    ->Unit(benchmark::kMillisecond)
    ->Iterations(2);
BENCHMARK_CAPTURE(identification, planar_table, chain::Bending::planar, Surroundings::table)
    ->Unit(benchmark::kMillisecond)
    ->Iterations(2);
BENCHMARK_CAPTURE(identification, spatial_air, chain::Bending::spatial, Surroundings::air)
    ->Unit(benchmark::kMillisecond)
    ->Iterations(2);

#ifdef CHAINSPLAT_WITH_MUJOCO
// The same chain with a fixed base; capsules stand for cylinders, contacts are off.
std::string mjcf(int joints, int axes, const char* integrator) {
  const double l = kLength / joints;
  char text[512];
  std::snprintf(
      text, sizeof text,
      "<mujoco><option timestep='%.17g' integrator='%s' gravity='0 0 -9.81'><flag contact='disable'/></option>"
      "<worldbody>",
      1.0 / 120.0, integrator);
  std::string out = text;
  for (int j = 0; j < joints; ++j) {
    std::snprintf(text, sizeof text, "<body pos='0 0 %.17g'>", j == 0 ? 0.0 : -l);
    out += text;
    for (int k = 0; k < axes; ++k) {
      std::snprintf(text, sizeof text, "<joint type='hinge' axis='%s' stiffness='%g' damping='%g'/>",
                    k == 0 ? "0 1 0" : "1 0 0", kStiffness, kDamping);
      out += text;
    }
    std::snprintf(text, sizeof text, "<geom type='cylinder' fromto='0 0 0 0 0 %.17g' size='%g' mass='%.17g'/>", -l,
                  0.5 * kDiameter, kMass / joints);
    out += text;
  }
  for (int j = 0; j < joints; ++j) out += "</body>";
  return out + "</worldbody></mujoco>";
}

struct Peer {
  mjModel* model;
  mjData* data;
  Peer(int joints, int axes, const char* integrator) {
    const std::string xml = mjcf(joints, axes, integrator);
    const auto file = std::filesystem::temp_directory_path() / "chainsplat_bench_host.xml";
    core::write_file(file, xml);
    char error[500] = "";
    model = mj_loadXML(file.c_str(), nullptr, error, sizeof error);
    std::filesystem::remove(file);
    if (!model) throw std::runtime_error(error);
    data = mj_makeData(model);
    place();
  }
  ~Peer() { mj_deleteData(data), mj_deleteModel(model); }
  void place() {
    for (int k = 0; k < model->nq; ++k) data->qpos[k] = 0.2 * std::sin(1.0 + k), data->qvel[k] = -data->qpos[k];
  }
};

void mujoco_forward(benchmark::State& state) {
  const Peer peer(static_cast<int>(state.range(0)), static_cast<int>(state.range(1)), "Euler");
  for (auto _ : state) {
    peer.data->qpos[0] += 1e-9;
    mj_forward(peer.model, peer.data);
    benchmark::DoNotOptimize(peer.data->qacc[0]);
  }
}
BENCHMARK(mujoco_forward)->Apply(chains);

void mujoco_step(benchmark::State& state, const char* integrator) {
  Peer peer(static_cast<int>(state.range(0)), static_cast<int>(state.range(1)), integrator);
  for (auto _ : state) {
    peer.place();
    mj_step(peer.model, peer.data);
    benchmark::DoNotOptimize(peer.data->qpos[0]);
  }
}
BENCHMARK_CAPTURE(mujoco_step, euler, "Euler")->Apply(chains);
BENCHMARK_CAPTURE(mujoco_step, implicit, "implicit")->Apply(chains);
BENCHMARK_CAPTURE(mujoco_step, rk4, "RK4")->Apply(chains);
#endif

}  // namespace

BENCHMARK_MAIN();
