// mask.cpp - object masks for a capture that has none: by our own means or by an outside program, frame by frame.
#include <sys/wait.h>
#include <unistd.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <iostream>
#include <memory>
#include <nlohmann/json.hpp>

#include "chainsplat/capture.h"
#include "chainsplat/image_model.h"
#include "chainsplat/json.h"
#include "chainsplat/masking.h"
#include "chainsplat/run_folder.h"
#include "cli.h"

namespace chainsplat::tools {

namespace {

namespace fs = std::filesystem;
using Json = nlohmann::ordered_json;

constexpr std::string_view kImageName = "{image}", kMaskName = "{mask}";  // in the line of a command
constexpr double kMostlyInside = 0.85;  // share of the chain's centerline in the masks under which they may be wrong
// m, more than calibrations of laboratories are wrong by: across the rope, and along it too, where the gripper hides it
constexpr double kFarAcross = 0.014, kFarGrasp = 0.020;
constexpr int kPreviewFrames = 4;  // pictures of a camera on the contact sheet
constexpr int kNamedFrames = 8;    // poor frames that a warning names

struct Request {
  std::string capture, out, command, frames, preview;
  std::vector<std::string> points, boxes, empty;
  bool force = false;
};

// Where a camera's masks go, or come from: a printf pattern with one number.
struct Pattern {
  std::string text;  // as in capture.json
  Path folder;       // it is relative to
  Path file(int frame) const {
    const std::size_t percent = text.find('%'), d = text.find('d', percent);
    std::string number = std::to_string(frame);
    const int digits = percent + 1 < d ? std::atoi(text.substr(percent + 1, d - percent - 1).c_str()) : 0;
    if (static_cast<int>(number.size()) < digits) number.insert(0, digits - number.size(), '0');
    return folder / (text.substr(0, percent) + number + text.substr(d + 1));
  }
};

// For the shell, whatever the text holds.
std::string quoted(const std::string& text) {
  std::string out = "'";
  for (const char letter : text) letter == '\'' ? out += "'\\''" : out += letter;
  return out + "'";
}

// The line with the files in place of {image} and {mask}. In one pass: a file's name may hold these letters, too.
std::string filled_in(const std::string& line, const Path& image, const Path& mask) {
  std::string out;
  for (std::size_t at = 0; at < line.size();) {
    const std::string_view rest = std::string_view(line).substr(at);
    if (rest.starts_with(kImageName)) {
      out += quoted(image.string());
      at += kImageName.size();
    } else if (rest.starts_with(kMaskName)) {
      out += quoted(mask.string());
      at += kMaskName.size();
    } else {
      out += line[at++];
    }
  }
  return out;
}

// A folder of its own for what goes to and comes from the outside program; gone at the end.
struct Exchange {
  Path folder;
  Exchange() {
    std::string name = (fs::temp_directory_path() / "chainsplat-mask.XXXXXX").string();
    if (!mkdtemp(name.data())) throw WorkError(name, "cannot be made", "make room or set TMPDIR");
    folder = name;
  }
  ~Exchange() {
    std::error_code error;
    fs::remove_all(folder, error);
  }
  Exchange(const Exchange&) = delete;
  Exchange& operator=(const Exchange&) = delete;
};

capture::Image8 mask_by_command(const std::string& command, const capture::View& view, const std::string& where,
                                const Path& folder) {
  const Path image = folder / "image.png", mask = folder / "mask.png";
  capture::Image8 picture{view.width, view.height, 3, {}};
  picture.pixels.resize(static_cast<std::size_t>(3) * view.width * view.height);
  for (std::size_t i = 0; i < picture.pixels.size() / 3; ++i) std::copy_n(&view.rgba[4 * i], 3, &picture.pixels[3 * i]);
  capture::write_png(image, picture);
  std::error_code error;
  fs::remove(mask, error);
  // its standard output must not mix with ours
  const std::string line = "{ " + filled_in(command, image, mask) + "\n} 1>&2 </dev/null";
  const int status = std::system(line.c_str());
  const std::string mend = "try the command by hand on one image; the masks so far are kept";
  if (WIFSIGNALED(status)) {
    if (WTERMSIG(status) == SIGINT || WTERMSIG(status) == SIGTERM) throw Interrupted(WTERMSIG(status));
    throw WorkError(where, "the command ended by signal " + std::to_string(WTERMSIG(status)), mend);
  }
  if (!WIFEXITED(status) || WEXITSTATUS(status) != 0)
    throw WorkError(where, "the command failed with exit code " + std::to_string(WEXITSTATUS(status)), mend);
  if (!fs::exists(mask, error)) throw WorkError(where, "the command wrote no mask", "it must write the file {mask}");
  capture::Image8 result;
  try {
    result = capture::read_image8(mask);
  } catch (const InputError&) {
    throw WorkError(where, "the command's mask is no image that can be read", "write an 8-bit PNG; " + mend);
  }
  if (result.width != view.width || result.height != view.height)
    throw WorkError(where,
                    "the command's mask is " + std::to_string(result.width) + "x" + std::to_string(result.height) +
                        " pixels, the image " + std::to_string(view.width) + "x" + std::to_string(view.height),
                    "write a mask of the image's size; the masks so far are kept");
  // gray or color; of gray with alpha and of color with alpha the alpha does not count
  const int channels = result.channels, colors = channels >= 3 ? 3 : 1;
  capture::Image8 out{view.width, view.height, 1, {}};
  out.pixels.resize(static_cast<std::size_t>(view.width) * view.height);
  int brightest = 0;
  for (std::size_t i = 0; i < out.pixels.size(); ++i) {
    int value = 0;
    for (int c = 0; c < colors; ++c) value = std::max<int>(value, result.pixels[channels * i + c]);
    brightest = std::max(brightest, value);
    out.pixels[i] = value >= image_model::kObjectMask ? 255 : 0;
  }
  if (brightest > 0 && brightest < image_model::kObjectMask)
    throw WorkError(where, "the command's mask has no value above " + std::to_string(brightest),
                    "the object must be 255 and the rest 0");
  return out;
}

// Agreement with masks that the capture has, by camera.
struct Agreement {
  std::vector<double> sum;
  std::vector<int> frames;
};

double iou(const capture::Image8& mask, const capture::Image8& other) {
  std::int64_t both = 0, either = 0;
  for (std::size_t i = 0; i < mask.pixels.size(); ++i) {
    const bool a = mask.pixels[i] >= image_model::kObjectMask,
               b = other.pixels[other.channels * i] >= image_model::kObjectMask;
    both += a && b;
    either += a || b;
  }
  return either ? static_cast<double>(both) / static_cast<double>(either) : 1.0;
}

int camera_named(const capture::Capture& scene, const std::string& name, const std::string& where) {
  std::string names;
  for (std::size_t c = 0; c < scene.cameras.size(); ++c) {
    if (scene.cameras[c].name == name) return static_cast<int>(c);
    names += (c ? ", " : "") + scene.cameras[c].name;
  }
  throw InputError(where, "the capture has no camera " + name, "it has " + names);
}

// Reads CAMERA[:FRAME]:NUMBER,NUMBER,... with `count` numbers.
struct Hint {
  int camera = 0;
  std::optional<int> frame;
  std::vector<double> numbers;
};
Hint read_hint(const std::string& text, const std::string& option, std::size_t count, const capture::Capture& scene) {
  const std::string where = option + " " + text;
  const auto refuse = [&] {
    throw InputError(where, "is not CAMERA:" + std::string(count == 2 ? "X,Y" : "X0,Y0,X1,Y1"),
                     "in recorded pixels, as in " + option + (count == 2 ? " cam0:412,230" : " cam0:300,80,560,470") +
                         "; with a frame as in cam0:12:...");
  };
  const std::size_t first = text.find(':'), last = text.rfind(':');
  if (first == std::string::npos) refuse();
  Hint out;
  out.camera = camera_named(scene, text.substr(0, first), where);
  const auto number = [&](const std::string& part) {
    char* end = nullptr;
    const double value = std::strtod(part.c_str(), &end);
    if (part.empty() || *end || !std::isfinite(value)) refuse();
    return value;
  };
  if (last != first) {
    const double frame = number(text.substr(first + 1, last - first - 1));
    if (frame < 0.0 || frame != std::floor(frame) || frame >= static_cast<double>(scene.times[out.camera].size()))
      throw InputError(where, "there is no such frame",
                       "the camera has " + std::to_string(scene.times[out.camera].size()) + ", counted from 0");
    out.frame = static_cast<int>(frame);
  }
  std::string rest = text.substr(last + 1) + ",";
  for (std::size_t comma; (comma = rest.find(',')) != std::string::npos; rest = rest.substr(comma + 1))
    out.numbers.push_back(number(rest.substr(0, comma)));
  if (out.numbers.size() != count) refuse();
  const capture::Camera& camera = scene.cameras[out.camera];
  for (std::size_t i = 0; i < count; ++i)
    if (count == 2 && (out.numbers[i] < 0.0 || out.numbers[i] > (i % 2 ? camera.height : camera.width)))
      throw InputError(where, "lies outside of the picture",
                       "it has " + std::to_string(camera.width) + "x" + std::to_string(camera.height) + " pixels");
  return out;
}

masking::Options read_hints(const Request& request, const capture::Capture& scene, int first) {
  masking::Options options;
  for (const std::string& text : request.points) {
    const Hint hint = read_hint(text, "--point", 2, scene);
    options.points.push_back({hint.camera, hint.frame.value_or(first), hint.numbers[0], hint.numbers[1]});
  }
  for (const std::string& text : request.boxes) {
    const Hint hint = read_hint(text, "--box", 4, scene);
    const std::vector<double>& n = hint.numbers;
    options.boxes.push_back({hint.camera, hint.frame, std::min(n[0], n[2]), std::min(n[1], n[3]), std::max(n[0], n[2]),
                             std::max(n[1], n[3])});
  }
  options.empty.resize(scene.cameras.size());
  for (const std::string& text : request.empty) {
    const std::size_t equals = text.find('=');
    if (equals == std::string::npos)
      throw InputError("--empty " + text, "is not CAMERA=FILE", "as in --empty cam0=empty.png");
    const int c = camera_named(scene, text.substr(0, equals), "--empty " + text);
    const Path file = text.substr(equals + 1);
    capture::Image8 picture = capture::read_image8(file);
    if (picture.width != scene.cameras[c].width || picture.height != scene.cameras[c].height)
      throw InputError(file.string(),
                       "has " + std::to_string(picture.width) + "x" + std::to_string(picture.height) +
                           " pixels, its camera " + std::to_string(scene.cameras[c].width) + "x" +
                           std::to_string(scene.cameras[c].height),
                       "give a picture of the same camera without the rope");
    if (scene.cameras[c].distorted())
      throw InputError(file.string(), "its camera has lens distortion, which is not taken out of it",
                       "undistort the recording first, or leave --empty out");
    options.empty[c] = std::move(picture);
  }
  return options;
}

// The score of one mask.
struct Score {
  int camera, frame;
  double score;
};

// Warns of the cameras whose masks are probably wrong, with their frames.
void warn_of_poor(const std::vector<Score>& scores, const capture::Capture& scene, const std::string& into) {
  for (std::size_t c = 0; c < scene.cameras.size(); ++c) {
    std::string frames;
    int poor = 0, all = 0;
    for (const Score& one : scores) {
      if (one.camera != static_cast<int>(c)) continue;
      ++all;
      if (one.score >= masking::kDoubtful) continue;
      if (++poor <= kNamedFrames) frames += (poor > 1 ? ", " : "") + std::to_string(one.frame);
    }
    if (poor == 0) continue;
    if (poor > kNamedFrames) frames += ", ...";
    core::warn(into + ": " + scene.cameras[c].name + ": " + std::to_string(poor) + " of " + std::to_string(all) +
               " masks are probably wrong (frame" + (poor > 1 ? "s " : " ") + frames +
               "); look at them (--preview), show the rope (--point " + scene.cameras[c].name +
               ":X,Y) or use --command");
  }
}

// The contact sheet: some frames of every camera, spread over the recording.
capture::Image8 preview_of(const Request& request, const capture::Capture& scene, const std::vector<Score>& scores,
                           const std::vector<Pattern>& masks, int first, int last) {
  std::vector<masking::PreviewTile> tiles;
  for (int c = 0; c < static_cast<int>(scene.cameras.size()); ++c) {
    const int all = static_cast<int>(scene.times[c].size()), end = last < 0 ? all : std::min(all, last);
    const int count = std::min(kPreviewFrames, end - first);
    for (int k = 0; k < count; ++k) {
      const int frame = first + (count > 1 ? k * (end - 1 - first) / (count - 1) : 0);
      capture::LoadOptions one;
      one.masked = one.undistort = false;
      one.camera = scene.cameras[c].name;
      one.first = frame, one.last = frame + 1;
      for (const capture::View& view : capture::load(request.capture, one).views) {
        masking::PreviewTile tile{scene.cameras[c].name, frame, {view.width, view.height, 3, {}}, {}, {}};
        for (std::size_t i = 0; i < view.rgba.size(); i += 4)
          tile.picture.pixels.insert(tile.picture.pixels.end(), &view.rgba[i], &view.rgba[i] + 3);
        tile.mask = capture::read_image8(masks[c].file(frame));
        for (const Score& score : scores)
          if (score.camera == c && score.frame == frame) tile.score = score.score;
        tiles.push_back(std::move(tile));
      }
    }
  }
  return masking::contact_sheet(tiles);
}

void make_masks(const Globals& globals, const Request& request) {
  const auto [first, last] = capture::read_frame_range(request.frames, "--frames");
  const bool in_place = request.out.empty();
  if (in_place && !request.frames.empty())
    throw InputError("--frames", "a capture needs a mask of every frame", "give -o FOLDER for some of them");
  if (!request.command.empty())
    for (const std::string_view name : {kImageName, kMaskName})
      if (request.command.find(name) == std::string::npos)
        throw InputError("--command", "does not hold " + std::string(name),
                         "write the program's line with {image} and {mask} where the file names go");
  capture::LoadOptions headers;
  headers.images = false;
  const capture::Capture scene = capture::load(request.capture, headers);
  if (!request.command.empty() && !(request.points.empty() && request.boxes.empty() && request.empty.empty()))
    throw InputError("--command", "does not go with --point, --box and --empty", "give one or the other");
  masking::Options options = read_hints(request, scene, first);
  std::error_code error;
  const Path file =
      fs::is_directory(request.capture, error) ? Path(request.capture) / "capture.json" : Path(request.capture);
  Json json = core::parse_json(core::read_file(file));

  std::vector<Pattern> given, wanted;  // masks that the capture names (empty text: none); where ours go
  for (std::size_t c = 0; c < scene.cameras.size(); ++c) {
    const std::string name = scene.cameras[c].name;
    const std::string own = json["cameras"][c].value("masks", std::string());
    const bool files = own.find('%') != std::string::npos;
    given.push_back({files ? own : std::string(), scene.folder});
    if (!in_place) {
      wanted.push_back({name + "/%06d.png", request.out});
      continue;
    }
    if (!own.empty() && !files)
      throw InputError(file.string() + ": cameras[" + std::to_string(c) + "].masks", "is a video: " + own,
                       "give -o FOLDER, or remove the key");
    wanted.push_back({files ? own : "masks/" + name + "/%06d.png", scene.folder});
    const Path into = wanted.back().file(0).parent_path();
    if (!request.force && (!own.empty() || (fs::is_directory(into, error) && !fs::is_empty(into, error))))
      throw InputError(into.string(), name + " has masks already", "use --force to replace them, or -o FOLDER");
  }
  if (in_place && ::access(scene.folder.c_str(), W_OK) != 0)
    throw InputError(scene.folder.string(), "cannot be written", "give -o FOLDER");
  if (!in_place)
    pipeline::check_output_folder(request.out, request.force, "use --force to write into it, or name another folder");
  const std::size_t cameras = scene.cameras.size();
  // a link can lead out of the folder, and neither is a mask written there nor read from there
  const Path into_folder = in_place ? scene.folder : Path(request.out);
  for (std::size_t c = 0; c < cameras; ++c)
    for (int k = 0; k < static_cast<int>(scene.times[c].size()); ++k) {
      const auto require_inside = [](const Path& folder, const Path& mask) {
        if (const std::string link = capture::link_out_of(folder, mask); !link.empty())
          throw InputError(mask.string(), link, "remove the link");
      };
      require_inside(into_folder, wanted[c].file(k));
      if (!given[c].text.empty()) require_inside(scene.folder, given[c].file(k));
    }
  Agreement agreement{std::vector<double>(cameras, 0.0), std::vector<int>(cameras, 0)};
  const auto keep = [&](int camera, int frame, const capture::Image8& mask) {
    const Path target = wanted[camera].file(frame);
    if (!in_place && !given[camera].text.empty() && fs::is_regular_file(given[camera].file(frame), error)) {
      const capture::Image8 other = capture::read_image8(given[camera].file(frame));
      if (other.width == mask.width && other.height == mask.height) {
        agreement.sum[camera] += iou(mask, other);
        ++agreement.frames[camera];
      }
    }
    core::make_folder(target.parent_path());
    capture::write_png(target, mask);
  };

  masking::Summary summary;
  std::vector<Score> scores;
  if (request.command.empty()) {
    options.first = first;
    options.last = last;
    summary =
        masking::make(request.capture, options, [&](int camera, int frame, const capture::Image8& mask, double score) {
          keep(camera, frame, mask);
          scores.push_back({camera, frame, score});
        });
    std::string table = "camera,frame,score\n";
    for (const Score& one : scores) {
      char line[48];
      std::snprintf(line, sizeof line, ",%d,%.3f\n", one.frame, one.score);
      table += scene.cameras[one.camera].name + line;
    }
    const Path folder = in_place ? scene.folder / "masks" : Path(request.out);
    core::make_folder(folder);
    core::write_file(folder / "scores.csv", table);
  } else {
    const Exchange exchange;
    std::int64_t total = 0;
    for (const std::vector<double>& times : scene.times) total += static_cast<std::int64_t>(times.size());
    for (int c = 0; c < static_cast<int>(cameras); ++c) {
      const int all = static_cast<int>(scene.times[c].size()), end = last < 0 ? all : std::min(all, last);
      // frames held in memory at once: few, but a block of a video is reached by decoding all before it
      constexpr double kBlockBytes = 256.0 * 1024 * 1024;
      const double bytes = 4.0 * scene.cameras[c].width * scene.cameras[c].height;
      const int most = static_cast<int>(std::clamp(kBlockBytes / bytes, 1.0, 1e6));
      for (int begin = first; begin < end; begin += most) {
        capture::LoadOptions block;
        block.masked = block.undistort = false;
        block.camera = scene.cameras[c].name;
        block.first = begin;
        block.last = std::min(end, begin + most);
        for (const capture::View& view : capture::load(request.capture, block).views) {
          if (core::stop_requested()) throw Interrupted(core::stop_requested());
          const std::string where = scene.cameras[c].name + ", frame " + std::to_string(view.frame);
          const capture::Image8 mask = mask_by_command(request.command, view, where, exchange.folder);
          ++summary.frames;
          summary.empty += std::none_of(mask.pixels.begin(), mask.pixels.end(), [](std::uint8_t p) { return p != 0; });
          keep(c, view.frame, mask);
          core::report({"mask", summary.frames, total, std::nan(""), std::nan(""), where});
        }
      }
    }
    if (summary.frames == 0)
      throw InputError(request.capture, "has no frame in the range asked for", "choose frames that it has");
  }
  if (in_place) {
    for (std::size_t c = 0; c < cameras; ++c) json["cameras"][c]["masks"] = wanted[c].text;
    core::write_file(file, json.dump(1) + "\n");
  }
  const std::string into = in_place ? (scene.folder / "masks").string() : request.out;
  if (summary.empty > 0)
    core::warn(into + ": " + std::to_string(summary.empty) + " of " + std::to_string(summary.frames) +
               " masks are empty; the rope is hidden or was not found there");
  warn_of_poor(scores, scene, into);
  const double across = (summary.grasp - summary.grasp.dot(scene.direction) * scene.direction).norm();
  if (across > kFarAcross || summary.grasp.norm() > kFarGrasp) {
    char text[160];
    std::snprintf(
        text, sizeof text, ": the rope seems to begin %.0f mm from the grasp that is given, at [%.0f, %.0f, %.0f]",
        1e3 * summary.grasp.norm(), 1e3 * summary.grasp.x(), 1e3 * summary.grasp.y(), 1e3 * summary.grasp.z());
    core::warn(into + text + " mm in the base frame; check the base's poses and the cameras, and look at the masks");
  }
  if (request.command.empty() && summary.inside < kMostlyInside)
    core::warn(into + ": only " + std::to_string(std::lround(100.0 * summary.inside)) +
               " % of the rope lies in the masks; look at them before you use them, or use --command");
  if (!request.preview.empty())
    capture::write_png(request.preview, preview_of(request, scene, scores, wanted, first, last));
  int poor = 0;
  for (const Score& one : scores) poor += one.score < masking::kDoubtful;
  Json document;
  document["masks"] = into;
  document["frames"] = summary.frames;
  document["empty"] = summary.empty;
  if (request.command.empty()) document["inside"] = summary.inside, document["poor"] = poor;
  if (summary.grasp.norm() > 0.0) document["grasp_offset"] = {summary.grasp.x(), summary.grasp.y(), summary.grasp.z()};
  if (!request.preview.empty()) document["preview"] = request.preview;
  for (std::size_t c = 0; c < cameras; ++c)
    if (agreement.frames[c] > 0) document["iou"][scene.cameras[c].name] = agreement.sum[c] / agreement.frames[c];
  if (globals.json) {
    std::cout << document.dump(1, ' ', false, Json::error_handler_t::replace) << "\n";
    return;
  }
  std::cout << "masks: " << summary.frames << " in " << into << "\n";
  for (std::size_t c = 0; c < cameras; ++c)
    if (agreement.frames[c] > 0)
      std::printf("%s: IoU %.4f with the capture's own masks\n", scene.cameras[c].name.c_str(),
                  agreement.sum[c] / agreement.frames[c]);
}

}  // namespace

void add_mask_command(CLI::App& app, const Globals& globals, Job& job) {
  CLI::App* command = app.add_subcommand(
      "mask",
      "Make object masks for a capture that has none: from the known cameras, base motion, length and\n"
      "diameter, the background and the colors near the grasp; or by an outside program, frame by frame");
  auto request = std::make_shared<Request>();
  command->add_option("CAPTURE", request->capture, "The capture's folder or its capture.json")->required();
  command
      ->add_option("-o,--output", request->out,
                   "Write FOLDER/CAMERA/000000.png and leave the capture alone (default: into the capture, where its\n"
                   "'masks' keys say or masks/CAMERA/%06d.png, which is then named in capture.json); where the\n"
                   "capture has masks, says how well they agree")
      ->type_name("FOLDER");
  command
      ->add_option("--command", request->command,
                   "Run this for every frame instead: {image} is a PNG to read, {mask} a PNG of the same size to\n"
                   "write, 255 for the object; example: 'segment {image} --out {mask}'")
      ->type_name("LINE");
  command->add_option("--frames", request->frames, "Only frames A to B - 1, with -o")->type_name("A:B");
  command
      ->add_option("--point", request->points,
                   "A point on the rope, as clicked, in recorded pixels of the first frame (or CAMERA:FRAME:X,Y);\n"
                   "may be given several times")
      ->type_name("CAMERA:X,Y")
      ->allow_extra_args(false);
  command
      ->add_option("--box", request->boxes,
                   "The rope lies in this box, in recorded pixels, in all frames (or CAMERA:FRAME:...)")
      ->type_name("CAMERA:X0,Y0,X1,Y1")
      ->allow_extra_args(false);
  command->add_option("--empty", request->empty, "A picture of the camera without the rope")
      ->type_name("CAMERA=FILE")
      ->allow_extra_args(false);
  command
      ->add_option("--preview", request->preview,
                   "Also write a contact sheet: some frames of every camera with the masks' outlines and scores")
      ->type_name("FILE.png");
  command->add_flag("--force", request->force, "Replace masks that are there");
  command->callback([&globals, &job, request] { job = [&globals, request] { make_masks(globals, *request); }; });
}

}  // namespace chainsplat::tools
