#include "chainsplat/recognition.h"

#include <doctest/doctest.h>
#include <unistd.h>

#include <algorithm>
#include <cmath>
#include <functional>

#include "src/recognition/checkpoint.h"
#include "src/recognition/modes.h"
#include "src/recognition/refine_angles.h"

using namespace chainsplat;
using namespace chainsplat::recognition;

namespace {

const Path kDemo = Path(CHAINSPLAT_SOURCE_DIR) / "assets/demo_free_30";

gpu::Device& device() {
  static const gpu::DevicePtr opened = gpu::open_device({.selector = {}, .validation = true});
  return *opened;
}

void check_silent() {
  for (const std::string& text : gpu::validation_texts(device())) MESSAGE(text);
  CHECK(gpu::validation_messages(device()) == 0);
}

// RMS distance from the true centerline, m.
double centerline_rms(const chain::Chain& chain, const capture::Capture& capture, const chain::States& states) {
  const auto truth = capture::load_true_centerline(kDemo);
  REQUIRE(truth);
  double squares = 0.0;
  Eigen::Index count = 0;
  for (std::size_t k = 0; k < states.time.size(); ++k) {
    REQUIRE(std::abs(truth->time[k] - states.time[k]) < 1e-6);
    const auto motions = chain::link_motions(chain, states.theta[k], capture.base.pose(states.time[k]));
    const auto arclengths = chain::equal_arclengths(chain, static_cast<int>(truth->points[k].cols()));
    squares += (chain::centerline(chain, motions, arclengths) - truth->points[k]).squaredNorm();
    count += truth->points[k].cols();
  }
  return std::sqrt(squares / count);
}

}  // namespace

// A recording is recognized twice, so this is of the suite "whole".
TEST_CASE("the demo's first frames are recognized to half a millimeter, the same each time" *
          doctest::test_suite("whole")) {
  capture::LoadOptions load;
  load.last = 12;
  const capture::Capture capture = capture::load(kDemo, load);
  Options options;
  options.bending = chain::Bending::spatial;
  options.budget = 300;
  const Result first = recognize(device(), capture, options);
  CHECK(first.states.time.size() == 12);
  CHECK(centerline_rms(first.chain, capture, first.states) < 5e-4);
  const std::vector<std::uint8_t>& guessed = first.gaussians.guessed;
  CHECK(std::count(guessed.begin(), guessed.end(), 0) <= 300);
  CHECK(std::count(guessed.begin(), guessed.end(), 1) > 20);  // as dense as the others
  CHECK(std::count(guessed.begin(), guessed.end(), 1) < 120);
  const Result second = recognize(device(), capture, options);
  CHECK(first.gaussians.mean == second.gaussians.mean);
  for (std::size_t k = 0; k < first.states.theta.size(); ++k) CHECK(first.states.theta[k] == second.states.theta[k]);
  check_silent();
}

