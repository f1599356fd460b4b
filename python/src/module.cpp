// chainsplat._core - the Python module: errors, messages, and work that can be stopped.
#include "module.h"

#include <exception>

namespace chainsplat::python {

namespace {

py::handle error_type, input_error_type, work_error_type;  // for the life of the process

py::handle make_error(py::module_& m, const char* name, const char* doc, const py::tuple& bases) {
  const std::string full = std::string("chainsplat.") + name;
  PyObject* const type = PyErr_NewExceptionWithDoc(full.c_str(), doc, bases.ptr(), nullptr);
  if (!type) throw py::error_already_set();
  m.attr(name) = py::handle(type);
  return type;
}

void raise(py::handle type, const Error& error) {
  const py::object made = type(error.what());
  made.attr("where") = error.where;
  made.attr("what") = error.problem;
  made.attr("how") = error.mend;
  PyErr_SetObject(type.ptr(), made.ptr());
}

// What the library says goes to the logger "chainsplat".
void log(const char* level, const std::string& line) {
  const py::gil_scoped_acquire gil;
  try {
    py::module_::import("logging").attr("getLogger")("chainsplat").attr(level)("%s", line);
  } catch (py::error_already_set& broken) {
    broken.discard_as_unraisable("chainsplat: a log handler");
  }
}

core::Listener to_the_log() {
  core::Listener listener;
  listener.warning = [](const std::string& line) { log("warning", line); };
  listener.message = [](const std::string& line) { log("info", line); };
  listener.detail = [](const std::string& line) { log("debug", line); };
  return listener;
}

}  // namespace

void add_errors(py::module_& m) {
  const auto builtin = [](PyObject* type) { return py::reinterpret_borrow<py::object>(type); };
  error_type = make_error(m, "Error", "What went wrong: `where`, `what`, and `how` to mend it.",
                          py::make_tuple(builtin(PyExc_Exception)));
  input_error_type = make_error(m, "InputError", "The request or its input is wrong; nothing was written.",
                                py::make_tuple(error_type, builtin(PyExc_ValueError)));
  work_error_type = make_error(m, "WorkError", "The work failed half-way; what exists is kept.",
                               py::make_tuple(error_type, builtin(PyExc_RuntimeError)));
  py::register_exception_translator([](std::exception_ptr thrown) {
    try {
      if (thrown) std::rethrow_exception(thrown);
    } catch (const InputError& error) {
      raise(input_error_type, error);
    } catch (const WorkError& error) {
      raise(work_error_type, error);
    } catch (const Interrupted&) {
      PyErr_SetNone(PyExc_KeyboardInterrupt);
    }
  });
  core::set_listener(to_the_log());
}

void run(const std::optional<ProgressFunction>& progress, const std::function<void(const core::Listener&)>& work) {
  std::exception_ptr raised;  // by Python, while it was asked
  const auto ask = [&raised](const std::function<void()>& python) {
    const py::gil_scoped_acquire gil;
    try {
      if (!raised) python();
    } catch (...) {
      raised = std::current_exception();
    }
  };
  core::Listener listener = to_the_log();
  if (progress)
    listener.progress = [&](const core::Progress& p) { ask([&] { (*progress)(p.stage, p.step, p.total, p.loss); }); };
  listener.stop = [&] {
    ask([] {
      if (PyErr_CheckSignals() != 0) throw py::error_already_set();
    });
    return raised != nullptr;
  };
  try {
    const py::gil_scoped_release release;
    work(listener);
  } catch (const Interrupted&) {
    if (!raised) throw;
  }
  if (raised) std::rethrow_exception(raised);
}

// NumPy 2 lays its types out in another way. pybind11 before 2.12 does not know, and would hand out arrays of one
// number again and again, without an error.
void check_numpy() {
#if PYBIND11_VERSION_HEX < 0x020C0000
  const auto version = py::module_::import("numpy").attr("__version__").cast<std::string>();
  if (std::stoi(version) >= 2)
    throw py::import_error("chainsplat: it was built with pybind11 " + std::to_string(PYBIND11_VERSION_MAJOR) + "." +
                           std::to_string(PYBIND11_VERSION_MINOR) + ", which cannot exchange arrays with NumPy " +
                           version + "; install 'numpy<2', or build the module with pip install .");
#endif
}

}  // namespace chainsplat::python

PYBIND11_MODULE(_core, m) {
  using namespace chainsplat::python;
  check_numpy();
  m.doc() = "Digital twins of ropes from videos. Use it as `import chainsplat as cs`.";
  m.attr("__version__") = CHAINSPLAT_VERSION;
  add_errors(m);
  add_types(m);
  add_twin(m);
  add_work(m);
  add_follow(m);
}
