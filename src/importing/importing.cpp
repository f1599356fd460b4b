// From sources to a capture: everything is read and decided first, and then written.
#include "chainsplat/importing.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <limits>
#include <numbers>

#include "base_log.h"
#include "calibration.h"
#include "chainsplat/json.h"
#include "chainsplat/text.h"
#include "clock.h"
#include "document.h"
#include "media.h"
#include "picture.h"
#include "src/math/decompositions.h"
#include "table.h"

namespace chainsplat::importing {

namespace fs = std::filesystem;
using math::Matrix3;
using math::Pose;
using math::Vector3;

namespace {

constexpr double kNewOrigin = 1e3;   // s; beyond, stamps are counted from the base's first second
constexpr double kFarCamera = 30.0;  // m from its world's origin; farther ones are in millimeters
constexpr double kInView = 0.5;      // share of the base's poses that a camera must see to be believed
constexpr double kMargin = 0.1;      // of the image around it that still counts as view
constexpr int kViewSamples = 50;
constexpr double kBesideFrames = 1.0;    // s of the base's motion before and after the frames that are kept
constexpr double kHour = 3600.0;         // s
constexpr double kPerpendicular = 1e-3;  // rad
constexpr double kOffVertical = 60.0;    // degrees from straight down, where a hanging rope is doubted
constexpr const char* kImportFile = "import.json";

std::string text(const char* format, auto... values) {
  char line[512];
  std::snprintf(line, sizeof line, format, values...);
  return line;
}

// A camera on its way into the capture.
struct Camera {
  const CameraRequest* request = nullptr;
  Media images;
  std::optional<Media> masks;
  MaskRule rule;
  Calibration calibration;
  std::optional<Undistortion> undistortion;
  capture::Camera camera;         // as it will stand in the capture
  std::vector<double> times;      // s, of all frames of the source, by the base's clock
  bool stamped = false;           // by a file of times
  double rate = 0.0;              // frames per second, where not stamped
  std::optional<double> readout;  // s, where it is known
  Take take;
};

// --- clocks ----------------------------------------------------------------------------------------------------------

// The start by the masks, where none was recorded.
void find_clock(Camera& camera, const trajectory::Trajectory& base, double origin, std::vector<std::string>& notes) {
  const std::string& name = camera.request->name;
  if (!camera.masks)
    throw InputError("`start`", "'auto' finds the start of " + name + " from its masks, and it has none",
                     "give `masks`, or the time of frame 0");
  const Undistortion* lens = camera.undistortion ? &*camera.undistortion : nullptr;
  const auto found =
      find_start(seen_ropes(*camera.masks, camera.rule, camera.rate, camera.camera, lens), camera.camera, base);
  if (!found)
    throw InputError("`start`", "several starts of " + name + " fit its masks and the base's motion about as well",
                     "give the time of its frame 0, or record a motion that does not repeat itself");
  // masks tell when the middle row is read, and stamps are of the first one
  const double start = found->start - 0.5 * std::abs(camera.readout.value_or(0.0));
  for (int k = 0; k < camera.images.frames; ++k) camera.times.push_back(start + k / camera.rate);
  notes.push_back(
      name +
      text(": %.6g frames per second, frame 0 at %.3f s, found from the masks, which the grasp then misses by %.1f px",
           camera.rate, start + origin, found->miss));
}

void set_times(Camera& camera, const Options& options, const std::vector<trajectory::Sample>& base, double origin,
               std::vector<std::string>& notes) {
  const CameraRequest& request = *camera.request;
  const int frames = camera.images.frames;
  if (!request.timestamps.empty()) {
    std::string note;
    const Source source = read_source(request.timestamps.string());
    camera.times = read_stamps(source.file, source.key, options.time_unit, note);
    const int count = static_cast<int>(camera.times.size());
    if (count < frames)
      throw InputError(request.timestamps.string(),
                       "has " + std::to_string(count) + " times for " + std::to_string(frames) + " frames",
                       "write one per frame");
    if (count > frames) {
      core::warn(request.timestamps.string() + ": has " + std::to_string(count) + " times for " +
                 std::to_string(frames) +
                 " frames; the first frame is taken to have the first one, and the last ones are left out");
      camera.times.resize(frames);
    }
    for (int k = 1; k < frames; ++k)
      if (!(camera.times[k] > camera.times[k - 1]))
        throw InputError(request.timestamps.string(),
                         "time " + std::to_string(k + 1) + " does not come after the one before",
                         "write one time per frame, increasing");
    for (double& time : camera.times) time += request.start.value_or(0.0) - origin;
    camera.stamped = true;
    notes.push_back(request.name + ": " + note + (request.start ? text(", plus %g s", *request.start) : ""));
    return;
  }
  camera.rate = request.rate.value_or(camera.images.rate);
  if (!(camera.rate > 0.0))
    throw InputError("`rate`", request.name + " has no times: images have no frame rate",
                     "give `rate` or `timestamps`");
  if (request.find_start) {
    find_clock(camera, trajectory::fit(base, options.base.file.string()), origin, notes);
    return;
  }
  const double base_start = base.front().time + origin;
  if (!request.start && base_start > kNewOrigin)
    throw InputError(
        "`timestamps`", request.name + text(" has no clock, and the base's begins at %.3f s", base_start),
        "give `timestamps` " + request.name + "=FILE, or its first frame's time with `start` " + request.name + "=S");
  const double start = request.start.value_or(0.0) - origin;
  for (int k = 0; k < frames; ++k) camera.times.push_back(start + k / camera.rate);
  notes.push_back(request.name + ": " + text("%.6g frames per second", camera.rate) +
                  (request.rate ? "" : " by the video's header") +
                  (request.start ? text(", frame 0 at %.3f s", *request.start)
                                 : ", frame 0 at the base's time 0, which is assumed (`start`, `timestamps`)"));
}

void check_readout(const Camera& camera) {
  if (!camera.readout || camera.times.size() < 2) return;
  constexpr double kRounding = 1.0 + 1e-3;  // one that fills the interval may be given in few digits
  const double interval = (camera.times.back() - camera.times.front()) / static_cast<double>(camera.times.size() - 1);
  if (std::abs(*camera.readout) > kRounding * interval)
    throw InputError(
        "`readout`",
        camera.request->name + text(": %.4g s are more than the %.4g s from frame to frame", *camera.readout, interval),
        "give the time from reading the first row to reading the last, in s or with a unit");
}

// The frames that the base covers, which lasts from `from` to `to`, s; `origin`: of the clock, for what is said.
void cut(Camera& camera, double from, double to, double origin, std::vector<std::string>& notes) {
  const std::vector<double>& times = camera.times;
  const double slack = 0.5 * (times.back() - times.front()) / std::max<std::size_t>(times.size() - 1, 1);
  camera.take = {0, static_cast<int>(times.size())};
  while (camera.take.first < camera.take.last && times[camera.take.first] < from - slack) ++camera.take.first;
  while (camera.take.last > camera.take.first && times[camera.take.last - 1] > to + slack) --camera.take.last;
  const int left_out = static_cast<int>(times.size()) - (camera.take.last - camera.take.first);
  if (camera.take.last == camera.take.first) {
    const double gap = times.front() - from;
    const double hours = std::round(gap / kHour);
    std::string hint = "record both by one clock, or give `start` " + camera.request->name + "=S, or `time_unit`";
    if (hours != 0.0 && std::abs(gap - hours * kHour) < std::max(60.0, to - from))
      hint = text("they differ by %.0f h: another time zone? give `start` %s=%.0f", hours, camera.request->name.c_str(),
                  -hours * kHour);
    throw InputError(camera.request->name,
                     "its frames are at " + text("%.3f to %.3f", times.front() + origin, times.back() + origin) +
                         " s and the base at " + text("%.3f to %.3f", from + origin, to + origin) +
                         " s, which never overlap",
                     hint);
  }
  if (left_out > 0)
    notes.push_back(camera.request->name + ": " + std::to_string(left_out) + " of " + std::to_string(times.size()) +
                    " frames are outside of the base's motion and are left out");
}

// A log that goes on for an hour says nothing more of a recording of seconds, and what the arm did then may be no
// smooth motion.
void leave_out_far_poses(std::vector<trajectory::Sample>& base, const std::vector<Camera>& cameras,
                         std::vector<std::string>& notes) {
  double from = std::numeric_limits<double>::infinity(), to = -from;
  for (const Camera& camera : cameras) {
    from = std::min(from, camera.times[camera.take.first] - kBesideFrames);
    to = std::max(to, camera.times[camera.take.last - 1] + kBesideFrames);
  }
  const std::size_t before = base.size();
  const auto is_before = [](const trajectory::Sample& sample, double time) { return sample.time < time; };
  auto first = std::lower_bound(base.begin(), base.end(), from, is_before);
  auto last = std::lower_bound(base.begin(), base.end(), to, is_before);
  if (first != base.begin()) --first;  // of a slow log the frames lie between two poses
  if (last != base.end()) ++last;
  base = std::vector<trajectory::Sample>(first, last);
  if (base.size() < before)
    notes.push_back("base: " + std::to_string(before - base.size()) + " of " + std::to_string(before) +
                    " poses are more than " + core::brief(kBesideFrames) + " s from all frames and are left out");
}

// --- cameras ---------------------------------------------------------------------------------------------------------

// How long its rows take, by the request or by the calibration.
void read_readout(Camera& camera, std::vector<std::string>& notes) {
  const CameraRequest& request = *camera.request;
  const std::optional<double> readout = request.readout ? request.readout : camera.calibration.readout;
  if (!readout) return;
  const std::string where = request.readout ? "`readout`" : request.calibration.file.string();
  if (!(std::abs(*readout) <= capture::kLongestReadout))
    throw InputError(where, text("%g s is more than any camera takes from its first row to its last", *readout),
                     text("give seconds within %g", capture::kLongestReadout));
  if (camera.undistortion && *readout != 0.0)
    throw InputError(where, request.name + "'s frames are undistorted, and their rows are then no camera's rows",
                     "give the frames of a lens that is no fisheye, or a readout of 0, which stays unmended");
  camera.readout = readout;
  notes.push_back(request.name + (*readout == 0.0 ? ": all rows are read at once"
                                                  : text(": its rows are read in %.4g ms", 1e3 * *readout)));
}

void read_optics(Camera& camera, std::vector<std::string>& notes) {
  const CameraRequest& request = *camera.request;
  Calibration& calibration = camera.calibration;
  calibration = read_calibration(request.calibration, request.name);
  const Media& images = camera.images;
  if (calibration.width > 0 && (calibration.width != images.width || calibration.height != images.height))
    throw InputError(request.calibration.file.string(),
                     text("is a calibration of %dx%d pixels, and the images of %s have %dx%d", calibration.width,
                          calibration.height, request.name.c_str(), images.width, images.height),
                     "calibrate at the size that was recorded, or give the images of that calibration");
  const Lens& lens = calibration.lens;
  if (!(lens.fx >= 1.0 && lens.fy >= 1.0 && lens.fx < 1e6 && lens.fy < 1e6))
    throw InputError(request.calibration.file.string(),
                     text("its focal lengths %g and %g are no pixels", lens.fx, lens.fy), "give fx and fy in pixels");
  std::string note = request.name + ": intrinsics from " + calibration.format + ", " +
                     (calibration.half_pixel_added ? "half a pixel added to cx and cy" : "cx and cy as they are");
  if (calibration.width == 0)
    note += text("; the file names no size, so that of the images is taken (%dx%d)", images.width, images.height);
  if (const auto fitted = as_capture_lens(lens, images.width, images.height)) {
    camera.camera = fitted->camera;
    if (fitted->error > 0.0) note += text("; its lens model is k1, k2, p1, p2, k3 within %.3f px", fitted->error);
  } else {
    camera.undistortion = undistortion(lens, images.width, images.height);
    camera.camera = camera.undistortion->camera;
    note += text("; a fisheye lens, so the frames are undistorted to %dx%d", camera.camera.width, camera.camera.height);
  }
  camera.camera.name = request.name;
  notes.push_back(note);
  read_readout(camera, notes);
}

void read_masks(Camera& camera, std::vector<std::string>& notes) {
  const CameraRequest& request = *camera.request;
  if (request.masks.empty()) return;
  const bool alpha = request.masks == "alpha";
  const Source source = alpha ? Source{} : read_source(request.masks);
  camera.masks = alpha ? camera.images : open_media(source.file);
  const Media& masks = *camera.masks;
  if (masks.width != camera.images.width || masks.height != camera.images.height)
    throw InputError(masks.source.string(),
                     text("masks of %dx%d pixels, and the images of %s have %dx%d", masks.width, masks.height,
                          request.name.c_str(), camera.images.width, camera.images.height),
                     "make masks of the images' size");
  if (masks.frames != camera.images.frames)
    throw InputError(masks.source.string(),
                     std::to_string(masks.frames) + " masks for " + std::to_string(camera.images.frames) + " frames",
                     "give one per frame");
  camera.rule = mask_rule(masks, {0, masks.frames}, source.key, alpha);
  notes.push_back(request.name + ": masks: " + camera.rule.note);
}

Matrix3 own_from_opencv(Axes axes) {
  Matrix3 m = Matrix3::Identity();
  if (axes == Axes::opengl) m.diagonal() << 1, -1, -1;
  if (axes == Axes::ros) m << 0, 0, 1, -1, 0, 0, 0, -1, 0;
  return m;
}

// Share of the base's poses during the camera's frames whose grasp lies before it and in its image.
double in_view(const capture::Camera& optics, const Pose& world_from_camera,
               const std::vector<trajectory::Sample>& base) {
  const Pose camera_from_world = world_from_camera.inverse();
  int seen = 0, tried = 0;
  const std::size_t step = std::max<std::size_t>(1, base.size() / kViewSamples);
  for (std::size_t k = 0; k < base.size(); k += step, ++tried) {
    const Vector3 p = camera_from_world * base[k].pose.translation;
    if (p.z() <= 0.0) continue;
    const math::Vector2 at = capture::project(optics, p);
    const double x = kMargin * optics.width, y = kMargin * optics.height;
    seen += at.x() > -x && at.x() < optics.width + x && at.y() > -y && at.y() < optics.height + y;
  }
  return tried ? double(seen) / tried : 0.0;
}

struct Way {
  Pose world_from_camera;
  std::string name;
};

Way way_of(const FoundPose& found, bool inverse, Axes axes, double scale, const Options& options) {
  Pose pose = found.matrix;
  pose.translation *= scale;
  if (inverse) pose = pose.inverse();
  pose.rotation = pose.rotation * own_from_opencv(axes);
  const char* kAxes[] = {"", ", OpenGL axes", ", ROS axes"};
  return {options.camera_world * pose,
          std::string(inverse ? "takes the world to the camera" : "takes the camera to the world") +
              kAxes[static_cast<int>(axes)]};
}

// The pose of a camera from what was found in its file, by what the file says and, where it is silent, by the view.
Pose decide(const FoundPose& found, const Camera& camera, const std::vector<trajectory::Sample>& base,
            const Options& options, std::vector<std::string>& notes) {
  const std::string& name = camera.request->name;
  std::string unit = options.camera_unit;
  if (unit.empty()) unit = found.matrix.translation.norm() > kFarCamera ? "mm" : "m";
  const double scale = unit_scale(unit);
  const Axes axes = options.camera_axes.value_or(found.axes);
  const bool asked = !options.poses.empty();
  const bool certain = asked || found.direction != Direction::open;
  const bool inverse = asked ? options.poses == "world-to-camera" : found.direction != Direction::world_from_camera;
  const Way first = way_of(found, inverse, axes, scale, options),
            second = way_of(found, !inverse, axes, scale, options);
  const double sees = in_view(camera.camera, first.world_from_camera, base),
               other = in_view(camera.camera, second.world_from_camera, base);
  const std::string suffix = unit == "m" ? "" : ", positions in " + unit;
  if (certain) {
    notes.push_back(name + ": pose from " + found.where + " " + first.name + suffix + (asked ? ", as asked" : ""));
    if (sees < kInView)
      core::warn(name + ": with this pose the grasp is in view in " + text("%.0f", 100.0 * sees) +
                 " % of the base's poses only" +
                 (other >= kInView ? "; the other way around it would be: `poses`" : ""));
    return first.world_from_camera;
  }
  if ((sees >= kInView) != (other >= kInView)) {
    const Way& chosen = sees >= kInView ? first : second;
    notes.push_back(name + ": pose from " + found.where + " " + chosen.name + suffix +
                    ", since only so the camera sees the grasp");
    return chosen.world_from_camera;
  }
  if (sees >= kInView)
    throw InputError(found.where, "does not say which way its pose maps, and the grasp is in view either way",
                     "give `poses` camera-to-world or world-to-camera");
  throw InputError(found.where, "the grasp is out of " + name + "'s view, whichever way its pose maps",
                   "check `base_world`, `camera_world` and the units, or give `poses` and `camera_axes`");
}

void set_poses(std::vector<Camera>& cameras, const std::vector<trajectory::Sample>& base, const Options& options,
               std::vector<std::string>& notes) {
  std::map<std::string, Pose> world_from_rig;
  std::vector<bool> placed(cameras.size());
  for (std::size_t c = 0; c < cameras.size(); ++c) {
    Camera& camera = cameras[c];
    const CameraRequest& request = *camera.request;
    std::optional<FoundPose> found = camera.calibration.pose;
    if (request.world_from_camera)
      found = FoundPose{*request.world_from_camera, Direction::world_from_camera, Axes::opencv, "`pose`"};
    else if (!request.pose.empty())
      found = read_pose(request.pose, request.name);
    if (!found) continue;
    camera.camera.world_from_camera = decide(*found, camera, base, options, notes);
    placed[c] = true;
    if (camera.calibration.rig_from_camera)
      world_from_rig.emplace(camera.calibration.rig,
                             camera.camera.world_from_camera * camera.calibration.rig_from_camera->inverse());
  }
  for (std::size_t c = 0; c < cameras.size(); ++c) {
    if (placed[c]) continue;
    Camera& camera = cameras[c];
    const std::string& name = camera.request->name;
    if (!camera.calibration.rig_from_camera)
      throw InputError(camera.request->calibration.file.string(), "has no pose of " + name + " in the robot's world",
                       "give it with `pose` " + name + "=FILE or `pose` " + name + "=x,y,z,qx,qy,qz,qw");
    const auto rig = world_from_rig.find(camera.calibration.rig);
    if (rig == world_from_rig.end())
      throw InputError(camera.request->calibration.file.string(),
                       "says where its cameras are to each other, and not in the robot's world",
                       "give the pose of one of them, for example `pose` " + name + "=FILE");
    camera.camera.world_from_camera = rig->second * *camera.calibration.rig_from_camera;
    notes.push_back(name + ": pose by the chain of " + camera.request->calibration.file.string() +
                    ", whose T_a_b takes b's coordinates to a");
    if (const double sees = in_view(camera.camera, camera.camera.world_from_camera, base); sees < kInView)
      core::warn(name + ": with this pose the grasp is in view in " + text("%.0f", 100.0 * sees) +
                 " % of the base's poses only");
  }
}

// --- the rope --------------------------------------------------------------------------------------------------------

// Across the rope: on a table its normal, in free space across the motion and the rope.
Vector3 choose_bending_axis(const Options& options, const std::vector<trajectory::Sample>& base,
                            std::vector<std::string>& notes) {
  const Vector3& along = options.direction;
  const Matrix3 base_from_world = base.front().pose.rotation.transpose();
  Vector3 axis = Vector3::Zero();
  std::string reason;
  if (options.tabletop) {
    axis = base_from_world * options.table->normal;
    reason = "the table's normal";
  } else {
    Vector3 mean = Vector3::Zero();
    for (const trajectory::Sample& sample : base) mean += sample.pose.translation / double(base.size());
    Matrix3 spread = Matrix3::Zero();
    for (const trajectory::Sample& sample : base)
      spread += (sample.pose.translation - mean) * (sample.pose.translation - mean).transpose();
    const Eigen::SelfAdjointEigenSolver<Matrix3> solver(spread);
    if (solver.eigenvalues()[2] > 1e-8) axis = along.cross(base_from_world * solver.eigenvectors().col(2));
    reason = "across the rope and the main motion of the base";
  }
  axis -= axis.dot(along) * along;
  if (axis.norm() < 1e-3) axis = along.unitOrthogonal(), reason = "any axis across the rope";
  axis.normalize();
  Eigen::Index largest = 0;
  axis.cwiseAbs().maxCoeff(&largest);
  if (axis[largest] < 0.0) axis = -axis;
  for (double& number : axis)
    if (std::abs(number) < 1e-12) number = 0.0;  // and no -0
  notes.push_back("grasp: bending axis " + text("%.3f, %.3f, %.3f", axis.x(), axis.y(), axis.z()) + ": " + reason);
  return axis;
}

// Given or chosen; and whether a hanging rope hangs.
Vector3 bending_axis(const Options& options, const std::vector<trajectory::Sample>& base,
                     std::vector<std::string>& notes) {
  const Vector3 axis = options.bending_axis ? *options.bending_axis : choose_bending_axis(options, base, notes);
  if (!(axis.norm() > 1e-9) || std::abs(axis.normalized().dot(options.direction)) > kPerpendicular)
    throw InputError("`bending_axis`", "is not perpendicular to the direction", "choose an axis across the rope");
  const double down = (base.front().pose.rotation * options.direction).dot(options.gravity.normalized());
  const double off = std::acos(std::clamp(down, -1.0, 1.0)) * 180.0 / std::numbers::pi;
  if (!options.tabletop && off > kOffVertical)
    core::warn(
        text("grasp: the rope leaves the gripper %.0f degrees from straight down at the first pose; is `direction` "
             "given in the frame of the grasp?",
             off));
  return axis.normalized();
}

// --- writing ---------------------------------------------------------------------------------------------------------

Json list_of_numbers(const auto& values) {
  Json out = Json::array();
  for (Eigen::Index i = 0; i < values.size(); ++i) out.push_back(values[i]);
  return out;
}

Json camera_json(const Camera& camera, const std::string& images, const std::string& masks) {
  const capture::Camera& c = camera.camera;
  Json out;
  out["name"] = c.name;
  out["width"] = c.width, out["height"] = c.height;
  out["fx"] = c.fx, out["fy"] = c.fy, out["cx"] = c.cx, out["cy"] = c.cy;
  out["distortion"] = c.distortion;
  Eigen::Matrix<double, 4, 4, Eigen::RowMajor> pose = Eigen::Matrix4d::Identity();
  pose.topLeftCorner<3, 3>() = c.world_from_camera.rotation;
  pose.topRightCorner<3, 1>() = c.world_from_camera.translation;
  out["world_from_camera"] = list_of_numbers(Eigen::Map<const Eigen::VectorXd>(pose.data(), 16));
  if (camera.readout) out["readout"] = *camera.readout;
  out["images"] = images;
  if (!masks.empty()) out["masks"] = masks;
  if (camera.stamped) {
    out["timestamps"] = c.name + ".txt";
  } else {
    out["rate"] = camera.rate;
    out["start"] = camera.times[camera.take.first];
  }
  return out;
}

Json capture_json(const Options& options, const std::string& name, const Vector3& axis) {
  Json out;
  out["format"] = "chainsplat-capture/1";
  out["name"] = name;
  out["scenario"] = options.tabletop ? "tabletop" : "free";
  out["gravity"] = list_of_numbers(options.gravity);
  out["object"]["length"] = options.length;
  out["object"]["diameter"] = options.diameter;
  if (options.mass) out["object"]["mass"] = *options.mass;
  out["grasp"]["direction"] = list_of_numbers(options.direction);
  out["grasp"]["bending_axis"] = list_of_numbers(axis);
  if (options.table) {
    out["table"]["point"] = list_of_numbers(options.table->point);
    out["table"]["normal"] = list_of_numbers(options.table->normal);
  }
  out["base"] = "base.tum";
  return out;
}

Json source_json(const Source& source) { return source.file.string() + (source.key.empty() ? "" : "#" + source.key); }

Json provenance(const Options& options, double origin, const std::vector<std::string>& notes) {
  Json out;
  out["format"] = "chainsplat-import/1";
  out["version"] = CHAINSPLAT_VERSION;
  out["clock_origin"] = origin;
  out["base"] = source_json(options.base);
  for (const CameraRequest& camera : options.cameras) {
    Json& entry = out["cameras"][camera.name];
    entry["images"] = camera.images.string();
    entry["calibration"] = source_json(camera.calibration);
    if (!camera.pose.empty()) entry["pose"] = source_json(camera.pose);
    if (!camera.masks.empty()) entry["masks"] = camera.masks;
    if (!camera.timestamps.empty()) entry["timestamps"] = camera.timestamps.string();
  }
  out["notes"] = notes;
  return out;
}

bool is_filled(const Path& folder) {
  std::error_code error;
  return fs::is_directory(folder, error) && !fs::is_empty(folder, error);
}

void check_room(const Path& out, const Options& options) {
  std::error_code error;
  if (fs::exists(out, error) && !fs::is_directory(out, error))
    throw InputError(out.string(), "is a file, not a folder", "name another folder");
  if (!is_filled(out)) return;
  if (!options.force)
    throw InputError(out.string(), "is there already and not empty",
                     "name another folder, or give `force` to import anew");
  if (!fs::is_regular_file(out / kImportFile, error))
    throw InputError(out.string(), "is there already and was not made by import", "name another folder");
}

// What an import before has left; frames of a longer recording would count as this one's.
void make_room(const Path& out, const Options& options) {
  if (!is_filled(out)) return;
  std::error_code error;
  fs::remove(out / "capture.json", error);
  for (const CameraRequest& camera : options.cameras)
    for (const Path& old : {out / camera.name, out / "masks" / camera.name}) fs::remove_all(old, error);
}

Path write_picture(const Path& out, const Camera& camera, const trajectory::Trajectory& base, const Options& options) {
  std::optional<capture::Image8> first;
  for_each_frame(camera.images, {camera.take.first, camera.take.first + 1},
                 [&](int, const capture::Image8& image) { first = image; });
  const Scene scene{base.pose(camera.times[camera.take.first]), options.direction, options.length, options.diameter,
                    options.table};
  core::make_folder(out / "pictures");
  const Path file = out / "pictures" / (camera.camera.name + ".png");
  capture::write_png(
      file, picture(camera.undistortion ? undistort(*camera.undistortion, *first) : *first, camera.camera, scene));
  return file;
}

// capture.json comes last: without it the folder is no capture.
void write_capture(const Path& out, const Options& options, const std::vector<Camera>& cameras,
                   const std::vector<trajectory::Sample>& base, const trajectory::Trajectory& motion,
                   Imported& imported) {
  make_room(out, options);
  core::make_folder(out);
  core::write_file(out / "base.tum", trajectory::write_tum(base));
  const std::string folder = fs::absolute(out).lexically_normal().filename().string();
  const std::string name = !options.name.empty() ? options.name : !folder.empty() ? folder : "capture";
  Json document = capture_json(options, name, *options.bending_axis);
  for (const Camera& camera : cameras) {
    const Undistortion* lens = camera.undistortion ? &*camera.undistortion : nullptr;
    const std::string images = write_frames(camera.images, camera.take, lens, out, camera.camera.name);
    const std::string masks =
        camera.masks ? write_masks(*camera.masks, camera.take, camera.rule, lens, out, camera.camera.name) : "";
    if (camera.stamped) {
      std::string lines;
      for (int k = camera.take.first; k < camera.take.last; ++k) lines += core::exact(camera.times[k]) + "\n";
      core::write_file(out / (camera.camera.name + ".txt"), lines);
    }
    document["cameras"].push_back(camera_json(camera, images, masks));
    imported.pictures.push_back(write_picture(out, camera, motion, options));
  }
  core::write_file(out / "capture.json", core::json_text(document) + "\n");
}

}  // namespace

Source read_source(const std::string& given) {
  std::error_code error;
  const std::size_t hash = given.rfind('#');
  if (hash == std::string::npos || fs::exists(given, error)) return {given, ""};
  return {given.substr(0, hash), given.substr(hash + 1)};
}

Pose read_frame(const std::string& given, const std::string& where) {
  std::vector<std::string> parts;
  for (std::size_t begin = 0; begin <= given.size();) {
    const std::size_t end = std::min(given.find(',', begin), given.size());
    parts.push_back(given.substr(begin, end - begin));
    begin = end + 1;
  }
  const std::string expected = "write x,y,z,qx,qy,qz,qw in meters, or axes like x,-z,y";
  if (parts.size() == 3) {
    Pose pose;
    pose.rotation.setZero();
    for (int row = 0; row < 3; ++row) {
      std::string axis = lower(parts[row]);
      const double sign = axis.starts_with('-') ? -1.0 : 1.0;
      if (axis.starts_with('-') || axis.starts_with('+')) axis.erase(0, 1);
      if (axis != "x" && axis != "y" && axis != "z") throw InputError(where, "'" + given + "' is no frame", expected);
      pose.rotation(row, axis[0] - 'x') = sign;
    }
    if (std::abs(pose.rotation.determinant() - 1.0) > 1e-9)
      throw InputError(where, "the axes '" + given + "' are not right-handed",
                       "name each of x, y and z once, with signs that turn");
    return pose;
  }
  std::vector<double> v;
  for (const std::string& part : parts)
    if (const auto value = number_of(part)) v.push_back(*value);
  if (parts.size() != 7 || v.size() != 7) throw InputError(where, "'" + given + "' is no frame", expected);
  const auto pose = rigid(Vector3(v[0], v[1], v[2]), Eigen::Quaterniond(v[6], v[3], v[4], v[5]));
  if (!pose) throw InputError(where, "its quaternion has not the length 1", expected);
  return *pose;
}

void Options::check() const {
  if (cameras.empty()) throw InputError("`camera`", "no camera is given", "give `camera` NAME=VIDEO");
  std::vector<std::string> names;
  for (const CameraRequest& camera : cameras) {
    if (std::find(names.begin(), names.end(), camera.name) != names.end())
      throw InputError("`camera`", "'" + camera.name + "' is named twice", "give every camera its own name");
    names.push_back(camera.name);
    const bool good = !camera.name.empty() && camera.name.size() <= 64 && camera.name[0] != '.' &&
                      std::all_of(camera.name.begin(), camera.name.end(),
                                  [](unsigned char c) { return std::isalnum(c) || c == '_' || c == '-' || c == '.'; });
    if (!good || camera.name == "masks" || camera.name == "pictures")
      throw InputError("`camera`", "'" + camera.name + "' cannot name a folder of frames",
                       "use letters, digits, - and _");
    if (camera.calibration.empty())
      throw InputError("`calibration`", camera.name + " has none",
                       "give `calibration` " + camera.name + "=FILE; known are " + known_calibrations());
    if (camera.rate && !(*camera.rate >= capture::kSlowestRate && *camera.rate <= capture::kFastestRate))
      throw InputError("`rate`", core::exact(*camera.rate) + " is no frame rate", "write frames per second");
  }
  if (base.empty()) throw InputError("`base`", "no log of the robot is given", "give `base` FILE");
  const auto one_of = [](const std::string& value, std::initializer_list<const char*> known, const char* field) {
    if (value.empty() || std::any_of(known.begin(), known.end(), [&](const char* k) { return value == k; })) return;
    std::string list;
    for (const char* k : known) list += (list.empty() ? "" : ", ") + std::string(k);
    throw InputError(field, "'" + value + "' is not known", "use one of " + list);
  };
  one_of(base_unit, {"m", "cm", "mm"}, "`base_unit`");
  one_of(camera_unit, {"m", "cm", "mm"}, "`camera_unit`");
  one_of(time_unit, {"s", "ms", "us", "ns"}, "`time_unit`");
  one_of(angle_unit, {"rad", "deg"}, "`angle_unit`");
  one_of(rotation, {"rotvec", "rpy"}, "`rotation`");
  one_of(poses, {"camera-to-world", "world-to-camera"}, "`poses`");
  if (!(length > 0.0)) throw InputError("`length`", "is not above 0", "give meters from the grasp to the free end");
  if (!(diameter > 0.0) || diameter >= length)
    throw InputError("`diameter`", "is not between 0 and the length", "give meters");
  if (mass && !(*mass > 0.0)) throw InputError("`mass`", "is not above 0", "give kilograms, or leave it out");
  if (!(direction.norm() > 1e-9))
    throw InputError("`direction`", "is missing",
                     "give where the rope leaves the gripper, in the frame of the grasp, for example -z");
  if (tabletop && !table)
    throw InputError("`table`", "is missing", "give the height of the table's surface, for example `table` 0.02");
}

Imported import_capture(const Path& out, const Options& given) {
  given.check();
  Options options = given;
  options.direction.normalize();
  check_room(out, options);
  Imported imported;
  std::vector<std::string>& notes = imported.notes;
  // the base, in the capture's world
  std::vector<trajectory::Sample> base = read_base_log(options, notes);
  for (trajectory::Sample& sample : base) sample.pose = options.base_world * sample.pose * options.tool;
  // one clock, from the base's first second where it began long ago
  const double origin = std::abs(base.front().time) > kNewOrigin ? std::floor(base.front().time) : 0.0;
  if (origin != 0.0) notes.push_back("clock: all times are from " + text("%.0f", origin) + " s on");
  for (trajectory::Sample& sample : base) sample.time -= origin;
  // frames, what is the rope in them, and where the cameras are
  std::vector<Camera> cameras(options.cameras.size());
  for (std::size_t c = 0; c < cameras.size(); ++c) {
    cameras[c].request = &options.cameras[c];
    cameras[c].images = open_media(cameras[c].request->images);
    read_optics(cameras[c], notes);
    read_masks(cameras[c], notes);
  }
  imported.masks =
      std::all_of(cameras.begin(), cameras.end(), [](const Camera& camera) { return camera.masks.has_value(); });
  set_poses(cameras, base, options, notes);
  for (Camera& camera : cameras) {
    set_times(camera, options, base, origin, notes);
    check_readout(camera);
    camera.take = {0, camera.images.frames};
    if (base.size() > 1) cut(camera, base.front().time, base.back().time, origin, notes);
  }
  leave_out_far_poses(base, cameras, notes);
  const trajectory::Trajectory motion = trajectory::fit(base, options.base.file.string());
  options.bending_axis = bending_axis(options, base, notes);
  try {
    write_capture(out, options, cameras, base, motion, imported);
  } catch (const InputError& damaged) {  // found only while copying
    throw WorkError(damaged.where, damaged.problem, damaged.mend + "; " + out.string() + " is unfinished");
  }
  core::write_file(out / kImportFile, core::json_text(provenance(given, origin, notes)) + "\n");
  return imported;
}

}  // namespace chainsplat::importing
