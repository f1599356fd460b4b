// The base trajectory: files, the smoothing spline's accuracy and its smoothing, twists against differences of poses.
#include <doctest/doctest.h>

#include <cmath>
#include <filesystem>
#include <fstream>
#include <functional>
#include <numbers>
#include <sstream>

#include "chainsplat/trajectory.h"

#include "error_of.h"

using namespace chainsplat;
using math::Vector3;
using math::Vector6;
using test::contains;
using test::error_of;
using trajectory::Sample;
using trajectory::Trajectory;

namespace {

constexpr double kTurn = 2.0 * std::numbers::pi;

struct Folder {  // a folder of this test, removed at the end
  Path path =
      std::filesystem::temp_directory_path() / ("chainsplat_trajectory_" + std::to_string(core::fnv1a(__FILE__)));
  Folder() { std::filesystem::create_directories(path); }
  ~Folder() { std::filesystem::remove_all(path); }
};

// A smooth motion that turns about a changing axis and moves along all three.
math::Pose analytic_pose(double t) {
  const Vector3 r(0.4 * std::sin(1.3 * t), 0.5 * std::cos(0.9 * t), 0.8 * std::sin(2.1 * t + 0.3));
  return {math::exp_so3(Vector3(0.3, -0.2, 0.7)) * math::exp_so3(r),
          {0.15 * std::sin(2.5 * t), 0.1 * std::cos(1.7 * t), 0.5 + 0.05 * std::sin(3.1 * t)}};
}

Vector3 analytic_acceleration(double t) {
  return {-0.15 * 6.25 * std::sin(2.5 * t), -0.1 * 2.89 * std::cos(1.7 * t), -0.05 * 9.61 * std::sin(3.1 * t)};
}

// Returns (T^-1 dT/dt)^vee by fourth-order differences of logarithms.
Vector6 twist_by_differences(const std::function<math::Pose(double)>& pose, double t, double h) {
  const math::Pose inverse = pose(t).inverse();
  const auto step = [&](double s) { return math::log_se3(inverse * pose(t + s)); };
  return (8.0 * (step(h) - step(-h)) - (step(2 * h) - step(-2 * h))) / (12.0 * h);
}

Vector3 world_acceleration(const trajectory::BaseMotion& motion) {
  const Vector3 w = motion.velocity.head<3>(), v = motion.velocity.tail<3>();
  return motion.pose.rotation * (motion.acceleration.tail<3>() + w.cross(v));
}

struct Truth {
  double time;
  Vector3 position, velocity, acceleration;
};

std::vector<Truth> read_truth(const Path& file) {
  std::istringstream text(core::read_file(file));
  std::string line;
  std::getline(text, line);
  std::vector<Truth> rows;
  while (std::getline(text, line)) {
    for (char& c : line)
      if (c == ',') c = ' ';
    std::istringstream numbers(line);
    Truth row;
    numbers >> row.time;
    for (Vector3* v : {&row.position, &row.velocity, &row.acceleration}) numbers >> v->x() >> v->y() >> v->z();
    rows.push_back(row);
  }
  return rows;
}

}  // namespace

TEST_CASE("V_b and its derivative agree with differences of the fitted poses and twists") {
  std::vector<Sample> samples;
  for (int k = 0; k <= 400; ++k) samples.push_back({0.01 * k, analytic_pose(0.01 * k)});
  const Trajectory fitted = trajectory::fit(samples, "test");
  for (const double t : {0.5, 1.234, 2.0, 3.3}) {
    const trajectory::BaseMotion motion = fitted.at(t);
    const Vector6 velocity = twist_by_differences([&](double s) { return fitted.pose(s); }, t, 1e-3);
    CHECK((motion.velocity - velocity).norm() < 1e-8);
    const double h = 1e-4;
    const Vector6 acceleration = (fitted.at(t + h).velocity - fitted.at(t - h).velocity) / (2.0 * h);
    CHECK((motion.acceleration - acceleration).norm() < 1e-5);
  }
}

