#include "manifest.h"
#include "chainsplat/corrections.h"

#include <algorithm>
#include <charconv>
#include <cmath>
#include <initializer_list>
#include <limits>
#include <nlohmann/json.hpp>
#include <set>

#include "chainsplat/json.h"
#include "chainsplat/text.h"

namespace chainsplat::capture {

using Json = nlohmann::ordered_json;
using math::Matrix3;
using math::Vector3;

Path ImageSource::frame_file(int frame) const {
  std::string number = std::to_string(frame);
  if (static_cast<int>(number.size()) < digits) number.insert(0, digits - number.size(), '0');
  return prefix + number + suffix;
}

namespace {

// Bounds of what a file may request. Each is far beyond any recording of a rope. They exist because memory and time
// grow with these numbers, so that a typing error or a hostile file ends in a message and not in exhausted memory.
constexpr std::size_t kMostText = std::size_t{4} << 20;  // bytes of capture.json
constexpr std::size_t kMostKeys = 1000;                  // per object, because keys are looked up one by one
constexpr std::size_t kMostCameras = 512;                // because the frames of all are in memory at once
constexpr int kLargestSide = 1 << 15;                    // px, of an image
constexpr double kLongestRecording = 3600.0;             // s; the dynamics are integrated over it in millisecond steps
constexpr double kLeastFocal = 1.0, kMostFocal = 1e6;    // px; less is no length in pixels, more are parallel rays
constexpr double kFarthest = 1e6;                        // m from the origin; enough digits remain to resolve a pixel
constexpr double kLongestRope = 100.0;                   // m
constexpr double kThinnest = 1e-4;                       // of the length, because masks are made in steps of a diameter
constexpr double kHeaviest = 1e4;                        // kg
constexpr double kMostGravity = 1e3;                     // m/s^2
constexpr int kMostUnknown = 5;                          // unknown keys per object that are named
constexpr double kRotationTolerance = 1e-3;              // of |R R^T - I|; numbers of three digits pass
constexpr double kUnitTolerance = 1e-3;                  // of a direction's length, beyond which it is doubted
constexpr double kPerpendicular = 1e-3;                  // rad
constexpr double kInversePixels = 1e-3;                  // px, largest error of undistort(distort(.)) at the border
// s by which the base may begin after the frames or end before them: its clock may be late, which training finds
constexpr double kLateClock = 0.08;
constexpr double kTopMeters = 5.0;  // m; a longer rope is doubted, as it may be in millimeters

// The text in quotes, cut to a length that fits on a line.
std::string in_quotes(const std::string& text) {
  constexpr std::size_t kMost = 60;
  std::string out = "'";
  out.append(text, 0, kMost).append(text.size() > kMost ? "...'" : "'");
  return out;
}

// Levenshtein's distance, which finds the key that a misspelled one stands for.
int edit_distance(const std::string& a, const std::string& b) {
  std::vector<int> row(b.size() + 1);
  for (std::size_t j = 0; j <= b.size(); ++j) row[j] = static_cast<int>(j);
  for (std::size_t i = 1; i <= a.size(); ++i) {
    int diagonal = row[0];
    row[0] = static_cast<int>(i);
    for (std::size_t j = 1; j <= b.size(); ++j) {
      const int substituted = diagonal + (a[i - 1] != b[j - 1]);
      diagonal = row[j];
      row[j] = std::min({row[j] + 1, row[j - 1] + 1, substituted});
    }
  }
  return row[b.size()];
}

// One JSON object of the file: typed access that records what is missing or wrong and continues with a default.
class Reader {
 public:
  Reader(const Json* object, std::string where, Findings& findings)
      : object_(object), where_(std::move(where)), findings_(findings) {}

  std::string at(const std::string& key) const { return where_ + (where_.ends_with(": ") ? "" : ".") + key; }
  bool has(const std::string& key) const { return object_ && object_->contains(key); }
  void problem(const std::string& key, const std::string& what, const std::string& mend) const {
    findings_.problems.push_back({at(key), what, mend});
  }
  void doubt(const std::string& key, const std::string& what) const {
    findings_.doubts.push_back(at(key) + ": " + what);
  }

  // Doubts unknown keys, and suggests the nearest known one where it is similar.
  void know(const std::vector<std::string>& known) const {
    if (!object_ || known.empty()) return;
    int unknown = 0;
    for (const auto& item : object_->items()) {
      const std::string key = item.key().substr(0, 40);  // more characters than any known key has
      if (std::any_of(known.begin(), known.end(), [&](const std::string& k) { return key == k; })) continue;
      if (++unknown > kMostUnknown) continue;
      const auto further = [&](const std::string& a, const std::string& b) {
        return edit_distance(key, a) < edit_distance(key, b);
      };
      const std::string& nearest = *std::min_element(known.begin(), known.end(), further);
      const bool similar = edit_distance(key, nearest) <= std::max<int>(2, static_cast<int>(key.size()) / 3);
      doubt(key, std::string("unknown key, ignored") + (similar ? "; is " + in_quotes(nearest) + " meant?" : ""));
    }
    if (unknown > kMostUnknown)
      findings_.doubts.push_back(where_ + (where_.ends_with(": ") ? "" : ": ") + std::to_string(unknown) +
                                 " unknown keys, all ignored");
  }

