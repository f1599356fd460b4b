// Whole recordings with known truth, rendered: blurred, noisy, through bent lenses, by clocks that are off. Each case
// renders a recording and runs all of calibrate over it, so all are of the suite "whole".
#include <doctest/doctest.h>
#include <unistd.h>

#include <filesystem>
#include <fstream>
#include <nlohmann/json.hpp>
#include <numbers>

#include "board_renderer.h"
#include "chainsplat/calibration.h"
#include "error_of.h"

using namespace chainsplat;
using namespace chainsplat::calibration;
using math::Matrix3;
using math::Pose;
using math::Vector3;
using test::error_of;
using Json = nlohmann::ordered_json;

namespace {

constexpr double kDegrees = 180.0 / std::numbers::pi;
constexpr double kBlur = 0.8, kNoise = 3.0;  // px, gray levels
constexpr double kRate = 5.0;                // Hz
constexpr int kFrames = 38;                  // of the robot that moves the board

struct Folder {
  Path path = std::filesystem::temp_directory_path() / ("chainsplat_calibration_" + std::to_string(getpid()));
  Folder() { std::filesystem::create_directories(path); }
  ~Folder() { std::filesystem::remove_all(path); }
};

bool has(const Calibration& result, const std::string& code) {
  return std::any_of(result.findings.begin(), result.findings.end(), [&](const Finding& f) { return f.code == code; });
}

// Cameras 1 m from the place of the board, to its left and right.
std::vector<capture::Camera> true_cameras() {
  std::vector<capture::Camera> cameras(2);
  for (int c = 0; c < 2; ++c) {
    capture::Camera& camera = cameras[c];
    camera.name = "cam" + std::to_string(c);
    camera.width = 640, camera.height = 480;
    camera.fx = 610 - 30 * c, camera.fy = 608 - 28 * c, camera.cx = 327 - 12 * c, camera.cy = 233 + 14 * c;
    camera.distortion = {-0.18 + 0.05 * c, 0.06, 0.0007, -0.0006, 0.0};
    const Pose place{math::exp_so3({0, 0, 0.4}), {0.3, -0.2, 0.5}};  // nothing is parallel to the world
    const double angle = c == 0 ? 0.35 : -0.4;
    const Vector3 eye(std::sin(angle), 0.05 * c, -std::cos(angle));
    camera.world_from_camera = place * Pose{math::exp_so3({0, -angle, 0}), eye};
  }
  return cameras;
}

// world_from_flange: about the place that the cameras look at.
Pose flange_at(double t, double turning) {
  const Pose place{math::exp_so3({0, 0, 0.4}), {0.3, -0.2, 0.5}};
  const Matrix3 face = Vector3(1, -1, -1).asDiagonal();
  const Vector3 turn(0.45 * std::sin(0.83 * t), 0.4 * std::sin(1.19 * t + 1), 0.5 * std::sin(0.61 * t + 2));
  const Vector3 shift(0.2 * std::sin(1.07 * t), 0.14 * std::sin(1.51 * t + 0.4), 0.12 * std::sin(0.7 * t));
  return place * Pose{math::exp_so3(Vector3(turning * turn.x(), turn.y(), turning * turn.z())) * face, shift};
}

Board true_board() {
  Board board;
  board.columns = 4, board.rows = 3, board.tag_size = 0.05, board.spacing = 0.0167;
  return board;
}

const Pose kFlangeFromBoard{math::exp_so3({0.05, -0.08, 0.3}), {0.012, -0.02, 0.055}};

// The true camera and board, in which no case differs: where a pixel's light comes from is worked out once.
const test::BoardRenderer& renderer_of(int camera) {
  static const std::array<test::BoardRenderer, 2> both{test::BoardRenderer(true_cameras()[0], true_board()),
                                                       test::BoardRenderer(true_cameras()[1], true_board())};
  return both[camera];
}

Path frame_in(const Path& folder, int frame, const char* ending) {
  char name[32];
  std::snprintf(name, sizeof name, "%06d%s", frame, ending);
  return folder / name;
}

// As plain PGM: to compress noise takes as long as to render it.
void render(const Path& folder, int camera, int frames, const std::function<Pose(int)>& world_from_board,
            std::uint64_t seed) {
  std::filesystem::create_directories(folder);
  const Pose camera_from_world = true_cameras()[camera].world_from_camera.inverse();
  core::parallel_for(frames, [&](std::int64_t i) {
    core::Random random(seed + 1000 * static_cast<std::uint64_t>(i));
    const Pose camera_from_board = camera_from_world * world_from_board(static_cast<int>(i));
    const capture::Image8 image = renderer_of(camera).image(camera_from_board, kBlur, kNoise, random);
    core::write_file(frame_in(folder, static_cast<int>(i), ".pgm"),
                     "P5 " + std::to_string(image.width) + " " + std::to_string(image.height) + " 255\n" +
                         std::string(image.pixels.begin(), image.pixels.end()));
  });
}

// Every so many frames of a rendered recording, as one of its own.
void thin_out(const Path& from, const Path& to, int frames, int step) {
  std::filesystem::create_directories(to);
  for (int i = 0; i * step < frames; ++i)
    std::filesystem::create_hard_link(frame_in(from, i * step, ".pgm"), frame_in(to, i, ".pgm"));
}

std::string slurp(const Path& file) { return core::read_file(file); }

}  // namespace

