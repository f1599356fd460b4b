// `chainsplat check`: what a capture contains and what is wrong or doubtful about it, in plain words.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <limits>
#include <numbers>

#include "manifest.h"

namespace chainsplat::capture {

using math::Pose;
using math::Vector2;
using math::Vector3;

namespace {

// Thresholds beyond which a capture is doubted. Meters become pixels at the distance of the grasp.
constexpr double kGripperReach = 0.015;  // m of rope beyond the grasp that fingers may hide
constexpr double kPoseSlack = 3.0;       // px of reprojection error that a calibrated camera may have
constexpr double kThinRope = 5.0;        // px across; thinner ropes leave too few pixels
constexpr double kSaturated = 250;       // of 255, in any channel
constexpr double kMostSaturated = 0.05;  // share of the object's pixels
constexpr double kDark = 20;             // of 255, mean of the object
constexpr double kFlicker = 0.15;        // relative change of the object's brightness from one frame to the next
constexpr double kRateTolerance = 0.01;  // relative difference between two rates
constexpr double kStill = 1e-3;          // m of base travel below which the base counts as at rest
constexpr double kNoisyBase = 2e-3;      // m, standard deviation of the base's position
constexpr double kAlong = 0.1;           // rad between the bending axis and the table's normal
constexpr double kBehind = 0.2;          // share of the mask on the wrong side of the grasp
constexpr double kForeshortened = 0.3;   // share of its length below which a projected rope shows no direction
constexpr int kMostLag = 4;              // frames, the largest delay between base and images that is tried
constexpr double kLagGain = 0.7;         // a delay is believed when it leaves less than this share of the error,
constexpr double kLagPixels = 1.0;       // px, and when the error shrinks by at least this
constexpr int kLagFrames = 50;           // frames per camera that the search for a delay uses
constexpr int kFarPixels = 100000;       // px, the distance to an empty mask
constexpr double kDegrees = 180.0 / std::numbers::pi;

std::string text(const char* format, auto... values) {
  char line[512];
  std::snprintf(line, sizeof line, format, values...);
  return line;
}

double median(std::vector<double> values) {
  return values.empty() ? std::numeric_limits<double>::quiet_NaN() : math::median(values);
}

// Returns the distance from an image position to the nearest mask pixel, px.
double mask_distance(const View& view, const Vector2& position) {
  double nearest = static_cast<double>(kFarPixels) * kFarPixels;
  for (int y = 0; y < view.height; ++y)
    for (int x = 0; x < view.width; ++x)
      if (view.rgba[4 * (static_cast<std::size_t>(y) * view.width + x) + 3] != 0)
        nearest = std::min(nearest, (Vector2(view.x0 + x + 0.5, view.y0 + y + 0.5) - position).squaredNorm());
  return std::sqrt(nearest);
}

// Returns the share of the mask that lies behind the grasp, seen in the direction in which the rope leaves the gripper,
// by more than the gripper's reach; NaN when the rope points at the camera. `grasp` and `direction`: camera frame.
double share_behind(const View& view, const Camera& camera, const Vector3& grasp, const Vector3& direction,
                    double length) {
  const Vector3 along = grasp + length * direction;
  if (along.z() <= 0) return std::numeric_limits<double>::quiet_NaN();
  const Vector2 start = project(camera, grasp), step = project(camera, along) - start;
  const double scale = camera.fx / grasp.z();  // px per meter
  if (step.norm() < kForeshortened * length * scale) return std::numeric_limits<double>::quiet_NaN();
  const Vector2 forward = step.normalized();
  int behind = 0, all = 0;
  for (int y = 0; y < view.height; ++y)
    for (int x = 0; x < view.width; ++x) {
      if (view.rgba[4 * (static_cast<std::size_t>(y) * view.width + x) + 3] == 0) continue;
      ++all;
      behind +=
          forward.dot(Vector2(view.x0 + x + 0.5, view.y0 + y + 0.5) - start) < -kGripperReach * scale - kPoseSlack;
    }
  return all ? static_cast<double>(behind) / all : 0.0;
}

struct ViewFacts {
  int pixels = 0, saturated = 0;
  double brightness = 0.0;  // mean of the object's pixels and channels, 0..255
  bool at_border = false;
  double depth = std::numeric_limits<double>::quiet_NaN();  // m, mean inside the mask
};

ViewFacts facts_of(const View& view, const Camera& camera) {
  ViewFacts facts;
  double depth = 0.0;
  int with_depth = 0;
  for (int y = 0; y < view.height; ++y)
    for (int x = 0; x < view.width; ++x) {
      const std::size_t i = static_cast<std::size_t>(y) * view.width + x;
      const std::uint8_t* const p = &view.rgba[4 * i];
      if (p[3] == 0) continue;
      ++facts.pixels;
      facts.brightness += (p[0] + p[1] + p[2]) / 3.0;
      facts.saturated += std::max({p[0], p[1], p[2]}) >= kSaturated;
      const int column = view.x0 + x, row = view.y0 + y;
      facts.at_border |= column == 0 || row == 0 || column + 1 == camera.width || row + 1 == camera.height;
      if (!view.depth.empty() && view.depth[i] > 0) {
        depth += view.depth[i];
        ++with_depth;
      }
    }
  if (facts.pixels > 0) facts.brightness /= facts.pixels;
  if (with_depth > 0) facts.depth = depth / with_depth;
  return facts;
}

void check_base(const Manifest& manifest, CheckReport& report) {
  // extremes of place, speed and acceleration at the samples
  const Capture& capture = manifest.capture;
  const auto& samples = capture.base.samples();
  Vector3 low = samples.front().pose.translation, high = low;
  for (const trajectory::Sample& sample : samples) {
    low = low.cwiseMin(sample.pose.translation);
    high = high.cwiseMax(sample.pose.translation);
  }
  const Vector3 travel = high - low;
  const double seconds = capture.base.end() - capture.base.start();
  double speed = 0.0, acceleration = 0.0, turning = 0.0;
  for (const trajectory::Sample& sample : samples) {
    const trajectory::BaseMotion motion = capture.base.at(sample.time);
    const Vector3 w = motion.velocity.head<3>(), v = motion.velocity.tail<3>();
    speed = std::max(speed, v.norm());
    turning = std::max(turning, w.norm());
    acceleration = std::max(acceleration, (motion.acceleration.tail<3>() + w.cross(v)).norm());
  }
  const double rate = seconds > 0 ? (static_cast<double>(samples.size()) - 1.0) / seconds : 0.0;
  report.facts.push_back(
      text("base: %zu poses, %.3f to %.3f s, %.4g Hz; travels %.3f, %.3f, %.3f m along x, y, z; at most %.2f m/s, "
           "%.2f m/s^2, %.2f rad/s; position noise %.2g m",
           samples.size(), capture.base.start(), capture.base.end(), rate, travel.x(), travel.y(), travel.z(), speed,
           acceleration, turning, capture.base.noise()));
  // speeds that are impossible, a base at rest, noise, and a rate below the cameras'
  if (!std::isfinite(speed + acceleration + turning))
    report.problems.push_back(
        "base: its speed is beyond all numbers: poses lie too far apart for their times; write meters and seconds");
  if (travel.norm() < kStill && turning * seconds < kStill)
    report.doubts.push_back(
        "base: it stays at rest; masses, damping and friction are hardly observable from such a capture");
  if (capture.base.noise() > kNoisyBase)
    report.doubts.push_back(
        text("base: position noise of %.1f mm; accelerations from it are uncertain", 1e3 * capture.base.noise()));
  for (const CameraSource& source : manifest.cameras)
    if (rate > 0 && source.interval > 0 && rate < (1.0 - kRateTolerance) / source.interval) {
      report.doubts.push_back(
          text("base: %.4g Hz is less than the %.4g Hz of %s; fast motion between the poses is lost", rate,
               1.0 / source.interval, source.camera.name.c_str()));
      break;
    }
  // the pose relative to the table
  if (capture.table) {
    const Pose& first = samples.front().pose;
    const Vector3 axis = first.rotation * capture.bending_axis;
    const double angle = std::acos(std::min(1.0, std::abs(axis.dot(capture.table->normal))));
    if (angle > kAlong)
      report.doubts.push_back(
          text("grasp.bending_axis: is %.0f degrees off the table's normal at the first pose", angle * kDegrees));
    const double height = capture.table->normal.dot(first.translation - capture.table->point);
    if (height < -kStill || height > capture.length)
      report.doubts.push_back(text("base: the grasp is %.3f m above the table at the first pose", height));
  }
}

// What the frames of one camera show.
struct CameraStatistics {
  int frames = 0, visible = 0, border = 0;  // numbers of frames: all, with a mask, with a mask at the image's border
  int behind = 0;                           // with the grasp behind the camera
  double pixels = 0.0, saturated = 0.0;     // of the masks of all frames
  std::vector<double> brightness;           // by visible frame, 0..255
  std::vector<double> distance;             // px, of the projected grasp from the mask
  std::vector<double> wrong_side;           // share of the mask behind the grasp
  std::vector<double> grasp_depth, object_depth;  // m
  std::vector<std::vector<double>> shifted;       // px, the grasp's distance from the mask per delay of the base
};

CameraStatistics statistics_of(const Manifest& manifest, const CameraSource& source, const PackedView* views,
                               int count) {
  const Camera& camera = source.camera;
  const trajectory::Trajectory& base = manifest.capture.base;
  const Pose camera_from_world = camera.world_from_camera.inverse();
  CameraStatistics out;
  out.frames = count;
  out.shifted.resize(2 * kMostLag + 1);
  for (int k = 0; k < count; ++k) {
    const View view = unpacked(views[k]);
    const ViewFacts facts = facts_of(view, camera);
    if (facts.pixels == 0) continue;
    ++out.visible;
    out.pixels += facts.pixels;
    out.saturated += facts.saturated;
    out.border += facts.at_border;
    out.brightness.push_back(facts.brightness);
    if (std::isfinite(facts.depth)) out.object_depth.push_back(facts.depth);
    const Pose pose = base.pose(view.time);
    const Vector3 grasp = camera_from_world * pose.translation;
    if (grasp.z() <= 0) {
      ++out.behind;
      continue;
    }
    out.grasp_depth.push_back(grasp.z());
    out.distance.push_back(mask_distance(view, project(camera, grasp)));
    const double side =
        share_behind(view, camera, grasp, camera_from_world.rotation * pose.rotation * manifest.capture.direction,
                     manifest.capture.length);
    if (std::isfinite(side)) out.wrong_side.push_back(side);
    if (k % std::max(1, count / kLagFrames) != 0) continue;
    for (int lag = -kMostLag; lag <= kMostLag; ++lag) {
      const Vector3 moved = camera_from_world * base.pose(view.time + lag * source.interval).translation;
      out.shifted[lag + kMostLag].push_back(moved.z() > 0 ? mask_distance(view, project(camera, moved)) : kFarPixels);
    }
  }
  return out;
}

std::string facts_line(const Manifest& manifest, const CameraSource& source, const CameraStatistics& s) {
  const Camera& camera = source.camera;
  const double z = median(s.grasp_depth);
  std::string line =
      text("%s: %dx%d, %d frames, %.3f to %.3f s, %s; sees the object in %d, %.0f px in the mean (%.2f %%)",
           camera.name.c_str(), camera.width, camera.height, s.frames, source.times.front(), source.times.back(),
           camera.distorted() ? "lens distortion is taken out" : "no lens distortion", s.visible,
           s.visible ? s.pixels / s.visible : 0.0,
           s.visible ? 100.0 * s.pixels / s.visible / camera.width / camera.height : 0.0);
  if (s.visible > 0) line += text("; brightness %.0f of 255", median(s.brightness));
  if (std::isfinite(z))
    line += text("; grasp %.2f m away, the rope about %.1f px across, the grasp %.1f px from the mask", z,
                 manifest.capture.diameter * camera.fx / z, median(s.distance));
  return line;
}

// Masks that are missing or cut off, and exposure.
void check_pictures(const Manifest& manifest, const CameraSource& source, const CameraStatistics& s,
                    CheckReport& report) {
  const std::string& name = source.camera.name;
  const double bright = median(s.brightness);
  if (s.visible < s.frames)
    report.doubts.push_back(
        text("%s: the mask is empty in %d of %d frames", name.c_str(), s.frames - s.visible, s.frames));
  if (s.border > 0)
    report.doubts.push_back(
        text("%s: the mask touches the image's border in %d of %d frames: part of the rope may be out of sight",
             name.c_str(), s.border, s.frames));
  if (s.saturated > kMostSaturated * s.pixels)
    report.doubts.push_back(
        text("%s: %.0f %% of the object's pixels are overexposed", name.c_str(), 100.0 * s.saturated / s.pixels));
  if (bright < kDark)
    report.doubts.push_back(text("%s: the object is very dark (%.0f of 255 in the mean)", name.c_str(), bright));
  const auto [darkest, brightest] = std::minmax_element(s.brightness.begin(), s.brightness.end());
  double jump = 0.0;
  for (std::size_t k = 1; k < s.brightness.size(); ++k)
    jump = std::max(jump, std::abs(s.brightness[k] - s.brightness[k - 1]));
  if (bright > 0 && jump > kFlicker * bright)
    report.doubts.push_back(
        text("%s: the object's brightness jumps between frames (%.0f to %.0f of 255): is the exposure fixed?",
             name.c_str(), *darkest, *brightest));
  const double across = manifest.capture.diameter * source.camera.fx / median(s.grasp_depth);
  if (std::isfinite(across) && across < kThinRope)
    report.doubts.push_back(text("%s: the rope is only %.1f px across", name.c_str(), across));
}

// Whether the grasp projects to where the masks begin.
void check_grasp(const CameraSource& source, const CameraStatistics& s, CheckReport& report) {
  const std::string& name = source.camera.name;
  const double miss = median(s.distance), side = median(s.wrong_side);
  const double allowed = kGripperReach * source.camera.fx / median(s.grasp_depth) + kPoseSlack;
  const std::size_t before = report.doubts.size();
  if (s.behind > 0)
    report.doubts.push_back(
        text("%s: the grasp is behind the camera in %d frames: does world_from_camera use OpenCV's axes (z forward)?",
             name.c_str(), s.behind));
  if (miss > allowed)
    report.doubts.push_back(
        text("%s: the grasp projects %.0f px from the mask (at most %.0f expected): check the camera's pose, the base "
             "trajectory and their times",
             name.c_str(), miss, allowed));
  else if (side > kBehind)
    report.doubts.push_back(text(
        "%s: %.0f %% of the mask lies behind the grasp, against grasp.direction: check the camera's pose, the base "
        "trajectory and the direction",
        name.c_str(), 100.0 * side));
  report.poses_doubted = report.poses_doubted || report.doubts.size() > before;
}

// A wrong clock shows as a distance that shrinks when the base is moved in time. The RMS over all frames is compared,
// because frames at rest carry no information and would decide a median.
void check_clock(const CameraSource& source, const CameraStatistics& s, CheckReport& report) {
  const auto rms = [&](int lag) {
    const std::vector<double>& values = s.shifted[lag + kMostLag];
    double sum = 0.0;
    for (const double v : values) sum += v * v;
    return values.empty() ? 0.0 : std::sqrt(sum / static_cast<double>(values.size()));
  };
  int best = 0;
  for (int lag = -kMostLag; lag <= kMostLag; ++lag)
    if (!s.shifted[lag + kMostLag].empty() && rms(lag) < rms(best)) best = lag;
  const double now = rms(0), then = rms(best);
  if (best != 0 && then < kLagGain * now && now - then > kLagPixels)
    report.doubts.push_back(text(
        "%s: the images fit the base better %d frames %s (%.1f px instead of %.1f): are start and the base's times "
        "on one clock?",
        source.camera.name.c_str(), std::abs(best), best > 0 ? "later" : "earlier", then, now));
}

// Depth against the distance of the grasp.
void check_depth(const Manifest& manifest, const CameraSource& source, const CameraStatistics& s, CheckReport& report) {
  if (!source.depth) return;
  const std::string& name = source.camera.name;
  const double depth = median(s.object_depth), z = median(s.grasp_depth);
  if (!std::isfinite(depth))
    report.doubts.push_back(name + ": no depth inside the masks");
  else if (std::isfinite(z) && std::abs(depth - z) > manifest.capture.length + kGripperReach)
    report.doubts.push_back(
        text("%s: the depth images say %.2f m, the grasp is %.2f m away: check depth_scale", name.c_str(), depth, z));
}

// `views` are all of the camera's, undistorted.
void check_camera(const Manifest& manifest, const CameraSource& source, const PackedView* views, int count,
                  CheckReport& report) {
  const CameraStatistics statistics = statistics_of(manifest, source, views, count);
  report.facts.push_back(facts_line(manifest, source, statistics));
  if (source.video_rate > 0 && source.interval > 0 &&
      std::abs(source.video_rate * source.interval - 1.0) > kRateTolerance)
    report.doubts.push_back(text("%s: the video says %.4g frames a second, the capture %.4g",
                                 source.camera.name.c_str(), source.video_rate, 1.0 / source.interval));
  if (statistics.visible == 0) return;  // load_views() has reported a problem already
  check_pictures(manifest, source, statistics, report);
  check_grasp(source, statistics, report);
  check_clock(source, statistics, report);
  check_depth(manifest, source, statistics, report);
}

void check_truth(const Manifest& manifest, CheckReport& report) {
  try {
    const std::optional<TrueCenterline> truth = load_true_centerline(manifest.capture.folder);
    if (!truth) return;
    for (const CameraSource& source : manifest.cameras)
      if (!source.times.empty() &&
          (source.times.back() < truth->time.front() || source.times.front() > truth->time.back()))
        report.doubts.push_back("truth/centreline.csv: says nothing of the times of " + source.camera.name);
  } catch (const InputError& error) {
    report.problems.push_back(error.what());
  }
}

}  // namespace

CheckReport check(const Path& path) {
  CheckReport report;
  Findings findings;
  const auto finish = [&] {
    for (const Problem& problem : findings.problems)
      report.problems.push_back(problem.where + ": " + problem.what + "; " + problem.mend);
    report.doubts.insert(report.doubts.begin(), findings.doubts.begin(), findings.doubts.end());
    return report;
  };
  // the manifest and the base
  Manifest manifest;
  try {
    manifest = read_manifest(path, "", true, findings);
  } catch (const InputError& error) {
    report.problems.push_back(error.what());
    return finish();
  }
  const Capture& capture = manifest.capture;
  report.facts.push_back(text("capture '%.100s': %s, %zu cameras", capture.name.c_str(),
                              capture.tabletop ? "on a table" : "free space", manifest.cameras.size()));
  report.facts.push_back(text("rope: %.4g m long, %.4g m thick, ", capture.length, capture.diameter) +
                         (capture.mass ? text("%.4g kg", *capture.mass) : std::string("mass not given")));
  if (!capture.mass)
    report.doubts.push_back("object.mass: is missing; masses and forces will be relative to a total mass of 1");
  if (manifest.cameras.size() == 1) report.doubts.push_back("cameras: only one; depth along its rays is hardly seen");
  if (!capture.base.samples().empty()) check_base(manifest, report);

  // the images of every camera whose files are whole, so that one camera's problem does not hide the others'
  for (std::size_t c = 0; c < manifest.cameras.size(); ++c) {
    const CameraSource& source = manifest.cameras[c];
    const auto of_this_camera = [&](const Problem& problem) {
      const auto among = [&](const ImageSource& files) {
        return !files.names.before.empty() && problem.where.starts_with(files.names.before);
      };
      return problem.where.starts_with(source.where) ||
             (source.images.video && problem.where.starts_with(source.images.file.string())) || among(source.images) ||
             (source.masks && among(*source.masks)) || (source.depth && among(*source.depth)) ||
             (source.timestamps && problem.where.starts_with(source.timestamps->string()));
    };
    if (source.times.empty() || capture.base.samples().empty() ||
        std::any_of(findings.problems.begin(), findings.problems.end(), of_this_camera))
      continue;
    Manifest one = manifest;
    one.cameras = {source};
    std::vector<PackedView> views, recorded;
    LoadOptions options;
    options.depth = true;
    options.margin = 0;
    try {
      load_views(one, options, findings, views, recorded);
    } catch (const InputError& error) {
      report.problems.push_back(error.what());
      continue;
    }
    check_camera(manifest, source, views.data(), static_cast<int>(views.size()), report);
  }
  // what serves evaluation only
  report.facts.push_back(capture.has_depth ? "depth: given, for evaluation" : "depth: none, so no Chamfer distance");
  std::error_code error;
  if (std::filesystem::is_directory(capture.folder / "truth", error)) {
    report.facts.push_back("truth: given, for evaluation; training never opens it");
    check_truth(manifest, report);
  }
  return finish();
}

}  // namespace chainsplat::capture