TEST_CASE("an analytic motion comes back: pose, twist, acceleration") {
  std::vector<Sample> samples;
  for (int k = 0; k <= 480; ++k) samples.push_back({k / 120.0, analytic_pose(k / 120.0)});
  const Trajectory fitted = trajectory::fit(samples, "test");
  CHECK(fitted.noise() < 1e-7);
  for (double t = 0.1; t < 3.9; t += 0.0371) {
    const trajectory::BaseMotion motion = fitted.at(t);
    CHECK((motion.pose.translation - analytic_pose(t).translation).norm() < 1e-7);
    CHECK(math::log_so3(motion.pose.rotation.transpose() * analytic_pose(t).rotation).norm() < 1e-7);
    CHECK((motion.velocity - twist_by_differences(analytic_pose, t, 1e-3)).norm() < 1e-5);
    CHECK((world_acceleration(motion) - analytic_acceleration(t)).norm() < 1e-3);
    const double h = 1e-3;
    const Vector3 angular =
        (twist_by_differences(analytic_pose, t + h, h) - twist_by_differences(analytic_pose, t - h, h)).head<3>() /
        (2 * h);
    CHECK((motion.acceleration.head<3>() - angular).norm() < 1e-3);
  }
}

TEST_CASE("the demo capture's base: seven digits at 120 Hz give the true acceleration") {
  const Path folder = Path(CHAINSPLAT_SOURCE_DIR) / "assets/demo_free_30";
  const Trajectory fitted = trajectory::fit(trajectory::read_tum(folder / "base.tum"), "base.tum");
  double position = 0.0, velocity = 0.0, acceleration = 0.0, squares = 0.0;
  const std::vector<Truth> rows = read_truth(folder / "truth/base.csv");
  for (const Truth& row : rows) {
    const trajectory::BaseMotion motion = fitted.at(row.time);
    position = std::max(position, (motion.pose.translation - row.position).norm());
    velocity = std::max(velocity, (motion.pose.rotation * motion.velocity.tail<3>() - row.velocity).norm());
    acceleration = std::max(acceleration, (world_acceleration(motion) - row.acceleration).norm());
    squares += (world_acceleration(motion) - row.acceleration).squaredNorm();
  }
  MESSAGE("largest error: position " << position << " m, velocity " << velocity << " m/s, acceleration " << acceleration
                                     << " m/s^2 (RMS " << std::sqrt(squares / rows.size()) << ")");
  CHECK(position < 1e-6);
  CHECK(velocity < 1e-4);
  CHECK(std::sqrt(squares / rows.size()) < 1e-2);
}

TEST_CASE("noise: its size is found and the acceleration stays sensible") {
  for (const double sigma : {1e-4, 5e-4, 2e-3}) {
    double worst = 0.0, found = 0.0;
    constexpr int kSeeds = 10;
    for (int seed = 0; seed < kSeeds; ++seed) {
      core::Random random(static_cast<std::uint64_t>(seed));
      std::vector<Sample> samples;
      for (int k = 0; k <= 150; ++k) {
        Sample sample{k / 30.0, analytic_pose(k / 30.0)};
        for (int i = 0; i < 3; ++i) sample.pose.translation[i] += sigma * random.normal();
        samples.push_back(sample);
      }
      const Trajectory fitted = trajectory::fit(samples, "test");
      found += fitted.noise() / kSeeds;
      double squares = 0.0;
      int count = 0;
      for (double t = 0.3; t < 4.7; t += 0.01, ++count)
        squares += (world_acceleration(fitted.at(t)) - analytic_acceleration(t)).squaredNorm() / 3.0;
      worst = std::max(worst, std::sqrt(squares / count));
    }
    MESSAGE("noise " << sigma << " m: found " << found << " m, worst RMS acceleration error " << worst << " m/s^2");
    CHECK(found == doctest::Approx(sigma).epsilon(0.1));
    // a tenth of the error of second differences at 30 Hz, sqrt(6) * 900 * sigma: 1.1 m/s^2 for 0.5 mm
    CHECK(worst < 0.1 * std::sqrt(6.0) * 900.0 * sigma);
  }
}

TEST_CASE("rotations beyond half a turn go on continuously") {
  std::vector<Sample> samples;
  const Vector3 axis = Vector3(1, 2, -2) / 3.0;
  for (int k = 0; k <= 200; ++k)
    samples.push_back(
        {k * 0.02, {math::exp_so3(2.5 * k * 0.02 * axis) * math::exp_so3(Vector3(0.1, 0.2, 0.3)), Vector3::Zero()}});
  // the axis is fixed in the world, so the rotation vector from the first sample grows along a line, to ten radians
  const Trajectory fitted = trajectory::fit(samples, "test");
  for (double t = 0.0; t <= 4.0; t += 0.013) {
    const trajectory::BaseMotion motion = fitted.at(t);
    CHECK((motion.pose.rotation * motion.velocity.head<3>() - 2.5 * axis).norm() < 1e-6);
    CHECK(motion.acceleration.head<3>().norm() < 1e-4);
  }
}

