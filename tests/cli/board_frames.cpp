// board_frames BOARD.json OUT: a recording of a board that a robot moves, small: OUT/cam0.mp4 (24 frames, 10 Hz, frame
// 0 at 1 s of the robot's clock), OUT/cam0 (the same as images), OUT/robot.tum, OUT/still.tum (a robot that rests).
#include <filesystem>

#include "board_renderer.h"
#include "chainsplat/trajectory.h"

using namespace chainsplat;

int main(int count, char** arguments) {
  if (count != 3) return 2;
  const calibration::Board board = calibration::read_board(arguments[1]);
  const Path out = arguments[2];
  std::filesystem::create_directories(out / "cam0");
  capture::Camera camera;
  camera.width = 400, camera.height = 300, camera.fx = 380, camera.fy = 381, camera.cx = 203, camera.cy = 148;
  camera.world_from_camera = {math::exp_so3({0.2, 0.1, 0.3}), {0.4, -0.3, 0.2}};
  const auto flange = [&](double t) {
    const math::Matrix3 face = math::Vector3(1, -1, -1).asDiagonal();
    const math::Vector3 turn(0.45 * std::sin(2.1 * t), 0.4 * std::sin(2.9 * t + 1), 0.5 * std::sin(1.7 * t + 2));
    const math::Vector3 place(0.15 * std::sin(2.7 * t), 0.1 * std::sin(3.7 * t + 0.4), 0.75 + 0.1 * std::sin(1.9 * t));
    return camera.world_from_camera * math::Pose{math::exp_so3(turn) * face, place};
  };
  const math::Pose flange_from_board{math::exp_so3({0.1, 0, 0}), {0.01, 0.02, 0.05}};
  const test::BoardRenderer renderer(camera, board);
  core::Random random(4);
  std::vector<capture::Image8> frames;
  for (int i = 0; i < 24; ++i) {
    const math::Pose board_pose = camera.world_from_camera.inverse() * flange(1.0 + 0.1 * i) * flange_from_board;
    const capture::Image8 gray = renderer.image(board_pose, 0.6, 2.0, random);
    char name[32];
    std::snprintf(name, sizeof name, "%06d.png", i);
    capture::write_png(out / "cam0" / name, gray);
    capture::Image8 rgb{gray.width, gray.height, 3, {}};
    for (const std::uint8_t value : gray.pixels) rgb.pixels.insert(rgb.pixels.end(), 3, value);
    frames.push_back(std::move(rgb));
  }
  capture::write_video(out / "cam0.mp4", 10.0, frames);
  std::vector<trajectory::Sample> log, still;
  for (int i = 0; i <= 450; ++i) log.push_back({0.01 * i, flange(0.01 * i)}), still.push_back({0.01 * i, flange(0.0)});
  core::write_file(out / "robot.tum", trajectory::write_tum(log));
  core::write_file(out / "still.tum", trajectory::write_tum(still));
  return 0;
}
