#include "src/silhouette/correction_equations.h"

#include <optional>

#include "src/math/decompositions.h"

namespace chainsplat::silhouette {

using math::MatrixX;
using math::Pose;
using math::Vector6;
using math::VectorX;

namespace {

constexpr double kBlobReach = 3.0;  // diameters from the chain within which a blob is the rope

// What one pixel of outline counts against the priors, of one independent observation of a deviation of 1 px.
// Neighboring outline and neighboring frames share the error of straight links, which pulls the grasp along the rope:
// on recordings with truth the place of the grasp and the length were off by 10 mm with 1, by their priors with less
// than 0.05.
constexpr double kEvidence = kAsRecognized;

// Curvature of the rope along each segment by the directions of its neighbors, camera frame, 1/m. Before the first one
// is the clamp, where the rope has the direction `at_grasp`; where that is not known (empty), the first segment is
// curved as the joint after it.
std::vector<Vector3> curvatures(const std::vector<Segment>& segments, const std::optional<Vector3>& at_grasp) {
  const int count = static_cast<int>(segments.size());
  std::vector<Vector3> out;
  for (int i = 0; i < count; ++i) {
    const Segment &before = segments[std::max(0, i - 1)], &after = segments[std::min(count - 1, i + 1)];
    const Vector3 turn = (after.b - after.a).normalized() - (before.b - before.a).normalized();
    const double apart = (0.5 * (after.a + after.b) - 0.5 * (before.a + before.b)).norm();
    out.push_back(apart > 0.0 ? Vector3(turn / apart) : Vector3::Zero());
  }
  if (at_grasp && count > 1) {
    const Vector3 first = segments[0].b - segments[0].a, next = segments[1].b - segments[1].a;
    out[0] = (0.5 * (first.normalized() + next.normalized()) - *at_grasp) / first.norm();
  }
  return out;
}

// From the middle of an arc's chord to its own, m.
Vector3 bow(const Vector3& chord, const Vector3& curvature) { return -0.125 * chord.squaredNorm() * curvature; }

// Bends the posed chain: each straight link becomes an arc that is as long, in straight pieces. Returns their
// curvatures, camera frame, 1/m, by which a piece is an arc still. `at_grasp`: see curvatures().
std::vector<Vector3> bend(ViewWork& work, const std::optional<Vector3>& at_grasp) {
  constexpr double kTurn = 0.15;  // rad, of a piece at most
  constexpr int kMostPieces = 8;
  const std::vector<Vector3> of_links = curvatures(work.segments, at_grasp);
  std::vector<Segment> pieces;
  std::vector<Vector3> out;
  Vector3 shift = Vector3::Zero();  // arcs reach less far than their links
  for (std::size_t i = 0; i < work.segments.size(); ++i) {
    const Segment& link = work.segments[i];
    const Vector3 straight = link.b - link.a, &curvature = of_links[i];
    const double turn = curvature.norm() * straight.norm();
    const Vector3 chord = (1.0 - turn * turn / 24.0) * straight, middle = bow(chord, curvature);
    const int count = std::clamp(static_cast<int>(std::ceil(turn / kTurn)), 1, kMostPieces);
    const auto at = [&](int k) {
      const double t = static_cast<double>(k) / count;
      return Vector3(link.a + shift + t * chord + 4.0 * t * (1.0 - t) * middle);
    };
    for (int k = 0; k < count; ++k) {
      Segment piece = link;
      const Vector3 from = at(k), to = at(k + 1);
      if (std::min(from.z(), to.z()) < kNear) continue;
      place(piece, *work.view->camera, from, to);
      pieces.push_back(std::move(piece));
      out.push_back(curvature);
    }
    shift += chord - straight;
  }
  work.segments = std::move(pieces);
  return out;
}

// The rope in one view, posed with the corrections, and how what the view depends on moves it. Its parts point at each
// other.
struct PosedView {
  PosedView() = default;
  PosedView(const PosedView&) = delete;
  PosedView& operator=(const PosedView&) = delete;

