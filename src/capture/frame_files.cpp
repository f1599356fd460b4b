#include "src/capture/frame_files.h"

#include <algorithm>
#include <charconv>
#include <cmath>

#include "chainsplat/text.h"

namespace chainsplat::capture {

namespace {

constexpr double kLongestRecording = 3600.0;  // s; the dynamics are integrated over it in millisecond steps
constexpr double kRounding = 1.0 + 1e-3;      // a readout that fills the interval may be written in few digits
constexpr const char* kOwnFile = "copy the file itself into the capture's folder";

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

double median_interval(const std::vector<double>& times) {
  std::vector<double> intervals;
  for (std::size_t k = 1; k < times.size(); ++k) intervals.push_back(times[k] - times[k - 1]);
  return math::median(intervals);
}

// A recording that is too long has no times. `key`: what says how long it is.
void check_span(CameraSource& source, const std::string& key, Findings& findings) {
  if (const double seconds = source.times.back() - source.times.front(); seconds > kLongestRecording) {
    findings.problems.push_back({source.where + key,
                                 "the frames span " + core::brief(seconds) + " s and a recording at most " +
                                     core::exact(kLongestRecording) + " s, for the motion between all is computed",
                                 "correct it or split the recording"});
    source.times.clear();
  }
}

// A stamp is of the first row that was read; a frame's time is that of its middle row.
void add_readout(CameraSource& source, Findings& findings) {
  const double readout = std::abs(source.camera.readout);
  if (readout == 0.0) return;
  if (source.times.size() > 1 && readout > kRounding * source.interval)
    findings.problems.push_back(
        {source.where + ".readout",
         core::brief(readout) + " s are more than the " + core::brief(source.interval) + " s from frame to frame",
         "write the seconds from the first row to the last, or 0 for a global shutter"});
  for (double& time : source.times) time += 0.5 * readout;
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
    source.interval = median_interval(source.times);
  } else {
    source.times.resize(frames);
    for (int k = 0; k < frames; ++k) source.times[k] = source.start + k / source.rate;
    source.interval = 1.0 / source.rate;
  }
  check_span(source, source.timestamps ? ".timestamps" : ".rate", findings);
  add_readout(source, findings);
}

// The frames of a camera that are in memory.
void survey_pictures(CameraSource& source, bool masked, Findings& findings) {
  const auto wrong = [&](const std::string& what, const std::string& mend) {
    findings.problems.push_back({source.where, what, mend});
    source.times.clear();
  };
  const std::size_t count = source.times.size();
  const auto fits = [&](const std::vector<Image8>& pictures, int channels) {
    const Camera& camera = source.camera;
    const std::size_t bytes = static_cast<std::size_t>(camera.width) * camera.height * channels;
    return pictures.size() == count && std::all_of(pictures.begin(), pictures.end(), [&](const Image8& picture) {
             return picture.width == camera.width && picture.height == camera.height && picture.channels == channels &&
                    picture.pixels.size() == bytes;
           });
  };
  if (count == 0 || count > kMostFrames)
    return wrong("has no frames, or more than " + std::to_string(kMostFrames), "give its `times` and `images`");
  for (std::size_t k = 0; k < count; ++k)
    if (!std::isfinite(source.times[k]) || (k > 0 && !(source.times[k] > source.times[k - 1])))
      return wrong("`times` of frame " + std::to_string(k) + " is not after the one before", "give increasing seconds");
  if (!fits(*source.images.pictures, 3))
    return wrong("`images` are not RGB of the camera's size, one per time", "give them as recorded");
  if (masked && source.masks && !fits(*source.masks->pictures, 1))
    return wrong("`masks` do not have one channel and the camera's size, one per time", "give one per image");
  source.interval = median_interval(source.times);
  check_span(source, "", findings);
  add_readout(source, findings);
}

}  // namespace

std::optional<ImageSource> image_source(const ObjectReader& reader, const std::string& key, const Path& folder,
                                        bool required) {
  const auto text = reader.path(key, required, "a video like cam0.mp4 or a pattern like cam0/%06d.png");
  if (!text) return std::nullopt;
  ImageSource source;
  if (text->find('%') == std::string::npos) {
    source.video = true;
    source.file = folder / *text;
    return source;
  }
  const std::optional<FramePattern> names = read_frame_pattern(*text);
  if (!names) {
    reader.problem(key, in_quotes(*text) + " is not a frame pattern", "write the number once, as %d or %06d");
    return std::nullopt;
  }
  source.names = *names;
  source.names.before = (folder / names->before).string();
  return source;
}

bool is_file(const Path& file) {
  std::error_code error;
  return std::filesystem::is_regular_file(file, error);
}

void require_file(const Path& file) {
  if (is_file(file)) return;
  std::error_code error;
  const auto status = std::filesystem::status(file, error);
  if (!std::filesystem::exists(status)) throw InputError(file.string(), "does not exist", "check the path");
  if (std::filesystem::is_directory(status)) throw InputError(file.string(), "is a folder, not a file", "name a file");
  throw InputError(file.string(), "is a pipe or device, not a file", "name a file");
}

void require_own_file(const Path& folder, const Path& file) {
  if (const std::string link = link_out_of(folder, file); !link.empty())
    throw InputError(file.string(), link, kOwnFile);
  require_file(file);
}

void survey_frames(Manifest& manifest, bool masked, Findings& findings) {
  std::vector<Findings> found(manifest.cameras.size());  // per camera, so that their order does not depend on threads
  core::parallel_for(static_cast<std::int64_t>(manifest.cameras.size()), [&](std::int64_t c) {
    CameraSource& source = manifest.cameras[c];
    Findings& mine = found[c];
    if (source.images.pictures) return survey_pictures(source, masked, mine);
    if (source.images.file.empty() && source.images.names.before.empty()) return;
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

}  // namespace chainsplat::capture
