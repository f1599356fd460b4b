#include "chainsplat/math.h"

#include <algorithm>
#include <cmath>
#include <numeric>
#include "src/math/decompositions.h"

namespace chainsplat::math {

namespace {

constexpr double kSmallAngle = 1e-2;  // rad; below it the series are exact to rounding (mathematics.md 1)

struct ExpCoefficients {
  double a, b, c;  // sin x / x, (1 - cos x)/x^2, (x - sin x)/x^3
};

ExpCoefficients exp_coefficients(double angle) {
  const double x2 = angle * angle;
  if (angle < kSmallAngle) {
    return {1 + x2 * (-1.0 / 6 + x2 * (1.0 / 120 - x2 / 5040)), 0.5 + x2 * (-1.0 / 24 + x2 * (1.0 / 720 - x2 / 40320)),
            1.0 / 6 + x2 * (-1.0 / 120 + x2 * (1.0 / 5040 - x2 / 362880))};
  }
  // 1 - cos x = 2 sin^2(x/2) has no cancellation
  const double half = std::sin(0.5 * angle);
  return {std::sin(angle) / angle, 2 * half * half / x2, (angle - std::sin(angle)) / (x2 * angle)};
}

}  // namespace

Matrix3 hat(const Vector3& w) {
  Matrix3 m;
  m << 0, -w.z(), w.y(), w.z(), 0, -w.x(), -w.y(), w.x(), 0;
  return m;
}

Matrix3 exp_so3(const Vector3& w) {
  const auto [a, b, c] = exp_coefficients(w.norm());
  (void)c;
  const Matrix3 skew = hat(w);
  return Matrix3::Identity() + a * skew + b * skew * skew;
}

Pose exp_se3(const Vector6& twist) {
  const Vector3 w = twist.head<3>();
  const auto [a, b, c] = exp_coefficients(w.norm());
  const Matrix3 skew = hat(w), square = skew * skew;
  return {Matrix3::Identity() + a * skew + b * square, (Matrix3::Identity() + b * skew + c * square) * twist.tail<3>()};
}

Vector3 log_so3(const Matrix3& rotation) {
  // Eigen forms the quaternion with the largest pivot, so that no digits are lost near pi
  Eigen::Quaterniond q(rotation);
  q.normalize();
  if (q.w() < 0) q.coeffs() = -q.coeffs();
  const double sine = q.vec().norm();
  if (sine < 1e-7) return 2.0 / q.w() * (1.0 - sine * sine / (3.0 * q.w() * q.w())) * q.vec();
  Vector3 w = 2.0 * std::atan2(sine, q.w()) / sine * q.vec();
  if (q.w() < 1e-15) {  // at exactly pi the sign is a convention: the first non-zero component is positive
    for (int i = 0; i < 3; ++i) {
      if (w[i] != 0.0) {
        if (w[i] < 0.0) w = -w;
        break;
      }
    }
  }
  return w;
}

Vector6 log_se3(const Pose& pose) {
  const Vector3 w = log_so3(pose.rotation);
  const double angle = w.norm(), x2 = angle * angle;
  const double d =
      angle < kSmallAngle ? 1.0 / 12 + x2 / 720 + x2 * x2 / 30240 : (1.0 - 0.5 * angle / std::tan(0.5 * angle)) / x2;
  const Matrix3 skew = hat(w);
  Vector6 twist;
  twist << w, (Matrix3::Identity() - 0.5 * skew + d * skew * skew) * pose.translation;
  return twist;
}

Matrix6 adjoint(const Pose& pose) {
  Matrix6 m = Matrix6::Zero();
  m.topLeftCorner<3, 3>() = pose.rotation;
  m.bottomRightCorner<3, 3>() = pose.rotation;
  m.bottomLeftCorner<3, 3>() = hat(pose.translation) * pose.rotation;
  return m;
}

Matrix6 ad(const Vector6& twist) {
  Matrix6 m = Matrix6::Zero();
  m.topLeftCorner<3, 3>() = hat(twist.head<3>());
  m.bottomRightCorner<3, 3>() = m.topLeftCorner<3, 3>();
  m.bottomLeftCorner<3, 3>() = hat(twist.tail<3>());
  return m;
}

Matrix6 coadjoint(const Vector6& wrench) {
  Matrix6 m = Matrix6::Zero();
  m.topLeftCorner<3, 3>() = hat(wrench.head<3>());
  m.topRightCorner<3, 3>() = hat(wrench.tail<3>());
  m.bottomLeftCorner<3, 3>() = m.topRightCorner<3, 3>();
  return m;
}

Vector6 transform_twist(const Pose& pose, const Vector6& twist) {
  Vector6 out;
  const Vector3 w = pose.rotation * twist.head<3>();
  out << w, pose.translation.cross(w) + pose.rotation * twist.tail<3>();
  return out;
}

Matrix3 orthonormalized(const Matrix3& almost_rotation) {
  const Eigen::JacobiSVD<Matrix3> svd(almost_rotation, Eigen::ComputeFullU | Eigen::ComputeFullV);
  // turning the axis of the least singular value makes a rotation of a reflection
  Matrix3 sign = Matrix3::Identity();
  sign(2, 2) = (svd.matrixU() * svd.matrixV().transpose()).determinant() < 0 ? -1.0 : 1.0;
  return svd.matrixU() * sign * svd.matrixV().transpose();
}

bool is_covariance(const MatrixX& m) {
  if (m.rows() != m.cols() || !m.allFinite() || (m.diagonal().array() < 0.0).any()) return false;
  const VectorX deviation = m.diagonal().cwiseSqrt();
  // the correlation matrix; a variable of zero variance must have zero covariances
  MatrixX correlation = m;
  for (Eigen::Index i = 0; i < m.rows(); ++i)
    for (Eigen::Index j = 0; j < m.cols(); ++j) {
      if (deviation[i] == 0.0 || deviation[j] == 0.0) {
        if (m(i, j) != 0.0) return false;
        correlation(i, j) = i == j ? 1.0 : 0.0;
        continue;
      }
      correlation(i, j) = m(i, j) / deviation[i] / deviation[j];
    }
  if (!((correlation - correlation.transpose()).array().abs() <= kCovarianceTolerance).all()) return false;
  correlation.diagonal().array() += kCovarianceTolerance;
  return is_positive(Eigen::LLT<MatrixX>(correlation));
}

double median(std::vector<double>& values) {
  if (values.empty()) return 0.0;
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

std::vector<Eigen::Index> known_part(const MatrixX& covariance) {
  std::vector<Eigen::Index> kept(static_cast<std::size_t>(covariance.rows()));
  std::iota(kept.begin(), kept.end(), Eigen::Index{0});
  while (!kept.empty()) {
    const MatrixX part = covariance(kept, kept);
    const auto unknown = (part.array() - part.array()).isNaN();  // true for infinite entries, too
    const Eigen::ArrayXi gaps = unknown.cast<int>().rowwise().sum() + unknown.cast<int>().colwise().sum().transpose();
    Eigen::Index emptiest = 0;
    if (gaps.maxCoeff(&emptiest) == 0) break;
    kept.erase(kept.begin() + emptiest);
  }
  return kept;
}

bool is_positive(const Eigen::LLT<MatrixX>& factor) {
  const auto diagonal = factor.matrixLLT().diagonal().array();
  return factor.info() == Eigen::Success && (diagonal > 0.0).all() && diagonal.isFinite().all();
}

bool is_positive(const Eigen::LDLT<MatrixX>& factor) {
  const auto diagonal = factor.vectorD().array();
  return factor.info() == Eigen::Success && (diagonal > 0.0).all() && diagonal.isFinite().all();
}

}  // namespace chainsplat::math
