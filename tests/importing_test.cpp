// Files of other programs as they write them, against numbers that are known.
#include <doctest/doctest.h>
#include <unistd.h>

#include <cmath>
#include <cstring>
#include <filesystem>
#include <fstream>

#include "chainsplat/importing.h"
#include "importing/base_log.h"
#include "importing/calibration.h"
#include "importing/clock.h"
#include "importing/document.h"
#include "importing/lens.h"
#include "importing/media.h"
#include "importing/picture.h"
#include "importing/table.h"

using namespace chainsplat;
using namespace chainsplat::importing;
using math::Pose;
using math::Vector2;
using math::Vector3;

namespace {

struct Folder {
  Path path = std::filesystem::temp_directory_path() / ("chainsplat_importing_" + std::to_string(::getpid()));
  Folder() { std::filesystem::create_directories(path); }
  ~Folder() { std::filesystem::remove_all(path); }
  Path write(const std::string& name, const std::string& text) const {
    std::filesystem::create_directories((path / name).parent_path());
    std::ofstream(path / name, std::ios::binary) << text;
    return path / name;
  }
};

// 0.1 rad about x, then y, then z by half as much each; a place whose numbers are all different.
Pose some_pose() { return {math::exp_so3({0.7, -0.4, 1.1}), {0.3, -0.5, 1.2}}; }

double apart(const Pose& a, const Pose& b) {
  return std::max((a.rotation - b.rotation).cwiseAbs().maxCoeff(),
                  (a.translation - b.translation).cwiseAbs().maxCoeff());
}

std::string rows(const Pose& pose, const char* line = ", ", const char* between = ", ") {
  std::string text;
  char number[40];
  for (int r = 0; r < 4; ++r)
    for (int c = 0; c < 4; ++c) {
      const double value = r == 3 ? (c == 3) : c == 3 ? pose.translation[r] : pose.rotation(r, c);
      std::snprintf(number, sizeof number, "%.12g", value);
      text += number + std::string(r == 3 && c == 3 ? "" : c == 3 ? line : between);
    }
  return text;
}

std::string words_of(const InputError& error) { return error.what(); }

template <class Call>
std::string refusal(const Call& call) {
  try {
    call();
  } catch (const InputError& error) {
    return words_of(error);
  }
  return "";
}

bool holds(const std::string& text, const char* part) { return text.find(part) != std::string::npos; }

}  // namespace

