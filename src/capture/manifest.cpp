#include "src/capture/manifest.h"

#include <algorithm>
#include <cmath>
#include <functional>
#include <set>

#include "chainsplat/corrections.h"
#include "chainsplat/text.h"
#include "src/capture/camera_reader.h"
#include "src/capture/frame_files.h"
#include "src/capture/object_reader.h"

namespace chainsplat::capture {

using math::Vector3;

namespace {

// Bounds of what a file may request. Each is far beyond any recording of a rope. They exist because memory and time
// grow with these numbers, so that a typing error or a hostile file ends in a message and not in exhausted memory.
// Others of them are in object_reader.cpp, camera_reader.cpp and frame_files.cpp.
constexpr std::size_t kMostCameras = 512;  // because the frames of all are in memory at once
constexpr double kLongestRope = 100.0;     // m
constexpr double kThinnest = 1e-4;         // of the length, because masks are made in steps of a diameter
constexpr double kHeaviest = 1e4;          // kg
constexpr double kLongestPayload = 10.0;   // m
constexpr double kMostGravity = 1e3;       // m/s^2
constexpr double kPerpendicular = 1e-3;    // rad
// s by which the base may begin after the frames or end before them: its clock may be late, which training finds
constexpr double kLateClock = 0.08;
constexpr double kTopMeters = 5.0;  // m; a longer rope is doubted, as it may be in millimeters

// Fits the base trajectory and checks that it covers the frames of all cameras. `file`: for messages.
void read_base(Manifest& manifest, const std::string& file,
               const std::function<std::vector<trajectory::Sample>()>& read, Findings& findings) {
  Capture& capture = manifest.capture;
  try {
    capture.base = trajectory::fit(read(), file);
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
      findings.problems.push_back({file,
                                   "covers " + core::brief(capture.base.start()) + " to " +
                                       core::brief(capture.base.end()) + " s, but the frames of " + source.camera.name +
                                       " are at " + core::brief(source.times.front()) + " to " +
                                       core::brief(source.times.back()) + " s",
                                   "record the base during all frames or correct start, rate or timestamps"});
  }
  // frames that a clock of the base, late or early, leaves without a base
  std::vector<trajectory::Sample> samples = trajectory::continued(capture.base, first, last);
  if (samples.size() == capture.base.samples().size()) return;
  findings.doubts.push_back(file + ": does not cover all frames; it is continued with its last velocity");
  capture.base = trajectory::fit(std::move(samples), file);
}

// "sigma": how sure each thing is that may be corrected, with the same keys as "corrections" in twin.json.
void read_sigma(const ObjectReader& reader, Capture& capture) {
  if (!reader.present()) return;
  reader.know({"cameras", "base", "grasp", "object", "table"});
  const auto read = [&](const ObjectReader& node, const std::string& subject, const char* kind) {
    if (!node.present()) return;
    std::vector<std::string> known;
    for (const CorrectedQuantity& quantity : corrected_quantities())
      if (std::string(quantity.subject) == kind) known.emplace_back(quantity.name);
    node.know(known);
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
  const ObjectReader cameras = reader.child("cameras", false, "{ \"cam0\": { \"rotation\": 0.002 } }");
  std::vector<std::string> names;
  for (const Camera& camera : capture.cameras) names.push_back(camera.name);
  cameras.know(names);
  for (const std::string& name : names) read(cameras.child(name, false, "{ \"rotation\": 0.002 }"), name, "camera");
  read(reader.child("base", false, "{ \"time\": 0.002 }"), "base", "base");
  read(reader.child("grasp", false, "{ \"translation\": 0.001 }"), "grasp", "grasp");
  read(reader.child("object", false, "{ \"length\": 0.003 }"), "object", "object");
  read(reader.child("table", false, "{ \"height\": 0.001 }"), "table", "table");
}

// object.tip_mass: a number, or { value, sigma }; object.tip_length.
std::optional<Payload> read_payload(const ObjectReader& object, bool known_mass) {
  constexpr const char* kExpected = "kilograms, as 0.2 or { \"value\": 0.2, \"sigma\": 0.01 }";
  constexpr const char* kExpectedLength = "meters from the free end to the payload's, as 0.05";
  const Json* const given = object.find("tip_mass", false, kExpected);
  if (!given) {
    if (object.find("tip_length", false, kExpectedLength))
      object.problem("tip_length", "says nothing without a payload's mass", "give object.tip_mass, too");
    return {};
  }
  const std::optional<double> length = object.number("tip_length", false, kExpectedLength);
  if (length && !(*length >= 0.0 && *length <= kLongestPayload))
    object.problem("tip_length", "is no length up to " + core::exact(kLongestPayload) + " m",
                   std::string("write ") + kExpectedLength);
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
    return Payload{value->get<double>(), sigma ? sigma->get<double>() : 0.0, length};
  return {};
}

std::vector<Path> files_of(const ImageSource& images) {
  if (images.video) return {images.file};
  std::vector<Path> files;
  for (int k = 0; k < images.frames; ++k) files.push_back(images.frame_file(k));
  return files;
}

std::uint64_t capture_hash(const std::string& text, const Manifest& manifest, const Path& base) {
  std::uint64_t hash = core::fnv1a(text);
  std::error_code error;
  if (is_file(base)) hash = core::fnv1a(core::read_file(base), hash);
  for (const CameraSource& source : manifest.cameras)
    for (const ImageSource* images : {&source.images, source.masks ? &*source.masks : nullptr}) {
      if (!images) continue;
      for (const Path& file : files_of(*images)) {
        const auto size = std::filesystem::file_size(file, error);
        hash = core::fnv1a(error ? "-" : std::to_string(size) + " ", hash);
      }
    }
  return hash;
}

template <class T>
std::uint64_t hash_of(const std::vector<T>& values, std::uint64_t hash) {
  return core::fnv1a({reinterpret_cast<const char*>(values.data()), values.size() * sizeof(T)}, hash);
}

std::uint64_t capture_hash(const InMemory& recording) {
  std::uint64_t hash = core::fnv1a(recording.document);
  for (const trajectory::Sample& sample : recording.base) {
    const auto& rotation = sample.pose.rotation.reshaped();
    std::vector<double> numbers(rotation.begin(), rotation.end());
    numbers.insert(numbers.end(), sample.pose.translation.begin(), sample.pose.translation.end());
    numbers.push_back(sample.time);
    hash = hash_of(numbers, hash);
  }
  for (const CameraFrames& frames : recording.cameras) {
    hash = hash_of(frames.times, hash);
    for (const std::vector<Image8>* pictures : {&frames.images, &frames.masks})
      for (const Image8& picture : *pictures) hash = hash_of(picture.pixels, hash);
  }
  return hash;
}

// What the scene is called, what it is, and its gravity.
void read_scene(const ObjectReader& top, Capture& capture) {
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
}

void read_object(const ObjectReader& top, Capture& capture) {
  const ObjectReader object = top.child("object", true, "{ \"length\": 0.3, \"diameter\": 0.02, \"mass\": 0.06 }");
  if (!object.present()) return;
  object.know({"length", "diameter", "mass", "tip_mass", "tip_length"});
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

// How the gripper holds the rope; the bending axis is made exactly perpendicular to the direction.
void read_grasp(const ObjectReader& top, Capture& capture) {
  const ObjectReader grasp = top.child("grasp", true, "{ \"direction\": [0, 0, -1], \"bending_axis\": [0, 1, 0] }");
  if (!grasp.present()) return;
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

void read_table(const ObjectReader& top, Capture& capture) {
  const ObjectReader table = top.child("table", capture.tabletop, "{ \"point\": [0, 0, 0], \"normal\": [0, 0, 1] }");
  if (!table.present()) return;
  table.know({"point", "normal"});
  const auto point = table.vector("point", true, "a point of the table, world frame");
  const auto normal = table.direction("normal", "the table's upward normal, world frame");
  if (!capture.tabletop)
    top.doubt("table", "is ignored in free space");
  else if (point && normal && table.near("point", *point))
    capture.table = Table{*point, *normal};
}

// The cameras, of which those not asked for are only checked for their names. `only`: the one asked for; empty: all.
// `recording`: null for files.
void read_cameras(const ObjectReader& top, const std::string& file, const std::string& only, const InMemory* recording,
                  Manifest& manifest, Findings& findings) {
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
  if (recording && cameras && cameras->size() != recording->cameras.size()) {
    top.problem("cameras",
                "are " + std::to_string(cameras->size()) + ", and frames are there of " +
                    std::to_string(recording->cameras.size()),
                "give the frames of each");
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
    if (!only.empty() && own_name != only) continue;
    const ObjectReader reader(&value, where, findings);
    manifest.cameras.push_back(recording ? read_camera(reader, where, recording->cameras[c])
                                         : read_camera(reader, where, manifest.capture.folder));
  }
  if (!only.empty() && cameras && manifest.cameras.empty())
    findings.problems.push_back({file, "has no camera " + in_quotes(only), "choose one of " + all_names});
}

// `manifest` says where it is; `recording`: null for files.
void read_document(const std::string& text, const std::string& camera, bool masked, const InMemory* recording,
                   Manifest& manifest, Findings& findings) {
  Capture& capture = manifest.capture;
  const std::string file = manifest.file.string();
  const Json json = parse_object(text, file, "{ \"format\": \"chainsplat-capture/1\", ... }");

  const ObjectReader top(&json, file + ": ", findings);
  const auto format = top.text("format", true, "\"chainsplat-capture/1\"");
  if (format && *format != "chainsplat-capture/1") {
    top.problem("format", in_quotes(*format) + " is not chainsplat-capture/1", "convert the capture to this format");
    return;  // the other keys would be judged by the wrong rules
  }

  read_scene(top, capture);
  read_object(top, capture);
  read_grasp(top, capture);
  read_table(top, capture);
  const auto base = recording ? std::nullopt : top.path("base", true, "\"base.tum\"");
  if (recording && top.has("base")) top.problem("base", "does not go with a motion in memory", "leave it out");
  read_cameras(top, file, camera, recording, manifest, findings);

  // the files that it names
  survey_frames(manifest, masked, findings);
  const Path base_file = base ? capture.folder / *base : Path();
  const auto read_file = [&] {
    require_own_file(capture.folder, base_file);
    return trajectory::read_tum(base_file);
  };
  if (recording)
    read_base(
        manifest, "`base`", [&] { return recording->base; }, findings);
  if (base) read_base(manifest, base_file.string(), read_file, findings);
  for (const CameraSource& source : manifest.cameras) {
    capture.cameras.push_back(source.camera);
    capture.times.push_back(source.times);
    capture.has_depth = capture.has_depth || source.depth.has_value();
  }
  read_sigma(top.child("sigma", false, "{ \"object\": { \"length\": 0.003 } }"), capture);
  for (const CameraSource& source : manifest.cameras)  // unless its "sigma" is given, too, which stands before it
    if (source.readout_given) capture.sigma.push_back({source.camera.name, "readout", 0.0});
  if (findings.problems.empty())
    capture.hash = recording ? capture_hash(*recording) : capture_hash(text, manifest, base_file);
}

}  // namespace

Manifest read_manifest(const Path& path, const std::string& camera, bool masked, Findings& findings) {
  Manifest manifest;
  std::error_code error;
  manifest.file = std::filesystem::is_directory(path, error) ? path / "capture.json" : path;
  manifest.capture.folder = manifest.file.has_parent_path() ? manifest.file.parent_path() : Path(".");
  if (std::filesystem::exists(manifest.file, error)) require_file(manifest.file);
  read_document(core::read_file(manifest.file), camera, masked, nullptr, manifest, findings);
  return manifest;
}

Manifest read_manifest(const InMemory& recording, const std::string& camera, bool masked, Findings& findings) {
  Manifest manifest;
  manifest.file = "`document`";
  read_document(recording.document, camera, masked, &recording, manifest, findings);
  return manifest;
}

std::uint64_t stamp(const Path& path) {
  Findings findings;
  const Manifest manifest = read_manifest(path, "", true, findings);
  throw_first(findings);
  std::uint64_t hash = core::fnv1a(std::to_string(manifest.capture.hash));
  for (const CameraSource& source : manifest.cameras) {
    hash = hash_of(source.times, hash);  // which may have a file of their own
    for (const ImageSource* images :
         {&source.images, source.masks ? &*source.masks : nullptr, source.depth ? &*source.depth : nullptr}) {
      if (!images) continue;
      for (const Path& file : files_of(*images)) {
        std::error_code error;
        const auto changed = std::filesystem::last_write_time(file, error).time_since_epoch().count();
        hash = core::fnv1a(error ? "-" : std::to_string(changed) + " ", hash);
      }
    }
  }
  return hash;
}

}  // namespace chainsplat::capture
