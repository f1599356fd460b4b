// Values: base motions, cameras, captures, states, parameters, images.
#include <algorithm>

#include "chainsplat/dynamics.h"
#include "chainsplat/in_memory.h"
#include "chainsplat/render.h"
#include "module.h"

namespace chainsplat::python {

namespace {

using dynamics::Parameters;
using trajectory::Trajectory;

Trajectory make_trajectory(const Numbers& time, const Numbers& poses) {
  const std::vector<double> times = list_of(time, "time");
  check_shape(poses, "poses", {static_cast<py::ssize_t>(times.size()), 4, 4});
  std::vector<trajectory::Sample> samples;
  for (std::size_t k = 0; k < times.size(); ++k) {
    const Numbers pose(std::vector<py::ssize_t>{4, 4}, poses.data() + 16 * k);
    samples.push_back({times[k], pose_of(pose, "poses")});
  }
  return unlocked([&] { return trajectory::fit(std::move(samples), "`poses`"); });
}

capture::Camera make_camera(const std::string& name, int width, int height, double fx, double fy, double cx, double cy,
                            const Numbers& world_from_camera, const std::array<double, 5>& distortion) {
  if (width < 1 || height < 1 || !(fx > 0.0) || !(fy > 0.0))
    throw InputError("`camera`", "has a size or a focal length that is not above 0", "give pixels");
  return {name, width, height, fx, fy, cx, cy, distortion, pose_of(world_from_camera, "world_from_camera")};
}

chain::States make_states(const Numbers& time, const Numbers& theta, const std::optional<Numbers>& thetadot) {
  chain::States states;
  states.time = list_of(time, "time");
  check_shape(theta, "theta", {static_cast<py::ssize_t>(states.time.size()), -1});
  states.theta = rows_of(theta, "theta", theta.shape(1));
  if (thetadot) {
    check_shape(*thetadot, "thetadot", {theta.shape(0), theta.shape(1)});
    states.thetadot = rows_of(*thetadot, "thetadot", theta.shape(1));
  }
  if (std::adjacent_find(states.time.begin(), states.time.end(), std::greater_equal<>()) != states.time.end())
    throw InputError("`time`", "does not increase", "sort the states");
  return states;
}

// A frame that was loaded masked, as it was recorded: RGB, black outside of the mask, or the mask alone.
py::array_t<std::uint8_t> picture(const capture::Capture& recorded, int camera, int frame, bool mask) {
  const auto found = std::find_if(recorded.views.begin(), recorded.views.end(),
                                  [&](const capture::ViewPlace& v) { return v.camera == camera && v.frame == frame; });
  if (found == recorded.views.end())
    throw InputError("`frame`", "camera " + std::to_string(camera) + " has no frame " + std::to_string(frame),
                     "load the capture with its images, and with this frame");
  const capture::View view = capture::unpacked(*found);
  const capture::Camera& seen = recorded.cameras[static_cast<std::size_t>(camera)];
  const std::size_t channels = mask ? 1 : 3;
  std::vector<std::uint8_t> pixels(channels * seen.width * seen.height, 0);
  for (int y = 0; y < view.height; ++y)
    for (int x = 0; x < view.width; ++x) {
      const std::uint8_t* const from = &view.rgba[4 * (static_cast<std::size_t>(y) * view.width + x)];
      const std::size_t to = static_cast<std::size_t>(view.y0 + y) * seen.width + view.x0 + x;
      std::copy_n(mask ? from + 3 : from, channels, &pixels[channels * to]);
    }
  std::vector<py::ssize_t> shape{seen.height, seen.width};
  if (!mask) shape.push_back(3);
  return taken(std::move(pixels), shape);
}

using List = std::vector<double> Parameters::*;
void add_list(py::class_<Parameters>& type, const char* name, List list, const char* doc) {
  type.def_property(
      name, [list](const Parameters& p) { return array_of(p.*list); },
      [list, name](Parameters& p, const Numbers& values) {
        check_shape(values, name, {static_cast<py::ssize_t>((p.*list).size())});
        p.*list = list_of(values, name);
      },
      doc);
}

}  // namespace

void add_types(py::module_& m) {
  using py::arg;

  py::class_<Trajectory>(m, "Trajectory",
                         "The base's motion: a smoothing spline through poses, with exact derivatives.")
      .def(py::init(&make_trajectory), arg("time"), arg("poses"),
           "time: (T,), s, increasing. poses: (T, 4, 4), base to world, m. One pose: at rest.")
      .def_static(
          "read",
          [](const Path& file) {
            return unlocked([&] { return trajectory::fit(trajectory::read_tum(file), file.string()); });
          },
          arg("file"), "Reads 'timestamp tx ty tz qx qy qz qw' a line (TUM).")
      .def(
          "write", [](const Trajectory& t, const Path& file) { core::write_file(file, write_tum(t.samples())); },
          arg("file"), "Writes its samples as TUM.")
      .def(
          "pose", [](const Trajectory& t, double time) { return array_of(t.pose(time)); }, arg("time"),
          "(4, 4): base to world at `time`, s.")
      .def(
          "motion",
          [](const Trajectory& t, double time) {
            const trajectory::BaseMotion now = t.at(time);
            return py::make_tuple(array_of(now.pose), math::Vector6(now.velocity), math::Vector6(now.acceleration));
          },
          arg("time"),
          "Pose (4, 4); body twist (6,), rad/s and m/s; its derivative (6,), rad/s^2 and m/s^2, in the base's frame.")
      .def_property_readonly("start", &Trajectory::start, "s")
      .def_property_readonly("end", &Trajectory::end, "s");

  py::class_<capture::Camera>(m, "Camera", "Pinhole camera with OpenCV's axes and lens distortion.")
      .def(py::init(&make_camera), arg("name"), arg("width"), arg("height"), arg("fx"), arg("fy"), arg("cx"), arg("cy"),
           arg("world_from_camera"), arg("distortion") = std::array<double, 5>{},
           "Sizes and focal lengths in px; world_from_camera: (4, 4), m; distortion: k1, k2, p1, p2, k3.")
      .def_readonly("name", &capture::Camera::name)
      .def_readonly("width", &capture::Camera::width)
      .def_readonly("height", &capture::Camera::height)
      .def_readonly("fx", &capture::Camera::fx)
      .def_readonly("fy", &capture::Camera::fy)
      .def_readonly("cx", &capture::Camera::cx)
      .def_readonly("cy", &capture::Camera::cy)
      .def_readonly("distortion", &capture::Camera::distortion)
      .def_readonly("readout", &capture::Camera::readout, "s, from the first row to the last; 0: all at once")
      .def_property_readonly(
          "world_from_camera", [](const capture::Camera& c) { return array_of(c.world_from_camera); }, "(4, 4), m")
      .def(
          "project",
          [](const capture::Camera& c, const Numbers& points) {
            py::array_t<double> out({points.shape(0), py::ssize_t{2}});
            const math::Pose camera_from_world = c.world_from_camera.inverse();
            py::ssize_t k = 0;
            for (const math::VectorX& point : rows_of(points, "points", 3)) {
              const math::Vector2 at =
                  capture::distort(c, capture::project(c, camera_from_world * math::Vector3(point)));
              out.mutable_at(k, 0) = at.x(), out.mutable_at(k++, 1) = at.y();
            }
            return out;
          },
          arg("points"), "(N, 2): recorded pixels of world points (N, 3), m; the center of the first is (0.5, 0.5).");

  py::class_<capture::Capture>(m, "Capture", "A recording: cameras, frames with their masks, the base's motion.")
      .def_static(
          "load",
          [](const Path& folder, bool images, const std::string& camera, int first, int last) {
            capture::LoadOptions options;
            options.images = images, options.camera = camera, options.first = first, options.last = last;
            options.pixels = capture::Pixels::recorded;
            return unlocked([&] { return capture::load(folder, options); });
          },
          arg("folder"), arg("images") = false, arg("camera") = "", arg("first") = 0, arg("last") = -1,
          "Loads a capture's facts and, if asked for, the frames [first, last) of its cameras, or of the named one.")
      .def_readonly("name", &capture::Capture::name)
      .def_readonly("tabletop", &capture::Capture::tabletop)
      .def_readonly("length", &capture::Capture::length, "m")
      .def_readonly("diameter", &capture::Capture::diameter, "m")
      .def_readonly("cameras", &capture::Capture::cameras)
      .def_readonly("base", &capture::Capture::base)
      .def_property_readonly(
          "times",
          [](const capture::Capture& c) {
            py::list out;
            for (const std::vector<double>& times : c.times) out.append(array_of(times));
            return out;
          },
          "For each camera the times of all its frames, s.")
      .def(
          "image", [](const capture::Capture& c, int camera, int frame) { return picture(c, camera, frame, false); },
          arg("camera"), arg("frame"), "(H, W, 3) uint8: a frame as recorded, black outside of its mask.")
      .def(
          "mask", [](const capture::Capture& c, int camera, int frame) { return picture(c, camera, frame, true); },
          arg("camera"), arg("frame"), "(H, W) uint8: 255 in the object.");

  // made by chainsplat.recording()
  py::class_<capture::InMemory>(m, "Recording", "A capture whose pictures are in memory, for train().")
      .def(py::init([](const std::string& document, const Trajectory& base, const std::vector<Bytes>& images,
                       const std::vector<Bytes>& masks, const std::vector<Numbers>& times) {
             capture::InMemory out{document, base.samples(), {}};
             for (std::size_t c = 0; c < times.size(); ++c)
               out.cameras.push_back(
                   {list_of(times[c], "times"), images_of(images[c], "images"), images_of(masks[c], "masks")});
             return out;
           }),
           arg("document"), arg("base"), arg("images"), arg("masks"), arg("times"));

  m.def(
      "write_png", [](const Path& file, const Bytes& image) { capture::write_png(file, image_of(image, "image")); },
      arg("file"), arg("image"), "Writes (H, W, 3) or (H, W) uint8.");

  py::class_<chain::States>(m, "States", "Joint angles along time.")
      .def(py::init(&make_states), arg("time"), arg("theta"), arg("thetadot") = py::none(),
           "time: (T,), s, increasing. theta: (T, n), rad. thetadot: (T, n), rad/s.")
      .def("__len__", [](const chain::States& s) { return s.time.size(); })
      .def_property_readonly(
          "time", [](const chain::States& s) { return array_of(s.time); }, "(T,), s")
      .def_property_readonly(
          "theta", [](const chain::States& s) { return array_of(s.theta); }, "(T, n), rad")
      .def_property_readonly(
          "thetadot", [](const chain::States& s) { return array_of(s.thetadot); },
          "(T, n), rad/s; (0, 0) where they are not known")
      .def_property_readonly(
          "roll", [](const chain::States& s) { return array_of(s.roll); },
          "(T, links), rad, how far the material has turned about each link's axis; (0, 0) where it has not")
      .def_property_readonly(
          "covariance", [](const chain::States& s) { return array_of(s.covariance); },
          "(T, n, n), rad^2, of theta; (0, 0, 0) where it is not known")
      .def(
          "at", [](const chain::States& s, double time) { return chain::interpolate(s, time); }, arg("time"),
          "(n,): the angles at any time, s, by cubics.");

  py::class_<Parameters> parameters(m, "Parameters", "The numbers of the dynamics. Lists by link from 1, or by angle.");
  parameters.def(py::init<const Parameters&>(), arg("other"), "A copy.");
  add_list(parameters, "link_mass", &Parameters::link_mass, "kg, by link");
  add_list(parameters, "viscous_friction", &Parameters::viscous_friction, "N s/m, by link, against the table");
  add_list(parameters, "coulomb_friction", &Parameters::coulomb_friction, "by link, against the table");
  add_list(parameters, "air_linear", &Parameters::air_linear, "N s/m, by link, across the rope");
  add_list(parameters, "air_quadratic", &Parameters::air_quadratic, "N s^2/m^2, by link, across the rope");
  add_list(parameters, "stiffness", &Parameters::stiffness, "N m/rad, by angle");
  add_list(parameters, "rest_angle", &Parameters::rest_angle, "rad, by angle");
  add_list(parameters, "damping", &Parameters::damping, "N m s/rad, by angle");
  add_list(parameters, "bending_friction", &Parameters::bending_friction, "N m, by angle; (0,): none");
  add_list(parameters, "bending_friction_angle", &Parameters::bending_friction_angle, "rad, by angle");
  add_list(parameters, "torsional_stiffness", &Parameters::torsional_stiffness,
           "N m/rad, by joint of two angles; (0,): the rope does not twist");
  parameters.def_readwrite("tip_mass", &Parameters::tip_mass, "kg")
      .def_readwrite("tip_length", &Parameters::tip_length, "m, of what hangs at the tip; 0: a point")
      .def_readwrite("gravity", &Parameters::gravity, "(3,), m/s^2, world")
      .def_readwrite("substeps", &Parameters::substeps, "steps of the integrator in 1/30 s")
      .def_property_readonly("total_mass", &dynamics::total_mass, "kg, of all links and the tip");

  py::class_<render::Images, std::shared_ptr<render::Images>>(m, "Images",
                                                              "Drawn images, one a time, in one piece of memory each.")
      .def_property_readonly(
          "rgb",
          [](const std::shared_ptr<render::Images>& i) {
            return py::array_t<std::uint8_t>({i->count, i->height, i->width, 3}, i->rgb.data(), py::cast(i));
          },
          "(T, H, W, 3) uint8, not copied")
      .def_property_readonly(
          "mask",
          [](const std::shared_ptr<render::Images>& i) {
            return py::array_t<std::uint8_t>({i->count, i->height, i->width}, i->mask.data(), py::cast(i));
          },
          "(T, H, W) uint8, 255 where the rope covers half or more, not copied")
      .def_property_readonly(
          "depth",
          [](const std::shared_ptr<render::Images>& i) {
            const int count = i->depth.empty() ? 0 : i->count;
            return py::array_t<float>({count, i->height, i->width}, i->depth.data(), py::cast(i));
          },
          "(T, H, W) float32, m along the camera's axis, 0: nothing; (0, H, W) unless asked for");
}

}  // namespace chainsplat::python