TEST_CASE("uneven and doubled sampling, few samples, the ends") {
  SUBCASE("uneven") {
    core::Random random(3);
    std::vector<Sample> samples;
    for (double t = 0.0; t < 4.0; t += random.uniform(1e-5, 0.02)) samples.push_back({t, analytic_pose(t)});
    const Trajectory fitted = trajectory::fit(samples, "test");
    for (double t = 0.1; t < 3.8; t += 0.011) {
      CHECK((fitted.pose(t).translation - analytic_pose(t).translation).norm() < 1e-6);
      CHECK((world_acceleration(fitted.at(t)) - analytic_acceleration(t)).norm() < 1e-2);
    }
  }
  SUBCASE("one sample rests") {
    const Trajectory fitted = trajectory::fit({{1.0, analytic_pose(1.0)}}, "test");
    CHECK(fitted.at(7.0).velocity.norm() == 0.0);
    CHECK((fitted.pose(-3.0).translation - analytic_pose(1.0).translation).norm() == 0.0);
    CHECK(fitted.start() == 1.0);
    CHECK(fitted.end() == 1.0);
  }
  SUBCASE("two samples move steadily, three and four and five pass through") {
    for (const int count : {2, 3, 4, 5}) {
      std::vector<Sample> samples;
      for (int k = 0; k < count; ++k) samples.push_back({0.5 * k, {math::Matrix3::Identity(), Vector3(0.2 * k, 0, 1)}});
      const Trajectory fitted = trajectory::fit(samples, "test");
      const trajectory::BaseMotion motion = fitted.at(0.3);
      CHECK((motion.pose.translation - Vector3(0.12, 0, 1)).norm() < 1e-8);
      CHECK((motion.velocity.tail<3>() - Vector3(0.4, 0, 0)).norm() < 1e-7);
      CHECK(motion.acceleration.norm() < 1e-6);
    }
  }
  SUBCASE("outside it rests; times that were rounded by the file's digits still count as inside") {
    std::vector<Sample> samples;
    for (int k = 0; k <= 100; ++k)
      samples.push_back({0.01 * k, {math::Matrix3::Identity(), Vector3(0.3 * 0.01 * k, 0, 0)}});
    const Trajectory fitted = trajectory::fit(samples, "test");
    CHECK(fitted.at(1.0 + 1e-6).velocity.tail<3>().x() == doctest::Approx(0.3));
    CHECK(fitted.at(1.02).velocity.norm() == 0.0);
    CHECK((fitted.pose(9.0).translation - Vector3(0.3015, 0, 0)).norm() < 1e-6);
  }
}

TEST_CASE("large offsets and long, dense recordings keep their digits") {
  core::Random random(11);
  std::vector<Sample> samples;
  constexpr double kOffset = 1.6e9;  // s, as of clocks that count from 1970
  for (int k = 0; k < 20000; ++k) {  // samples at 1 kHz with 0.1 mm of noise
    const double t = 0.001 * k;
    samples.push_back({kOffset + t, analytic_pose(t)});
    for (int i = 0; i < 3; ++i) samples.back().pose.translation[i] += 1e-4 * random.normal();
  }
  const Trajectory fitted = trajectory::fit(samples, "test");
  CHECK(fitted.noise() == doctest::Approx(1e-4).epsilon(0.05));
  double squares = 0.0;
  int count = 0;
  for (double t = 1.0; t < 19.0; t += 0.01, ++count)
    squares += (world_acceleration(fitted.at(kOffset + t)) - analytic_acceleration(t)).squaredNorm() / 3.0;
  CHECK(std::sqrt(squares / count) < 0.05);
}

