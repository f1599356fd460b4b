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
#include <memory>
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

struct State;  // of the filter between two frames

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
  int doubtful_frames = 0;           // at first, whose masks are not yet good enough to be sure
  silhouette::Options silhouette;    // the filter sets the prior
};

// Returns the options for masks that are made while the rope is followed. In free space the error of their outline
// persists (a hand's edge, the rope's dark side), so that less of it is independent in each frame and colors count for
// more. On a table the persistent part, the masks' shift, is in the belief instead.
Options options_for_live_masks(bool tabletop);

// Compares the twin, with its links at `motions` (one list per view), with the colors inside the views' masks.
// `cameras`: all of them as they are believed to stand, by View::camera. Returns one result per view. Throws WorkError.
using CompareColors = std::function<std::vector<splat::ColorSums>(std::span<const capture::View* const> views,
                                                                  std::span<const capture::Camera> cameras,
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
  BaseCorrection base;             // of the base motion as it was given (Filter::base_at())
  double late_sigma = 0.0;         // s, standard deviation of base.late; 0: not known
  math::VectorX theta_by_late;     // rad/s, how theta changes with base.late, as it is seen with the base where it is
                                   // believed to be; n, or empty: not known
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

// Follows a rope from frame to frame. One thread at a time.
class Filter {
 public:
  // `base`: as given, valid from `base_start` on, s; it is asked up to 0.2 s after a frame's own time, too, where it
  // may be as at rest, and from two threads at once. `unverified`: by camera whether no training has compared its pose
  // with the rope; empty: none. `compare_colors`: empty: outlines alone. Throws InputError where the twin's chain or
  // parameters are unusable.
  Filter(const twin::Twin& twin, const std::vector<capture::Camera>& cameras, dynamics::BaseFunction base,
         double base_start, const Options& options = {}, const std::vector<char>& unverified = {},
         CompareColors compare_colors = {});
  ~Filter();
  Filter(Filter&&) noexcept;
  Filter& operator=(Filter&&) noexcept;

  // Processes one frame: undistorted crops with their masks, which may be empty, of one camera or of several at nearly
  // the same time (the first view's; View::camera is an index into cameras()). Times must increase. Throws WorkError.
  Estimate update(std::span<const capture::View* const> views);
  // Other options from the next frame on, where only the frames themselves show what they are.
  void set_options(const Options& options);

  // The predicted angles at `time`, where the masks should be searched for; none before the first frame and while the
  // rope is lost.
  std::optional<math::VectorX> expected(double time) const;
  // The base's motion as it is believed to be: its clock and how it holds the rope mended as far as they are known.
  trajectory::BaseMotion base_at(double time) const;
  // What of the setup has turned out to be wrong by more than three deviations, so far: codes "base-time" and
  // "camera-pose".
  std::vector<capture::Finding> findings() const;

  const dynamics::Model& model() const;                 // without parameters where the twin has no dynamics
  const std::vector<capture::Camera>& cameras() const;  // as they are believed to be
  const math::VectorX& rest() const;                    // rad, angles of the rope at rest at `base_start`

 private:
  std::unique_ptr<State> state_;
};

// The paper's method ("State Estimation"), for comparison: a few Adam steps on the rendering loss of every frame, from
// the previous frame's angles. It has no motion model and no covariance; rates are differences of the angles.
struct AdamOptions {
  int steps = 10;         // per frame, as in the paper
  int first_steps = 100;  // in the first frame, from the motion that the twin predicts
  double rate = 0.01;     // rad, as in recognition
};

// The gradient of the rendering loss with respect to the links' motions: world twists, 6 x links (mathematics.md 2.8).
// `camera`: the view's.
using LinkGradient = std::function<math::MatrixX(const capture::View& view, const capture::Camera& camera,
                                                 const std::vector<math::Pose>& motions)>;

class AdamFollower {
 public:
  // As the filter; the base is mended by what the table tells alone, and the cameras stand as given.
  AdamFollower(const twin::Twin& twin, const std::vector<capture::Camera>& cameras, dynamics::BaseFunction base,
               double base_start, LinkGradient gradient, const AdamOptions& options = {});
  ~AdamFollower();
  AdamFollower(AdamFollower&&) noexcept;
  AdamFollower& operator=(AdamFollower&&) noexcept;

  Estimate update(std::span<const capture::View* const> views);  // as the filter's, with an empty covariance
  std::optional<math::VectorX> expected(double time) const;      // the last frame's, whatever the time
  trajectory::BaseMotion base_at(double time) const;
  const dynamics::Model& model() const;
  const std::vector<capture::Camera>& cameras() const;
  const math::VectorX& rest() const;

 private:
  struct State;
  std::unique_ptr<State> state_;
};

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
