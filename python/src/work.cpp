// Long work: train, identify, evaluate, plan, excite.
#include <cmath>
#include <variant>

#include "chainsplat/in_memory.h"
#include "chainsplat/motion_files.h"
#include "chainsplat/pipeline.h"
#include "module.h"
#include "twin.h"

namespace chainsplat::python {

namespace {

using planning::Plan;

std::string text_of(const py::handle& value) {
  if (py::isinstance<py::bool_>(value)) return value.cast<bool>() ? "true" : "false";
  if (!py::isinstance<py::str>(value) && py::isinstance<py::sequence>(value)) {
    std::string text;
    for (const py::handle& part : value) text += (text.empty() ? "" : ",") + py::str(part).cast<std::string>();
    return text;
  }
  return py::str(value).cast<std::string>();
}

struct Workspace {
  std::shared_ptr<pipeline::Workspace> kept = pipeline::make_workspace();
};

// `options`: by the names of the program's job files (formats.md).
std::shared_ptr<Twin> train(const std::variant<Path, const capture::InMemory*>& capture, const Path& folder,
                            const std::optional<ProgressFunction>& progress, bool resume, bool force,
                            const Path& picture, bool anyway, std::uint64_t seed, const std::string& device,
                            Workspace* workspace, const py::kwargs& settings) {
  pipeline::TrainOptions options;
  options.resume = resume, options.force = force, options.picture = picture, options.anyway = anyway;
  options.seed = seed, options.device = device;
  for (const auto& [name, value] : settings)
    if (!value.is_none())
      pipeline::set(options, name.cast<std::string>(), text_of(value), "`" + name.cast<std::string>() + "`");
  pipeline::Workspace* const kept = workspace ? workspace->kept.get() : nullptr;
  run(progress, [&](const core::Listener& listener) {
    if (const auto* const path = std::get_if<Path>(&capture))
      pipeline::train(*path, folder, options, listener, kept);
    else if (const capture::InMemory* const recording = std::get<const capture::InMemory*>(capture))
      pipeline::train(*recording, folder, options, listener, kept);
    else
      throw InputError("`capture`", "is None", "give a folder or a Recording");
  });
  return unlocked([&] { return std::make_shared<Twin>(pipeline::load_rope(folder), device); });
}

void identify(const std::vector<Path>& runs, bool joint, const std::vector<Path>& markers,
              const std::optional<ProgressFunction>& progress, std::uint64_t seed, const std::string& device) {
  if (!markers.empty() && runs.size() != 1)
    throw InputError("`markers`", "go with one run", "give the twin's run folder alone");
  run(progress, [&](const core::Listener& listener) {
    if (markers.empty()) {
      pipeline::IdentifyOptions options;
      options.joint = joint, options.seed = seed, options.device = device;
      pipeline::identify(runs, options, listener);
    } else {
      pipeline::MarkerOptions options;
      options.seed = seed;
      pipeline::identify_markers(runs[0], markers, options, listener);
    }
  });
}

py::dict evaluate(const Path& folder, const Path& capture, const Path& picture, const std::string& device,
                  const Path& lpips) {
  pipeline::EvaluateOptions options;
  options.picture = picture, options.device = device, options.lpips = lpips;
  pipeline::Evaluation found;
  run({}, [&](const core::Listener& listener) { found = pipeline::evaluate(folder, capture, options, listener); });
  py::dict out;
  const auto add = [&](const char* name, const std::optional<eval::Metrics>& metrics) {
    if (!metrics) return;
    py::dict mean;
    const eval::FrameMetrics& m = metrics->mean;
    for (const auto& [key, value] : {std::pair("psnr", m.psnr),
                                     {"psnr_object", m.psnr_object},
                                     {"ssim", m.ssim},
                                     {"lpips", m.lpips},
                                     {"iou", m.iou},
                                     {"chamfer", m.chamfer},
                                     {"centerline_rms", m.centerline_rms},
                                     {"tip_rms", m.tip_rms},
                                     {"shape_rms", m.shape_rms}})
      if (!std::isnan(value)) mean[key] = value;
    out[name] = mean;
  };
  add("recognized", found.recognized);
  add("rollout", found.rollout);
  return out;
}

struct Planned {
  planning::Problem problem;
  Plan plan;
};

Planned plan(const Twin& twin, const Numbers& targets, const std::string& axes, double horizon, bool free_horizon,
             const std::string& hit, const std::optional<math::VectorX>& terminal, int samples,
             const std::optional<std::pair<math::VectorX, math::VectorX>>& initial, std::uint64_t seed) {
  planning::Options options;
  if (!axes.empty()) options.axes = planning::parse_axes(axes);
  options.horizon = horizon, options.free_horizon = free_horizon, options.terminal = terminal;
  options.samples = samples, options.seed = seed;
  if (hit == "tip") options.part = planning::Part::tip;
  if (hit == "last-link") options.part = planning::Part::last_link;
  if (hit == "rope") options.part = planning::Part::rope;
  if (!hit.empty() && !options.part)
    throw InputError("`hit`", "'" + hit + "' is nothing that can hit", "give tip, last-link or rope");
  Numbers points = targets;
  if (points.ndim() == 1) points = points.reshape({1, -1});
  Planned out;
  const std::vector<math::VectorX> rows = rows_of(points, "targets", 3);
  return unlocked([&] {
    out.problem = pipeline::planning_problem(twin.rope);
    if (initial) {
      if (initial->first.size() != twin.rope.twin.chain.angles() || initial->second.size() != initial->first.size())
        throw InputError("`initial`", "is not (theta, thetadot) of the rope's angles", "give two arrays");
      out.problem.initial =
          pipeline::state_at(out.problem.model, out.problem.base, 0.0, initial->first, initial->second);
    }
    for (const math::VectorX& row : rows) out.problem.targets.push_back(row);
    out.plan = planning::plan(out.problem, options);
    return out;
  });
}

trajectory::Trajectory base_of(const planning::Motion& motion, double end, double rate) {
  planning::check_rate(rate, end, "give rows a second, for example 100");
  std::vector<trajectory::Sample> samples;
  for (const double time : planning::row_times(end, rate))
    samples.push_back({time, planning::base_at(motion, time).pose});
  return trajectory::fit(std::move(samples), "the motion");
}

// A motion to record, and how long it is.
struct Excited {
  excitation::Result result;
  double duration = 0.0;  // s
};

Excited excite(const Twin& twin, double duration, const std::string& axes, double stroke, double velocity,
               double acceleration, double jerk, const std::optional<double>& noise, double frame_rate, double max_bend,
               std::uint64_t seed) {
  excitation::Options options;
  if (!axes.empty()) options.axes = planning::parse_axes(axes);
  options.duration = duration, options.frame_rate = frame_rate, options.max_bend = max_bend, options.seed = seed;
  options.limits.stroke = stroke, options.limits.velocity = velocity;
  options.limits.acceleration = acceleration, options.limits.jerk = jerk;
  return unlocked([&] {
    options.noise = noise;
    return Excited{excitation::excite(pipeline::excitation_problem(twin.rope), options), duration};
  });
}

// By name: the standard error now, after the motion, and after one more recording of the old motion.
py::dict errors_of(const excitation::Prediction& p) {
  py::dict out;
  for (std::size_t i = 0; i < p.names.size(); ++i) {
    py::dict row;
    row["now"] = p.now[i], row["excited"] = p.excited[i];
    if (!p.repeated.empty()) row["repeated"] = p.repeated[i];
    out[py::str(p.names[i])] = row;
  }
  return out;
}

}  // namespace

void add_work(py::module_& m) {
  using py::arg;
  py::class_<Workspace>(
      m, "Workspace",
      "What calls of train() in one process hand on to the next, which is then cheaper and has the same "
      "bits: the opened device, and the last capture as it was read and corrected, until one of its "
      "files changes. It costs that capture's memory once more.")
      .def(py::init<>());
  m.def("train", &train, arg("capture"), arg("run"), arg("progress") = py::none(), arg("resume") = false,
        arg("force") = false, arg("picture") = "", arg("anyway") = false, arg("seed") = 0, arg("device") = "",
        arg("workspace") = py::none(),
        "Makes the twin of a capture, a folder or a Recording, in the folder `run`, and returns it. progress: called "
        "with (stage, step, total, "
        "loss). Further options by name: joints, bending ('planar', 'spatial'), twist, every, frames ('0:60'), mode "
        "('fast', 'paper'), stages, joint, fixed. workspace: a Workspace, for several trainings one after the other. "
        "Ctrl-C stops it and leaves a checkpoint, from which `resume` goes on with the same bits.");
  m.def(
      "identify", &identify, arg("runs"), arg("joint") = false, arg("markers") = std::vector<Path>{},
      arg("progress") = py::none(), arg("seed") = 0, arg("device") = "",
      "Finds the dynamics of recognized runs anew, one set of parameters for all, or of one run from marker files, and "
      "saves them there.");
  m.def(
      "evaluate", &evaluate, arg("run"), arg("capture"), arg("picture") = "", arg("device") = "", arg("lpips") = "",
      "How well a twin explains a capture: {'recognized': {'iou': ..., 'psnr': ...}, 'rollout': {...}}, means over all "
      "frames; dB, m. `lpips`: a trunk that tools/lpips_trunk made, for LPIPS, too.");

  py::class_<Planned>(m, "Plan", "A base motion that brings the rope to its targets, and what it comes to.")
      .def_property_readonly("reached", [](const Planned& p) { return p.plan.reached; })
      .def_property_readonly(
          "reason", [](const Planned& p) { return p.plan.reason; }, "Why it is not reached")
      .def_property_readonly(
          "misses",
          [](const Planned& p) {
            std::vector<double> out;
            for (const planning::Hit& hit : p.plan.hits) out.push_back(hit.miss);
            return array_of(out);
          },
          "(targets,), m")
      .def_property_readonly(
          "times",
          [](const Planned& p) {
            std::vector<double> out;
            for (const planning::Hit& hit : p.plan.hits) out.push_back(hit.time);
            return array_of(out);
          },
          "(targets,), s: when the rope is there")
      .def_property_readonly(
          "points",
          [](const Planned& p) {
            std::vector<math::Vector3> out;
            for (const planning::Hit& hit : p.plan.hits) out.push_back(hit.point);
            return array_of(out);
          },
          "(targets, 3), m: where the rope is then")
      .def_property_readonly(
          "duration", [](const Planned& p) { return p.plan.motion.end(); }, "s")
      .def(
          "base", [](const Planned& p, double rate) { return base_of(p.plan.motion, p.plan.motion.end(), rate); },
          arg("rate") = 100.0, "The base's motion, with samples at `rate` a second.")
      .def(
          "states",
          [](const Planned& p, double rate) {
            return unlocked([&] {
              planning::check_rate(rate, p.plan.motion.end(), "give rows a second, for example 100");
              return planning::predict(p.problem, p.plan.motion, planning::row_times(p.plan.motion.end(), rate));
            });
          },
          arg("rate") = 100.0, "The rope's predicted states.")
      .def(
          "json", [](const Planned& p) { return planning::plan_json(p.problem, {}, p.plan, ""); }, "As plan.json.");
  py::class_<Excited>(m, "Excitation", "The base motion that is to be recorded next, and what it will tell.")
      .def_readonly("duration", &Excited::duration, "s")
      .def_property_readonly(
          "states", [](const Excited& e) { return e.result.states; }, "The rope's predicted states.")
      .def_property_readonly(
          "parameters", [](const Excited& e) { return errors_of(e.result.prediction); },
          "By name the standard error 'now', 'excited' (after a recording of the motion) and 'repeated' (after one "
          "more "
          "of the old motion).")
      .def_property_readonly(
          "gain", [](const Excited& e) { return e.result.prediction.gain; },
          "Decrease of the log of the uncertain volume per parameter.")
      .def_property_readonly(
          "repeated_gain", [](const Excited& e) { return e.result.prediction.repeated_gain; },
          "The same by the old motion again.")
      .def(
          "base", [](const Excited& e, double rate) { return base_of(e.result.motion, e.duration, rate); },
          arg("rate") = 100.0, "The base's motion, with samples at `rate` a second.");
  m.def("excite", &excite, arg("twin"), arg("duration") = 5.0, arg("axes") = "", arg("stroke") = 0.2,
        arg("velocity") = 1.5, arg("acceleration") = 10.0, arg("jerk") = 200.0, arg("noise") = py::none(),
        arg("frame_rate") = 30.0, arg("max_bend") = 1.2, arg("seed") = 0,
        "The base motion to record next, after which the parameters' errors shrink most. duration: s. axes: 'x', "
        "'x,y,yaw', ...; '': x, of a spatial chain x and y, on a table x, y and yaw. Limits in m, m/s, m/s^2, m/s^3. "
        "noise: m, by which a recorded point is off the model; None: as in the twin's own recording. max_bend: rad.");
  m.def(
      "plan", &plan, arg("twin"), arg("targets"), arg("axes") = "", arg("horizon") = 3.0, arg("free_horizon") = false,
      arg("hit") = "", arg("terminal") = py::none(), arg("samples") = 0, arg("initial") = py::none(), arg("seed") = 0,
      "Plans from rest to rest. targets: (3,) or (targets, 3), m, world. axes: 'x,y,z,yaw' or some of them. horizon: s "
      "for each target. hit: 'tip', 'last-link', 'rope'. terminal: offset at the end, one an axis. samples: parameter "
      "sets that the motion shall do for. initial: (theta, thetadot) at the start; None: at rest.");
  m.def("set_threads", &core::set_threads, arg("threads"), "Host threads of the library; 0: one a core.");
}

}  // namespace chainsplat::python
