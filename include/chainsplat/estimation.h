// chainsplat/estimation.h - a rope followed live, from one camera or more: joint angles, rates and how sure they are
// (SPEC 6).
//
// An iterated extended Kalman filter. Its motion model is the twin's own dynamics under the base's motion; what the
// model does not know (a hand, a finger, its own errors) is a force on the rope that wanders slowly and is estimated
// too, as a shift of the joints' rest angles. Its first measurement is the silhouette fit of one mask, with the
// prediction as the fit's prior (silhouette.h); its second, where the twin can be drawn, the colors inside the mask: by
// them marks along the rope are recognized, which tells its slope in depth. Depth along the camera's rays is else
// hardly seen; the dynamics supply it, and the covariance says how well.
#pragma once
#include <functional>
#include <limits>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "chainsplat/capture.h"
#include "chainsplat/dynamics.h"
#include "chainsplat/silhouette.h"
#include "chainsplat/splat.h"
#include "chainsplat/twin.h"

namespace chainsplat::estimation {

// Unknown forces are per kilogram of rope. The values were chosen on captures with truth.
struct Options {
  double model_force = 0.06;         // N/sqrt(s) a kilogram of rope, random walk of the unknown force without contact
  double contact_force = 4.0;        // N/sqrt(s) a kilogram, the same while the motion does not follow the model
  double force_memory = 0.5;         // s, in which an unknown force that nothing confirms is forgotten
  double acceleration = 2.0;         // rad/s^2, of every angle, independent from frame to frame
  double blind_acceleration = 30.0;  // rad/s^2, the same where the motion does not follow the model and
                                     // no force is estimated (no dynamics or stiffness)
  double new_share = 0.4;            // of a silhouette's variance that is new in every frame (the rest stays)
  double color_share = 0.002;        // of a pixel's and channel's information that counts: channels are alike, pixels
                                     // over about 5 x 5, and the errors of the twin's looks stay for many frames
  int color_steps = 1;               // Gauss-Newton steps on the colors
  silhouette::Options silhouette;    // the prior is set by the filter
};

// Where the masks of a rope in space are made while it is followed: their outline errs the same way for long (a hand's
// edge, the rope's dark side), so that less of it is new in every frame, and colors count for more. On a table what
// lasts is a part of the belief instead: the masks' shift.
Options options_for_live_masks(bool tabletop);

// Gaussian belief about (theta, thetadot, shift of the rest angles), 3 n, rad and rad/s; on a table, where ropes have
// contact shadows, also about the shift of each camera's masks (silhouette::Prior), px in x and y.
struct Belief {
  double time = 0.0;
  math::VectorX mean;
  math::MatrixX covariance;
};

// The twin, its links moved so, compared with what the views show inside their masks: one a view. Throws WorkError.
using CompareColors = std::function<std::vector<splat::ColorSums>(std::span<const capture::View* const> views,
                                                                  std::span<const std::vector<math::Pose>> motions)>;

struct Estimate {
  int frame = 0;
  double time = 0.0;               // s
  math::VectorX theta, thetadot;   // rad, rad/s; n
  math::MatrixX covariance;        // of (theta, thetadot), 2 n x 2 n; empty: not known
  double centerline_sigma = 0.0;   // m, standard deviation of the centerline, RMS over the rope
  double iou = 0.0;                // of the chain's tube and the mask
  double residual = 0.0;           // px, RMS of the mask's outline about the tube's, robust
  double color_residual = 0.0;     // RMS of drawn against seen colors inside the mask, of 1; 0: not looked at
  std::optional<double> likeness;  // correlation of drawn and seen colors, each channel without its mean; the best of
                                   // the views'; none: not looked at, or a rope without marks
  double gain = 1.0, bias = 0.0;   // exposure of the (last) view against the twin's looks
  double surprise = 0.0;           // squared innovation over its expectation; about 1 as long as the model holds
  bool seen = false;               // the mask showed something
  bool lost = false;               // the estimate does not explain the mask, nothing was seen for long, or what
                                   // the mask shows has long not looked like the twin
};

constexpr double kNever = -std::numeric_limits<double>::infinity();  // s; frames may have negative times

// The filter between two frames.
struct Filter {
  dynamics::Model model;
  bool identified = false;                    // the twin has dynamics; else angles go on at constant rate
  bool shifts = false;                        // the unknown force is a part of the state
  std::optional<math::Vector3> table_normal;  // unit, world; on a table the masks' shift is a part of the state too
  std::vector<capture::Camera> cameras;
  dynamics::BaseFunction base;
  Options options;
  CompareColors compare_colors;     // empty: silhouettes alone
  std::optional<Belief> belief;     // none before the first frame
  double base_start = 0.0;          // s, from here on the base's motion is known: the rope is thought at rest there
  math::VectorX rest;               // rad, how the rope rests (or lies) at that time
  double contact_until = kNever;    // s, until then the motion is thought not to follow the model
  math::VectorX everywhere, place;  // shares of the links' ends in the unknown force: evenly, and as learned in contact
  double last_seen = kNever;        // s
  double last_like = kNever;        // s, the mask looked like the twin inside
  bool lost = false;                // in the last frame
  double edge_offset = 0.0, edge_offset_variance = 0.0;  // px, px^2: how much wider the masks are than the tube
};

// `base_start`: the first time that `base` is good for. Throws InputError where the twin's chain or parameters are no
// good.
Filter start(const twin::Twin& twin, const std::vector<capture::Camera>& cameras, dynamics::BaseFunction base,
             double base_start, const Options& options = {});

// One frame: undistorted crops with their masks, which may be empty, of one camera or of several at nearly one time
// (that of the first; View::camera counts in Filter::cameras). Times must increase.
Estimate update(Filter& filter, std::span<const capture::View* const> views);

// What may have happened to the rope in a step: nothing that the model does not know, a force that changes as under a
// hand, or a blow too: it ran into something, or was let go.
enum class Contact { none, touched, struck };

// The belief at a later time, without looking.
Belief predict(const Filter& filter, const Belief& belief, double time, Contact contact);

// Where the rope will be at `time`, for whoever must look for it there; none before the first frame and while lost.
std::optional<math::VectorX> expected(const Filter& filter, double time);

// The paper's way ("State Estimation"), to compare with: a few Adam steps on the rendering loss of every frame, from
// the last frame's angles. No motion model, no covariance; rates are differences of the angles.
struct AdamOptions {
  int steps = 10;         // a frame, the paper's
  int first_steps = 100;  // of the first frame, from the motion that the twin expects
  double rate = 0.01;     // rad, as in recognition
};

// Gradient of the rendering loss with respect to the links' motions: world twists, 6 x links (SPEC 2.8).
using LinkGradient = std::function<math::MatrixX(const capture::View& view, const std::vector<math::Pose>& motions)>;

struct AdamFollower {
  Filter filter;  // its twin, cameras and base; it has no belief
  LinkGradient gradient;
  AdamOptions options;
  math::VectorX theta;  // of the last frame; empty before the first
  double time = 0.0;
};

AdamFollower start_adam(const Filter& filter, LinkGradient gradient, const AdamOptions& options = {});

// As update() of the filter, with an empty covariance.
Estimate update(AdamFollower& follower, std::span<const capture::View* const> views);

bool has_mask(const capture::View& view);

// Share of pixels in both the mask and the tube about the chain among those in either.
double tube_iou(const chain::Chain& chain, const math::Pose& base, const math::VectorX& theta,
                const capture::View& view, const capture::Camera& camera);

// The line of INTERFACE 5, without line feed; what is not finite is null. `latency`: s. "covariance" is the lower
// triangle, row by row, of theta's; with `rates` of (theta, thetadot)'s, which begins with it.
std::string to_json(const Estimate& estimate, double latency, bool rates = false);

}  // namespace chainsplat::estimation
