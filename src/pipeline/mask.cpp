// mask.cpp - masks for a capture that has none: where they go, how they are made, and what is said of them.
#include "chainsplat/masks.h"

#include <unistd.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <nlohmann/json.hpp>
#include <optional>

#include "chainsplat/frame_pattern.h"
#include "chainsplat/image_model.h"
#include "chainsplat/json.h"
#include "chainsplat/run_folder.h"

namespace chainsplat::pipeline {

namespace fs = std::filesystem;
using capture::Image8;
using Json = nlohmann::ordered_json;

namespace {

constexpr double kMostlyInside = 0.85;  // share of the chain's centerline in the masks under which they may be wrong
// m, more than calibrations of laboratories are wrong by: across the rope, and along it too, where the gripper hides it
constexpr double kFarAcross = 0.014, kFarGrasp = 0.020;
constexpr int kPreviewFrames = 4;  // pictures of a camera on the contact sheet
constexpr int kNamedFrames = 8;    // poor frames that a warning names

// Where the masks of one camera are.
struct MaskFiles {
  Path folder;
  std::string text;  // their names, as in capture.json
  capture::FramePattern names = *capture::read_frame_pattern(text);
  Path file(int frame) const { return folder / names.file(frame); }
};

// A capture, the masks that it has, and where the new ones go.
struct Places {
  capture::Capture scene;  // without images
  Path file;               // capture.json
  Json document;
  bool in_place = false;
  Path folder;                                  // that no mask may be led out of
  std::vector<std::optional<MaskFiles>> given;  // by camera; none: no masks, or a video
  std::vector<MaskFiles> wanted;                // by camera
};

// Throws InputError where a camera's masks would replace others.
MaskFiles files_in_capture(const Places& places, int camera, const std::string& own, bool force) {
  const std::string& name = places.scene.cameras[camera].name;
  const bool video = !own.empty() && !places.given[camera];
  if (video)
    throw InputError(places.file.string() + ": cameras[" + std::to_string(camera) + "].masks", "is a video: " + own,
                     "give `output` FOLDER, or remove the key");
  const MaskFiles files{places.scene.folder, own.empty() ? "masks/" + name + "/%06d.png" : own};
  const Path into = files.file(0).parent_path();
  std::error_code error;
  if (!force && (!own.empty() || (fs::is_directory(into, error) && !fs::is_empty(into, error))))
    throw InputError(into.string(), name + " has masks already", "use `force` to replace them, or `output` FOLDER");
  return files;
}

// Throws InputError where masks are there already.
Places places_of(const Path& path, const MaskOptions& options) {
  Places places;
  capture::LoadOptions headers;
  headers.images = false;
  places.scene = capture::load(path, headers);
  std::error_code error;
  places.file = fs::is_directory(path, error) ? path / "capture.json" : path;
  places.document = core::parse_json(core::read_file(places.file));
  places.in_place = options.output.empty();
  places.folder = places.in_place ? places.scene.folder : options.output;
  for (int c = 0; c < static_cast<int>(places.scene.cameras.size()); ++c) {
    const std::string own = places.document["cameras"][c].value("masks", std::string());
    places.given.emplace_back();
    if (capture::read_frame_pattern(own)) places.given.back() = MaskFiles{places.scene.folder, own};
    places.wanted.push_back(places.in_place ? files_in_capture(places, c, own, options.force)
                                            : MaskFiles{options.output, places.scene.cameras[c].name + "/%06d.png"});
  }
  return places;
}

// Throws InputError unless the masks can be written. A link can lead out of the folder, and neither is a mask written
// there nor read from there.
void check_places(const Places& places, bool force) {
  if (places.in_place && ::access(places.folder.c_str(), W_OK) != 0)
    throw InputError(places.folder.string(), "cannot be written", "give `output` FOLDER");
  if (!places.in_place)
    check_output_folder(places.folder, force, "use `force` to write into it, or name another folder");
  const auto require_inside = [](const Path& folder, const Path& mask) {
    if (const std::string link = capture::link_out_of(folder, mask); !link.empty())
      throw InputError(mask.string(), link, "remove the link");
  };
  for (std::size_t c = 0; c < places.wanted.size(); ++c)
    for (int k = 0; k < static_cast<int>(places.scene.times[c].size()); ++k) {
      require_inside(places.folder, places.wanted[c].file(k));
      if (places.given[c]) require_inside(places.scene.folder, places.given[c]->file(k));
    }
}

void write_mask(const Path& file, const Image8& mask) {
  core::make_folder(file.parent_path());
  capture::write_png(file, mask);
}

double iou(const Image8& mask, const Image8& other) {
  std::int64_t both = 0, either = 0;
  for (std::size_t i = 0; i < mask.pixels.size(); ++i) {
    const bool a = mask.pixels[i] >= image_model::kObjectMask,
               b = other.pixels[other.channels * i] >= image_model::kObjectMask;
    both += a && b;
    either += a || b;
  }
  return either ? static_cast<double>(both) / static_cast<double>(either) : 1.0;
}

// How well one camera's masks agree with those that the capture has.
struct Agreement {
  double sum = 0.0;
  int frames = 0;
  void add(const Image8& mask, const MaskFiles& given, int frame) {
    std::error_code error;
    if (!fs::is_regular_file(given.file(frame), error)) return;
    const Image8 other = capture::read_image8(given.file(frame));
    if (other.width != mask.width || other.height != mask.height) return;
    sum += iou(mask, other);
    ++frames;
  }
};

// The frames [first, last) of a camera that are asked for.
capture::FrameRange frames_of(const capture::Capture& scene, int camera, const capture::FrameRange& asked) {
  const int all = static_cast<int>(scene.times[camera].size());
  return {asked.first, asked.last < 0 ? all : std::min(all, asked.last)};
}

// What another program says the mask of a frame is, as 0 and 255. Throws WorkError where it is none. `where`: which
// frame.
Image8 object_mask(const Image8& given, const Image8& picture, const std::string& where) {
  const auto size = [](const Image8& image) {
    return std::to_string(image.width) + "x" + std::to_string(image.height);
  };
  if (given.width != picture.width || given.height != picture.height)
    throw WorkError(where, "the command's mask is " + size(given) + " pixels, the image " + size(picture),
                    "write a mask of the image's size; the masks so far are kept");
  // gray or color; of gray with alpha and of color with alpha the alpha does not count
  const int colors = given.channels >= 3 ? 3 : 1;
  Image8 mask{given.width, given.height, 1, {}};
  mask.pixels.resize(static_cast<std::size_t>(mask.width) * mask.height);
  int brightest = 0;
  for (std::size_t i = 0; i < mask.pixels.size(); ++i) {
    const std::uint8_t* const pixel = &given.pixels[given.channels * i];
    const int value = *std::max_element(pixel, pixel + colors);
    brightest = std::max(brightest, value);
    mask.pixels[i] = value >= image_model::kObjectMask ? 255 : 0;
  }
  if (brightest > 0 && brightest < image_model::kObjectMask)
    throw WorkError(where, "the command's mask has no value above " + std::to_string(brightest),
                    "the object must be 255 and the rest 0");
  return mask;
}

using Keep = std::function<void(int camera, int frame, const Image8& mask)>;

masking::Summary masks_by_command(const Path& path, const Places& places, const MaskOptions& options,
                                  const Keep& keep) {
  masking::Summary summary;
  const capture::Capture& scene = places.scene;
  std::int64_t total = 0;
  for (const std::vector<double>& times : scene.times) total += static_cast<std::int64_t>(times.size());
  for (int c = 0; c < static_cast<int>(scene.cameras.size()); ++c) {
    const std::string& name = scene.cameras[c].name;
    capture::FrameReader reader(path, name, options.frames, capture::Pixels::recorded);
    while (const std::optional<capture::Frame> frame = reader.next()) {
      core::stop_if_requested();
      const std::string where = name + ", frame " + std::to_string(frame->frame);
      const Image8 mask = object_mask(options.command(name, frame->frame, frame->picture), frame->picture, where);
      ++summary.frames;
      summary.empty += std::none_of(mask.pixels.begin(), mask.pixels.end(), [](std::uint8_t p) { return p != 0; });
      keep(c, frame->frame, mask);
      core::report({"mask", summary.frames, total, std::nan(""), std::nan(""), where});
    }
  }
  if (summary.frames == 0)
    throw InputError(path.string(), "has no frame in the range asked for", "choose frames that it has");
  return summary;
}

std::string scores_csv(const std::vector<MaskScore>& scores) {
  std::string table = "camera,frame,score\n";
  for (const MaskScore& one : scores) {
    char line[48];
    std::snprintf(line, sizeof line, ",%d,%.3f\n", one.frame, one.score);
    table += one.camera + line;
  }
  return table;
}

void name_masks(Places& places) {
  for (std::size_t c = 0; c < places.wanted.size(); ++c) places.document["cameras"][c]["masks"] = places.wanted[c].text;
  core::write_file(places.file, places.document.dump(1) + "\n");
}

// Warns of the cameras whose masks are probably wrong, with their frames.
void warn_of_poor(const std::vector<MaskScore>& scores, const capture::Capture& scene, const std::string& into) {
  for (const capture::Camera& camera : scene.cameras) {
    std::string frames;
    int poor = 0, all = 0;
    for (const MaskScore& one : scores) {
      if (one.camera != camera.name) continue;
      ++all;
      if (one.score >= masking::kDoubtful) continue;
      if (++poor <= kNamedFrames) frames += (poor > 1 ? ", " : "") + std::to_string(one.frame);
    }
    if (poor == 0) continue;
    if (poor > kNamedFrames) frames += ", ...";
    core::warn(into + ": " + camera.name + ": " + std::to_string(poor) + " of " + std::to_string(all) +
               " masks are probably wrong (frame" + (poor > 1 ? "s " : " ") + frames +
               "); look at them (`preview`), show the rope (`point` " + camera.name + ":X,Y) or use `command`");
  }
}

// Warns of a rope that seems to begin elsewhere than at the grasp.
void warn_of_grasp(const math::Vector3& grasp, const math::Vector3& direction, const std::string& into) {
  const double across = (grasp - grasp.dot(direction) * direction).norm();
  if (across <= kFarAcross && grasp.norm() <= kFarGrasp) return;
  char text[160];
  std::snprintf(text, sizeof text,
                ": the rope seems to begin %.0f mm from the grasp that is given, at [%.0f, %.0f, %.0f]",
                1e3 * grasp.norm(), 1e3 * grasp.x(), 1e3 * grasp.y(), 1e3 * grasp.z());
  core::warn(into + text + " mm in the base frame; check the base's poses and the cameras, and look at the masks");
}

void warn_of(const MaskResult& result, const capture::Capture& scene) {
  const std::string into = result.folder.string();
  const masking::Summary& summary = result.summary;
  if (summary.empty > 0)
    core::warn(into + ": " + std::to_string(summary.empty) + " of " + std::to_string(summary.frames) +
               " masks are empty; the rope is hidden or was not found there");
  if (result.scores.empty()) return;
  warn_of_poor(result.scores, scene, into);
  warn_of_grasp(summary.grasp, scene.direction, into);
  if (summary.inside < kMostlyInside)
    core::warn(into + ": only " + std::to_string(std::lround(100.0 * summary.inside)) +
               " % of the rope lies in the masks; look at them before you use them, or use `command`");
}

// The contact sheet: some frames of every camera, spread over the recording.
Image8 contact_sheet(const Path& path, const Places& places, const capture::FrameRange& asked,
                     const std::vector<MaskScore>& scores) {
  std::vector<masking::PreviewTile> tiles;
  for (int c = 0; c < static_cast<int>(places.scene.cameras.size()); ++c) {
    const capture::Camera& camera = places.scene.cameras[c];
    const auto [first, last] = frames_of(places.scene, c, asked);
    const int count = std::min(kPreviewFrames, last - first);
    for (int k = 0; k < count; ++k) {
      const int frame = first + (count > 1 ? k * (last - 1 - first) / (count - 1) : 0);
      masking::PreviewTile tile{camera.name, frame, {}, capture::read_image8(places.wanted[c].file(frame)), {}};
      for (const MaskScore& one : scores)
        if (one.camera == camera.name && one.frame == frame) tile.score = one.score;
      tile.picture =
          capture::FrameReader(path, camera.name, {frame, frame + 1}, capture::Pixels::recorded).next()->picture;
      tiles.push_back(std::move(tile));
    }
  }
  return masking::contact_sheet(tiles);
}

}  // namespace

void MaskOptions::check() const {
  if (output.empty() && frames != capture::FrameRange{})
    throw InputError("`frames`", "a capture needs a mask of every frame", "give `output` FOLDER for some of them");
  if (command && hints.any())
    throw InputError("`command`", "does not go with `point`, `box` and `empty`", "give one or the other");
}

MaskResult make_masks(const Path& path, const MaskOptions& options, const core::Listener& listener) {
  const core::ListenerScope scope(listener);
  options.check();
  Places places = places_of(path, options);
  check_places(places, options.force);
  const capture::Capture& scene = places.scene;
  std::vector<Agreement> agreement(scene.cameras.size());
  const Keep keep = [&](int camera, int frame, const Image8& mask) {
    if (!places.in_place && places.given[camera]) agreement[camera].add(mask, *places.given[camera], frame);
    write_mask(places.wanted[camera].file(frame), mask);
  };

  MaskResult result;
  result.folder = places.in_place ? places.folder / "masks" : places.folder;
  if (options.command) {
    result.summary = masks_by_command(path, places, options, keep);
  } else {
    result.summary = masking::make(path, options.frames, options.hints,
                                   [&](int camera, int frame, const Image8& mask, double score) {
                                     keep(camera, frame, mask);
                                     result.scores.push_back({scene.cameras[camera].name, frame, score});
                                   });
    core::make_folder(result.folder);
    core::write_file(result.folder / "scores.csv", scores_csv(result.scores));
  }
  if (places.in_place) name_masks(places);
  for (std::size_t c = 0; c < agreement.size(); ++c)
    if (agreement[c].frames > 0)
      result.agreement.emplace_back(scene.cameras[c].name, agreement[c].sum / agreement[c].frames);
  warn_of(result, scene);
  if (!options.preview.empty())
    capture::write_png(options.preview, contact_sheet(path, places, options.frames, result.scores));
  return result;
}

}  // namespace chainsplat::pipeline
