// chainsplat/math.h - rotations, rigid motions, twists, wrenches and covariances, on which all geometry and dynamics
// build (mathematics.md 1; Lynch & Park, Modern Robotics).
//
// Twists (omega, v) and wrenches (m, f) have the angular part first. All numbers are double, in SI units and radians.
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

// A rigid motion x -> rotation * x + translation. Variables are named by the frames they connect, so that products read
// as a chain: world_from_camera * camera_from_base.
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
Pose exp_se3(const Vector6& twist);  // mathematics.md 1, by a series below |omega| = 1e-2
Vector6 log_se3(const Pose& pose);   // inverse of exp_se3, accurate up to |omega| = pi
Matrix3 exp_so3(const Vector3& w);
Vector3 log_so3(const Matrix3& rotation);
Matrix6 adjoint(const Pose& pose);         // Ad_T = [R 0; [p]R R]: V_x = Ad_{T_xy} V_y, F_y = Ad_{T_xy}^T F_x
Matrix6 ad(const Vector6& twist);          // ad_V = [[w] 0; [v] [w]]
Matrix6 coadjoint(const Vector6& wrench);  // ad*_F with ad_X^T F = ad*_F X
Vector6 transform_twist(const Pose& pose, const Vector6& twist);  // Ad_T V without forming Ad_T

// Returns the rotation nearest to a 3x3 matrix that is almost one (read from a file with few digits).
Matrix3 orthonormalized(const Matrix3& almost_rotation);

// Returns whether a matrix from outside is a covariance: finite, symmetric and positive semidefinite. The last two hold
// up to kCovarianceTolerance of the correlation matrix, so that units do not matter. Files hold nine digits, and this
// moves the eigenvalues of an n x n correlation matrix by up to 5e-9 n; the computation's own rounding is smaller.
constexpr double kCovarianceTolerance = 1e-6;
bool is_covariance(const MatrixX& m);
// The middle value, of an even number the upper of the two in the middle, 0 of none. Reorders the values.
double median(std::vector<double>& values);

// Returns the indices that remain, in ascending order, after those with unknown (not finite) entries are removed from
// the covariance one by one, each time the index with the most unknown entries.
std::vector<Eigen::Index> known_part(const MatrixX& covariance);
// Returns whether the factored matrix is positive definite and finite. Eigen's info() calls a factor of NaN a success,
// and solving with a failed factor returns garbage without an error.
bool is_positive(const Eigen::LLT<MatrixX>& factor);
bool is_positive(const Eigen::LDLT<MatrixX>& factor);

}  // namespace chainsplat::math
