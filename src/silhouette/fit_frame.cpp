#include <algorithm>
#include <cmath>
#include <limits>

#include "src/math/decompositions.h"
#include "src/silhouette/observations.h"

namespace chainsplat::silhouette {

using math::MatrixX;
using math::Pose;
using math::Vector3;
using math::VectorX;

namespace {

constexpr double kSameAxis = 0.5;  // cosine; the axes of a joint are perpendicular, so anything between 0 and 1

// coarse stage
constexpr double kFarHuber = 50.0;       // px, before `huber_pixels` takes over: everything pulls
constexpr double kFarShare = 1.0 / 3.0;  // share of the coarse iterations with kFarHuber
constexpr double kCoarseVariance = 100;  // px^2, what a mask pixel's distance says about the centerline: half widths,
                                         // strongly correlated; scales the priors
constexpr double kCoarseStep = 1e-3;     // rad, smaller steps end the stage
constexpr double kLongestStep = 0.5;     // rad, largest change of an angle in one step
constexpr double kReach = 5.0;           // diameters: farther from the prediction (median) a blob is not the rope
constexpr double kLastReach = 1.0;       // the same after the coarse stage

// fine stage
constexpr double kFirstCut = 8.0;   // px, Tukey's cut-off before residuals are known
constexpr double kFineStep = 1e-5;  // rad

// priors, rad
constexpr double kJointDifference = 0.3;  // between neighboring joints of eight, along one axis
constexpr double kJointSize = 1.5;        // of an angle
constexpr double kWarmChange = 0.2;       // from the frame before: 6 rad/s at 30 Hz
constexpr double kTwist = 0.5;            // unseen by silhouettes, held

// px^2, an outline point counts as one observation of this variance: noise of 0.3 px, correlated over some ten pixels,
// and what straight links cannot follow. Chosen so that three deviations hold on captures with truth.
constexpr double kFineVariance = 1.0;

// cold start
constexpr double kStartBend = 1.5;                  // rad, whole bend of the extra starts
constexpr double kAlike = 1.5, kAlikePixels = 2.0;  // costs under this times the best, plus this (px^2), are alike

constexpr double kClearly = 0.02;    // difference of shares covered and inside
constexpr double kExplained = 0.97;  // share of the masks; where less is, what was taken for hidden may be there
constexpr double kAllowed = 9.0;     // square deviations of the given prior per number, up to which it allows a fit

// What is believed before looking, as information.
struct Belief {
  MatrixX joints;         // between neighbors, and that angles are small
  MatrixX all;            // with the frame before or the caller's prior
  VectorX weighted_mean;  // sum of each part's information times its mean
  VectorX pull(const VectorX& state) const { return weighted_mean - all * state; }
};

// Puts the chain and the masks where the unknowns say: the angles, with `shifts` two numbers per view, the edge offset.
void place(Problem& problem, const VectorX& unknowns) {
  const int n = problem.chain->angles();
  for (std::size_t v = 0; problem.shifts && v < problem.views.size(); ++v)
    problem.views[v].shift = unknowns.segment<2>(n + 2 * static_cast<int>(v));
  pose(problem, unknowns.head(n));
}

// What is known of the masks' edge offset. Without weight it is held.
struct OffsetBelief {
  double mean = 0.0, weight = 0.0;
};

// Adds priors to the equations of the masks, and takes the unknowns that are held out of them.
void add_priors(Problem& problem, const Belief& belief, double variance, const OffsetBelief& offset,
                const VectorX& unknowns) {
  const int n = problem.chain->angles(), last = problem.unknowns() - 1;
  problem.normal.topLeftCorner(last, last) += variance * belief.all;
  problem.right.head(last) += variance * belief.pull(unknowns.head(last));
  problem.normal(last, last) += offset.weight;
  problem.right[last] += offset.weight * (offset.mean - unknowns[last]);
  for (int k = 0; k <= last; ++k) {
    if (k < n ? !problem.held[k] : k < last || offset.weight > 0.0) continue;
    problem.normal.row(k).setZero();
    problem.normal.col(k).setZero();
    problem.normal(k, k) = 1.0;
    problem.right[k] = 0.0;
  }
}

// Gauss-Newton. `equations` puts the unknowns in place, fills the equations with priors and returns the cost.
template <class Equations>
solve::Summary gauss_newton(Problem& problem, int steps, double step_tolerance, Equations&& equations,
                            VectorX& unknowns) {
  if (steps < 1) return {};
  solve::Callbacks callbacks;
  callbacks.evaluate = [&](const VectorX& at, bool) { return equations(at); };
  callbacks.step = [&](double, VectorX& step) {
    step = problem.normal.ldlt().solve(problem.right);
    return true;
  };
  return solve::least_squares(unknowns, callbacks,
                              {.steps = steps,
                               .checked = false,
                               .step_tolerance = step_tolerance,
                               .longest = kLongestStep,
                               .measured = problem.chain->angles()});
}

void coarse_stage(Problem& problem, const Belief& belief, int iterations, bool choose, const Options& options,
                  VectorX& unknowns) {
  int i = 0;
  const int far = static_cast<int>(std::ceil(kFarShare * iterations));
  const auto equations = [&](const VectorX& at) {
    place(problem, at);
    if (choose) choose_blobs(problem, i == 0 ? kReach : kReach + (kLastReach - kReach) * i / iterations);
    coarse_equations(problem, i < far ? kFarHuber : options.huber_pixels);
    add_priors(problem, belief, kCoarseVariance, {}, at);
    ++i;
    return std::numeric_limits<double>::quiet_NaN();  // the blobs and the loss change from step to step
  };
  gauss_newton(problem, far, 0.0, equations, unknowns);
  i = far;
  gauss_newton(problem, iterations - far, kCoarseStep, equations, unknowns);
}

// Tukey's cut-off that the last residuals call for.
double next_cut(Problem& problem, double cut) {
  if (problem.sizes.empty()) return cut;
  return std::clamp(robust_cut(problem.sizes), kLeastCut, kLargestCut);
}

// `start`, and bends to every side, of one size.
std::vector<VectorX> cold_starts(const chain::Chain& chain, const VectorX& start) {
  std::vector<VectorX> starts{start};
  std::vector<int> first;  // angles of the first joint: their axes
  for (int k = 0; k < chain.angles() && chain.child_link[k] == chain.child_link[0]; ++k) first.push_back(k);
  const int joints = chain.links() - 1;
  for (const int axis : first) {
    const Vector3 about = chain.axes[axis].head<3>();
    if (chain::is_twist(chain, axis)) continue;
    for (const double sign : {1.0, -1.0}) {
      VectorX bent = VectorX::Zero(chain.angles());
      for (int k = 0; k < chain.angles(); ++k)
        if (std::abs(chain.axes[k].head<3>().dot(about)) > kSameAxis) bent[k] = sign * kStartBend / joints;
      starts.push_back(bent);
    }
  }
  return starts;
}

}  // namespace

MatrixX joint_prior(const chain::Chain& chain, const Options& options) {
  const int n = chain.angles();
  const double deviation = options.joint_smoothness > 0.0 ? 1.0 / std::sqrt(options.joint_smoothness)
                                                          : chain::neighbor_difference(chain, kJointDifference);
  MatrixX information = MatrixX::Identity(n, n) / (kJointSize * kJointSize);
  information += chain::curvature_information(chain, deviation);
  const double difference = 1.0 / (deviation * deviation);
  // no moment bends the free end
  for (int k = 0; k < n; ++k)
    if (chain.child_link[k] + 1 == chain.links()) information(k, k) += difference;
  return information;
}

namespace {

// One frame being fitted.
struct Work {
  const Options& options;
  Problem problem;
  Belief belief = {};
  OffsetBelief offset = {};
  VectorX unknowns = {};  // angles, masks' shifts where they are unknown, edge offset
  FineSums total = {};    // of the last fine equations
  bool hiding = false;    // a part may be hidden
  FrameSolution out = {};