  const Json* find(const std::string& key, bool required, const char* expected) const {
    if (!object_) return nullptr;
    const auto found = object_->find(key);
    if (found != object_->end()) return &*found;
    if (required) problem(key, "is missing", std::string("add it: ") + expected);
    return nullptr;
  }

  std::optional<double> number(const std::string& key, bool required, const char* expected) const {
    const Json* value = find(key, required, expected);
    if (!value) return std::nullopt;
    if (value->is_number() && std::isfinite(value->get<double>())) return value->get<double>();
    problem(key, value->is_number() ? "is not finite" : "is not a number", std::string("write ") + expected);
    return std::nullopt;
  }

  // A positive number, or 0 and a problem. It may be at most `most`; `reason` ends the sentence that says so.
  double positive(const std::string& key, const char* expected, double most = std::numeric_limits<double>::max(),
                  const char* reason = "") const {
    const auto value = number(key, true, expected);
    if (!value) return 0.0;
    if (*value <= 0.0) problem(key, core::exact(*value) + " is not positive", std::string("write ") + expected);
    if (*value > most)
      problem(key, core::exact(*value) + " is more than " + core::exact(most) + reason,
              std::string("write ") + expected);
    return *value;
  }

  // The frames per second, or 0 and a problem.
  double rate() const {
    const double value = positive("rate", "frames a second");
    if (value >= kSlowestRate && value <= kFastestRate) return value;
    if (value > 0.0)
      problem("rate",
              core::exact(value) + " is not between " + core::exact(kSlowestRate) + " and " +
                  std::to_string(static_cast<int>(kFastestRate)) +
                  " frames a second, between which cameras record motion",
              "write frames a second");
    return 0.0;
  }

  // Returns whether a place in the world is near enough to the origin that enough digits remain for the rope.
  bool near(const std::string& key, const Vector3& place) const {
    if (place.cwiseAbs().maxCoeff() <= kFarthest) return true;
    problem(key,
            "lies more than " + std::to_string(static_cast<int>(kFarthest)) +
                " m from the world's origin, too far for exact numbers",
            "write meters from an origin near the rope");
    return false;
  }

  int pixels(const std::string& key) const {
    const auto value = number(key, true, "a whole number of pixels");
    if (!value) return 0;
    if (*value < 1 || *value > kLargestSide || *value != std::floor(*value)) {
      problem(key, core::exact(*value) + " is not an image size", "write a whole number of pixels");
      return 0;
    }
    return static_cast<int>(*value);
  }

  std::optional<std::vector<double>> numbers(const std::string& key, std::size_t count, bool required,
                                             const char* expected) const {
    const Json* value = find(key, required, expected);
    if (!value) return std::nullopt;
    if (!value->is_array() || value->size() != count) {
      problem(key,
              value->is_array()
                  ? "has " + std::to_string(value->size()) + " entries instead of " + std::to_string(count)
                  : "is not a list",
              std::string("write ") + expected);
      return std::nullopt;
    }
    std::vector<double> out;
    for (const Json& entry : *value) {
      if (!entry.is_number() || !std::isfinite(entry.get<double>())) {
        problem(key + "[" + std::to_string(out.size()) + "]", "is not a finite number",
                std::string("write ") + expected);
        return std::nullopt;
      }
      out.push_back(entry.get<double>());
    }
    return out;
  }

  std::optional<Vector3> vector(const std::string& key, bool required, const char* expected) const {
    const auto values = numbers(key, 3, required, expected);
    if (!values) return std::nullopt;
    return Vector3((*values)[0], (*values)[1], (*values)[2]);
  }

  // A direction, normalized; a length other than 1 is doubted.
  std::optional<Vector3> direction(const std::string& key, const char* expected) const {
    const auto value = vector(key, true, expected);
    if (!value) return std::nullopt;
    const double length = value->norm();
    if (!(length > 0.0)) {
      problem(key, "has no length", std::string("write ") + expected);
      return std::nullopt;
    }
    if (std::abs(length - 1.0) > kUnitTolerance)
      doubt(key, "has length " + core::brief(length) + ", taken as a direction");
    return *value / length;
  }

  std::optional<std::string> text(const std::string& key, bool required, const char* expected) const {
    const Json* value = find(key, required, expected);
    if (!value) return std::nullopt;
    if (value->is_string()) return value->get<std::string>();
    problem(key, "is not a text", std::string("write ") + expected);
    return std::nullopt;
  }

