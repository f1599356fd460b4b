#include "image_files.h"

#include <OpenImageIO/imageio.h>

#include <unistd.h>

#include <cmath>
#include <filesystem>
#include <fstream>
#include <memory>
#include <string>
#include <string_view>

namespace chainsplat::capture {

namespace {

// A PNG that ends before its last chunk. Found here, because libpng prints a line of its own about it.
bool cut_off_png(const Path& file) {
  std::ifstream stream(file, std::ios::binary);
  constexpr std::string_view kSignature = "\x89PNG\r\n\x1a\n";
  char start[8] = {};
  if (!stream.read(start, sizeof start) || std::string_view(start, sizeof start) != kSignature) return false;
  for (;;) {  // chunks: length, name, data, checksum
    unsigned char head[8];
    if (!stream.read(reinterpret_cast<char*>(head), sizeof head)) return true;
    const std::streamoff length = (head[0] << 24u) | (head[1] << 16) | (head[2] << 8) | head[3];
    if (std::string_view(reinterpret_cast<const char*>(head) + 4, 4) == "IEND") return false;
    if (length < 0) return true;
    stream.seekg(length + 4, std::ios::cur);
  }
}

std::unique_ptr<OIIO::ImageInput> open_image(const Path& file) {
  std::error_code error;
  if (!std::filesystem::exists(file, error))
    throw InputError(file.string(), "does not exist", "check the path and the frame numbers");
  if (cut_off_png(file)) throw InputError(file.string(), "is cut off", "write it again");
  OIIO::ImageSpec options;
  options.attribute("oiio:UnassociatedAlpha", 1);  // colors as stored, not multiplied by alpha
  auto input = OIIO::ImageInput::open(file.string(), &options);
  if (!input) {
    OIIO::geterror();  // its text names plugins and internals, not the user's mistake
    throw InputError(file.string(), "is not a readable image", "write it again as PNG");
  }
  input->threads(1);  // files are read in parallel already
  return input;
}

std::string size_text(int width, int height) { return std::to_string(width) + "x" + std::to_string(height); }

void require_size(const Path& file, const OIIO::ImageSpec& spec, int width, int height) {
  if (spec.width != width || spec.height != height)
    throw InputError(file.string(),
                     "is " + size_text(spec.width, spec.height) + " pixels, the camera has " + size_text(width, height),
                     "correct width and height in capture.json or the image");
}

template <class Value>
std::vector<Value> read_pixels(OIIO::ImageInput& input, const Path& file, OIIO::TypeDesc type, int channels) {
  const OIIO::ImageSpec& spec = input.spec();
  std::vector<Value> pixels(static_cast<std::size_t>(spec.width) * spec.height * channels);
  // asked for what the file holds, OpenImageIO reads in place; else through a buffer of 64 MB an image
  if (spec.format == type && spec.nchannels == channels) type = OIIO::TypeDesc::UNKNOWN;
  if (!input.read_image(0, 0, 0, channels, type, pixels.data())) {
    input.geterror();
    throw InputError(file.string(), "is damaged or cut off", "write it again");
  }
  return pixels;
}

// Opens `create` under a temporary name, writes, and renames: a reader never sees half a file.
void write_image(const Path& file, const std::string& format, const OIIO::ImageSpec& spec, const OIIO::TypeDesc& type,
                 const void* pixels) {
  const Path temporary = file.string() + ".tmp" + std::to_string(::getpid());
  auto output = OIIO::ImageOutput::create(format);
  CHAINSPLAT_CHECK(output != nullptr, "OpenImageIO lacks " + format);
  const bool written = output->open(temporary.string(), spec) && output->write_image(type, pixels) && output->close();
  std::error_code error;
  if (written) std::filesystem::rename(temporary, file, error);
  if (!written || error) {
    const std::string reason = written ? error.message() : output->geterror();
    std::filesystem::remove(temporary, error);
    throw WorkError(file.string(), "cannot be written (" + reason.substr(0, reason.find('\n')) + ")",
                    "check the folder and the free space");
  }
}

}  // namespace

std::vector<std::uint8_t> read_mask(const Path& file, int width, int height) {
  const auto input = open_image(file);
  require_size(file, input->spec(), width, height);
  return read_pixels<std::uint8_t>(*input, file, OIIO::TypeDesc::UINT8, 1);
}

std::vector<std::uint8_t> read_rgb(const Path& file, int width, int height) {
  const auto input = open_image(file);
  require_size(file, input->spec(), width, height);
  if (input->spec().nchannels >= 3) return read_pixels<std::uint8_t>(*input, file, OIIO::TypeDesc::UINT8, 3);
  const std::vector<std::uint8_t> gray = read_pixels<std::uint8_t>(*input, file, OIIO::TypeDesc::UINT8, 1);
  std::vector<std::uint8_t> rgb(3 * gray.size());
  for (std::size_t i = 0; i < rgb.size(); ++i) rgb[i] = gray[i / 3];
  return rgb;
}

std::vector<float> read_depth(const Path& file, int width, int height, double scale) {
  const auto input = open_image(file);
  require_size(file, input->spec(), width, height);
  if (input->spec().format != OIIO::TypeDesc::UINT16)
    throw InputError(file.string(), "does not have 16 bits a pixel",
                     "write depth as 16-bit PNG, value x depth_scale = m");
  const std::vector<std::uint16_t> raw = read_pixels<std::uint16_t>(*input, file, OIIO::TypeDesc::UINT16, 1);
  std::vector<float> depth(raw.size());
  for (std::size_t i = 0; i < raw.size(); ++i) depth[i] = static_cast<float>(raw[i] * scale);
  return depth;
}

Image8 read_image8(const Path& file) {
  const auto input = open_image(file);
  const OIIO::ImageSpec& spec = input->spec();
  return {spec.width, spec.height, spec.nchannels,
          read_pixels<std::uint8_t>(*input, file, OIIO::TypeDesc::UINT8, spec.nchannels)};
}

void write_png(const Path& file, const Image8& image) {
  CHAINSPLAT_CHECK(image.pixels.size() == static_cast<std::size_t>(image.width) * image.height * image.channels,
                   file.string());
  OIIO::ImageSpec spec(image.width, image.height, image.channels, OIIO::TypeDesc::UINT8);
  spec.attribute("oiio:UnassociatedAlpha", 1);
  write_image(file, "png", spec, OIIO::TypeDesc::UINT8, image.pixels.data());
}

void write_depth_png(const Path& file, int width, int height, const std::vector<float>& meters, double scale) {
  CHAINSPLAT_CHECK(meters.size() == static_cast<std::size_t>(width) * height, file.string());
  constexpr double kLargest = 65535.0;  // of 16 bits; what does not fit is "none"
  std::vector<std::uint16_t> raw(meters.size());
  for (std::size_t i = 0; i < raw.size(); ++i) {
    const double value = std::round(meters[i] / scale);
    raw[i] = value > 0.0 && value <= kLargest ? static_cast<std::uint16_t>(value) : 0;
  }
  write_image(file, "png", OIIO::ImageSpec(width, height, 1, OIIO::TypeDesc::UINT16), OIIO::TypeDesc::UINT16,
              raw.data());
}

void write_depth_exr(const Path& file, int width, int height, const std::vector<float>& meters) {
  CHAINSPLAT_CHECK(meters.size() == static_cast<std::size_t>(width) * height, file.string());
  OIIO::ImageSpec spec(width, height, 1, OIIO::TypeDesc::FLOAT);
  spec.channelnames = {"Z"};  // OpenEXR's name for depth
  write_image(file, "openexr", spec, OIIO::TypeDesc::FLOAT, meters.data());
}

}  // namespace chainsplat::capture
