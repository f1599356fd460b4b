// calibrate.cpp - cameras from videos of a printed board, and the board.
#include <algorithm>
#include <cstdio>
#include <iostream>
#include <memory>
#include <nlohmann/json.hpp>
#include <numbers>

#include "camera_options.h"
#include "chainsplat/calibration.h"
#include "chainsplat/json.h"
#include "cli.h"
#include "command_line.h"

namespace chainsplat::tools {

namespace {

using Json = nlohmann::ordered_json;

struct CalibrateRequest {
  std::string out, base, board, svg, tags = "5x7", world = "camera", tag_size = "0.027", spacing = "0.009";
  int first_id = 0;
  std::vector<std::string> cameras, timestamps, rates, starts;
  calibration::Options options;
};

std::string text(const char* format, auto... values) {
  char out[400];
  std::snprintf(out, sizeof out, format, values...);
  return out;
}

void write_board(const Globals& globals, const CalibrateRequest& request) {
  calibration::Board board;
  const std::size_t times = request.tags.find('x');
  const auto count = [&](const std::string& digits) {
    if (digits.empty() || digits.size() > 4 || digits.find_first_not_of("0123456789") != std::string::npos)
      throw InputError("--tags", "'" + request.tags + "' is no grid", "write COLUMNSxROWS, like 5x7");
    return std::stoi(digits);
  };
  board.columns = count(request.tags.substr(0, times));
  board.rows = count(times == std::string::npos ? "" : request.tags.substr(times + 1));
  board.tag_size = quantity(request.tag_size, "--tag-size", kLengths);
  board.spacing = quantity(request.spacing, "--spacing", kLengths);
  board.first_id = request.first_id;
  board.check();
  const Path svg = request.svg, json = Path(request.svg).replace_extension(".json");
  if (svg.extension() != ".svg") throw InputError("--board-svg", "'" + request.svg + "' is no SVG", "name it .svg");
  std::error_code error;
  for (const Path& file : {svg, json})
    if (std::filesystem::exists(file, error) && !request.options.force)
      throw InputError(file.string(), "exists already", "name another file, or replace it with --force");
  core::write_file(svg, calibration::board_svg(board));
  core::write_file(json, calibration::write_board(board));
  if (globals.json) {
    std::cout << core::json_text(Json{{"svg", svg.string()}, {"board", json.string()}}) << "\n";
    return;
  }
  std::cout << "Print " << core::printable(svg.string()) << " at 100 %, glue it on something flat, measure the ruler "
            << "and the black squares,\nand mend tag_size and spacing in " << core::printable(json.string()) << "\n";
}

constexpr double kDegrees = 180.0 / std::numbers::pi;

std::string table(const calibration::Calibration& result) {
  std::string out;
  for (const calibration::CameraResult& c : result.cameras) {
    const calibration::Deviation& d = c.deviation;
    const math::Vector3 p = c.camera.world_from_camera.translation;
    out += text("%s: %d views, %d corners, RMS %.3f px = %.3f mm at the board; at the image's edge +- %.2g px\n",
                c.camera.name.c_str(), c.views, c.corners, c.rms, c.rms_mm, c.edge_deviation);
    out += text("  fx %.3f +- %.2g  fy %.3f +- %.2g  cx %.3f +- %.2g  cy %.3f +- %.2g px\n", c.camera.fx, d.fx,
                c.camera.fy, d.fy, c.camera.cx, d.cx, c.camera.cy, d.cy);
    out += "  distortion";
    for (int k = 0; k < 5; ++k) out += text(" %.4f +- %.2g", c.camera.distortion[k], d.distortion[k]);
    out += "\n";
    if (c.placed)
      out += text("  at %.4f %.4f %.4f m +- %.2g mm, turned +- %.2g degrees\n", p.x(), p.y(), p.z(),
                  1e3 * d.position.maxCoeff(), d.rotation.maxCoeff() * kDegrees);
    if (result.robot)
      out += text("  clock: frames are taken %.2f +- %.2g ms later than given; --start %s=%.4f\n", 1e3 * c.clock,
                  1e3 * d.clock, c.camera.name.c_str(), c.start);
  }
  if (result.robot) {
    const Eigen::Quaterniond q(result.flange_from_board.rotation);
    const math::Vector3 t = result.flange_from_board.translation;
    out += text("board on the flange: %.5f,%.5f,%.5f,%.5f,%.5f,%.5f,%.5f +- %.2g mm, %.2g degrees\n", t.x(), t.y(),
                t.z(), q.x(), q.y(), q.z(), q.w(), 1e3 * result.board_position_deviation.maxCoeff(),
                result.board_rotation_deviation.maxCoeff() * kDegrees);
    out += text("robot and board scatter by %.2g mm and %.2g degrees\n", 1e3 * result.robot_position,
                result.robot_rotation * kDegrees);
  }
  return out;
}

void calibrate(const Globals& globals, CalibrateRequest& request) {
  if (!request.svg.empty()) return write_board(globals, request);
  calibration::Options& options = request.options;
  if (request.out.empty()) throw InputError("OUT", "is missing", "name the folder for the result, or give --board-svg");
  if (request.board.empty())
    throw InputError("--board", "is missing", "name the board's file; --board-svg writes one to print");
  for (const std::string& word : request.cameras) {
    const std::size_t equals = word.find('=');
    if (equals == std::string::npos)
      throw InputError("--camera", "'" + word + "' has no name", "write NAME=VIDEO, for example cam0=left.mp4");
    calibration::CameraRequest camera;
    camera.name = word.substr(0, equals), camera.images = word.substr(equals + 1);
    options.cameras.push_back(std::move(camera));
  }
  give_to_cameras<calibration::CameraRequest>(
      options.cameras, request.timestamps, "--timestamps",
      [](auto& camera, const std::string& value) { camera.stamps = importing::read_source(value); });
  give_to_cameras<calibration::CameraRequest>(
      options.cameras, request.rates, "--rate",
      [](auto& camera, const std::string& value) { camera.rate = numbers(value, "--rate", 1)[0]; });
  give_to_cameras<calibration::CameraRequest>(options.cameras, request.starts, "--start",
                                              [](auto& camera, const std::string& value) {
                                                camera.find_start = value == "auto";
                                                if (!camera.find_start) camera.start = numbers(value, "--start", 1)[0];
                                              });
  options.board = request.board;
  if (!request.base.empty()) options.log.base = importing::read_source(request.base);
  options.world = request.world == "board" ? calibration::World::board : calibration::World::camera;
  const calibration::Calibration result = calibration::calibrate(request.out, options);
  end_progress();
  if (globals.json) {
    Json document = calibration::to_json(result);
    document["pictures"] = Json::array();
    for (const Path& picture : result.pictures) document["pictures"].push_back(picture.string());
    std::cout << core::json_text(document) << "\n";
  } else {
    for (const std::string& note : result.notes) std::cout << core::printable(with_options(note)) << "\n";
    std::cout << table(result);
    for (const Path& picture : result.pictures) std::cout << "look at " << core::printable(picture.string()) << "\n";
    for (const calibration::Finding& finding : result.findings)
      std::cout << (finding.bad ? "bad: " : "doubt: ") << finding.text << "\n";
    std::cout << (!result.trusted() ? "Do not use this calibration.\n"
                  : result.findings.empty()
                      ? "This calibration is good: use it with import --calibration NAME=" +
                            core::printable(request.out) + "/NAME.json\n"
                      : "This calibration can be used; the doubts say what would make it better.\n");
  }
  if (result.trusted()) return;
  std::cout.flush();
  throw WorkError(request.out, "the calibration is not good enough", "record again as the lines 'bad' say; it is kept");
}

}  // namespace

void add_calibrate_command(Command app, const Globals& globals, Job& job) {
  Command command = app.add_command(
      "calibrate", "Intrinsics, poses and clocks of cameras from videos of a printed board; the board itself");
  auto request = std::make_shared<CalibrateRequest>();
  calibration::Options& options = request->options;
  command.add_option("OUT", request->out,
                     "Folder for the result: NAME.json of every camera, calibration.json, pictures");
  const auto several = [&](const char* name, std::vector<std::string>& into, const char* help, const char* type) {
    command.add_option(name, into, help).type_name(type).one_each();
  };
  several("--camera", request->cameras, "What a camera saw of the board: a video, a folder of images, or a pattern",
          "NAME=VIDEO");
  command.add_option("--board", request->board, "The board, as --board-svg writes it").type_name("FILE.json");
  command
      .add_option("--base", request->base,
                  "Log of the robot that moved the board, as of import: TUM, or a table with named columns.\nThe poses "
                  "are then in its world (default: a hand moved it)")
      .type_name("FILE[#NAME]");
  command
      .add_option("--world", request->world,
                  "Without --base, whose frame the poses are in: camera (the first), or board (where it is seen first)")
      .one_of({"camera", "board"});
  several("--timestamps", request->timestamps, "Times of its frames, one per line or a table's column",
          "NAME=FILE[#COLUMN]");
  several("--rate", request->rates, "Its frames per second (default: the video's)", "[NAME=]HZ");
  several("--start", request->starts,
          "Time of its frame 0 by the log's clock (default 0; up to 1 s more or less is found); auto: anywhere in the "
          "log.\nWith --timestamps added to them",
          "[NAME=]S|auto");
  command.add_option("--columns", options.log.columns, "As of import: which column of the log is what")
      .type_name("time=NAME,...");
  command.add_option("--urdf", options.log.urdf, "The arm, where the log has its joint angles").type_name("FILE");
  command.add_option("--flange", options.log.flange, "Link of the URDF (default: the last one)").type_name("LINK");
  command.add_option("--base-unit", options.log.base_unit,
                     "Of the log's positions: m, cm, mm (default: by name or size)");
  command.add_option("--time-unit", options.log.time_unit, "Of all stamps: s, ms, us, ns (default: by name or size)");
  command.add_option("--angle-unit", options.log.angle_unit,
                     "Of the log's angles: rad, deg (default: by name or size)");
  command.add_option("--rotation", options.log.rotation,
                     "What rx, ry, rz are: rotvec, rpy (default: rotvec in rad, rpy in deg)");
  command.add_option("--board-svg", request->svg, "Write a board to print, and FILE.json beside it; nothing else")
      .type_name("FILE.svg");
  command.add_option("--tags", request->tags, "Of the board to print (default 5x7, on A4)").type_name("COLUMNSxROWS");
  command.add_option("--tag-size", request->tag_size, "Edge of a black square, m or with a unit (default 27mm)")
      .type_name("M");
  command.add_option("--spacing", request->spacing, "White between two squares (default 9mm)").type_name("M");
  command.add_option("--first-id", request->first_id, "Number of its first tag (default 0)")
      .in_range(0, 100000)
      .type_name("N");
  command.add_flag("--force", options.force, "Replace a calibration or board that was made before");
  command.callback([&globals, &job, request] { job = [&globals, request] { calibrate(globals, *request); }; });
}

}  // namespace chainsplat::tools