TEST_CASE("a robot that moves a board: lenses, poses, the board on the flange, and clocks" *
          doctest::test_suite("whole")) {
  const Folder folder;
  const std::vector<capture::Camera> cameras = true_cameras();
  const Board board = true_board();
  const double clocks[] = {0.043, -0.118};  // s, that the cameras' stamps are behind
  core::write_file(folder.path / "board.json", write_board(board));
  for (int c = 0; c < 2; ++c)
    render(
        folder.path / cameras[c].name, c, kFrames,
        [&](int i) { return flange_at(1.0 + i / kRate + clocks[c], 1.0) * kFlangeFromBoard; }, 17 + c);
  // the log has a robot's errors: 0.1 mm and 0.01 degrees at 100 Hz
  std::vector<trajectory::Sample> log;
  core::Random random(99);
  const auto noise = [&](double size) {
    return Vector3(size * Vector3(random.normal(), random.normal(), random.normal()));
  };
  for (int i = 0; i <= 1000; ++i) {
    Pose pose = flange_at(0.01 * i, 1.0);
    pose.translation += noise(1e-4), pose.rotation = math::exp_so3(noise(1.7e-4)) * pose.rotation;
    log.push_back({0.01 * i, pose});
  }
  core::write_file(folder.path / "robot.tum", trajectory::write_tum(log));

  Options options;
  options.board = folder.path / "board.json";
  options.log.base.file = folder.path / "robot.tum";
  for (const capture::Camera& camera : cameras) {
    CameraRequest request;
    request.name = camera.name, request.images = folder.path / camera.name, request.rate = kRate, request.start = 1.0;
    options.cameras.push_back(request);
  }
  const Calibration result = calibrate(folder.path / "out", options);
  for (const Finding& finding : result.findings) MESSAGE(finding.text);
  CHECK(result.trusted());
  REQUIRE(result.cameras.size() == 2);
  double scores = 0.0;
  int numbers = 0;
  for (int c = 0; c < 2; ++c) {
    const CameraResult& found = result.cameras[c];
    const capture::Camera &truth = cameras[c], &camera = found.camera;
    const double turn =
        math::log_so3(camera.world_from_camera.rotation * truth.world_from_camera.rotation.transpose()).norm() *
        kDegrees;
    const double shift = (camera.world_from_camera.translation - truth.world_from_camera.translation).norm();
    MESSAGE(camera.name << ": fx " << camera.fx / truth.fx - 1 << " fy " << camera.fy / truth.fy - 1 << " cx "
                        << camera.cx - truth.cx << " cy " << camera.cy - truth.cy << " px, turned " << turn
                        << " degrees, shifted " << 1e3 * shift << " mm, clock " << 1e3 * (found.clock - clocks[c])
                        << " ms, RMS " << found.rms << " px, " << found.rms_mm << " mm; deviations "
                        << found.deviation.fx << " px " << 1e3 * found.deviation.position.norm() << " mm "
                        << found.deviation.rotation.norm() * kDegrees << " degrees " << 1e3 * found.deviation.clock
                        << " ms; views " << found.views);
    CHECK(std::abs(camera.fx / truth.fx - 1) < 0.002);
    CHECK(std::abs(camera.fy / truth.fy - 1) < 0.002);
    CHECK(std::abs(camera.cx - truth.cx) < 0.002 * truth.fx);
    CHECK(std::abs(camera.cy - truth.cy) < 0.002 * truth.fx);
    CHECK(turn < 0.05);
    CHECK(shift < 0.0005);
    CHECK(std::abs(found.clock - clocks[c]) < 0.001);
    CHECK(found.start == doctest::Approx(1.0 + found.clock));
    CHECK(found.rms < 0.15);
    const double off[] = {
        (camera.fx - truth.fx) / found.deviation.fx, (camera.cx - truth.cx) / found.deviation.cx,
        (camera.cy - truth.cy) / found.deviation.cy, (found.clock - clocks[c]) / found.deviation.clock,
        shift / found.deviation.position.norm(),     turn / kDegrees / found.deviation.rotation.norm()};
    for (const double score : off) scores += score * score, ++numbers;
    // what import reads
    const capture::Calibration read = capture::read_calibration(folder.path / "out" / (camera.name + ".json"));
    CHECK(read.camera.cx == camera.cx);
    CHECK(read.camera.world_from_camera.translation == camera.world_from_camera.translation);
    CHECK(capture::read_image8(result.pictures[c]).width == 640);
  }
  MESSAGE("errors over standard deviations, RMS: " << std::sqrt(scores / numbers) << "; robot "
                                                   << 1e3 * result.robot_position << " mm "
                                                   << result.robot_rotation * kDegrees << " degrees");
  CHECK(std::sqrt(scores / numbers) < 2.0);
  CHECK((result.flange_from_board.translation - kFlangeFromBoard.translation).norm() < 0.0005);
  CHECK(math::log_so3(result.flange_from_board.rotation * kFlangeFromBoard.rotation.transpose()).norm() * kDegrees <
        0.05);
  CHECK(result.robot_position < 3e-4);

  // every second frame is enough for what follows
  Options fewer = options;
  for (CameraRequest& request : fewer.cameras) {
    const Path thinned = folder.path / "half" / request.name;
    thin_out(request.images, thinned, kFrames, 2);
    request.images = thinned, request.rate = kRate / 2;
  }
  // another number of threads gives the same bytes
  {
    const int threads = core::threads();
    const Calibration by_default = calibrate(folder.path / "half/out", fewer);
    const std::string before = slurp(folder.path / "half/out/calibration.json"),
                      picture = slurp(by_default.pictures[1]);
    core::set_threads(threads == 1 ? 2 : 1);
    Options again = fewer;
    again.force = true;
    calibrate(folder.path / "half/out", again);
    core::set_threads(threads);
    CHECK(slurp(folder.path / "half/out/calibration.json") == before);
    CHECK(slurp(by_default.pictures[1]) == picture);
  }
  // a start that nobody knows is found
  {
    Options unknown = fewer;
    for (CameraRequest& request : unknown.cameras) request.start.reset(), request.find_start = true;
    const Calibration found = calibrate(folder.path / "auto", unknown);
    for (int c = 0; c < 2; ++c) CHECK(std::abs(found.cameras[c].start - 1.0 - clocks[c]) < 0.002);
  }
  // a log of another time
  {
    Options late = options;
    for (CameraRequest& request : late.cameras) request.start = 500.0;
    const std::string line = error_of([&] { calibrate(folder.path / "late", late); });
    CHECK(line.find("robot.tum: covers 0 to 10 s, and cam0 is recorded from 500 to 507.4 s") != std::string::npos);
    CHECK(!std::filesystem::exists(folder.path / "late"));
  }
  // another board
  {
    Board other = board;
    other.first_id = 100;
    core::write_file(folder.path / "other.json", write_board(other));
    Options of_other = options;
    of_other.board = folder.path / "other.json";
    of_other.cameras[0].images = folder.path / "few";
    thin_out(options.cameras[0].images, of_other.cameras[0].images, kFrames, 15);
    const std::string line = error_of([&] { calibrate(folder.path / "other", of_other); });
    CHECK(line.find("cam0 never sees the board in") != std::string::npos);
    CHECK(line.find("but the tags 0, 1, 2, 3, 4, 5, 6, 7, ..., and the board has 100 to 111") != std::string::npos);
  }
  // what is there is not replaced unasked
  CHECK(error_of([&] { calibrate(folder.path / "out", options); }).find("exists already") != std::string::npos);
  CHECK(error_of([&] { calibrate(folder.path, options); }).find("is no calibration") != std::string::npos);
}

