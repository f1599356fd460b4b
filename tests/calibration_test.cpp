// A board on paper, its tags in pictures, and the joint fit on made corners.
#include "chainsplat/calibration.h"

#include <doctest/doctest.h>

#include <filesystem>
#include <fstream>
#include <nlohmann/json.hpp>
#include <numbers>

#include "board_renderer.h"
#include "calibration/bundle.h"
#include "calibration/start.h"
#include "calibration/tags.h"
#include "error_of.h"

using namespace chainsplat;
using namespace chainsplat::calibration;
using math::Matrix3;
using math::Pose;
using math::Vector2;
using math::Vector3;
using test::error_of;

namespace {

constexpr double kDegree = std::numbers::pi / 180.0;

capture::Camera wide_camera() {
  capture::Camera camera;
  camera.name = "cam0";
  camera.width = 640, camera.height = 480;
  camera.fx = 603.0, camera.fy = 600.5, camera.cx = 331.2, camera.cy = 236.7;
  camera.distortion = {-0.21, 0.07, 0.0008, -0.0011, -0.01};
  return camera;
}

// In front of the camera, facing it (the board's z towards it), then turned.
Pose facing(double x, double y, double z, const Vector3& turn) {
  const Matrix3 face = Vector3(1, -1, -1).asDiagonal();
  return {math::exp_so3(turn) * face, {x, y, z}};
}

// A bundle whose corners are exact: `count` moments of a board before cameras that stand in an arc.
Bundle made_bundle(int cameras, int count, const trajectory::Trajectory* robot, core::Random& random) {
  Board board;
  board.columns = 4, board.rows = 3, board.tag_size = 0.04, board.spacing = 0.012;
  Bundle bundle;
  bundle.robot = robot;
  const Matrix3 face = Vector3(1, -1, -1).asDiagonal();
  for (int c = 0; c < cameras; ++c) {
    capture::Camera camera = wide_camera();
    const double angle = 0.5 * (c - 0.5 * (cameras - 1));
    camera.world_from_camera = Pose{math::exp_so3({0, -angle, 0}), {std::sin(angle), 0.02 * c, 1.0 - std::cos(angle)}};
    bundle.cameras.push_back(camera), bundle.clocks.push_back(robot ? 0.02 * (c + 1) : 0.0), bundle.scales.push_back(1);
  }
  bundle.flange_from_board = robot ? Pose{math::exp_so3({0.1, -0.2, 0.3}), {0.01, 0.02, 0.06}} : Pose{};
  for (int m = 0; m < count; ++m) {
    Moment moment;
    if (!robot)
      moment.pose =
          Pose{math::exp_so3({random.uniform(-0.6, 0.6), random.uniform(-0.6, 0.6), random.uniform(-0.5, 0.5)}) * face,
               {random.uniform(-0.15, 0.15), random.uniform(-0.1, 0.1), random.uniform(0.7, 1.2)}};
    for (int c = 0; c < cameras; ++c) {
      View view{c, m, robot ? 0.2 + 0.05 * m : 0.1 * m, {}};
      const Pose camera_from_board =
          bundle.cameras[c].world_from_camera.inverse() * board_in_world(bundle, moment, view);
      for (int id = 0; id < board.tags(); ++id)
        for (int k = 0; k < 4; ++k)
          if (const auto pixel = pixel_of(bundle.cameras[c], camera_from_board * board.corner(id, k)))
            if (pixel->x() > 0 && pixel->y() > 0 && pixel->x() < 640 && pixel->y() < 480)
              view.corners.push_back({board.corner(id, k), *pixel, 0.1});
      if (view.corners.size() >= 4) moment.views.push_back(view);
    }
    if (!moment.views.empty()) bundle.moments.push_back(moment);
  }
  return bundle;
}

// A robot that turns and moves about a place 1 m in front of the world's origin.
trajectory::Trajectory made_robot() {
  std::vector<trajectory::Sample> samples;
  const Matrix3 face = Vector3(1, -1, -1).asDiagonal();
  for (int i = 0; i <= 1200; ++i) {
    const double t = 0.01 * i;
    samples.push_back(
        {t, Pose{math::exp_so3({0.5 * std::sin(0.9 * t), 0.45 * std::sin(1.3 * t + 1), 0.5 * std::sin(0.7 * t + 2)}) *
                     face * math::exp_so3({0.1, -0.2, 0.3}).transpose(),
                 {0.12 * std::sin(1.1 * t), 0.09 * std::cos(0.8 * t), 1.0 + 0.15 * std::sin(0.6 * t)}}});
  }
  return trajectory::fit(samples, "made");
}

}  // namespace

