// chainsplat/correction_fit.h - what a recording was given wrongly, from the masks' outlines: poses, focal lengths and
// clocks of the cameras, the base's clock, the grasp and the rope's size (mathematics.md 6.10, 6.14).
//
// Everything is solved together with the angles of many frames, from a sequence that was fitted with what was given.
// Which of it is then corrected is decided in the pipeline, by the evidence that is found here. The equations of one
// frame are also what a rope that is followed learns its setup from.
#pragma once
#include <functional>
#include <optional>
#include <span>
#include <string>
#include <vector>
#include "chainsplat/capture.h"
#include "chainsplat/chain.h"
#include "chainsplat/corrections.h"
#include "chainsplat/silhouette.h"
#include "chainsplat/solve.h"

namespace chainsplat::silhouette {

// A camera lost a frame before this one of its frames: its stamps, which count frames, are early by a frame from there
// on.
struct LostFrame {
  int camera = 0, frame = 0;
};
// What outlines show of it, as jumps of a camera's clock against the base's and the other cameras' (mathematics.md 6.14).
struct LostFrames {
  // Each may be one that is lost, the likeliest first. Once it is restored, the others look otherwise.
  std::vector<LostFrame> likely;
  // Mean square distance of the outlines about the clocks as they are, px^2: less where one was restored that was lost.
  double misfit = 0.0;
};
// `sequence` is fitted to `chain`.
LostFrames find_lost_frames(const chain::Chain& chain, const capture::Capture& capture, const SequenceFit& sequence);

constexpr double kAsRecognized = 0.02;
struct CorrectionOptions {
  std::vector<std::string> held = {};  // groups of corrected_quantities() that are not varied
  int frames = 75;                     // at most, spread over the recording
  // How the planar chain lies on its table, by which its lift was made: then the lift follows the grasp's shift, and
  // the table's height varies too.
  std::optional<Lying> lying = {};
  // Of the angles, relative to what outlines count as here. kAsRecognized: as in recognition. 1: the rope is held 50
  // times as straight, without which much that is wrong at a time would go into its length.
  double prior_weight = 1.0;
  // Whether all cameras may read their rows one after the other, in the same time: for the cause "readout", not beside
  // everything else, with which it trades.
  bool readout = false;
  std::string only = {};  // the cause that is corrected, by its name; none: all there may be
  std::string then = {};  // the cause that is, from there on; none: the same
  // Known mistakes as the corrections that mend them, e.g. half a pixel. Quantities that are not in one of them are
  // right as given.
  std::vector<capture::Corrections> mistakes = {};
};

// How far the masks' outlines are from the rope's in one camera, px; a positive sign where the mask is wider.
struct OutlineMisfit {
  double mean = 0.0, rms = 0.0;  // over the outline that counts
  double cut = 0.0;              // share of the outline that is left out as not the rope's
  int worst_frame = -1;          // of the camera
  double worst_rms = 0.0;
};

// One thing that may be all that is wrong with a recording.
struct Cause {
  std::string name;       // "base.time", "cam1.pose", "length", "masks", "grasp and length, masks", ...
  std::string in_doubt;   // the name of the cause with what this one may be mistaken for, too: "grasp and length"
  int numbers = 0;        // that it is made of
  double evidence = 0.0;  // that something is wrong, which is left when it is corrected and nothing else
  double surprise = 0.0;  // -ln of how likely just this is by the priors (mathematics.md 6.10, 'Which of two')
};
struct CorrectionFit {
  capture::Corrections corrections;
  math::MatrixX covariance;  // of all their numbers, in their order and units; 0 for those that are held
  // By which share the outlines' square residuals would be larger with what was given, whatever of it is wrong.
  double evidence = 0.0;
  std::vector<Cause> causes;
  double surprise = 0.0;               // of this fit, as a cause's
  double unexplained = 0.0;            // half the outlines' weighted square residuals that it leaves, beside all priors
  std::vector<double> evidence_after;  // the same with each of the options' mistakes mended, and nothing else
  solve::Summary summary;              // the unknowns relative to their prior deviations, and rad
  std::vector<OutlineMisfit> misfits;  // by camera, after the corrections
  chain::Chain chain;                  // with the corrected length and diameter
  std::vector<double> time;            // s, corrected, of the frames that were fitted
  std::vector<math::VectorX> theta;    // rad, of these frames
};

// Poses, focal lengths and clocks of the cameras, the base's clock, the grasp's place and the rope's size, together
// with the angles of up to `frames` frames, from the masks' outlines. Gauss-Newton on the arrow system from `fit`;
// it must have a frame with a residual, and may be a few pixels off: what is cut as foreign starts wide and narrows.
// Deviations are the larger of what the equations say and of what the scatter between stretches of time says.
CorrectionFit fit_corrections(const chain::Chain& chain, const capture::Capture& capture, const SequenceFit& fit,
                              const CorrectionOptions& options = {});

// What the corrections' `covariance` (CorrectionFit) leaves open about the angles of every state, rad^2, n x n: other
// corrections as likely as these would have made other angles. `capture` is the corrected one that the states are of.
std::vector<math::MatrixX> covariances_by_corrections(const chain::Chain& chain, const capture::Capture& capture,
                                                      const chain::States& states,
                                                      const capture::Corrections& corrections,
                                                      const math::MatrixX& covariance);

// What a table says of how the rope is turned in the grasp: a rope that lies there bends in its plane, however the
// gripper holds it (mathematics.md 6.10). For a small rotation vector of the grasp, rad, base frame, about where it
// turns the bending axis to `bending_axis`; `normal`: the table's, unit, base frame. Axes may point down, too.
struct TiltEquations {
  math::Matrix3 information;
  math::Vector3 gradient;
};
TiltEquations tilt_equations(const math::Vector3& bending_axis, const math::Vector3& normal);

// What one frame says of what all frames share: by how much its base is late (s), how the rope is turned in the grasp
// (rad, rotation vector in the base frame), and then for each camera of `posed`, by camera, how it is turned (rad,
// rotation vector in its own frame) and where it stands (m, world). The frame's angles are unknown too, with the prior
// of `options` (about theta, the frame's fit), and so is each camera's edge offset. With the tempered weights of
// fit_corrections(). `expected`: n x m, how the prior's mean changes with the unknowns.
struct SetupEquations {
  static constexpr int kClock = 0, kGrasp = 1, kCameras = 4, kPerCamera = 6;  // where they stand
  math::MatrixX information;                                                  // m x m
  math::VectorX gradient;  // m, of the cost: the change that the frame asks for is -information^-1 gradient
  math::MatrixX angles;    // n x m, how the frame's angles change with the unknowns, what is expected of them included
};
SetupEquations setup_equations(const chain::Chain& chain,
                               const std::function<trajectory::BaseMotion(double time)>& base,
                               std::span<const capture::View* const> views, const std::vector<capture::Camera>& cameras,
                               const std::vector<char>& posed, const math::VectorX& theta,
                               const math::MatrixX& expected, const Options& options);

}  // namespace chainsplat::silhouette
