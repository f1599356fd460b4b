// Private to identification: recordings, ready to be compared with rollouts, and the unknowns of all of them.
#pragma once
#include <limits>
#include <memory>

#include "unknowns.h"

namespace chainsplat::identification {

inline constexpr double kInfinity = std::numeric_limits<double>::infinity();
// Model errors of neighbors in space and time are alike: so many count as one.
inline constexpr double kCorrelated = 9.0;
inline constexpr std::size_t kLeastTimes = 3;  // of a recording

// One recording, its own unknowns after the shared ones.
struct Part {
  const chain::Chain& chain;
  Unknowns unknowns;
  std::vector<double> times;
  std::vector<chain::MaterialPoint> points;  // that are compared
  std::vector<MatrixX> target;               // per frame: 3 x points, base frame
  std::vector<VectorX> theta;                // recognized
  // a frame: of the angles, n x n, in the metric of the points; of markers, 3 x 3 blocks side by side. Copies of a part
  // share them, since of many angles they are nearly all of it.
  std::shared_ptr<const std::vector<MatrixX>> whitening;
  dynamics::BaseGrid grids[2];        // half the substeps, for the way to the minimum, and all of them
  std::vector<std::size_t> nodes[2];  // of the grid, up to and with each output
  bool has_markers = false;           // the points are markers; unseen ones have no weight
  // of the first link, world axes, in the mean: of a rope that swings that in which it hangs
  math::Vector3 direction = math::Vector3::Zero();
  Start start = {};
};

// All recordings. The unknowns: those that are shared, then the initial state of each recording.
struct Problem {
  const chain::Chain& chain;
  std::vector<Part> parts;
  int shared = 0;
  VectorX mean;
  MatrixX precision;
  // Of a chain of many joints: what a fit may change the unknowns of a part by, unknowns x modes, the first ones the
  // shared unknowns alone and the others its initial state; empty: everything.
  MatrixX modes = {};
  int shared_modes = 0;
  Rod rod = {};  // that the unknowns of the parts are about

  int own() const { return parts[0].unknowns.size() - shared; }
  // where the unknowns of a recording are among all: `shared` and then its own
  VectorX of_part(const VectorX& p, std::size_t part) const {
    VectorX out(shared + own());
    out << p.head(shared), p.segment(shared + part * own(), own());
    return out;
  }
  auto modes_of_shared() const { return modes.topLeftCorner(modes.size() > 0 ? shared : 0, shared_modes); }
  auto modes_of_own() const {
    return modes.bottomRightCorner(modes.size() > 0 ? own() : 0, modes.cols() - shared_modes);
  }
  Eigen::Index coordinates() const {
    return shared_modes + static_cast<Eigen::Index>(parts.size()) * (modes.cols() - shared_modes);
  }
  // p with all modes moved by x.
  VectorX moved(const VectorX& p, const VectorX& x) const {
    VectorX out = p;
    out.head(shared) += modes_of_shared() * x.head(shared_modes);
    const Eigen::Index each = modes.cols() - shared_modes;
    for (Eigen::Index i = 0; i < static_cast<Eigen::Index>(parts.size()); ++i)
      out.segment(shared + i * own(), own()) += modes_of_own() * x.segment(shared_modes + i * each, each);
    return out;
  }
};

// With `markers` the points that are compared are theirs, else the centerline's. Throws InputError where the recognized
// states are too few, not finite or of another chain.
Part make_part(const chain::Chain& chain, const trajectory::Trajectory& base, const chain::States& recognized,
               const Options& options, const Markers* markers = nullptr);

Problem make_problem(const chain::Chain& chain, std::vector<Part> parts);

// Points of the centerline in the base frame and, where asked, their derivatives by theta.
void place_points(const Part& part, const VectorX& theta, MatrixX& points, std::vector<MatrixX>* slopes);

// How many of a part's times lie within `horizon` seconds of its first; three at least, as far as there are any.
std::size_t frames_within(const Part& part, double horizon);

// The base up to and with the first `frames` times.
dynamics::BaseGrid prefix(const Part& part, std::size_t frames, bool fine);

// m, root mean square distance of a rollout from the markers that are seen, or from the recognized links' ends.
double rms_of(const Part& part, const chain::States& rollout);

}  // namespace chainsplat::identification