TEST_CASE("a board is read as it was written, and what is wrong with one is said in a line") {
  const Path folder = std::filesystem::temp_directory_path() / "chainsplat_board_test";
  std::filesystem::create_directories(folder);
  const Path file = folder / "board.json";
  Board board;
  board.columns = 3, board.rows = 2, board.tag_size = 0.05, board.spacing = 0.02, board.first_id = 40;
  core::write_file(file, write_board(board));
  const Board read = read_board(file);
  CHECK(read.columns == 3);
  CHECK(read.rows == 2);
  CHECK(read.tag_size == 0.05);
  CHECK(read.spacing == 0.02);
  CHECK(read.first_id == 40);
  const auto refusal = [&](const std::string& text) {
    core::write_file(file, text);
    return error_of([&] { read_board(file); });
  };
  const std::string good = write_board(board);
  const auto with = [&](const char* key, nlohmann::ordered_json value) {
    auto json = nlohmann::ordered_json::parse(good);
    json[key] = value;
    return json.dump();
  };
  CHECK(refusal(with("tagsize", 0.05)).find("unknown key 'tagsize'; known are format") != std::string::npos);
  CHECK(refusal(with("tag_size", "5 cm")).find("tag_size: \"5 cm\" is no number") != std::string::npos);
  CHECK(refusal(with("tag_size", -1)).find("tag_size: -1 m") != std::string::npos);
  CHECK(refusal(with("spacing", 0.001)).find("too little white") != std::string::npos);
  CHECK(refusal(with("columns", 2.5)).find("columns: 2.5 is no whole number") != std::string::npos);
  CHECK(refusal(with("columns", 500)).find("more than there are") != std::string::npos);
  CHECK(refusal(with("family", "tag16h5")).find("is not supported") != std::string::npos);
  CHECK(refusal("{\"columns\": 3}").find("has no key 'format'") != std::string::npos);
  CHECK(refusal("[1]").find("is no board") != std::string::npos);
  CHECK(error_of([&] { read_board(folder / "none.json"); }).find("none.json") != std::string::npos);
  std::filesystem::remove_all(folder);
}

TEST_CASE("the page has each tag's black square where the board says its corners are, and a ruler of 100 mm") {
  Board board;
  board.columns = 3, board.rows = 2, board.tag_size = 0.05, board.spacing = 0.02, board.first_id = 7;
  const std::string svg = board_svg(board);
  const auto page = test::read_page(svg);
  REQUIRE(page.size() == 6);
  for (const auto& [id, rectangles] : page) {
    double x0 = 1, y0 = 1, x1 = -1, y1 = -1;
    for (const test::Rectangle& r : rectangles)
      x0 = std::min(x0, r.x0), y0 = std::min(y0, r.y0), x1 = std::max(x1, r.x1), y1 = std::max(y1, r.y1);
    CHECK((board.corner(id, 0) - Vector3(x0, y0, 0)).norm() < 3e-6);  // the page has micrometers
    CHECK((board.corner(id, 1) - Vector3(x1, y0, 0)).norm() < 3e-6);
    CHECK((board.corner(id, 2) - Vector3(x1, y1, 0)).norm() < 3e-6);
    CHECK((board.corner(id, 3) - Vector3(x0, y1, 0)).norm() < 3e-6);
  }
  const std::size_t ruler = svg.find("id=\"ruler\"");
  REQUIRE(ruler != std::string::npos);
  double first = 0, last = 0, w = 0;
  std::sscanf(svg.c_str() + svg.find('M', ruler), "M%lf", &first);
  const std::size_t end = svg.find("\"/>", ruler), line = svg.rfind('M', end), tick = svg.rfind('M', line - 1);
  std::sscanf(svg.c_str() + tick, "M%lf", &last);
  std::sscanf(svg.c_str() + svg.find('h', line), "h%lf", &w);
  CHECK(last - first == doctest::Approx(100.0).epsilon(1e-6));
  CHECK(w == doctest::Approx(100.0).epsilon(1e-6));
  CHECK(svg.find("tag36h11 7 to 12, 3 x 2") != std::string::npos);
}

