// import.cpp - a capture from videos, calibrations of other programs and a robot's log.
#include <algorithm>
#include <iostream>
#include <memory>
#include <nlohmann/json.hpp>

#include "camera_options.h"
#include "chainsplat/importing.h"
#include "chainsplat/json.h"
#include "cli.h"
#include "command_line.h"

namespace chainsplat::tools {

namespace {

using Json = nlohmann::ordered_json;

struct ImportRequest {
  std::string out, base, urdf, tool, base_world, camera_world, camera_axes, length, diameter, mass, direction,
      bending_axis, table, gravity, scenario;
  std::vector<std::string> cameras, calibrations, poses_of, masks, timestamps, rates, starts, readouts;
  importing::Options options;
};

// '-z', or three numbers.
math::Vector3 direction(const std::string& text, const std::string& option) {
  const bool minus = text.starts_with('-');
  const std::string axis = text.substr(minus || text.starts_with('+') ? 1 : 0);
  if (axis == "x" || axis == "y" || axis == "z") return (minus ? -1.0 : 1.0) * math::Vector3::Unit(axis[0] - 'x');
  const auto v = numbers(text, option, 3);
  return {v[0], v[1], v[2]};
}

capture::Table table(const std::string& text) {
  const auto v = numbers(text, "--table", 0);
  if (v.size() == 1) return {{0, 0, v[0]}, math::Vector3::UnitZ()};
  if (v.size() != 6)
    throw InputError("--table", "'" + text + "' has " + std::to_string(v.size()) + " numbers",
                     "write the height, or a point and the normal: x,y,z,nx,ny,nz");
  const math::Vector3 normal(v[3], v[4], v[5]);
  if (!(normal.norm() > 1e-9)) throw InputError("--table", "its normal has no length", "write x,y,z,nx,ny,nz");
  return {{v[0], v[1], v[2]}, normal.normalized()};
}

void read_cameras(ImportRequest& request) {
  auto& cameras = request.options.cameras;
  for (const std::string& text : request.cameras) {
    const std::size_t equals = text.find('=');
    if (equals == std::string::npos)
      throw InputError("--camera", "'" + text + "' has no name", "write NAME=VIDEO, for example cam0=left.mp4");
    importing::CameraRequest camera;
    camera.name = text.substr(0, equals);
    camera.images = text.substr(equals + 1);
    cameras.push_back(camera);
  }
  give_to_cameras<importing::CameraRequest>(
      cameras, request.calibrations, "--calibration",
      [](auto& camera, const std::string& text) { camera.calibration = importing::read_source(text); });
  give_to_cameras<importing::CameraRequest>(cameras, request.masks, "--masks",
                                            [](auto& camera, const std::string& text) { camera.masks = text; });
  give_to_cameras<importing::CameraRequest>(cameras, request.timestamps, "--timestamps",
                                            [](auto& camera, const std::string& text) { camera.timestamps = text; });
  give_to_cameras<importing::CameraRequest>(
      cameras, request.rates, "--rate",
      [](auto& camera, const std::string& text) { camera.rate = numbers(text, "--rate", 1)[0]; });
  give_to_cameras<importing::CameraRequest>(cameras, request.starts, "--start",
                                            [](auto& camera, const std::string& text) {
                                              camera.find_start = text == "auto";
                                              if (!camera.find_start) camera.start = numbers(text, "--start", 1)[0];
                                            });
  give_to_cameras<importing::CameraRequest>(
      cameras, request.readouts, "--readout",
      [](auto& camera, const std::string& text) { camera.readout = quantity(text, "--readout", kTimes); });
  give_to_cameras<importing::CameraRequest>(
      cameras, request.poses_of, "--pose", [](auto& camera, const std::string& text) {
        const importing::Source source = importing::read_source(text);
        std::error_code error;
        if (!std::filesystem::exists(source.file, error) && std::count(text.begin(), text.end(), ',') == 6)
          camera.world_from_camera = importing::read_frame(text, "--pose");
        else
          camera.pose = source;
      });
}

void import_capture(const Globals& globals, ImportRequest& request) {
  importing::Options& options = request.options;
  read_cameras(request);
  options.base = importing::read_source(request.base);
  options.urdf = request.urdf;
  if (!request.tool.empty()) options.tool = importing::read_frame(request.tool, "--tool");
  if (!request.base_world.empty()) options.base_world = importing::read_frame(request.base_world, "--base-world");
  if (!request.camera_world.empty())
    options.camera_world = importing::read_frame(request.camera_world, "--camera-world");
  if (request.camera_axes == "opencv") options.camera_axes = importing::Axes::opencv;
  if (request.camera_axes == "opengl") options.camera_axes = importing::Axes::opengl;
  if (request.camera_axes == "ros") options.camera_axes = importing::Axes::ros;
  options.length = quantity(request.length, "--length", kLengths);
  options.diameter = quantity(request.diameter, "--diameter", kLengths);
  if (!request.mass.empty()) options.mass = quantity(request.mass, "--mass", kMasses);
  options.direction = direction(request.direction, "--direction");
  if (!request.bending_axis.empty()) options.bending_axis = direction(request.bending_axis, "--bending-axis");
  if (!request.table.empty()) options.table = table(request.table);
  if (!request.gravity.empty()) {
    const auto v = numbers(request.gravity, "--gravity", 3);
    options.gravity = {v[0], v[1], v[2]};
  }
  options.tabletop = request.scenario == "tabletop";
  const importing::Imported imported = importing::import_capture(request.out, options);
  end_progress();
  std::vector<std::string> notes, pictures;
  for (const std::string& note : imported.notes) notes.push_back(with_options(note));
  for (const Path& picture : imported.pictures) pictures.push_back(picture.string());
  CheckReport report = check_report(request.out, imported.masks);
  if (globals.json) {
    Json document;
    document["capture"] = request.out;
    document["notes"] = notes;
    document["pictures"] = pictures;
    document["check"] = report.document;
    std::cout << core::json_text(document) << "\n";
  } else {
    for (const std::string& note : notes) std::cout << core::printable(note) << "\n";
    std::cout << report.text;
    for (const std::string& picture : pictures) std::cout << "look at " << core::printable(picture) << "\n";
    if (!imported.masks) std::cout << "It has no masks yet: chainsplat mask " << core::printable(request.out) << "\n";
  }
  if (report.problems == 0) return;
  std::cout.flush();
  throw WorkError(request.out, std::to_string(report.problems) + (report.problems == 1 ? " problem" : " problems"),
                  "mend what is listed as a problem; the capture is written");
}

}  // namespace

void add_import_command(Command app, const Globals& globals, Job& job) {
  Command importer =
      app.add_command("import", "Make a capture from videos, calibrations of other programs and a robot's log");
  auto request = std::make_shared<ImportRequest>();
  importing::Options& options = request->options;
  importer.add_option("OUT", request->out, "Capture folder to make").required();
  const auto several = [&](const char* name, std::vector<std::string>& into, const char* help, const char* type) {
    return importer.add_option(name, into, help).type_name(type).one_each();
  };
  several("--camera", request->cameras, "Frames of a camera: a video, a folder of images, or a pattern like f%04d.png",
          "NAME=VIDEO")
      .required();
  several("--calibration", request->calibrations,
          ("Its intrinsics, and its pose where the file has one. Without NAME= of all cameras.\nKnown: " +
           importing::known_calibrations())
              .c_str(),
          "[NAME=]FILE[#KEY]")
      .required();
  several("--pose", request->poses_of, "Its pose, where the calibration has none: a file, or the numbers",
          "NAME=FILE[#KEY]|x,y,z,qx,qy,qz,qw");
  several("--masks", request->masks,
          "Its masks: a folder, video or pattern; alpha: the images' own. Default: none, see mask",
          "NAME=PATH[#VALUE]|alpha");
  several("--timestamps", request->timestamps, "Times of its frames, one per line or a table's column",
          "NAME=FILE[#COLUMN]");
  several("--rate", request->rates, "Its frames per second (default: the video's)", "[NAME=]HZ");
  several("--start", request->starts,
          "Time of its frame 0 by the base's clock (default 0); auto: found from the masks. With --timestamps added to "
          "them",
          "[NAME=]S|auto");
  several(
      "--readout", request->readouts,
      "From reading its first row to reading its last, s or with a unit: 20ms; 0: a global shutter (default: found in "
      "training)",
      "[NAME=]S");
  importer
      .add_option(
          "--base", request->base,
          "Robot's log: TUM, or a table with named columns; with --urdf joint angles. #NAME: which of several poses")
      .required()
      .type_name("FILE[#NAME]");
  importer
      .add_option("--columns", options.columns,
                  "Which column is what, where names do not tell: time, x, y, z, qx to qw, rx to rz, roll, pitch, yaw")
      .type_name("time=NAME,...");
  importer.add_option("--urdf", request->urdf, "The arm, where the log has its joint angles").type_name("FILE");
  importer.add_option("--flange", options.flange, "Link of the URDF (default: the last one)").type_name("LINK");
  importer
      .add_option("--tool", request->tool,
                  "Pose of the grasp in the frame of the log's poses, the flange (default: the same)")
      .type_name("x,y,z,qx,qy,qz,qw");
  importer
      .add_option("--base-world", request->base_world,
                  "Pose of the log's world in the capture's, or the capture's axes in the log's")
      .type_name("x,y,z,qx,qy,qz,qw|x,-z,y");
  importer.add_option("--camera-world", request->camera_world, "The same of the world of the calibrations")
      .type_name("x,y,z,qx,qy,qz,qw|x,-z,y");
  importer.add_option("--length", request->length, "From the grasp to the free end, m or with a unit: 0.3, 30cm")
      .required()
      .type_name("M");
  importer.add_option("--diameter", request->diameter, "Of the rope, m or with a unit").required().type_name("M");
  importer.add_option("--mass", request->mass, "Of this length of rope, kg or with a unit: 0.06, 60g").type_name("KG");
  importer.add_option("--scenario", request->scenario, "free: it hangs or swings; tabletop: it lies on a table")
      .one_of({"free", "tabletop"})
      .required();
  importer.add_option("--direction", request->direction, "Where the rope leaves the gripper, in the frame of the grasp")
      .required()
      .type_name("-z|X,Y,Z");
  importer
      .add_option("--bending-axis", request->bending_axis,
                  "Axis of planar bending, same frame (default: by motion or table)")
      .type_name("y|X,Y,Z");
  importer.add_option("--table", request->table, "Height of its surface, m, or a point and its normal")
      .type_name("H|x,y,z,nx,ny,nz");
  importer.add_option("--gravity", request->gravity, "World, m/s^2 (default 0,0,-9.81)").type_name("X,Y,Z");
  importer.add_option("--name", options.name, "Of the capture (default: the folder's)").type_name("NAME");
  importer
      .add_option("--poses", options.poses,
                  "Which way the cameras' poses map (default: by source, else so that the grasp is in view)")
      .type_name("camera-to-world|world-to-camera");
  importer.add_option("--camera-axes", request->camera_axes, "Axes of the cameras (default: by source)")
      .one_of({"opencv", "opengl", "ros"});
  importer.add_option("--camera-unit", options.camera_unit, "Of the cameras' positions: m, cm, mm (default: by size)");
  importer.add_option("--base-unit", options.base_unit, "Of the log's positions: m, cm, mm (default: by name or size)");
  importer.add_option("--time-unit", options.time_unit, "Of all stamps: s, ms, us, ns (default: by name or size)");
  importer.add_option("--angle-unit", options.angle_unit, "Of the log's angles: rad, deg (default: by name or size)");
  importer.add_option("--rotation", options.rotation,
                      "What rx, ry, rz are: rotvec, rpy (default: rotvec in rad, rpy in deg)");
  importer.add_flag("--force", options.force, "Replace a capture that was imported before");
  importer.callback([&globals, &job, request] { job = [&globals, request] { import_capture(globals, *request); }; });
}

}  // namespace chainsplat::tools
