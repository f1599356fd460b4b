// One frame's fit, with what a sequence needs beside the result: the data's own quadratic about it.
#pragma once
#include <vector>

#include "chainsplat/silhouette.h"
#include "src/silhouette/mask_points.h"

namespace chainsplat::silhouette {

struct FrameView {
  const MaskPoints* mask = nullptr;
  const capture::Camera* camera = nullptr;
  math::Pose base;  // at the view's time
};

struct FrameSolution {
  FrameFit fit;
  // Data and joint priors: with x = theta - fit.theta (and what the prior knows of the masks' shifts likewise) the log
  // likelihood is -x^T information x / 2 + gradient^T x.
  math::MatrixX information;  // 1/rad^2, calibrated
  math::VectorX gradient;
  double cost = 0.0;    // px^2, mask outside the tube and centerline outside the mask: compares fits of one frame
  int mask_pixels = 0;  // in all views
};

// Information (n x n, 1/rad^2) that angles are small and those of neighboring joints alike, about zero.
math::MatrixX joint_prior(const chain::Chain& chain, const Options& options);

FrameSolution solve_frame(const chain::Chain& chain, const std::vector<FrameView>& views, const math::VectorX& start,
                          bool warm, const Options& options);

// Whether `a` leaves more of the masks uncovered than `b` and is less inside of them, both clearly. Then its cost does
// not count: where something hides a part of the rope, the right fit's is high for that part, and one that turns back
// on itself in front of it may cost less.
bool explains_less(const FrameFit& a, const FrameFit& b);

// Times of the frames of the first camera and, for each, the views (by index) that belong to it.
struct Frames {
  std::vector<double> times;
  std::vector<std::vector<int>> views;
};
Frames frames_of(const capture::Capture& capture);

constexpr double kFewViews = 1.5;  // views per frame, in the mean, that count as one camera

}  // namespace chainsplat::silhouette
