// chainsplat/math.h - SO(3), SE(3), twists and wrenches (SPEC 1; Lynch & Park, Modern Robotics).
//
// Twists (omega, v) and wrenches (m, f) have the angular part first. Everything is double, SI units, radians.
#pragma once
#include <Eigen/Dense>
#include <vector>

namespace chainsplat::math {

using Vector2 = Eigen::Vector2d;
using Vector3 = Eigen::Vector3d;
using Vector6 = Eigen::Matrix<double, 6, 1>;
using VectorX = Eigen::VectorXd;
using Matrix3 = Eigen::Matrix3d;
using Matrix6 = Eigen::Matrix<double, 6, 6>;
using MatrixX = Eigen::MatrixXd;

// A rigid motion x -> rotation * x + translation. `world_from_camera` is a Pose: names chain by reading.
struct Pose {
  Matrix3 rotation = Matrix3::Identity();
  Vector3 translation = Vector3::Zero();

  Vector3 operator*(const Vector3& x) const { return rotation * x + translation; }
  Pose operator*(const Pose& other) const {
    return {rotation * other.rotation, rotation * other.translation + translation};
  }
  Pose inverse() const { return {rotation.transpose(), -(rotation.transpose() * translation)}; }
};

Matrix3 hat(const Vector3& w);       // [w]: hat(w) x = w cross x
Pose exp_se3(const Vector6& twist);  // SPEC 1, series below |omega| = 1e-2
Vector6 log_se3(const Pose& pose);   // inverse of exp_se3, accurate to |omega| = pi
Matrix3 exp_so3(const Vector3& w);
Vector3 log_so3(const Matrix3& rotation);
Matrix6 adjoint(const Pose& pose);         // Ad_T = [R 0; [p]R R]: V_x = Ad_{T_xy} V_y, F_y = Ad_{T_xy}^T F_x
Matrix6 ad(const Vector6& twist);          // ad_V = [[w] 0; [v] [w]]
Matrix6 coadjoint(const Vector6& wrench);  // ad*_F with ad_X^T F = ad*_F X
Vector6 transform_twist(const Pose& pose, const Vector6& twist);  // Ad_T V without forming Ad_T

// Nearest rotation to a 3x3 matrix that is almost one (read from a file with few digits).
Matrix3 orthonormalized(const Matrix3& almost_rotation);

// Whether numbers from outside are a covariance: finite, symmetric and positive semidefinite, each up to
// kCovarianceTolerance of the correlations (so units do not matter). Files hold nine digits: rounding moves eigenvalues
// of n numbers' correlations by up to 5e-9 n, and what computed them by less.
constexpr double kCovarianceTolerance = 1e-6;
bool is_covariance(const MatrixX& m);
// Rows and columns that are left when those of unknown (not finite) numbers are taken out, the emptiest first.
std::vector<Eigen::Index> known_part(const MatrixX& covariance);
// Whether what was factored is positive definite and finite. Eigen's info() calls a factor of NaN a success, and
// solving with one that failed gives garbage without a word.
bool is_positive(const Eigen::LLT<MatrixX>& factor);
bool is_positive(const Eigen::LDLT<MatrixX>& factor);

}  // namespace chainsplat::math
