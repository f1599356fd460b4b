// arrays.h - NumPy arrays to the library's types and back. What comes from Python is copied and checked; large results
// go to Python without a copy.
#pragma once
#include <pybind11/eigen.h>
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>
#include <pybind11/stl/filesystem.h>

#include <initializer_list>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "chainsplat/capture.h"
#include "chainsplat/chain.h"
#include "chainsplat/trajectory.h"

namespace chainsplat::python {

namespace py = pybind11;

using Numbers = py::array_t<double, py::array::c_style | py::array::forcecast>;
using Bytes = py::array_t<std::uint8_t, py::array::c_style | py::array::forcecast>;

// Throws InputError unless the array has this shape; -1: any size.
void check_shape(const py::array& array, const std::string& name, std::initializer_list<py::ssize_t> shape);

math::Pose pose_of(const Numbers& matrix, const std::string& name);  // 4 x 4; the rotation is made exact
std::vector<math::VectorX> rows_of(const Numbers& table, const std::string& name, py::ssize_t columns);
std::vector<double> list_of(const Numbers& list, const std::string& name);
capture::Image8 image_of(const Bytes& picture, const std::string& name);  // H x W x 3, or H x W
// T x H x W x 3, or T x H x W
std::vector<capture::Image8> images_of(const Bytes& pictures, const std::string& name);

py::array_t<double> array_of(const math::Pose& pose);                // 4 x 4
py::array_t<double> array_of(const std::vector<math::Pose>& poses);  // count x 4 x 4
py::array_t<double> array_of(const math::MatrixX& matrix);
py::array_t<double> array_of(const std::vector<math::VectorX>& rows);      // rows x n
py::array_t<double> array_of(const std::vector<math::Vector3>& rows);      // rows x 3
py::array_t<double> array_of(const std::vector<math::MatrixX>& matrices);  // count x rows x columns
py::array_t<double> array_of(const std::vector<double>& list);

// The memory of a vector as an array that owns it: no copy.
template <class T>
py::array_t<T> taken(std::vector<T> values, std::vector<py::ssize_t> shape) {
  auto owner = std::make_unique<std::vector<T>>(std::move(values));
  T* const data = owner->data();
  py::capsule free(owner.release(), [](void* p) { delete static_cast<std::vector<T>*>(p); });
  return py::array_t<T>(std::move(shape), data, free);
}

}  // namespace chainsplat::python