TEST_CASE("the poses of a few stills are met, however little they have in common") {
  for (const int count : {3, 4, 5, 8, 20}) {
    std::vector<trajectory::Sample> samples;
    for (int k = 0; k < count; ++k) {
      math::Pose pose;
      pose.translation = Vector3(0.1 * ((k * 7) % 5), 0.05 * ((k * 3) % 4), 0.02 * (k % 2));
      pose.rotation = math::exp_so3(Vector3(0.0, 0.2 * ((k * 5) % 3), 0.0));
      samples.push_back({1.0 * k, pose});
    }
    const Trajectory fitted = trajectory::fit(samples, "test");
    for (const trajectory::Sample& sample : samples) {
      CAPTURE(count);
      CHECK((fitted.pose(sample.time).translation - sample.pose.translation).norm() < 1e-4);
      CHECK((fitted.pose(sample.time).rotation - sample.pose.rotation).norm() < 1e-3);
    }
  }
}

TEST_CASE("TUM files: read, written, refused with file and line") {
  const Folder folder;
  const Path file = folder.path / "base.tum";
  const auto write = [&](const std::string& text) { std::ofstream(file) << text; };
  write("# a comment\n0.0 1 2 3 0 0 0 1\n\n0.5\t1 2 3.5  0 0 0.7071068 0.7071068 # half\r\n");
  const std::vector<Sample> read = trajectory::read_tum(file);
  REQUIRE(read.size() == 2);
  CHECK(read[1].time == 0.5);
  CHECK(read[1].pose.translation.z() == 3.5);
  CHECK((math::log_so3(read[1].pose.rotation) - Vector3(0, 0, kTurn / 4)).norm() < 1e-7);

  write(trajectory::write_tum(read));
  const std::vector<Sample> again = trajectory::read_tum(file);
  REQUIRE(again.size() == 2);
  for (int k = 0; k < 2; ++k) {
    CHECK(again[k].time == read[k].time);
    CHECK((again[k].pose.translation - read[k].pose.translation).norm() == 0.0);
    CHECK((again[k].pose.rotation - read[k].pose.rotation).norm() < 1e-15);
  }

  const auto refused = [&](const std::string& text) {
    write(text);
    return error_of([&] { trajectory::read_tum(file); });
  };
  CHECK(contains(refused("0 1 2 3 0 0 0 1\n1 1 2 nan 0 0 0 1\n"), "base.tum:2: column 4 is not finite"));
  CHECK(contains(refused("0 1 2 3 0 0 0 1\n1 1 2 1e999 0 0 0 1\n"), "base.tum:2"));
  CHECK(contains(refused("0 1 2 3 0 0 0\n"), "base.tum:1: 7 numbers instead of 8"));
  CHECK(contains(refused("0 1 2 3 0 0 0 1 9\n"), "9 numbers"));
  CHECK(contains(refused("0 1 2 3 0 0 0 0\n"), "quaternion"));
  CHECK(contains(refused("0 1 two 3 0 0 0 1\n"), "column 3"));
  CHECK(contains(refused("# nothing\n"), "no pose"));
  CHECK(contains(error_of([&] { trajectory::read_tum(folder.path / "missing.tum"); }), "missing.tum"));
  CHECK(contains(error_of([] { trajectory::fit({{0, {}}, {1, {}}, {1, {}}}, "x.tum"); }), "pose 3: its time 1 s"));
  CHECK(contains(error_of([] { trajectory::fit({{0, {}}, {std::nan(""), {}}}, "x.tum"); }), "not finite"));
  CHECK(contains(error_of([] { trajectory::fit({}, "x.tum"); }), "no pose"));

  // values on which memory and time depend are bounded
  CHECK(contains(error_of([] { trajectory::fit({{0, {}}, {1, {}}, {1e7, {}}}, "x.tum"); }),
                 "pose 3: comes 1e+07 s after the first and a motion lasts at most 86400 s"));
  CHECK(error_of([] { trajectory::fit({{1.7e9, {}}, {1.7e9 + 86400, {}}}, "x.tum"); }) == "");
  Sample far;
  far.pose.translation.x() = 1e300;
  CHECK(contains(error_of([&] { trajectory::fit({far}, "x.tum"); }), "pose 1: lies more than 1000000 m"));
  std::string many;
  for (int k = 0; k <= 1000000; ++k) many += "0 0 0 0 0 0 0 1\n";
  CHECK(contains(refused(many), "base.tum:1000001: is beyond the 1000000 poses"));
}
