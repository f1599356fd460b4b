#include "media.h"

#include "chainsplat/encode.h"
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

const media::VideoLibrary& videos() {
  static const media::VideoLibrary& library = core::own_library<media::VideoLibrary>("chainsplat_videos", kMend);
  return library;
}

}  // namespace

std::vector<std::uint8_t> read_mask(const Path& file, int width, int height) {
  return images().read_mask(file, width, height);
}

std::vector<std::uint8_t> read_rgb(const Path& file, int width, int height) {
  return images().read_rgb(file, width, height);
}

std::vector<float> read_depth(const Path& file, int width, int height, double scale) {
  return images().read_depth(file, width, height, scale);
}

Image8 read_image8(const Path& file) { return images().read_image8(file); }

void write_png(const Path& file, const Image8& image) { images().write_png(file, image); }

void write_depth_png(const Path& file, int width, int height, const std::vector<float>& meters, double scale) {
  images().write_depth_png(file, width, height, meters, scale);
}

void write_depth_exr(const Path& file, int width, int height, const std::vector<float>& meters) {
  images().write_depth_exr(file, width, height, meters);
}

std::string jpeg(const Image8& image, int quality) { return images().jpeg(image, quality); }

struct VideoReader::Implementation {
  media::Decoder& decoder;
  ~Implementation() { videos().close(&decoder); }
};

VideoReader::VideoReader(const Path& file, int threads, const DeviceFormat& format)
    : implementation_(new Implementation{*videos().open(file, threads, format, {core::warn, core::stop_requested})}) {}

VideoReader::~VideoReader() = default;
VideoReader::VideoReader(VideoReader&&) noexcept = default;
VideoReader& VideoReader::operator=(VideoReader&&) noexcept = default;

bool VideoReader::next(Image8& rgb) { return videos().next(implementation_->decoder, &rgb); }
bool VideoReader::skip() { return videos().next(implementation_->decoder, nullptr); }
bool VideoReader::device() const { return videos().device(implementation_->decoder); }
int VideoReader::frames() const { return videos().frames(implementation_->decoder); }
double VideoReader::rate() const { return videos().rate(implementation_->decoder); }
double VideoReader::time() const { return videos().time(implementation_->decoder); }
double VideoReader::first_time() const { return videos().first_time(implementation_->decoder); }

VideoFacts video_facts(const Path& file) { return videos().video_facts(file); }

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
