#include "pipeline/mistakes.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <functional>
#include <numbers>

#include "chainsplat/estimation.h"
#include "chainsplat/silhouette.h"

namespace chainsplat::pipeline {

using capture::Camera;
using capture::Capture;
using capture::Finding;
using math::Matrix3;
using math::Pose;
using math::Vector3;

namespace {

constexpr int kFrames = 3;  // spread over the recording; a wrong pose is wrong in all of them
constexpr int kJoints = 8;  // enough to find the rope within a few pixels
// Support (see there): of right captures 0.8 and more, and of those whose cameras are off by half a degree 0.6.
constexpr double kMissed = 0.5;      // below this, mistakes are looked for
constexpr double kFound = 0.65;      // from this on, a mistake explains what is seen
constexpr double kClearly = 0.2;     // by which it must raise the support to be believed
constexpr double kClampBend = 1.0;   // rad between the grasp's direction and the rope up to which nothing is odd
constexpr double kOtherSize = 0.15;  // relative distance of the principal point from the middle of the image
constexpr double kFromMillimeters = 1e-3;

// What is varied: everything that a frame is fitted with, but the pictures.
struct Setup {
  std::vector<Camera> cameras;
  std::vector<Pose> base;  // by frame
  double length = 0.0, diameter = 0.0;
};

struct Frame {
  double time = 0.0;
  std::vector<capture::View> views;
};

struct Mistake {
  const char* code;
  std::string subject, text;
  std::function<void(Setup&)> mend;
};

// Frames that every camera sees the object in, where there are such, spread over the recording.
std::vector<Frame> spread_frames(const Capture& capture) {
  std::vector<Frame> all;
  for (const capture::PackedView& view : capture.views)
    if (view.camera == capture.views.front().camera && capture::shows_object(view)) all.push_back({view.time, {}});
  std::vector<Frame> out;
  for (int k = 0; k < kFrames && !all.empty(); ++k) {
    Frame frame = all[(2 * k + 1) * all.size() / (2 * kFrames)];
    for (int c = 0; c < static_cast<int>(capture.cameras.size()); ++c) {
      const capture::PackedView* nearest = nullptr;
      for (const capture::PackedView& view : capture.views)
        if (view.camera == c && capture::shows_object(view) &&
            (!nearest || std::abs(view.time - frame.time) < std::abs(nearest->time - frame.time)))
          nearest = &view;
      if (nearest) frame.views.push_back(capture::unpacked(*nearest));
    }
    out.push_back(std::move(frame));
  }
  return out;
}

// How well the rope explains the masks, 0 to 1: the intersection over union of tube and mask in the camera that it
// explains worst, less where the rope would have to leave the gripper sideways or backwards.
double support(const Capture& capture, const std::vector<Frame>& frames, const Setup& setup) {
  const chain::Bending kind = capture.tabletop ? chain::Bending::planar : chain::Bending::spatial;
  const chain::Chain chain =
      chain::make_chain(setup.length, setup.diameter, capture.direction, capture.bending_axis, kJoints, kind, false);
  std::vector<double> shares(setup.cameras.size(), 0.0);
  for (std::size_t f = 0; f < frames.size(); ++f) {
    std::vector<const capture::View*> views;
    for (const capture::View& view : frames[f].views) views.push_back(&view);
    const silhouette::FrameFit fit =
        silhouette::fit_frame(chain, setup.base[f], views, setup.cameras, math::VectorX::Zero(chain.angles()), false);
    double bend = 0.0;
    for (int k = 0; k < chain.angles() && chain.child_link[k] == 1; ++k) bend = std::hypot(bend, fit.theta[k]);
    const double straight = std::min(1.0, kClampBend / std::max(bend, 1e-9));
    for (const capture::View* const view : views)
      shares[view->camera] += straight / static_cast<double>(frames.size()) *
                              estimation::tube_iou(chain, setup.base[f], fit.theta, *view, setup.cameras[view->camera]);
  }
  return frames.empty() ? 1.0 : *std::min_element(shares.begin(), shares.end());
}

void invert(Camera& camera) { camera.world_from_camera = camera.world_from_camera.inverse(); }
// OpenGL's, Blender's and nerfstudio's cameras look along -z, with y up
void turn_axes(Camera& camera) {
  camera.world_from_camera.rotation *= Vector3(1.0, -1.0, -1.0).asDiagonal().toDenseMatrix();
}
void shrink(Camera& camera) { camera.world_from_camera.translation *= kFromMillimeters; }
// The ratio of two image sizes that is nearest: the principal point is never quite in the middle.
double size_ratio(double middle, double principal) {
  constexpr std::array kRatios = {0.25, 1.0 / 3.0, 0.375, 0.5, 2.0 / 3.0, 0.75, 0.8, 1.0,
                                  1.25, 4.0 / 3.0, 1.5,   2.0, 8.0 / 3.0, 3.0,  4.0};
  const double found = middle / principal;
  return *std::min_element(kRatios.begin(), kRatios.end(), [&](double a, double b) {
    return std::abs(std::log(a / found)) < std::abs(std::log(b / found));
  });
}
void resize(Camera& camera) {
  const double x = size_ratio(0.5 * camera.width, camera.cx), y = size_ratio(0.5 * camera.height, camera.cy);
  camera.fx *= x, camera.cx *= x;
  camera.fy *= y, camera.cy *= y;
}
bool of_other_size(const Camera& camera) {
  return std::abs(2.0 * camera.cx / camera.width - 1.0) > kOtherSize ||
         std::abs(2.0 * camera.cy / camera.height - 1.0) > kOtherSize;
}

// Rotation whose quaternion's numbers were read as x, y, z, w and stand as w, x, y, z.
Matrix3 reordered(const Matrix3& rotation) {
  const Eigen::Quaterniond read(rotation);
  return Eigen::Quaterniond(read.x(), read.y(), read.z(), read.w()).toRotationMatrix();
}

// Mistakes of cameras [first, last): all of them, or one.
void add_camera_mistakes(const Capture& capture, int first, int last, std::vector<Mistake>& out) {
  const bool all = last - first > 1 || capture.cameras.size() == 1;
  const std::string subject = all ? "cameras" : capture.cameras[first].name;
  const auto each = [first, last](void (*change)(Camera&)) {
    return [=](Setup& setup) {
      for (int c = first; c < last; ++c) change(setup.cameras[c]);
    };
  };
  const std::string where = all ? "the cameras' world_from_camera" : subject + "'s world_from_camera";
  out.push_back(
      {"inverse-pose", subject, where + " is the pose of the world in the camera: write its inverse", each(invert)});
  out.push_back({"opengl-axes", subject,
                 where + " has OpenGL's axes (y up, z backward): turn the signs of its second and third column",
                 each(turn_axes)});
  out.push_back({"inverse-pose", subject,
                 where + " is the pose of the world in a camera with OpenGL's axes (y up, z backward): write its "
                         "inverse, then turn the signs of its second and third column",
                 each([](Camera& camera) {
                   invert(camera);
                   turn_axes(camera);
                 })});
  out.push_back({"units", subject, where + " has millimeters: write meters", each(shrink)});
  if (std::any_of(capture.cameras.begin() + first, capture.cameras.begin() + last, of_other_size))
    out.push_back({"image-size", subject,
                   (all ? std::string("the cameras' fx, fy, cx, cy are") : subject + "'s fx, fy, cx, cy are") +
                       " of another image size: multiply them by this image's size over that one's",
                   [first, last](Setup& setup) {
                     for (int c = first; c < last; ++c)
                       if (of_other_size(setup.cameras[c])) resize(setup.cameras[c]);
                   }});
}

std::vector<Mistake> mistakes_of(const Capture& capture) {
  const int cameras = static_cast<int>(capture.cameras.size());
  std::vector<Mistake> out;
  // those of everything first: of two that explain the same, the first is told
  add_camera_mistakes(capture, 0, cameras, out);
  const auto base = [&](const char* code, const std::string& text, Pose (*change)(const Pose&)) {
    out.push_back({code, "base", text, [change](Setup& setup) {
                     for (Pose& pose : setup.base) pose = change(pose);
                   }});
  };
  base("units", "the base's positions are in millimeters: write meters", [](const Pose& pose) {
    return Pose{pose.rotation, kFromMillimeters * pose.translation};
  });
  base("quaternion-order", "the base's quaternions stand as w x y z: write x y z w", [](const Pose& pose) {
    return Pose{reordered(pose.rotation), pose.translation};
  });
  base("inverse-pose", "the base's poses are those of the world in the gripper: write their inverses",
       [](const Pose& pose) { return pose.inverse(); });
  out.push_back({"units", "cameras and base", "cameras and base are in millimeters: write meters", [](Setup& setup) {
                   for (Camera& camera : setup.cameras) shrink(camera);
                   for (Pose& pose : setup.base) pose.translation *= kFromMillimeters;
                 }});
  out.push_back({"units", "object", "the rope's length and diameter are in millimeters: write meters",
                 [](Setup& setup) { setup.length *= kFromMillimeters, setup.diameter *= kFromMillimeters; }});
  out.push_back({"units", "object", "the rope's length and diameter are in centimeters: write meters",
                 [](Setup& setup) { setup.length *= 0.01, setup.diameter *= 0.01; }});
  if (cameras > 1)
    for (int c = 0; c < cameras; ++c) add_camera_mistakes(capture, c, c + 1, out);
  for (int a = 0; a < cameras; ++a)
    for (int b = a + 1; b < cameras; ++b)
      out.push_back({"swapped-videos", capture.cameras[a].name,
                     "the videos of " + capture.cameras[a].name + " and " + capture.cameras[b].name +
                         " are swapped: swap their images and masks",
                     [a, b](Setup& setup) { std::swap(setup.cameras[a], setup.cameras[b]); }});
  return out;
}

}  // namespace

std::vector<Finding> find_mistakes(const Capture& capture) {
  const std::vector<Frame> frames = spread_frames(capture);
  Setup setup{capture.cameras, {}, capture.length, capture.diameter};
  for (const Frame& frame : frames) setup.base.push_back(capture.base.pose(frame.time));
  const double given = support(capture, frames, setup);
  if (given >= kMissed) return {};

  const std::vector<Mistake> mistakes = mistakes_of(capture);
  std::vector<Finding> found;
  double before = given;
  for (int round = 0; round < 2; ++round) {  // people make two at once, seldom three
    std::vector<double> supports(mistakes.size());
    core::parallel_for(static_cast<std::int64_t>(mistakes.size()), [&](std::int64_t i) {
      Setup mended = setup;
      mistakes[i].mend(mended);
      supports[i] = support(capture, frames, mended);
    });
    const auto best = std::max_element(supports.begin(), supports.end());
    if (*best < before + kClearly) break;
    const Mistake& mistake = mistakes[best - supports.begin()];
    char share[64];
    std::snprintf(share, sizeof share, " (rope and masks then overlap by %.0f %%, not %.0f %%)", 100.0 * *best,
                  100.0 * before);
    found.push_back({mistake.code, mistake.subject, *best, 0.0, "share", false, false, true, -1, mistake.text + share});
    mistake.mend(setup);
    before = *best;
    if (before >= kFound) return found;
  }
  return {};  // none explains what is seen
}

}  // namespace chainsplat::pipeline