TEST_CASE("a robot that turns the board about one axis only does not tell where the cameras are, and it is said" *
          doctest::test_suite("whole")) {
  const Folder folder;
  const std::vector<capture::Camera> cameras = true_cameras();
  const Board board = true_board();
  core::write_file(folder.path / "board.json", write_board(board));
  render(
      folder.path / "cam0", 0, 20, [&](int i) { return flange_at(i / kRate, 0.0) * kFlangeFromBoard; }, 5);
  std::vector<trajectory::Sample> log;
  for (int i = 0; i <= 450; ++i) log.push_back({0.01 * i, flange_at(0.01 * i, 0.0)});
  core::write_file(folder.path / "robot.tum", trajectory::write_tum(log));
  Options options;
  options.board = folder.path / "board.json";
  options.log.base.file = folder.path / "robot.tum";
  options.cameras.resize(1);
  options.cameras[0].name = "cam0", options.cameras[0].images = folder.path / "cam0", options.cameras[0].rate = kRate;
  const Calibration result = calibrate(folder.path / "out", options);
  CHECK(!result.trusted());
  CHECK(has(result, "one_axis"));
  CHECK(std::filesystem::exists(folder.path / "out" / "calibration.json"));
}

TEST_CASE("a hand that holds a board: cameras relative to the first, or to the board where it lay first" *
          doctest::test_suite("whole")) {
  const Folder folder;
  const std::vector<capture::Camera> cameras = true_cameras();
  const Board board = true_board();
  core::write_file(folder.path / "board.json", write_board(board));
  // held still for two frames in each of 20 places, of which half are enough for the second world
  constexpr int kBoth = 40;
  const auto place = [&](int i) { return flange_at(0.77 * (i / 2), 1.0); };
  for (int c = 0; c < 2; ++c) {
    render(folder.path / cameras[c].name, c, kBoth, place, 70 + c);
    thin_out(folder.path / cameras[c].name, folder.path / "half" / cameras[c].name, kBoth / 2, 1);
  }
  Options options;
  options.board = folder.path / "board.json";
  for (const capture::Camera& camera : cameras) {
    CameraRequest request;
    request.name = camera.name, request.images = folder.path / camera.name, request.rate = kRate;
    options.cameras.push_back(request);
  }
  for (const World world : {World::camera, World::board}) {
    options.world = world;
    if (world == World::board)
      for (CameraRequest& request : options.cameras) request.images = folder.path / "half" / request.name;
    const Calibration result = calibrate(folder.path / (world == World::camera ? "camera" : "board"), options);
    for (const Finding& finding : result.findings) MESSAGE(finding.text);
    CHECK(result.trusted());
    const Pose world_from = world == World::camera ? cameras[0].world_from_camera : place(0);
    for (int c = 0; c < 2; ++c) {
      const Pose truth = world_from.inverse() * cameras[c].world_from_camera;
      const CameraResult& found = result.cameras[c];
      const Pose& pose = found.camera.world_from_camera;
      const double turn = math::log_so3(pose.rotation * truth.rotation.transpose()).norm() * kDegrees;
      const double shift = (pose.translation - truth.translation).norm();
      MESSAGE("cam" << c << ": fx " << found.camera.fx / cameras[c].fx - 1 << ", turned " << turn
                    << " degrees, shifted " << 1e3 * shift << " mm, deviations "
                    << 1e3 * found.deviation.position.norm() << " mm " << found.deviation.rotation.norm() * kDegrees
                    << " degrees, RMS " << found.rms << " px, views " << found.views);
      CHECK(std::abs(found.camera.fx / cameras[c].fx - 1) < 0.002);
      CHECK(turn < 0.1);
      CHECK(shift < 0.001);
      CHECK(turn / kDegrees < 3.0 * found.deviation.rotation.norm() + 1e-8);
      CHECK(shift < 3.0 * found.deviation.position.norm() + 1e-8);
    }
  }
}