  capture::Camera camera;
  FrameView frame;
  Problem problem;                 // of this view alone; its segments are pieces of arcs
  std::vector<Vector3> curvature;  // of each, camera frame, 1/m
  MatrixX twists;                  // 6 x angles, camera frame
  Vector6 base_twist;              // camera frame, of the base's own motion
  double mask_start = 0.0;         // m
  double readout = 0.0;            // s, beside what the view was freed of
};

// `i`: which of the frame's views.
void pose_view(const CorrectionProblem& fit, const CorrectedFrame& frame, std::size_t i,
               const capture::Corrections& corrections, const chain::Chain& chain, const VectorX& theta,
               PosedView& out) {
  const capture::ViewPlace& view = *fit.views[frame.views[i]];
  const capture::Camera& given = fit.cameras[view.camera];
  const double base_late = capture::value_of(corrections, "base", "time");
  const double first_late = capture::value_of(corrections, fit.cameras[0].name, "time");
  const double late = capture::value_of(corrections, given.name, "time");
  const double after = (view.time - late) - (frame.time - first_late);  // s, of the view after the frame
  const trajectory::BaseMotion base = fit.base(view.time - late + base_late);

  out.camera = capture::corrected(corrections, given);
  out.mask_start = capture::value_of(corrections, given.name, "mask_start");
  out.readout = capture::value_of(corrections, given.name, "readout");
  out.frame = {&frame.masks[i], &out.camera, base.pose * capture::grasp_in_base(corrections)};
  out.problem.chain = &chain;
  ViewWork work;
  work.view = &out.frame;
  work.camera_from_base = out.camera.world_from_camera.inverse() * out.frame.base;
  work.diameter =
      chain.diameter * 0.5 * (out.camera.fx + out.camera.fy) / std::max(kNear, work.camera_from_base.translation.z());
  work.active.assign(out.frame.mask->blobs.size(), 0);
  out.problem.views.push_back(std::move(work));
  out.twists.resize(6, chain.angles());
  const Pose camera_from_recorded = out.camera.world_from_camera.inverse() * base.pose;
  out.base_twist = math::transform_twist(camera_from_recorded, base.velocity);
  pose(out.problem, theta + after * frame.thetadot);
  choose_blobs(out.problem, kBlobReach);
  find_hidden(out.problem, kHiddenReach, fit.cut);
  // in space the first joint also takes up how the gripper holds the rope
  std::optional<Vector3> at_grasp;
  if (!chain::bends_in_space(chain)) at_grasp = out.problem.views[0].camera_from_base.rotation * chain.direction;
  out.curvature = bend(out.problem.views[0], at_grasp);
  for (int k = 0; k < chain.angles(); ++k)
    out.twists.col(k) = math::transform_twist(out.problem.views[0].camera_from_base, out.problem.axes.col(k));
}

// How fast a point of the outline moves, px/s, px/m, ..., with the quantities that its view depends on. `down`: m by
// which its link comes down to the table for each meter that the grasp is above it; 0 where it does not lie on one.
SharedRow shared_row(const PosedView& view, const OutlinePoint& p, double angle_speed, const Vector3& normal,
                     double down) {
  const ViewWork& work = view.problem.views[0];
  const capture::Camera& camera = view.camera;
  const chain::Chain& chain = *view.problem.chain;
  const Vector3 &g = p.gradient, moment = p.x.cross(g), from_grasp = p.x - work.camera_from_base.translation;
  const math::Matrix3& camera_from_base = work.camera_from_base.rotation;
  const double base_speed = moment.dot(view.base_twist.head<3>()) + g.dot(view.base_twist.tail<3>());
  const Vector2 from_center = image_of(camera, p.x) - Vector2(camera.cx, camera.cy);
  SharedRow row;
  row.segment<3>(kRotation) = -moment;
  row.segment<3>(kTranslation) = -(camera.world_from_camera.rotation * g);
  row[kFocal] = (p.outward.dot(from_center) + p.half_width) / camera.fx;
  row[kCameraTime] = -angle_speed - base_speed;
  row[kReadout] = (angle_speed + base_speed) * image_of(camera, p.x).y() / camera.height;
  row[kMaskOffset] = 1.0;
  const bool start = p.part == OutlinePoint::Part::start;
  row[kMaskStart] = start ? g.dot((p.segment->b - p.segment->a).normalized()) : 0.0;
  row[kBaseTime] = base_speed;
  const Vector3 with_grasp = camera_from_base.transpose() * g;
  row[kTableHeight] = down * chain.bending_axis.dot(normal) * chain.bending_axis.dot(with_grasp);
  row.segment<3>(kGrasp) = with_grasp - row[kTableHeight] * normal;
  row.segment<3>(kGraspRotation) = camera_from_base.transpose() * from_grasp.cross(g);
  row[kLength] = start ? 0.0 : g.dot(from_grasp) / chain.length;
  row[kDiameter] = p.half_width / chain.diameter + 0.5 * row[kTableHeight];  // a thicker rope lies higher
  return row;
}

// A row of the least squares: how fast the distance of a point from the outline changes with the twist of its link
// (camera frame, angular part first), then with what the point's view depends on.
constexpr int kPointSize = 6 + kSharedOfView;
using PointRow = Eigen::Matrix<double, kPointSize, 1>;

// Sums over the outline points of one link. The angles move them by the link's twist alone, so that the equations of
// all angles follow from these sums, once per link (mathematics.md 2.3).
struct LinkSums {
  Eigen::Matrix<double, kPointSize, kPointSize> normal = decltype(normal)::Zero();  // sum of weight * row * row^T
  PointRow right = PointRow::Zero();                                                // sum of weight * residual * row
  PointRow slope = PointRow::Zero();                                                // sum of weight * row
  double weight = 0.0;                                                              // sum of weights
  double residual = 0.0;                                                            // sum of weight * residual
};

// Normal equations of one view: its angles, then what it shares.
struct ViewEquations {
  MatrixX normal;
  VectorX right;
};

// Its sums go into those of its camera in `frame`.
std::vector<LinkSums> link_sums(const PosedView& view, int camera, const CorrectionProblem& fit,
                                const VectorX& thetadot, FrameEquations& frame) {
  const SharedPlaces& places = fit.places[camera];
  FrameEquations::Sums& sums = frame.sums[camera];
  const chain::Chain& chain = *view.problem.chain;
  std::vector<LinkSums> out(chain.links());
  MatrixX speeds = MatrixX::Zero(6, chain.links());  // twist of each link by the angles' rates
  for (int link = 0; link < chain.links(); ++link) {
    const int angles = chain.last_angle(link) + 1;
    speeds.col(link) = view.twists.leftCols(angles) * thetadot.head(angles);
  }
  std::vector<double> down(chain.links(), 0.0);
  for (int link = 0; fit.lying && link < chain.links(); ++link)
    down[link] = lying_slope(chain, chain.link_lift(chain.links() - 1), link);
  const Vector3 normal = fit.lying ? fit.lying->normal : Vector3::Zero();
  const std::vector<Segment>& segments = view.problem.views[0].segments;
  const auto add = [&](const OutlinePoint& p) {
    if (p.part == OutlinePoint::Part::before_grasp) return;  // the gripper's, or a cut face that is not round
    const Vector3 chord = p.segment->b - p.segment->a;
    const double t = std::clamp((p.x - p.segment->a).dot(chord) / chord.squaredNorm(), 0.0, 1.0);
    const Vector3 beside = 4.0 * t * (1.0 - t) * bow(chord, view.curvature[p.segment - segments.data()]);
    double residual = p.distance - view.camera.mask_offset - p.gradient.dot(beside);
    const int link = p.segment->link;
    PointRow row;
    row.head<3>() = p.x.cross(p.gradient);
    row.segment<3>(3) = p.gradient;
    const SharedRow shared = shared_row(view, p, row.head<6>().dot(speeds.col(link)), normal, down[link]);
    residual -= view.readout * shared[kReadout];
    const double weight = kEvidence * p.length * tukey_weight(residual, fit.cut);
    frame.sizes.push_back(std::abs(residual));
    sums.length += p.length;
    if (weight == 0.0) {
      sums.cut += p.length;
      return;
    }
    sums.weight += weight;
    sums.first += weight * residual;
    sums.second += weight * residual * residual;
    frame.cost += 0.5 * weight * residual * residual;
    row.tail<kSharedOfView>() = places.unit.cwiseProduct(shared);
    if (p.part == OutlinePoint::Part::start) {
      sums.start_weight += weight;
      sums.start_first += weight * residual;
      sums.start_second += weight * residual * residual;
      sums.start_speed += weight * std::abs(shared[kMaskStart]);
      sums.start_bulge += weight * p.half_width;
    }
    LinkSums& of = out[link];
    const PointRow weighted = weight * row;
    of.normal.noalias() += weighted * row.transpose();
    of.right += residual * weighted;
    of.slope += weighted;
    of.weight += weight;
    of.residual += weight * residual;
  };
  Ends ends{fit.end_reach, {}};
  if (places.at[kMaskStart] >= 0) ends.mask_start = view.mask_start;
  for_each_outline_point(
      chain, view.problem.views[0], [](const Edge&) {}, add, ends);
  return out;
}

ViewEquations view_equations(const PosedView& view, int camera, const CorrectionProblem& fit, const VectorX& thetadot,
                             FrameEquations& frame) {
  const chain::Chain& chain = *view.problem.chain;
  const int n = chain.angles(), size = n + kSharedOfView;
  ViewEquations out{MatrixX::Zero(size, size), VectorX::Zero(size)};
  const std::vector<LinkSums> sums = link_sums(view, camera, fit, thetadot, frame);
  for (int link = 0; link < chain.links(); ++link) {
    LinkSums of = sums[link];
    if (of.weight == 0.0) continue;
    // each link's own offset in this view (observations.cpp) is eliminated
    const double offset = of.weight + kEvidence / (kLinkOffsetDeviation * kLinkOffsetDeviation);
    of.normal.noalias() -= of.slope * of.slope.transpose() / offset;
    of.right -= of.slope * (of.residual / offset);
    const int angles = chain.last_angle(link) + 1;
    const auto twists = view.twists.leftCols(angles);
    out.normal.topLeftCorner(angles, angles).noalias() += twists.transpose() * of.normal.topLeftCorner<6, 6>() * twists;
    out.normal.bottomLeftCorner(kSharedOfView, angles).noalias() +=
        of.normal.bottomLeftCorner<kSharedOfView, 6>() * twists;
    out.normal.bottomRightCorner<kSharedOfView, kSharedOfView>() +=
        of.normal.bottomRightCorner<kSharedOfView, kSharedOfView>();
    out.right.head(angles).noalias() += twists.transpose() * of.right.head<6>();
    out.right.tail<kSharedOfView>() += of.right.tail<kSharedOfView>();
  }
  out.normal.triangularView<Eigen::StrictlyUpper>() = out.normal.transpose();
  return out;
}

// Adds a view's equations where they belong; the gradient is that of the cost, the residual's negative.
void scatter(const ViewEquations& view, const SharedPlaces& places, FrameEquations& out) {
  const Eigen::Index n = out.local.gradient.size();
  out.local.matrix += view.normal.topLeftCorner(n, n);
  out.local.gradient -= view.right.head(n);
  for (int i = 0; i < kSharedOfView; ++i) {
    if (places.at[i] < 0) continue;
    out.local.coupling.col(places.at[i]) += view.normal.block(0, n + i, n, 1);
    out.shared_gradient[places.at[i]] -= view.right[n + i];
    for (int j = 0; j < kSharedOfView; ++j)
      if (places.at[j] >= 0) out.shared(places.at[i], places.at[j]) += view.normal(n + i, n + j);
  }
}

void hold(const std::vector<char>& held, solve::ArrowEquations::Local& local) {
  for (Eigen::Index k = 0; k < local.gradient.size(); ++k) {
    if (!held[k]) continue;
    local.matrix.row(k).setZero();
    local.matrix.col(k).setZero();
    local.matrix(k, k) = 1.0;
    local.coupling.row(k).setZero();
    local.gradient[k] = 0.0;
  }
}

}  // namespace

std::vector<const capture::ViewPlace*> views_of(const capture::Capture& capture) {
  std::vector<const capture::ViewPlace*> views;
  for (const capture::PackedView& view : capture.views) views.push_back(&view);
  return views;
}

MaskPoints mask_of(const capture::Capture& capture, int v) {
  const capture::PackedView& view = capture.views[v];
  return mask_points(capture::unpacked(view), capture.cameras[view.camera], Options{}.max_pixels);
}

TiltEquations tilt_equations(const Vector3& bending_axis, const Vector3& normal) {
  constexpr double kDeviation = 0.002;  // rad, of the bending plane from the table's
  constexpr double kWeight = 1.0 / (kDeviation * kDeviation);
  const Vector3 axis = bending_axis.dot(normal) < 0.0 ? Vector3(-bending_axis) : bending_axis;
  const Vector3 residual = axis.cross(normal);
  const math::Matrix3 slope = math::hat(normal) * math::hat(axis);  // (w x axis) x normal = [normal] [axis] w
  return {kWeight * slope.transpose() * slope, kWeight * slope.transpose() * residual};
}

FrameEquations frame_equations(const CorrectionProblem& problem, const CorrectedFrame& frame,
                               const capture::Corrections& corrections, const chain::Chain& chain,
                               const VectorX& theta) {
  const int n = chain.angles(), m = problem.shared;
  FrameEquations out;
  out.shared = MatrixX::Zero(m, m);
  out.shared_gradient = VectorX::Zero(m);
  out.local.matrix = problem.prior;
  out.local.coupling = MatrixX::Zero(n, m);
  out.local.gradient = problem.prior * theta;
  out.cost = 0.5 * theta.dot(problem.prior * theta);
  out.sums.resize(problem.cameras.size());
  for (std::size_t i = 0; i < frame.views.size(); ++i) {
    const int camera = problem.views[frame.views[i]]->camera;
    PosedView view;
    pose_view(problem, frame, i, corrections, chain, theta, view);
    scatter(view_equations(view, camera, problem, frame.thetadot, out), problem.places[camera], out);
  }
  hold(problem.held, out.local);
  return out;
}

SetupEquations setup_equations(const chain::Chain& chain,
                               const std::function<trajectory::BaseMotion(double time)>& base,
                               std::span<const capture::View* const> views, const std::vector<capture::Camera>& cameras,
                               const std::vector<char>& posed, const VectorX& theta, const MatrixX& expected,
                               const Options& options) {
  const int n = chain.angles();
  const MatrixX prior = kEvidence * options.prior.information;
  CorrectionProblem problem{{views.begin(), views.end()}, cameras, base, {}, 0, {}, prior, {}, kLargestCut, kEndReach};
  SharedPlaces places;
  places.at.fill(-1);
  problem.places.assign(cameras.size(), places);
  const auto vary = [&](SharedPlaces& of, int quantity, int at) {
    of.at[quantity] = at;
    of.unit[quantity] = 1.0;
  };
  problem.shared = SetupEquations::kCameras;
  for (std::size_t c = 0; c < cameras.size(); ++c) {
    vary(problem.places[c], kBaseTime, SetupEquations::kClock);
    for (int i = 0; i < 3; ++i) vary(problem.places[c], kGraspRotation + i, SetupEquations::kGrasp + i);
    for (int i = 0; posed[c] && i < 3; ++i) {
      vary(problem.places[c], kRotation + i, problem.shared + i);
      vary(problem.places[c], kTranslation + i, problem.shared + 3 + i);
    }
    if (posed[c]) problem.shared += SetupEquations::kPerCamera;
  }
  const int m = problem.shared, widths = static_cast<int>(cameras.size());  // then each camera's edge offset
  for (SharedPlaces& of : problem.places) vary(of, kMaskOffset, problem.shared++);

  for (int k = 0; k < n; ++k) problem.held.push_back(chain::is_twist(chain, k));
  CorrectedFrame frame{views.front()->time, VectorX::Zero(n), {}, {}};
  for (std::size_t v = 0; v < views.size(); ++v) {
    frame.masks.push_back(mask_points(*views[v], cameras.at(views[v]->camera), Options{}.max_pixels));
    frame.views.push_back(static_cast<int>(v));
  }
  FrameEquations equations = frame_equations(problem, frame, {}, chain, theta);
  CHAINSPLAT_CHECK(expected.rows() == n && expected.cols() == m, "how the prior's mean changes");
  // the angles are what is expected of them with these unknowns, and a difference from it, which the prior is of
  MatrixX follows = MatrixX::Zero(n, m + widths);
  follows.leftCols(m) = expected;
  for (int k = 0; k < n; ++k)
    if (problem.held[k]) follows.row(k).setZero();
  MatrixX outlines = equations.local.matrix - prior;
  for (int k = 0; k < n; ++k)
    if (problem.held[k]) outlines.row(k).setZero();
  const MatrixX crossed = follows.transpose() * equations.local.coupling;
  equations.shared += crossed + crossed.transpose() + follows.transpose() * outlines * follows;
  equations.shared_gradient += follows.transpose() * (equations.local.gradient - prior * theta);
  equations.local.coupling += outlines * follows;
  // what ends with this frame, its angles and the edge offsets, is eliminated
  const double known = 1.0 / (options.edge_offset_deviation * options.edge_offset_deviation);
  MatrixX own(n + widths, n + widths), coupling(n + widths, m);
  own << equations.local.matrix, equations.local.coupling.rightCols(widths),
      equations.local.coupling.rightCols(widths).transpose(), equations.shared.bottomRightCorner(widths, widths);
  own.diagonal().tail(widths).array() += known;
  coupling << equations.local.coupling.leftCols(m), equations.shared.bottomLeftCorner(widths, m);
  VectorX gradient(n + widths);
  gradient << equations.local.gradient - prior * options.prior.mean,
      (equations.shared_gradient.tail(widths).array() - known * options.edge_offset).matrix();
  const MatrixX moved = own.ldlt().solve(coupling);
  return {equations.shared.topLeftCorner(m, m) - moved.transpose() * coupling,
          equations.shared_gradient.head(m) - moved.transpose() * gradient, expected - moved.topRows(n)};
}

}  // namespace chainsplat::silhouette
