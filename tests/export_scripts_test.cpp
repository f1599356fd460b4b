// What exports for NumPy and MuJoCo hold, URDF among them. With CHAINSPLAT_TEST_EXPORTS=FOLDER they are left there,
// beside what the program says of the same motion, for tests/cli/exports.sh, which runs them.
#include <doctest/doctest.h>

#include <cmath>
#include <cstdlib>
#include <numbers>

#include "chainsplat/export.h"
#include "small_twin.h"

using namespace chainsplat;

namespace {

constexpr double kSeconds = 5.0;

// A rope that lies on a table, which grips it and rolls it.
twin::Twin table_twin() {
  twin::Twin twin = test::small_twin(chain::Bending::planar);
  twin.chain = chain::make_chain(0.3, 0.02, {0, 1, 0}, {0, 0, 1}, 5, chain::Bending::planar, false, 0.013);
  twin.gaussians = test::spiral_gaussians(twin.chain, 300);
  for (int j = 0; j < twin.chain.links(); ++j) twin.chain.lift.push_back(-2e-4 * j);
  twin.tabletop = true;
  twin.table_point = math::Vector3(0, 0, 0.54);
  twin.table_normal = math::Vector3::UnitZ();
  dynamics::Parameters& p = *twin.parameters;
  p.table_normal = twin.table_normal;
  p.tip_mass = 0.0;
  for (double& c : p.air_quadratic) c = 0.0;
  for (double& c : p.coulomb_friction) c = 0.2 + 0.2 * c;
  for (double& c : p.viscous_friction) c = 1e-3;
  for (int k = 0; k < twin.chain.angles(); ++k) {
    p.roll_lever.push_back(2e-4 * (k - 2));
    p.stiffness[k] += 6e-3, p.damping[k] += 3e-4;  // or it folds
  }
  p.substeps = 16;
  return twin;
}

// A rope that is naturally bent, twists within its links, and whose strands rub.
twin::Twin twisting_twin() {
  twin::Twin twin = test::small_twin(chain::Bending::spatial);
  dynamics::Parameters& p = *twin.parameters;
  const int n = twin.chain.angles();
  for (int k = 0; k < n; ++k) {
    p.rest_angle[k] = 0.4 * std::cos(1.3 * k);
    p.stiffness[k] += 6e-3, p.damping[k] += 3e-4;
    p.bending_friction.push_back(5e-4), p.bending_friction_angle.push_back(0.05);
    if (k % 2 == 0) p.torsional_stiffness.push_back(0.7 * p.stiffness[k]);
  }
  twin.initial->internal_state = math::VectorX::LinSpaced(n, -0.5, 0.7);
  return twin;
}

void write_all(twin::Twin twin, const Path& folder) {
  const trajectory::Trajectory base = test::moving_base(kSeconds);
  core::make_folder(folder);
  twin.initial->time = 0.0;
  twin.parameters->substeps = 16;  // its own steps must not be seen beside MuJoCo's
  std::vector<double> times;
  for (int k = 0; k <= 30 * static_cast<int>(kSeconds); ++k) times.push_back(k / 30.0);
  twin.rollout = dynamics::rollout(dynamics::make_model(twin.chain, *twin.parameters), base, *twin.initial, times);
  for (const math::VectorX& theta : twin.states.theta)
    twin.states.covariance.push_back(1e-4 * math::MatrixX::Identity(theta.size(), theta.size()));
  twin.estimates.names = {"log_stiffness", "log_damping"};
  twin.estimates.values = twin.estimates.standard_errors = {0.1, 0.2};
  twin.estimates.covariance = math::MatrixX::Identity(2, 2);
  for (const char* const name : {"rope.xml", "rope.urdf", "rope.usda", "twin.npz"})
    exports::write(twin, twin.states, base, folder / name);
  core::write_file(folder / "rollout.csv", twin::states_csv(twin.rollout));
  core::write_file(folder / "centerline.csv", twin::centerline_csv(twin.chain, twin.rollout, base));
}

}  // namespace