TEST_CASE("OpenCV's YAML and JSON: half a pixel more, and rvec and tvec take the world to the camera") {
  const Folder folder;
  const Pose camera_from_world = some_pose();
  const Vector3 r = math::log_so3(camera_from_world.rotation), t = camera_from_world.translation;
  char text[600];
  std::snprintf(text, sizeof text,
                "%%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\ncamera_matrix: !!opencv-matrix\n   rows: 3\n"
                "   cols: 3\n   dt: d\n   data: [ 600., 0., 319.5, 0., 601., 239.5, 0., 0., 1. ]\n"
                "distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 5\n   dt: d\n   data: [ -0.1, 2.e-2, "
                "1e-3, -2e-3, 3e-3 ]\n"
                "rvec: !!opencv-matrix\n   rows: 3\n   cols: 1\n   dt: d\n   data: [ %.15g, %.15g, %.15g ]\n"
                "tvec: [ %.15g, %.15g, %.15g ]\n",
                r.x(), r.y(), r.z(), t.x(), t.y(), t.z());
  const Calibration yaml = read_calibration({folder.write("a.yml", text), ""}, "cam0");
  CHECK(yaml.format == "OpenCV");
  CHECK(yaml.width == 640);
  CHECK(yaml.lens.fx == 600.0);
  CHECK(yaml.lens.cx == 320.0);
  CHECK(yaml.lens.cy == 240.0);
  CHECK(yaml.lens.coefficients == std::vector<double>{-0.1, 0.02, 1e-3, -2e-3, 3e-3});
  REQUIRE(yaml.pose);
  CHECK(yaml.pose->direction == Direction::camera_from_world);
  CHECK(apart(yaml.pose->matrix, camera_from_world) < 1e-12);

  const std::string json = R"({"left": {"K": [[600, 0, 319.5], [0, 601, 239.5], [0, 0, 1]], "D": [], "size": [640, 480],
    "T_world_cam": [[)" + rows(some_pose(), "],[") +
                           "]]}, \"right\": 3}";
  const Calibration named = read_calibration({folder.write("b.json", json), ""}, "left");
  CHECK(named.lens.cx == 320.0);
  CHECK(named.height == 480);
  REQUIRE(named.pose);
  CHECK(named.pose->direction == Direction::world_from_camera);
  CHECK(apart(named.pose->matrix, some_pose()) < 1e-9);
  CHECK(holds(refusal([&] { read_calibration({folder.path / "b.json", "up"}, "left"); }), "it has left, right"));
  CHECK(holds(refusal([&] { read_calibration({folder.write("c.yaml", "a: 1\n"), ""}, "left"); }), "Kalibr camchain"));
  CHECK(holds(refusal([&] {
                read_calibration({folder.write("d.yaml", "a: [1, 2\nb: }"), ""}, "left");
              }),
              "neither YAML, JSON nor"));
}

TEST_CASE("OpenCV's XML") {
  const Folder folder;
  const Calibration c = read_calibration(
      {folder.write(
           "a.xml",
           "<?xml version=\"1.0\"?>\n<opencv_storage>\n<image_width>640</image_width><image_height>480</image_height>\n"
           "<camera_matrix type_id=\"opencv-matrix\"><rows>3</rows><cols>3</cols><dt>d</dt>\n"
           "<data> 600. 0. 319.5\n 0. 601. 239.5 0. 0. 1.</data></camera_matrix>\n<distortion_coefficients "
           "type_id=\"opencv-matrix\"><rows>5</rows><cols>1</cols><dt>d</dt><data>-0.1 0. 0. 0. 2e-3</data>"
           "</distortion_coefficients><rvec>0 0 0</rvec><tvec>0.1 0.2 0.3</tvec></opencv_storage>\n"),
       ""},
      "cam0");
  CHECK(c.width == 640);
  CHECK(c.lens.cy == 240.0);
  CHECK(c.lens.coefficients == std::vector<double>{-0.1, 0.0, 0.0, 0.0, 2e-3});
  REQUIRE(c.pose);
  CHECK(c.pose->matrix.translation == Vector3(0.1, 0.2, 0.3));
  CHECK(refusal([&] { read_calibration({folder.write("b.xml", "<a><b></a>"), ""}, "cam0"); }) != "");
}

TEST_CASE("a matrix's name says which way it maps") {
  const Folder folder;
  const auto direction = [&](const std::string& name) {
    const std::string json =
        R"({"fx": 1000, "fy": 1000, "cx": 1, "cy": 1, ")" + name + "\": [" + rows(some_pose()) + "]}";
    return read_calibration({folder.write("e.json", json), ""}, "left").pose->direction;
  };
  for (const char* name :
       {"T_world_cam", "T_base_camera", "world_T_cam", "cam2world", "camera_to_base", "T_wc", "wTc", "cam0_in_robot",
        "T_world_cam2", "world_from_camera_matrix", "camToWorld", "T_robot_left", "base_from_cam0"})
    CHECK_MESSAGE(direction(name) == Direction::world_from_camera, name);
  for (const char* name :
       {"T_cam_world", "cam_T_world", "world2cam", "base_to_camera", "T_cw", "cTw", "camera_from_world", "worldToCam"})
    CHECK_MESSAGE(direction(name) == Direction::camera_from_world, name);
  for (const char* name : {"extrinsics", "pose", "H", "matrix"})
    CHECK_MESSAGE(direction(name) == Direction::open, name);
}

TEST_CASE("intrinsics and extrinsics as objects, coefficients by name") {
  const Folder folder;
  const Calibration c = read_calibration(
      {folder.write("f.json",
                    R"({"cameras": [{"name": "up"}, {"name": "left", "intrinsics": {"fx": 600, "fy": 601, "cx": 319.5,
    "cy": 239.5, "k1": -0.1, "p2": 0.002, "width": 640, "height": 480}, "extrinsics": {"cam_to_base": [)" +
                        rows(some_pose()) + "]}}]}"),
       ""},
      "left");
  CHECK(c.lens.cx == 320.0);
  CHECK(c.width == 640);
  CHECK(c.lens.coefficients == std::vector<double>{-0.1, 0.0, 0.0, 0.002});
  REQUIRE(c.pose);
  CHECK(c.pose->direction == Direction::world_from_camera);
}

