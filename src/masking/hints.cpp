#include "src/masking/hints.h"

#include <algorithm>
#include <cmath>

namespace chainsplat::masking {

using math::Vector2;

namespace {

constexpr double kClick = 2.0;  // px, by which a click misses

// As it was given: CAMERA[:FRAME]:X,Y.
std::string text_of(const std::string& hint, const std::string& camera, const std::optional<int>& frame,
                    const std::vector<double>& numbers) {
  std::string text = hint + " " + camera + (frame ? ":" + std::to_string(*frame) : "");
  for (std::size_t i = 0; i < numbers.size(); ++i) text += (i ? "," : ":") + core::exact(numbers[i]);
  return text;
}

int camera_named(const capture::Capture& scene, const std::string& name, const std::string& where) {
  std::string names;
  for (std::size_t c = 0; c < scene.cameras.size(); ++c) {
    if (scene.cameras[c].name == name) return static_cast<int>(c);
    names += (c ? ", " : "") + scene.cameras[c].name;
  }
  throw InputError(where, "the capture has no camera " + name, "it has " + names);
}

void require_frame(const capture::Capture& scene, int camera, const std::optional<int>& frame,
                   const std::string& where) {
  const std::size_t frames = scene.times[camera].size();
  if (frame && (*frame < 0 || *frame >= static_cast<int>(frames)))
    throw InputError(where, "there is no such frame", "the camera has " + std::to_string(frames) + ", counted from 0");
}

std::string size_text(int width, int height) { return std::to_string(width) + "x" + std::to_string(height); }

Help::Point point_of(const PointHint& hint, const capture::Capture& scene, int first) {
  const std::string where = text_of("`point`", hint.camera, hint.frame, {hint.x, hint.y});
  const int c = camera_named(scene, hint.camera, where);
  require_frame(scene, c, hint.frame, where);
  const capture::Camera& camera = scene.cameras[c];
  if (!(hint.x >= 0.0 && hint.x <= camera.width && hint.y >= 0.0 && hint.y <= camera.height))
    throw InputError(where, "lies outside of the picture",
                     "it has " + size_text(camera.width, camera.height) + " pixels");
  const Vector2 recorded(hint.x, hint.y);
  return {c, hint.frame.value_or(first), capture::undistort(camera, recorded), recorded, where};
}

Help::Region region_of(const BoxHint& hint, const capture::Capture& scene) {
  const std::string where = text_of("`box`", hint.camera, hint.frame, {hint.x0, hint.y0, hint.x1, hint.y1});
  const int c = camera_named(scene, hint.camera, where);
  require_frame(scene, c, hint.frame, where);
  const auto [x0, x1] = std::minmax(hint.x0, hint.x1);
  const auto [y0, y1] = std::minmax(hint.y0, hint.y1);
  const Vector2 low = capture::undistort(scene.cameras[c], Vector2(x0, y0)),
                high = capture::undistort(scene.cameras[c], Vector2(x1, y1));
  return {c, hint.frame,
          math::Rectangle{static_cast<int>(std::floor(low.x())), static_cast<int>(std::floor(low.y())),
                          static_cast<int>(std::ceil(high.x())), static_cast<int>(std::ceil(high.y()))}};
}

capture::Image8 picture_of(const EmptyScene& hint, const capture::Camera& camera) {
  capture::Image8 picture = capture::read_image8(hint.picture);
  if (picture.width != camera.width || picture.height != camera.height)
    throw InputError(hint.picture.string(),
                     "has " + size_text(picture.width, picture.height) + " pixels, its camera " +
                         size_text(camera.width, camera.height),
                     "give a picture of the same camera without the rope");
  if (camera.distorted())
    throw InputError(hint.picture.string(), "its camera has lens distortion, which is not taken out of it",
                     "undistort the recording first, or leave `empty` out");
  return picture;
}

}  // namespace

std::vector<Vector2> Help::points_in(int camera, int frame) const {
  std::vector<Vector2> out;
  for (const Point& point : points)
    if (point.camera == camera && point.frame == frame) out.push_back(point.at);
  return out;
}

Help help_of(const Hints& hints, const capture::Capture& scene, int first) {
  Help help;
  help.empty.resize(scene.cameras.size());
  for (const PointHint& hint : hints.points) help.points.push_back(point_of(hint, scene, first));
  for (const BoxHint& hint : hints.boxes) help.boxes.push_back(region_of(hint, scene));
  for (const EmptyScene& hint : hints.empty) {
    const int c = camera_named(scene, hint.camera, "`empty` " + hint.camera + "=" + hint.picture.string());
    help.empty[c] = picture_of(hint, scene.cameras[c]);
  }
  return help;
}

void warn_of_missed_points(const Help& help, int camera, int frame, const capture::Image8& mask) {
  for (const Help::Point& point : help.points) {
    if (point.camera != camera || point.frame != frame) continue;
    bool through = false;
    for (int y = 0; y < mask.height && !through; ++y)
      for (int x = 0; x < mask.width && !through; ++x)
        through = mask.pixels[static_cast<std::size_t>(y) * mask.width + x] != 0 &&
                  (Vector2(x + 0.5, y + 0.5) - point.recorded).norm() < kClick;
    if (!through)
      core::warn(point.text +
                 ": the mask does not run through it: no rope of this length, as smooth as one at rest, was "
                 "found that begins at the grasp and does; check the point, the length and the grasp");
  }
}

}  // namespace chainsplat::masking
