// chainsplat/rectangle.h - a rectangle of pixels, of an image or of a crop of one.
#pragma once
#include <algorithm>

namespace chainsplat::math {

struct Rectangle {  // pixels [x0, x1) x [y0, y1)
  int x0 = 0, y0 = 0, x1 = 0, y1 = 0;
  bool empty() const { return x1 <= x0 || y1 <= y0; }
  int width() const { return x1 - x0; }
  int height() const { return y1 - y0; }
};

// What lies in both; may be empty.
inline Rectangle intersection(const Rectangle& a, const Rectangle& b) {
  return {std::max(a.x0, b.x0), std::max(a.y0, b.y0), std::min(a.x1, b.x1), std::min(a.y1, b.y1)};
}

// The smallest that holds both, of which one may be empty.
inline Rectangle enclosing(const Rectangle& a, const Rectangle& b) {
  if (a.empty() || b.empty()) return a.empty() ? b : a;
  return {std::min(a.x0, b.x0), std::min(a.y0, b.y0), std::max(a.x1, b.x1), std::max(a.y1, b.y1)};
}

// With so many pixels more on each side.
inline Rectangle grown(const Rectangle& r, int margin) {
  return {r.x0 - margin, r.y0 - margin, r.x1 + margin, r.y1 + margin};
}

}  // namespace chainsplat::math