TEST_CASE("ROS camera_info: its R rectifies and is no pose") {
  const Folder folder;
  const Calibration c = read_calibration(
      {folder.write("info.yaml",
                    "image_width: 640\nimage_height: 480\ncamera_name: left\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
                    "  data: [600, 0, 319.5, 0, 601, 239.5, 0, 0, 1]\ndistortion_model: plumb_bob\n"
                    "distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [0.1, 0, 0, 0, 0]\n"
                    "rectification_matrix:\n  rows: 3\n  cols: 3\n  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]\n"
                    "projection_matrix:\n  rows: 3\n  cols: 4\n  data: [600, 0, 320, 0, 0, 600, 240, 0, 0, 0, 1, 0]\n"),
       ""},
      "left");
  CHECK(c.format == "ROS camera_info");
  CHECK(c.lens.cx == 320.0);
  CHECK(c.lens.coefficients[0] == 0.1);
  CHECK_FALSE(c.pose.has_value());
}

TEST_CASE("Kalibr's chain leads back to the first camera") {
  const Folder folder;
  const Pose step{math::exp_so3({0.1, 0.2, -0.1}), {-0.2, 0.01, 0.02}},
      next{math::exp_so3({-0.3, 0.0, 0.1}), {-0.1, 0.0, 0.05}};
  const auto camera = [](const std::string& name, const std::string& chain) {
    return name + ":\n" + chain + "  camera_model: pinhole\n  intrinsics: [600, 601, 319.5, 239.5]\n" +
           "  distortion_model: equidistant\n  distortion_coeffs: [0.1, 0.02, 0, 0]\n  resolution: [640, 480]\n";
  };
  const auto chain = [](const Pose& pose) { return "  T_cn_cnm1:\n  - [" + rows(pose, "]\n  - [") + "]\n"; };
  const Path file =
      folder.write("camchain.yaml", camera("cam0", "") + camera("cam1", chain(step)) + camera("cam2", chain(next)));
  const Calibration first = read_calibration({file, "cam0"}, "left"), third = read_calibration({file, "cam2"}, "up");
  CHECK(first.lens.model == LensModel::fisheye);
  CHECK(first.lens.cx == 320.0);
  REQUIRE(first.rig_from_camera);
  REQUIRE(third.rig_from_camera);
  CHECK(first.rig == third.rig);
  CHECK(apart(*first.rig_from_camera, Pose{}) < 1e-12);
  CHECK(apart(third.rig_from_camera->inverse(), next * step) < 1e-9);
}

