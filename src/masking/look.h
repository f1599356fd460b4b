// Colors and background of one camera: learned from frames, asked by pixel.
#pragma once
#include <span>

#include "chainsplat/masking.h"
#include "src/masking/tube.h"

namespace chainsplat::masking {

constexpr int kColorBins = 32 * 32 * 32;
inline int color_bin(const std::uint8_t* rgb) { return (rgb[0] >> 3) << 10 | (rgb[1] >> 3) << 5 | rgb[2] >> 3; }

inline const std::uint8_t* pixel(const Picture& picture, int x, int y) {
  return picture.pixels +
         static_cast<std::size_t>(picture.channels) * (static_cast<std::size_t>(y) * picture.width + x);
}

// What pixels the rope can reach at all: nearer to the grasp than its length, and not behind the grasp.
struct Reach {
  Box box;
  math::Vector2 grasp, along;  // px; unit, or zero where the rope points at the camera
  double radius = 0.0, behind = 0.0;
  bool holds(int x, int y) const {
    const math::Vector2 d(x + 0.5 - grasp.x(), y + 0.5 - grasp.y());
    return d.squaredNorm() <= radius * radius && d.dot(along) >= -behind;
  }
};
Reach reach(const chain::Chain& chain, const math::Pose& base, const capture::Camera& camera);

// The rope's marks: medians of the frames' colors, so that what hides the rope for less than half of them does not
// count.
Marks marks(std::span<const Picture> frames, std::span<const Tube> tubes, const chain::Chain& chain);
// Those of one picture, where it shows something (alpha).
Marks marks(const capture::View& drawn, const Tube& tube, const chain::Chain& chain);
// Whether a pixel inside the tube has the color that is usual there, in more or less light; true where that is not
// known.
bool usual(const Marks& marks, const Tube& tube, const Picture& picture, int x, int y);

// Adds the pixels of a frame where the tube is known: its core as object, what is about it, as far as its map goes, as
// surroundings. `margin`: px on either side of the tube's outline where that is not sure. `mask`: of the core only
// what it holds; of that what has the rope's marks, where they are known (a hand may hide the rope). Nothing of the
// rope's first diameter: the gripper hides it.
void count_colors(Look& look, const Picture& picture, const Tube& tube, const Reach& where, const chain::Chain& chain,
                  double margin, const capture::View* mask = nullptr);

// Median of the frames, where at least `least` of them show the background. `covered[i]`: tube of frame i, empty when
// not known.
Background median_background(std::span<const Picture> frames, std::span<const Tube> covered, int least);

// Noise as Background keeps it, gray levels.
std::uint8_t noise_level(double deviation);

// Log odds, rope against background, of a pixel for the difference from the background; 0 where it is not known.
double difference_odds(const Background& background, const Picture& picture, int x, int y);
double color_odds(const Colors& colors, const std::uint8_t* rgb);
void settle(Look& look);

}  // namespace chainsplat::masking
