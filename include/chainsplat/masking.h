// chainsplat/masking.h - object masks without prompts or a model file (INTERFACE 1, mask).
//
// What is known does most of the work: the rope is a tube of known length and diameter that begins at the base's pose,
// seen by known cameras. In some moments a chain is grown from the grasp so that its tube best parts the colors inside
// from those beside it, in all cameras together; nothing need move for that. The tubes say what colors the rope and its
// surroundings have and what the background is; a graph cut in a band about the tube decides each pixel from votes -
// color, difference from the background, place, and whether the picture changes at the tube's outline at all or
// something hides it - with contours where the picture has edges. The masks give a better chain (silhouette.h), that
// better masks. A gripper, a finger or a shadow is not tube, not the rope's color, or both.
//
// Pictures are undistorted pixels unless a function says otherwise. Nothing here depends on time or threads.
#pragma once
#include <functional>
#include <optional>
#include <vector>

#include "chainsplat/capture.h"
#include "chainsplat/chain.h"

namespace chainsplat::masking {

// Log odds (natural) of a color for the rope against what surrounds it: 32 steps a channel, index (r, g, b) / 8.
struct Colors {
  std::vector<double> object, surroundings;  // pixels counted, 32^3; empty: nothing known
  std::vector<float> log_odds;               // 32^3, from the counts by settle()
  double usual = 0.0, separation = 0.0;      // mean log odds of the object's pixels; less that of the surroundings'
};
// Makes log_odds from the counts, smoothed, so that near colors speak for each other.
void settle(Colors& colors);

// What a camera sees behind the rope.
struct Background {
  std::vector<std::uint8_t> rgb;    // 3 * width * height
  std::vector<std::uint8_t> noise;  // width * height: standard deviation, gray levels; 0: not known here
};

// What the rope looks like along and across, as one camera sees it: while it does not turn about itself every mark
// stays at its arclength and side.
struct Marks {
  int along = 0, across = 0;      // cells; 0: nothing known
  double step = 0.0;              // m, of a cell along
  std::vector<std::uint8_t> rgb;  // 3 * along * across
  std::vector<char> known;        // along * across
};

// How one camera tells the rope from the rest.
struct Look {
  Colors near, far;  // the rope's half at the grasp and that at the free end, whose tip may look different
  Background background;
  Marks marks;
};

// The mask of one picture, 255 or 0: RGB or RGBA pixels of the camera's size, row-major. With `theta` the chain is
// thought to be there, to within about half a diameter; without, colors and background decide alone, as far as the rope
// can reach. `doubt`: times the usual doubt about the place.
// Returned as a crop whose RGB is that of the picture inside the mask; empty (width 0) when there is none.
struct Picture {
  const std::uint8_t* pixels = nullptr;
  int width = 0, height = 0, channels = 3;
};
capture::View cut(const Look& look, const Picture& picture, const capture::Camera& camera, const chain::Chain& chain,
                  const math::Pose& base, const std::optional<math::VectorX>& theta, double doubt = 1.0);

struct Options {
  int first = 0, last = -1;  // frames [first, last), last < 0: to the end, of each camera
};

// A mask of one frame in recorded pixels, one channel, 0 or 255.
using Sink = std::function<void(int camera, int frame, const capture::Image8& mask)>;

struct Summary {
  int frames = 0;     // of all cameras
  int empty = 0;      // masks in which nothing was found
  double inside = 0;  // share of the chain's centerline that lies in the masks, mean; low: hidden, or masks are wrong
};

// Masks of a whole capture, by camera, then frame; masks that it has are not looked at.
// Throws InputError when the capture is no good, has no frames or nothing like a rope is found at the grasp.
Summary make(const Path& capture, const Options& options, const Sink& sink);

// Masks while the rope is being followed. Learns as it goes: the background where the rope is not, and the colors of
// what is masked.
struct Live {
  capture::Camera camera;  // as recorded
  chain::Chain chain;
  Look look;
  std::vector<float> mean, variance;   // of the background, by channel and by pixel
  std::vector<std::uint16_t> seen;     // frames in which the background was seen, by pixel
  std::vector<double> given;           // counts of the colors given at the start
  std::vector<std::uint8_t> straight;  // work space: the frame without its lens distortion, and by pixel
  std::vector<std::int16_t> from;      // where that comes from: column and row of the recorded frame,
  std::vector<std::uint16_t> part;     // and the share of the next ones, as cv::remap has it
  int frames = 0;
};

// `object_rgb`: colors of the rope, 0..255, three a sample (of a twin: its Gaussians', of a capture: its masks').
Live start(const capture::Camera& camera, const chain::Chain& chain, const std::vector<std::uint8_t>& object_rgb);
// The rope's marks as a drawn picture of it at these angles shows them (an undistorted crop with its coverage): what
// hides the rope has not these.
void learn_marks(Live& live, const capture::View& drawn, const math::Pose& base, const math::VectorX& theta);
// A recorded frame -> the undistorted crop with its mask. `theta`: where the rope is expected; none when that is not
// known (the first frame, or lost).
capture::View mask(Live& live, const capture::Image8& recorded_rgb, const math::Pose& base,
                   const std::optional<math::VectorX>& theta);

}  // namespace chainsplat::masking
