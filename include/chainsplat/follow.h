// chainsplat/follow.h - a rope followed frame by frame, and an estimate for each: frames that a program of one's own
// has in memory (Tracker), or those of a capture, a video, a V4L2 device or standard input (Follower).
#pragma once
#include <functional>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "chainsplat/capture.h"
#include "chainsplat/corrections.h"
#include "chainsplat/dynamics.h"

namespace chainsplat::estimation {
struct Estimate;
}
namespace chainsplat::twin {
struct Twin;
}

namespace chainsplat::pipeline {

// One moment. A recorded capture has views, everything else a picture.
struct LiveFrame {
  int frame = 0;
  double time = 0.0;                 // s
  std::vector<capture::View> views;  // undistorted crops with masks, of one camera or several at nearly one time
  capture::Image8 picture;  // whole, RGB as recorded, of the first camera; empty for a capture unless asked for
  double arrived = 0.0;     // core::seconds_now() when it was decoded
};

struct SourceOptions {
  Path source;  // a capture; with `calibration` a video, a device under /dev or "-": Y4M or RGB24 on standard input
  std::string camera;           // of a capture, by its name; empty: all of them together
  Path calibration;             // camera object as in capture.json
  double rate = 0.0;            // frames per second; 0: the calibration's, else the video's
  std::optional<double> start;  // s, of the first frame; none: the calibration's
  bool unix_time = false;       // a device's own stamps in Unix time, in place of `start`
  capture::FrameRange frames;
  bool pictures = false;             // whole frames of a capture too (its first camera)
  capture::Corrections corrections;  // of the cameras and of a capture's base: the twin's, set by the follower
};

struct FrameSource {
  std::vector<capture::Camera> cameras;
  std::vector<char> unverified;                // by camera: the twin was made with another calibration
  std::optional<trajectory::Trajectory> base;  // a capture's own, as the twin corrects it
  bool masked = false;                         // the frames have views
  // The next frame; false at the end. Throws InputError or WorkError where the frames end in another way, Interrupted
  // where a stop is requested while it waits.
  std::function<bool(LiveFrame&)> next;
};

// Throws InputError.
FrameSource open_frames(const SourceOptions& options);

// newton: outlines, then the colors inside them, drawn on the device; silhouette: outlines alone, without a device;
// adam: the paper's, ten Adam steps on the rendering loss from the last frame's angles, without deviations.
enum class Solver { newton, silhouette, adam };

struct TrackerOptions {
  std::optional<Solver> solver;     // none: newton, and silhouette where there is no device
  std::string device;               // Vulkan device, its number or a part of its name; empty: chosen
  std::string name = "the frames";  // whose they are, in messages
};

// Follows a rope through frames that come from anywhere, one moment after the other. One thread at a time.
class Tracker {
 public:
  // `cameras`: as they are believed to be (as_corrected()). `base` is asked at times up to 0.2 s after a
  // frame's own, where it may be as at rest, by any thread; before `start`, s, the rope is taken to rest. `unverified`:
  // by camera, as as_corrected() says; empty: none.
  // Throws InputError for a twin without states or Gaussians that the solver needs, and where there is no such device.
  Tracker(const twin::Twin& twin, const std::vector<capture::Camera>& cameras, dynamics::BaseFunction base,
          double start, const TrackerOptions& options = {}, const std::vector<char>& unverified = {});
  ~Tracker();
  Tracker(Tracker&&) noexcept;
  Tracker& operator=(Tracker&&) noexcept;

  // The next moment, seen by one camera or by several at nearly one time: undistorted crops with their masks
  // (capture::view_of(), View::camera an index into `cameras`). Times increase. Throws InputError where they do not.
  estimation::Estimate update(std::span<const capture::View> views);
  // The view of a whole picture (RGB, as recorded) of the first camera, for update(): its mask is made here, from the
  // twin's colors, or from what is not black where the first picture was masked before.
  capture::View mask(const capture::Image8& picture, double time);
  // What the next frame would have to wait for and can be done before it comes: drawing the rope for its marks, in
  // every tenth frame, and, with the time of the next frame, s, the rope's motion until then. Give that time where it
  // is known to a microsecond and the base's motion until then is known already. Calling it is not needed.
  void between_frames(std::optional<double> next = {});

  const twin::Twin& twin() const;
  const dynamics::Model& model() const;
  trajectory::BaseMotion base_at(double time) const;  // as it is believed to move
  std::vector<capture::Finding> findings() const;     // what was given wrongly, as far as it is known by now
  const std::vector<capture::Camera>& cameras() const;

 private:
  struct Implementation;
  std::unique_ptr<Implementation> implementation_;
};
// Cameras as they were given, with what the twin knows of them. `unverified`, if not null, gets by camera whether the
// twin was made with another calibration, which then stays as it is.
std::vector<capture::Camera> as_corrected(const capture::Corrections& corrections, std::vector<capture::Camera> cameras,
                                          std::vector<char>* unverified = nullptr);

struct FollowOptions {
  SourceOptions source;
  Path base;                     // base motion, TUM; empty: the capture's, else at rest
  std::optional<Solver> solver;  // none: newton, and silhouette where there is no device
  int drop = 1;                  // every n-th frame is used
  std::string device;            // Vulkan device, its number or a part of its name; empty: chosen

  void check() const;
};

// What one frame came to.
struct Followed {
  const LiveFrame& frame;
  const std::vector<capture::View>& views;  // what was looked at: the frame's own, or made of its picture
  const estimation::Estimate& estimate;
  double latency;  // s, from the decoded frame until now
};

class Follower {
 public:
  // The twin in `run`, the source and the device, all of them opened and checked.
  Follower(const Path& run, const FollowOptions& options);
  ~Follower();
  // Frame by frame until the source ends; `each` is called after every one. Throws Interrupted where a stop is
  // requested.
  void follow(const std::function<void(const Followed&)>& each);

  const twin::Twin& twin() const;
  const dynamics::Model& model() const;
  const trajectory::Trajectory& base() const;         // a capture's own as the twin corrects it, another as given
  trajectory::BaseMotion base_at(double time) const;  // as it is believed to move
  std::vector<capture::Finding> findings() const;     // what was given wrongly, as far as it is known by now
  const std::vector<capture::Camera>& cameras() const;

 private:
  struct Implementation;
  std::unique_ptr<Implementation> implementation_;
};

}  // namespace chainsplat::pipeline
