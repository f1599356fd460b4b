#include "arrays.h"

#include <algorithm>
#include <cmath>

namespace chainsplat::python {

namespace {

std::string text_of(const py::array& array) {
  std::string text = "(";
  for (py::ssize_t d = 0; d < array.ndim(); ++d) text += (d ? ", " : "") + std::to_string(array.shape(d));
  return text + ")";
}

template <class Row>
py::array_t<double> table(const std::vector<Row>& rows) {
  const auto columns = static_cast<py::ssize_t>(rows.empty() ? 0 : rows[0].size());
  py::array_t<double> out({static_cast<py::ssize_t>(rows.size()), columns});
  double* to = out.mutable_data();
  for (const Row& row : rows) to = std::copy(row.begin(), row.end(), to);
  return out;
}

void fill(const math::Pose& pose, double* to) {
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 3; ++column) *to++ = pose.rotation(row, column);
    *to++ = pose.translation[row];
  }
  for (const double value : {0.0, 0.0, 0.0, 1.0}) *to++ = value;
}

}  // namespace

void check_shape(const py::array& array, const std::string& name, std::initializer_list<py::ssize_t> shape) {
  bool fits = array.ndim() == static_cast<py::ssize_t>(shape.size());
  py::ssize_t d = 0;
  std::string wanted;
  for (const py::ssize_t size : shape) {
    fits = fits && (size < 0 || array.shape(d) == size);
    wanted += (d++ ? ", " : "") + (size < 0 ? std::string("any") : std::to_string(size));
  }
  if (!fits)
    throw InputError("`" + name + "`", "has the shape " + text_of(array), "give an array of shape (" + wanted + ")");
}

math::Pose pose_of(const Numbers& matrix, const std::string& name) {
  check_shape(matrix, name, {4, 4});
  math::Pose pose;
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 3; ++column) pose.rotation(row, column) = matrix.at(row, column);
    pose.translation[row] = matrix.at(row, 3);
  }
  constexpr double kTolerance = 1e-3;  // of |R R^T - I|, as of a capture's cameras
  const math::Matrix3 off = pose.rotation * pose.rotation.transpose() - math::Matrix3::Identity();
  if (!(off.norm() < kTolerance) || pose.rotation.determinant() < 0.0 || !pose.translation.allFinite() ||
      matrix.at(3, 0) != 0.0 || matrix.at(3, 1) != 0.0 || matrix.at(3, 2) != 0.0 || matrix.at(3, 3) != 1.0)
    throw InputError("`" + name + "`", "is no rigid motion",
                     "give 4 x 4 numbers: a rotation, a translation in meters, and 0 0 0 1 below");
  pose.rotation = math::orthonormalized(pose.rotation);
  return pose;
}

std::vector<math::VectorX> rows_of(const Numbers& array, const std::string& name, py::ssize_t columns) {
  check_shape(array, name, {-1, columns});
  std::vector<math::VectorX> rows;
  for (py::ssize_t row = 0; row < array.shape(0); ++row)
    rows.push_back(Eigen::Map<const math::VectorX>(array.data(row, 0), columns));
  return rows;
}

std::vector<double> list_of(const Numbers& list, const std::string& name) {
  check_shape(list, name, {-1});
  return {list.data(), list.data() + list.size()};
}

capture::Image8 image_of(const Bytes& picture, const std::string& name) {
  const int channels = picture.ndim() == 3 ? static_cast<int>(picture.shape(2)) : 1;
  if (picture.ndim() == 2)
    check_shape(picture, name, {-1, -1});
  else
    check_shape(picture, name, {-1, -1, 3});
  return {static_cast<int>(picture.shape(1)),
          static_cast<int>(picture.shape(0)),
          channels,
          {picture.data(), picture.data() + picture.size()}};
}

std::vector<capture::Image8> images_of(const Bytes& pictures, const std::string& name) {
  const int channels = pictures.ndim() == 4 ? static_cast<int>(pictures.shape(3)) : 1;
  if (pictures.ndim() == 3)
    check_shape(pictures, name, {-1, -1, -1});
  else
    check_shape(pictures, name, {-1, -1, -1, 3});
  const auto height = static_cast<int>(pictures.shape(1)), width = static_cast<int>(pictures.shape(2));
  const py::ssize_t size = pictures.size() / std::max<py::ssize_t>(1, pictures.shape(0));
  std::vector<capture::Image8> out;
  for (py::ssize_t k = 0; k < pictures.shape(0); ++k)
    out.push_back({width, height, channels, {pictures.data() + k * size, pictures.data() + (k + 1) * size}});
  return out;
}

py::array_t<double> array_of(const math::Pose& pose) {
  py::array_t<double> out({4, 4});
  fill(pose, out.mutable_data());
  return out;
}

py::array_t<double> array_of(const std::vector<math::Pose>& poses) {
  py::array_t<double> out({static_cast<py::ssize_t>(poses.size()), py::ssize_t{4}, py::ssize_t{4}});
  for (std::size_t k = 0; k < poses.size(); ++k) fill(poses[k], out.mutable_data() + 16 * k);
  return out;
}

py::array_t<double> array_of(const math::MatrixX& matrix) {
  py::array_t<double> out({matrix.rows(), matrix.cols()});
  using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
  Eigen::Map<RowMajor>(out.mutable_data(), matrix.rows(), matrix.cols()) = matrix;
  return out;
}

py::array_t<double> array_of(const std::vector<math::VectorX>& rows) { return table(rows); }
py::array_t<double> array_of(const std::vector<math::Vector3>& rows) { return table(rows); }

py::array_t<double> array_of(const std::vector<math::MatrixX>& matrices) {
  const auto rows = matrices.empty() ? 0 : matrices[0].rows(), columns = matrices.empty() ? 0 : matrices[0].cols();
  py::array_t<double> out({static_cast<py::ssize_t>(matrices.size()), rows, columns});
  double* to = out.mutable_data();
  for (const math::MatrixX& matrix : matrices)
    for (Eigen::Index row = 0; row < rows; ++row)
      for (Eigen::Index column = 0; column < columns; ++column) *to++ = matrix(row, column);
  return out;
}

py::array_t<double> array_of(const std::vector<double>& list) {
  return py::array_t<double>(static_cast<py::ssize_t>(list.size()), list.data());
}

}  // namespace chainsplat::python