TEST_CASE("exports for NumPy and MuJoCo: every file that was named, the same bytes again") {
  const char* const asked = std::getenv("CHAINSPLAT_TEST_EXPORTS");
  const test::TemporaryFolder own("scripts");
  const Path folder = asked ? Path(asked) : own.path;
  twin::Twin free = test::small_twin();
  for (double& b : free.parameters->air_linear) b = 2e-4;
  write_all(free, folder / "free");
  write_all(table_twin(), folder / "table");
  write_all(twisting_twin(), folder / "twisting");
  twin::Twin thin = free;  // as --mode paper has it
  thin.parameters->radius = 0.0, thin.parameters->tip_mass = 0.0;
  write_all(thin, folder / "thin");
  for (const char* const name : {"rope.xml", "rope_base.csv", "rope_play.py", "rope.urdf", "twin.npz", "twin.py"})
    CHECK(std::filesystem::file_size(folder / "free" / name) > 100);
  CHECK(exports::files("a/rope.xml") == std::vector<Path>{"a/rope.xml", "a/rope_base.csv", "a/rope_play.py"});
  CHECK(exports::files("a/b.c.npz") == std::vector<Path>{"a/b.c.npz", "a/b.c.py"});
  write_all(free, folder / "again");
  for (const char* const name : {"rope.xml", "rope.urdf", "twin.npz"})
    CHECK(core::read_file(folder / "free" / name) == core::read_file(folder / "again" / name));

  // a name with markup in it stays a name, and cannot end the comment
  free.provenance.capture = "\"/>--><x a='";
  const std::string model = exports::mujoco(free, test::moving_base(1.0), "rope").model;
  CHECK(model.find("<x") == std::string::npos);
  CHECK(model.find("-->") == model.rfind("-->"));
}

TEST_CASE("a twin that is not identified has no dynamics to export") {
  twin::Twin twin = test::small_twin();
  twin.parameters.reset();
  const test::TemporaryFolder folder("unidentified");
  CHECK_THROWS_AS(exports::write(twin, twin.states, {}, folder.path / "rope.xml"), InputError);
  CHECK(std::filesystem::is_empty(folder.path));
  exports::write(twin, twin.states, {}, folder.path / "twin.npz");
  CHECK(std::filesystem::exists(folder.path / "twin.py"));
}

TEST_CASE("exported colors hold the light of the motion: its mean, and what cameras see of it") {
  twin::Twin twin = test::small_twin(chain::Bending::planar, 40);
  const chain::Chain& chain = twin.chain;
  splat::Gaussians& g = twin.gaussians;
  CHECK(exports::with_baked_light(g, chain, twin.states, {}, {}).sh == g.sh);  // as there is none
  g.light = {chain.direction, 0.6, 0.3 * chain.bending_axis, math::Matrix3::Zero()};
  const trajectory::Trajectory rest = trajectory::fit({trajectory::Sample{}}, "rest");
  chain::States rolling;  // there and turned over: what is above once is below once
  for (const double turn : {0.0, std::numbers::pi}) {
    rolling.time.push_back(turn);
    rolling.theta.push_back(math::VectorX::Zero(chain.angles()));
    rolling.roll.push_back(math::VectorX::Constant(chain.links(), turn));
  }
  const splat::Gaussians mean = exports::with_baked_light(g, chain, rolling, rest, {}),
                         home = exports::with_baked_light(g, chain, {}, {}, {});
  CHECK_FALSE(mean.light.known());
  const math::Vector3 from(0.6, 0.0, -0.8);
  for (int i = 0; i < g.count; ++i) {
    const math::Vector3 at(g.mean[3 * i], g.mean[3 * i + 1], g.mean[3 * i + 2]),
        off = at - at.dot(chain.direction) * chain.direction;
    const double side = off.normalized().dot(chain.bending_axis);
    CHECK((splat::sh_color(mean, i, from) - 0.6 * splat::sh_color(g, i, from)).norm() < 1e-6);
    CHECK((splat::sh_color(home, i, from) - (0.6 + 0.3 * side) * splat::sh_color(g, i, from)).norm() < 1e-6);
  }

  // a camera that sees the rope turn, from above it at first
  chain::States turning;
  for (int k = 0; k <= 20; ++k) {
    turning.time.push_back(0.05 * k);
    turning.theta.push_back(math::VectorX::Zero(chain.angles()));
    turning.roll.push_back(math::VectorX::Constant(chain.links(), 0.06 * k));
  }
  capture::Camera camera;
  const math::Vector3 middle = 0.5 * chain.length * chain.direction;
  camera.world_from_camera.translation = middle + 2.0 * chain.bending_axis;
  const splat::Gaussians baked = exports::with_baked_light(g, chain, turning, rest, {camera});
  const splat::Gaussians flat = exports::with_baked_light(g, chain, turning, rest, {});
  double wrong = 0.0, wrong_by_mean = 0.0, count = 0.0;
  for (std::size_t k = 0; k < turning.time.size(); ++k) {
    const auto motions = chain::material_motions(chain, turning, turning.time[k], rest.pose(0.0));
    for (int i = 0; i < g.count; ++i) {
      const math::Pose& pose = motions[splat::surest_link(g, i)];
      const math::Vector3 at(g.mean[3 * i], g.mean[3 * i + 1], g.mean[3 * i + 2]);
      const math::Vector3 ray = pose * at - camera.world_from_camera.translation,
                          direction = pose.rotation.transpose() * ray.normalized();
      const math::Vector3 off = at - at.dot(chain.direction) * chain.direction;
      if (-direction.dot(off.normalized()) < 0.3) continue;  // on the far side
      const math::Vector3 lit = splat::brightness(g, i, pose.rotation) * splat::sh_color(g, i, direction);
      wrong += (splat::sh_color(baked, i, direction) - lit).squaredNorm();
      wrong_by_mean += (splat::sh_color(flat, i, direction) - lit).squaredNorm();
      count += 1.0;
    }
  }
  CHECK(count > 200);
  CHECK(std::sqrt(wrong / count) < 0.01);
  CHECK(std::sqrt(wrong_by_mean / count) > 0.04);
}

