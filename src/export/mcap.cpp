#include "chainsplat/mcap.h"

#include <unistd.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <functional>
#include <limits>
#include <map>

#include "chainsplat/corrections.h"
#include "chainsplat/dynamics/base_wrench.h"
#include "chainsplat/encode.h"
#include "chainsplat/export.h"
#include "foxglove.h"
#include "mcap_file.h"
#include "parts.h"
#include "protobuf.h"

namespace chainsplat::exports {

namespace {

using math::Pose;
using math::Vector3;
using math::VectorX;
using protobuf::Message;

constexpr const char* kWorld = "world";
constexpr double kPixelCenter = 0.5;  // px: ours of pixel (0, 0); by OpenCV, ROS and Foxglove it is 0

std::uint64_t nanoseconds(double time) {
  if (!(time >= 0.0))
    throw InputError("time " + std::to_string(time) + " s", "is before 0, which MCAP does not have",
                     "shift the recording's and the base's times");
  return static_cast<std::uint64_t>(std::llround(1e9 * time));
}

Message stamp(std::uint64_t time) {
  constexpr std::uint64_t kSecond = 1'000'000'000;
  return Message().integer(1, time / kSecond).integer(2, time % kSecond);
}

Message vector(const Vector3& v) { return Message().number(1, v.x()).number(2, v.y()).number(3, v.z()); }

Message quaternion(const math::Matrix3& rotation) {
  const Eigen::Quaterniond q(rotation);
  return Message().number(1, q.x()).number(2, q.y()).number(3, q.z()).number(4, q.w());
}

Message pose_message(const Pose& pose) {
  return Message().message(1, vector(pose.translation)).message(2, quaternion(pose.rotation));
}

Message transform(std::uint64_t time, const std::string& parent, const std::string& child, const Pose& pose) {
  return Message()
      .message(1, stamp(time))
      .bytes(2, parent)
      .bytes(3, child)
      .message(4, vector(pose.translation))
      .message(5, quaternion(pose.rotation));
}

std::string link_name(std::size_t link) { return "link_" + std::to_string(link); }

const char* unit(bool known_mass) { return known_mass ? "N" : "N/kg"; }

Message calibration(std::uint64_t time, const capture::Camera& camera, bool rectified) {
  const double cx = camera.cx - kPixelCenter, cy = camera.cy - kPixelCenter;
  std::vector<double> lens(camera.distortion.begin(), camera.distortion.end());
  if (rectified) lens.assign(lens.size(), 0.0);
  return Message()
      .message(1, stamp(time))
      .fixed(2, static_cast<std::uint32_t>(camera.width))
      .fixed(3, static_cast<std::uint32_t>(camera.height))
      .bytes(4, "plumb_bob")
      .numbers(5, lens)
      .numbers(6, {camera.fx, 0, cx, 0, camera.fy, cy, 0, 0, 1})
      .numbers(7, {1, 0, 0, 0, 1, 0, 0, 0, 1})
      .numbers(8, {camera.fx, 0, cx, 0, 0, camera.fy, cy, 0, 0, 0, 1, 0})
      .bytes(9, camera.name);
}

}  // namespace

struct McapRecording::Implementation {
  McapFile file;
  chain::Chain chain;
  std::vector<capture::Camera> cameras;
  std::vector<char> calibrated;  // by camera: its calibration is written
  std::map<std::string, std::uint16_t> topics;
  bool cameras_placed = false;