TEST_CASE("COLMAP as text and binary, and nerfstudio") {
  const Folder folder;
  const Pose p = some_pose();
  const Eigen::Quaterniond q(p.rotation);
  char line[300];
  std::snprintf(line, sizeof line, "7 %.15g %.15g %.15g %.15g %.15g %.15g %.15g 3 left/0001.png\n", q.w(), q.x(), q.y(),
                q.z(), p.translation.x(), p.translation.y(), p.translation.z());
  folder.write("text/cameras.txt", "# comment\n3 OPENCV 640 480 600 601 320 240 -0.1 0.02 1e-3 -2e-3\n");
  folder.write("text/images.txt", std::string("# comment\n") + line + "\n" + "8 1 0 0 0 0 0 0 3 right/0001.png\n\n");
  std::string cameras, images;
  const auto put = [](std::string& bytes, auto value) {
    bytes.append(reinterpret_cast<const char*>(&value), sizeof value);
  };
  put(cameras, std::uint64_t{1}), put(cameras, std::uint32_t{3}), put(cameras, std::int32_t{4});
  put(cameras, std::uint64_t{640}), put(cameras, std::uint64_t{480});
  for (const double v : {600., 601., 320., 240., -0.1, 0.02, 1e-3, -2e-3}) put(cameras, v);
  put(images, std::uint64_t{1}), put(images, std::uint32_t{7});
  for (const double v : {q.w(), q.x(), q.y(), q.z(), p.translation.x(), p.translation.y(), p.translation.z()})
    put(images, v);
  put(images, std::uint32_t{3});
  images += std::string("left/0001.png") + '\0';
  put(images, std::uint64_t{1}), images.append(24, 'x');
  folder.write("binary/sparse/0/cameras.bin", cameras);
  folder.write("binary/sparse/0/images.bin", images);
  for (const char* name : {"text", "binary"}) {
    const Calibration c = read_calibration({folder.path / name, ""}, "left");
    CHECK(c.width == 640);
    CHECK(c.lens.cx == 320.0);
    CHECK(c.lens.coefficients[3] == -2e-3);
    REQUIRE(c.pose);
    CHECK(c.pose->direction == Direction::camera_from_world);
    CHECK(apart(c.pose->matrix, p) < 1e-12);
  }
  CHECK(holds(refusal([&] {
                read_calibration({folder.path / "text", "up"}, "left");
              }),
              "left/0001.png, right/0001.png"));
  folder.write("binary/sparse/0/images.bin", images.substr(0, 60));
  CHECK(holds(refusal([&] { read_calibration({folder.path / "binary", ""}, "left"); }), "cut off"));

  const Path transforms = folder.write(
      "transforms.json", R"({"fl_x": 600, "fl_y": 601, "cx": 320, "cy": 240, "w": 640, "h": 480, "k1": 0.1, "frames": [
    {"file_path": "images/left.png", "transform_matrix": [[)" +
                             rows(p, "],[") + R"(]]},
    {"file_path": "images/right.png", "transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]})");
  const Calibration nerf = read_calibration({transforms, ""}, "left");
  CHECK(nerf.lens.cx == 320.0);
  CHECK(nerf.pose->axes == Axes::opengl);
  CHECK(apart(nerf.pose->matrix, p) < 1e-9);
}

TEST_CASE("a mild fisheye or rational lens becomes five coefficients, a strong one is undistorted") {
  const Lens rational{300, 301, 320, 240, LensModel::rational, {0.12, 0.03, 1e-3, -1e-3, 0.002, 0.1, 0.01, 0.001}};
  const auto fitted = as_capture_lens(rational, 640, 480);
  REQUIRE(fitted);
  CHECK(fitted->error < kLensTolerance);
  for (const Vector2& at : {Vector2(0.3, 0.2), Vector2(-0.9, 0.6)}) {
    const Vector2 straight(rational.fx * at.x() + rational.cx, rational.fy * at.y() + rational.cy);
    CHECK((capture::distort(fitted->camera, straight) - distort(rational, at)).norm() < kLensTolerance);
  }
  const Lens fisheye{200, 200, 320, 240, LensModel::fisheye, {0.05, -0.01, 0.0, 0.0}};
  CHECK_FALSE(as_capture_lens(fisheye, 640, 480));
  // a picture whose values are a function of the direction looks the same in the straight one
  const auto value = [](const Vector2& p) { return 128 + 60 * std::sin(3 * p.x()) * std::cos(2 * p.y()); };
  const Undistortion straight = undistortion(fisheye, 640, 480);
  CHECK(straight.camera.width > 640);
  capture::Image8 seen{640, 480, 1, std::vector<std::uint8_t>(640 * 480)};
  for (int y = 0; y < 480; ++y)
    for (int x = 0; x < 640; ++x) {
      // equidistant: radius over focal length is about the angle; found by bisection of the model
      const Vector2 d((x + 0.5 - fisheye.cx) / fisheye.fx, (y + 0.5 - fisheye.cy) / fisheye.fy);
      double low = 0.0, high = 1.5;
      for (int i = 0; i < 50; ++i) {
        const double t = 0.5 * (low + high);
        (t * (1 + 0.05 * t * t - 0.01 * t * t * t * t) < d.norm() ? low : high) = t;
      }
      const double scale = d.norm() > 1e-9 ? std::tan(std::min(low, 1.2)) / d.norm() : 1.0;
      seen.pixels[640 * y + x] = static_cast<std::uint8_t>(value(scale * d));
    }
  const capture::Image8 flat = undistort(straight, seen);
  for (const Vector2& p : {Vector2(0, 0), Vector2(0.5, -0.3), Vector2(-0.8, 0.4)}) {
    const int x = static_cast<int>(p.x() * straight.camera.fx + straight.camera.cx);
    const int y = static_cast<int>(p.y() * straight.camera.fy + straight.camera.cy);
    const Vector2 center((x + 0.5 - straight.camera.cx) / straight.camera.fx,
                         (y + 0.5 - straight.camera.cy) / straight.camera.fy);
    CHECK(std::abs(flat.pixels[static_cast<std::size_t>(y) * flat.width + x] - value(center)) < 2.5);
  }
}

TEST_CASE("logs of a robot: names, units, orders and clocks of columns") {
  const Folder folder;
  const auto base_of = [&](const std::string& name, const std::string& text, const std::string& key = "") {
    Options options;
    options.base = {folder.write(name, text), key};
    std::vector<std::string> notes;
    return read_base_log(options, notes);
  };
  const Eigen::Quaterniond q(Eigen::AngleAxisd(0.5, Vector3::UnitZ()));
  char text[500];
  std::snprintf(text, sizeof text, "timestamp_ms;Z [mm];X [mm];Y [mm];qw;qx;qy;qz\n1500;3,5;1;2;%.9f;0;0;%.9f\n", q.w(),
                q.z());
  for (char& c : text)
    if (c == '.') c = ',';
  auto samples = base_of("a.csv", text);
  REQUIRE(samples.size() == 1);
  CHECK(samples[0].time == doctest::Approx(1.5));
  CHECK((samples[0].pose.translation - Vector3(1e-3, 2e-3, 3.5e-3)).norm() < 1e-12);
  CHECK((samples[0].pose.rotation - q.toRotationMatrix()).norm() < 1e-8);
  // UR's RTDE: a place and a rotation vector; of target and actual the actual one
  samples =
      base_of("b.csv",
              "timestamp target_TCP_pose_0 target_TCP_pose_1 target_TCP_pose_2 target_TCP_pose_3 target_TCP_pose_4 "
              "target_TCP_pose_5 actual_TCP_pose_0 actual_TCP_pose_1 actual_TCP_pose_2 actual_TCP_pose_3 "
              "actual_TCP_pose_4 actual_TCP_pose_5\n1 9 9 9 0 0 0 0.1 0.2 0.3 0 0 0.5\n");
  CHECK((samples[0].pose.translation - Vector3(0.1, 0.2, 0.3)).norm() < 1e-12);
  CHECK((samples[0].pose.rotation - q.toRotationMatrix()).norm() < 1e-12);
  // ROS, Unix nanoseconds
  samples =
      base_of("c.csv",
              "%time,field.header.stamp,field.pose.position.x,field.pose.position.y,field.pose.position.z,"
              "field.pose.orientation.x,field.pose.orientation.y,field.pose.orientation.z,field.pose.orientation.w\n"
              "5,1700000000500000000,0.1,0.2,0.3,0,0,0,1\n");
  CHECK(samples[0].time == doctest::Approx(1700000000.5).epsilon(1e-15));
  // roll, pitch, yaw in degrees; a position in plain numbers that no arm reaches in meters
  samples = base_of("d.csv", "t,x,y,z,roll_deg,pitch_deg,yaw_deg\n0,100,200,300,90,0,90\n");
  CHECK((samples[0].pose.translation - Vector3(0.1, 0.2, 0.3)).norm() < 1e-12);
  CHECK((samples[0].pose.rotation * Vector3::UnitY() - Vector3::UnitZ()).norm() < 1e-12);
  CHECK((samples[0].pose.rotation * Vector3::UnitX() - Vector3::UnitY()).norm() < 1e-12);
  // Franka's matrix by columns
  samples = base_of(
      "e.csv",
      "time,O_T_EE_0,O_T_EE_1,O_T_EE_2,O_T_EE_3,O_T_EE_4,O_T_EE_5,O_T_EE_6,O_T_EE_7,O_T_EE_8,O_T_EE_9,"
      "O_T_EE_10,O_T_EE_11,O_T_EE_12,O_T_EE_13,O_T_EE_14,O_T_EE_15\n0,0,1,0,0,-1,0,0,0,0,0,1,0,0.1,0.2,0.3,1\n");
  CHECK((samples[0].pose * Vector3(1, 0, 0) - Vector3(0.1, 1.2, 0.3)).norm() < 1e-12);
  // dates
  samples = base_of("l.csv", "timestamp,x,y,z\n2026-11-22T12:00:00.25Z,0,0,0\n2026-11-22T13:00:01+01:00,0,0,0\n");
  CHECK(samples[0].time == doctest::Approx(1795348800.25).epsilon(1e-15));
  CHECK(samples[1].time - samples[0].time == doctest::Approx(0.75));
  // TUM, with a row that repeats its time
  samples = base_of("f.tum", "# a comment\n0 1 2 3 0 0 0 1\n0 1 2 3 0 0 0 1\n0.1 1 2 3 0 0 0 1\n");
  CHECK(samples.size() == 2);
  CHECK(holds(refusal([&] { base_of("g.csv", "time,a_x,a_y,a_z,b_x,b_y,b_z\n0,1,2,3,4,5,6\n"); }),
              "2 poses are in it: a, b"));
  CHECK(base_of("g.csv", "time,a_x,a_y,a_z,b_x,b_y,b_z\n0,1,2,3,4,5,6\n", "b_")[0].pose.translation.x() == 4.0);
  CHECK(holds(refusal([&] { base_of("h.csv", "time,foo\n0,1\n"); }), "it has time, foo"));
  CHECK(
      holds(refusal([&] { base_of("i.csv", "time,x,y,z\n0,1,2,3\n1,1,?,3\n"); }), "i.csv:3: column 'y' is no number"));
  CHECK(holds(refusal([&] { base_of("j.csv", "time,x,y,z\n1,1,2,3\n0,1,2,3\n"); }), "before that of the line above"));
  CHECK(holds(refusal([&] { base_of("k.mcap", ""); }), "bag_to_files"));
}

TEST_CASE("joint angles and a URDF: a planar arm of two links") {
  const Folder folder;
  const Path urdf = folder.write(
      "arm.urdf", R"(<robot name="arm"><link name="base"/><link name="upper"/><link name="lower"/><link name="tool"/>
    <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0 0.1"/><axis xyz="0 0 1"/></joint>
    <joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0.5 0 0"/><axis xyz="0 0 1"/></joint>
    <joint name="flange" type="fixed"><parent link="lower"/><child link="tool"/><origin xyz="0.25 0 0" rpy="0 0 1.5707963267948966"/></joint></robot>)");
  Options options;
  options.urdf = urdf;
  options.base = {folder.write("q.csv", "time,elbow_deg,shoulder_deg\n0,90,0\n1,-90,90\n"), ""};
  std::vector<std::string> notes;
  const auto samples = read_base_log(options, notes);
  CHECK((samples[0].pose.translation - Vector3(0.5, 0.25, 0.1)).norm() < 1e-12);
  CHECK((samples[0].pose.rotation * Vector3::UnitX() + Vector3::UnitX()).norm() < 1e-12);
  CHECK((samples[1].pose.translation - Vector3(0.25, 0.5, 0.1)).norm() < 1e-12);
  options.base.file = folder.write("n.csv", "time,q_1,q_2\n0,0,1.5707963267948966\n");
  CHECK((read_base_log(options, notes)[0].pose.translation - samples[0].pose.translation).norm() < 1e-12);
  options.flange = "hand";
  CHECK(holds(refusal([&] { read_base_log(options, notes); }), "it has upper, lower, tool"));
}

TEST_CASE("masks: bright or dark, labels, alpha") {
  const Folder folder;
  const auto image = [&](const std::string& name, int channels, int rope, int rest, int alpha) {
    capture::Image8 picture{20, 10, channels, {}};
    for (int i = 0; i < 200; ++i)
      for (int c = 0; c < channels; ++c)
        picture.pixels.push_back(static_cast<std::uint8_t>(c == 3 ? (i < 20 ? 255 : alpha) : i < 20 ? rope : rest));
    capture::write_png(folder.path / name, picture);
    return open_media(folder.path / name);
  };
  const Take take{0, 1};
  MaskRule rule = mask_rule(image("bright.png", 1, 255, 0, 0), take, "", false);
  CHECK_FALSE(rule.inverted);
  rule = mask_rule(image("one.png", 1, 1, 0, 0), take, "", false);
  CHECK(rule.threshold == 1);
  CHECK_FALSE(rule.inverted);
  rule = mask_rule(image("dark.png", 3, 0, 255, 0), take, "", false);
  CHECK(rule.inverted);
  const Media alpha = image("alpha.png", 4, 90, 80, 0);
  rule = mask_rule(alpha, take, "", false);
  CHECK(rule.alpha);
  write_masks(alpha, take, rule, nullptr, folder.path, "cam");
  const capture::Image8 written = capture::read_image8(folder.path / "masks/cam/000000.png");
  CHECK(written.pixels[19] == 255);
  CHECK(written.pixels[20] == 0);
  const Media labels = image("labels.png", 1, 3, 7, 0);
  rule = mask_rule(labels, take, "3", false);
  write_masks(labels, take, rule, nullptr, folder.path, "cam");
  CHECK(capture::read_image8(folder.path / "masks/cam/000000.png").pixels[0] == 255);
  CHECK(capture::read_image8(folder.path / "masks/cam/000000.png").pixels[20] == 0);
  CHECK(holds(refusal([&] { mask_rule(labels, take, "4", false); }), "no mask has the value '4'"));
  CHECK(holds(refusal([&] { mask_rule(labels, take, "", true); }), "no alpha"));
  // images in the order of their numbers
  for (const char* name : {"seq/f10.png", "seq/f9.png", "seq/f100.png"}) {
    std::filesystem::create_directories(folder.path / "seq");
    std::filesystem::copy_file(folder.path / "one.png", folder.path / name);
  }
  const Media sequence = open_media(folder.path / "seq");
  CHECK(sequence.files[0].filename() == "f9.png");
  CHECK(sequence.files[2].filename() == "f100.png");
}

TEST_CASE("a camera's start is found from its masks, unless the motion repeats itself") {
  capture::Camera camera;
  camera.width = 640, camera.height = 480, camera.fx = camera.fy = 600, camera.cx = 320, camera.cy = 240;
  camera.world_from_camera.translation = {0, 0, -1};
  const auto base_of = [](double period) {
    std::vector<trajectory::Sample> samples;
    for (int k = 0; k <= 800; ++k) {
      const double t = 0.01 * k;
      samples.push_back(
          {50.0 + t,
           {math::Matrix3::Identity(),
            {0.1 * std::sin(6.28318 * t / period) + (period > 5 ? 0.03 * std::sin(5 * t) : 0.0), -0.1, 0}}});
    }
    return trajectory::fit(samples, "base");
  };
  const auto seen_under = [&](const trajectory::Trajectory& base, double start) {
    std::vector<SeenRope> seen;
    for (int k = 0; k < 50; ++k) {
      const double t = 0.08 * k;
      const Vector2 grasp =
          capture::project(camera, camera.world_from_camera.inverse() * base.pose(start + t).translation);
      SeenRope rope{t, Eigen::Matrix2Xf(2, 100)};  // straight down from the grasp
      for (int i = 0; i < 100; ++i) rope.pixels.col(i) = (grasp + Vector2(0, i)).cast<float>();
      seen.push_back(rope);
    }
    return seen;
  };
  const trajectory::Trajectory once = base_of(20.0), again = base_of(1.0);
  const auto found = find_start(seen_under(once, 52.345), camera, once);
  REQUIRE(found);
  CHECK(std::abs(found->start - 52.345) < 2e-3);
  CHECK(found->miss < 0.2);
  CHECK_FALSE(find_start(seen_under(again, 52.345), camera, again));
}

TEST_CASE("frames from words") {
  CHECK((read_frame("x,-z,y", "--base-world") * Vector3(1, 2, 3) - Vector3(1, -3, 2)).norm() < 1e-15);
  CHECK((read_frame("1,2,3,0,0,0.70710678,0.70710678", "--tool") * Vector3(1, 0, 0) - Vector3(1, 3, 3)).norm() < 1e-7);
  CHECK(holds(refusal([] { read_frame("x,z,y", "--tool"); }), "not right-handed"));
  CHECK(holds(refusal([] { read_frame("1,2,3,1,0,0,1", "--tool"); }), "length 1"));
  CHECK(holds(refusal([] { read_frame("1,2", "--tool"); }), "is no frame"));
}
