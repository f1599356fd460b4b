// COLMAP's models: cameras and images as text or binary. Poses take the world to the camera, quaternions have the
// scalar first, and the center of the first pixel is (0.5, 0.5).
#include <bit>
#include <cstring>
#include <map>
#include <sstream>

#include "calibration.h"
#include "document.h"

namespace chainsplat::importing {

namespace {

static_assert(std::endian::native == std::endian::little, "COLMAP's files are little endian");

struct Model {
  const char* name;
  std::size_t parameters;
};
constexpr Model kModels[] = {{"SIMPLE_PINHOLE", 3},
                             {"PINHOLE", 4},
                             {"SIMPLE_RADIAL", 4},
                             {"RADIAL", 5},
                             {"OPENCV", 8},
                             {"OPENCV_FISHEYE", 8},
                             {"FULL_OPENCV", 12},
                             {"FOV", 5},
                             {"SIMPLE_RADIAL_FISHEYE", 4},
                             {"RADIAL_FISHEYE", 5},
                             {"THIN_PRISM_FISHEYE", 12}};

struct Camera {
  std::string model;
  int width = 0, height = 0;
  std::vector<double> parameters;
};
struct Image {
  std::string name;
  std::uint32_t camera = 0;
  Eigen::Quaterniond rotation;
  math::Vector3 translation;
};
struct Files {
  std::map<std::uint32_t, Camera> cameras;
  std::vector<Image> images;
};

// A binary file, read from front to back.
class Bytes {
 public:
  explicit Bytes(const Path& file) : file_(file), text_(core::read_file(file)) {}
  template <class Value>
  Value take() {
    Value value;
    need(sizeof value);
    std::memcpy(&value, text_.data() + at_, sizeof value);
    at_ += sizeof value;
    return value;
  }
  std::string name() {
    const std::size_t end = text_.find('\0', at_);
    if (end == std::string::npos) need(text_.size());
    std::string out = text_.substr(at_, end - at_);
    at_ = end + 1;
    return out;
  }
  void skip(std::uint64_t count, std::size_t size) {
    if (count > text_.size()) need(text_.size());
    need(count * size);
    at_ += count * size;
  }