  void write(const std::string& topic, const char* schema, std::uint64_t time, const Message& message) {
    auto known = topics.find(topic);
    if (known == topics.end())
      known = topics.emplace(topic, file.add_topic(topic, schema, foxglove_descriptors())).first;
    file.write(known->second, time, message.text());
  }
};

McapRecording::McapRecording(const Path& file, const chain::Chain& chain, const std::vector<capture::Camera>& cameras)
    : implementation_(
          new Implementation{McapFile(file), chain, cameras, std::vector<char>(cameras.size(), 0), {}, false}) {}
McapRecording::~McapRecording() = default;
McapRecording::McapRecording(McapRecording&&) noexcept = default;

void McapRecording::pose(double seconds, const Pose& base, const VectorX& theta, const VectorX& thetadot) {
  Implementation& i = *implementation_;
  const std::uint64_t time = nanoseconds(seconds);
  const std::vector<Pose> local = local_poses(i.chain, theta, {}, base);
  Message transforms, links, joints, line, entity;
  if (!i.cameras_placed)
    for (const capture::Camera& camera : i.cameras)
      transforms.message(1, transform(time, kWorld, camera.name, camera.world_from_camera));
  i.cameras_placed = true;
  links.message(1, stamp(time)).bytes(2, kWorld);
  Pose world;
  for (std::size_t j = 0; j < local.size(); ++j) {
    transforms.message(1, transform(time, j == 0 ? kWorld : link_name(j - 1), link_name(j), local[j]));
    world = world * local[j];
    links.message(3, pose_message(world));
  }
  joints.message(1, stamp(time));
  for (Eigen::Index k = 0; k < theta.size(); ++k) {
    Message joint;
    joint.bytes(1, "theta_" + std::to_string(k + 1)).number(2, theta[k]);
    if (thetadot.size() == theta.size()) joint.number(3, thetadot[k]);
    joints.message(2, joint);
  }
  line.number(3, i.chain.diameter);
  const math::MatrixX nodes = chain::nodes(i.chain, chain::link_motions(i.chain, theta, base));
  for (Eigen::Index k = 0; k < nodes.cols(); ++k) line.message(5, vector(nodes.col(k)));
  constexpr double kGray = 0.7;
  line.message(6, Message().number(1, kGray).number(2, kGray).number(3, kGray).number(4, 1.0));
  entity.message(1, stamp(time)).bytes(2, kWorld).bytes(3, "rope").message(11, line);
  i.write("/tf", kFrameTransforms, time, transforms);
  i.write("/rope/joints", kJointStates, time, joints);
  i.write("/rope/links", kPosesInFrame, time, links);
  i.write("/rope/centerline", kSceneUpdate, time, Message().message(2, entity));
}

void McapRecording::points(double seconds, const Pose& base, const VectorX& theta, const VectorX& roll,
                           const splat::Gaussians& gaussians) {
  constexpr std::uint64_t kUint8 = 1, kFloat32 = 7;  // of PackedElementField.NumericType
  const std::uint64_t time = nanoseconds(seconds);
  const std::vector<Pose> motions = chain::material_motions(implementation_->chain, theta, roll, base);
  std::string data;
  for (int i = 0; i < gaussians.count; ++i) {
    const Vector3 home(gaussians.mean[3 * i], gaussians.mean[3 * i + 1], gaussians.mean[3 * i + 2]);
    const Vector3 point = motions[surest_link(gaussians, i)] * home;
    for (const double x : point) put(data, static_cast<float>(x));
    const double alpha = 1.0 / (1.0 + std::exp(-static_cast<double>(gaussians.opacity_logit[i])));
    for (const double x : splat::base_color(gaussians, i)) put(data, static_cast<std::uint8_t>(std::lround(255.0 * x)));
    put(data, static_cast<std::uint8_t>(std::lround(255.0 * alpha)));
  }
  Message cloud;
  cloud.message(1, stamp(time)).bytes(2, kWorld).message(3, pose_message({})).fixed(4, 3 * sizeof(float) + 4);
  std::uint32_t offset = 0;
  for (const char* const name : {"x", "y", "z", "red", "green", "blue", "alpha"}) {
    const bool number = offset < 3 * sizeof(float);
    cloud.message(5, Message().bytes(1, name).fixed(2, offset).integer(3, number ? kFloat32 : kUint8));
    offset += number ? sizeof(float) : 1;
  }
  implementation_->write("/rope/points", kPointCloud, time, cloud.bytes(6, data));
}

void McapRecording::wrench(double seconds, const math::Vector6& wrench, bool known_mass) {
  const std::uint64_t time = nanoseconds(seconds);
  implementation_->write("/rope/wrench", kWrench, time,
                         Message()
                             .message(1, stamp(time))
                             .bytes(2, kWorld)
                             .message(3, vector(wrench.tail<3>()))
                             .message(4, vector(wrench.head<3>()))
                             .bytes(5, unit(known_mass)));
}

void McapRecording::force(double seconds, const Vector3& point, const Vector3& force, const Vector3& sigma,
                          bool touching, bool known_mass) {
  const std::uint64_t time = nanoseconds(seconds);
  implementation_->write("/rope/force", kForce, time,
                         Message()
                             .message(1, stamp(time))
                             .bytes(2, kWorld)
                             .message(3, vector(point))
                             .message(4, vector(force))
                             .message(5, vector(sigma))
                             .integer(6, touching)
                             .bytes(7, unit(known_mass)));
}

void McapRecording::status(double seconds, const std::string& status, double sigma, double latency) {
  const std::uint64_t time = nanoseconds(seconds);
  implementation_->write("/rope/status", kStatus, time,
                         Message().message(1, stamp(time)).bytes(2, status).number(3, sigma).number(4, latency));
}

void McapRecording::picture(double seconds, int camera, const std::string& jpeg, bool rectified) {
  Implementation& i = *implementation_;
  const std::uint64_t time = nanoseconds(seconds);
  const capture::Camera& of = i.cameras.at(camera);
  const std::string topic = "/cameras/" + of.name;
  if (!i.calibrated[camera])
    i.write(topic + "/calibration", kCameraCalibration, time, calibration(time, of, rectified));
  i.calibrated[camera] = 1;
  i.write(topic + "/image", kCompressedImage, time,
          Message().message(1, stamp(time)).bytes(2, jpeg).bytes(3, "jpeg").bytes(4, of.name));
}

void McapRecording::finish() { implementation_->file.finish(); }

namespace {

// Calls use(time, camera, JPEG) for the pictures of a capture, in the order of their times.
void for_each_picture(const Path& capture, const capture::Capture& facts,
                      const std::function<void(double, int, const std::string&)>& use) {
  constexpr int kQuality = 85;  // of JPEG
  struct Camera {
    capture::FrameReader reader;
    std::optional<capture::Frame> next;
  };
  std::vector<Camera> cameras;
  for (const capture::Camera& camera : facts.cameras) {
    cameras.push_back({{capture, camera.name, {}, capture::Pixels::recorded}, {}});
    cameras.back().next = cameras.back().reader.next();
  }
  for (;;) {
    core::stop_if_requested();
    int first = -1;
    double earliest = std::numeric_limits<double>::infinity();
    for (int c = 0; c < static_cast<int>(cameras.size()); ++c)
      if (const auto& next = cameras[c].next; next && facts.times[c][next->frame] < earliest)
        first = c, earliest = facts.times[c][next->frame];
    if (first < 0) return;
    use(earliest, first, capture::jpeg(cameras[first].next->picture, kQuality));
    cameras[first].next = cameras[first].reader.next();
  }
}

}  // namespace

void write_mcap(const twin::Twin& twin, const chain::States& motion, const trajectory::Trajectory& base,
                const Path& file, const Path& capture) {
  capture::Capture facts;
  if (!capture.empty()) {
    capture::LoadOptions load;
    load.images = false;
    facts = capture::load(capture, load);
    capture::apply(twin.corrections, facts);
  }
  std::vector<math::Vector6> wrenches;
  if (twin.parameters && motion.thetadot.size() == motion.time.size())
    wrenches = dynamics::base_wrenches(dynamics::make_model(twin.chain, *twin.parameters), base, motion);
  const Path temporary = file.string() + ".tmp" + std::to_string(::getpid());
  std::error_code error;
  try {
    McapRecording recording(temporary, twin.chain, facts.cameras);
    std::size_t next = 0;
    const auto states_until = [&](double time) {
      for (; next < motion.time.size() && motion.time[next] <= time; ++next) {
        const double t = motion.time[next];
        const math::Pose at = base.samples().empty() ? Pose{} : base.pose(t);
        recording.pose(t, at, motion.theta[next], motion.thetadot.empty() ? VectorX() : motion.thetadot[next]);
        if (twin.gaussians.count > 0)
          recording.points(t, at, motion.theta[next], chain::roll_at(motion, t), twin.gaussians);
        if (!wrenches.empty()) recording.wrench(t, wrenches[next], twin.known_mass);
      }
    };
    if (!capture.empty())
      for_each_picture(capture, facts, [&](double time, int camera, const std::string& jpeg) {
        states_until(time);
        recording.picture(time, camera, jpeg, false);
      });
    states_until(std::numeric_limits<double>::infinity());
    recording.finish();
    std::filesystem::rename(temporary, file);
  } catch (const std::filesystem::filesystem_error&) {
    std::filesystem::remove(temporary, error);
    throw WorkError(file.string(), "cannot be written", "check the folder and the free space");
  } catch (...) {
    std::filesystem::remove(temporary, error);
    throw;
  }
}

}  // namespace chainsplat::exports
