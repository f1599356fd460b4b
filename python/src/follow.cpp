// Follower: a rope followed through frames as they come.
#include <variant>

#include "chainsplat/estimation.h"
#include "module.h"
#include "twin.h"

namespace chainsplat::python {

namespace {

using estimation::Estimate;
using Base = std::variant<std::monostate, trajectory::Trajectory, Numbers>;

class Follower {
 public:
  Follower(const std::shared_ptr<Twin>& followed, const std::vector<capture::Camera>& given, const Base& base,
           double start, const std::string& solver, const std::string& device, bool corrected)
      : twin_(followed) {
    pipeline::TrackerOptions options;
    options.device = device;
    if (solver == "newton") options.solver = pipeline::Solver::newton;
    if (solver == "silhouette") options.solver = pipeline::Solver::silhouette;
    if (solver == "adam") options.solver = pipeline::Solver::adam;
    if (!solver.empty() && !options.solver)
      throw InputError("`solver`", "'" + solver + "' is none", "give newton, silhouette or adam");
    dynamics::BaseFunction motion;
    if (const auto* known = std::get_if<trajectory::Trajectory>(&base)) {
      motion = [known = *known](double time) { return known.at(time); };
      start = known->start();
    } else {
      const auto* pose = std::get_if<Numbers>(&base);
      const trajectory::Trajectory& own = twin_->rope.base;
      poses_ = std::make_shared<pipeline::LiveBase>();
      poses_->add(start, pose ? pose_of(*pose, "base") : own.pose(own.start()));
      motion = [poses = poses_](double time) { return poses->at(time); };
    }
    unlocked([&] {
      std::vector<char> unverified(given.size(), 0);
      const std::vector<capture::Camera> cameras =
          corrected ? given : pipeline::as_corrected(twin_->rope.twin.corrections, given, &unverified);
      tracker_.emplace(twin_->rope.twin, cameras, std::move(motion), start, options, unverified);
    });
  }

  Estimate update(const std::vector<Bytes>& images, const std::optional<std::vector<Bytes>>& masks, double time,
                  const std::optional<Numbers>& base) {
    const std::vector<capture::Camera>& cameras = tracker_->cameras();
    if (images.size() > cameras.size() || images.empty() || (masks && masks->size() != images.size()))
      throw InputError("`image`",
                       std::to_string(images.size()) + " images, " +
                           std::to_string(masks ? masks->size() : images.size()) + " masks, " +
                           std::to_string(cameras.size()) + " cameras",
                       "give one of each for every camera, in their order");
    if (!masks && images.size() > 1)
      throw InputError("`mask`", "is needed with several cameras", "give a mask for each image");
    std::vector<capture::Image8> pictures, coverage;
    for (const Bytes& image : images) pictures.push_back(image_of(image, "image"));
    if (masks)
      for (const Bytes& mask : *masks) coverage.push_back(image_of(mask, "mask"));
    if (base) {
      if (!poses_) throw InputError("`base`", "is known beforehand", "leave it out, or make the Follower with a pose");
      poses_->add(time, pose_of(*base, "base"));
    }
    return unlocked([&] {
      std::vector<capture::View> views;
      for (std::size_t c = 0; c < pictures.size(); ++c) {
        views.push_back(masks ? capture::view_of(cameras[c], pictures[c], coverage[c])
                              : tracker_->mask(pictures[c], time));
        views.back().camera = static_cast<int>(c);
        views.back().time = time, views.back().frame = frames_;
      }
      ++frames_;
      return tracker_->update(views);
    });
  }

 private:
  std::shared_ptr<Twin> twin_;
  std::shared_ptr<pipeline::LiveBase> poses_;  // none where the base's motion is known beforehand
  std::optional<pipeline::Tracker> tracker_;
  int frames_ = 0;
};

}  // namespace

void add_follow(py::module_& m) {
  using py::arg;
  py::class_<Estimate>(m, "Estimate", "What one frame came to.")
      .def_readonly("time", &Estimate::time, "s")
      .def_readonly("theta", &Estimate::theta, "(n,), rad")
      .def_readonly("thetadot", &Estimate::thetadot, "(n,), rad/s")
      .def_property_readonly(
          "covariance", [](const Estimate& e) { return array_of(e.covariance); },
          "(2 n, 2 n), of theta and thetadot; (0, 0): unknown")
      .def_property_readonly(
          "base_late", [](const Estimate& e) { return e.base.late; },
          "s, by which the base's stamps are believed to be late")
      .def_readonly("base_late_sigma", &Estimate::late_sigma, "s, standard deviation of base_late")
      .def_readonly("theta_by_base_late", &Estimate::theta_by_late,
                    "(n,), rad/s: how theta changes with base_late; (0,): not known")
      .def_property_readonly(
          "grasp", [](const Estimate& e) { return array_of(e.base.grasp); },
          "(4, 4): how the rope is believed to be held, base from grasp; the identity where it is as given")
      .def_readonly("settling", &Estimate::settling,
                    "True while cameras or clock are being learned: no force should be told from it")
      .def_readonly("centerline_sigma", &Estimate::centerline_sigma, "m, standard deviation along the rope, RMS")
      .def_readonly("iou", &Estimate::iou, "of the rope's tube and the mask")
      .def_readonly("residual", &Estimate::residual, "px, of the outline")
      .def_readonly("surprise", &Estimate::surprise, "about 1 as long as the model holds")
      .def_readonly("seen", &Estimate::seen)
      .def_property_readonly("status", &estimation::status, "'following', 'doubtful' or 'lost'");

  py::class_<Follower>(m, "Follower", "Follows a rope through frames as they come. One thread at a time.")
      .def(py::init<const std::shared_ptr<Twin>&, const std::vector<capture::Camera>&, const Base&, double,
                    const std::string&, const std::string&, bool>(),
           arg("twin"), arg("cameras"), arg("base") = py::none(), arg("start") = 0.0, arg("solver") = "",
           arg("device") = "", arg("corrected") = false,
           "base: its motion, a Trajectory; or its pose (4, 4) at `start`, s, and update() gets the later ones; None: "
           "at "
           "rest where the twin's recording began. solver: 'newton', 'silhouette', 'adam'; '': newton, and silhouette "
           "without a device. corrected: the cameras are as they are; else what training corrected of them is applied.")
      .def(
          "update",
          [](Follower& f, const Bytes& image, const std::optional<Bytes>& mask, double time,
             const std::optional<Numbers>& base) {
            return f.update({image}, mask ? std::optional<std::vector<Bytes>>({*mask}) : std::nullopt, time, base);
          },
          arg("image"), arg("mask"), arg("time"), arg("base") = py::none(),
          "The next frame of one camera. image: (H, W, 3) uint8, as recorded. mask: (H, W) uint8, 128 and more in the "
          "rope; "
          "None: made here. time: s, increasing. base: (4, 4), the base's pose then.")
      .def("update_all", &Follower::update, arg("images"), arg("masks"), arg("time"), arg("base") = py::none(),
           "The same of several cameras at nearly one time, in their order.");
}

}  // namespace chainsplat::python