TEST_CASE("cameras that never share a view, and poor views, are said" * doctest::test_suite("whole")) {
  const Folder folder;
  const std::vector<capture::Camera> cameras = true_cameras();
  const Board board = true_board();
  core::write_file(folder.path / "board.json", write_board(board));
  // hardly tilted, in the middle of the image, few
  const auto place = [&](int c, int i) {
    const Matrix3 face = Vector3(1, -1, -1).asDiagonal();
    return cameras[c].world_from_camera *
           Pose{math::exp_so3(Vector3(0.05 * i, -0.04 * i, 0)) * face, Vector3(0.03 * i, -0.01 * i, 1.0)};
  };
  for (int c = 0; c < 2; ++c)
    render(
        folder.path / cameras[c].name, c, 6,
        [&](int i) {
          return i / 3 == c ? place(c, i % 3) : Pose{Matrix3::Identity(), {0, 0, 1e4}};
        },
        9 + c);
  Options options;
  options.board = folder.path / "board.json";
  for (const capture::Camera& camera : cameras) {
    CameraRequest request;
    request.name = camera.name, request.images = folder.path / camera.name, request.rate = kRate;
    options.cameras.push_back(request);
  }
  const Calibration result = calibrate(folder.path / "out", options);
  CHECK(!result.trusted());
  CHECK(has(result, "no_pose"));
  CHECK(has(result, "few_views"));
  CHECK(has(result, "no_tilt"));
  CHECK(!std::filesystem::exists(folder.path / "out" / "cam1.json"));
  CHECK(std::filesystem::exists(folder.path / "out" / "cam0.json"));
  // nothing to be seen
  render(
      folder.path / "empty", 0, 2,
      [](int) {
        return Pose{Matrix3::Identity(), {0, 0, 1e4}};
      },
      1);
  options.cameras[1].images = folder.path / "empty";
  CHECK(error_of([&] {
          calibrate(folder.path / "none", options);
        }).find("never sees the board in 2 frames, and no other tag") != std::string::npos);
  options.cameras[1].images = folder.path / "nowhere.mp4";
  CHECK(error_of([&] { calibrate(folder.path / "none", options); }).find("nowhere.mp4: does not exist") !=
        std::string::npos);
  options.cameras[1].name = "cam0";
  CHECK(error_of([&] { calibrate(folder.path / "none", options); }).find("given twice") != std::string::npos);
}
