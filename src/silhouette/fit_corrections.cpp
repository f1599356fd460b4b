#include <algorithm>
#include <cmath>
#include <numeric>

#include "chainsplat/core.h"
#include "src/math/decompositions.h"
#include "src/math/usual.h"
#include "src/silhouette/correction_priors.h"

namespace chainsplat::silhouette {

using capture::Correction;
using capture::CorrectionState;
using math::MatrixX;
using math::Vector6;
using math::VectorX;

namespace {

// Gauss-Newton. Outlines farther from the rope than a cut do not count (Tukey); it starts wide, since what is given may
// be wrong by many pixels, and narrows until the residuals' own spread sets it.
constexpr int kSteps = 40;
constexpr double kStep = 0.02;               // of the prior deviations, and rad: smaller steps end it
constexpr double kLongestCorrection = 50.0;  // the same, in one step
constexpr double kWidestCut = 30.0;          // px
constexpr double kNarrowing = 0.6;           // of that cut from step to step
constexpr double kWideEnd = 8.0;             // half widths: the reach of the free end as long as the cut is wide
constexpr double kLeastSize = 0.5;           // share of the given length and diameter below which no correction goes
// A finger's edge that crosses the cut face leaves outlines that scatter by 1 / sqrt(12) of what it covers at one side,
// and it covers half of that in the mean.
constexpr double kCovered = 1.7321;
constexpr double kRound = 0.25;  // deviation of how far the cut face reaches beyond its middle, of what a flat one does
constexpr double kUnknownShare = 0.7;  // of the prior's deviation there above which a value is the prior's
constexpr int kTimeStretches = 12;     // of time, whose scatter tells what the equations do not know
constexpr double kHeld = 1e12;         // information that holds an unknown, in units of its deviation
constexpr double kExact = 1e-4;        // of the prior's deviation, below which it was held so
constexpr double kSameClock = 1e-9;    // s
constexpr double kAgree = 0.003;       // s, by which clocks that are right differ at most

// How little each camera's masks tell of where the rope leaves the gripper, m along it. Fingers have another shape than
// the rope's cut face, so that the outline there scatters more than elsewhere; and no cut is quite flat.
std::vector<double> start_deviations(const std::vector<FrameEquations>& frames) {
  std::vector<FrameEquations::Sums> sums(frames.front().sums.size());
  for (const FrameEquations& frame : frames)
    for (std::size_t c = 0; c < sums.size(); ++c) {
      sums[c].weight += frame.sums[c].weight;
      sums[c].second += frame.sums[c].second;
      sums[c].start_weight += frame.sums[c].start_weight;
      sums[c].start_first += frame.sums[c].start_first;
      sums[c].start_second += frame.sums[c].start_second;
      sums[c].start_speed += frame.sums[c].start_speed;
      sums[c].start_bulge += frame.sums[c].start_bulge;
    }
  std::vector<double> out(sums.size(), 0.0);
  for (std::size_t c = 0; c < sums.size(); ++c) {
    const FrameEquations::Sums& s = sums[c];
    if (!(s.start_speed > 0.0)) continue;
    const double mean = s.start_first / s.start_weight, bulge = s.start_bulge / s.start_weight;
    const double excess = s.start_second / s.start_weight - mean * mean - s.second / s.weight;
    out[c] = std::hypot(kCovered * std::sqrt(std::max(0.0, excess)), kRound * bulge) * s.start_weight / s.start_speed;
  }
  return out;
}

chain::Chain resized(const chain::Chain& chain, double length, double diameter) {
  chain::Chain out = chain;
  const double ratio = length / chain.length;
  out.length = length;
  out.diameter = diameter;
  for (double& arclength : out.joint_arclength) arclength *= ratio;
  for (Vector6& axis : out.axes) axis.tail<3>() *= ratio;  // -w x (s d)
  return out;
}

// The rope's size and lift with these corrections. A size that is off by more than half is refused by the verdict
// anyway, and must not become negative on the way there.
chain::Chain changed(const chain::Chain& given, const std::optional<Lying>& lying,
                     const capture::Corrections& corrections) {
  const auto size = [&](double before, const char* quantity) {
    return std::max(kLeastSize * before, before + capture::value_of(corrections, "object", quantity));
  };
  chain::Chain out = resized(given, size(given.length, "length"), size(given.diameter, "diameter"));
  if (lying)
    // a thicker rope lies higher
    out.lift = lying_down(
        out, height_with(out, *lying, capture::grasp_in_base(corrections).translation,
                         capture::value_of(corrections, "table", "height") + 0.5 * (out.diameter - given.diameter)));
  return out;
}

std::vector<FrameEquations> all_equations(const CorrectionProblem& problem, const Layout& layout,
                                          const chain::Chain& given, const VectorX& x) {
  const int m = layout.size, n = given.angles();
  const capture::Corrections corrections = corrections_at(layout, problem.cameras, x.head(m));
  const chain::Chain chain = changed(given, problem.lying, corrections);
  std::vector<FrameEquations> out(problem.frames.size());
  core::parallel_for(static_cast<std::int64_t>(out.size()), [&](std::int64_t f) {
    out[f] = frame_equations(problem, problem.frames[f], corrections, chain, x.segment(m + f * n, n));
  });
  return out;
}

double cut_of(const std::vector<FrameEquations>& frames) {
  std::vector<double> sizes;
  for (const FrameEquations& frame : frames) sizes.insert(sizes.end(), frame.sizes.begin(), frame.sizes.end());
  return robust_cut(sizes);
}

// What is known of the shared unknowns beside the outlines, at x.
struct Known {
  MatrixX information;
  VectorX gradient;
};

void add_table(const capture::Capture& capture, const Layout& layout, const VectorX& x, Known& known) {
  if (!capture.table) return;
  for (const Column& column : layout.columns) {
    if (column.first < 0 || column.quantity->subject != std::string("grasp") ||
        column.quantity->name != std::string("rotation"))
      continue;
    const Vector3 normal = capture.base.pose(capture.base.start()).rotation.transpose() * capture.table->normal;
    const Vector3 axis = math::exp_so3(column.deviation * x.segment<3>(column.first)) * capture.bending_axis;
    const TiltEquations tilt = tilt_equations(axis, normal);
    known.information.block<3, 3>(column.first, column.first) += column.deviation * column.deviation * tilt.information;
    known.gradient.segment<3>(column.first) += column.deviation * tilt.gradient;
  }
}

Known known_at(const capture::Capture& capture, const Layout& layout, const VectorX& x, Starts starts,
               const std::vector<FrameEquations>& frames, const MatrixX& held) {
  const SharedPrior prior = shared_prior(layout, x, starts, start_deviations(frames));
  Known known{MatrixX(prior.information.asDiagonal()) + held, prior.gradient + held * x};
  add_table(capture, layout, x, known);
  return known;
}

solve::ArrowEquations arrow_of(const std::vector<FrameEquations>& frames, const Known& known) {
  solve::ArrowEquations arrow;
  arrow.shared = known.information;
  arrow.gradient = known.gradient;
  for (const FrameEquations& frame : frames) {
    arrow.shared += frame.shared;
    arrow.gradient += frame.shared_gradient;
    arrow.local.push_back(frame.local);
  }
  return arrow;
}

// Each thing that may be all that is wrong, and what it leaves of the evidence. `x`: all that was found.
std::vector<Cause> causes_of(const Layout& layout, const std::vector<capture::Camera>& cameras,
                             const MatrixX& information, const std::vector<double>& start_deviations, const VectorX& x,
                             double squares) {
  const auto [cost, follow, starts, others] = cost_of_change(layout, information);
  std::vector<Cause> out;
  for (const Direction& d : single_causes(layout, cameras)) {
    const MatrixX cost_of = d.directions.transpose() * cost;
    const VectorX along = MatrixX(cost_of * d.directions).completeOrthogonalDecomposition().solve(VectorX(cost_of * x));
    VectorX alone = d.directions * along;
    const VectorX left = x - alone;
    if (!starts.empty()) alone(starts) = VectorX(x(starts)) - follow * VectorX(left(others));
    out.push_back({d.name, d.in_doubt, static_cast<int>(d.directions.cols()), left.dot(cost * left) / squares,
                   surprise_of(layout, d.directions, cost, alone, start_deviations)});
  }
  return out;
}

// The directions of the cause of this name; of none, no name, all are.
MatrixX directions_of(const Layout& layout, const std::vector<capture::Camera>& cameras, const std::string& name) {
  if (name.empty()) return MatrixX::Identity(layout.size, layout.size);
  const std::vector<Direction> causes = single_causes(layout, cameras);
  const auto cause = std::find_if(causes.begin(), causes.end(), [&](const Direction& d) { return d.name == name; });
  CHAINSPLAT_CHECK(cause != causes.end(), "cause " + name);
  return cause->directions;
}

// Information that holds all unknowns but these directions, and where the masks begin.
MatrixX holding_all_but(const Layout& layout, const MatrixX& d) {
  MatrixX out =
      MatrixX::Identity(layout.size, layout.size) - d * MatrixX(d.transpose() * d).ldlt().solve(MatrixX(d.transpose()));
  for (const Column& column : layout.columns)
    if (column.first >= 0 && is_mask_start(column)) out(column.first, column.first) = 0.0;
  return kHeld * out;
}

// What the outlines alone say of the shared unknowns, whatever the angles are.
MatrixX outline_information(const std::vector<FrameEquations>& frames) {
  MatrixX out = MatrixX::Zero(frames.front().shared.rows(), frames.front().shared.cols());
  for (const FrameEquations& frame : frames)
    out += frame.shared - frame.local.coupling.transpose() * frame.local.matrix.ldlt().solve(frame.local.coupling);
  return out;
}

// Deviations of the shared unknowns: the larger of what the equations say and of what the scatter of the gradients
// between stretches of time says (a sandwich estimate), since neighboring frames share the model's error.
MatrixX shared_covariance(const std::vector<FrameEquations>& frames, const MatrixX& outlines, const MatrixX& known) {
  const Eigen::Index m = known.rows();
  const MatrixX information = known + outlines;
  MatrixX scatter = known;
  const int count = static_cast<int>(frames.size()), stretches = std::min(kTimeStretches, count);
  for (int s = 0; s < stretches; ++s) {
    VectorX gradient = VectorX::Zero(m);
    for (int f = s * count / stretches; f < (s + 1) * count / stretches; ++f) {
      const auto& local = frames[f].local;
      gradient += frames[f].shared_gradient - local.coupling.transpose() * local.matrix.ldlt().solve(local.gradient);
    }
    scatter += gradient * gradient.transpose();
  }
  const MatrixX covariance = information.ldlt().solve(MatrixX::Identity(m, m));
  MatrixX robust = covariance * scatter * covariance;
  const VectorX grown = (covariance.diagonal().array() / robust.diagonal().array()).max(1.0).sqrt();
  return grown.asDiagonal() * robust * grown.asDiagonal();
}

// The clocks were counted from the first camera's. Afterwards that camera's clock is right from which the others part
// least, so that one that is wrong is found to be wrong, be it the first camera's.
void choose_clock(const Layout& layout, MatrixX& covariance, capture::Corrections& corrections) {
  std::vector<int> clocks;
  for (int i = 0; i < static_cast<int>(layout.columns.size()); ++i)
    if (is(layout.columns[i], "time")) clocks.push_back(i);
  // a held clock other than the first camera's takes no part
  std::erase_if(clocks, [&](int i) { return layout.columns[i].first < 0 && layout.columns[i].camera != 0; });
  const auto time = [&](int i) { return corrections[i].value[0]; };
  int best = -1;
  double least = 1e300;
  for (const int i : clocks) {
    if (layout.columns[i].camera < 0) continue;
    double sum = 0.0;
    for (const int other : clocks) sum += std::abs(time(other) - time(i));
    if (sum >= least - kSameClock) continue;  // ties are the first camera's
    least = sum;
    best = i;
  }
  if (best < 0) return;
  if (layout.columns[best].first >= 0) {  // every clock minus that one
    MatrixX change = MatrixX::Identity(covariance.rows(), covariance.rows());
    const double shift = time(best);
    for (const int i : clocks) {
      change(layout.columns[i].number, layout.columns[best].number) -= 1.0;
      corrections[i].value[0] -= shift;
      corrections[i].state = i == best ? CorrectionState::held : CorrectionState::free;
    }
    covariance = MatrixX(change * covariance * change.transpose());
  }

  // Where it is not one of more than half of the clocks, that of the base may as well be the right one.
  const auto agreeing = std::count_if(clocks.begin(), clocks.end(), [&](int i) { return std::abs(time(i)) < kAgree; });
  const int last = clocks.back();
  if (layout.columns[last].camera >= 0 || clocks.size() < 3 || 2 * agreeing > static_cast<int>(clocks.size())) return;
  const double doubt = 0.5 * time(last) * time(last);
  for (const int i : clocks)
    for (const int j : clocks) covariance(layout.columns[i].number, layout.columns[j].number) += doubt;
}

// Frames that show the rope: those in which as much of it is in the masks as in most. What is hidden follows from the
// prior alone, which prefers straight ropes and would have shorter ones. All that show something where most hide a
// part.
std::vector<int> telling_frames(const SequenceFit& sequence, const Frames& all) {
  constexpr double kMoreHidden = 0.1;  // share of the rope, above what usual masks leave out
  std::vector<int> shown, telling;
  std::vector<double> hidden;
  for (int f = 0; f < static_cast<int>(all.times.size()); ++f) {
    if (all.views[f].empty() || !(sequence.frames[f].residual_pixels > 0.0)) continue;
    shown.push_back(f);
    hidden.push_back(1.0 - sequence.frames[f].inside);
  }
  for (const int i : math::usual_ones(hidden, kMoreHidden)) telling.push_back(shown[i]);
  return telling;
}

// Up to `most` telling frames, evenly spread, with their masks; returns their angles.
std::vector<VectorX> choose_frames(const SequenceFit& sequence, int most, const capture::Capture& capture,
                                   CorrectionProblem& problem) {
  const Frames all = frames_of(capture);
  const std::vector<int> telling = telling_frames(sequence, all);
  const std::size_t count = std::min<std::size_t>(most, telling.size());
  std::vector<VectorX> theta;
  for (std::size_t i = 0; i < count; ++i) {
    const int f = telling[i * telling.size() / count];
    problem.frames.push_back({all.times[f], sequence.states.thetadot[f], all.views[f], {}});
    theta.push_back(sequence.states.theta[f]);
  }
  core::parallel_for(static_cast<std::int64_t>(problem.frames.size()), [&](std::int64_t f) {
    CorrectedFrame& frame = problem.frames[f];
    for (const int v : frame.views) frame.masks.push_back(mask_of(capture, v));
  });
  return theta;
}

void set_states(const Layout& layout, const VectorX& prior, const MatrixX& shared, capture::Corrections& corrections) {
  for (std::size_t i = 0; i < corrections.size(); ++i) {
    const Column& column = layout.columns[i];
    if (column.first < 0) continue;
    const double relative = shared.diagonal().segment(column.first, column.quantity->size).cwiseSqrt().minCoeff();
    corrections[i].state = relative < kExact                                           ? CorrectionState::held
                           : relative * std::sqrt(prior[column.first]) < kUnknownShare ? CorrectionState::free
                                                                                       : CorrectionState::prior;
  }
}

double square_residuals(const std::vector<FrameEquations>& frames) {
  double out = 0.0;
  for (const FrameEquations& frame : frames)
    for (const FrameEquations::Sums& sums : frame.sums) out += sums.second;
  return out;
}

std::vector<OutlineMisfit> misfits_of(const CorrectionProblem& problem, const std::vector<FrameEquations>& frames) {
  const int cameras = static_cast<int>(problem.cameras.size());
  std::vector<FrameEquations::Sums> sums(cameras);
  std::vector<OutlineMisfit> out(cameras);
  for (std::size_t f = 0; f < frames.size(); ++f) {
    for (int c = 0; c < cameras; ++c) {
      const FrameEquations::Sums& one = frames[f].sums[c];
      sums[c].weight += one.weight;
      sums[c].first += one.first;
      sums[c].second += one.second;
      sums[c].length += one.length;
      sums[c].cut += one.cut;
      const double rms = one.weight > 0.0 ? std::sqrt(one.second / one.weight) : 0.0;
      if (rms <= out[c].worst_rms) continue;
      out[c].worst_rms = rms;
      for (const int v : problem.frames[f].views)
        if (problem.views[v]->camera == c) out[c].worst_frame = problem.views[v]->frame;
    }
  }
  for (int c = 0; c < cameras; ++c) {
    if (sums[c].weight <= 0.0) continue;
    out[c].mean = sums[c].first / sums[c].weight;
    out[c].rms = std::sqrt(sums[c].second / sums[c].weight);
    out[c].cut = sums[c].cut / sums[c].length;
  }
  return out;
}

}  // namespace

CorrectionFit fit_corrections(const chain::Chain& chain, const capture::Capture& capture, const SequenceFit& sequence,
                              const CorrectionOptions& options) {
  const Layout layout = layout_of(capture, chain, options);
  MatrixX directions = directions_of(layout, capture.cameras, options.only);
  MatrixX held = holding_all_but(layout, directions);
  CorrectionProblem problem{views_of(capture),
                            capture.cameras,
                            [&](double time) { return capture.base.at(time); },
                            places_of(layout, static_cast<int>(capture.cameras.size())),
                            layout.size,
                            {},
                            {},
                            {},
                            kWidestCut,
                            kWideEnd,
                            options.lying};
  problem.prior = options.prior_weight * joint_prior(chain, {});
  const int n = chain.angles(), m = layout.size;
  for (int k = 0; k < n; ++k) problem.held.push_back(chain::is_twist(chain, k));
  const std::vector<VectorX> theta = choose_frames(sequence, options.frames, capture, problem);
  CHAINSPLAT_CHECK(!theta.empty(), "a frame in which the rope is seen");

  VectorX x = VectorX::Zero(m + n * static_cast<int>(theta.size()));
  for (std::size_t f = 0; f < theta.size(); ++f) x.segment(m + static_cast<int>(f) * n, n) = theta[f];
  const VectorX start = x;
  double wide = kWidestCut;
  Starts starts = Starts::anywhere;
  const auto evaluate = [&](const VectorX& at, solve::ArrowEquations* equations) {
    const std::vector<FrameEquations> frames = all_equations(problem, layout, chain, at);
    wide *= kNarrowing;
    problem.cut = std::max({cut_of(frames), kLeastCut, wide});
    if (wide <= kLeastCut) problem.end_reach = kEndReach;
    if (equations) *equations = arrow_of(frames, known_at(capture, layout, at.head(m), starts, frames, held));
    double cost = 0.5 * at.head(m).squaredNorm();
    for (const FrameEquations& frame : frames) cost += frame.cost;
    return cost;
  };
  solve::Options solving{.steps = kSteps, .checked = false, .step_tolerance = kStep, .longest = kLongestCorrection};
  solving.damping.rule = solve::Damping::Rule::none;
  CorrectionFit out;
  // which masks begin at the grasp is seen only when cameras and grasp are nearly right
  const solve::Summary first = solve::least_squares(x, evaluate, solving);
  starts = Starts::at_grasp;
  if (!options.then.empty()) {
    directions = directions_of(layout, capture.cameras, options.then);
    held = holding_all_but(layout, directions);
  }
  out.summary = solve::least_squares(x, evaluate, solving);
  out.summary.iterations += first.iterations;
  out.summary.initial_cost = first.initial_cost;
  if (!x.allFinite()) {
    core::warn(capture.name + ": what it was given wrongly cannot be estimated; it is taken as given");
    x = start;
  }

  const std::vector<FrameEquations> frames = all_equations(problem, layout, chain, x);
  const std::vector<double> untold = start_deviations(frames);
  const VectorX prior = shared_prior(layout, x.head(m), starts, untold).information;
  const MatrixX outlines = outline_information(frames);
  const MatrixX covariance =
      shared_covariance(frames, outlines, known_at(capture, layout, x.head(m), starts, frames, held).information);
  const double squares = square_residuals(frames);
  const MatrixX cost = cost_of_change(layout, outlines).cost;
  const auto evidence_of = [&](const capture::Corrections& mended) {
    const VectorX change = x.head(m) - shared_of(layout, capture.cameras, mended);
    return squares > 0.0 ? change.dot(cost * change) / squares : 0.0;
  };
  out.evidence = evidence_of({});
  for (const capture::Corrections& mended : options.mistakes) out.evidence_after.push_back(evidence_of(mended));
  for (const FrameEquations& frame : frames) out.unexplained += frame.cost;
  out.surprise = surprise_of(layout, directions, cost, x.head(m), untold);
  if (squares > 0.0) out.causes = causes_of(layout, capture.cameras, outlines, untold, x.head(m), squares);
  out.corrections = corrections_at(layout, capture.cameras, x.head(m));
  set_states(layout, prior, covariance, out.corrections);
  out.covariance = covariance_of_numbers(layout, covariance);
  choose_clock(layout, out.covariance, out.corrections);
  for (std::size_t i = 0; i < out.corrections.size(); ++i)
    out.corrections[i].deviation = out.covariance.diagonal()
                                       .segment(layout.columns[i].number, layout.columns[i].quantity->size)
                                       .cwiseMax(0.0)
                                       .cwiseSqrt();
  out.chain = changed(chain, options.lying, out.corrections);
  for (std::size_t f = 0; f < frames.size(); ++f) {
    out.time.push_back(problem.frames[f].time - capture::value_of(out.corrections, capture.cameras[0].name, "time"));
    out.theta.push_back(x.segment(m + static_cast<int>(f) * n, n));
  }
  out.misfits = misfits_of(problem, frames);
  return out;
}

std::vector<MatrixX> covariances_by_corrections(const chain::Chain& chain, const capture::Capture& capture,
                                                const chain::States& states, const capture::Corrections& corrections,
                                                const MatrixX& covariance) {
  const int cameras = static_cast<int>(capture.cameras.size()), n = chain.angles();
  Layout layout;
  for (const Correction& c : corrections) {
    if (of_colors(*c.quantity) || c.quantity == &capture::lost_frames()) continue;
    int camera = -1;
    for (int i = 0; i < cameras; ++i)
      if (capture.cameras[i].name == c.subject && c.quantity->subject == std::string("camera")) camera = i;
    const int size = c.quantity->size;
    const bool held = covariance.diagonal().segment(layout.numbers, size).maxCoeff() <= 0.0;
    layout.columns.push_back({c.quantity, camera, layout.numbers, held ? -1 : layout.size, held ? 0.0 : 1.0});
    layout.numbers += size;
    if (!held) layout.size += size;
  }
  MatrixX choose = MatrixX::Zero(layout.size, layout.numbers);
  for (const Column& column : layout.columns)
    for (int i = 0; column.first >= 0 && i < column.quantity->size; ++i)
      choose(column.first + i, column.number + i) = 1.0;
  const MatrixX shared = choose * covariance * choose.transpose();

  const Frames all = frames_of(capture);
  CorrectionProblem problem{views_of(capture),
                            capture.cameras,
                            [&](double time) { return capture.base.at(time); },
                            places_of(layout, cameras),
                            layout.size,
                            {},
                            joint_prior(chain, {}),
                            {},
                            kLargestCut,
                            kEndReach,
                            chain::bends_in_space(chain) ? std::nullopt : lying_on_table(capture)};
  for (int k = 0; k < n; ++k) problem.held.push_back(chain::is_twist(chain, k));
  std::vector<MatrixX> out(states.time.size(), MatrixX::Zero(n, n));
  core::parallel_for(static_cast<std::int64_t>(out.size()), [&](std::int64_t k) {
    const auto later = std::lower_bound(all.times.begin(), all.times.end(), states.time[k]);
    const bool before =  // the nearest one; of two as near the earlier
        later == all.times.end() ||
        (later != all.times.begin() && states.time[k] - later[-1] <= *later - states.time[k]);
    const auto at = later - (before ? 1 : 0) - all.times.begin();
    CorrectedFrame frame{all.times[at], states.thetadot[k], all.views[at], {}};
    for (const int v : frame.views) frame.masks.push_back(mask_of(capture, v));
    const FrameEquations equations = frame_equations(problem, frame, {}, chain, states.theta[k]);
    const MatrixX moved = equations.local.matrix.ldlt().solve(equations.local.coupling);
    out[k] = moved * shared * moved.transpose();
  });
  return out;
}

}  // namespace chainsplat::silhouette