  // A relative path that stays inside the capture's folder.
  std::optional<std::string> path(const std::string& key, bool required, const char* expected) const {
    const auto value = text(key, required, expected);
    if (!value) return std::nullopt;
    const Path normal = Path(*value).lexically_normal();
    if (value->empty() || value->find('\0') != std::string::npos || normal.is_absolute() || normal == "." ||
        *normal.begin() == "..") {
      problem(key, in_quotes(*value) + " is not a path inside the capture's folder", "put the file into the folder");
      return std::nullopt;
    }
    constexpr std::size_t kLongestPath = 4096;  // bytes, Linux's limit
    if (value->size() > kLongestPath) {
      problem(key, in_quotes(*value) + " is longer than a path can be", "shorten it");
      return std::nullopt;
    }
    return value;
  }

  Reader child(const std::string& key, bool required, const char* expected) const {
    const Json* value = find(key, required, expected);
    if (value && !value->is_object()) {
      problem(key, "is not an object", std::string("write ") + expected);
      value = nullptr;
    }
    return Reader(value, at(key), findings_);
  }

  bool present() const { return object_ != nullptr; }

 private:
  const Json* object_;
  std::string where_;
  Findings& findings_;
};

// Reads 'cam0.mp4' as a video and 'cam0/%06d.png' as a pattern of image files.
std::optional<ImageSource> image_source(const Reader& reader, const std::string& key, const Path& folder,
                                        bool required) {
  const auto text = reader.path(key, required, "a video like cam0.mp4 or a pattern like cam0/%06d.png");
  if (!text) return std::nullopt;
  ImageSource source;
  const std::size_t percent = text->find('%');
  if (percent == std::string::npos) {
    source.video = true;
    source.file = folder / *text;
    return source;
  }
  std::size_t end = percent + 1;
  while (end < text->size() && std::isdigit(static_cast<unsigned char>((*text)[end]))) ++end;
  const std::string width = text->substr(percent + 1, end - percent - 1);
  const bool valid = end < text->size() && (*text)[end] == 'd' && width.size() <= 3 &&
                     (width.empty() || width[0] == '0') && text->find('%', end) == std::string::npos;
  if (!valid) {
    reader.problem(key, in_quotes(*text) + " is not a frame pattern", "write the number once, as %d or %06d");
    return std::nullopt;
  }
  source.prefix = (folder / text->substr(0, percent)).string();
  source.suffix = text->substr(end + 1);
  if (!width.empty()) std::from_chars(width.data(), width.data() + width.size(), source.digits);
  return source;
}

bool is_file(const Path& file) {
  std::error_code error;
  return std::filesystem::is_regular_file(file, error);
}

constexpr const char* kOwnFile = "copy the file itself into the capture's folder";

// Throws InputError unless `file` is a regular file, because reading a pipe or a device might never end.
void require_file(const Path& file) {
  if (is_file(file)) return;
  std::error_code error;
  const auto status = std::filesystem::status(file, error);
  if (!std::filesystem::exists(status)) throw InputError(file.string(), "does not exist", "check the path");
  if (std::filesystem::is_directory(status)) throw InputError(file.string(), "is a folder, not a file", "name a file");
  throw InputError(file.string(), "is a pipe or device, not a file", "name a file");
}

// The same for a file that a capture names, which must also lie in its folder.
void require_own_file(const Path& folder, const Path& file) {
  if (const std::string link = link_out_of(folder, file); !link.empty())
    throw InputError(file.string(), link, kOwnFile);
  require_file(file);
}

// Sets source.frames, and `*rate` for a video. Returns false and records a problem when there is no frame, a number is
// missing, or a file is unreadable or leads out of the folder.
bool count_frames(ImageSource& source, const Path& folder, const std::string& where, double* rate, const Camera* camera,
                  Findings& findings) {
  const auto too_many = [&](const Path& file) {
    findings.problems.push_back({file.string(),
                                 "there are more than " + std::to_string(kMostFrames) +
                                     " frames, which no memory holds as a training needs them",
                                 "split the recording"});
    return false;
  };
  // a video: its container counts the frames
  if (source.video) {
    try {
      require_own_file(folder, source.file);
      const VideoFacts facts = video_facts(source.file);
      if (facts.frames > kMostFrames) return too_many(source.file);
      source.frames = facts.frames;
      if (rate) *rate = facts.rate;
      if (camera && facts.width > 0 && (facts.width != camera->width || facts.height != camera->height)) {
        findings.problems.push_back({source.file.string(),
                                     "is " + std::to_string(facts.width) + "x" + std::to_string(facts.height) +
                                         " pixels, the camera has " + std::to_string(camera->width) + "x" +
                                         std::to_string(camera->height),
                                     "correct width and height in capture.json or the video"});
        return false;
      }
    } catch (const InputError& error) {
      findings.problems.push_back({where, error.what(), "check the file"});
      return false;
    }
    if (source.frames > 0) return true;
    findings.problems.push_back({source.file.string(), "has no frame", "write the video again"});
    return false;
  }
  // image files: count them from 0, and check each folder and each link once
  std::string leaving;  // how a frame's path leaves the folder
  Path inside;          // the folder of the previous frame
  const auto there = [&](int frame) {
    const Path file = source.frame_file(frame);
    if (!is_file(file)) return false;
    const auto leaves = [&](const Path& place) {
      leaving = link_out_of(folder, place);
      if (!leaving.empty()) findings.problems.push_back({where + ": " + place.string(), leaving, kOwnFile});
      return !leaving.empty();
    };
    std::error_code error;
    if (file.parent_path() != inside && leaves(inside = file.parent_path())) return false;
    return !std::filesystem::is_symlink(file, error) || !leaves(file);
  };
  while (source.frames <= kMostFrames && there(source.frames)) ++source.frames;
  if (!leaving.empty()) return false;
  if (source.frames > kMostFrames) return too_many(source.frame_file(0));
  constexpr int kLookAhead = 16;  // frames; a longer gap is regarded as the end
  for (int k = source.frames + 1; k < source.frames + kLookAhead; ++k)
    if (is_file(source.frame_file(k))) {
      findings.problems.push_back({source.frame_file(source.frames).string(), "is missing, though later frames exist",
                                   "number the frames from 0 without gaps"});
      return false;
    }
  if (source.frames > 0) return true;
  findings.problems.push_back(
      {source.frame_file(0).string(), "is missing", "number the frames from 0, or correct the pattern"});
  return false;
}

// Reads one time per line, with '#' comments.
std::vector<double> read_timestamps(const Path& file) {
  const std::string text = core::read_file(file);
  std::vector<double> times;
  int line_number = 0;
  for (std::size_t begin = 0; begin < text.size();) {
    const std::size_t end = std::min(text.find('\n', begin), text.size());
    std::string line = text.substr(begin, end - begin);
    begin = end + 1;
    ++line_number;
    line.resize(std::min(line.find('#'), line.size()));
    const std::size_t first = line.find_first_not_of(" \t\r");
    if (first == std::string::npos) continue;
    const std::size_t last = line.find_last_not_of(" \t\r");
    double time = 0.0;
    const char* const stop = line.data() + last + 1;
    const auto [after, error] = std::from_chars(line.data() + first, stop, time);
    const std::string where = file.string() + ":" + std::to_string(line_number);
    if (error != std::errc() || after != stop || !std::isfinite(time))
      throw InputError(where, "not a time in seconds", "write one number a line");
    if (!times.empty() && !(time > times.back()))
      throw InputError(where, "does not come after the time before it", "sort the times; one a frame");
    times.push_back(time);
  }
  return times;
}

// Sets source.times and source.interval from the timestamps, or else from start and rate.
void set_times(CameraSource& source, const Path& folder, Findings& findings) {
  const int frames = source.images.frames;
  if (source.timestamps) {
    try {
      require_own_file(folder, *source.timestamps);
      source.times = read_timestamps(*source.timestamps);
    } catch (const InputError& error) {
      findings.problems.push_back({source.where + ".timestamps", error.what(), "correct the file"});
      return;
    }
    const int count = static_cast<int>(source.times.size());
    if (count < frames) {
      findings.problems.push_back({source.timestamps->string(),
                                   "has " + std::to_string(count) + " times for " + std::to_string(frames) + " frames",
                                   "write one number a frame"});
      source.times.clear();
      return;
    }
    if (count > frames)
      findings.doubts.push_back(source.timestamps->string() + ": has " + std::to_string(count) + " times for " +
                                std::to_string(frames) + " frames; the last ones are ignored");
    source.times.resize(frames);
    std::vector<double> intervals;
    for (int k = 1; k < frames; ++k) intervals.push_back(source.times[k] - source.times[k - 1]);
    source.interval = math::median(intervals);
  } else {
    source.times.resize(frames);
    for (int k = 0; k < frames; ++k) source.times[k] = source.start + k / source.rate;
    source.interval = 1.0 / source.rate;
  }
  if (const double seconds = source.times.back() - source.times.front(); seconds > kLongestRecording) {
    findings.problems.push_back({source.where + (source.timestamps ? ".timestamps" : ".rate"),
                                 "the frames span " + core::brief(seconds) + " s and a recording at most " +
                                     core::exact(kLongestRecording) + " s, for the motion between all is computed",
                                 "correct it or split the recording"});
    source.times.clear();
  }
}

void read_pose(const Reader& reader, Camera& camera) {
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
void check_lens(const Reader& reader, const Camera& camera) {
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
void refuse_lens_models(const Reader& reader) {
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
Camera read_optics(const Reader& reader) {
  refuse_lens_models(reader);
  reader.know({"name", "width", "height", "fx", "fy", "cx", "cy", "distortion", "world_from_camera", "images", "masks",
               "depth", "depth_scale", "rate", "start", "timestamps"});
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
  read_pose(reader, camera);
  return camera;
}

CameraSource read_camera(const Reader& reader, const std::string& where, const Path& folder) {
  CameraSource source;
  source.where = where;
  source.camera = read_optics(reader);
  source.camera.name = reader.text("name", true, "a short name like cam0").value_or("");
  if (reader.has("name") && !good_name(source.camera.name))
    reader.problem("name", in_quotes(source.camera.name) + " cannot name a folder", "use letters, digits, - and _");

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

std::string line_of(const std::string& text, std::size_t byte) {
  const std::size_t end = std::min(byte, text.size());
  return std::to_string(1 + std::count(text.begin(), text.begin() + static_cast<std::ptrdiff_t>(end), '\n'));
}

// Finds what a parsed document hides or cannot bear: of a key that stands twice in an object it keeps only the last
// one, and it looks keys up one by one, so that very many keys in one object would take time quadratic in their number.
struct Keys : nlohmann::json_sax<Json> {
  std::vector<std::set<std::string>> objects;  // keys of the open objects, outermost first
  std::optional<std::string> twice;
  bool many = false;
  bool key(std::string& name) override {
    if (!objects.back().insert(name).second) twice = name;
    many = objects.back().size() > kMostKeys;
    return !twice && !many;
  }
  bool start_object(std::size_t) override {
    objects.emplace_back();
    return true;
  }
  bool end_object() override {
    objects.pop_back();
    return true;
  }
  bool null() override { return true; }
  bool boolean(bool) override { return true; }
  bool number_integer(Json::number_integer_t) override { return true; }
  bool number_unsigned(Json::number_unsigned_t) override { return true; }
  bool number_float(Json::number_float_t, const std::string&) override { return true; }
  bool string(std::string&) override { return true; }
  bool binary(Json::binary_t&) override { return true; }
  bool start_array(std::size_t) override { return true; }
  bool end_array() override { return true; }
  bool parse_error(std::size_t, const std::string&, const nlohmann::detail::exception&) override { return false; }
};

// Parses a text that must be one JSON object; `file` and `expected` are for the messages.
Json parse(const std::string& text, const std::string& file, const char* expected) {
  if (text.size() > kMostText)
    throw InputError(file,
                     "is larger than " + std::to_string(kMostText >> 20) + " MiB, too large for numbers and names",
                     std::string("write ") + expected);
  Keys keys;
  Json::sax_parse(text, &keys);
  if (keys.twice)
    throw InputError(file, "the key " + in_quotes(*keys.twice) + " stands twice in one object", "remove one of them");
  if (keys.many)
    throw InputError(file, "an object has more than " + std::to_string(kMostKeys) + " keys",
                     std::string("write ") + expected);
  Json json;
  try {
    json = core::parse_json(text);
  } catch (const Json::parse_error& failure) {
    throw InputError(file + ":" + line_of(text, failure.byte),
                     "is not JSON (a comma, bracket or quote is missing, or the file is cut off)",
                     "correct this line or the one before");
  } catch (const Json::exception&) {  // thrown for a number beyond double
    throw InputError(file, "has a number that is too large", "write finite numbers");
  }
  if (!json.is_object()) throw InputError(file, "is not a JSON object", std::string("write ") + expected);
  return json;
}

// Counts the frames of all cameras and sets their times.
void survey(Manifest& manifest, bool masked, Findings& findings) {
  std::vector<Findings> found(manifest.cameras.size());  // per camera, so that their order does not depend on threads
  core::parallel_for(static_cast<std::int64_t>(manifest.cameras.size()), [&](std::int64_t c) {
    CameraSource& source = manifest.cameras[c];
    Findings& mine = found[c];
    if (source.images.file.empty() && source.images.prefix.empty()) return;
    const Path& folder = manifest.capture.folder;
    if (!count_frames(source.images, folder, source.where + ".images", &source.video_rate, &source.camera, mine))
      return;
    const int frames = source.images.frames;
    const auto compare = [&](std::optional<ImageSource>& other, const char* key) {
      if (!other || !count_frames(*other, folder, source.where + "." + key, nullptr, &source.camera, mine)) return;
      if (other->frames < frames)
        mine.problems.push_back({source.where + "." + key,
                                 std::to_string(other->frames) + " frames, but images has " + std::to_string(frames),
                                 "write one for every frame"});
      else if (other->frames > frames)
        mine.doubts.push_back(source.where + "." + key + ": " + std::to_string(other->frames) +
                              " frames, but images has " + std::to_string(frames) + "; the last ones are ignored");
    };
    if (masked) compare(source.masks, "masks");
    compare(source.depth, "depth");
    if (source.timestamps || source.rate > 0) set_times(source, folder, mine);
  });
  for (const Findings& one : found) {
    findings.problems.insert(findings.problems.end(), one.problems.begin(), one.problems.end());
    findings.doubts.insert(findings.doubts.end(), one.doubts.begin(), one.doubts.end());
  }
}

// Reads the base trajectory and checks that it covers the frames of all cameras.
void read_base(Manifest& manifest, const Path& file, Findings& findings) {
  Capture& capture = manifest.capture;
  try {
    require_own_file(capture.folder, file);
    capture.base = trajectory::fit(trajectory::read_tum(file), file.string());
  } catch (const InputError& error) {
    findings.problems.push_back({manifest.file.string() + ": base", error.what(), "correct the file"});
    return;
  }
  double first = capture.base.start(), last = capture.base.end();
  for (const CameraSource& source : manifest.cameras) {
    if (source.times.empty()) continue;
    const double slack = std::max(0.5 * source.interval, kLateClock);
    first = std::min(first, source.times.front());
    last = std::max(last, source.times.back());
    if (source.times.front() < capture.base.start() - slack || source.times.back() > capture.base.end() + slack)
      findings.problems.push_back({file.string(),
                                   "covers " + core::brief(capture.base.start()) + " to " +
                                       core::brief(capture.base.end()) + " s, but the frames of " + source.camera.name +
                                       " are at " + core::brief(source.times.front()) + " to " +
                                       core::brief(source.times.back()) + " s",
                                   "record the base during all frames or correct start, rate or timestamps"});
  }
  // frames that a clock of the base, late or early, leaves without a base
  std::vector<trajectory::Sample> samples = trajectory::continued(capture.base, first, last);
  if (samples.size() == capture.base.samples().size()) return;
  findings.doubts.push_back(file.string() + ": does not cover all frames; it is continued with its last velocity");
  capture.base = trajectory::fit(std::move(samples), file.string());
}

// "sigma": how sure each thing is that may be corrected, with the same keys as "corrections" in twin.json.
void read_sigma(const Reader& reader, Capture& capture) {
  if (!reader.present()) return;
  reader.know({"cameras", "base", "grasp", "object"});
  const auto read = [&](const Reader& node, const std::string& subject, const char* kind) {
    if (!node.present()) return;
    for (const CorrectedQuantity& quantity : corrected_quantities()) {
      if (std::string(quantity.subject) != kind) continue;
      const std::string expected = std::string("one standard deviation in ") + quantity.unit;
      const std::optional<double> value = node.number(quantity.name, false, expected.c_str());
      if (!value) continue;
      if (*value < 0.0 || *value > quantity.most)
        node.problem(quantity.name, core::exact(*value) + " is no standard deviation", "write " + expected);
      else
        capture.sigma.push_back({subject, quantity.name, *value});
    }
  };
  const Reader cameras = reader.child("cameras", false, "{ \"cam0\": { \"rotation\": 0.002 } }");
  std::vector<std::string> names;
  for (const Camera& camera : capture.cameras) names.push_back(camera.name);
  cameras.know(names);
  for (const Camera& camera : capture.cameras) {
    const Reader node = cameras.child(camera.name, false, "{ \"rotation\": 0.002 }");
    if (node.present())
      node.know({"rotation", "translation", "focal", "time", "mask_offset", "mask_start", "gain", "bias"});
    read(node, camera.name, "camera");
  }
  const Reader base = reader.child("base", false, "{ \"time\": 0.002 }");
  if (base.present()) base.know({"time"});
  read(base, "base", "base");
  const Reader grasp = reader.child("grasp", false, "{ \"translation\": 0.001 }");
  if (grasp.present()) grasp.know({"translation", "rotation"});
  read(grasp, "grasp", "grasp");
  const Reader object = reader.child("object", false, "{ \"length\": 0.003 }");
  if (object.present()) object.know({"length", "diameter"});
  read(object, "object", "object");
}

// object.tip_mass: a number, or { value, sigma }.
std::optional<Payload> read_payload(const Reader& object, bool known_mass) {
  constexpr const char* kExpected = "kilograms, as 0.2 or { \"value\": 0.2, \"sigma\": 0.01 }";
  const Json* const given = object.find("tip_mass", false, kExpected);
  if (!given) return {};
  const auto mass = [&](const Json* value) {
    return value && value->is_number() && value->get<double>() >= 0.0 && value->get<double>() <= kHeaviest;
  };
  const auto member = [&](const char* name) {
    return given->is_object() && given->contains(name) ? &(*given)[name] : nullptr;
  };
  const Json* const value = given->is_object() ? member("value") : given;
  const Json* const sigma = member("sigma");
  if (!mass(value) || (sigma && !mass(sigma)))
    object.problem("tip_mass", "is no mass from 0 to " + core::exact(kHeaviest) + " kg",
                   std::string("write ") + kExpected);
  else if (!known_mass)
    object.problem("tip_mass", "says nothing beside a rope of unknown mass", "give object.mass, too");
  else
    return Payload{value->get<double>(), sigma ? sigma->get<double>() : 0.0};
  return {};
}

std::uint64_t capture_hash(const std::string& text, const Manifest& manifest, const Path& base) {
  std::uint64_t hash = core::fnv1a(text);
  std::error_code error;
  if (is_file(base)) hash = core::fnv1a(core::read_file(base), hash);
  for (const CameraSource& source : manifest.cameras)
    for (const ImageSource* images : {&source.images, source.masks ? &*source.masks : nullptr}) {
      if (!images) continue;
      for (int k = 0; k < (images->video ? 1 : images->frames); ++k) {
        const auto size = std::filesystem::file_size(images->video ? images->file : images->frame_file(k), error);
        hash = core::fnv1a(error ? "-" : std::to_string(size) + " ", hash);
      }
    }
  return hash;
}

}  // namespace

Manifest read_manifest(const Path& path, const std::string& camera, bool masked, Findings& findings) {
  // the document
  Manifest manifest;
  std::error_code error;
  manifest.file = std::filesystem::is_directory(path, error) ? path / "capture.json" : path;
  Capture& capture = manifest.capture;
  capture.folder = manifest.file.has_parent_path() ? manifest.file.parent_path() : Path(".");
  if (std::filesystem::exists(manifest.file, error)) require_file(manifest.file);
  const std::string text = core::read_file(manifest.file);
  const std::string file = manifest.file.string();
  const Json json = parse(text, file, "{ \"format\": \"chainsplat-capture/1\", ... }");

  const Reader top(&json, file + ": ", findings);
  const auto format = top.text("format", true, "\"chainsplat-capture/1\"");
  if (format && *format != "chainsplat-capture/1") {
    top.problem("format", in_quotes(*format) + " is not chainsplat-capture/1", "convert the capture to this format");
    return manifest;  // the other keys would be judged by the wrong rules
  }

  // the scene
  top.know({"format", "name", "scenario", "gravity", "object", "grasp", "table", "base", "cameras", "sigma"});
  capture.name = top.text("name", false, "a short name").value_or(capture.folder.filename().string());
  const std::string scenario = top.text("scenario", true, "\"free\" or \"tabletop\"").value_or("free");
  if (scenario != "free" && scenario != "tabletop")
    top.problem("scenario", in_quotes(scenario) + " is unknown", "write \"free\" or \"tabletop\"");
  capture.tabletop = scenario == "tabletop";
  if (const auto gravity = top.vector("gravity", false, "[0, 0, -9.81]")) {
    capture.gravity = *gravity;
    constexpr double kLeast = 9.7, kMost = 9.9;  // m/s^2, anywhere on Earth
    if (!(gravity->norm() <= kMostGravity))
      top.problem("gravity", "is more than " + core::exact(kMostGravity) + " m/s^2, beyond every experiment",
                  "write it in m/s^2, world frame");
    else if (gravity->norm() < kLeast || gravity->norm() > kMost)
      top.doubt("gravity", "has length " + core::brief(gravity->norm()) + " m/s^2, not Earth's");
  } else if (!top.has("gravity")) {
    top.doubt("gravity", "is missing; (0, 0, -9.81) is assumed");
  }

  // the rope
  const Reader object = top.child("object", true, "{ \"length\": 0.3, \"diameter\": 0.02, \"mass\": 0.06 }");
  if (object.present()) {
    object.know({"length", "diameter", "mass", "tip_mass"});
    capture.length = object.positive("length", "meters from the grasp to the free end", kLongestRope, " m");
    capture.diameter = object.positive("diameter", "meters");
    if (object.has("mass")) {
      const double mass = object.positive("mass", "kilograms, or leave it out", kHeaviest, " kg");
      if (mass > 0) capture.mass = mass;
    }
    capture.payload = read_payload(object, capture.mass.has_value());
    if (capture.length > kTopMeters) object.doubt("length", core::exact(capture.length) + " m: are these millimeters?");
    if (capture.length > 0 && capture.diameter >= capture.length)
      object.problem("diameter", "is not less than the length", "write both in meters");
    if (capture.diameter > 0 && capture.diameter < kThinnest * capture.length)
      object.problem(
          "diameter",
          "is less than 1/" + std::to_string(std::lround(1.0 / kThinnest)) + " of the length, as no camera sees",
          "write both in meters");
  }

  // how the gripper holds it; the bending axis is made exactly perpendicular to the direction
  const Reader grasp = top.child("grasp", true, "{ \"direction\": [0, 0, -1], \"bending_axis\": [0, 1, 0] }");
  if (grasp.present()) {
    grasp.know({"direction", "bending_axis"});
    const auto direction = grasp.direction("direction", "where the rope leaves the gripper, base frame");
    const auto axis = grasp.direction("bending_axis", "the axis of planar bending, base frame");
    if (direction && axis) {
      if (std::abs(direction->dot(*axis)) > kPerpendicular)
        grasp.problem("bending_axis", "is not perpendicular to direction", "choose an axis across the rope");
      capture.direction = *direction;
      capture.bending_axis = (*axis - direction->dot(*axis) * *direction).normalized();
    }
  }

  const Reader table = top.child("table", capture.tabletop, "{ \"point\": [0, 0, 0], \"normal\": [0, 0, 1] }");
  if (table.present()) {
    table.know({"point", "normal"});
    const auto point = table.vector("point", true, "a point of the table, world frame");
    const auto normal = table.direction("normal", "the table's upward normal, world frame");
    if (!capture.tabletop)
      top.doubt("table", "is ignored in free space");
    else if (point && normal && table.near("point", *point))
      capture.table = Table{*point, *normal};
  }

  // the base's file and the cameras, of which those not asked for are only checked for their names
  const auto base = top.path("base", true, "\"base.tum\"");
  const Json* cameras = top.find("cameras", true, "a list of cameras");
  if (cameras && (!cameras->is_array() || cameras->empty())) {
    top.problem("cameras", "is not a list of at least one camera", "describe every camera as an object");
    cameras = nullptr;
  }
  if (cameras && cameras->size() > kMostCameras) {
    top.problem("cameras",
                std::to_string(cameras->size()) + " are more than " + std::to_string(kMostCameras) +
                    ", whose frames no memory holds at once",
                "leave out what is not needed");
    cameras = nullptr;
  }
  std::set<std::string> names;
  std::string all_names;
  for (std::size_t c = 0; cameras && c < cameras->size(); ++c) {
    const std::string where = file + ": cameras[" + std::to_string(c) + "]";
    const Json& value = (*cameras)[c];
    if (!value.is_object()) {
      findings.problems.push_back({where, "is not an object", "describe every camera as an object"});
      continue;
    }
    const auto name = value.find("name");
    const std::string own_name = name != value.end() && name->is_string() ? name->get<std::string>() : "";
    all_names.append(c ? ", " : "").append(own_name, 0, 64);
    if (!own_name.empty() && !names.insert(own_name).second)
      findings.problems.push_back(
          {where + ".name", in_quotes(own_name) + " is used twice", "give every camera its own name"});
    if (!camera.empty() && own_name != camera) continue;
    manifest.cameras.push_back(read_camera(Reader(&value, where, findings), where, capture.folder));
  }
  if (!camera.empty() && cameras && manifest.cameras.empty())
    findings.problems.push_back({file, "has no camera " + in_quotes(camera), "choose one of " + all_names});

  // the files that it names
  survey(manifest, masked, findings);
  if (base) read_base(manifest, capture.folder / *base, findings);
  for (const CameraSource& source : manifest.cameras) {
    capture.cameras.push_back(source.camera);
    capture.times.push_back(source.times);
    capture.has_depth = capture.has_depth || source.depth.has_value();
  }
  read_sigma(top.child("sigma", false, "{ \"object\": { \"length\": 0.003 } }"), capture);
  if (findings.problems.empty()) capture.hash = capture_hash(text, manifest, base ? capture.folder / *base : Path());
  return manifest;
}

std::string link_out_of(const Path& folder, const Path& file) {
  namespace fs = std::filesystem;
  std::error_code error;
  Path root = fs::weakly_canonical(fs::absolute(folder), error);
  if (root.filename().empty() && root.has_relative_path()) root = root.parent_path();  // for 'folder/'
  const auto leaves = [&](const Path& place) {
    const Path resolved = fs::weakly_canonical(fs::absolute(place), error);
    return !error && std::mismatch(root.begin(), root.end(), resolved.begin(), resolved.end()).first != root.end();
  };
  // name the first link on the way that leads out
  if (!leaves(file)) return "";
  Path way = folder;
  for (const Path& part : file.lexically_relative(folder)) {
    way /= part;
    if (fs::is_symlink(way, error) && leaves(way))
      return (way == file ? "" : "its folder " + way.string() + " ") + "is a link out of " + folder.string() + ", to " +
             fs::weakly_canonical(way, error).string();
  }
  return "leads out of " + folder.string() + ", to " + fs::weakly_canonical(file, error).string();
}

Calibration read_calibration(const Path& path) {
  const std::string file = path.string();
  const Json json = parse(core::read_file(path), file, "a camera object as in capture.json");
  const auto cameras = json.find("cameras");  // a whole capture.json of one camera is accepted, too
  const bool whole = cameras != json.end() && cameras->is_array() && cameras->size() == 1 && (*cameras)[0].is_object();
  Findings findings;
  const Reader reader(whole ? &(*cameras)[0] : &json, file + ": ", findings);
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