 private:
  void need(std::size_t bytes) const {
    if (bytes > text_.size() - at_) throw InputError(file_.string(), "is cut off", "write it again with COLMAP");
  }
  Path file_;
  std::string text_;
  std::size_t at_ = 0;
};

Files read_binary(const Path& folder) {
  Files files;
  Bytes cameras(folder / "cameras.bin");
  for (auto left = cameras.take<std::uint64_t>(); left > 0; --left) {
    const auto id = cameras.take<std::uint32_t>();
    const auto model = cameras.take<std::int32_t>();
    if (model < 0 || model >= static_cast<std::int32_t>(std::size(kModels)))
      throw InputError((folder / "cameras.bin").string(),
                       "has a camera model " + std::to_string(model) + ", which is unknown",
                       "write it again with COLMAP");
    Camera camera{
        kModels[model].name, static_cast<int>(std::min<std::uint64_t>(cameras.take<std::uint64_t>(), 1 << 15)), 0, {}};
    camera.height = static_cast<int>(std::min<std::uint64_t>(cameras.take<std::uint64_t>(), 1 << 15));
    for (std::size_t i = 0; i < kModels[model].parameters; ++i) camera.parameters.push_back(cameras.take<double>());
    files.cameras[id] = camera;
  }
  Bytes images(folder / "images.bin");
  for (auto left = images.take<std::uint64_t>(); left > 0; --left) {
    Image image;
    images.take<std::uint32_t>();
    double v[7];
    for (double& value : v) value = images.take<double>();
    image.rotation = {v[0], v[1], v[2], v[3]};
    image.translation = {v[4], v[5], v[6]};
    image.camera = images.take<std::uint32_t>();
    image.name = images.name();
    images.skip(images.take<std::uint64_t>(), 24);
    files.images.push_back(image);
  }
  return files;
}

// The lines that are no comments. Of images.txt every second one is a list of points, and may be empty.
std::vector<std::string> lines_of(const Path& file) {
  std::istringstream stream(core::read_file(file));
  std::vector<std::string> lines;
  for (std::string line; std::getline(stream, line);)
    if (!line.starts_with("#")) lines.push_back(line);
  return lines;
}

Files read_text(const Path& folder) {
  Files files;
  for (const std::string& line : lines_of(folder / "cameras.txt")) {
    std::istringstream words(line);
    std::uint32_t id = 0;
    Camera camera;
    if (!(words >> id >> camera.model >> camera.width >> camera.height)) continue;
    for (double value = 0; words >> value;) camera.parameters.push_back(value);
    files.cameras[id] = camera;
  }
  const std::vector<std::string> lines = lines_of(folder / "images.txt");
  for (std::size_t i = 0; i < lines.size(); i += 2) {
    std::istringstream words(lines[i]);
    std::uint32_t id = 0;
    double v[7];
    Image image;
    if (!(words >> id >> v[0] >> v[1] >> v[2] >> v[3] >> v[4] >> v[5] >> v[6] >> image.camera >> image.name)) continue;
    image.rotation = {v[0], v[1], v[2], v[3]};
    image.translation = {v[4], v[5], v[6]};
    files.images.push_back(image);
  }
  return files;
}

const Image& choose(const Files& files, const std::string& wanted, const Path& folder) {
  std::vector<const Image*> found;
  std::vector<std::string> names;
  for (const Image& image : files.images) {
    names.push_back(image.name);
    if (image.name == wanted || Path(image.name).stem() == wanted) return image;
    if (image.name.find(wanted) != std::string::npos) found.push_back(&image);
  }
  if (found.size() == 1) return *found[0];
  throw InputError(folder.string(),
                   found.empty() ? "has no image '" + wanted + "'"
                                 : std::to_string(found.size()) + " images have '" + wanted + "' in their names",
                   "name one with #IMAGE; it has " + list_of(names));
}

Lens lens_of(const Camera& camera, const Path& folder) {
  const std::vector<double>& p = camera.parameters;
  std::size_t needed = 0;
  for (const Model& model : kModels)
    if (camera.model == model.name) needed = model.parameters;
  if (needed == 0 || p.size() != needed)
    throw InputError(folder.string(),
                     "its camera model '" + camera.model + "' has " + std::to_string(p.size()) + " parameters",
                     "write it again with COLMAP");
  const bool one_focal = camera.model.find("SIMPLE") == 0 || camera.model.find("RADIAL") == 0;
  Lens lens;
  std::size_t i = 0;
  lens.fx = p[i++];
  lens.fy = one_focal ? lens.fx : p[i++];
  lens.cx = p[i++];
  lens.cy = p[i++];
  const auto k = [&](std::size_t n) { return i + n < p.size() ? p[i + n] : 0.0; };
  if (camera.model.find("PINHOLE") != std::string::npos) return lens;
  if (camera.model == "OPENCV") {
    lens.coefficients = {k(0), k(1), k(2), k(3)};
  } else if (camera.model == "SIMPLE_RADIAL" || camera.model == "RADIAL") {
    lens.coefficients = {k(0), k(1)};
  } else if (camera.model == "FULL_OPENCV") {
    lens.model = LensModel::rational;
    lens.coefficients = {k(0), k(1), k(2), k(3), k(4), k(5), k(6), k(7)};
  } else if (camera.model == "OPENCV_FISHEYE" || camera.model == "SIMPLE_RADIAL_FISHEYE" ||
             camera.model == "RADIAL_FISHEYE") {
    lens.model = LensModel::fisheye;
    lens.coefficients = {k(0), k(1), k(2), k(3)};
  } else {
    throw InputError(folder.string(), "its camera model '" + camera.model + "' is not supported",
                     "use OPENCV or OPENCV_FISHEYE, or COLMAP's image_undistorter");
  }
  return lens;
}

}  // namespace

bool is_colmap(const Path& folder) {
  std::error_code error;
  for (const char* ending : {".bin", ".txt"})
    if (std::filesystem::is_regular_file(folder / ("cameras" + std::string(ending)), error) &&
        std::filesystem::is_regular_file(folder / ("images" + std::string(ending)), error))
      return true;
  return false;
}

Calibration read_colmap(const Path& folder, const std::string& image_name, const std::string& camera_name) {
  std::error_code error;
  const bool binary = std::filesystem::is_regular_file(folder / "cameras.bin", error);
  const Files files = binary ? read_binary(folder) : read_text(folder);
  const Image& image = choose(files, image_name.empty() ? camera_name : image_name, folder);
  const auto found = files.cameras.find(image.camera);
  if (found == files.cameras.end())
    throw InputError(folder.string(), "has no camera " + std::to_string(image.camera) + ", which an image names",
                     "write it again with COLMAP");
  Calibration out;
  out.format = binary ? "COLMAP (binary)" : "COLMAP (text)";
  out.width = found->second.width, out.height = found->second.height;
  out.lens = lens_of(found->second, folder);
  const auto pose = rigid(image.translation, image.rotation);
  if (!pose)
    throw InputError(folder.string(), "the pose of " + image.name + " is no rigid motion",
                     "write it again with COLMAP");
  out.pose = FoundPose{*pose, Direction::camera_from_world, Axes::opencv, folder.string() + ": " + image.name};
  return out;
}

}  // namespace chainsplat::importing