TEST_CASE("exported scales hold what the renderer adds at the nearest that a Gaussian comes to a camera") {
  twin::Twin twin = test::small_twin(chain::Bending::spatial, 40);
  capture::Camera camera;
  camera.width = 640, camera.height = 480, camera.fx = 600, camera.fy = 620, camera.cx = 320, camera.cy = 240;
  camera.world_from_camera.translation = {0, 0, -1};  // looks up along z
  capture::Camera far = camera;
  far.world_from_camera.translation.z() = -4;
  const trajectory::Trajectory rest = trajectory::fit({trajectory::Sample{}}, "rest");
  chain::States straight;
  straight.time = {0.0};
  straight.theta = {math::VectorX::Zero(twin.chain.angles())};
  const splat::Gaussians& before = twin.gaussians;
  const splat::Gaussians after = exports::with_low_pass(before, twin.chain, straight, rest, {far, camera});
  for (int i = 0; i < before.count; ++i)
    for (int c = 0; c < 3; ++c) {
      const double pixel = (before.mean[3 * i + 2] + 1.0) / std::sqrt(600.0 * 620.0),
                   scale = std::exp(before.log_scale[3 * i + c]);
      CHECK(std::exp(after.log_scale[3 * i + c]) ==
            doctest::Approx(std::sqrt(scale * scale + 0.3 * pixel * pixel)).epsilon(1e-5));
    }
  // fitted to pictures of known distance, they are as blurred as those, whatever looks at them
  splat::Gaussians coarse = before;
  coarse.pixel_footprint = 0.01;
  const splat::Gaussians blurred = exports::with_low_pass(coarse, twin.chain, straight, rest, {});
  for (std::size_t k = 0; k < before.log_scale.size(); ++k) {
    const double scale = std::exp(before.log_scale[k]);
    CHECK(std::exp(blurred.log_scale[k]) == doctest::Approx(std::sqrt(scale * scale + 0.3 * 1e-4)).epsilon(1e-5));
  }
  // a camera that the rope is behind sees nothing of it
  camera.world_from_camera.translation.z() = 1;
  CHECK(exports::with_low_pass(before, twin.chain, straight, rest, {camera}).log_scale == before.log_scale);
}
