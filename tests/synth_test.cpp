#include "chainsplat/synth.h"

#include <doctest/doctest.h>

#include <algorithm>

#include "small_twin.h"

using namespace chainsplat;
using math::Vector3;

namespace {

splat::Engine& engine() {
  static const gpu::DevicePtr device = gpu::open_device();
  static splat::Engine engine(*device);
  return engine;
}

// Two cameras around small_twin(): the second distorts, starts late and runs at an uneven rate.
capture::Capture scene() {
  capture::Capture out;
  out.length = 0.3;
  out.diameter = 0.02;
  out.direction = {0, 0, -1};
  out.bending_axis = {0, 1, 0};
  out.gravity = {0, 0, -9.81};
  out.base = test::moving_base(1.0);
  capture::Camera camera;
  camera.name = "cam0";
  camera.width = 160;
  camera.height = 121;
  camera.fx = camera.fy = 150;
  camera.cx = 80;
  camera.cy = 60;
  camera.world_from_camera.rotation << 1, 0, 0, 0, 0, 1, 0, -1, 0;
  camera.world_from_camera.translation = {0.02, -0.6, 0.4};
  out.cameras.push_back(camera);
  camera.name = "left";
  camera.distortion = {-0.2, 0.05, 0.001, -0.002, 0.0};
  camera.world_from_camera = math::Pose{math::exp_so3({0, 0, -0.9}), Vector3::Zero()} * camera.world_from_camera;
  out.cameras.push_back(camera);
  out.times.resize(2);
  for (int k = 0; k < 8; ++k) {
    out.times[0].push_back(0.2 + k / 30.0);
    out.times[1].push_back(0.21 + k / 25.0 + (k == 3 ? 0.004 : 0.0));
  }
  return out;
}

}  // namespace

TEST_CASE("a synthesized capture loads and holds what was drawn") {
  const test::TemporaryFolder folder("synth");
  const twin::Twin twin = test::small_twin(chain::Bending::spatial, 400);
  const capture::Capture source = scene();
  synth::Options options;
  options.video = false;
  synth::write(engine(), twin, twin.states, source, folder.path / "capture", options);

  capture::LoadOptions load;
  load.pixels = capture::Pixels::recorded;
  load.depth = true;
  const capture::Capture read = capture::load(folder.path / "capture", load);
  CHECK(read.name == "synth");
  CHECK(!read.tabletop);
  CHECK(read.length == 0.3);
  double mass = twin.parameters->tip_mass;
  for (const double link : twin.parameters->link_mass) mass += link;
  CHECK(read.mass.value_or(0.0) == doctest::Approx(mass));
  REQUIRE(read.cameras.size() == 2);
  CHECK(read.cameras[1].name == "left");
  CHECK(read.cameras[1].distortion == source.cameras[1].distortion);
  CHECK((read.cameras[1].world_from_camera.rotation - source.cameras[1].world_from_camera.rotation).norm() < 1e-14);
  REQUIRE(read.views.size() == 16);
  for (int c = 0; c < 2; ++c)
    for (int k = 0; k < 8; ++k) CHECK(read.times[c][k] == doctest::Approx(source.times[c][k]).epsilon(1e-12));
  for (const double t : {0.2, 0.35, 0.5})
    CHECK((read.base.pose(t).translation - source.base.pose(t).translation).norm() < 1e-6);

  // the loaded views equal the pictures, to 8 bits and 0.1 mm
  int solid = 0;
  for (const capture::PackedView& packed : read.views) {
    const capture::View view = capture::unpacked(packed);
    const capture::Camera& camera = read.cameras[view.camera];
    render::Options drawing;
    drawing.depth = true;
    const auto frames = render::frames(engine(), twin.gaussians, twin.chain, twin.states, source.base, camera,
                                       view.camera, {view.time}, drawing);
    const capture::Image8 color = render::color_image(frames.at(0), camera),
                          mask = render::mask_image(frames[0], camera);
    const std::vector<float> depth = render::depth_image(frames[0], camera);
    int in_mask = 0, wrong = 0;
    for (int y = 0; y < view.height; ++y)
      for (int x = 0; x < view.width; ++x) {
        const std::size_t k = static_cast<std::size_t>(y) * view.width + x;
        const std::size_t i = static_cast<std::size_t>(view.y0 + y) * camera.width + view.x0 + x;
        in_mask += view.rgba[4 * k + 3] != 0;
        if ((view.rgba[4 * k + 3] != 0) != (mask.pixels[i] != 0)) ++wrong;
        if (view.rgba[4 * k + 3] == 0) continue;
        for (int c = 0; c < 3; ++c) wrong += std::abs(view.rgba[4 * k + c] - color.pixels[3 * i + c]) > 1;
        wrong += !(std::abs(view.depth[k] - depth[i]) <= 0.51e-4);
      }
    CHECK(wrong == 0);
    CHECK(in_mask > 100);
    CHECK(in_mask == std::count(mask.pixels.begin(), mask.pixels.end(), 255));
    solid += in_mask;
  }
  CHECK(solid > 5000);

  // the truth is the chain: its ends are exact, and points between lie on the straight links
  const auto truth = capture::load_true_centerline(folder.path / "capture");
  REQUIRE(truth.has_value());
  REQUIRE(truth->time.size() == 8);
  for (std::size_t k = 0; k < 8; ++k) {
    const auto motions = chain::link_motions(twin.chain, chain::interpolate(twin.states, source.times[0][k]),
                                             source.base.pose(source.times[0][k]));
    const math::MatrixX nodes = chain::nodes(twin.chain, motions);
    REQUIRE(truth->points[k].cols() == 49);
    CHECK((truth->points[k].col(0) - nodes.col(0)).norm() < 1e-12);
    CHECK((truth->points[k].col(48) - nodes.rightCols(1)).norm() < 1e-12);
  }
}

TEST_CASE("only frames that the states cover are written, numbered from 0; videos load too") {
  const test::TemporaryFolder folder("synth_video");
  twin::Twin twin = test::small_twin(chain::Bending::planar, 200);
  twin.known_mass = false;
  twin.tabletop = true;
  capture::Capture source = scene();
  source.cameras.resize(1);
  source.times.resize(1);
  const chain::States states = test::swing(twin.chain, 0.1, 0.3);  // 0.3 to 0.4 s; frames 0.2, 0.2333, ...
  synth::write(engine(), twin, states, source, folder.path);
  capture::LoadOptions load;
  load.pixels = capture::Pixels::recorded;
  const capture::Capture read = capture::load(folder.path, load);
  CHECK(read.tabletop);
  CHECK(!read.mass);
  REQUIRE(read.table.has_value());
  CHECK(read.table->normal == Vector3::UnitZ());
  CHECK(std::filesystem::exists(folder.path / "cam0.mp4"));
  REQUIRE(read.times[0].size() == 4);
  CHECK(read.times[0][0] == doctest::Approx(0.3));
  for (const capture::ViewPlace& view : read.views) CHECK(view.width > 20);
  CHECK_THROWS_AS(synth::write(engine(), twin, test::swing(twin.chain, 0.1, 5.0), source, folder.path / "none"),
                  InputError);
  CHECK(!std::filesystem::exists(folder.path / "none"));
}
