#include "media.h"

#include <fcntl.h>

#include <cstring>
#include <limits>
#include <variant>

#include "camera_device.h"
#include "chainsplat/encode.h"
#include "frame_stream.h"
#include "image_files.h"
#include "src/core/own_library.h"

namespace chainsplat::capture {

namespace {

constexpr const char* kMend =
    "install chainsplat-media, or what chainsplat was built with; where only Python has it, give pictures as arrays";

const media::ImageLibrary& images() {
  static const media::ImageLibrary& library = core::own_library<media::ImageLibrary>("chainsplat_images", kMend);
  return library;
}

const media::PngLibrary& pngs() {
  static const media::PngLibrary& library = core::own_library<media::PngLibrary>("chainsplat_pngs", kMend);
  return library;
}

const media::VideoLibrary& videos() {
  static const media::VideoLibrary& library = core::own_library<media::VideoLibrary>("chainsplat_videos", kMend);
  return library;
}

}  // namespace

std::vector<std::uint8_t> read_mask(const Path& file, int width, int height) {
  std::vector<std::uint8_t> mask;
  const media::PlainPng plain{.width = width, .height = height, .channels = 1, .bytes = 1, .rows = height};
  return pngs().read(file, plain, mask) ? mask : images().read_mask(file, width, height);
}

std::vector<std::uint8_t> read_rgb(const Path& file, int width, int height) {
  std::vector<std::uint8_t> rgb;
  const media::PlainPng plain{.width = width, .height = height, .channels = 3, .bytes = 1, .rows = height};
  return pngs().read(file, plain, rgb) ? rgb : images().read_rgb(file, width, height);
}

std::vector<float> read_depth(const Path& file, int width, int height, int rows, double scale) {
  std::vector<std::uint8_t> bytes;
  const media::PlainPng plain{.width = width, .height = height, .channels = 1, .bytes = 2, .rows = rows};
  if (!pngs().read(file, plain, bytes)) return images().read_depth(file, width, height, scale);
  std::vector<float> depth(static_cast<std::size_t>(width) * height, 0.0f);
  for (std::size_t i = 0; 2 * i < bytes.size(); ++i) {
    std::uint16_t raw = 0;
    std::memcpy(&raw, &bytes[2 * i], sizeof raw);
    depth[i] = static_cast<float>(raw * scale);
  }
  return depth;
}

Image8 read_image8(const Path& file) { return images().read_image8(file); }

void write_png(const Path& file, const Image8& image) { images().write_png(file, image); }

void write_depth_png(const Path& file, int width, int height, const std::vector<float>& meters, double scale) {
  images().write_depth_png(file, width, height, meters, scale);
}

void write_depth_exr(const Path& file, int width, int height, const std::vector<float>& meters) {
  images().write_depth_exr(file, width, height, meters);
}

namespace {

// A compressed video.
class Video {
 public:
  // `pipe`: what `file` is opened as already, where it is a pipe.
  Video(const Path& file, Descriptor pipe, int threads)
      : pipe_(std::move(pipe)), decoder_(videos().open(file, pipe_.number(), threads), videos().close) {}
  bool next(Image8* rgb) { return videos().next(*decoder_, rgb); }
  int frames() const { return videos().frames(*decoder_); }
  double rate() const { return videos().rate(*decoder_); }
  double time() const { return videos().time(*decoder_); }

 private:
  Descriptor pipe_;
  std::unique_ptr<media::Decoder, void (*)(media::Decoder*)> decoder_;
};

// A camera, frames that are not compressed, or a compressed video, by what `file` is and how it begins.
std::variant<CameraDevice, FrameStream, Video> open_source(const Path& file, int threads, const DeviceFormat& format) {
  std::error_code error;
  if (file == "-") return FrameStream(Descriptor(STDIN_FILENO), "standard input", format.width, format.height);
  if (std::filesystem::is_character_file(file, error)) return CameraDevice(file, format);
  Descriptor opened(::open(file.c_str(), O_RDONLY | O_CLOEXEC));
  if (opened.number() >= 0 && is_y4m(opened.number())) return FrameStream(std::move(opened), file.string());
  if (!std::filesystem::is_fifo(file, error)) opened = Descriptor();
  return Video(file, std::move(opened), threads);
}

}  // namespace

struct VideoReader::Implementation {
  std::variant<CameraDevice, FrameStream, Video> source;
};

VideoReader::VideoReader(const Path& file, int threads, const DeviceFormat& format)
    : implementation_(new Implementation{open_source(file, threads, format)}) {}

VideoReader::~VideoReader() = default;
VideoReader::VideoReader(VideoReader&&) noexcept = default;
VideoReader& VideoReader::operator=(VideoReader&&) noexcept = default;

bool VideoReader::next(Image8& rgb) {
  return std::visit([&](auto& source) { return source.next(&rgb); }, implementation_->source);
}
bool VideoReader::skip() {
  return std::visit([](auto& source) { return source.next(nullptr); }, implementation_->source);
}
bool VideoReader::device() const { return std::holds_alternative<CameraDevice>(implementation_->source); }
int VideoReader::frames() const {
  return std::visit([](const auto& source) { return source.frames(); }, implementation_->source);
}
double VideoReader::rate() const {
  return std::visit([](auto& source) { return source.rate(); }, implementation_->source);
}
double VideoReader::time() const {
  return std::visit([](const auto& source) { return source.time(); }, implementation_->source);
}
double VideoReader::first_time() const {
  const auto* const camera = std::get_if<CameraDevice>(&implementation_->source);
  return camera ? camera->first_time() : std::numeric_limits<double>::quiet_NaN();
}

VideoFacts video_facts(const Path& file) {
  Descriptor opened(::open(file.c_str(), O_RDONLY | O_CLOEXEC));
  if (opened.number() < 0 || !is_y4m(opened.number())) return videos().video_facts(file);
  FrameStream stream(std::move(opened), file.string());
  while (stream.frames() <= kMostFrames && stream.next(nullptr)) {
  }
  return {stream.width(), stream.height(), stream.frames(), stream.rate()};
}

struct VideoWriter::Implementation {
  media::Encoder& encoder;
  ~Implementation() { videos().discard(&encoder); }
};

VideoWriter::VideoWriter(const Path& file, double rate)
    : implementation_(new Implementation{*videos().create(file, rate)}) {}

VideoWriter::~VideoWriter() = default;

void VideoWriter::add(const Image8& frame) { videos().add(implementation_->encoder, frame); }
void VideoWriter::finish() { videos().finish(implementation_->encoder); }

void write_video(const Path& file, double rate, const std::vector<Image8>& frames) {
  VideoWriter writer(file, rate);
  for (const Image8& frame : frames) writer.add(frame);
  writer.finish();
}

}  // namespace chainsplat::capture
