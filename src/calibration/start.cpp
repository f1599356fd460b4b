#include "start.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>
#include "src/math/decompositions.h"

namespace chainsplat::calibration {

using math::Matrix3;
using math::MatrixX;
using math::Pose;
using math::Vector2;
using math::Vector3;
using math::VectorX;

namespace {

constexpr double kLeastTurn = 0.1;   // rad, between two views whose turns tell the clock
constexpr double kClockStep = 0.01;  // s
constexpr double kTurnStep = 0.005;  // s, at which the robot's turns are looked up
constexpr double kTurnError = 0.01;  // rad, of a good view
constexpr double kDistinct = 2.0;    // the best clock's misfit must be less than that of others by this factor
constexpr double kOtherClock = 0.2;  // s: this far away is another clock
constexpr double kDegree = std::numbers::pi / 180.0;

// Homography from the board's plane to the image, both in the given coordinates; by the direct linear transformation.
std::optional<Matrix3> homography(const std::vector<Vector2>& board, const std::vector<Vector2>& image) {
  if (board.size() < 4) return {};
  const auto normalized = [](const std::vector<Vector2>& points, Matrix3& transform) {
    Vector2 center = Vector2::Zero();
    for (const Vector2& p : points) center += p / static_cast<double>(points.size());
    double size = 0.0;
    for (const Vector2& p : points) size += (p - center).norm() / static_cast<double>(points.size());
    const double s = size > 0.0 ? std::sqrt(2.0) / size : 1.0;
    transform << s, 0, -s * center.x(), 0, s, -s * center.y(), 0, 0, 1;
  };
  Matrix3 from_board, from_image;
  normalized(board, from_board), normalized(image, from_image);
  Eigen::Matrix<double, 9, 9> sum = Eigen::Matrix<double, 9, 9>::Zero();
  for (std::size_t i = 0; i < board.size(); ++i) {
    const Vector3 b = from_board * board[i].homogeneous(), p = from_image * image[i].homogeneous();
    Eigen::Matrix<double, 2, 9> row;
    row << b.transpose(), Vector3::Zero().transpose(), -p.x() * b.transpose(), Vector3::Zero().transpose(),
        b.transpose(), -p.y() * b.transpose();
    sum += row.transpose() * row;
  }
  const Eigen::SelfAdjointEigenSolver<MatrixX> axes{MatrixX(sum)};
  if (!(axes.eigenvalues()(1) > 1e-10 * axes.eigenvalues()(8))) return {};
  const VectorX h = axes.eigenvectors().col(0);
  const Matrix3 out =
      from_image.inverse() * Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(h.data()) * from_board;
  if (!out.allFinite()) return {};
  return out;
}

double angle_between(const Matrix3& a, const Matrix3& b) {
  return std::acos(std::clamp(0.5 * ((a.transpose() * b).trace() - 1.0), -1.0, 1.0));
}

}  // namespace

std::optional<double> focal_length(const std::vector<const View*>& views, int width, int height) {
  double products = 0.0, squares = 0.0;  // of a u + v = 0 for a = (width / f)^2
  for (const View* view : views) {
    std::vector<Vector2> board, image;
    for (const Seen& seen : view->corners) {
      board.push_back(seen.point.head<2>());
      image.push_back((seen.pixel - 0.5 * Vector2(width, height)) / width);
    }
    const auto h = homography(board, image);
    if (!h) continue;
    const Matrix3 m = *h / h->col(0).norm();
    for (const auto& [u, v] : {std::pair(m.col(0).head<2>().dot(m.col(1).head<2>()), m(2, 0) * m(2, 1)),
                               std::pair(m.col(0).head<2>().squaredNorm() - m.col(1).head<2>().squaredNorm(),
                                         m(2, 0) * m(2, 0) - m(2, 1) * m(2, 1))})
      products += u * v, squares += u * u;
  }
  if (!(squares > 0.0) || !(products < 0.0)) return {};
  const double f = width / std::sqrt(-products / squares);
  if (!(f > 0.2 * width && f < 20.0 * width)) return {};
  return f;
}

std::optional<Pose> pose_by_homography(const View& view, const capture::Camera& camera) {
  std::vector<Vector2> board, image;
  for (const Seen& seen : view.corners) {
    const Vector2 p = camera.distorted() ? capture::undistort(camera, seen.pixel) : seen.pixel;
    board.push_back(seen.point.head<2>());
    image.push_back({(p.x() - camera.cx) / camera.fx, (p.y() - camera.cy) / camera.fy});
  }
  const auto h = homography(board, image);
  if (!h) return {};
  const double size = 0.5 * (h->col(0).norm() + h->col(1).norm());
  const Matrix3 m = *h / (h->col(2).z() < 0.0 ? -size : size);
  Matrix3 turn;
  turn << m.col(0), m.col(1), m.col(0).cross(m.col(1));
  const Pose pose{math::orthonormalized(turn), m.col(2)};
  if (!pose.rotation.allFinite() || !pose.translation.allFinite()) return {};
  return pose;
}

Pose middle_pose(const std::vector<Pose>& poses, double arm) {
  CHAINSPLAT_CHECK(!poses.empty(), "no pose");
  std::size_t best = 0;
  double least = std::numeric_limits<double>::infinity();
  for (std::size_t i = 0; i < poses.size(); ++i) {
    double sum = 0.0;
    for (const Pose& other : poses)
      sum += (poses[i].translation - other.translation).norm() + arm * angle_between(poses[i].rotation, other.rotation);
    if (sum < least) least = sum, best = i;
  }
  return poses[best];
}

std::optional<double> clock_by_turns(const std::vector<Placed>& views, const trajectory::Trajectory& robot, double from,
                                     double to) {
  struct Pair {
    double a, b, angle;
  };
  std::vector<Pair> pairs;
  for (const std::size_t gap : {1, 2, 4, 8, 16, 32})
    for (std::size_t i = 0; i + gap < views.size(); ++i) {
      const double angle = angle_between(views[i].camera_from_board.rotation.transpose(),
                                         views[i + gap].camera_from_board.rotation.transpose());
      if (angle > kLeastTurn) pairs.push_back({views[i].time, views[i + gap].time, angle});
    }
  if (pairs.size() < 5) return {};
  // every clock asks for the same turns again
  std::vector<Matrix3> turns;
  for (double t = robot.start(); t <= robot.end(); t += kTurnStep) turns.push_back(robot.pose(t).rotation);
  const auto turn_at = [&](double time) { return std::lround((time - robot.start()) / kTurnStep); };
  // misfit by clock: Cauchy's, so that views with a wrong pose do not decide
  std::vector<double> clocks, misfits;
  for (double clock = from; clock <= to + 1e-9; clock += kClockStep) {
    double sum = 0.0;
    std::size_t inside = 0;
    for (const Pair& pair : pairs) {
      const long a = turn_at(pair.a + clock), b = turn_at(pair.b + clock);
      if (std::min(a, b) < 0 || std::max(a, b) >= static_cast<long>(turns.size())) continue;
      const double off = (angle_between(turns[a].transpose(), turns[b].transpose()) - pair.angle) / kTurnError;
      sum += std::log1p(off * off);
      ++inside;
    }
    if (2 * inside < pairs.size()) continue;
    clocks.push_back(clock), misfits.push_back(sum / static_cast<double>(inside));
  }
  if (clocks.empty()) return {};
  const std::size_t best = std::min_element(misfits.begin(), misfits.end()) - misfits.begin();
  double other = std::numeric_limits<double>::infinity();
  for (std::size_t i = 0; i < clocks.size(); ++i)
    if (std::abs(clocks[i] - clocks[best]) > kOtherClock) other = std::min(other, misfits[i]);
  if (std::isfinite(other) && !(other > kDistinct * misfits[best])) return {};
  return clocks[best];
}

std::optional<HandEye> hand_eye(const std::vector<Placed>& views, const trajectory::Trajectory& robot, double clock) {
  std::vector<Pose> flanges;
  std::vector<bool> used(views.size(), true);
  for (const Placed& view : views) flanges.push_back(robot.pose(view.time + clock));
  HandEye out;
  for (int round = 0; round < 4; ++round) {
    // R_c R_i = R_f R_b, i the view, f the flange, c the camera, b the board: vec(R_c) and vec(R_b) are the singular
    // vectors of sum R_i^T (x) R_f^T for its largest value, of which the right one is an eigenvector of the sum's
    // square
    MatrixX sum = MatrixX::Zero(9, 9);
    int count = 0;
    for (std::size_t i = 0; i < views.size(); ++i) {
      if (!used[i]) continue;
      ++count;
      const Matrix3 &a = views[i].camera_from_board.rotation, &f = flanges[i].rotation;
      for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c) sum.block<3, 3>(3 * r, 3 * c) += a(c, r) * f.transpose();
    }
    if (count < 3) return {};
    const Eigen::SelfAdjointEigenSolver<MatrixX> right_vectors(MatrixX(sum.transpose() * sum));
    const VectorX right_vector = right_vectors.eigenvectors().rightCols<1>();
    const VectorX left_vector = VectorX(sum * right_vector).normalized();
    const auto rotation = [](const VectorX& v) {
      const Matrix3 m = Eigen::Map<const Matrix3>(v.data());
      const double det = m.determinant();
      return math::orthonormalized((det < 0 ? -1.0 : 1.0) * m / std::cbrt(std::max(std::abs(det), 1e-12)));
    };
    out.flange_from_board.rotation = rotation(left_vector);
    out.world_from_camera.rotation = rotation(right_vector);
    // t_c - R_f t_b = t_f - R_c t_i
    MatrixX normal = MatrixX::Identity(6, 6) * 1e-9;
    VectorX right = VectorX::Zero(6);
    for (std::size_t i = 0; i < views.size(); ++i) {
      if (!used[i]) continue;
      Eigen::Matrix<double, 3, 6> row;
      row << Matrix3::Identity(), -flanges[i].rotation;
      normal += row.transpose() * row;
      right += row.transpose() *
               (flanges[i].translation - out.world_from_camera.rotation * views[i].camera_from_board.translation);
    }
    const VectorX t = normal.ldlt().solve(right);
    if (!t.allFinite()) return {};
    out.world_from_camera.translation = t.head<3>(), out.flange_from_board.translation = t.tail<3>();
    // those that do not agree
    std::vector<double> angles, misses;
    for (std::size_t i = 0; i < views.size(); ++i) {
      const Pose left = flanges[i] * out.flange_from_board, side = out.world_from_camera * views[i].camera_from_board;
      angles.push_back(angle_between(left.rotation, side.rotation));
      misses.push_back((left.translation - side.translation).norm());
    }
    std::vector<double> sorted = angles, distances = misses;
    const double most = std::max(3.0 * math::median(sorted), 0.5 * kDegree);
    out.miss = math::median(distances);
    const double farthest = std::max(3.0 * out.miss, 1e-3);
    bool changed = false;
    for (std::size_t i = 0; i < views.size(); ++i) {
      const bool good = angles[i] <= most && misses[i] <= farthest;
      changed = changed || good != used[i];
      used[i] = good;
    }
    if (!changed) break;
  }
  return out;
}

}  // namespace chainsplat::calibration
