// What recognition does when things go wrong: a lost device, too little device memory, gradients that are not finite,
// an optimization that runs away. The faults are made, not pretended: by limits on the device, bad numbers, huge steps.
// Cases that recognize a recording more than once are of the suite "whole".
#include <doctest/doctest.h>
#include <unistd.h>

#include <cmath>
#include <limits>

#include "chainsplat/recognition.h"
#include "src/recognition/step_watch.h"

using namespace chainsplat;
using namespace chainsplat::recognition;

namespace {

const capture::Capture& demo() {
  static const capture::Capture loaded = [] {
    capture::LoadOptions load;
    load.last = 6;
    return capture::load(Path(CHAINSPLAT_SOURCE_DIR) / "assets/demo_free_30", load);
  }();
  return loaded;
}

Options small_options() {
  Options options;
  options.joints = 3;
  options.bending = chain::Bending::planar;
  options.budget = 100;
  return options;
}

gpu::DevicePtr limited_device(std::uint64_t most_bytes, std::uint64_t most_submits) {
  gpu::DeviceOptions options;
  options.most_bytes = most_bytes;
  options.most_submits = most_submits;
  return gpu::open_device(options);
}

// Warnings while it lives.
struct Warnings {
  std::vector<std::string> lines;
  Warnings() {
    core::Listener listener;
    listener.warning = [this](const std::string& line) { lines.push_back(line); };
    core::set_listener(listener);
  }
  ~Warnings() { core::set_listener({}); }
  bool tell(const std::string& part) const {
    for (const std::string& line : lines)
      if (line.find(part) != std::string::npos) return true;
    return false;
  }
};

// What recognition gives where nothing goes wrong, and what it warns of meanwhile.
struct Undisturbed {
  Result result;
  std::vector<std::string> warnings;
};
const Undisturbed& undisturbed() {
  static const Undisturbed kept = [] {
    const gpu::DevicePtr device = gpu::open_device();
    Warnings warnings;
    Result result = recognize(*device, demo(), small_options());
    return Undisturbed{std::move(result), warnings.lines};
  }();
  return kept;
}

bool same(const Result& a, const Result& b) {
  return a.gaussians.mean == b.gaussians.mean && a.gaussians.sh == b.gaussians.sh && a.states.theta == b.states.theta;
}

}  // namespace

TEST_CASE("a lost device leaves a checkpoint, from which another device ends with the same bits" *
          doctest::test_suite("whole")) {
  const Path folder = std::filesystem::temp_directory_path() / ("chainsplat_faults_" + std::to_string(getpid()));
  std::filesystem::remove_all(folder);
  Options options = small_options();
  options.checkpoint = folder;
  constexpr std::uint64_t kInTheThirdRound = 260;  // submits
  const gpu::DevicePtr weak = limited_device(0, kInTheThirdRound);
  bool lost = false;
  try {
    recognize(*weak, demo(), options);
  } catch (const WorkError& error) {
    lost = std::string(error.what()).find("lost") != std::string::npos;
  }
  CHECK(lost);
  CHECK(std::filesystem::exists(folder / "recognize.before.bin"));
  const gpu::DevicePtr device = gpu::open_device();
  options.resume = true;
  const Result resumed = recognize(*device, demo(), options);
  CHECK(same(resumed, undisturbed().result));
  std::filesystem::remove_all(folder);
}

TEST_CASE("too little device memory: fewer views in a submission, a warning, and the same picture") {
  const chain::Chain chain =
      chain::make_chain(0.3, 0.02, -math::Vector3::UnitZ(), math::Vector3::UnitY(), 3, chain::Bending::planar, false);
  splat::Gaussians g;
  g.resize(300, chain.links(), 0);
  for (int i = 0; i < g.count; ++i) {
    g.mean[3 * i + 2] = static_cast<float>(-0.3 * (i + 0.5) / g.count);
    for (int c = 0; c < 3; ++c) g.log_scale[3 * i + c] = std::log(0.004f);
    g.link_logits[chain.links() * i + chain::link_at(chain, -g.mean[3 * i + 2])] = 12.0f;
  }
  std::vector<splat::ViewSpec> views;
  for (const capture::ViewPlace& view : demo().views)
    views.push_back({&demo().cameras[view.camera], 0, 0, 320, 240,
                     chain::link_motions(chain, math::VectorX::Zero(3), demo().base.pose(view.time))});
  const gpu::DevicePtr whole_device = gpu::open_device();
  splat::Engine whole(*whole_device);
  const auto expected = whole.draw(g, views);

  Warnings warnings;
  constexpr std::uint64_t kRoom = 8u << 20;      // of some 30 MB that 18 views take at once
  constexpr std::uint64_t kStaging = 16u << 20;  // where the host does not see the device's memory
  const gpu::DevicePtr small_device =
      limited_device(kRoom + (gpu::info(*whole_device).unified_memory ? 0 : kStaging), 0);
  splat::Engine small(*small_device);
  const auto pictures = small.draw(g, views);
  CHECK(warnings.tell("device memory is short"));
  REQUIRE(pictures.size() == expected.size());
  for (std::size_t v = 0; v < pictures.size(); ++v) CHECK(pictures[v].rgba == expected[v].rgba);

  // not even one view
  const gpu::DevicePtr tiny_device = limited_device(1u << 20, 0);
  splat::Engine tiny(*tiny_device);
  CHECK_THROWS_AS(tiny.draw(g, views), gpu::OutOfMemory);
}

