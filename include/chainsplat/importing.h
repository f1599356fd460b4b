// chainsplat/importing.h - a capture (formats.md 1) from what a laboratory has: videos or images, calibrations of other
// programs, a robot's log, masks of any kind.
//
// Every source has its own conventions: where a pixel's center is, which way a pose maps, which way a camera's axes
// point, units, clocks. They are told by the source's format and, where the format leaves them open, by the recording:
// the grasp must be in view. What was decided is said in a sentence each (`notes`), and kept in import.json.
#pragma once
#include <optional>
#include <string>
#include <vector>

#include "chainsplat/capture.h"

namespace chainsplat::importing {

// A file and, behind '#', which part of it: a key, a topic, a column's prefix.
struct Source {
  Path file;
  std::string key;
  bool empty() const { return file.empty(); }
};
Source read_source(const std::string& text);  // 'FILE#KEY'; a file whose own name has a '#' is taken as it is

// A pose as 'x,y,z,qx,qy,qz,qw' (m, unit quaternion), or axes as 'x,-z,y': what the new x, y and z are in the old
// frame. Throws InputError that names `where`.
math::Pose read_frame(const std::string& text, const std::string& where);

// Which way a camera's own axes point: x right, y down, z forward; x right, y up, z backward; x forward, y left, z up.
enum class Axes { opencv, opengl, ros };

struct CameraRequest {
  std::string name;
  Path images;         // a video, a folder of images, or a pattern like frames/%06d.png
  Source calibration;  // intrinsics, and the pose where it has one
  Source pose;         // the camera's pose; empty: the calibration's, or by the rig from another camera's
  std::optional<math::Pose> world_from_camera;  // the same given as it is, OpenCV's axes unless `camera_axes` says else
  std::string masks;              // a folder, pattern or video; 'alpha': the images' own alpha channel; empty: none
  Path timestamps;                // a time per line, or a table with a column of times; empty: by rate and start
  std::optional<double> rate;     // frames per second; none: the video's own
  std::optional<double> start;    // s, of frame 0 by the base's clock; none: 0
  bool find_start = false;        // from the masks instead
  std::optional<double> readout;  // s, Camera::readout; none: the calibration's, or not known
};

struct Options {
  std::vector<CameraRequest> cameras;
  Source base;          // TUM, a table with named columns, or, with `urdf`, joint angles
  std::string columns;  // 'time=NAME,x=NAME,...,qw=NAME': which column is what; empty: found by their names
  std::string base_unit, time_unit, angle_unit;  // m, cm, mm; s, ms, us, ns; rad, deg; empty: by name or size
  std::string rotation;                          // of rx, ry, rz: 'rotvec' or 'rpy'; empty: by unit
  Path urdf;                                     // the arm
  std::string flange;                            // link of the URDF whose pose is meant; empty: the last one
  math::Pose tool;                               // flange_from_grasp
  math::Pose base_world;                         // world_from_log: the world of the base's log in the capture's
  math::Pose camera_world;                       // world_from_calibration: the same of the calibrations
  std::string camera_unit;                       // m, cm, mm of the cameras' positions; empty: by size
  std::optional<Axes> camera_axes;               // none: by source
  std::string poses;  // which way the poses in files map: camera-to-world, world-to-camera; empty: by source and view
  double length = 0.0, diameter = 0.0;  // m
  std::optional<double> mass;           // kg
  bool tabletop = false;
  math::Vector3 direction = math::Vector3::Zero();  // of the rope at the grasp, in the frame of the grasp
  std::optional<math::Vector3> bending_axis;        // the same frame; none: chosen from the motion or the table
  std::optional<capture::Table> table;
  math::Vector3 gravity{0, 0, -9.81};  // m/s^2, world
  std::string name;                    // empty: the folder's
  bool force = false;                  // replace a capture that was imported before

  void check() const;  // throws InputError
};

struct Imported {
  std::vector<std::string> notes;  // what was decided, a sentence each
  std::vector<Path> pictures;      // one per camera
  bool masks = false;              // every camera has masks
};

// Writes the capture `out`: capture.json, base.tum, images, masks, times, pictures/NAME.png and import.json. Throws
// InputError before anything is written, except where an image turns out to be damaged; WorkError where it cannot
// write.
Imported import_capture(const Path& out, const Options& options);

// Poses of the flange in the log's world, s by the log's clock, m. Rows that repeat a time are left out. Adds to
// `notes` how the file was read. Throws InputError.
std::vector<trajectory::Sample> read_base_log(const Options& options, std::vector<std::string>& notes);

// The calibration formats that are read, for messages and for --help.
std::string known_calibrations();

}  // namespace chainsplat::importing
