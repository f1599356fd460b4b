// module.h - the parts of the module chainsplat._core.
#pragma once
#include <pybind11/functional.h>

#include <functional>
#include <optional>
#include <string>

#include "arrays.h"
#include "chainsplat/core.h"

namespace chainsplat::python {

void add_errors(py::module_& m);
void add_types(py::module_& m);  // Trajectory, Camera, Capture, States, Parameters, Images
void add_twin(py::module_& m);
void add_work(py::module_& m);    // train, identify, evaluate, plan
void add_follow(py::module_& m);  // Follower

using ProgressFunction =
    std::function<void(const std::string& stage, std::int64_t step, std::int64_t total, double loss)>;
// Runs long work without the GIL. `progress` is called with it; Ctrl-C and an exception of `progress` stop the work,
// and are raised here when it has stopped and left its checkpoint.
void run(const std::optional<ProgressFunction>& progress, const std::function<void(const core::Listener&)>& work);

// A call of the library without the GIL: others may run meanwhile, and its own threads may log.
template <class Call>
auto unlocked(Call call) {
  const py::gil_scoped_release release;
  return call();
}

}  // namespace chainsplat::python