  int angles() const { return problem.chain->angles(); }
  int last() const { return problem.unknowns() - 1; }  // index of the edge offset
};

Problem make_problem(const chain::Chain& chain, const std::vector<FrameView>& views, const Options& options) {
  Problem problem;
  problem.chain = &chain;
  problem.held.assign(chain.angles(), 0);
  for (int k = 0; k < chain.angles(); ++k) problem.held[k] = chain::is_twist(chain, k);
  for (const FrameView& view : views) {
    ViewWork work;
    work.view = &view;
    work.camera_from_base = view.camera->world_from_camera.inverse() * view.base;
    work.sums.normal.resize(chain.links());
    work.sums.right.resize(chain.links());
    const double depth = std::max(kNear, work.camera_from_base.translation.z());
    work.diameter = chain.diameter * 0.5 * (view.camera->fx + view.camera->fy) / depth;
    work.active.assign(view.mask->blobs.size(), 0);
    problem.views.push_back(std::move(work));
  }
  problem.shifts = options.prior.mean.size() == chain.angles() + 2 * static_cast<int>(views.size());
  return problem;
}

bool has_prior(const Work& work) {
  return work.options.prior.mean.size() == work.last() && work.options.prior.information.rows() == work.last();
}

// The joints' own prior, and what is known of this frame: the given prior, or, where `warm`, that it is near `start`.
Belief make_belief(const Work& work, const VectorX& start, bool warm) {
  const int n = work.angles(), last = work.last();
  Belief belief;
  belief.joints = MatrixX::Zero(last, last);
  belief.joints.topLeftCorner(n, n) = joint_prior(*work.problem.chain, work.options);
  belief.all = belief.joints;
  belief.weighted_mean = VectorX::Zero(last);
  if (has_prior(work)) {
    belief.all += work.options.prior.information;
    belief.weighted_mean += work.options.prior.information * work.options.prior.mean;
  } else if (warm) {
    const double weight = 1.0 / (kWarmChange * kWarmChange);
    belief.all.diagonal().head(n).array() += weight;
    belief.weighted_mean.head(n) += weight * start;
  }
  return belief;
}

// Tells apart fits that cover the masks alike.
double edge_cost(const FineSums& total) { return total.length > 0 ? total.capped_square / total.length : 0.0; }

// Masks' shifts as the prior expects them.
void reset_shifts(Work& work) {
  if (work.problem.shifts)
    work.unknowns.segment(work.angles(), work.last() - work.angles()) =
        work.options.prior.mean.tail(work.last() - work.angles());
}

// Fits the masks' outlines from `theta`; leaves the equations at its result in `work.problem`.
void fine_stage(Work& work, const VectorX& theta) {
  Problem& problem = work.problem;
  const int last = work.last();
  work.unknowns.head(work.angles()) = theta;
  reset_shifts(work);
  work.unknowns[last] = work.offset.mean;
  place(problem, work.unknowns);
  choose_blobs(problem, kLastReach);
  if (work.hiding) find_hidden(problem, kHiddenReach, kFirstCut);
  double cut = kFirstCut;
  const auto equations = [&](const VectorX& at) {
    place(problem, at);
    work.total = fine_equations(problem, at[last], cut);
    cut = next_cut(problem, cut);
    add_priors(problem, work.belief, kFineVariance, work.offset, at);
    return edge_cost(work.total);
  };
  const int steps = std::max(1, work.options.iterations - work.options.iterations / 2);
  work.out.fit.summary = gauss_newton(problem, steps, kFineStep, equations, work.unknowns);
  place(problem, work.unknowns);
  work.total = fine_equations(problem, work.unknowns[last], cut);
  work.out.fit.summary.final_cost = edge_cost(work.total);
}

// The angles from which the fine stage starts where the frame before is known.
VectorX warm_angles(Work& work, const VectorX& start) {
  work.unknowns.head(work.angles()) = start;
  if (work.hiding) {
    place(work.problem, work.unknowns);
    choose_blobs(work.problem, kReach);
    find_hidden(work.problem, kHiddenReach, 0.0);
  }
  coarse_stage(work.problem, work.belief, std::max(1, work.options.iterations / 2), true, work.options, work.unknowns);
  return work.unknowns.head(work.angles());
}

// Whether the given prior allows the unknowns. It does where there is none.
bool allowed(const Work& work) {
  if (!has_prior(work)) return true;
  const VectorX off = work.unknowns.head(work.last()) - work.options.prior.mean;
  return off.dot(work.options.prior.information * off) <= kAllowed * static_cast<double>(off.size());
}

// The same where nothing is known but perhaps a wide prior: of the fits from bends to every side that cover the masks
// about as well as the best one, the one whose outlines fit best. Those do not count that explain less than another, or
// cover no more than another that the prior allows while it does not allow them.
VectorX cold_angles(Work& work, const VectorX& start) {
  Problem& problem = work.problem;
  const Options& options = work.options;
  struct Candidate {
    VectorX theta;
    FrameFit fit;
    double cost = 0.0;
    bool allowed = true;
  };
  std::vector<Candidate> found;
  for (const VectorX& cold : cold_starts(*problem.chain, start)) {
    // first what hangs together with the grasp, whatever its distance; then what lies near the rope found
    work.unknowns.head(work.angles()) = cold;
    place(problem, work.unknowns);
    choose_blobs(problem, 0.0);
    coarse_stage(problem, work.belief, options.first_iterations, false, options, work.unknowns);
    coarse_stage(problem, work.belief, std::max(1, options.iterations / 2), true, options, work.unknowns);
    place(problem, work.unknowns);
    judge(problem, work.out);
    found.push_back({work.unknowns.head(work.angles()), work.out.fit, work.out.cost, allowed(work)});
  }
  const auto beaten = [](const Candidate& one, const Candidate& other) {
    const bool covers_as_much = other.fit.covered > one.fit.covered - kClearly;
    return explains_less(one.fit, other.fit) || (!one.allowed && other.allowed && covers_as_much);
  };
  double best = std::numeric_limits<double>::infinity();
  for (Candidate& one : found) {
    if (std::any_of(found.begin(), found.end(), [&](const Candidate& other) { return beaten(one, other); }))
      one.cost = std::numeric_limits<double>::infinity();
    best = std::min(best, one.cost);
  }
  double best_edge_cost = std::numeric_limits<double>::infinity();
  VectorX theta = start;
  for (const Candidate& one : found) {
    if (one.cost > kAlike * best + kAlikePixels) continue;
    fine_stage(work, one.theta);
    if (edge_cost(work.total) < best_edge_cost) {
      best_edge_cost = edge_cost(work.total);
      theta = work.unknowns.head(work.angles());
    }
  }
  return theta;
}

// Information and gradient of the angles (and shifts) without the edge offset, which is marginalized; held angles have
// none. The joints' prior is in them, the given one is not.
void take_information(Work& work) {
  const Problem& problem = work.problem;
  const int last = work.last();
  FrameSolution& out = work.out;
  const double offset_normal = problem.normal(last, last) + work.offset.weight;
  const double offset_right = problem.right[last] + work.offset.weight * (work.offset.mean - work.unknowns[last]);
  const VectorX coupling = problem.normal.col(last).head(last);
  out.information =
      (problem.normal.topLeftCorner(last, last) - coupling * coupling.transpose() / offset_normal) / kFineVariance;
  out.gradient = (problem.right.head(last) - coupling * (offset_right / offset_normal)) / kFineVariance;
  for (int k = 0; k < work.angles(); ++k) {
    if (!problem.held[k]) continue;
    out.information.row(k).setZero();
    out.information.col(k).setZero();
    out.gradient[k] = 0.0;
  }
  out.information += work.belief.joints;
  out.gradient -= work.belief.joints * VectorX(work.unknowns.head(last));
}

// The posterior covariance, the given prior included.
MatrixX covariance_of(const Work& work) {
  const int last = work.last();
  MatrixX posterior = work.out.information;
  for (int k = 0; k < work.angles(); ++k)
    if (work.problem.held[k]) posterior(k, k) += 1.0 / (kTwist * kTwist);
  if (has_prior(work)) posterior += work.options.prior.information;
  return posterior.ldlt().solve(MatrixX::Identity(last, last));
}

}  // namespace

bool explains_less(const FrameFit& a, const FrameFit& b) {
  return a.covered < b.covered - kClearly && a.inside < b.inside - kClearly;
}

namespace {

// `hiding`: a part of the rope may be hidden where `start` is near.
FrameSolution solve_once(const chain::Chain& chain, const std::vector<FrameView>& views, const VectorX& start,
                         bool warm, bool hiding, const Options& options) {
  Work work{options, make_problem(chain, views, options)};
  work.offset = {options.edge_offset, 1.0 / (options.edge_offset_deviation * options.edge_offset_deviation)};
  work.belief = make_belief(work, start, warm);
  work.unknowns = VectorX::Zero(work.problem.unknowns());
  work.hiding = warm && hiding;
  reset_shifts(work);

  const VectorX near = warm ? warm_angles(work, start) : cold_angles(work, start);
  work.hiding = hiding;
  fine_stage(work, near);

  take_information(work);
  FrameFit& fit = work.out.fit;
  const int n = work.angles();
  fit.theta = work.unknowns.head(n);
  if (work.problem.shifts) fit.mask_shift = work.unknowns.segment(n, work.last() - n);
  fit.covariance = covariance_of(work);
  fit.edge_offset = work.unknowns[work.last()];
  fit.residual_pixels = work.total.weight > 0 ? std::sqrt(work.total.weighted_square / work.total.weight) : 0.0;
  judge(work.problem, work.out);
  return std::move(work.out);
}

}  // namespace

FrameSolution solve_frame(const chain::Chain& chain, const std::vector<FrameView>& views, const VectorX& start,
                          bool warm, const Options& options) {
  FrameSolution out = solve_once(chain, views, start, warm, true, options);
  if (!warm || out.fit.covered + out.fit.foreign > kExplained) return out;
  FrameSolution seen = solve_once(chain, views, start, warm, false, options);
  return seen.fit.covered > out.fit.covered + kClearly ? std::move(seen) : std::move(out);
}

FrameFit fit_frame(const chain::Chain& chain, const Pose& base, std::span<const capture::View* const> views,
                   const std::vector<capture::Camera>& cameras, const VectorX& start, bool warm,
                   const Options& options) {
  std::vector<MaskPoints> masks;
  masks.reserve(views.size());
  std::vector<FrameView> frame_views;
  for (const capture::View* const view : views) {
    const capture::Camera& camera = cameras.at(view->camera);
    masks.push_back(mask_points(*view, camera, options.max_pixels));
    frame_views.push_back({&masks.back(), &camera, base});
  }
  return solve_frame(chain, frame_views, start, warm, options).fit;
}

}  // namespace chainsplat::silhouette