TEST_CASE("corners of rendered tags are found where they are: pixel (0, 0) is centered at (0.5, 0.5)") {
  capture::Camera camera = wide_camera();
  Board board;
  board.columns = 4, board.rows = 3, board.tag_size = 0.06, board.spacing = 0.02;
  core::Random random(3);
  for (const bool bent : {false, true}) {
    CAPTURE(bent);
    if (!bent)
      camera.distortion = {};
    else
      camera.distortion = wide_camera().distortion;
    const test::BoardRenderer renderer(camera, board);
    for (const double blur : {0.5, 1.2}) {
      CAPTURE(blur);
      Vector2 sum = Vector2::Zero();
      double squares = 0.0, expected = 0.0, worst = 0.0;
      int count = 0;
      for (int i = 0; i < 6; ++i) {
        const Pose pose = facing(random.uniform(-0.08, 0.08), random.uniform(-0.06, 0.06), random.uniform(0.7, 1.0),
                                 {random.uniform(-0.5, 0.5), random.uniform(-0.5, 0.5), random.uniform(-3, 3)});
        const Gray image = gray(renderer.image(pose, blur, 2.0, random));
        std::map<int, int> others;
        const std::vector<Tag> tags = find_tags(image, board, others);
        CHECK(tags.size() >= 10);
        CHECK(others.empty());
        for (const Tag& tag : tags) {
          const auto found = corners(tag, camera);
          if (!found) continue;
          for (int k = 0; k < 4; ++k) {
            const Vector3 at = pose * board.corner(tag.id, k);
            const Vector2 truth = capture::distort(camera, capture::project(camera, at));
            const Vector2 off = (*found)[k].pixel - truth;
            CHECK((tag.rough[k] - truth).norm() < 2.0);  // the same corner, in the same order
            sum += off, squares += off.squaredNorm(), worst = std::max(worst, off.norm()), ++count;
            expected += 2.0 * std::pow((*found)[k].deviation, 2);
          }
        }
      }
      REQUIRE(count > 200);
      MESSAGE("bent " << bent << " blur " << blur << ": mean " << (sum / count).transpose() << " rms "
                      << std::sqrt(squares / count) << " expected " << std::sqrt(expected / count) << " worst " << worst
                      << " of " << count);
      CHECK((sum / count).norm() < 0.01);
      CHECK(std::sqrt(squares / count) < 0.07);
      CHECK(std::sqrt(squares / count) < 1.6 * std::sqrt(expected / count));
      CHECK(std::sqrt(squares / count) > 0.5 * std::sqrt(expected / count));
    }
  }
}

TEST_CASE("the lens is the capture's, and its derivatives are right") {
  const capture::Camera camera = wide_camera();
  for (const Vector3& point : {Vector3(0.1, -0.2, 0.9), Vector3(-0.4, 0.3, 1.1), Vector3(0, 0, 1)}) {
    Eigen::Matrix<double, 2, 3> by_point;
    Eigen::Matrix<double, 2, kLensUnknowns> by_lens;
    const auto pixel = pixel_of(camera, point, by_point, by_lens);
    REQUIRE(pixel);
    CHECK((*pixel - capture::distort(camera, capture::project(camera, point))).norm() < 1e-9);
    for (int k = 0; k < 3; ++k) {
      const Vector3 step = 1e-6 * Vector3::Unit(k);
      const Vector2 numeric = (*pixel_of(camera, point + step) - *pixel_of(camera, point - step)) / 2e-6;
      CHECK((numeric - by_point.col(k)).norm() < 1e-5 * (1.0 + numeric.norm()));
    }
    for (int k = 0; k < kLensUnknowns; ++k) {
      const auto changed = [&](double step) {
        capture::Camera other = camera;
        double* const unknowns[] = {&other.fx, &other.fy, &other.cx, &other.cy};
        (k < 4 ? *unknowns[k] : other.distortion[k - 4]) += step;
        return *pixel_of(other, point);
      };
      const Vector2 numeric = (changed(1e-5) - changed(-1e-5)) / 2e-5;
      CHECK((numeric - by_lens.col(k)).norm() < 1e-5 * (1.0 + numeric.norm()));
    }
  }
  CHECK(!pixel_of(camera, {0, 0, -1}));
}

