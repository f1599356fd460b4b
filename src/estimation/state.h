// state.h - what the filter holds from frame to frame: what is given, what is learned of it, and the belief.
#pragma once
#include <limits>

#include "chainsplat/correction_fit.h"
#include "chainsplat/dynamics/rolling.h"
#include "chainsplat/estimation.h"

namespace chainsplat::estimation {

constexpr double kNever = -std::numeric_limits<double>::infinity();  // s; before all times, which may be negative
constexpr double kLeastVariance = 1e-12;                             // rad^2, keeps covariances invertible
constexpr double kLostShare = 0.5;  // share of the mask explained, below which the rope is lost (mathematics.md 6)

// What is given, and does not change while the rope is followed.
struct Given {
  dynamics::Model model;
  bool identified = false;                    // the twin has dynamics; otherwise rates are constant
  bool shifts = false;                        // the unknown force is a part of the state
  std::optional<math::Vector3> table_normal;  // unit, world; on a table the masks' shift is a part of the state too
  std::vector<capture::Camera> cameras;       // as given
  dynamics::BaseFunction base;                // as given; base_at() is what is believed
  double base_start = 0.0;   // s, where the base's motion begins to be known; the rope is assumed at rest there
  math::VectorX rest;        // rad, angles of the rope at rest at that time
  math::VectorX everywhere;  // even shares of the links' ends in the unknown force
};

// What is learned of the surroundings while the rope is followed: the base's clock, how the grasp is turned, and the
// poses of cameras that no training has compared with the rope. Gaussian, of the numbers of silhouette::SetupEquations,
// which are 0 where all is as given.
struct Setup {
  std::vector<char> posed;  // by camera: its pose is learned
  math::VectorX mean;
  math::MatrixX information;        // of what is known beforehand and of all frames
  math::VectorX right;              // information times mean
  math::MatrixX first_information;  // of what is known beforehand alone
  math::VectorX first_right;
  int frames = 0;                  // that count
  double last = kNever;            // s, the last frame
  double settling_until = kNever;  // s: until then it changes so fast that the rope seems to move by it
};

// A Gaussian belief about (theta, thetadot, shift of the rest angles), 3 n numbers in rad and rad/s. On a table, where
// ropes have contact shadows, it also holds the shift of each camera's masks (silhouette::Prior), px in x and y.
struct Belief {
  double time = 0.0;  // s
  math::VectorX mean;
  math::MatrixX covariance;
  // How the mean changes with the setup's m numbers: as many rows as the mean, m columns. `covariance` is that of a
  // setup that is exactly as believed; with the setup's own covariance C, by_setup C by_setup^T comes on top.
  math::MatrixX by_setup;
};

// The mean of a belief moved to a later time by the twin's dynamics, and its derivatives by the mean before, n x 3 n.
struct Motion {
  double time = 0.0;  // s
  math::VectorX theta, thetadot;
  math::MatrixX theta_by_state, thetadot_by_state;
  math::MatrixX by_setup;  // of theta and thetadot, 2 n x m; from the same mean before, by how the base moves alone
};

// The filter between two frames.
struct State {
  Given given;
  Options options;
  CompareColors compare_colors;          // empty: silhouettes alone
  std::vector<capture::Camera> cameras;  // as they are believed to be
  Setup setup;
  std::optional<Belief> belief;            // none before the first frame
  std::optional<Motion> ahead;             // that belief's, where it was asked for before the frame came
  double contact_until = kNever;           // s, end of the time in which the motion is assumed to depart from the model
  math::VectorX place;                     // shares of the links' ends in the unknown force, as learned in contact
  double last_seen = kNever;               // s, last frame in which the masks showed the rope
  double last_like = kNever;               // s, last frame in which the colors in the masks were like the twin's
  double last_misfit = kNever;             // s, last frame whose masks may be another rope's, or not all of it
  double last_doubt = kNever;              // s, last frame that gave reason to doubt, its colors included
  int frames = 0;                          // in which something was seen
  bool lost = false;                       // in the last frame
  bool whole = false;                      // the masks have shown the whole rope since it was found
  double hidden_since = kNever;            // s, first frame since it was found
  double surprising = 0.0;                 // share of the last frames whose innovation nothing explains, fading
  std::optional<dynamics::Roller> roller;  // where the twin knows how the rope rolls on a table
  math::VectorX roll;                      // rad, of the links' material in this frame; empty: not known
  double edge_offset = 0.0, edge_offset_variance = 0.0;  // px, px^2, of the masks' outline outside the tube's
};

// Throws InputError where the twin's chain or parameters are unusable.
Given given_by(const twin::Twin& twin, const std::vector<capture::Camera>& cameras, dynamics::BaseFunction base,
               double base_start);
// The state before the first frame; arguments as those of Filter.
State start(const twin::Twin& twin, const std::vector<capture::Camera>& cameras, dynamics::BaseFunction base,
            double base_start, const Options& options = {}, const std::vector<char>& unverified = {},
            CompareColors compare_colors = {});

// As Filter::base_at().
trajectory::BaseMotion base_at(const State& state, double time);

// As Filter::update().
Estimate update(State& state, std::span<const capture::View* const> views);

inline void symmetrize(math::MatrixX& matrix) { matrix = (0.5 * (matrix + matrix.transpose())).eval(); }

}  // namespace chainsplat::estimation
