// What a fit needs of one mask: blobs, sampled pixels and sub-pixel edge points with normals, computed once a view.
#pragma once
#include <cstdint>
#include <vector>

#include "chainsplat/capture.h"

namespace chainsplat::silhouette {

using math::Vector2;

// A point of the mask's outline, where coverage crosses one half between two neighboring pixels.
struct Edge {
  Vector2 point;        // px
  Vector2 outward;      // unit normal of the outline, from the mask to the outside
  double weight = 0.0;  // length of outline it stands for, px (1 to sqrt 2)
};

// A connected part of a mask (8-neighborhood). Ranges of MaskPoints::pixels and ::edges, [begin, end).
struct Blob {
  int area = 0;  // px
  int first_pixel = 0, last_pixel = 0;
  int first_edge = 0, last_edge = 0;
};

struct MaskPoints {
  std::vector<Blob> blobs;      // by area, largest first; specks are left out
  std::vector<Vector2> pixels;  // px, centers of evenly chosen mask pixels
  std::vector<Edge> edges;
  int area = 0;  // px, all blobs
  // The crop, to look up single pixels.
  int x0 = 0, y0 = 0, width = 0, height = 0;
  struct Run {  // pixels [begin, end) of a row that belong to one blob
    int begin = 0, end = 0, blob = 0;
  };
  std::vector<Run> runs;       // row by row, from left to right
  std::vector<int> first_run;  // of every row, and of one more; empty without a mask

  // Blob number at an image position, -1 outside the mask or the crop.
  int blob_at(const Vector2& pixel) const;
};

MaskPoints mask_points(const capture::View& view, const capture::Camera& camera, int max_pixels);

}  // namespace chainsplat::silhouette
