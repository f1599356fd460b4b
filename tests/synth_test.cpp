#include "chainsplat/synth.h"

#include <doctest/doctest.h>

#include "chainsplat/capture.h"
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
  camera.name = "left/1";  // no file name
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
  const capture::Capture given = scene();
  synth::Options options;
  options.video = false;
  synth::write(engine(), twin, twin.states, given, folder.path / "capture", options);

  capture::LoadOptions load;
  load.undistort = false;
  load.depth = true;
  const capture::Capture read = capture::load(folder.path / "capture", load);
  CHECK(read.name == "synth");
  CHECK(!read.tabletop);
  CHECK(read.length == 0.3);
  double mass = twin.parameters->tip_mass;
  for (const double link : twin.parameters->link_mass) mass += link;
  CHECK(read.mass.value_or(0.0) == doctest::Approx(mass));
  REQUIRE(read.cameras.size() == 2);
  CHECK(read.cameras[1].name == "left/1");
  CHECK(read.cameras[1].distortion == given.cameras[1].distortion);
  CHECK((read.cameras[1].world_from_camera.rotation - given.cameras[1].world_from_camera.rotation).norm() < 1e-14);
  REQUIRE(read.views.size() == 16);
  for (int c = 0; c < 2; ++c)
    for (int k = 0; k < 8; ++k) CHECK(read.times[c][k] == doctest::Approx(given.times[c][k]).epsilon(1e-12));
  for (const double t : {0.2, 0.35, 0.5})
    CHECK((read.base.pose(t).translation - given.base.pose(t).translation).norm() < 1e-6);

  // the twin explains its own capture: all that is left is 8 bits of color, 0.1 mm of depth, the polyline's chords
  const eval::Metrics metrics = eval::evaluate(engine(), twin.gaussians, twin.chain, twin.states, read);
  REQUIRE(metrics.frames.size() == 16);
  CHECK(metrics.mean.iou > 0.999);
  CHECK(metrics.mean.psnr_object > 50.0);
  CHECK(metrics.mean.psnr > 50.0);
  CHECK(metrics.mean.ssim > 0.995);
  CHECK(metrics.mean.chamfer < 1e-4);
  CHECK(metrics.mean.centerline_rms < 5e-4);
  CHECK(metrics.cameras[0].tip_rms < 2e-6);
  CHECK(metrics.cameras[1].tip_rms < 1e-3);  // between the truth's times: cubic
  CHECK(metrics.empty_clouds == 0);

  // a base that is 5 mm away moves the centerline by exactly that, and the picture by enough to see
  capture::Capture shifted = read;
  std::vector<trajectory::Sample> samples = read.base.samples();
  for (trajectory::Sample& sample : samples) sample.pose.translation += Vector3(0.003, 0, 0.004);
  shifted.base = trajectory::fit(samples, "shifted");
  const eval::Metrics off = eval::evaluate(engine(), twin.gaussians, twin.chain, twin.states, shifted);
  CHECK(off.cameras[0].centerline_rms == doctest::Approx(0.005).epsilon(0.01));
  CHECK(off.cameras[0].tip_rms == doctest::Approx(0.005).epsilon(0.001));
  CHECK(off.mean.iou < 0.95);
  CHECK(off.mean.psnr_object < metrics.mean.psnr_object - 15.0);
  CHECK(off.mean.chamfer > 2e-4);
  CHECK(off.mean.chamfer < 5e-3);
}

TEST_CASE("only frames that the states cover are written, numbered from 0; videos load too") {
  const test::TemporaryFolder folder("synth_video");
  twin::Twin twin = test::small_twin(chain::Bending::planar, 200);
  twin.known_mass = false;
  twin.tabletop = true;
  capture::Capture given = scene();
  given.cameras.resize(1);
  given.times.resize(1);
  const chain::States states = test::swing(twin.chain, 0.1, 0.3);  // 0.3 to 0.4 s; frames 0.2, 0.2333, ...
  synth::write(engine(), twin, states, given, folder.path);
  capture::LoadOptions load;
  load.undistort = false;
  const capture::Capture read = capture::load(folder.path, load);
  CHECK(read.tabletop);
  CHECK(!read.mass);
  REQUIRE(read.table.has_value());
  CHECK(read.table->normal == Vector3::UnitZ());
  CHECK(std::filesystem::exists(folder.path / "cam0.mp4"));
  REQUIRE(read.times[0].size() == 4);
  CHECK(read.times[0][0] == doctest::Approx(0.3));
  const eval::Metrics metrics = eval::evaluate(engine(), twin.gaussians, twin.chain, states, read);
  CHECK(metrics.mean.iou > 0.999);
  CHECK(metrics.mean.psnr_object > 20.0);  // chroma at half resolution
  CHECK(metrics.cameras[0].tip_rms < 2e-6);

  CHECK_THROWS_AS(synth::write(engine(), twin, test::swing(twin.chain, 0.1, 5.0), given, folder.path / "none"), InputError);
  CHECK(!std::filesystem::exists(folder.path / "none"));
  CHECK_THROWS_AS(eval::evaluate(engine(), twin.gaussians, twin.chain, test::swing(twin.chain, 0.1, 5.0), read), InputError);
}
