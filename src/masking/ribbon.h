// The rope in one picture as a ribbon: a pair of outlines found along a rough axis, where colors change on either side.
//
// A grown or fitted chain lies within about a radius of the rope and has one width. Where the background is not known,
// as in a few stills, the outlines themselves say where the rope is and how wide: the picture is straightened along the
// axis, and the cheapest pair of outlines, left and right, is found by dynamic programming over the arclength. What
// counts: colors inside and outside, color steps at both outlines, a width and a place that change little along the
// rope, and a width near the usual one, except at the tip, where a connector may be.
#pragma once
#include "src/masking/look.h"

namespace chainsplat::masking {

struct RibbonOptions {
  double width = 1.0;            // usual width as a share of the axis' own,
  double width_deviation = 0.2;  // and how sure that is
  double slack = 0.01;           // m, by which the rope may end or come out of the gripper elsewhere
  bool shadow = false;           // it lies on something, on which it casts a shadow
  bool rims = false;             // outlines where the rims of a tube fit, instead of where colors change most
  std::vector<math::Vector2> through = {};  // px: places that lie between the outlines
};

struct Ribbon {
  Axis axis;           // what lies between the outlines; empty where nothing is seen
  double width = 1.0;  // median width as a share of that of the axis it was sought about
};

// `along`: the rough axis. `length`: the rope's, m.
Ribbon find_ribbon(const Look& look, const Picture& picture, const Axis& along, double length,
                   const RibbonOptions& options = {});

// How a tube looks by itself, whatever it was found by: shares of its length.
struct Evidence {
  double edges = 0.0;   // that differ in color from both sides
  double steady = 0.0;  // that have the color of most of it
};
Evidence evidence(const Picture& picture, const Axis& axis);
double score(const Evidence& evidence);  // as masking.h tells it

}  // namespace chainsplat::masking
