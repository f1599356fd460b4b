// chainsplat/silhouette.h - masks and a chain -> joint angles: the coarse step of recognition and estimation
// (mathematics.md 6).
//
// A frame in two stages, Gauss-Newton over all its views at once. Coarse: sampled mask pixels are drawn to the
// projected centerline along its normal (those past the free end with the whole vector) and centerline samples into the
// mask: this finds the rope from afar. Fine: the mask's outline, to a fraction of a pixel, is put at the tube's radius
// from the centerline on either side, and its end at the free end. A sequence is warm-started frame by frame, repaired
// where that failed, and smoothed over time with each frame's own normal equations as weights. design.md,
// 'Recognition'.
#pragma once
#include <optional>
#include <span>
#include <vector>
#include "chainsplat/capture.h"
#include "chainsplat/chain.h"
#include "chainsplat/solve.h"

namespace chainsplat::silhouette {

// A Gaussian belief about theta, e.g. a filter's prediction. Both empty: none. Where it goes on with two numbers a
// view, these are the mask's shift in the image, px in x and y, which is then estimated too: a contact shadow that was
// taken for rope, all on one side, shifts the mask by half its width (and widens it by as much, see edge_offset).
struct Prior {
  math::VectorX mean;         // rad, n; or rad and px, n + 2 views
  math::MatrixX information;  // its inverse covariance
};

struct Options {
  int max_pixels = 500;                // mask pixels used a view (coarse stage)
  int iterations = 8;                  // Gauss-Newton steps of a warm-started frame, half of them coarse
  int first_iterations = 30;           // coarse steps of a frame without a warm start, from each of several starts
  double huber_pixels = 8.0;           // px, coarse stage, after the first iterations
  double joint_smoothness = 0.0;       // 1/rad^2, weight of (theta_j - theta_{j-1})^2, edges known to 1 px; 0: default
  double edge_offset = 0.0;            // px by which the masks are thought wider than the tube on each side, and
  double edge_offset_deviation = 3.0;  // px, how sure that is (one camera reads depth off the width)
  bool smooth_in_time = true;          // fit_sequence: smooth the angles over time
  Prior prior;                         // fit_frame only
};

struct FrameFit {
  math::VectorX theta;
  double residual_pixels = 0.0;  // RMS distance of the mask's outline from the tube's, robust, px
  double covered = 0.0;          // share of mask pixels within the tube's half width + 2 px of the projected centerline
  double foreign = 0.0;          // share of mask pixels in parts of the masks that lie apart from the whole chain
  double inside = 0.0;           // share of the projected centerline that lies in the masks (occluders lower it)
  double edge_offset = 0.0;      // px by which the masks are wider than the tube on each side
  math::VectorX mask_shift;      // px, x and y of each view; empty where the prior says nothing about it
  math::MatrixX covariance;  // of theta, rad^2, then mask_shift; directions that the views do not fix have the prior's
  solve::Summary summary;    // of the fine stage, rad; cost: outline's mean capped square, px^2, nearly what it fits
};

// One frame: all views taken at (nearly) one time. `views` must be undistorted crops with masks, which may be empty.
// `warm`: `start` is near (the frame before); otherwise several starts are tried and the best is kept.
FrameFit fit_frame(const chain::Chain& chain, const math::Pose& base, std::span<const capture::View* const> views,
                   const std::vector<capture::Camera>& cameras, const math::VectorX& start, bool warm,
                   const Options& options = {});

// Every time of the first camera that has views, in order; other cameras' nearest frame within half an interval joins
// it (with the base pose of its own time). Frames without any mask pixel keep the prediction from their neighbors (and
// are named in one warning), as do single ones whose masks show no rope near that of the frames beside them. Frames
// whose fit is far worse than the others' are fitted again from the frame after them. Throws InputError when no mask
// shows anything.
struct SequenceFit {
  chain::States states;          // theta (smoothed over time) and thetadot
  std::vector<FrameFit> frames;  // each frame's own fit
  solve::Summary summary;        // of all frames that show the object together
};
SequenceFit fit_sequence(const chain::Chain& chain, const capture::Capture& capture, const Options& options = {});

// Whether one camera sees the rope at a time, so that the width of its masks alone tells depth: most frames have one
// view, whatever the number of cameras.
bool seen_by_one(const capture::Capture& capture);

// design.md, 'Recognition', --bending auto: planar on a table, or where a spatial fit is out of plane by less than 1 mm
// or 3 deviations RMS, or where of one camera a planar fit explains the outlines nearly as well (of a rope that is
// carried: as well); else spatial.
struct BendingChoice {
  chain::Bending bending = chain::Bending::spatial;
  double out_of_plane_rms = 0.0;  // m; 0 when not measured
  double deviation = 0.0;         // its standard deviation, m
};
BendingChoice choose_bending(const chain::Chain& spatial_chain, const capture::Capture& capture,
                             const SequenceFit& fit);

// design.md, 'Recognition', --joints auto: the fewest of 8, 12 and 16 joints with whose straight links the rope's curve
// is followed as closely as all masks together can tell, else 16, or 24 where 16 leave more than a tenth of a
// millimeter. `fit` is that of `chain`, whose joints are evenly spaced.
struct JointChoice {
  int joints = 0;
  int tried = 0;           // joints of `chain`
  double bow = 0.0;        // of the rope beside the links of `chain`, RMS over the rope and the frames, m
  double deviation = 0.0;  // what the masks of all frames leave open about the centerline, standard deviation, m
};
JointChoice choose_joints(const chain::Chain& chain, const SequenceFit& fit);

// How far, m along the bending axis, a rope on a table lies beside the plane in which its grasp moves, from the
// outlines of up to 16 frames of several cameras, beginning with `first`, which stays where it is right to a hundredth
// of the diameter, or where one camera alone sees the rope. `fit` is that of `chain`, which is planar.
// Mathematics.md 6.13.
double fit_height(const chain::Chain& chain, const capture::Capture& capture, const SequenceFit& fit, double first);
// How a rope lies on its table.
struct Lying {
  double height = 0.0;   // m, along the bending axis, from the plane of the grasp to where it lies
  math::Vector3 normal;  // of the table, base frame, at the beginning
};
// As the capture gives the table; none where it gives none, or none that is below the grasp and near it.
std::optional<Lying> lying_on_table(const capture::Capture& capture);
// Its height, 0 where there is none.
double height_by_table(const capture::Capture& capture);
// Chain::lift of a chain that lies so far beside it: it goes there as a heavy rod does. `reach`: the arclength
// until there, as a share of that of a rope of usual stiffness.
std::vector<double> lying_down(const chain::Chain& chain, double height, double reach = 1.0);

}  // namespace chainsplat::silhouette
