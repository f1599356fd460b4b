#include <algorithm>
#include <cmath>
#include <numeric>

#include "chainsplat/core.h"
#include "src/silhouette/outline.h"

namespace chainsplat::silhouette {

using capture::Correction;
using capture::CorrectionState;
using math::MatrixX;
using math::Pose;
using math::Vector6;
using math::VectorX;

namespace {

// Gauss-Newton. Outlines farther from the rope than a cut do not count (Tukey); it starts wide, since what is given may
// be wrong by many pixels, and narrows until the residuals' own spread sets it.
constexpr int kSteps = 40;
constexpr double kStep = 0.02;                     // of the prior deviations, and rad: smaller steps end it
constexpr double kLongestStep = 50.0;              // the same, in one step
constexpr double kWidestCut = 30.0;                // px
constexpr double kNarrowing = 0.6;                 // of that cut from step to step
constexpr double kLeastCut = 2.5;                  // px
constexpr double kCutDeviations = 4.685 * 1.4826;  // Tukey's constant times a median's standard deviation
constexpr double kWideEnd = 8.0;          // half widths from the chain's end within which the free end is sought
constexpr double kJointDifference = 0.3;  // rad, deviation of the difference of neighboring angles with eight joints
constexpr double kBlobReach = 3.0;        // diameters from the chain within which a blob is the rope
constexpr double kLinkOffset = 0.2;       // px, deviation of one link's outline in one view (observations.cpp)
// What one pixel of outline counts against the priors, of one independent observation of a deviation of 1 px.
// Neighboring outline and neighboring frames share the error of straight links, which pulls the grasp along the rope:
// on recordings with truth the place of the grasp and the length were off by 10 mm with 1, by their priors with less
// than 0.05.
constexpr double kEvidence = 0.02;
// The priors' penalty is kTails / 2 ln(1 + |y|^2 / kTails) in units of their deviation: nearly a Gaussian's for what a
// careful laboratory gets wrong, and for a fault ten times that nearly flat.
constexpr double kTails = 2.0;
constexpr double kUnknownShare = 0.7;  // of the prior's deviation there above which a value is the prior's
constexpr int kStretches = 12;         // of time, whose scatter tells what the equations do not know
constexpr double kSameClock = 1e-9;    // s
constexpr int kLeastCameras = 2;       // from which poses and sizes can be told apart

// Where one kind of correction of one subject stands among the shared unknowns, which are in units of its deviation.
struct Column {
  const capture::CorrectedQuantity* quantity = nullptr;
  int camera = -1;         // -1: of base, grasp or object
  int first = -1;          // -1: held
  double deviation = 0.0;  // in the quantity's unit
};

struct Layout {
  std::vector<Column> columns;
  int size = 0;
};

Layout layout_of(const capture::Capture& capture, const CorrectionOptions& options) {
  Layout layout;
  const bool alone = static_cast<int>(capture.cameras.size()) < kLeastCameras;
  const auto add = [&](const capture::CorrectedQuantity& quantity, int camera) {
    const std::string group = quantity.group;
    const bool clock = group == "time";
    bool held = std::find(options.held.begin(), options.held.end(), group) != options.held.end();
    held = held || (alone && !clock && group != "masks");
    held = held || (clock && camera == 0);  // the others count from its clock
    held = held || (clock && camera < 0 && capture.base.samples().size() < 2);
    const double given = group == "length"     ? capture.length
                         : group == "diameter" ? capture.diameter
                         : camera >= 0         ? capture.cameras[camera].fx
                                               : 0.0;
    const double deviation = quantity.relative > 0.0 ? quantity.relative * given : quantity.deviation;
    layout.columns.push_back({&quantity, camera, held ? -1 : layout.size, deviation});
    if (!held) layout.size += quantity.size;
  };
  for (const auto& quantity : capture::corrected_quantities()) {
    if (quantity.subject == std::string("camera")) {
      for (int c = 0; c < static_cast<int>(capture.cameras.size()); ++c) add(quantity, c);
    } else {
      add(quantity, -1);
    }
  }
  return layout;
}

const Column& column_of(const Layout& layout, const char* subject, const char* quantity, int camera = -1) {
  return *std::find_if(layout.columns.begin(), layout.columns.end(), [&](const Column& c) {
    return c.camera == camera && std::string(c.quantity->subject) == subject &&
           std::string(c.quantity->name) == quantity;
  });
}

// Information of the heavy-tailed prior about each shared unknown at x, in units of its deviation: most recordings are
// right in most things, and wrong by much in a few.
VectorX prior_weights(const Layout& layout, const VectorX& x) {
  VectorX out = VectorX::Ones(layout.size);
  for (const Column& column : layout.columns) {
    if (column.first < 0) continue;
    const int size = column.quantity->size;
    out.segment(column.first, size).setConstant(1.0 / (1.0 + x.segment(column.first, size).squaredNorm() / kTails));
  }
  return out;
}

capture::Corrections corrections_at(const Layout& layout, const capture::Capture& capture, const VectorX& x) {
  capture::Corrections out;
  for (const Column& column : layout.columns) {
    const capture::CorrectedQuantity& q = *column.quantity;
    Correction c;
    c.quantity = &q;
    c.subject = column.camera < 0 ? std::string(q.subject) : capture.cameras[column.camera].name;
    c.value = column.first < 0 ? VectorX::Zero(q.size) : VectorX(column.deviation * x.segment(column.first, q.size));
    c.deviation = VectorX::Zero(q.size);
    if (column.camera >= 0) c.calibration = capture::calibration_text(capture.cameras[column.camera]);
    out.push_back(std::move(c));
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

struct Frame {
  double time = 0.0;  // s, as given
  VectorX thetadot;   // rad/s
  std::vector<int> views;
};

// Equations of one frame: shared x shared, own x shared, own x own.
struct FrameEquations {
  MatrixX shared;
  VectorX shared_gradient;
  solve::ArrowEquations::Local local;
  double cost = 0.0;
  std::vector<double> sizes;  // px, residuals' absolute values
  struct Sums {
    double weight = 0.0, first = 0.0, second = 0.0;  // of the weights, times the residual, times its square
    double length = 0.0, cut = 0.0;                  // px of outline, and of it what does not count
  };
  std::vector<Sums> sums;  // by camera
};

struct Fit {
  const capture::Capture& capture;
  const chain::Chain& given;
  Layout layout;
  std::vector<Frame> frames;
  std::vector<MaskPoints> masks;               // by view
  MatrixX prior;                               // of the angles
  std::vector<char> held;                      // by angle
  double cut = kWidestCut, wide = kWidestCut;  // px
};

// The angles that one frame's views show, and how they and the shared unknowns move the outline.
FrameEquations frame_equations(const Fit& fit, const Frame& frame, const capture::Corrections& corrections,
                               const chain::Chain& chain, const VectorX& theta) {
  const Layout& layout = fit.layout;
  const int n = chain.angles(), m = layout.size, cameras = static_cast<int>(fit.capture.cameras.size());
  FrameEquations out;
  out.shared = MatrixX::Zero(m, m);
  out.shared_gradient = VectorX::Zero(m);
  out.local.matrix = fit.prior;
  out.local.coupling = MatrixX::Zero(n, m);
  out.local.gradient = fit.prior * theta;
  out.cost = 0.5 * theta.dot(fit.prior * theta);
  out.sums.resize(cameras);

  const double base_late = capture::value_of(corrections, "base", "time");
  const double first_late = capture::value_of(corrections, fit.capture.cameras[0].name, "time");
  const Correction* const grasp = capture::find(corrections, "grasp", "translation");
  const Pose grasp_in_base{math::Matrix3::Identity(), Vector3(grasp->value)};
  for (const int v : frame.views) {
    const capture::View& view = fit.capture.views[v];
    const capture::Camera camera = capture::corrected(corrections, fit.capture.cameras[view.camera]);
    const double late = capture::value_of(corrections, camera.name, "time");
    const double after = (view.time - late) - (frame.time - first_late);  // s, of the view after the frame
    const trajectory::BaseMotion base = fit.capture.base.at(view.time - late + base_late);
    const Pose world_from_base = base.pose * grasp_in_base;

    FrameView frame_view{&fit.masks[v], &camera, world_from_base};
    Problem problem;
    problem.chain = &chain;
    ViewWork work;
    work.view = &frame_view;
    work.camera_from_base = camera.world_from_camera.inverse() * world_from_base;
    work.diameter =
        chain.diameter * 0.5 * (camera.fx + camera.fy) / std::max(kNear, work.camera_from_base.translation.z());
    work.active.assign(frame_view.mask->blobs.size(), 0);
    problem.views.push_back(std::move(work));
    pose(problem, theta + after * frame.thetadot);
    choose_blobs(problem, kBlobReach);
    const ViewWork& posed = problem.views[0];

    // what of the shared unknowns this view depends on, and the twists (camera frame) that they and the angles are
    struct Used {
      const Column* column;
      int at;  // in the row
    };
    std::vector<Used> used;
    int size = n;
    const auto use = [&](const char* subject, const char* quantity, int c) {
      const Column& column = column_of(layout, subject, quantity, c);
      if (column.first < 0) return -1;
      used.push_back({&column, size});
      size += column.quantity->size;
      return size - column.quantity->size;
    };
    const int c = view.camera;
    const int at_rotation = use("camera", "rotation", c), at_translation = use("camera", "translation", c);
    const int at_focal = use("camera", "focal", c), at_late = use("camera", "time", c);
    const int at_offset = use("camera", "mask_offset", c), at_base = use("base", "time", -1);
    const int at_grasp = use("grasp", "translation", -1), at_length = use("object", "length", -1);
    const int at_diameter = use("object", "diameter", -1);
    MatrixX twists(6, n);
    for (int k = 0; k < n; ++k) twists.col(k) = math::transform_twist(posed.camera_from_base, problem.axes.col(k));
    const Pose camera_from_recorded = camera.world_from_camera.inverse() * base.pose;
    const Vector6 base_twist = math::transform_twist(camera_from_recorded, base.velocity);
    const math::Matrix3 &world_from_camera = camera.world_from_camera.rotation,
                        &camera_from_base = posed.camera_from_base.rotation;
    const Vector3& at_clamp = posed.camera_from_base.translation;
    const double offset = capture::value_of(corrections, camera.name, "mask_offset");

    MatrixX normal = MatrixX::Zero(size, size);
    VectorX right = VectorX::Zero(size);
    const int links = chain.links();
    MatrixX coupling = MatrixX::Zero(size, links);  // of each link's own offset in this view
    VectorX link_weight = VectorX::Constant(links, kEvidence / (kLinkOffset * kLinkOffset)),
            link_right = VectorX::Zero(links);
    VectorX row(size);
    FrameEquations::Sums& sums = out.sums[c];
    for_each_outline_point(
        chain, posed, [](const Edge&) {},
        [&](const OutlinePoint& p) {
          if (p.before_grasp) return;  // the gripper's, or a cut face that is not round
          const double residual = p.distance - offset;
          const double robust = tukey_weight(residual, fit.cut), weight = kEvidence * p.length * robust;
          out.sizes.push_back(std::abs(residual));
          sums.length += p.length;
          if (weight == 0.0) {
            sums.cut += p.length;
            return;
          }
          sums.weight += weight;
          sums.first += weight * residual;
          sums.second += weight * residual * residual;
          const Vector3 &g = p.gradient, moment = p.x.cross(g);
          const int link = p.segment->link;
          double speed = 0.0;  // px/s, of the outline by the angles' motion
          for (int k = 0; k < n; ++k) {
            const bool moves = link >= chain.child_link[k];
            row[k] = moves ? moment.dot(twists.col(k).head<3>()) + g.dot(twists.col(k).tail<3>()) : 0.0;
            speed += row[k] * frame.thetadot[k];
          }
          const double base_speed = moment.dot(base_twist.head<3>()) + g.dot(base_twist.tail<3>());
          const auto scaled = [&](int at, const char* subject, const char* quantity, int camera_index,
                                  const auto& value) {
            const double unit = column_of(layout, subject, quantity, camera_index).deviation;
            row.segment(at, value.size()) = unit * value;
          };
          using One = Eigen::Matrix<double, 1, 1>;
          const auto one = [](double value) { return One(value); };
          if (at_rotation >= 0) scaled(at_rotation, "camera", "rotation", c, Vector3(g.cross(p.x)));
          if (at_translation >= 0)
            scaled(at_translation, "camera", "translation", c, Vector3(-(world_from_camera * g)));
          if (at_focal >= 0) {
            const Vector2 from_center = image_of(camera, p.x) - Vector2(camera.cx, camera.cy);
            scaled(at_focal, "camera", "focal", c, one((p.outward.dot(from_center) + p.half_width) / camera.fx));
          }
          if (at_late >= 0) scaled(at_late, "camera", "time", c, one(-speed - base_speed));
          if (at_offset >= 0) scaled(at_offset, "camera", "mask_offset", c, one(1.0));
          if (at_base >= 0) scaled(at_base, "base", "time", -1, one(base_speed));
          if (at_grasp >= 0) scaled(at_grasp, "grasp", "translation", -1, Vector3(camera_from_base.transpose() * g));
          if (at_length >= 0) scaled(at_length, "object", "length", -1, one(g.dot(p.x - at_clamp) / chain.length));
          if (at_diameter >= 0) scaled(at_diameter, "object", "diameter", -1, one(p.half_width / chain.diameter));
          normal.selfadjointView<Eigen::Lower>().rankUpdate(row, weight);
          right += weight * residual * row;
          coupling.col(link) += weight * row;
          link_weight[link] += weight;
          link_right[link] += weight * residual;
          out.cost += 0.5 * weight * residual * residual;
        },
        fit.wide > kLeastCut ? kWideEnd : kEndReach);
    for (int link = 0; link < links; ++link) {
      normal.selfadjointView<Eigen::Lower>().rankUpdate(coupling.col(link), -1.0 / link_weight[link]);
      right -= coupling.col(link) * (link_right[link] / link_weight[link]);
    }
    normal.triangularView<Eigen::StrictlyUpper>() = normal.transpose();

    // to where they belong; the gradient is that of the cost, the residual's negative
    out.local.matrix += normal.topLeftCorner(n, n);
    out.local.gradient -= right.head(n);
    for (const Used& a : used) {
      const int first = a.column->first, count = a.column->quantity->size;
      out.local.coupling.middleCols(first, count) += normal.block(0, a.at, n, count);
      out.shared_gradient.segment(first, count) -= right.segment(a.at, count);
      for (const Used& b : used)
        out.shared.block(first, b.column->first, count, b.column->quantity->size) +=
            normal.block(a.at, b.at, count, b.column->quantity->size);
    }
  }
  for (int k = 0; k < n; ++k) {
    if (!fit.held[k]) continue;
    out.local.matrix.row(k).setZero();
    out.local.matrix.col(k).setZero();
    out.local.matrix(k, k) = 1.0;
    out.local.coupling.row(k).setZero();
    out.local.gradient[k] = 0.0;
  }
  return out;
}

std::vector<FrameEquations> all_equations(const Fit& fit, const VectorX& x) {
  const int m = fit.layout.size, n = fit.given.angles();
  const capture::Corrections corrections = corrections_at(fit.layout, fit.capture, x.head(m));
  const chain::Chain chain = resized(fit.given, fit.given.length + capture::value_of(corrections, "object", "length"),
                                     fit.given.diameter + capture::value_of(corrections, "object", "diameter"));
  std::vector<FrameEquations> out(fit.frames.size());
  core::parallel_for(static_cast<std::int64_t>(out.size()), [&](std::int64_t f) {
    out[f] = frame_equations(fit, fit.frames[f], corrections, chain, x.segment(m + f * n, n));
  });
  return out;
}

double median_size(const std::vector<FrameEquations>& frames) {
  std::vector<double> sizes;
  for (const FrameEquations& frame : frames) sizes.insert(sizes.end(), frame.sizes.begin(), frame.sizes.end());
  if (sizes.empty()) return 0.0;
  const auto middle = sizes.begin() + static_cast<std::ptrdiff_t>(sizes.size() / 2);
  std::nth_element(sizes.begin(), middle, sizes.end());
  return *middle;
}

// Deviations of the shared unknowns: the larger of what the equations say and of what the scatter of the gradients
// between stretches of time says (a sandwich estimate), since neighboring frames share the model's error.
MatrixX shared_covariance(const std::vector<FrameEquations>& frames, const VectorX& prior, const VectorX& x,
                          double& evidence) {
  const Eigen::Index m = prior.size();
  MatrixX information = prior.asDiagonal(), scatter = information;
  const int count = static_cast<int>(frames.size()), stretches = std::min(kStretches, count);
  for (int s = 0; s < stretches; ++s) {
    VectorX gradient = VectorX::Zero(m);
    for (int f = s * count / stretches; f < (s + 1) * count / stretches; ++f) {
      const auto& local = frames[f].local;
      const Eigen::LDLT<MatrixX> own(local.matrix);
      information += frames[f].shared - local.coupling.transpose() * own.solve(local.coupling);
      gradient += frames[f].shared_gradient - local.coupling.transpose() * own.solve(local.gradient);
    }
    scatter += gradient * gradient.transpose();
  }
  double squares = 0.0;
  for (const FrameEquations& frame : frames)
    for (const FrameEquations::Sums& sums : frame.sums) squares += sums.second;
  evidence = squares > 0.0 ? (x.dot(information * x) - x.dot(prior.cwiseProduct(x))) / squares : 0.0;
  const MatrixX covariance = information.ldlt().solve(MatrixX::Identity(m, m));
  MatrixX robust = covariance * scatter * covariance;
  const VectorX grown = (covariance.diagonal().array() / robust.diagonal().array()).max(1.0).sqrt();
  return grown.asDiagonal() * robust * grown.asDiagonal();
}

// The clocks were counted from the first camera's. Afterwards that clock is right from which the others part least, so
// that one that is wrong is found to be wrong, be it the first camera's.
void choose_clock(const Layout& layout, const MatrixX& covariance, capture::Corrections& corrections) {
  std::vector<int> clocks;
  for (int i = 0; i < static_cast<int>(layout.columns.size()); ++i)
    if (std::string(layout.columns[i].quantity->group) == "time") clocks.push_back(i);
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
  if (best < 0 || layout.columns[best].first < 0) return;
  const double shift = time(best);
  const int reference = layout.columns[best].first;
  const double unit = layout.columns[best].deviation;
  for (const int i : clocks) {
    Correction& c = corrections[i];
    const int own = layout.columns[i].first;
    const double own_unit = layout.columns[i].deviation;
    double variance = unit * unit * covariance(reference, reference);
    if (own >= 0) variance += own_unit * (own_unit * covariance(own, own) - 2.0 * unit * covariance(own, reference));
    c.value[0] -= shift;
    c.deviation[0] = i == best ? 0.0 : std::sqrt(std::max(0.0, variance));
    c.state = i == best ? CorrectionState::held : CorrectionState::free;
  }
}

}  // namespace

CorrectionFit fit_corrections(const chain::Chain& chain, const capture::Capture& capture, const SequenceFit& sequence,
                              const CorrectionOptions& options) {
  const Frames all = frames_of(capture);
  // bends between neighbors shrink with the square of the links' length, as curvature changes along the rope
  Options smooth;
  const double difference = kJointDifference * std::pow(8.0 / (chain.links() - 1), 2);
  smooth.joint_smoothness = 1.0 / (difference * difference);
  Fit fit{capture, chain, layout_of(capture, options), {}, {}, joint_prior(chain, smooth), {}};
  const int n = chain.angles(), m = fit.layout.size, cameras = static_cast<int>(capture.cameras.size());
  for (int k = 0; k < n; ++k) fit.held.push_back(chain::is_twist(chain, k));

  // frames that show something, evenly spread
  const int every = std::max(1, (static_cast<int>(all.times.size()) + options.frames - 1) / options.frames);
  std::vector<VectorX> theta;
  for (int f = 0; f < static_cast<int>(all.times.size()); f += every) {
    if (all.views[f].empty() || sequence.frames[f].residual_pixels <= 0.0) continue;
    fit.frames.push_back({all.times[f], sequence.states.thetadot[f], all.views[f]});
    theta.push_back(sequence.states.theta[f]);
  }
  fit.masks.resize(capture.views.size());
  std::vector<int> needed;
  for (const Frame& frame : fit.frames) needed.insert(needed.end(), frame.views.begin(), frame.views.end());
  core::parallel_for(static_cast<std::int64_t>(needed.size()), [&](std::int64_t i) {
    const capture::View& view = capture.views[needed[i]];
    fit.masks[needed[i]] = mask_points(view, capture.cameras[view.camera], Options{}.max_pixels);
  });

  VectorX x = VectorX::Zero(m + n * static_cast<int>(fit.frames.size()));
  for (std::size_t f = 0; f < theta.size(); ++f) x.segment(m + static_cast<int>(f) * n, n) = theta[f];
  std::vector<FrameEquations> frames;
  const auto evaluate = [&](const VectorX& at, solve::ArrowEquations* equations) {
    frames = all_equations(fit, at);
    fit.wide *= kNarrowing;
    fit.cut = std::max({kCutDeviations * median_size(frames), kLeastCut, fit.wide});
    solve::ArrowEquations arrow;
    const VectorX weights = prior_weights(fit.layout, at.head(m));
    arrow.shared = weights.asDiagonal();
    arrow.gradient = weights.cwiseProduct(at.head(m));
    double cost = 0.5 * at.head(m).squaredNorm();
    for (const FrameEquations& frame : frames) {
      arrow.shared += frame.shared;
      arrow.gradient += frame.shared_gradient;
      arrow.local.push_back(frame.local);
      cost += frame.cost;
    }
    if (equations) *equations = std::move(arrow);
    return cost;
  };
  solve::Options solving{.steps = kSteps, .checked = false, .step_tolerance = kStep, .longest = kLongestStep};
  solving.damping.rule = solve::Damping::Rule::none;
  CorrectionFit out;
  out.summary = solve::least_squares(x, evaluate, solving);
  frames = all_equations(fit, x);

  const VectorX prior = prior_weights(fit.layout, x.head(m));
  const MatrixX covariance = shared_covariance(frames, prior, x.head(m), out.evidence);
  out.corrections = corrections_at(fit.layout, capture, x.head(m));
  for (std::size_t i = 0; i < out.corrections.size(); ++i) {
    const Column& column = fit.layout.columns[i];
    Correction& c = out.corrections[i];
    if (column.first < 0) continue;
    const VectorX relative = covariance.diagonal().segment(column.first, c.value.size()).cwiseSqrt();
    c.deviation = column.deviation * relative;
    c.state = relative.minCoeff() * std::sqrt(prior[column.first]) < kUnknownShare ? CorrectionState::free
                                                                                   : CorrectionState::prior;
  }
  choose_clock(fit.layout, covariance, out.corrections);
  out.chain = resized(chain, chain.length + capture::value_of(out.corrections, "object", "length"),
                      chain.diameter + capture::value_of(out.corrections, "object", "diameter"));
  std::vector<FrameEquations::Sums> sums(cameras);
  out.misfits.resize(cameras);
  for (std::size_t f = 0; f < frames.size(); ++f) {
    out.time.push_back(fit.frames[f].time - capture::value_of(out.corrections, capture.cameras[0].name, "time"));
    out.theta.push_back(x.segment(m + static_cast<int>(f) * n, n));
    for (int c = 0; c < cameras; ++c) {
      const FrameEquations::Sums& one = frames[f].sums[c];
      sums[c].weight += one.weight;
      sums[c].first += one.first;
      sums[c].second += one.second;
      sums[c].length += one.length;
      sums[c].cut += one.cut;
      const double rms = one.weight > 0.0 ? std::sqrt(one.second / one.weight) : 0.0;
      if (rms <= out.misfits[c].worst_rms) continue;
      out.misfits[c].worst_rms = rms;
      for (const int v : fit.frames[f].views)
        if (capture.views[v].camera == c) out.misfits[c].worst_frame = capture.views[v].frame;
    }
  }
  for (int c = 0; c < cameras; ++c) {
    if (sums[c].weight <= 0.0) continue;
    out.misfits[c].mean = sums[c].first / sums[c].weight;
    out.misfits[c].rms = std::sqrt(sums[c].second / sums[c].weight);
    out.misfits[c].cut = sums[c].cut / sums[c].length;
  }
  return out;
}

}  // namespace chainsplat::silhouette