TEST_CASE("refined angles come back to where the picture was drawn") {
  // the target is drawn by the splatting itself at known angles; the start is off by 20 px at the tip
  const chain::Chain chain =
      chain::make_chain(0.3, 0.02, -math::Vector3::UnitZ(), math::Vector3::UnitY(), 4, chain::Bending::planar, false);
  capture::Capture capture;
  capture.cameras.resize(2);
  for (int c = 0; c < 2; ++c) {
    capture::Camera& camera = capture.cameras[c];
    camera.width = 200, camera.height = 240;
    camera.fx = camera.fy = 500.0;
    camera.cx = 100.0, camera.cy = 120.0;
    const double side = c == 0 ? -1.0 : 1.0;  // both look along +y, turned by 0.4 rad about z
    camera.world_from_camera.rotation.col(0) = math::Vector3(std::cos(0.4), side * std::sin(0.4), 0);
    camera.world_from_camera.rotation.col(1) = -math::Vector3::UnitZ();
    camera.world_from_camera.rotation.col(2) = math::Vector3(-side * std::sin(0.4), std::cos(0.4), 0);
    camera.world_from_camera.translation = math::Vector3(0, 0, -0.15) - 0.9 * camera.world_from_camera.rotation.col(2);
  }
  capture.base = trajectory::fit({{0.0, math::Pose{}}}, "test");
  splat::Gaussians g;
  g.resize(600, chain.links(), 0);
  core::Random random(5);
  for (int i = 0; i < g.count; ++i) {
    const double s = 0.3 * (i + 0.5) / g.count, angle = random.uniform(0.0, 6.283185307);
    const double home[3] = {0.008 * std::cos(angle), 0.008 * std::sin(angle), -s};
    for (int c = 0; c < 3; ++c) {
      g.mean[3 * i + c] = static_cast<float>(home[c]);
      g.log_scale[3 * i + c] = std::log(0.003f);
      g.sh[3 * i + c] = static_cast<float>(random.normal());
    }
    g.opacity_logit[i] = 2.0f;
    g.link_logits[g.links * i + chain::link_at(chain, s)] = 12.0f;
  }
  math::VectorX truth(4);
  truth << 0.15, -0.1, 0.2, 0.05;
  splat::Engine engine(device());
  const auto specs = [&](std::span<const int> views, std::span<const std::vector<math::Pose>> motions) {
    std::vector<splat::ViewSpec> out;
    for (std::size_t v = 0; v < views.size(); ++v)
      out.push_back({&capture.cameras[views[v]], 0, 0, 200, 240, motions[v]});
    return out;
  };
  const std::vector<int> both{0, 1};
  const std::vector<std::vector<math::Pose>> poses(2, chain::link_motions(chain, truth, math::Pose{}));
  const auto pictures = engine.draw(g, specs(both, poses));
  for (int c = 0; c < 2; ++c) {
    capture::View view;
    view.camera = c;
    view.width = 200, view.height = 240;
    view.rgba.resize(4 * 200 * 240);
    for (std::size_t k = 0; k < view.rgba.size(); ++k)
      view.rgba[k] = static_cast<std::uint8_t>(std::lround(255.0f * std::clamp(pictures[c].rgba[k], 0.0f, 1.0f)));
    capture.views.push_back(capture::packed(view));
  }
  chain::States states;
  states.time = {0.0};
  states.theta = {truth + (math::VectorX(4) << 0.04, -0.03, 0.03, 0.04).finished()};
  const std::vector<FrameViews> frames{{0.0, both}};
  int draws = 0;
  const Draw draw = [&](std::span<const int> views, std::span<const std::vector<math::Pose>> motions) {
    ++draws;
    return engine.draw(g, specs(views, motions), true);
  };
  RefineOptions options;
  options.iterations = 12;
  options.smooth_sigma = 100.0;  // no prior
  const std::vector<int> selected{0};
  const solve::Summary summary = refine_angles(chain, capture, frames, selected, draw, options, {}, states).summary;
  CHECK(summary.final_cost < 0.2 * summary.initial_cost);
  CHECK(solve::converged(summary));
  CHECK((states.theta[0] - truth).lpNorm<Eigen::Infinity>() < 2e-3);

  // a step within what is trusted is taken as it is, and drawn but for the equations; a longer one is checked
  const math::VectorX near = truth + math::VectorX::Constant(4, 2e-3);
  chain::States checked = states, trusted = states;
  checked.theta[0] = trusted.theta[0] = near;
  options.iterations = 1;
  draws = 0;
  refine_angles(chain, capture, frames, selected, draw, options, {}, checked);
  CHECK(draws == 2);
  options.trusted = 0.01;
  draws = 0;
  CHECK(refine_angles(chain, capture, frames, selected, draw, options, {}, trusted).steps == 1);
  CHECK(draws == 1);
  CHECK((trusted.theta[0] - truth).norm() < 0.5 * (near - truth).norm());
  CHECK(trusted.theta[0] == checked.theta[0]);
  options.trusted = 1e-5;
  draws = 0;
  trusted.theta[0] = near;
  refine_angles(chain, capture, frames, selected, draw, options, {}, trusted);
  CHECK(draws == 2);
  check_silent();
}

TEST_CASE("a job is another one when anything differs that its result depends on") {
  capture::Capture capture;
  for (const int frame : {0, 1, 2}) {
    capture::View view;
    view.frame = frame;
    view.time = 0.1 * frame;
    view.width = view.height = 1;
    view.rgba = {9, 9, 9, 255};
    capture.views.push_back(capture::packed(view));
  }
  const std::string job = job_text(capture, {});
  CHECK(job == job_text(capture, {}));
  CHECK(job.find("\nframes 0:3\n") != std::string::npos);
  const auto other_capture = [&](const std::function<void(capture::Capture&)>& change) {
    capture::Capture changed = capture;
    change(changed);
    CHECK(job_text(changed, {}) != job);
  };
  other_capture([](auto& c) { c.hash = 1; });
  other_capture([](auto& c) { c.views[1].time += 1e-3; });
  other_capture([](auto& c) { c.views[1].x0 = 1; });
  other_capture([](auto& c) { c.views[1].rgba[3] = 0; });
  other_capture([](auto& c) {
    for (capture::PackedView& view : c.views) view.frame += 10;
  });
  const auto other_options = [&](const std::function<void(Options&)>& change) {
    Options changed;
    change(changed);
    CHECK(job_text(capture, changed) != job);
  };
  other_options([](Options& o) { o.joints = 3; });
  other_options([](Options& o) { o.bending = chain::Bending::planar; });
  other_options([](Options& o) { o.twist = true; });
  other_options([](Options& o) { o.every = 1; });
  other_options([](Options& o) { o.mode = Mode::paper; });
  other_options([](Options& o) { o.seed = 1; });
  other_options([](Options& o) { o.budget = 100; });
  other_options([](Options& o) { o.step = 0.5; });
  other_options([](Options& o) { o.paper.gaussians = 100; });
  other_options([](Options& o) { o.paper.iterations = 100; });
  other_options([](Options& o) { o.paper.background = Background::white; });
  other_options([](Options& o) { o.paper.growth = false; });
  other_options([](Options& o) { o.paper.opacity_resets = false; });
  other_options([](Options& o) { o.paper.link_resets = false; });
}