TEST_CASE("the joint fit finds what made the corners, from a start that is far off") {
  const trajectory::Trajectory robot = made_robot();
  for (const bool with_robot : {false, true}) {
    CAPTURE(with_robot);
    core::Random random(11);
    const Bundle truth = made_bundle(2, 40, with_robot ? &robot : nullptr, random);
    Bundle bundle = truth;
    bundle.robot_position = 1e-4, bundle.robot_rotation = 1e-4;
    for (capture::Camera& camera : bundle.cameras) {
      camera.fx *= 1.04, camera.fy *= 0.97, camera.cx += 6, camera.cy -= 5, camera.distortion = {};
      if (with_robot || &camera != &bundle.cameras[0])
        camera.world_from_camera = camera.world_from_camera *
                                   math::exp_se3((math::Vector6() << 0.03, -0.02, 0.04, 0.02, 0.03, -0.02).finished());
    }
    if (with_robot) {
      bundle.flange_from_board = bundle.flange_from_board *
                                 math::exp_se3((math::Vector6() << 0.05, 0.05, -0.04, 0.01, -0.01, 0.02).finished());
      bundle.clocks = {0.05, 0.0};
    } else {
      for (Moment& moment : bundle.moments) moment.pose.translation.z() *= 1.05;
    }
    set_scales(bundle);
    fit(bundle, 60);
    bundle.scales = {1.0, 1.0};
    fit(bundle, 30);
    for (int c = 0; c < 2; ++c) {
      CHECK(bundle.cameras[c].fx == doctest::Approx(truth.cameras[c].fx).epsilon(1e-5));
      CHECK(bundle.cameras[c].cy == doctest::Approx(truth.cameras[c].cy).epsilon(1e-4));
      CHECK(bundle.cameras[c].distortion[0] == doctest::Approx(truth.cameras[c].distortion[0]).epsilon(1e-3));
      CHECK((bundle.cameras[c].world_from_camera.translation - truth.cameras[c].world_from_camera.translation).norm() <
            1e-5);
      CHECK(math::log_so3(bundle.cameras[c].world_from_camera.rotation *
                          truth.cameras[c].world_from_camera.rotation.transpose())
                .norm() < 3e-5);
      if (with_robot) CHECK(std::abs(bundle.clocks[c] - truth.clocks[c]) < 1e-5);
    }
    if (with_robot) CHECK((bundle.flange_from_board.translation - truth.flange_from_board.translation).norm() < 1e-5);
  }
}

