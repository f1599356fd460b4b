#include "media.h"

#include <algorithm>
#include <array>
#include <cctype>
#include <cstdio>

#include "chainsplat/frame_pattern.h"
#include "chainsplat/image_model.h"
#include "document.h"

namespace chainsplat::importing {

namespace fs = std::filesystem;

namespace {

bool is_image(const Path& file) {
  const std::string ending = lower(file.extension().string());
  for (const char* known : {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm", ".pnm", ".webp", ".exr"})
    if (ending == known) return true;
  return false;
}

// "frame2.png" before "frame10.png".
bool before(const std::string& a, const std::string& b) {
  std::size_t i = 0, j = 0;
  while (i < a.size() && j < b.size()) {
    if (std::isdigit(static_cast<unsigned char>(a[i])) && std::isdigit(static_cast<unsigned char>(b[j]))) {
      const auto run = [](const std::string& text, std::size_t& at) {
        const std::size_t from = std::min(text.find_first_not_of('0', at), text.size());
        at = from;
        while (at < text.size() && std::isdigit(static_cast<unsigned char>(text[at]))) ++at;
        return text.substr(from, at - from);
      };
      const std::string x = run(a, i), y = run(b, j);
      if (x.size() != y.size()) return x.size() < y.size();
      if (x != y) return x < y;
      continue;
    }
    if (a[i] != b[j]) return a[i] < b[j];
    ++i, ++j;
  }
  return a.size() - i < b.size() - j;
}

std::string padded(int frame) {
  char text[32];
  std::snprintf(text, sizeof text, "%06d", frame);
  return text;
}

std::vector<Path> by_pattern(const Path& path) {
  const std::string text = path.string();
  const std::size_t percent = text.find('%'), d = text.find('d', percent);
  const std::string width = d == std::string::npos ? "x" : text.substr(percent + 1, d - percent - 1);
  if (d == std::string::npos || width.size() > 3 || width.find_first_not_of("0123456789") != std::string::npos)
    throw InputError(text, "is no pattern of images", "write the number once, as %d or %06d");
  const capture::FramePattern names{text.substr(0, percent), text.substr(d + 1),
                                    width.empty() ? 0 : std::atoi(width.c_str())};
  std::vector<Path> files;
  std::error_code error;
  for (int begin : {0, 1}) {
    for (int frame = begin; frame <= capture::kMostFrames; ++frame) {
      Path file = names.file(frame);
      if (!fs::is_regular_file(file, error)) break;
      files.push_back(std::move(file));
    }
    if (!files.empty()) break;
  }
  return files;
}

// Lossless, since what is undistorted or cut is compressed once already.
std::string write_png_frames(const Media& media, const Take& take, const Path& folder, const std::string& name,
                             const std::function<capture::Image8(const capture::Image8&)>& change) {
  core::make_folder(folder / name);
  for_each_frame(media, take, [&](int frame, const capture::Image8& image) {
    capture::write_png(folder / name / (padded(frame - take.first) + ".png"), change(image));
    core::report({"import " + name, frame - take.first + 1, take.last - take.first, NAN, NAN, ""});
  });
  return name + "/%06d.png";
}

void copy_whole(const Path& from, const Path& to) {
  std::error_code error;
  fs::copy_file(from, to, fs::copy_options::overwrite_existing, error);
  if (error) throw WorkError(to.string(), "cannot be written (" + error.message() + ")", "make room");
}

int value_of(const capture::Image8& image, std::size_t pixel, const MaskRule& rule) {
  const std::uint8_t* p = &image.pixels[pixel * image.channels];
  if (rule.alpha) return p[image.channels - 1];
  int value = p[0];
  for (int c = 1; c < std::min(image.channels, 3) && image.channels >= 3; ++c) value = std::max<int>(value, p[c]);
  return value;
}

bool has_alpha(const Media& media) { return media.channels == 2 || media.channels == 4; }

}  // namespace

Media open_media(const Path& path) {
  Media media;
  media.source = path;
  std::error_code error;
  if (fs::is_directory(path, error)) {
    for (const auto& entry : fs::directory_iterator(path, error))
      if (entry.is_regular_file(error) && is_image(entry.path())) media.files.push_back(entry.path());
    std::sort(media.files.begin(), media.files.end(),
              [](const Path& a, const Path& b) { return before(a.filename().string(), b.filename().string()); });
    if (media.files.empty())
      throw InputError(path.string(), "is a folder without images", "give a video or a folder of PNG or JPEG");
  } else if (path.string().find('%') != std::string::npos && !fs::exists(path, error)) {
    media.files = by_pattern(path);
    if (media.files.empty())
      throw InputError(path.string(), "no image has such a name", "number the frames from 0 or 1");
  } else if (is_image(path) && fs::is_regular_file(path, error)) {
    media.files = {path};
  } else {
    if (!fs::exists(path, error)) throw InputError(path.string(), "does not exist", "check the path");
    if (!fs::is_regular_file(path, error))
      throw InputError(path.string(), "is a pipe or a device, which can be read once", "record it into a file first");
    const capture::VideoFacts facts = capture::video_facts(path);
    if (facts.frames < 1) throw InputError(path.string(), "has no frame", "write the video again");
    media.video = true;
    media.frames = facts.frames, media.width = facts.width, media.height = facts.height, media.rate = facts.rate;
    media.channels = 3;
    return media;
  }
  const capture::Image8 first = capture::read_image8(media.files.front());
  media.frames = static_cast<int>(media.files.size());
  media.width = first.width, media.height = first.height, media.channels = first.channels;
  return media;
}

void for_each_frame(const Media& media, const Take& take, const std::function<void(int, const capture::Image8&)>& use) {
  if (!media.video) {
    for (int frame = take.first; frame < take.last; ++frame) {
      const capture::Image8 image = capture::read_image8(media.files[frame]);
      if (image.width != media.width || image.height != media.height)
        throw InputError(media.files[frame].string(),
                         "is " + std::to_string(image.width) + "x" + std::to_string(image.height) +
                             " pixels, the first one " + std::to_string(media.width) + "x" +
                             std::to_string(media.height),
                         "give images of one size");
      use(frame, image);
    }
    return;
  }
  capture::VideoReader reader(media.source, core::threads());
  capture::Image8 image;
  for (int frame = 0; frame < take.last; ++frame) {
    if (!(frame < take.first ? reader.skip() : reader.next(image)))
      throw InputError(media.source.string(), "ends after " + std::to_string(frame) + " frames",
                       "write the video again");
    if (frame >= take.first) use(frame, image);
  }
}

std::string write_frames(const Media& media, const Take& take, const Undistortion* lens, const Path& folder,
                         const std::string& name) {
  if (lens)
    return write_png_frames(media, take, folder, name,
                            [&](const capture::Image8& image) { return undistort(*lens, image); });
  if (media.video && take.first == 0 && take.last == media.frames) {
    const std::string file = name + lower(media.source.extension().string());
    copy_whole(media.source, folder / file);
    return file;
  }
  if (media.video)
    return write_png_frames(media, take, folder, name, [](const capture::Image8& image) { return image; });
  const std::string ending = lower(media.files.front().extension().string());
  core::make_folder(folder / name);
  for (int frame = take.first; frame < take.last; ++frame)
    copy_whole(media.files[frame], folder / name / (padded(frame - take.first) + ending));
  return name + "/%06d" + ending;
}

MaskRule mask_rule(const Media& media, const Take& take, const std::string& label, bool alpha) {
  MaskRule rule;
  if (alpha && !has_alpha(media))
    throw InputError(media.source.string(), "has no alpha channel",
                     "give masks of their own, or make them: chainsplat mask");
  std::array<std::int64_t, 256> colors{}, alphas{};
  for_each_frame(media, take, [&](int, const capture::Image8& image) {
    const bool with_alpha = image.channels == 2 || image.channels == 4;
    for (std::size_t i = 0; i < image.pixels.size() / image.channels; ++i) {
      ++colors[value_of(image, i, rule)];
      if (with_alpha) ++alphas[image.pixels[i * image.channels + image.channels - 1]];
    }
  });
  std::int64_t all = 0, transparent = 0;
  for (const std::int64_t n : colors) all += n;
  for (int v = 0; v < 255; ++v) transparent += alphas[v];
  rule.alpha = alpha || (has_alpha(media) && transparent > 0);
  const std::array<std::int64_t, 256>& counts = rule.alpha ? alphas : colors;
  int most = 255;
  while (most > 0 && counts[most] == 0) --most;
  if (most == 0)
    throw InputError(media.source.string(), "all masks are empty", "the rope must be brighter than the rest");
  rule.threshold = std::max(1, (most + 1) / 2);
  std::int64_t object = 0;
  if (!label.empty()) {
    const auto value = number_of(label);
    if (!value || *value < 0 || *value > 255 || counts[static_cast<int>(*value)] == 0)
      throw InputError(media.source.string(), "no mask has the value '" + label + "'",
                       "name a value of the masks behind #");
    rule.label = static_cast<int>(*value);
    object = counts[rule.label];
    rule.note = "the value " + label + " is the rope";
  } else {
    for (int v = rule.threshold; v < 256; ++v) object += counts[v];
    rule.inverted = 2 * object > all;
    if (rule.inverted) object = all - object;
    int values = 0;
    for (const std::int64_t n : counts) values += 1000 * n > all;
    rule.note = std::string(rule.alpha ? "alpha, " : "") +
                (rule.inverted ? "the rope is dark (below " : "the rope is bright (from ") +
                std::to_string(rule.threshold) + " of " + std::to_string(most) + ")";
    if (values > 2 && !media.video && values < 12)
      rule.note += ", though " + std::to_string(values) +
                   " values are common: choose one with #VALUE if several things are labeled";
  }
  char share[64];
  std::snprintf(share, sizeof share, ", %.2g %% of the picture",
                100.0 * static_cast<double>(object) / static_cast<double>(all));
  rule.note += share;
  return rule;
}

capture::Image8 binary_mask(const capture::Image8& image, const MaskRule& rule) {
  capture::Image8 mask{image.width, image.height, 1, {}};
  mask.pixels.resize(static_cast<std::size_t>(image.width) * image.height);
  for (std::size_t i = 0; i < mask.pixels.size(); ++i) {
    const int value = value_of(image, i, rule);
    const bool inside = rule.label >= 0 ? value == rule.label : (value >= rule.threshold) != rule.inverted;
    mask.pixels[i] = inside ? 255 : 0;
  }
  return mask;
}

std::string write_masks(const Media& media, const Take& take, const MaskRule& rule, const Undistortion* lens,
                        const Path& folder, const std::string& name) {
  return write_png_frames(media, take, folder, "masks/" + name, [&](const capture::Image8& image) {
    const capture::Image8 mask = binary_mask(image, rule);
    if (!lens) return mask;
    capture::Image8 straight = undistort(*lens, mask);
    for (std::uint8_t& value : straight.pixels) value = value >= image_model::kObjectMask ? 255 : 0;
    return straight;
  });
}

}  // namespace chainsplat::importing
