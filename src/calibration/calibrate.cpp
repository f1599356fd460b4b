// From recordings to a calibration: each camera by itself, then all of them together.
#include "chainsplat/calibration.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>

#include "bundle.h"
#include "chainsplat/text.h"
#include "files.h"
#include "look.h"
#include "src/math/decompositions.h"
#include "start.h"
#include "verdict.h"

namespace chainsplat::calibration {

using math::Matrix3;
using math::MatrixX;
using math::Pose;
using math::Vector2;
using math::Vector3;
using math::VectorX;

namespace {

constexpr std::size_t kAloneViews = 60;  // of a camera by itself
constexpr int kFirstSteps = 40, kSteps = 25;
constexpr int kLensRounds = 3;                                  // corners depend on the lens, the lens on the corners
constexpr int kScaleRounds = 8;                                 // of the robot's and the corners' scatter
constexpr double kSettled = 0.01;                               // relative change of the scatter
constexpr double kGoodStart = 3.0;                              // px: with more another focal length is tried
constexpr double kOtherFocals[] = {0.6, 1.0, 2.0};              // times the image's width
constexpr double kLeastPosition = 1e-5, kLeastRotation = 1e-5;  // m, rad: of a robot's scatter
constexpr std::size_t kFewestViews = 3;
constexpr double kInset = 0.02;        // of the image: where its edge is judged
constexpr int kAcross = 8, kDown = 6;  // regions that are counted as covered

capture::Camera first_lens(const Recording& recording) {
  capture::Camera camera;
  camera.name = recording.name;
  camera.width = recording.media.width, camera.height = recording.media.height;
  camera.cx = 0.5 * camera.width, camera.cy = 0.5 * camera.height;
  return camera;
}

void drop_poor(std::vector<Moment>& moments) {
  for (Moment& moment : moments) std::erase_if(moment.views, [](const View& view) { return view.corners.size() < 4; });
  std::erase_if(moments, [](const Moment& moment) { return moment.views.empty(); });
}

double rms(const Bundle& bundle, int camera) {
  double sum = 0.0, count = 0.0;
  for (const Moment& moment : bundle.moments)
    for (const View& view : moment.views) {
      if (view.camera != camera) continue;
      const MatrixX r = residuals(bundle, moment, view, nullptr);
      for (Eigen::Index i = 0; i < r.cols(); ++i)
        if (r.col(i).allFinite()) sum += r.col(i).squaredNorm(), count += 1.0;
    }
  return count > 0.0 ? std::sqrt(sum / count) : NAN;
}

// The scatter of corners and robot, and with it the weights, until they agree with what is left.
Certainty settle(Bundle& bundle, solve::Summary& summary) {
  Certainty sure = certainty(bundle);
  for (int round = 0; round < kScaleRounds; ++round) {
    const Bundle before = bundle;
    set_scales(bundle, sure.absorbed);
    if (bundle.robot) {
      bundle.robot_position = std::max(std::sqrt(sure.position_square), kLeastPosition);
      bundle.robot_rotation = std::max(std::sqrt(sure.rotation_square), kLeastRotation);
    }
    summary = fit(bundle, kSteps);
    sure = certainty(bundle);
    double change = std::abs(std::log(bundle.robot_position / before.robot_position)) +
                    std::abs(std::log(bundle.robot_rotation / before.robot_rotation));
    for (std::size_t c = 0; c < bundle.scales.size(); ++c)
      change = std::max(change, std::abs(std::log(bundle.scales[c] / before.scales[c])));
    if (change < kSettled) break;
  }
  return sure;
}

// One camera by itself; its pose is the world.
struct Alone {
  Bundle bundle;
  solve::Summary summary;
  double rms = 0.0;  // px
};

Alone calibrate_alone(const Recording& recording, std::vector<View> views, const Board& board) {
  if (views.size() > kAloneViews) {
    std::vector<View> fewer;
    for (std::size_t i = 0; i < kAloneViews; ++i) fewer.push_back(views[i * views.size() / kAloneViews]);
    views = std::move(fewer);
  }
  const capture::Camera lens = first_lens(recording);
  for (View& view : views) view.camera = 0, set_corners(view, recording, board, lens);
  std::erase_if(views, [](const View& view) { return view.corners.size() < 4; });
  if (views.empty())
    throw InputError(recording.media.source.string(), recording.name + " sees the board, but nowhere with sharp edges",
                     "hold it nearer and stiller, in more light");
  std::vector<const View*> all;
  for (const View& view : views) all.push_back(&view);
  const auto begin = [&](double focal) {
    Alone alone;
    Bundle& bundle = alone.bundle;
    bundle.cameras = {lens}, bundle.clocks = {0.0}, bundle.scales = {1.0};
    bundle.cameras[0].fx = bundle.cameras[0].fy = focal;
    for (const View& view : views)
      if (const auto pose = pose_by_homography(view, bundle.cameras[0])) bundle.moments.push_back({{view}, *pose});
    if (bundle.moments.empty()) return alone;
    set_scales(bundle);
    alone.summary = fit(bundle, kFirstSteps);
    alone.rms = rms(bundle, 0);
    return alone;
  };
  const auto focal = focal_length(all, lens.width, lens.height);
  Alone best = begin(focal.value_or(lens.width));
  if (best.bundle.moments.empty())
    throw InputError(recording.media.source.string(), recording.name + " sees the board from the edge only",
                     "tilt it less");
  if (!(best.rms < kGoodStart))
    for (const double factor : kOtherFocals)
      if (Alone other = begin(factor * lens.width); other.rms < best.rms) best = std::move(other);
  for (int round = 0; round < kLensRounds; ++round) {
    for (Moment& moment : best.bundle.moments) set_corners(moment.views[0], recording, board, best.bundle.cameras[0]);
    drop_poor(best.bundle.moments);
    set_scales(best.bundle);
    best.summary = fit(best.bundle, kSteps);
  }
  settle(best.bundle, best.summary);
  best.rms = rms(best.bundle, 0);
  return best;
}

// camera_from_board of every view, none where it cannot be told.
std::optional<Pose> place(const View& view, const capture::Camera& lens) { return pose_by_homography(view, lens); }

// --- a robot moves the board -----------------------------------------------------------------------------------------

struct Robot {
  trajectory::Trajectory motion;
  double origin = 0.0;  // s, of the log; all times are from here on
};

std::string range(double first, double last) { return core::brief(first) + " to " + core::brief(last) + " s"; }

// Throws InputError where the camera's times lie outside of the robot's log, however its clock is turned.
void check_overlap(const Options& options, std::size_t camera, const Robot& robot, double first, double last,
                   const std::string& what) {
  const CameraRequest& request = options.cameras[camera];
  const trajectory::Trajectory& motion = robot.motion;
  if (request.find_start || (first - kClockSearch <= motion.end() && last + kClockSearch >= motion.start())) return;
  throw InputError(options.log.base.file.string(),
                   "covers " + range(motion.start() + robot.origin, motion.end() + robot.origin) + ", and " +
                       request.name + what + range(first + robot.origin, last + robot.origin),
                   "give both by one clock with `timestamps` or `start`, or `start` " + request.name + "=auto");
}

// Clocks, cameras' poses and the board's pose on the flange, to begin with.
void begin_with_robot(Bundle& bundle, std::vector<std::vector<View>>& views, const std::vector<Recording>& recordings,
                      const Options& options, const Robot& robot, std::vector<std::string>& notes) {
  const trajectory::Trajectory& motion = robot.motion;
  std::optional<HandEye> best;
  std::vector<std::vector<Placed>> placed(views.size());
  for (std::size_t c = 0; c < views.size(); ++c) {
    const CameraRequest& request = options.cameras[c];
    const double first = recordings[c].seen.front().time, last = recordings[c].seen.back().time;
    check_overlap(options, c, robot, first, last, " sees the board from ");
    for (const View& view : views[c])
      if (const auto pose = place(view, bundle.cameras[c])) placed[c].push_back({view.time, *pose});
    const double from = request.find_start ? motion.start() - last : -kClockSearch;
    const double to = request.find_start ? motion.end() - first : kClockSearch;
    const auto clock = clock_by_turns(placed[c], motion, from, to);
    if (!clock && request.find_start)
      throw InputError("`start`", "the board's turns do not tell when " + request.name + " began to record",
                       "give the time of its frame 0, or let the robot turn the board, each time by another angle");
    if (!clock) notes.push_back(request.name + ": the board's turns do not tell its clock, which is taken as given");
    bundle.clocks[c] = clock.value_or(0.0);
    const auto outside = [&](double time) {
      return time + bundle.clocks[c] < motion.start() || time + bundle.clocks[c] > motion.end();
    };
    std::erase_if(views[c], [&](const View& view) { return outside(view.time); });
    std::erase_if(placed[c], [&](const Placed& view) { return outside(view.time); });
    if (placed[c].size() < kFewestViews)
      throw InputError(options.log.base.file.string(),
                       "covers " + range(motion.start() + robot.origin, motion.end() + robot.origin) + ", and only " +
                           std::to_string(placed[c].size()) + " different views of " + request.name + " lie in it",
                       "record the robot while the camera sees the board, in 15 places or more");
    const auto found = hand_eye(placed[c], motion, bundle.clocks[c]);
    if (found && (!best || found->miss < best->miss)) best = found;
  }
  if (!best)
    throw InputError(options.log.base.file.string(), "does not fit the board's motion at all",
                     "check that the robot moved the board, the units and the clocks");
  bundle.flange_from_board = best->flange_from_board;
  for (std::size_t c = 0; c < views.size(); ++c) {
    std::vector<Pose> poses;
    for (const Placed& view : placed[c])
      poses.push_back(motion.pose(view.time + bundle.clocks[c]) * bundle.flange_from_board *
                      view.camera_from_board.inverse());
    bundle.cameras[c].world_from_camera = middle_pose(poses, 0.5);
  }
}

// RMS of the flange's turns about other axes than the one that it turns about most.
double turn_about_others(const Bundle& bundle) {
  std::vector<Matrix3> turns;
  for (const Moment& moment : bundle.moments)
    for (const View& view : moment.views)
      turns.push_back(bundle.robot->pose(view.time + bundle.clocks[view.camera]).rotation);
  Matrix3 moments = Matrix3::Zero();
  double count = 0.0;
  for (std::size_t i = 0; i < turns.size(); ++i)
    for (std::size_t k = i + 1; k < turns.size(); k += 1 + turns.size() / 50) {
      const Vector3 turn = math::log_so3(turns[i] * turns[k].transpose());
      moments += turn * turn.transpose(), count += 1.0;
    }
  if (count == 0.0) return 0.0;
  const Eigen::SelfAdjointEigenSolver<Matrix3> axes(Matrix3(moments / count));
  return std::sqrt(std::max(axes.eigenvalues()(1), 0.0));
}

// --- a hand moves the board ------------------------------------------------------------------------------------------

// Poses of the cameras relative to the first one along the pairs that saw the board together most often. False for a
// camera that no pair leads to.
std::vector<bool> chain_cameras(Bundle& bundle) {
  const std::size_t count = bundle.cameras.size();
  std::vector<std::vector<std::vector<Pose>>> between(count, std::vector<std::vector<Pose>>(count));  // a_from_b
  for (const Moment& moment : bundle.moments) {
    std::vector<std::pair<int, Pose>> poses;
    for (const View& view : moment.views)
      if (const auto pose = place(view, bundle.cameras[view.camera])) poses.emplace_back(view.camera, *pose);
    for (const auto& [a, pose_a] : poses)
      for (const auto& [b, pose_b] : poses)
        if (a != b) between[a][b].push_back(pose_a * pose_b.inverse());
  }
  std::vector<bool> placed(count, false);
  placed[0] = true;
  bundle.cameras[0].world_from_camera = {};
  for (;;) {
    std::size_t from = 0, to = 0, most = 0;
    for (std::size_t a = 0; a < count; ++a)
      for (std::size_t b = 0; b < count; ++b)
        if (placed[a] && !placed[b] && between[a][b].size() > most) from = a, to = b, most = between[a][b].size();
    if (most == 0) break;
    bundle.cameras[to].world_from_camera = bundle.cameras[from].world_from_camera * middle_pose(between[from][to], 0.5);
    placed[to] = true;
  }
  for (Moment& moment : bundle.moments) {
    std::erase_if(moment.views, [&](const View& view) { return !placed[view.camera]; });
    std::vector<Pose> poses;
    for (const View& view : moment.views)
      if (const auto pose = place(view, bundle.cameras[view.camera]))
        poses.push_back(bundle.cameras[view.camera].world_from_camera * *pose);
    if (poses.empty())
      moment.views.clear();
    else
      moment.pose = middle_pose(poses, 0.5);
  }
  std::erase_if(bundle.moments, [](const Moment& moment) { return moment.views.empty(); });
  return placed;
}

// The world becomes the board's frame where the first camera sees it first.
void turn_to_board(Bundle& bundle) {
  std::size_t first = bundle.moments.size();
  double least = std::numeric_limits<double>::infinity();
  for (std::size_t m = 0; m < bundle.moments.size(); ++m)
    for (const View& view : bundle.moments[m].views)
      if (view.camera == 0 && view.time < least) least = view.time, first = m;
  if (first == bundle.moments.size()) return;
  const Pose board_from_world = bundle.moments[first].pose.inverse();
  for (capture::Camera& camera : bundle.cameras) camera.world_from_camera = board_from_world * camera.world_from_camera;
  for (Moment& moment : bundle.moments) moment.pose = board_from_world * moment.pose;
  bundle.held_camera = -1, bundle.held_moment = static_cast<int>(first);
}

// --- results ---------------------------------------------------------------------------------------------------------

const char* const kRegions[3][3] = {{"upper left", "upper middle", "upper right"},
                                    {"middle left", "center", "middle right"},
                                    {"lower left", "lower middle", "lower right"}};

// Fills all but names and frames. `camera` is the bundle's, `covariance` of its shared unknowns.
void describe_camera(const Bundle& bundle, int camera, const MatrixX& covariance, CameraResult& out,
                     Evidence& evidence) {
  out.camera = bundle.cameras[camera];
  out.clock = bundle.clocks[camera];
  const Eigen::Index first = kCameraUnknowns * camera;
  const VectorX sigma = covariance.diagonal().segment(first, kCameraUnknowns).cwiseMax(0.0).cwiseSqrt();
  Deviation& d = out.deviation;
  d.fx = sigma(0), d.fy = sigma(1), d.cx = sigma(2), d.cy = sigma(3);
  for (int k = 0; k < 5; ++k) d.distortion[k] = sigma(4 + k);
  d.rotation = sigma.segment<3>(9), d.position = sigma.segment<3>(12), d.clock = bundle.robot ? sigma(15) : 0.0;
  double squares = 0.0, squares_mm = 0.0;
  std::vector<double> all_depths;
  std::vector<bool> covered(kAcross * kDown, false), regions(9, false);
  for (const Moment& moment : bundle.moments)
    for (const View& view : moment.views) {
      if (view.camera != camera) continue;
      ++out.views;
      std::vector<double> depths;
      const MatrixX r = residuals(bundle, moment, view, &depths);
      for (Eigen::Index i = 0; i < r.cols(); ++i) {
        if (!r.col(i).allFinite()) continue;
        ++out.corners;
        const double size = r.col(i).norm();
        out.worst = std::max(out.worst, size);
        squares += size * size;
        squares_mm += std::pow(1e3 * size * depths[i] / out.camera.fx, 2);
        all_depths.push_back(depths[i]);
        const Vector2& at = view.corners[i].pixel;
        const double u = std::clamp(at.x() / out.camera.width, 0.0, 0.9999),
                     v = std::clamp(at.y() / out.camera.height, 0.0, 0.9999);
        covered[static_cast<int>(v * kDown) * kAcross + static_cast<int>(u * kAcross)] = true;
        regions[static_cast<int>(v * 3) * 3 + static_cast<int>(u * 3)] = true;
      }
      const Pose camera_from_board = out.camera.world_from_camera.inverse() * board_in_world(bundle, moment, view);
      const double facing = std::abs(camera_from_board.rotation.col(2).dot(camera_from_board.translation.normalized()));
      out.tilt = std::max(out.tilt, std::acos(std::min(facing, 1.0)));
    }
  const double count = std::max(1, out.corners);
  out.rms = std::sqrt(squares / count), out.rms_mm = std::sqrt(squares_mm / count);
  out.covered = static_cast<double>(std::count(covered.begin(), covered.end(), true)) / (kAcross * kDown);
  for (int i = 0; i < 9; ++i)
    if (!regions[i]) evidence.uncovered.push_back(kRegions[i / 3][i % 3]);
  // points of the world, as far away as the board was, that fall near the edge of the image
  const double depth = math::median(all_depths);
  capture::Camera still = out.camera;
  for (const double v : {kInset, 0.5, 1.0 - kInset})
    for (const double u : {kInset, 0.5, 1.0 - kInset}) {
      const Vector2 straight = capture::undistort(still, {u * still.width, v * still.height});
      const Vector3 point =
          depth * Vector3((straight.x() - still.cx) / still.fx, (straight.y() - still.cy) / still.fy, 1.0);
      Eigen::Matrix<double, 2, 3> by_point;
      Eigen::Matrix<double, 2, kLensUnknowns> by_lens;
      if (!point.allFinite() || !pixel_of(still, point, by_point, by_lens)) {
        out.edge_deviation = std::numeric_limits<double>::infinity();
        continue;
      }
      const Matrix3 from_world = still.world_from_camera.rotation.transpose();
      Eigen::Matrix<double, 2, 15> by_all;
      by_all << by_lens, by_point * from_world * math::hat(still.world_from_camera.rotation * point),
          -by_point * from_world;
      const Eigen::Matrix2d c = by_all * covariance.block(first, first, 15, 15) * by_all.transpose();
      out.edge_deviation = std::max(out.edge_deviation, std::sqrt(std::max(c.trace(), 0.0)));
    }
}

}  // namespace

void Options::check() const {
  if (cameras.empty()) throw InputError("`camera`", "there is none", "name one: --camera cam0=board.mp4");
  for (std::size_t i = 0; i < cameras.size(); ++i) {
    const std::string& name = cameras[i].name;
    if (name.empty() || name.size() > 64 || name[0] == '.' ||
        name.find_first_not_of("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789-_.") !=
            std::string::npos)
      throw InputError("`camera`", "'" + name + "' is no name of a camera", "use letters, digits, -, _ and .");
    if (name == "calibration")
      throw InputError("`camera`", "'calibration' is the name of the result", "call the camera something else");
    for (std::size_t k = 0; k < i; ++k)
      if (cameras[k].name == name) throw InputError("`camera`", "'" + name + "' is given twice", "name each once");
    if (cameras[i].find_start && log.base.empty())
      throw InputError("`start`", "'auto' needs the robot's motion", "give `base`");
  }
  if (!log.base.empty() && world == World::board)
    throw InputError("`world`", "with `base` the world is the robot's", "leave `world` out");
}

Calibration calibrate(const Path& out_folder, const Options& options) {
  options.check();
  check_output(out_folder, options.force);
  Calibration out;
  out.board = read_board(options.board);
  out.notes.push_back("board: " + std::to_string(out.board.columns) + " x " + std::to_string(out.board.rows) +
                      " tags of " + core::brief(1e3 * out.board.tag_size) + " mm");
  Robot robot;
  out.robot = !options.log.base.empty();
  if (out.robot) {
    std::vector<trajectory::Sample> samples = importing::read_base_log(options.log, out.notes);
    if (samples.size() < kFewestViews)
      throw InputError(options.log.base.file.string(), "has only " + std::to_string(samples.size()) + " poses",
                       "record the robot while it moves the board");
    robot.origin = samples.front().time;
    for (trajectory::Sample& sample : samples) sample.time -= robot.origin;
    robot.motion = trajectory::fit(std::move(samples), options.log.base.file.string());
  }
  std::vector<Recording> recordings;
  for (const CameraRequest& request : options.cameras)
    recordings.push_back(open_recording(request, options.log.time_unit, robot.origin, out.notes));
  if (out.robot)
    for (std::size_t c = 0; c < recordings.size(); ++c)
      check_overlap(options, c, robot, recordings[c].times.front(), recordings[c].times.back(), " is recorded from ");
  look(recordings, out.board);

  const std::size_t count = recordings.size();
  std::vector<std::vector<View>> views(count);
  std::vector<Moment> moments;
  if (out.robot)
    for (std::size_t c = 0; c < count; ++c) views[c] = thinned(recordings[c], static_cast<int>(c));
  else
    for (Moment& moment : moments = chosen(recordings))
      for (const View& view : moment.views) views[view.camera].push_back(view);

  std::vector<Alone> alone;
  Bundle bundle;
  for (std::size_t c = 0; c < count; ++c) {
    core::report({"calibrate " + recordings[c].name, static_cast<std::int64_t>(c), static_cast<std::int64_t>(count) + 1,
                  NAN, NAN, "alone"});
    alone.push_back(calibrate_alone(recordings[c], views[c], out.board));
    bundle.cameras.push_back(alone.back().bundle.cameras[0]);
    bundle.clocks.push_back(0.0), bundle.scales.push_back(alone.back().bundle.scales[0]);
    for (View& view : views[c]) set_corners(view, recordings[c], out.board, bundle.cameras[c]);
    std::erase_if(views[c], [](const View& view) { return view.corners.size() < 4; });
  }
  core::report(
      {"calibrate", static_cast<std::int64_t>(count), static_cast<std::int64_t>(count) + 1, NAN, NAN, "all together"});
  std::vector<bool> placed(count, true);
  const auto all_views = [&] {
    std::vector<View> all;
    for (const std::vector<View>& own : views) all.insert(all.end(), own.begin(), own.end());
    return all;
  };
  double interval = std::numeric_limits<double>::infinity();
  for (const Recording& recording : recordings) interval = std::min(interval, recording.interval);
  if (out.robot) {
    bundle.robot = &robot.motion;
    begin_with_robot(bundle, views, recordings, options, robot, out.notes);
    bundle.moments = grouped(all_views(), bundle.clocks, interval);
    out.world = "the world of the robot's log";
  } else {
    bundle.moments = grouped(all_views(), bundle.clocks, interval);
    placed = chain_cameras(bundle);
    out.world = options.world == World::board ? "the board's frame where " + recordings[0].name +
                                                    " sees it first (x right, y up the page, z out of it)"
                                              : "the frame of " + recordings[0].name;
    if (options.world == World::board) turn_to_board(bundle);
  }
  out.notes.push_back("poses are in " + out.world);
  for (int round = 0; round < kLensRounds; ++round) {
    if (round > 0)
      for (Moment& moment : bundle.moments)
        for (View& view : moment.views)
          set_corners(view, recordings[view.camera], out.board, bundle.cameras[view.camera]);
    set_scales(bundle);
    out.summary = fit(bundle, round == 0 ? kFirstSteps : kSteps);
  }
  const Certainty sure = settle(bundle, out.summary);

  std::vector<Evidence> evidence(count);
  out.moments = static_cast<int>(bundle.moments.size());
  for (std::size_t c = 0; c < count; ++c) {
    CameraResult result;
    result.placed = placed[c];
    evidence[c].alone_rms = alone[c].rms;
    if (placed[c])
      describe_camera(bundle, static_cast<int>(c), sure.covariance, result, evidence[c]);
    else
      describe_camera(alone[c].bundle, 0, certainty(alone[c].bundle).covariance, result, evidence[c]);
    result.frames = recordings[c].looked, result.seen = static_cast<int>(recordings[c].seen.size());
    const CameraRequest& request = options.cameras[c];
    result.start = request.start.value_or(0.0) + result.clock;
    out.cameras.push_back(std::move(result));
  }
  if (out.robot) {
    out.flange_from_board = bundle.flange_from_board;
    const VectorX sigma = sure.covariance.diagonal().tail<kPoseUnknowns>().cwiseMax(0.0).cwiseSqrt();
    out.board_rotation_deviation = sigma.head<3>(), out.board_position_deviation = sigma.tail<3>();
    out.robot_position = bundle.robot_position, out.robot_rotation = bundle.robot_rotation;
  }
  judge(out, evidence, out.robot ? turn_about_others(bundle) : 0.0);
  for (std::size_t c = 0; c < count; ++c) {
    const Bundle& of = placed[c] ? bundle : alone[c].bundle;
    out.pictures.push_back(draw(out_folder, recordings[c], of, placed[c] ? static_cast<int>(c) : 0));
  }
  write_calibration(out_folder, out);
  return out;
}

}  // namespace chainsplat::calibration