TEST_CASE("standard deviations are those of repeated fits") {
  const trajectory::Trajectory robot = made_robot();
  core::Random random(5);
  constexpr double kPixelNoise = 0.1, kRobotPosition = 3e-4, kRobotRotation = 5e-4;  // px, m, rad
  const Bundle truth = made_bundle(2, 25, &robot, random);
  std::vector<double> scores;
  constexpr int kFits = 24;
  for (int n = 0; n < kFits; ++n) {
    Bundle bundle = truth;
    bundle.robot_position = kRobotPosition, bundle.robot_rotation = kRobotRotation;
    for (Moment& moment : bundle.moments) {
      Moment real = moment;
      for (int k = 0; k < 3; ++k) real.pose.translation(k) = kRobotPosition * random.normal();
      real.pose.rotation = math::exp_so3(kRobotRotation * Vector3(random.normal(), random.normal(), random.normal()));
      for (View& view : moment.views) {
        const Pose camera_from_board =
            truth.cameras[view.camera].world_from_camera.inverse() * board_in_world(truth, real, view);
        for (Seen& seen : view.corners)
          seen.pixel = *pixel_of(truth.cameras[view.camera], camera_from_board * seen.point) +
                       kPixelNoise * Vector2(random.normal(), random.normal());
      }
    }
    fit(bundle, 40);
    const Certainty sure = certainty(bundle);
    set_scales(bundle, sure.absorbed);
    for (const double scale : bundle.scales) CHECK(scale == doctest::Approx(1.0).epsilon(0.05));
    CHECK(std::sqrt(sure.position_square) == doctest::Approx(kRobotPosition).epsilon(0.35));
    CHECK(std::sqrt(sure.rotation_square) == doctest::Approx(kRobotRotation).epsilon(0.35));
    const math::VectorX sigma = sure.covariance.diagonal().cwiseSqrt();
    for (int c = 0; c < 2; ++c) {
      const capture::Camera &a = bundle.cameras[c], &b = truth.cameras[c];
      const Vector3 turn = math::log_so3(a.world_from_camera.rotation * b.world_from_camera.rotation.transpose());
      const Vector3 shift = a.world_from_camera.translation - b.world_from_camera.translation;
      const double off[kCameraUnknowns] = {a.fx - b.fx,
                                           a.fy - b.fy,
                                           a.cx - b.cx,
                                           a.cy - b.cy,
                                           a.distortion[0] - b.distortion[0],
                                           a.distortion[1] - b.distortion[1],
                                           a.distortion[2] - b.distortion[2],
                                           a.distortion[3] - b.distortion[3],
                                           a.distortion[4] - b.distortion[4],
                                           turn.x(),
                                           turn.y(),
                                           turn.z(),
                                           shift.x(),
                                           shift.y(),
                                           shift.z(),
                                           bundle.clocks[c] - truth.clocks[c]};
      for (int k = 0; k < kCameraUnknowns; ++k) scores.push_back(off[k] / sigma(kCameraUnknowns * c + k));
    }
  }
  // of each unknown, over the fits; 24 of them leave a fifth of uncertainty
  double all = 0.0;
  for (int k = 0; k < 2 * kCameraUnknowns; ++k) {
    double squares = 0.0;
    for (int n = 0; n < kFits; ++n) squares += std::pow(scores[n * 2 * kCameraUnknowns + k], 2) / kFits;
    CAPTURE(k);
    // k3 is hardly seen: what was assumed of it, nearly the truth, decides
    if (k % kCameraUnknowns != 8) CHECK(std::sqrt(squares) > 0.5);
    CHECK(std::sqrt(squares) < 1.7);
    all += squares / (2 * kCameraUnknowns);
  }
  MESSAGE("errors over standard deviations, RMS: " << std::sqrt(all));
  CHECK(std::sqrt(all) == doctest::Approx(1.0).epsilon(0.25));
}

TEST_CASE("a start is found from the views alone") {
  core::Random random(2);
  const trajectory::Trajectory robot = made_robot();
  Bundle truth = made_bundle(1, 60, &robot, random);
  truth.cameras[0].distortion = {};
  for (Moment& moment : truth.moments)
    for (View& view : moment.views) {
      const Pose camera_from_board = truth.cameras[0].world_from_camera.inverse() * board_in_world(truth, moment, view);
      for (Seen& seen : view.corners)
        seen.pixel = *pixel_of(truth.cameras[0], camera_from_board * seen.point) +
                     0.1 * Vector2(random.normal(), random.normal());
    }
  std::vector<const View*> views;
  std::vector<Placed> placed;
  for (const Moment& moment : truth.moments) {
    views.push_back(&moment.views[0]);
    const auto pose = pose_by_homography(moment.views[0], truth.cameras[0]);
    REQUIRE(pose);
    placed.push_back({moment.views[0].time, *pose});
  }
  const auto focal = focal_length(views, 640, 480);
  REQUIRE(focal);
  CHECK(*focal == doctest::Approx(600).epsilon(0.05));  // its center is 12 px off
  const auto clock = clock_by_turns(placed, robot, -1.0, 1.0);
  REQUIRE(clock);
  CHECK(std::abs(*clock - truth.clocks[0]) < 0.03);
  const auto found = hand_eye(placed, robot, truth.clocks[0]);
  REQUIRE(found);
  CHECK((found->world_from_camera.translation - truth.cameras[0].world_from_camera.translation).norm() < 0.02);
  CHECK((found->flange_from_board.translation - truth.flange_from_board.translation).norm() < 0.02);
  CHECK(math::log_so3(found->flange_from_board.rotation * truth.flange_from_board.rotation.transpose()).norm() <
        2 * kDegree);
  // a robot at rest has no turns to tell the clock by
  std::vector<Placed> same(30, placed[0]);
  for (int i = 0; i < 30; ++i) same[i].time = 0.1 * i;
  CHECK(!clock_by_turns(same, robot, -1.0, 1.0));
}
