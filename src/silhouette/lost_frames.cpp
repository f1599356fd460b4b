// Frames that a camera lost, as jumps of its clock against the base's and the other cameras'.
#include <algorithm>
#include <cmath>
#include <utility>

#include "chainsplat/core.h"
#include "src/math/decompositions.h"
#include "src/silhouette/correction_equations.h"
#include "src/silhouette/frame.h"

namespace chainsplat::silhouette {

using math::MatrixX;
using math::VectorX;

namespace {

constexpr double kWidestCut = 30.0;  // px: outlines of another moment still count
// Frames by which a jump is judged. Others may follow soon, so that few after it count; those before it are mended.
constexpr std::size_t kBefore = 20, kAfter = 12;
// What it must explain of the square residuals in them. In recordings without jumps, with all other faults of
// docs/figures.md, none explains so much.
constexpr double kLeastShare = 0.02, kLeastGain = 0.006;                      // share, and px^2 / 2
constexpr double kLeastJump = 0.6, kLargestJump = 1.4;                        // frames that one may seem to be
constexpr double kWrongTurn = 0.01, kWrongPlace = 0.01, kWrongLength = 0.05;  // rad, m, share: deviations of the rest

// Of one frame, about the clocks as they are, in frame intervals by which each camera's stamps are late; the angles are
// eliminated.
struct ClockEquations {
  MatrixX information;
  VectorX gradient;
  double cost = 0.0, weight = 0.0;  // of the outlines: half the sum of weighted px^2, and that of the weights
  std::vector<int> frame;           // of each camera, -1: none
};

// The cameras' clocks come first, in frame intervals; then what else may be wrong, in wide deviations.
std::vector<SharedPlaces> places_of_clocks(const capture::Capture& capture, int& size) {
  SharedPlaces all;
  all.at.fill(-1);
  std::vector<SharedPlaces> out(capture.cameras.size(), all);
  size = static_cast<int>(out.size());
  const auto vary = [&](SharedPlaces& of, int quantity, int at, double unit) {
    of.at[quantity] = at;
    of.unit[quantity] = unit;
  };
  for (std::size_t c = 0; c < out.size(); ++c) {
    vary(out[c], kCameraTime, static_cast<int>(c), capture::frame_interval(capture, static_cast<int>(c)));
    for (int i = 0; i < 3; ++i) {
      vary(out[c], kRotation + i, size + i, kWrongTurn);
      vary(out[c], kTranslation + i, size + 3 + i, kWrongPlace);
    }
    size += 6;
  }
  for (SharedPlaces& of : out) {
    for (int i = 0; i < 3; ++i) vary(of, kGrasp + i, size + i, kWrongPlace);
    vary(of, kLength, size + 3, kWrongLength * capture.length);
  }
  size += 4;
  return out;
}

std::vector<ClockEquations> clock_equations(const chain::Chain& chain, const capture::Capture& capture,
                                            const SequenceFit& sequence) {
  const int cameras = static_cast<int>(capture.cameras.size());
  const Frames all = frames_of(capture);
  CorrectionProblem problem{views_of(capture),
                            capture.cameras,
                            [&](double time) { return capture.base.at(time); },
                            {},
                            0,
                            {},
                            kAsRecognized * joint_prior(chain, {}),
                            {},
                            kWidestCut};
  problem.places = places_of_clocks(capture, problem.shared);
  for (int k = 0; k < chain.angles(); ++k) problem.held.push_back(chain::is_twist(chain, k));
  std::vector<int> seen;
  for (int f = 0; f < static_cast<int>(all.times.size()); ++f)
    if (!all.views[f].empty() && sequence.frames[f].residual_pixels > 0.0) seen.push_back(f);
  std::vector<ClockEquations> equations(seen.size());
  core::parallel_for(static_cast<std::int64_t>(seen.size()), [&](std::int64_t i) {
    const int f = seen[i];
    CorrectedFrame frame{all.times[f], sequence.states.thetadot[f], all.views[f], {}};
    ClockEquations& out = equations[i];
    out.frame.assign(cameras, -1);
    for (const int v : frame.views) {
      frame.masks.push_back(mask_of(capture, v));
      out.frame[capture.views[v].camera] = capture.views[v].frame;
    }
    const FrameEquations of = frame_equations(problem, frame, {}, chain, sequence.states.theta[f]);
    const auto solver = of.local.matrix.ldlt();
    out.information = of.shared - of.local.coupling.transpose() * solver.solve(of.local.coupling);
    out.gradient = of.shared_gradient - of.local.coupling.transpose() * solver.solve(of.local.gradient);
    for (const FrameEquations::Sums& sums : of.sums) out.cost += 0.5 * sums.second, out.weight += sums.weight;
  });
  return equations;
}

struct Candidate {
  LostFrame lost;
  double gain = 0.0;  // by which the cost of the frames around it falls
};

// The camera whose clock jumps between frames i - 1 and i, if one does, judged by those around them; what does not
// change there is free.
Candidate jump_before(const std::vector<ClockEquations>& equations, std::size_t i) {
  const Eigen::Index cameras = static_cast<Eigen::Index>(equations[i].frame.size()),
                     size = equations[i].gradient.size();
  const std::size_t first = i > kBefore ? i - kBefore : 0, last = std::min(equations.size(), i + kAfter);
  MatrixX information = MatrixX::Identity(size, size);  // priors
  VectorX gradient = VectorX::Zero(size), after = VectorX::Zero(size);
  MatrixX coupling = MatrixX::Zero(size, size);
  double cost = 0.0, weight = 0.0;
  for (std::size_t k = first; k < last; ++k) {
    information += equations[k].information;
    gradient += equations[k].gradient;
    cost += equations[k].cost;
    weight += equations[k].weight;
    if (k < i) continue;
    coupling += equations[k].information;
    after += equations[k].gradient;
  }
  const auto constant = information.ldlt();
  Candidate best;
  for (Eigen::Index c = 0; c < cameras; ++c) {
    if (equations[i].frame[c] < 0) continue;
    const VectorX response = constant.solve(VectorX(coupling.col(c)));
    const double curvature = coupling(c, c) - coupling.col(c).dot(response), slope = after[c] - response.dot(gradient);
    if (!(curvature > 0.0)) continue;
    const double frames = -slope / curvature;  // later by so many frames from there on
    if (frames > -kLeastJump || frames < -kLargestJump) continue;
    const double gain = std::abs(slope) - 0.5 * curvature;  // of a whole frame
    if (gain <= std::max({best.gain, kLeastShare * cost, kLeastGain * weight})) continue;
    best = {{static_cast<int>(c), equations[i].frame[c]}, gain};
  }
  return best;
}

}  // namespace

LostFrames find_lost_frames(const chain::Chain& chain, const capture::Capture& capture, const SequenceFit& sequence) {
  const std::vector<ClockEquations> equations = clock_equations(chain, capture, sequence);
  LostFrames out;
  double cost = 0.0, weight = 0.0;
  for (const ClockEquations& frame : equations) cost += frame.cost, weight += frame.weight;
  if (weight > 0.0) out.misfit = 2.0 * cost / weight;
  std::vector<std::pair<std::size_t, Candidate>> found;  // and before which frame
  for (std::size_t i = 1; i < equations.size(); ++i)
    if (const Candidate one = jump_before(equations, i); one.gain > 0.0) found.emplace_back(i, one);
  while (!found.empty()) {
    const auto [at, best] = *std::max_element(
        found.begin(), found.end(), [](const auto& a, const auto& b) { return a.second.gain < b.second.gain; });
    out.likely.push_back(best.lost);
    std::erase_if(found, [at = at](const auto& other) {
      return std::max(at, other.first) - std::min(at, other.first) <= kAfter;
    });
  }
  return out;
}

}  // namespace chainsplat::silhouette
