#include "src/capture/camera_reader.h"

#include <algorithm>
#include <cctype>
#include <cmath>

#include "chainsplat/text.h"
#include "src/capture/frame_files.h"

namespace chainsplat::capture {

using math::Matrix3;
using math::Vector3;

namespace {

constexpr double kLeastFocal = 1.0, kMostFocal = 1e6;  // px; less is no length in pixels, more are parallel rays
constexpr double kRotationTolerance = 1e-3;            // of |R R^T - I|; numbers of three digits pass
constexpr const char* kReadout = "seconds from the first row to the last, like 0.015, or 0 for a global shutter";
constexpr double kInversePixels = 1e-3;  // px, largest error of undistort(distort(.)) at the border

void read_pose(const ObjectReader& reader, Camera& camera) {
  const char* const expected = "a 4x4 matrix by rows, camera to world, camera axes x right, y down, z forward";
  const auto m = reader.numbers("world_from_camera", 16, true, expected);
  if (!m) return;
  const double* a = m->data();
  Matrix3 rotation;
  rotation << a[0], a[1], a[2], a[4], a[5], a[6], a[8], a[9], a[10];
  const bool bottom = a[12] == 0 && a[13] == 0 && a[14] == 0 && a[15] == 1;
  if (!bottom) {
    const bool by_columns = a[3] == 0 && a[7] == 0 && a[11] == 0 && a[15] == 1;
    reader.problem("world_from_camera",
                   by_columns ? "is written by columns (its last row is not 0 0 0 1)" : "its last row is not 0 0 0 1",
                   by_columns ? "transpose it" : std::string("write ") + expected);
    return;
  }
  if ((rotation * rotation.transpose() - Matrix3::Identity()).cwiseAbs().maxCoeff() > kRotationTolerance) {
    reader.problem("world_from_camera", "its upper left 3x3 is not a rotation", "make its rows unit and perpendicular");
    return;
  }
  if (rotation.determinant() < 0) {
    reader.problem("world_from_camera", "its upper left 3x3 is a reflection", "turn the sign of one camera axis");
    return;
  }
  if (!reader.near("world_from_camera", {a[3], a[7], a[11]})) return;
  camera.world_from_camera = {math::orthonormalized(rotation), {a[3], a[7], a[11]}};
}

// Checks that the lens model can be inverted: a strong one may fold the image over itself.
void check_lens(const ObjectReader& reader, const Camera& camera) {
  if (!camera.distorted()) return;
  const double w = camera.width, h = camera.height;
  for (const math::Vector2& recorded : {math::Vector2(0, 0), math::Vector2(w, 0), math::Vector2(0, h),
                                        math::Vector2(w, h), math::Vector2(0, h / 2), math::Vector2(w / 2, 0)}) {
    const math::Vector2 back = distort(camera, undistort(camera, recorded));
    if (!((back - recorded).norm() < kInversePixels)) {
      reader.problem("distortion",
                     "cannot be undone at pixel (" + core::brief(recorded.x()) + ", " + core::brief(recorded.y()) +
                         "): the model folds the image",
                     "write OpenCV's k1, k2, p1, p2, k3 of this image size");
      return;
    }
  }
}

bool good_name(const std::string& name) {
  return !name.empty() && name.size() <= 64 && name[0] != '.' &&
         std::all_of(name.begin(), name.end(),
                     [](unsigned char c) { return std::isalnum(c) || c == '_' || c == '-' || c == '.'; });
}

// Other lens models than OpenCV's five numbers are refused where they are named: read as these, they bend the image.
void refuse_lens_models(const ObjectReader& reader) {
  for (const char* const key : {"model", "camera_model", "distortion_model", "lens_model", "lens"}) {
    const Json* const value = reader.find(key, false, "");
    if (!value || !value->is_string()) continue;
    std::string name = value->get<std::string>();
    std::transform(name.begin(), name.end(), name.begin(), [](unsigned char c) { return std::tolower(c); });
    for (const char* const other : {"fish", "equidist", "kannala", "omni", "rational", "thin_prism", "fov"})
      if (name.find(other) != std::string::npos)
        reader.problem(key, "the lens model " + in_quotes(value->get<std::string>()) + " is not known here",
                       "undistort images and masks first, and write \"distortion\": [0, 0, 0, 0, 0]");
  }
}

// Reads a camera except its name and the location of its frames.
Camera read_optics(const ObjectReader& reader) {
  refuse_lens_models(reader);
  reader.know({"name", "width", "height", "fx", "fy", "cx", "cy", "distortion", "world_from_camera", "readout",
               "images", "masks", "depth", "depth_scale", "rate", "start", "timestamps"});
  Camera camera;
  camera.width = reader.pixels("width");
  camera.height = reader.pixels("height");
  if (static_cast<std::int64_t>(camera.width) * camera.height > kMostPixels)
    reader.problem("width",
                   std::to_string(camera.width) + "x" + std::to_string(camera.height) + " are more than " +
                       std::to_string(kMostPixels >> 20) + " million pixels, which no memory holds for every frame",
                   "write the image's size, or make the images smaller");
  camera.fx = reader.positive("fx", "the focal length in pixels");
  camera.fy = reader.positive("fy", "the focal length in pixels");
  camera.cx = reader.number("cx", true, "the principal point in pixels").value_or(0.0);
  camera.cy = reader.number("cy", true, "the principal point in pixels").value_or(0.0);
  for (const auto& [key, value] : {std::pair("fx", camera.fx), {"fy", camera.fy}, {"cx", camera.cx}, {"cy", camera.cy}})
    if (std::abs(value) > kMostFocal)
      reader.problem(key, core::exact(value) + " is beyond every camera", "write it in pixels");
  for (const auto& [key, value] : {std::pair("fx", camera.fx), {"fy", camera.fy}})
    if (value > 0.0 && value < kLeastFocal)
      reader.problem(key, core::exact(value) + " is less than a pixel", "write the focal length in pixels");
  if (camera.width > 0 && camera.height > 0 &&
      (camera.cx < 0 || camera.cx > camera.width || camera.cy < 0 || camera.cy > camera.height))
    reader.doubt("cx", "the principal point lies outside the image");
  if (const auto values = reader.numbers("distortion", 5, false, "OpenCV's [k1, k2, p1, p2, k3]"))
    std::copy(values->begin(), values->end(), camera.distortion.begin());
  if (camera.width > 0 && camera.height > 0 && camera.fx >= kLeastFocal && camera.fy >= kLeastFocal)
    check_lens(reader, camera);
  camera.readout = reader.number("readout", false, kReadout).value_or(0.0);
  if (!(std::abs(camera.readout) <= kLongestReadout))
    reader.problem("readout", core::exact(camera.readout) + " s is more than any camera takes",
                   std::string("write ") + kReadout);
  read_pose(reader, camera);
  return camera;
}

CameraSource read_named(const ObjectReader& reader, const std::string& where) {
  CameraSource source;
  source.where = where;
  source.camera = read_optics(reader);
  source.readout_given = reader.has("readout");
  source.camera.name = reader.text("name", true, "a short name like cam0").value_or("");
  if (reader.has("name") && !good_name(source.camera.name))
    reader.problem("name", in_quotes(source.camera.name) + " cannot name a folder", "use letters, digits, - and _");
  return source;
}

}  // namespace

CameraSource read_camera(const ObjectReader& reader, const std::string& where, const CameraFrames& frames) {
  CameraSource source = read_named(reader, where);
  for (const char* const key : {"images", "masks", "depth", "depth_scale", "rate", "start", "timestamps"})
    if (reader.has(key)) reader.problem(key, "does not go with frames that are in memory", "leave it out");
  const auto pictures_of = [](const std::vector<Image8>& pictures) {
    ImageSource out;
    out.pictures = &pictures;
    out.frames = static_cast<int>(pictures.size());
    return out;
  };
  source.images = pictures_of(frames.images);
  if (!frames.masks.empty()) source.masks = pictures_of(frames.masks);
  source.times = frames.times;
  return source;
}

CameraSource read_camera(const ObjectReader& reader, const std::string& where, const Path& folder) {
  CameraSource source = read_named(reader, where);
  if (const auto images = image_source(reader, "images", folder, true)) source.images = *images;
  source.masks = image_source(reader, "masks", folder, false);
  source.depth = image_source(reader, "depth", folder, false);
  if (source.depth && source.depth->video) {
    reader.problem("depth", "is not a pattern", "write 16-bit images like depth/cam0/%06d.png");
    source.depth.reset();
  }
  if (source.depth) source.depth_scale = reader.positive("depth_scale", "meters a unit, like 0.0001");
  if (const auto file = reader.path("timestamps", false, "a text file with a time a line"))
    source.timestamps = folder / *file;
  if (!reader.has("timestamps")) {
    source.rate = reader.rate();
    source.start = reader.number("start", false, "the first frame's time in seconds").value_or(0.0);
  }
  return source;
}

Calibration read_calibration(const Path& path) {
  const std::string file = path.string();
  const Json json = parse_object(core::read_file(path), file, "a camera object as in capture.json");
  const auto cameras = json.find("cameras");  // a whole capture.json of one camera is accepted, too
  const bool whole = cameras != json.end() && cameras->is_array() && cameras->size() == 1 && (*cameras)[0].is_object();
  Findings findings;
  const ObjectReader reader(whole ? &(*cameras)[0] : &json, file + ": ", findings);
  Calibration calibration;
  calibration.camera = read_optics(reader);
  calibration.camera.name = reader.text("name", false, "a short name like cam0").value_or("camera");
  if (reader.has("rate")) calibration.rate = reader.rate();
  calibration.start = reader.number("start", false, "the first frame's time in seconds").value_or(0.0);
  if (!findings.problems.empty()) {
    const Problem& first = findings.problems.front();
    throw InputError(first.where, first.what, first.mend);
  }
  for (const std::string& doubt : findings.doubts) core::warn(doubt);
  return calibration;
}

}  // namespace chainsplat::capture