TEST_CASE("gradients that are not finite move nothing and are counted") {
  const gpu::DevicePtr device = gpu::open_device();
  splat::Engine engine(*device);
  splat::Gaussians g;
  g.resize(2, 1, 0);
  for (int i = 0; i < 2; ++i) {
    g.mean[3 * i] = 0.02f * static_cast<float>(i);
    for (int c = 0; c < 3; ++c) g.log_scale[3 * i + c] = std::log(0.01f);
  }
  capture::Camera camera;
  camera.width = camera.height = 32;
  camera.fx = camera.fy = 200.0;
  camera.cx = camera.cy = 16.0;
  camera.world_from_camera.translation = math::Vector3(0, 0, -1);
  const std::vector<splat::ViewSpec> views{{&camera, 0, 0, 32, 32, {math::Pose{}}}};
  std::vector<std::uint8_t> target(4 * 32 * 32, 0);
  for (int c = 0; c < 4; ++c) target[4 * (16 * 32 + 16) + c] = 255;  // means are then taken over one pixel
  capture::View wanted;
  wanted.width = wanted.height = 32;
  wanted.rgba = target;
  const capture::PackedView packed = capture::packed(wanted);
  const std::vector<const capture::PackedView*> targets{&packed};
  engine.set_views(views, targets);
  splat::AdamRates rates;
  rates.mean = rates.sh0 = rates.opacity = 0.01f;
  const std::vector<int> batch{0};
  g.sh[0] = std::numeric_limits<float>::max();  // so bright that gradients overflow
  engine.set_gaussians(g);
  CHECK(engine.step(batch, {1.0f, 0.0f, 0.3f}, rates, true).not_finite > 0);
  const splat::Gaussians after = engine.gaussians();
  for (const float value : after.mean) CHECK(std::isfinite(value));
  for (const float value : after.opacity_logit) CHECK(std::isfinite(value));
  g.sh[0] = 0.0f;
  engine.set_gaussians(g);
  CHECK(engine.step(batch, {1.0f, 0.0f, 0.3f}, rates, true).not_finite == 0);
  CHECK(engine.gaussians().sh[0] != 0.0f);
}

TEST_CASE("a loss that doubles is a runaway, one that wavers is not; gradients may fail for a while only") {
  StepWatch watch;
  begin_round(watch);
  for (int k = 0; k < 100; ++k)
    CHECK(watch_loss(watch, 0.5 * std::exp(-0.03 * k) + (k % 2 ? 0.03 : 0.0)) == Course::fine);
  int steps = 1;
  while (watch_loss(watch, 0.5) == Course::fine) ++steps;
  CHECK(steps <= 3);
  begin_round(watch);
  CHECK(watch_loss(watch, 0.5) == Course::fine);  // of another round
  CHECK(watch_loss(watch, std::numeric_limits<double>::quiet_NaN()) == Course::diverged);
  StepWatch empty;  // nothing is drawn any more
  steps = 1;
  while (watch_loss(empty, steps == 1 ? 0.9 : 1.0) == Course::fine) ++steps;
  CHECK(steps == 5);

  Warnings warnings;
  for (int round = 0; round < 3; ++round) {
    for (int k = 0; k < 15; ++k) CHECK(watch_gradients(watch, 7, k) == Course::fine);
    CHECK(watch_gradients(watch, 0, 15) == Course::fine);
  }
  CHECK(watch.bad_steps == 45);
  CHECK(warnings.lines.size() == 1);
  steps = 1;
  while (watch_gradients(watch, 1, steps) == Course::fine) ++steps;
  CHECK(steps == 20);
}

TEST_CASE("an optimization that runs away is repeated with smaller steps, and given up with a diagnosis" *
          doctest::test_suite("whole")) {
  const gpu::DevicePtr device = gpu::open_device();
  Options options = small_options();
  CHECK(undisturbed().warnings.empty());
  {
    Warnings warnings;
    options.step = 200.0;
    const Result result = recognize(*device, demo(), options);
    CHECK(warnings.tell("is repeated from its start with steps of 0.25"));
    for (const float value : result.gaussians.mean) REQUIRE(std::isfinite(value));
  }
  {
    Warnings warnings;
    options.step = 1e30;
    bool told = false;
    try {
      recognize(*device, demo(), options);
    } catch (const WorkError& error) {
      told = std::string(error.what()).find("in round 1 at step sizes down to") != std::string::npos;
    }
    CHECK(told);
    CHECK(warnings.lines.size() >= 3);
  }
}