TEST_CASE("a damaged checkpoint gives way to the one before; one of another job is refused") {
  const Path folder = std::filesystem::temp_directory_path() / ("chainsplat_checkpoint_" + std::to_string(getpid()));
  std::filesystem::remove_all(folder);
  static std::vector<std::string> warnings;
  warnings.clear();
  core::Listener listener;
  listener.warning = [](const std::string& line) { warnings.push_back(line); };
  core::set_listener(listener);
  CHECK_FALSE(load_checkpoint(folder, "job"));
  Checkpoint c;
  c.job = "job";
  c.states.time = {0.0, 0.1};
  c.states.theta = {math::VectorX::Ones(2), math::VectorX::Zero(2)};
  c.gaussians.resize(2, 3, 1);
  c.snapshot.gaussians.resize(1, 3, 0);
  c.watch.least_loss = 0.25;
  for (c.stage = 3; c.stage <= 4; ++c.stage) save_checkpoint(c, folder);
  const auto back = load_checkpoint(folder, "job");
  REQUIRE(back);
  CHECK(back->stage == 4);
  CHECK(back->states.theta[0] == c.states.theta[0]);
  CHECK(back->gaussians.sh.size() == 24);
  CHECK(back->snapshot.gaussians.count == 1);
  CHECK(back->watch.least_loss == 0.25);
  CHECK_THROWS_AS(load_checkpoint(folder, "another job"), InputError);
  c.job = "frames 0:20\n--joints 3\n--seed 0\n";
  save_checkpoint(c, folder / "other");
  const auto refusal = [&](const std::string& job) -> std::string {
    try {
      load_checkpoint(folder / "other", job);
    } catch (const InputError& error) {
      return error.what();
    }
    return "";
  };
  CHECK(refusal(c.job).empty());
  CHECK(refusal("frames 0:20\n--joints 4\n--seed 1\n").find("(`joints` 3, not 4); ") != std::string::npos);
  CHECK(refusal("frames 10:30\n--joints 3\n--seed 0\n").find("(frames 0:20, not 10:30); ") != std::string::npos);
  core::write_file(folder / "other/notes.txt", "somebody else's");
  remove_checkpoint(folder / "other");
  CHECK_FALSE(std::filesystem::exists(folder / "other/recognize.bin"));
  CHECK(std::filesystem::exists(folder / "other/notes.txt"));
  CHECK(warnings.empty());
  const Path last = folder / "recognize.bin", before = folder / "recognize.before.bin";
  const std::string bytes = core::read_file(last), whole = core::read_file(before);
  for (const std::size_t place : {std::size_t{3}, std::size_t{30}, bytes.size() / 2, bytes.size() - 1}) {
    std::string damaged = bytes;
    damaged[place] ^= 1;
    core::write_file(last, damaged);
    REQUIRE(load_checkpoint(folder, "job"));
    CHECK(load_checkpoint(folder, "job")->stage == 3);
  }
  CHECK(warnings.size() == 8);
  for (const std::size_t length : {std::size_t{0}, std::size_t{10}, bytes.size() - 5}) {
    core::write_file(last, bytes.substr(0, length));
    CHECK(load_checkpoint(folder, "job")->stage == 3);
  }
  std::filesystem::remove(last);  // as a kill between the two renames leaves it
  CHECK(load_checkpoint(folder, "job")->stage == 3);
  core::write_file(last, bytes.substr(0, 40));
  core::write_file(before, whole.substr(0, whole.size() - 1));
  CHECK_FALSE(load_checkpoint(folder, "job"));
  CHECK(warnings.back().find("begins anew") != std::string::npos);
  core::set_listener({});
  std::filesystem::remove_all(folder);
}
