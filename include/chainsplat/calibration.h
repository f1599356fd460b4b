// chainsplat/calibration.h - cameras from videos of a printed board: intrinsics, poses and clocks (mathematics.md 12).
//
// The board is a grid of AprilTags (tag36h11), or a single one. What is found, all at once by damped least squares with
// robust weights: each camera's focal lengths, principal point and five lens coefficients, its pose, and the pose of
// the board at every moment. Where a robot moves the board (`Options::log`), the board's pose on the flange and each
// camera's clock come to it, and the cameras' poses are in the world of the robot's log; the robot's own errors are
// unknowns too, whose size the data tell. Else the poses are relative to the first camera, or to the board where it
// was seen first, and cameras must see the board at the same moments.
//
// Standard deviations follow from the scatter of the corners and of the robot. They know nothing of what all moments
// have in common: a tag that was measured wrongly, a board that bends, a lens beyond the five coefficients.
#pragma once
#include <array>
#include <nlohmann/json_fwd.hpp>
#include <optional>
#include <string>
#include <vector>

#include "chainsplat/capture.h"
#include "chainsplat/importing.h"
#include "chainsplat/solve.h"

namespace chainsplat::calibration {

// --- the board -------------------------------------------------------------------------------------------------------

// Tags are numbered by rows from the upper left one. The board's frame: origin in the middle of the grid, x to the
// right, y up the page, z out of the page toward who reads it; the tags lie in z = 0.
struct Board {
  int columns = 5, rows = 7;
  double tag_size = 0.027;  // m, edge of a tag's black square
  double spacing = 0.009;   // m, white between two tags; at least an eighth of tag_size
  int first_id = 0;

  int tags() const { return columns * rows; }
  bool has(int id) const { return id >= first_id && id < first_id + tags(); }
  // Corner 0 to 3 of a tag: lower left, lower right, upper right, upper left. Board's frame, m.
  math::Vector3 corner(int id, int index) const;
  void check() const;  // throws InputError that names the field
};
// A board as a file (formats.md 4.6). Throws InputError: no such file, an unknown key, a value that is none.
Board read_board(const Path& file);
std::string write_board(const Board& board);
// A page in the board's true size, with a ruler by which the print can be checked.
std::string board_svg(const Board& board);

// --- the request -----------------------------------------------------------------------------------------------------

struct CameraRequest {
  std::string name;
  Path images;                  // a video, a folder of images, or a pattern like frames/%06d.png
  importing::Source stamps;     // a time per line, or a table's column; empty: by rate and start
  std::optional<double> rate;   // frames per second; none: the video's own
  std::optional<double> start;  // s, of frame 0 by the base's clock, or added to the stamps; none: 0
  bool find_start = false;      // anywhere in the log, from the board's turns; else within kClockSearch of it
};

constexpr double kClockSearch = 1.0;  // s, to either side of the given clock

// In which frame the poses are, where no robot tells.
enum class World { camera, board };  // of the first camera; of the board where the first camera sees it first

struct Options {
  std::vector<CameraRequest> cameras;
  Path board;
  importing::Options log;  // the robot's log: base, columns, units, urdf, flange; base empty: there is none
  World world = World::camera;
  bool force = false;  // replace a calibration that was made before

  void check() const;  // throws InputError
};

// --- the result ------------------------------------------------------------------------------------------------------

struct Deviation {                        // one standard deviation; NaN: not determined
  double fx = 0, fy = 0, cx = 0, cy = 0;  // px
  std::array<double, 5> distortion{};
  math::Vector3 position = math::Vector3::Zero(), rotation = math::Vector3::Zero();  // m, rad, about the world's axes
  double clock = 0;                                                                  // s
};

struct CameraResult {
  capture::Camera camera;  // with its pose in the world, where it has one
  bool placed = false;     // it has a pose
  Deviation deviation;
  double clock = 0.0;        // s: base time = frame time + clock; 0 without a robot
  double start = 0.0;        // s: what `start` would be, the clock added to what was given
  int frames = 0, seen = 0;  // frames that were looked at, and those with the board
  int views = 0, corners = 0;
  double rms = 0.0, rms_mm = 0.0, worst = 0.0;  // residuals of a corner in px and, at the board, mm; the largest, px
  double edge_deviation = 0.0;  // px: where a point of the world falls in the image, the worst of nine regions
  double covered = 0.0;         // part of the image's regions (8 x 6) that hold a corner
  double tilt = 0.0;            // rad, largest angle between the line of sight and the board's normal
};

struct Finding {
  bool bad = false;  // the calibration must not be used as it is; else: look at it
  std::string code;  // as in formats.md 5.11
  std::string camera;
  std::string text;  // what is bad, and what to do
};

struct Calibration {
  Board board;
  std::string world;  // in words
  std::vector<CameraResult> cameras;
  bool robot = false;
  math::Pose flange_from_board;
  math::Vector3 board_position_deviation = math::Vector3::Zero(), board_rotation_deviation = math::Vector3::Zero();
  double robot_position = 0.0, robot_rotation = 0.0;  // m, rad: scatter of the robot's poses, each axis
  int moments = 0;
  solve::Summary summary;
  std::vector<Finding> findings;
  std::vector<std::string> notes;  // what was decided, a sentence each
  std::vector<Path> pictures;      // one per camera
  bool trusted() const;            // no finding is bad
};

// Writes `out`: NAME.json of every placed camera (import --calibration), calibration.json, pictures/NAME.png. Throws
// InputError before anything is written, WorkError where it cannot write.
Calibration calibrate(const Path& out, const Options& options);
nlohmann::ordered_json to_json(const Calibration& calibration);

}  // namespace chainsplat::calibration
