// mask.cpp - object masks for a capture that has none: by our own means or by an outside program, frame by frame.
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <iostream>
#include <memory>
#include <nlohmann/json.hpp>
#include <optional>

#include "chainsplat/json.h"
#include "chainsplat/masks.h"
#include "cli.h"
#include "command_line.h"

namespace chainsplat::tools {

namespace {

namespace fs = std::filesystem;
using Json = nlohmann::ordered_json;

constexpr std::string_view kImageName = "{image}", kMaskName = "{mask}";  // in the line of a command

struct MaskRequest {
  std::string capture, out, command, frames, preview;
  std::vector<std::string> points, boxes, empty;
  bool force = false;
};

// The line with the files in place of {image} and {mask}. In one pass: a file's name may hold these letters, too.
std::string filled_in(const std::string& line, const Path& image, const Path& mask) {
  std::string out;
  for (std::size_t at = 0; at < line.size();) {
    const std::string_view rest = std::string_view(line).substr(at);
    if (rest.starts_with(kImageName)) {
      out += shell_quoted(image.string());
      at += kImageName.size();
    } else if (rest.starts_with(kMaskName)) {
      out += shell_quoted(mask.string());
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
    std::string name =
        (fs::temp_directory_path() / ("chainsplat-mask." + std::string(6, 'X'))).string();  // mkdtemp replaces them
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

// Runs the command's line for one frame.
capture::Image8 mask_by_command(const std::string& command, const capture::Image8& picture, const std::string& where,
                                const Path& folder) {
  const Path image = folder / "image.png", mask = folder / "mask.png";
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
  try {
    return capture::read_image8(mask);
  } catch (const InputError&) {
    throw WorkError(where, "the command's mask is no image that can be read", "write an 8-bit PNG; " + mend);
  }
}

// The command's line as the library calls it.
pipeline::MaskCommand mask_command(const std::string& line) {
  for (const std::string_view name : {kImageName, kMaskName})
    if (line.find(name) == std::string::npos)
      throw InputError("--command", "does not hold " + std::string(name),
                       "write the program's line with {image} and {mask} where the file names go");
  const auto exchange = std::make_shared<std::optional<Exchange>>();  // made for the first frame
  return [line, exchange](const std::string& camera, int frame, const capture::Image8& picture) {
    if (!*exchange) exchange->emplace();
    return mask_by_command(line, picture, camera + ", frame " + std::to_string(frame), (*exchange)->folder);
  };
}

// CAMERA[:FRAME]:NUMBER,NUMBER,... with `count` numbers.
struct Hint {
  std::string camera;
  std::optional<int> frame;
  std::vector<double> numbers;
};
Hint read_hint(const std::string& text, const std::string& option, std::size_t count) {
  const auto refuse = [&] {
    throw InputError(option + " " + text, "is not CAMERA:" + std::string(count == 2 ? "X,Y" : "X0,Y0,X1,Y1"),
                     "in recorded pixels, as in " + option + (count == 2 ? " cam0:412,230" : " cam0:300,80,560,470") +
                         "; with a frame as in cam0:12:...");
  };
  const std::size_t first = text.find(':'), last = text.rfind(':');
  if (first == std::string::npos) refuse();
  Hint out;
  out.camera = text.substr(0, first);
  const auto number = [&](const std::string& part) {
    char* end = nullptr;
    const double value = std::strtod(part.c_str(), &end);
    if (part.empty() || *end || !std::isfinite(value)) refuse();
    return value;
  };
  if (last != first) {
    const double frame = number(text.substr(first + 1, last - first - 1));
    if (frame != std::floor(frame) || std::abs(frame) > capture::kMostFrames) refuse();
    out.frame = static_cast<int>(frame);
  }
  std::string rest = text.substr(last + 1) + ",";
  for (std::size_t comma; (comma = rest.find(',')) != std::string::npos; rest = rest.substr(comma + 1))
    out.numbers.push_back(number(rest.substr(0, comma)));
  if (out.numbers.size() != count) refuse();
  return out;
}

masking::Hints read_hints(const MaskRequest& request) {
  masking::Hints hints;
  for (const std::string& text : request.points) {
    const Hint hint = read_hint(text, "--point", 2);
    hints.points.push_back({hint.camera, hint.frame, hint.numbers[0], hint.numbers[1]});
  }
  for (const std::string& text : request.boxes) {
    const Hint hint = read_hint(text, "--box", 4);
    const std::vector<double>& n = hint.numbers;
    hints.boxes.push_back({hint.camera, hint.frame, n[0], n[1], n[2], n[3]});
  }
  for (const std::string& text : request.empty) {
    const std::size_t equals = text.find('=');
    if (equals == std::string::npos)
      throw InputError("--empty " + text, "is not CAMERA=FILE", "as in --empty cam0=empty.png");
    hints.empty.push_back({text.substr(0, equals), text.substr(equals + 1)});
  }
  return hints;
}

void print_document(const MaskRequest& request, const pipeline::MaskResult& result) {
  const math::Vector3& grasp = result.summary.grasp;
  Json document;
  document["masks"] = result.folder.string();
  document["frames"] = result.summary.frames;
  document["empty"] = result.summary.empty;
  if (request.command.empty()) {
    document["inside"] = result.summary.inside;
    document["poor"] = std::count_if(result.scores.begin(), result.scores.end(),
                                     [](const auto& one) { return one.score < masking::kDoubtful; });
  }
  if (grasp.norm() > 0.0) document["grasp_offset"] = {grasp.x(), grasp.y(), grasp.z()};
  if (!request.preview.empty()) document["preview"] = request.preview;
  for (const auto& [camera, iou] : result.agreement) document["iou"][camera] = iou;
  std::cout << core::json_text(document) << "\n";
}

void make_masks(const Globals& globals, const MaskRequest& request) {
  pipeline::MaskOptions options;
  options.output = request.out;
  options.force = request.force;
  options.frames = capture::read_frame_range(request.frames, "--frames");
  if (!request.command.empty()) options.command = mask_command(request.command);
  options.hints = read_hints(request);
  options.preview = request.preview;
  const pipeline::MaskResult result = pipeline::make_masks(request.capture, options, terminal());
  if (globals.json) return print_document(request, result);
  std::cout << "masks: " << result.summary.frames << " in " << result.folder.string() << "\n";
  for (const auto& [camera, iou] : result.agreement)
    std::printf("%s: IoU %.4f with the capture's own masks\n", camera.c_str(), iou);
}

}  // namespace

void add_mask_command(Command app, const Globals& globals, Job& job) {
  Command command = app.add_command(
      "mask",
      "Make object masks for a capture that has none: from the known cameras, base motion, length and\n"
      "diameter, the background and the colors near the grasp; or by an outside program, frame by frame");
  auto request = std::make_shared<MaskRequest>();
  command.add_option("CAPTURE", request->capture, "The capture's folder or its capture.json").required();
  command
      .add_option("-o,--output", request->out,
                  "Write FOLDER/CAMERA/000000.png and leave the capture alone (default: into the capture, where its\n"
                  "'masks' keys say or masks/CAMERA/%06d.png, which is then named in capture.json); where the\n"
                  "capture has masks, says how well they agree")
      .type_name("FOLDER");
  command
      .add_option("--command", request->command,
                  "Run this for every frame instead: {image} is a PNG to read, {mask} a PNG of the same size to\n"
                  "write, 255 for the object; example: 'segment {image} --out {mask}'")
      .type_name("LINE");
  command.add_option("--frames", request->frames, "Only frames A to B - 1, with -o").type_name("A:B");
  command
      .add_option("--point", request->points,
                  "A point on the rope, as clicked, in recorded pixels of the first frame (or CAMERA:FRAME:X,Y);\n"
                  "may be given several times")
      .type_name("CAMERA:X,Y")
      .one_each();
  command
      .add_option("--box", request->boxes,
                  "The rope lies in this box, in recorded pixels, in all frames (or CAMERA:FRAME:...)")
      .type_name("CAMERA:X0,Y0,X1,Y1")
      .one_each();
  command.add_option("--empty", request->empty, "A picture of the camera without the rope")
      .type_name("CAMERA=FILE")
      .one_each();
  command
      .add_option("--preview", request->preview,
                  "Also write a contact sheet: some frames of every camera with the masks' outlines and scores")
      .type_name("FILE.png");
  command.add_flag("--force", request->force, "Replace masks that are there");
  command.callback([&globals, &job, request] { job = [&globals, request] { make_masks(globals, *request); }; });
}

}  // namespace chainsplat::tools
