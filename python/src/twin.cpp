// Twin: loaded once, then rolled out, drawn, differentiated, sampled, written.
#include <limits>
#include <mutex>

#include "chainsplat/export.h"
#include "chainsplat/motion_files.h"
#include "chainsplat/properties.h"
#include "chainsplat/render.h"
#include "chainsplat/validity.h"
#include "module.h"
#include "twin.h"

namespace chainsplat::python {

namespace {

using dynamics::InitialState;
using dynamics::Parameters;
using trajectory::Trajectory;
using Start = std::optional<std::pair<math::VectorX, math::VectorX>>;

const Trajectory& base_or_own(const Twin& twin, const std::optional<Trajectory>& base) {
  return base ? *base : twin.rope.base;
}

// Where a rollout starts, as the program's: what is given, at the first time; else the identified state under the
// twin's own base; else at rest.
InitialState start_of(const Twin& twin, const std::optional<Trajectory>& base, const Start& initial,
                      const std::optional<std::vector<double>>& times) {
  const Trajectory& under = base_or_own(twin, base);
  if (!initial && !base && twin.rope.twin.initial) return *twin.rope.twin.initial;
  const double start = initial && times && !times->empty() ? times->front() : under.start();
  if (!initial) return pipeline::rest_state(twin.rope, under.pose(start), start);
  const int angles = twin.rope.twin.chain.angles();
  if (initial->first.size() != angles || initial->second.size() != angles)
    throw InputError("`initial`", "is not (theta, thetadot) of " + std::to_string(angles) + " numbers each",
                     "give two arrays");
  return pipeline::state_at(model_of(twin.rope), under.pose(start), start, initial->first, initial->second);
}

std::vector<double> times_or(const Twin& twin, const std::optional<Trajectory>& base, const InitialState& initial,
                             const std::optional<std::vector<double>>& times, double rate) {
  return times ? *times : pipeline::times_of(base_or_own(twin, base), initial.time, rate);
}

math::VectorX angles_of(const Twin& twin, const Numbers& theta) {
  const int angles = twin.rope.twin.chain.angles();
  check_shape(theta, "theta", {angles});
  return Eigen::Map<const math::VectorX>(theta.data(), angles);
}

math::Pose base_of(const std::optional<Numbers>& base) { return base ? pose_of(*base, "base") : math::Pose{}; }

chain::States rollout(const Twin& twin, const std::optional<Trajectory>& base, const Start& initial,
                      const std::optional<std::vector<double>>& times, double rate,
                      const std::optional<Parameters>& parameters) {
  return unlocked([&] {
    const InitialState start = start_of(twin, base, initial, times);
    const Trajectory under = base_or_own(twin, base);
    const chain::Chain& chain = twin.rope.twin.chain;
    const dynamics::Model model = parameters ? dynamics::make_model(chain, *parameters) : model_of(twin.rope);
    chain::States found = dynamics::rollout(model, under, start, times_or(twin, base, start, times, rate));
    twin::warn_beyond(twin.rope.twin.validity, twin::validity_of(chain, under, found), "rollout");
    return found;
  });
}

py::dict rollout_batch(const Twin& twin, const std::optional<std::vector<Parameters>>& parameters,
                       const std::optional<std::vector<Trajectory>>& bases,
                       const std::optional<std::vector<std::pair<math::VectorX, math::VectorX>>>& initials,
                       const std::optional<std::vector<double>>& times, double rate) {
  std::vector<Trajectory> under = bases.value_or(std::vector<Trajectory>{twin.rope.base});
  std::vector<InitialState> starts;
  std::vector<double> at;
  const std::vector<chain::States> found = unlocked([&] {
    const std::size_t count = std::max({under.size(), initials ? initials->size() : 1});
    for (std::size_t i = 0; i < count && !under.empty(); ++i) {
      const std::optional<Trajectory> base =
          bases ? std::optional<Trajectory>(under[under.size() == 1 ? 0 : std::min(i, under.size() - 1)])
                : std::nullopt;
      const Start initial = initials && !initials->empty()
                                ? Start((*initials)[initials->size() == 1 ? 0 : std::min(i, initials->size() - 1)])
                                : Start();
      starts.push_back(start_of(twin, base, initial, times));
    }
    at = times ? *times : starts.empty() ? std::vector<double>{} : pipeline::times_of(under[0], starts[0].time, rate);
    return pipeline::rollout_batch(twin.rope, parameters.value_or(std::vector<Parameters>{}), under, starts, at);
  });
  const auto rows = static_cast<py::ssize_t>(at.size()), angles = py::ssize_t{twin.rope.twin.chain.angles()};
  const std::vector<py::ssize_t> shape{static_cast<py::ssize_t>(found.size()), rows, angles};
  py::array_t<double> theta(shape), thetadot(shape);
  const double nan = std::numeric_limits<double>::quiet_NaN();
  std::fill_n(theta.mutable_data(), theta.size(), nan), std::fill_n(thetadot.mutable_data(), theta.size(), nan);
  for (std::size_t i = 0; i < found.size(); ++i)
    for (std::size_t k = 0; k < found[i].theta.size(); ++k) {
      const std::size_t first = (i * at.size() + k) * static_cast<std::size_t>(angles);
      std::copy(found[i].theta[k].begin(), found[i].theta[k].end(), theta.mutable_data() + first);
      std::copy(found[i].thetadot[k].begin(), found[i].thetadot[k].end(), thetadot.mutable_data() + first);
    }
  py::dict out;
  out["time"] = array_of(at), out["theta"] = theta, out["thetadot"] = thetadot;
  return out;
}

py::dict rollout_derivatives(const Twin& twin, const std::vector<std::string>& names,
                             const std::optional<Trajectory>& base, const Start& initial,
                             const std::optional<std::vector<double>>& times, double rate,
                             const std::vector<Trajectory>& directions) {
  const pipeline::Derivatives found = unlocked([&] {
    const InitialState start = start_of(twin, base, initial, times);
    return pipeline::rollout_derivatives(twin.rope, base_or_own(twin, base), start,
                                         times_or(twin, base, start, times, rate), names, directions);
  });
  py::dict out;
  out["states"] = found.states;
  out["theta"] = array_of(found.by_names.theta), out["thetadot"] = array_of(found.by_names.thetadot);
  out["theta_by_base"] = array_of(found.by_directions.theta);
  out["thetadot_by_base"] = array_of(found.by_directions.thetadot);
  return out;
}

std::shared_ptr<render::Images> draw(Twin& twin, const chain::States& states, const capture::Camera& camera,
                                     const std::optional<Trajectory>& base,
                                     const std::optional<std::vector<double>>& times, bool depth, bool undistorted) {
  return unlocked([&] {
    if (twin.rope.twin.gaussians.count == 0)
      throw InputError(twin.rope.run.string(), "has no Gaussians to draw", "recognize it from images first");
    const std::lock_guard lock(twin.drawing);  // one picture at a time on the device
    if (!twin.engine) {
      twin.device = gpu::open_device({.selector = twin.device_name});
      twin.engine.emplace(*twin.device);
    }
    render::Options options;
    options.depth = depth, options.undistorted = undistorted;
    return std::make_shared<render::Images>(render::images(*twin.engine, twin.rope.twin.gaussians, twin.rope.twin.chain,
                                                           states, base_or_own(twin, base), camera,
                                                           times ? *times : states.time, options));
  });
}

py::dict forces(const Twin& twin, const chain::States& states, const std::optional<Trajectory>& base,
                const std::optional<math::Vector3>& contact) {
  const std::vector<force::Estimate> found =
      unlocked([&] { return pipeline::forces(twin.rope, states, base_or_own(twin, base), contact); });
  std::vector<double> time, probability;
  std::vector<math::Vector3> point, force, sigma;
  for (const force::Estimate& e : found) {
    time.push_back(e.time), probability.push_back(e.probability);
    point.push_back(e.point), force.push_back(e.force), sigma.push_back(e.sigma);
  }
  py::dict out;
  out["time"] = array_of(time), out["point"] = array_of(point), out["force"] = array_of(force);
  out["sigma"] = array_of(sigma), out["probability"] = array_of(probability);
  return out;
}

}  // namespace

void add_twin(py::module_& m) {
  using py::arg;
  py::class_<Twin, std::shared_ptr<Twin>>(m, "Twin",
                                          "A rope's twin: a chain of screw joints that moves and looks like it.")
      .def_static(
          "load",
          [](const Path& run, const std::string& device) {
            return unlocked([&] { return std::make_shared<Twin>(pipeline::load_rope(run), device); });
          },
          arg("run"), arg("device") = "", "Loads a run folder. device: that draws, its number or a part of its name.")
      .def(
          "save", [](const Twin& t, const Path& run) { unlocked([&] { twin::save(t.rope.twin, run); }); }, arg("run"))
      .def(
          "export",
          [](const Twin& t, const Path& file, const std::optional<chain::States>& states,
             const std::optional<Trajectory>& base, bool mesh) {
            const chain::States& own = t.rope.twin.rollout.time.empty() ? t.rope.twin.states : t.rope.twin.rollout;
            unlocked([&] {
              twin::Twin twin = t.rope.twin;
              if (base && twin.parameters)  // a simulator's model starts where `rollout` does
                twin.initial = pipeline::rest_state(t.rope, base->pose(base->start()), base->start());
              exports::write(twin, states ? *states : own, base_or_own(t, base), file,
                             {.mesh = mesh, .cameras = {}, .properties = {}});
            });
          },
          arg("file"), arg("states") = py::none(), arg("base") = py::none(), arg("mesh") = false,
          "Writes .glb, .gltf, .ply, .csv, .npz, .xml (MuJoCo), .urdf, .usda or .mcap, with a motion: the rollout, "
          "unless `states` are given.")

      .def_property_readonly(
          "angles", [](const Twin& t) { return t.rope.twin.chain.angles(); }, "n")
      .def_property_readonly(
          "links", [](const Twin& t) { return t.rope.twin.chain.links(); }, "with the base link")
      .def_property_readonly(
          "length", [](const Twin& t) { return t.rope.twin.chain.length; }, "m")
      .def_property_readonly(
          "diameter", [](const Twin& t) { return t.rope.twin.chain.diameter; }, "m")
      .def_property_readonly("tabletop", [](const Twin& t) { return t.rope.twin.tabletop; })
      .def_property_readonly(
          "known_mass", [](const Twin& t) { return t.rope.twin.known_mass; },
          "False: masses are relative, forces are per kilogram of rope")
      .def_property_readonly("trusted", [](const Twin& t) { return t.rope.twin.trusted(); })
      .def_property_readonly(
          "verdict",
          [](const Twin& t) {
            std::vector<std::string> lines;
            for (const capture::Finding& finding : t.rope.twin.verdict) lines.push_back(finding.text);
            return lines;
          },
          "What was found wrong or doubtful, a line each")
      .def_property_readonly(
          "base", [](const Twin& t) { return t.rope.base; }, "The base's motion of its recording")
      .def_property_readonly(
          "states", [](const Twin& t) { return t.rope.twin.states; }, "As recognized, a frame each")
      .def_property_readonly(
          "rollout_states", [](const Twin& t) { return t.rope.twin.rollout; }, "As trained")
      .def_property_readonly("parameters", [](const Twin& t) { return model_of(t.rope).parameters; })
      .def_property_readonly(
          "estimates",
          [](const Twin& t) {
            const dynamics::Estimates& e = t.rope.twin.estimates;
            py::dict out;
            out["names"] = e.names, out["values"] = array_of(e.values);
            out["standard_errors"] = array_of(e.standard_errors), out["covariance"] = array_of(e.covariance);
            return out;
          },
          "What identification found: names, values, standard_errors, covariance")
      .def(
          "properties",
          [](const Twin& t) {
            py::dict out;
            model_of(t.rope);  // says what is missing
            for (const twin::Property& p : twin::properties(t.rope.twin))
              out[p.name.c_str()] = py::make_tuple(p.value, p.sigma, p.unit);
            return out;
          },
          "What people know a rope by: name to (value, standard deviation, unit)")
      .def(
          "cameras",
          [](const Twin& t, const std::vector<capture::Camera>& given) {
            return pipeline::as_corrected(t.rope.twin.corrections, given);
          },
          arg("cameras"), "Cameras as they were given, with what training corrected of them.")

      .def(
          "link_poses",
          [](const Twin& t, const Numbers& theta, const std::optional<Numbers>& base) {
            const chain::Chain& chain = t.rope.twin.chain;
            std::vector<math::Pose> poses = chain::link_motions(chain, angles_of(t, theta), base_of(base));
            for (int j = 0; j < chain.links(); ++j)
              poses[j] = poses[j] * math::Pose{math::Matrix3::Identity(), chain.link_start(j) * chain.direction};
            return array_of(poses);
          },
          arg("theta"), arg("base") = py::none(),
          "(links, 4, 4): frames of the links, where each begins, base link first; m. theta: (n,), rad. base: (4, 4), "
          "the "
          "base's pose; None: in the base's frame.")
      .def(
          "centerline",
          [](const Twin& t, const Numbers& theta, const std::optional<Numbers>& base, int count) {
            const chain::Chain& chain = t.rope.twin.chain;
            return array_of(
                math::MatrixX(chain::centerline(chain, chain::link_motions(chain, angles_of(t, theta), base_of(base)),
                                                chain::equal_arclengths(chain, count))
                                  .transpose()));
          },
          arg("theta"), arg("base") = py::none(), arg("count") = 49,
          "(count, 3), m: equally spaced points from grasp to tip.")
      .def(
          "jacobian",
          [](const Twin& t, const Numbers& theta, double s, const std::optional<Numbers>& base) {
            const chain::Chain& chain = t.rope.twin.chain;
            const math::VectorX angles = angles_of(t, theta);
            if (!(s >= 0.0 && s <= chain.length))
              throw InputError("`s`", "is not on the rope", "give 0 to its length, m");
            const std::vector<math::Pose> motions = chain::link_motions(chain, angles, base_of(base));
            const chain::MaterialPoint point = chain::centerline_point(chain, s);
            return array_of(chain::point_jacobian(chain, chain::world_axes(chain, angles, base_of(base)), point.link,
                                                  motions[point.link] * point.home));
          },
          arg("theta"), arg("s"), arg("base") = py::none(),
          "(3, n), m/rad: of the point of the centerline at arclength s, m, with the base held.")
      .def(
          "rest",
          [](const Twin& t, const std::optional<Numbers>& base) {
            return unlocked([&] { return pipeline::rest_state(t.rope, base_of(base), 0.0).theta; });
          },
          arg("base") = py::none(), "(n,), rad: at rest under a base at rest at `base`, (4, 4).")

      .def("rollout", &rollout, arg("base") = py::none(), arg("initial") = py::none(), arg("times") = py::none(),
           arg("rate") = 30.0, arg("parameters") = py::none(),
           "States under a base's motion (None: its own), as the command rollout. initial: (theta, thetadot); None: as "
           "identified, under another base at rest. times: s, increasing; None: `rate` a second while the base moves. "
           "Motion beyond what the twin was identified in is warned of in the log.")
      .def("rollout_batch", &rollout_batch, arg("parameters") = py::none(), arg("bases") = py::none(),
           arg("initials") = py::none(), arg("times") = py::none(), arg("rate") = 30.0,
           "Many rollouts on all cores. Lists of one length, or of one entry for all. Returns time (T,), theta and "
           "thetadot (B, T, n); NaN after a rollout has diverged.")
      .def("rollout_derivatives", &rollout_derivatives, arg("names"), arg("base") = py::none(),
           arg("initial") = py::none(), arg("times") = py::none(), arg("rate") = 30.0,
           arg("directions") = std::vector<Trajectory>{},
           "A rollout with its derivatives. names: of estimates, or 'theta_1', 'thetadot_1'. Returns states, theta and "
           "thetadot (T, n, names), and by the amplitudes of displacements of the base (`directions`, trajectories "
           "whose "
           "translations are added) theta_by_base and thetadot_by_base (T, n, directions).")
      .def(
          "sample",
          [](const Twin& t, int count, std::uint64_t seed) {
            return unlocked([&] {
              return planning::draw_parameters(t.rope.twin.chain, model_of(t.rope).parameters, t.rope.twin.estimates,
                                               count, seed);
            });
          },
          arg("count"), arg("seed") = 0, "Parameters drawn from the identification's covariance.")
      .def("render", &draw, arg("states"), arg("camera"), arg("base") = py::none(), arg("times") = py::none(),
           arg("depth") = false, arg("undistorted") = false,
           "Draws the states at their times, or at `times`, s, into memory. base: of these states; None: the twin's "
           "own.")
      .def("forces", &forces, arg("states"), arg("base") = py::none(), arg("contact") = py::none(),
           "The force from outside, one a state: time (T,), point (T, 3), m, force and sigma (T, 3), N (per kilogram "
           "unless "
           "known_mass), probability (T,) of a touch. contact: where it is touched, (3,), m, world; None: found.");
}

}  // namespace chainsplat::python
