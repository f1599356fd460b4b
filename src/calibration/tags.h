// src/calibration/tags.h - finding a board's tags in an image, with their edges to a fraction of a pixel.
#pragma once
#include <array>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "chainsplat/calibration.h"

namespace chainsplat::calibration {

struct Gray {
  int width = 0, height = 0;
  std::vector<std::uint8_t> pixels;
};
Gray gray(const capture::Image8& image);

// The black and white cells of a tag36h11, kCells x kCells by rows from the upper left, its black border among them.
constexpr int kCells = 8;
std::array<bool, kCells * kCells> black_cells(int id);
int tags_in_family();

// One tag in an image. Points lie on the border of its black square, in recorded pixels; edge k leads from corner k to
// corner k + 1.
struct Tag {
  int id = 0;
  std::array<math::Vector2, 4> rough;               // the corners as the detector has them, px
  std::array<std::vector<math::Vector2>, 4> edges;  // empty where the edge is not sharp enough
};
// Tags of the board, in the order of their numbers; one that is seen twice is left out. Adds the numbers of tags of the
// family that the board does not have to `others`.
std::vector<Tag> find_tags(const Gray& image, const Board& board, std::map<int, int>& others);
// Families other than tag36h11 of which there are tags in the image, for messages: "tag25h9 (3, 7)".
std::vector<std::string> other_families(const Gray& image);

// Where the lines through a tag's edges meet. Edges are straight without lens distortion, so the points are freed of
// it and the corners distorted again.
struct Corner {
  math::Vector2 pixel;     // recorded
  double deviation = 0.0;  // px, of each coordinate, by the scatter of the points about their lines
};
std::optional<std::array<Corner, 4>> corners(const Tag& tag, const capture::Camera& lens);

}  // namespace chainsplat::calibration
