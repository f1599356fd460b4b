// chainsplat/mcap.h - recordings of a rope for Foxglove, rerun and whatever else reads MCAP (formats.md 5.10).
//
// Part of `export`. Messages are Foxglove's, in Protocol Buffers, each described in the file; where Foxglove has none
// they are ours. Frames are "world", "link_0" (the grasp) to "link_n", and the cameras' names. A topic is there from
// its first message on:
//
//   /tf                        foxglove.FrameTransforms   base and links; with the first pose also the cameras
//   /rope/joints               foxglove.JointStates       "theta_1" and so on, rad and rad/s
//   /rope/links                foxglove.PosesInFrame      link frames (mathematics.md 2.2), in the world
//   /rope/centerline           foxglove.SceneUpdate       a line as thick as the rope
//   /rope/points               foxglove.PointCloud        the Gaussians' centers with their colors
//   /rope/wrench               chainsplat.Wrench          of the gripper on the rope, about the grasp
//   /rope/force                chainsplat.Force           of the outside on the rope, with its place and deviation
//   /rope/status               chainsplat.Status          how far an estimate is to be believed
//   /cameras/NAME/calibration  foxglove.CameraCalibration
//   /cameras/NAME/image        foxglove.CompressedImage   JPEG
#pragma once
#include <memory>
#include <string>
#include <vector>
#include "chainsplat/capture.h"
#include "chainsplat/chain.h"
#include "chainsplat/splat.h"
#include "chainsplat/trajectory.h"
#include "chainsplat/twin.h"

namespace chainsplat::exports {

// Written as it grows: what is killed in between loses a second at most, and can be recovered ('mcap recover'). All
// throw WorkError where the file cannot be written, and InputError for times below 0 s, which MCAP does not have.
class McapRecording {
 public:
  McapRecording(const Path& file, const chain::Chain& chain, const std::vector<capture::Camera>& cameras);
  ~McapRecording();
  McapRecording(McapRecording&&) noexcept;

  // Where the rope is at `time`, s. `thetadot` may be empty.
  void pose(double time, const math::Pose& base, const math::VectorX& theta, const math::VectorX& thetadot);
  // The same rope's Gaussians, each on its most probable link, whose material is turned by `roll` (chain::States; may
  // be empty).
  void points(double time, const math::Pose& base, const math::VectorX& theta, const math::VectorX& roll,
              const splat::Gaussians& gaussians);
  // Moment, N m, and force, N, as dynamics::base_wrench() gives them; `known_mass`: else per kilogram of rope.
  void wrench(double time, const math::Vector6& wrench, bool known_mass);
  // N, at a point in the world, m; `sigma`: standard deviations.
  void force(double time, const math::Vector3& point, const math::Vector3& force, const math::Vector3& sigma,
             bool touching, bool known_mass);
  // "following", "doubtful" or "lost"; the centerline's standard deviation, m; from the frame's arrival to its
  // estimate, s.
  void status(double time, const std::string& status, double sigma, double latency);
  // A camera's picture as JPEG; `rectified`: without its lens distortion.
  void picture(double time, int camera, const std::string& jpeg, bool rectified);
  void finish();

 private:
  struct Implementation;
  std::unique_ptr<Implementation> implementation_;
};

// The whole of a motion, in one step as core::write_file(): poses, Gaussians, of an identified twin the wrench of its
// gripper, and every camera's pictures in `capture`, which the twin was made from; empty: none. Throws InputError as
// capture::load().
void write_mcap(const twin::Twin& twin, const chain::States& motion, const trajectory::Trajectory& base,
                const Path& file, const Path& capture);

}  // namespace chainsplat::exports
