// chainsplat/estimation.h - a rope followed live from one camera or more: a twin and masked frames in; joint angles,
// rates and their covariance out, frame by frame (mathematics.md 6).
//
// The estimator is an iterated extended Kalman filter. Its motion model is the twin's own dynamics under the base's
// motion. What the model does not contain (a hand, a finger, its own errors) is an unknown force on the rope, modeled
// as a slow random walk and estimated as a shift of the joints' rest angles. The first measurement is the silhouette
// fit of the frame's masks, with the prediction as the fit's prior (silhouette.h). The second, where the twin can be
// drawn, is the colors inside the masks: they match marks along the rope, which reveals its slope in depth. Otherwise
// depth along a camera's rays is hardly observable; the dynamics supply it, and the covariance shows how well.
//
// Angles are in rad, rates in rad/s, times in s, positions in the world frame in m.
#pragma once
#include <functional>
#include <limits>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "chainsplat/capture.h"
#include "chainsplat/corrections.h"
#include "chainsplat/dynamics.h"
#include "chainsplat/estimate_lines.h"
#include "chainsplat/silhouette.h"
#include "chainsplat/splat.h"
#include "chainsplat/twin.h"

namespace chainsplat::estimation {

// The filter's noise model. Unknown forces are per kilogram of rope. The values were chosen on captures with truth.
struct Options {
  double model_force = 0.06;         // N/sqrt(s) per kilogram, random walk of the unknown force without contact
  double contact_force = 4.0;        // N/sqrt(s) per kilogram, the same while the motion departs from the model
  double force_memory = 0.5;         // s, time constant with which an unconfirmed unknown force decays
  double acceleration = 2.0;         // rad/s^2, process noise per angle, independent from frame to frame
  double blind_acceleration = 30.0;  // rad/s^2, the same without dynamics, or where the motion departs from the
                                     // model and no force can be estimated (without stiffness)
  double new_share = 0.4;            // share of a silhouette's variance that is independent in each frame
  double color_share = 0.002;        // share of the information per pixel and channel that counts: channels are
                                     // correlated, so are some 5 x 5 pixels, and errors of the twin's colors last
  int color_steps = 1;               // number of Gauss-Newton steps on the colors
  silhouette::Options silhouette;    // the filter sets the prior
};

// Returns the options for masks that are made while the rope is followed. In free space the error of their outline
// persists (a hand's edge, the rope's dark side), so that less of it is independent in each frame and colors count for
// more. On a table the persistent part, the masks' shift, is in the belief instead.
Options options_for_live_masks(bool tabletop);

// A Gaussian belief about (theta, thetadot, shift of the rest angles), 3 n numbers in rad and rad/s. On a table, where
// ropes have contact shadows, it also holds the shift of each camera's masks (silhouette::Prior), px in x and y.
struct Belief {
  double time = 0.0;  // s
  math::VectorX mean;
  math::MatrixX covariance;
};

// Compares the twin, with its links at `motions`, with the colors inside the views' masks. Returns one result per view.
// Throws WorkError.
using CompareColors = std::function<std::vector<splat::ColorSums>(std::span<const capture::View* const> views,
                                                                  std::span<const std::vector<math::Pose>> motions)>;

struct Estimate {
  int frame = 0;
  double time = 0.0;               // s
  math::VectorX theta, thetadot;   // rad, rad/s; n
  math::MatrixX covariance;        // of (theta, thetadot), 2 n x 2 n; empty: unknown
  double centerline_sigma = 0.0;   // m, standard deviation of the centerline, RMS over the rope
  double iou = 0.0;                // of the chain's tube and the mask, mean over the views
  double residual = 0.0;           // px, robust RMS distance of the mask's outline from the tube's
  double color_residual = 0.0;     // RMS difference of drawn and recorded colors in the mask, 0..1; 0: not compared
  std::optional<double> likeness;  // correlation of drawn and recorded colors about each channel's mean, the best
                                   // of the views'; none: not compared, or a rope without marks
  double gain = 1.0, bias = 0.0;   // exposure of the last view relative to the twin's colors
  BaseCorrection base;             // of the base motion as it was given (base_at())
  double surprise = 0.0;           // squared innovation over its expectation, about 1 as long as the model holds
  bool seen = false;               // whether a mask shows anything
  bool lost = false;               // whether the estimate does not explain the mask, the masks were empty for long,
                                   // or the colors in them have been unlike the twin's for long
  bool doubtful = false;           // not lost, but what is seen may not be the rope, or not all of it: the deviations
                                   // are those of a rope that nobody looks at, and no force should be told from it
  bool settling = false;           // the rope seems to move since where cameras stand, or the base's clock, is being
                                   // learned: no force should be told from it, either
};
const char* status(const Estimate& estimate);  // "following", "doubtful" or "lost"

constexpr double kNever = -std::numeric_limits<double>::infinity();  // s; before all times, which may be negative

// What is learned of the surroundings while the rope is followed: the base's clock, how the grasp is turned, and the
// poses of cameras that no training has compared with the rope. Gaussian, of the numbers of silhouette::SetupEquations,
// which are 0 where all is as given.
struct Setup {
  std::vector<capture::Camera> cameras;  // as given
  std::vector<char> posed;               // by camera: its pose is learned
  math::VectorX mean;
  math::MatrixX information;       // of what is known beforehand and of all frames
  math::VectorX right;             // information times mean
  math::MatrixX angles;            // rad^2, n x n: what the rest of its uncertainty adds to the last frame's angles
  math::MatrixX first_information;  // of what is known beforehand alone
  math::VectorX first_right;
  int frames = 0;                  // that count
  double last = kNever;            // s, the last frame
  double settling_until = kNever;  // s: until then it changes so fast that the rope seems to move by it
};

// The state of the filter between two frames.
struct Filter {
  dynamics::Model model;
  bool identified = false;                    // the twin has dynamics; otherwise rates are constant
  bool shifts = false;                        // the unknown force is a part of the state
  std::optional<math::Vector3> table_normal;  // unit, world; on a table the masks' shift is a part of the state too
  std::vector<capture::Camera> cameras;       // as they are believed to be
  dynamics::BaseFunction base;                // as given; base_at() is what is believed
  Setup setup;
  Options options;
  CompareColors compare_colors;     // empty: silhouettes alone
  std::optional<Belief> belief;     // none before the first frame
  double base_start = 0.0;          // s, where the base's motion begins to be known; the rope is assumed at rest there
  math::VectorX rest;               // rad, angles of the rope at rest at that time
  double contact_until = kNever;    // s, end of the time in which the motion is assumed to depart from the model
  math::VectorX everywhere, place;  // shares of the links' ends in the unknown force: even, and as learned in contact
  double last_seen = kNever;        // s, last frame in which the masks showed the rope
  double last_like = kNever;        // s, last frame in which the colors in the masks were like the twin's
  bool lost = false;                // in the last frame
  bool whole = false;               // the masks have shown the whole rope since it was found
  double hidden_since = kNever;     // s, first frame since it was found
  double edge_offset = 0.0, edge_offset_variance = 0.0;  // px, px^2, of the masks' outline outside the tube's
};

// Starts a filter. `base_start`: the first time at which `base` is valid; it is asked up to 0.2 s after a frame's own
// time, too, where it may be as at rest. `unverified`: by camera whether no training has compared its pose with the
// rope; empty: none. Throws InputError where the twin's chain or parameters are unusable.
Filter start(const twin::Twin& twin, const std::vector<capture::Camera>& cameras, dynamics::BaseFunction base,
             double base_start, const Options& options = {}, const std::vector<char>& unverified = {});

// The base's motion as it is believed to be: its clock and how it holds the rope mended as far as they are known.
trajectory::BaseMotion base_at(const Filter& filter, double time);

// What of the setup has turned out to be wrong by more than three deviations, so far: codes "base-time" and
// "camera-pose".
std::vector<capture::Finding> findings(const Filter& filter);

// Processes one frame: undistorted crops with their masks, which may be empty, of one camera or of several at nearly
// the same time (the first view's; View::camera is an index into Filter::cameras). Times must increase. Throws
// WorkError.
Estimate update(Filter& filter, std::span<const capture::View* const> views);

// What may have happened to the rope in a step: nothing beyond the model, a force that changes as under a hand, or also
// a blow, when the rope runs into something or is released.
enum class Contact { none, touched, struck };

// Returns the belief at a later time, without a measurement.
Belief predict(const Filter& filter, const Belief& belief, double time, Contact contact);

// Returns the predicted angles at `time`, where the masks should be searched for; none before the first frame and while
// the rope is lost.
std::optional<math::VectorX> expected(const Filter& filter, double time);

// The paper's method ("State Estimation"), for comparison: a few Adam steps on the rendering loss of every frame, from
// the previous frame's angles. It has no motion model and no covariance; rates are differences of the angles.
struct AdamOptions {
  int steps = 10;         // per frame, as in the paper
  int first_steps = 100;  // in the first frame, from the motion that the twin predicts
  double rate = 0.01;     // rad, as in recognition
};

// The gradient of the rendering loss with respect to the links' motions: world twists, 6 x links (mathematics.md 2.8).
using LinkGradient = std::function<math::MatrixX(const capture::View& view, const std::vector<math::Pose>& motions)>;

struct AdamFollower {
  Filter filter;  // supplies the twin, the cameras and the base; its belief is unused
  LinkGradient gradient;
  AdamOptions options;
  math::VectorX theta;  // of the last frame; empty before the first
  double time = 0.0;    // s, of the last frame
};

AdamFollower start_adam(const Filter& filter, LinkGradient gradient, const AdamOptions& options = {});

// As the filter's update(), with an empty covariance.
Estimate update(AdamFollower& follower, std::span<const capture::View* const> views);

// Returns whether any pixel of the view is in the mask.
bool has_mask(const capture::View& view);

// Returns the intersection over union of the mask and the tube around the chain.
double tube_iou(const chain::Chain& chain, const math::Pose& base, const math::VectorX& theta,
                const capture::View& view, const capture::Camera& camera);

// Returns the line of formats.md 3.1, without line feed; numbers that are not finite become null. `latency`: s.
// "covariance" is the lower triangle of theta's covariance, row by row; with `rates` it is that of (theta, thetadot),
// which begins with the same numbers.
std::string to_json(const Estimate& estimate, double latency, bool rates = false);

}  // namespace chainsplat::estimation
