// The colors, marks and background of one camera: learned from frames, evaluated per pixel.
#pragma once
#include <algorithm>
#include <cstdint>
#include <span>

#include "chainsplat/capture.h"
#include "chainsplat/chain.h"
#include "src/masking/tube.h"

namespace chainsplat::masking {

// An image of the camera's size, RGB or RGBA, row-major; the pixels are not owned.
struct Picture {
  const std::uint8_t* pixels = nullptr;
  int width = 0, height = 0, channels = 3;
};

// Natural log odds of a color for the rope against its surroundings, on a grid of 32 steps per channel with index
// (r, g, b) / 8.
struct Colors {
  std::vector<double> object, surroundings;  // numbers of pixels, 32^3; empty: nothing known
  std::vector<float> log_odds;               // 32^3, computed from the counts by settle()
  double usual = 0.0, separation = 0.0;      // mean log odds of the object's pixels; that minus the surroundings' mean
};

// The picture of one camera without the rope.
struct Background {
  std::vector<std::uint8_t> rgb;    // 3 * width * height
  std::vector<std::uint8_t> noise;  // width * height, standard deviation in gray levels; 0: background unknown here
};

// The rope's colors along and across as one camera sees it. While the rope does not turn about itself, every mark stays
// at its arclength and side.
struct Marks {
  int along = 0, across = 0;      // numbers of cells; 0: nothing known
  double step = 0.0;              // m, length of a cell along the rope
  std::vector<std::uint8_t> rgb;  // 3 * along * across
  std::vector<char> known;        // along * across
};

// What distinguishes the rope from everything else for one camera.
struct Look {
  Colors near, far;  // of the rope's half at the grasp and of that at the free end, whose tip may differ in color
  Background background;
  Marks marks;
};

constexpr int kColorBins = 32 * 32 * 32;
inline int color_bin(const std::uint8_t* rgb) { return (rgb[0] >> 3) << 10 | (rgb[1] >> 3) << 5 | rgb[2] >> 3; }

inline const std::uint8_t* pixel(const Picture& picture, int x, int y) {
  return picture.pixels +
         static_cast<std::size_t>(picture.channels) * (static_cast<std::size_t>(y) * picture.width + x);
}

// The pixels that the rope can reach at all: nearer to the grasp than its length, and not behind the grasp.
struct Reach {
  math::Rectangle box;
  math::Vector2 grasp, along;         // px; unit, or zero where the rope points at the camera
  double radius = 0.0, behind = 0.0;  // px around the grasp, and px against `along`
  bool holds(int x, int y) const {
    const math::Vector2 d(x + 0.5 - grasp.x(), y + 0.5 - grasp.y());
    return d.squaredNorm() <= radius * radius && d.dot(along) >= -behind;
  }
};
Reach reach(const chain::Chain& chain, const math::Pose& base, const capture::Camera& camera);

// Returns the rope's marks as medians over the frames, so that what hides the rope in less than half of them does not
// count.
Marks marks(std::span<const Picture> frames, std::span<const Tube> tubes, const chain::Chain& chain);
// Returns the marks of one drawn picture, where its alpha is nearly opaque.
Marks marks(const capture::View& drawn, const Tube& tube, const chain::Chain& chain);
// Returns whether a pixel inside the tube has the usual color of its place, in more or less light; true where that
// color is unknown.
bool usual(const Marks& marks, const Tube& tube, const Picture& picture, int x, int y);

// Counts the pixels of a frame in which the tube is known: those inside it as object, those around it, within the reach
// of its distance map, as surroundings. `margin`: px on either side of the outline that are left out as uncertain. Of
// the inside only pixels in the `mask`, if there is one, and with the rope's marks, where these are known, count,
// because a hand may hide the rope; the rope's first diameter never counts, because the gripper hides it.
void count_colors(Look& appearance, const Picture& picture, const Tube& tube, const Reach& where,
                  const chain::Chain& chain, double margin, const capture::View* mask = nullptr);

// Returns the median of the frames where at least `least` of them show the background. `covered[i]`: tube of frame i,
// empty when unknown.
Background median_background(std::span<const Picture> frames, std::span<const Tube> covered, int least);

// Returns the background that one picture of the scene without the rope shows, with the exposure of `now`, which shows
// the rope: cameras choose it anew.
Background empty_scene(const capture::Image8& empty, const Picture& now);
// Returns `now` without what the empty scene shows, for the search from scratch: differences by channel, magnified,
// RGB.
capture::Image8 difference(const capture::Image8& empty, const Picture& now);

// Returns a standard deviation in gray levels as Background stores it.
inline std::uint8_t noise_level(double deviation) {
  constexpr double kLeast = 1.5, kMost = 25.0;  // gray levels
  return static_cast<std::uint8_t>(std::clamp(deviation, kLeast, kMost) + 0.5);
}

// Returns a pixel's log odds for the rope from its difference from the background; 0 where the background is unknown.
double difference_odds(const Background& background, const Picture& picture, int x, int y);
double color_odds(const Colors& colors, const std::uint8_t* rgb);
// Computes log_odds from the counts, smoothed over neighboring colors.
void settle(Colors& colors);
void settle(Look& appearance);

}  // namespace chainsplat::masking
