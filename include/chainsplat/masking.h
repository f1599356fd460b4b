// chainsplat/masking.h - object masks without prompts or a model file (formats.md 1.5, mask): whole images and the
// base's pose in, masks of the rope out, for a whole capture or live.
//
// The method uses that the rope is a tube of known length and diameter that begins at the base's pose, seen by known
// cameras. In some moments a chain is grown from the grasp so that its tube best separates the colors inside from those
// on either side, in all cameras together; nothing need move for that. These tubes show the colors of the rope and of
// its surroundings. Of a video they also show the background: a graph cut in a band around the tube then labels each
// pixel from log odds of color, difference from the background and place, and of whether the picture changes at the
// tube's outline at all or something hides the rope, with contours along the picture's edges. The masks give a better
// chain (silhouette.h), and that gives better masks. A gripper, a finger or a shadow is outside the tube, unlike the
// rope in color, or both. A few stills have no such background: there the mask is the best pair of outlines along the
// chain (src/masking/ribbon.h). Every mask gets a score.
//
// Pictures are in undistorted pixels unless a function says otherwise. Results do not depend on time or threads.
#pragma once
#include <functional>
#include <memory>
#include <optional>
#include <vector>

#include "chainsplat/capture.h"
#include "chainsplat/chain.h"

namespace chainsplat::masking {

// Help by the user: cameras by name, places in recorded pixels.
struct PointHint {
  std::string camera;
  std::optional<int> frame;  // none: the first that a mask is made of
  double x = 0.0, y = 0.0;   // lies on the rope
};
struct BoxHint {
  std::string camera;
  std::optional<int> frame;                       // none: all
  double x0 = 0.0, y0 = 0.0, x1 = 0.0, y1 = 0.0;  // opposite corners, finite; the rope lies between them
};
struct EmptyScene {
  std::string camera;
  Path picture;  // as recorded, without the rope; its exposure may be another one
};

// What does not fit the capture is an InputError: it names the hint as `point`, `box` or `empty`, or the picture's
// file.
struct Hints {
  std::vector<PointHint> points = {};
  std::vector<BoxHint> boxes = {};
  std::vector<EmptyScene> empty = {};
  bool any() const { return !(points.empty() && boxes.empty() && empty.empty()); }
};

// Receives the mask of one frame in recorded pixels, one channel, 0 or 255, and its score, 0 to 1: how much the picture
// shows one rope there, from the grasp to its end, judged from the picture's own edges and colors. Masks with a score
// below kDoubtful are probably wrong (IoU below 0.8).
constexpr double kDoubtful = 0.85;
using Sink = std::function<void(int camera, int frame, const capture::Image8& mask, double score)>;

struct Summary {
  int frames = 0;     // of all cameras
  int empty = 0;      // number of masks in which nothing was found
  double inside = 0;  // mean share of the chain's centerline that lies in the masks; low: hidden, or masks are wrong
  math::Vector3 grasp = math::Vector3::Zero();  // m, base frame: by how much the grasp is off, at most; stills only
};

// Makes the masks of these frames of a capture, by camera, then by frame; masks that it has are ignored. At most eight
// frames a camera are stills: they have no background to learn and no motion to smooth. Each is judged by itself, from
// its outlines too, the grasp may be off by 1 cm, and the rope hangs at rest.
// Throws InputError when the capture is unusable, has no frames, or shows nothing like the rope at the grasp.
Summary make(const Path& capture, const capture::FrameRange& frames, const Hints& hints, const Sink& sink);

// One picture of a contact sheet: as recorded, RGB, with its mask.
struct PreviewTile {
  std::string camera;
  int frame = 0;
  capture::Image8 picture, mask;
  std::optional<double> score;
};
// Returns the pictures side by side, each at most 640 px wide, with the mask's outline and the score.
capture::Image8 contact_sheet(const std::vector<PreviewTile>& tiles);

// What is known of a rope whose angles are unknown.
struct LiveStart {
  math::VectorX resting;         // rad, how it hangs or lies if nobody has touched it; empty: not known
  double grasp_deviation = 0.0;  // m, by which it may seem to begin beside the base, since the camera stands elsewhere
};

// Masks of one camera's frames as they come, while the rope is followed. It learns the background where the rope is
// not, and the colors of what is masked, in a thread of its own, which the next call waits for.
class LiveMasks {
 public:
  static constexpr int kBackgroundFrames = 8;  // before a background pixel is believed; until then colors alone decide
  // `camera`: as recorded, with its lens distortion. `object_rgb`: colors of the rope, 0..255, three numbers per sample
  // (those of a twin's Gaussians, or of a capture's masks).
  LiveMasks(const capture::Camera& camera, const chain::Chain& chain, const std::vector<std::uint8_t>& object_rgb);
  ~LiveMasks();
  // Learns the rope's marks, which nothing that hides it has, from a drawn picture of the rope at these angles (an
  // undistorted crop with its coverage as alpha). `base`: world_from_base.
  void learn_marks(const capture::View& drawn, const math::Pose& base, const math::VectorX& theta);
  // Tells where the camera is believed to stand from now on: at first, as it was given.
  void see_from(const math::Pose& world_from_camera);
  // Tells before the next frame comes where mask() will be asked to look, which then has less to do.
  void expect(const math::Pose& base, const math::VectorX& theta);
  // Returns the undistorted crop of a recorded frame (RGB, of the camera's size) with its mask; an empty view (width 0)
  // where nothing is found. `theta`: the expected angles; none where they are unknown (in the first frame, or when the
  // rope is lost): the rope is then found by what `start` knows of it.
  capture::View mask(const capture::Image8& recorded, const math::Pose& base, const std::optional<math::VectorX>& theta,
                     const LiveStart& start = {});
  int frames() const;  // that were masked

 private:
  struct State;
  std::unique_ptr<State> state_;
};

}  // namespace chainsplat::masking
