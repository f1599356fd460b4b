// The user's help, checked against the capture: cameras by number, places in undistorted pixels.
#pragma once
#include <optional>
#include <string>
#include <vector>

#include "chainsplat/masking.h"
#include "src/masking/tube.h"

namespace chainsplat::masking {

struct Help {
  struct Point {
    int camera = 0, frame = 0;
    math::Vector2 at, recorded;  // the same place in undistorted and in recorded pixels
    std::string text;            // as it was given
  };
  struct Region {
    int camera = 0;
    std::optional<int> frame;  // none: all
    math::Rectangle box;
  };
  std::vector<Point> points;
  std::vector<Region> boxes;
  std::vector<std::optional<capture::Image8>> empty;  // by camera

  bool points_at(int camera, int frame) const { return !points_in(camera, frame).empty(); }
  std::vector<math::Vector2> points_in(int camera, int frame) const;  // undistorted
  const capture::Image8* empty_of(int camera) const { return empty[camera] ? &*empty[camera] : nullptr; }
};

// `first`: the frame that a point without one is in. Throws InputError as masking.h says of Hints.
Help help_of(const Hints& hints, const capture::Capture& scene, int first);
// Warns of points that this frame's mask, in recorded pixels, does not run through.
void warn_of_missed_points(const Help& help, int camera, int frame, const capture::Image8& mask);

}  // namespace chainsplat::masking
