#include "bundle.h"

#include <algorithm>
#include <cmath>
#include "src/math/decompositions.h"

namespace chainsplat::calibration {

using math::Matrix3;
using math::MatrixX;
using math::Pose;
using math::Vector2;
using math::Vector3;
using math::VectorX;

namespace {

constexpr double kRobust = 3.0;  // scaled residuals beyond this count linearly (Huber)
constexpr double kLost = 1e4;    // scaled residual of a corner that the camera cannot see at all
constexpr double kHeld = 1e-9;   // rad, m: what is not to move
constexpr double kNear = 0.01;   // m in front of the camera
// What is assumed of everything beforehand, so weakly that it only shows where the views tell nothing
constexpr double kAnyFocal = 10.0, kAnyCenter = 0.5;                       // times the image's width
constexpr double kAnyDistortion[] = {1.0, 1.0, 0.05, 0.05, 1.0};           // k1 k2 p1 p2 k3
constexpr double kAnyRotation = 10.0, kAnyPlace = 100.0, kAnyClock = 1.0;  // rad, m, s

// d(exp(w) p) = -hat(exp(w) p) left_jacobian(w) dw
Matrix3 left_jacobian(const Vector3& w) {
  const double angle = w.norm();
  const Matrix3 h = math::hat(w);
  if (angle < 1e-4) return Matrix3::Identity() + 0.5 * h + h * h / 6.0;
  return Matrix3::Identity() + (1.0 - std::cos(angle)) / (angle * angle) * h +
         (angle - std::sin(angle)) / (angle * angle * angle) * h * h;
}

// A pose moved by unknowns: rotation vector in front, translation added.
Pose moved(const Pose& pose, const Eigen::Ref<const VectorX>& x) {
  return {math::exp_so3(x.head<3>()) * pose.rotation, pose.translation + x.tail<3>()};
}

int shared_unknowns(const Bundle& bundle) {
  return kCameraUnknowns * static_cast<int>(bundle.cameras.size()) + (bundle.robot ? kPoseUnknowns : 0);
}

capture::Camera moved_lens(capture::Camera camera, const Eigen::Ref<const VectorX>& x) {
  camera.fx += x(0), camera.fy += x(1), camera.cx += x(2), camera.cy += x(3);
  for (int k = 0; k < 5; ++k) camera.distortion[k] += x(4 + k);
  return camera;
}

Bundle at(const Bundle& start, const VectorX& x) {
  Bundle bundle = start;
  for (std::size_t c = 0; c < bundle.cameras.size(); ++c) {
    const auto own = x.segment(kCameraUnknowns * static_cast<Eigen::Index>(c), kCameraUnknowns);
    bundle.cameras[c] = moved_lens(bundle.cameras[c], own);
    bundle.cameras[c].world_from_camera = moved(bundle.cameras[c].world_from_camera, own.segment(9, 6));
    bundle.clocks[c] += own(15);
  }
  Eigen::Index next = shared_unknowns(bundle);
  if (bundle.robot) bundle.flange_from_board = moved(bundle.flange_from_board, x.segment(next - 6, 6));
  for (Moment& moment : bundle.moments) moment.pose = moved(moment.pose, x.segment(next, 6)), next += 6;
  return bundle;
}

struct Part {  // of one moment
  double cost = 0.0;
  MatrixX shared;
  VectorX shared_gradient;
  solve::ArrowEquations::Local local;
};

using Wide = Eigen::Matrix<double, 2, Eigen::Dynamic>;

// The corners of one moment at x. `x_own`: of the moment, `x` of all that is shared.
void add_moment(const Bundle& start, const VectorX& x, const Eigen::Ref<const VectorX>& x_own, const Moment& moment,
                bool derivatives, Part& part) {
  const int shared = shared_unknowns(start), board = shared - kPoseUnknowns;
  const Pose own = moved(moment.pose, x_own);
  const Pose on_flange = start.robot ? moved(start.flange_from_board, x.segment(board, 6)) : Pose{};
  const Matrix3 own_jacobian = left_jacobian(x_own.head<3>());
  const Matrix3 board_jacobian = start.robot ? left_jacobian(x.segment<3>(board)) : Matrix3::Identity();
  const Matrix3 own_turn = math::exp_so3(x_own.head<3>());
  Wide by_shared(2, shared);
  Eigen::Matrix<double, 2, 6> by_own;
  for (const View& view : moment.views) {
    const Eigen::Index first = kCameraUnknowns * view.camera;
    const auto x_camera = x.segment(first, kCameraUnknowns);
    const capture::Camera camera = moved_lens(start.cameras[view.camera], x_camera);
    const Vector3 turn = x_camera.segment<3>(9);
    const Matrix3 back = math::exp_so3(-turn), camera_jacobian = left_jacobian(-turn);
    const Matrix3 from_world = start.cameras[view.camera].world_from_camera.rotation.transpose();
    const Vector3 position = start.cameras[view.camera].world_from_camera.translation + x_camera.segment<3>(12);
    trajectory::BaseMotion robot;
    if (start.robot) robot = start.robot->at(view.time + start.clocks[view.camera] + x_camera(15));
    const Vector3 omega = robot.velocity.head<3>(), v = robot.velocity.tail<3>();
    for (const Seen& seen : view.corners) {
      const Vector3 g = on_flange * seen.point;
      // with a robot its error moves the flange; without one `own` is the board's pose
      const Vector3 h = own * g, w = robot.pose * h;
      const Vector3 y = back * (w - position), c = from_world * y;
      Eigen::Matrix<double, 2, 3> by_point;
      Eigen::Matrix<double, 2, kLensUnknowns> by_lens;
      const double deviation = seen.deviation * start.scales[view.camera];
      const auto pixel = derivatives ? pixel_of(camera, c, by_point, by_lens) : pixel_of(camera, c);
      if (!pixel) {
        part.cost += 2.0 * kRobust * kLost - kRobust * kRobust;
        continue;
      }
      const Vector2 r = (*pixel - seen.pixel) / deviation;
      const double size = std::min(r.norm(), kLost);
      const bool far = size > kRobust;
      part.cost += far ? 2.0 * kRobust * size - kRobust * kRobust : size * size;
      if (!derivatives) continue;
      const double weight = far ? kRobust / size : 1.0;
      const Eigen::Matrix<double, 2, 3> by_y = by_point * from_world / deviation, by_w = by_y * back,
                                        by_h = by_w * robot.pose.rotation;
      by_shared.setZero();
      by_shared.block<2, kLensUnknowns>(0, first) = by_lens / deviation;
      by_shared.block<2, 3>(0, first + 9) = by_y * math::hat(y) * camera_jacobian;
      by_shared.block<2, 3>(0, first + 12) = -by_w;
      if (start.robot) {
        by_shared.col(first + 15) = by_h * (omega.cross(h) + v);
        const Eigen::Matrix<double, 2, 3> by_g = by_h * own.rotation;
        const Vector3 turned = on_flange.rotation * seen.point;
        by_shared.block<2, 3>(0, board) = -by_g * math::hat(turned) * board_jacobian;
        by_shared.block<2, 3>(0, board + 3) = by_g;
      }
      const Vector3 turned = own_turn * (moment.pose.rotation * g);
      by_own.leftCols<3>() = -by_h * math::hat(turned) * own_jacobian;
      by_own.rightCols<3>() = by_h;
      // only the blocks that are not zero
      const auto add_block = [&](Eigen::Index i, Eigen::Index n, Eigen::Index j, Eigen::Index m) {
        part.shared.block(i, j, n, m).noalias() +=
            weight * by_shared.middleCols(i, n).transpose() * by_shared.middleCols(j, m);
      };
      add_block(first, kCameraUnknowns, first, kCameraUnknowns);
      part.shared_gradient.segment(first, kCameraUnknowns) +=
          weight * by_shared.middleCols(first, kCameraUnknowns).transpose() * r;
      part.local.coupling.middleCols(first, kCameraUnknowns).noalias() +=
          weight * by_own.transpose() * by_shared.middleCols(first, kCameraUnknowns);
      if (start.robot) {
        add_block(first, kCameraUnknowns, board, kPoseUnknowns);
        add_block(board, kPoseUnknowns, first, kCameraUnknowns);
        add_block(board, kPoseUnknowns, board, kPoseUnknowns);
        part.shared_gradient.segment(board, kPoseUnknowns) +=
            weight * by_shared.middleCols(board, kPoseUnknowns).transpose() * r;
        part.local.coupling.middleCols(board, kPoseUnknowns).noalias() +=
            weight * by_own.transpose() * by_shared.middleCols(board, kPoseUnknowns);
      }
      part.local.matrix.noalias() += weight * by_own.transpose() * by_own;
      part.local.gradient.noalias() += weight * by_own.transpose() * r;
    }
  }
}

// Adds (value / deviation)^2 for one unknown whose derivative of `value` is 1.
void add_prior(double value, double deviation, double& cost, double* matrix, double* gradient) {
  const double information = 1.0 / (deviation * deviation);
  cost += information * value * value;
  if (matrix) *matrix += information, *gradient += information * value;
}

double evaluate(const Bundle& start, const VectorX& x, solve::ArrowEquations* equations) {
  const int shared = shared_unknowns(start);
  const auto count = static_cast<Eigen::Index>(start.moments.size());
  std::vector<Part> parts(start.moments.size());
  core::parallel_for(count, [&](std::int64_t m) {
    Part& part = parts[m];
    if (equations) {
      part.shared = MatrixX::Zero(shared, shared), part.shared_gradient = VectorX::Zero(shared);
      part.local = {MatrixX::Zero(6, 6), MatrixX::Zero(6, shared), VectorX::Zero(6)};
    }
    const auto own = x.segment(shared + 6 * m, 6);
    const Moment& moment = start.moments[m];
    add_moment(start, x, own, moment, equations, part);
    const bool held = !start.robot && m == start.held_moment && start.held_camera < 0;
    if (!start.robot && !held) return;
    // the robot's error; its rotation vector is small, so that it is moved by what is in front
    const Vector3 turn =
        start.robot ? math::log_so3(math::exp_so3(own.head<3>()) * moment.pose.rotation) : Vector3(own.head<3>());
    const Vector3 shift = start.robot ? Vector3(moment.pose.translation + own.tail<3>()) : Vector3(own.tail<3>());
    for (int k = 0; k < 6; ++k) {
      const double deviation = held ? kHeld : k < 3 ? start.robot_rotation : start.robot_position;
      add_prior(k < 3 ? turn(k) : shift(k - 3), deviation, part.cost, equations ? &part.local.matrix(k, k) : nullptr,
                equations ? &part.local.gradient(k) : nullptr);
    }
  });
  double cost = 0.0;
  solve::ArrowEquations sum;
  if (equations) {
    sum.shared = MatrixX::Zero(shared, shared), sum.gradient = VectorX::Zero(shared);
    sum.local.reserve(parts.size());
  }
  for (Part& part : parts) {
    cost += part.cost;
    if (!equations) continue;
    sum.shared += part.shared, sum.gradient += part.shared_gradient;
    sum.local.push_back(std::move(part.local));
  }
  const auto prior = [&](Eigen::Index i, double value, double deviation) {
    add_prior(value, deviation, cost, equations ? &sum.shared(i, i) : nullptr, equations ? &sum.gradient(i) : nullptr);
  };
  for (std::size_t c = 0; c < start.cameras.size(); ++c) {
    const Eigen::Index first = kCameraUnknowns * static_cast<Eigen::Index>(c);
    const capture::Camera camera = moved_lens(start.cameras[c], x.segment(first, kCameraUnknowns));
    if (!(camera.fx > 1.0 && camera.fy > 1.0)) return std::numeric_limits<double>::infinity();
    const double width = camera.width;
    prior(first, camera.fx - width, kAnyFocal * width), prior(first + 1, camera.fy - width, kAnyFocal * width);
    prior(first + 2, camera.cx - 0.5 * camera.width, kAnyCenter * width);
    prior(first + 3, camera.cy - 0.5 * camera.height, kAnyCenter * width);
    for (int k = 0; k < 5; ++k) prior(first + 4 + k, camera.distortion[k], kAnyDistortion[k]);
    const bool held = !start.robot && static_cast<int>(c) == start.held_camera;
    for (int k = 0; k < 6; ++k) prior(first + 9 + k, x(first + 9 + k), held ? kHeld : k < 3 ? kAnyRotation : kAnyPlace);
    prior(first + 15, x(first + 15), start.robot ? kAnyClock : kHeld);
  }
  if (start.robot)
    for (int k = 0; k < 6; ++k) prior(shared - 6 + k, x(shared - 6 + k), k < 3 ? kAnyRotation : kAnyPlace);
  if (equations) *equations = std::move(sum);
  return cost;
}

}  // namespace

Pose board_in_world(const Bundle& bundle, const Moment& moment, const View& view) {
  if (!bundle.robot) return moment.pose;
  return bundle.robot->pose(view.time + bundle.clocks[view.camera]) * moment.pose * bundle.flange_from_board;
}

std::optional<Vector2> pixel_of(const capture::Camera& camera, const Vector3& point) {
  Eigen::Matrix<double, 2, 3> by_point;
  Eigen::Matrix<double, 2, kLensUnknowns> by_lens;
  return pixel_of(camera, point, by_point, by_lens);
}

std::optional<Vector2> pixel_of(const capture::Camera& camera, const Vector3& point,
                                Eigen::Matrix<double, 2, 3>& by_point,
                                Eigen::Matrix<double, 2, kLensUnknowns>& by_lens) {
  if (!(point.z() > kNear)) return {};
  const double x = point.x() / point.z(), y = point.y() / point.z();
  const auto& [k1, k2, p1, p2, k3] = camera.distortion;
  const double rr = x * x + y * y, radial = 1.0 + rr * (k1 + rr * (k2 + rr * k3)),
               slope = k1 + rr * (2.0 * k2 + 3.0 * rr * k3);  // of `radial` by rr
  // past where the lens folds the image a far point would lead back into it
  if (!(radial + 2.0 * rr * slope > 0.05)) return {};
  const Vector2 bent(x * radial + 2.0 * p1 * x * y + p2 * (rr + 2.0 * x * x),
                     y * radial + p1 * (rr + 2.0 * y * y) + 2.0 * p2 * x * y);
  Eigen::Matrix2d by_plane;
  by_plane << radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x,
      2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y, 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y,
      radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x;
  const Eigen::DiagonalMatrix<double, 2> focal(camera.fx, camera.fy);
  Eigen::Matrix<double, 2, 3> plane_by_point;
  plane_by_point << 1.0 / point.z(), 0.0, -x / point.z(), 0.0, 1.0 / point.z(), -y / point.z();
  by_point = focal * by_plane * plane_by_point;
  by_lens << bent.x(), 0.0, 1.0, 0.0, x * rr, x * rr * rr, 2.0 * x * y, rr + 2.0 * x * x, x * rr * rr * rr,  //
      0.0, bent.y(), 0.0, 1.0, y * rr, y * rr * rr, rr + 2.0 * y * y, 2.0 * x * y, y * rr * rr * rr;
  by_lens.row(0).tail<5>() *= camera.fx, by_lens.row(1).tail<5>() *= camera.fy;
  return Vector2(camera.fx * bent.x() + camera.cx, camera.fy * bent.y() + camera.cy);
}

solve::Summary fit(Bundle& bundle, int steps) {
  VectorX x = VectorX::Zero(shared_unknowns(bundle) + 6 * static_cast<Eigen::Index>(bundle.moments.size()));
  solve::Options options;
  options.steps = steps;
  options.cost_tolerance = 1e-10;
  options.attempts = 12;
  options.cancellable = true;
  const std::function<double(const VectorX&, solve::ArrowEquations*)> cost =
      [&](const VectorX& place, solve::ArrowEquations* equations) { return evaluate(bundle, place, equations); };
  const solve::Summary summary = solve::least_squares(x, cost, options);
  core::stop_if_requested();
  if (x.allFinite()) bundle = at(bundle, x);
  return summary;
}

MatrixX residuals(const Bundle& bundle, const Moment& moment, const View& view, std::vector<double>* depths) {
  const capture::Camera& camera = bundle.cameras[view.camera];
  const Pose camera_from_board = camera.world_from_camera.inverse() * board_in_world(bundle, moment, view);
  MatrixX out(2, static_cast<Eigen::Index>(view.corners.size()));
  if (depths) depths->clear();
  for (Eigen::Index i = 0; i < out.cols(); ++i) {
    const Vector3 point = camera_from_board * view.corners[i].point;
    const auto pixel = pixel_of(camera, point);
    out.col(i) = pixel ? Vector2(*pixel - view.corners[i].pixel) : Vector2::Constant(NAN);
    if (depths) depths->push_back(point.z());
  }
  return out;
}

void set_scales(Bundle& bundle, std::optional<double> absorbed) {
  std::vector<std::vector<double>> sizes(bundle.cameras.size());  // squares of scaled residuals
  std::vector<double> squares(bundle.cameras.size(), 0.0);
  double corners = 0.0;
  for (const Moment& moment : bundle.moments)
    for (const View& view : moment.views) {
      const MatrixX r = residuals(bundle, moment, view, nullptr);
      for (Eigen::Index i = 0; i < r.cols(); ++i) {
        if (!r.col(i).allFinite()) continue;
        const double size = r.col(i).norm() / view.corners[i].deviation;
        sizes[view.camera].push_back(size * size);
        const double most = kRobust * bundle.scales[view.camera];
        squares[view.camera] += size * std::min(size, most), corners += 1.0;
      }
    }
  const double left = std::max(1.0 - absorbed.value_or(0.0) / std::max(2.0 * corners, 1.0), 0.1);
  for (std::size_t c = 0; c < sizes.size(); ++c) {
    if (sizes[c].empty()) continue;
    const double n = static_cast<double>(sizes[c].size());
    // the median of two squared standard normal numbers' sum is 2 ln 2
    const double square = absorbed ? squares[c] / (2.0 * n * left) : math::median(sizes[c]) / (2.0 * std::log(2.0));
    bundle.scales[c] = std::max(std::sqrt(square), 0.05);
  }
}

Certainty certainty(const Bundle& bundle) {
  solve::ArrowEquations equations;
  const VectorX x = VectorX::Zero(shared_unknowns(bundle) + 6 * static_cast<Eigen::Index>(bundle.moments.size()));
  evaluate(bundle, x, &equations);
  const MatrixX information = solve::reduced(equations).matrix;
  // unknowns have units of very different size
  const VectorX size = information.diagonal().cwiseAbs().cwiseSqrt().cwiseMax(1e-12).cwiseInverse();
  const MatrixX scaled = size.asDiagonal() * information * size.asDiagonal();
  const Eigen::SelfAdjointEigenSolver<MatrixX> axes(MatrixX(0.5 * (scaled + scaled.transpose())));
  const VectorX least = axes.eigenvalues().cwiseMax(1e-14);
  Certainty out;
  out.absorbed = static_cast<double>(information.rows());
  out.covariance = size.asDiagonal() *
                   (axes.eigenvectors() * least.cwiseInverse().asDiagonal() * axes.eigenvectors().transpose()) *
                   size.asDiagonal();
  for (std::size_t m = 0; m < bundle.moments.size(); ++m) {
    const auto& local = equations.local[m];
    const Eigen::LDLT<MatrixX> factor(local.matrix);
    const MatrixX inverse = factor.solve(MatrixX::Identity(6, 6)), to_own = factor.solve(local.coupling);
    const MatrixX own = inverse + to_own * out.covariance * to_own.transpose();
    const Pose& pose = bundle.moments[m].pose;
    out.rotation_square += (math::log_so3(pose.rotation).squaredNorm() + own.diagonal().head<3>().sum()) / 3.0;
    out.position_square += (pose.translation.squaredNorm() + own.diagonal().tail<3>().sum()) / 3.0;
    out.absorbed += 6.0;
    if (bundle.robot)  // less what its priors tell
      out.absorbed -= own.diagonal().head<3>().sum() / (bundle.robot_rotation * bundle.robot_rotation) +
                      own.diagonal().tail<3>().sum() / (bundle.robot_position * bundle.robot_position);
  }
  const double count = std::max<double>(1.0, static_cast<double>(bundle.moments.size()));
  out.rotation_square /= count, out.position_square /= count;
  return out;
}

}  // namespace chainsplat::calibration
