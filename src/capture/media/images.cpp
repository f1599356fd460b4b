// Single images with OpenImageIO's ImageInput and ImageOutput, without its cache.
#include <OpenImageIO/imageio.h>
#include <unistd.h>

#include <cmath>
#include <filesystem>
#include <fstream>
#include <memory>
#include <string>
#include <string_view>

#include "src/capture/media.h"
#include "src/capture/media/damage.h"

namespace chainsplat::capture::media {

namespace {

// Returns the name of OpenImageIO's reader for the format that the file's first bytes show, or null for another format.
// Without a name OpenImageIO tries all its readers, and some pass the file to libraries that open any other file or
// address it names.
const char* format_of(const Path& file) {
  struct Start {
    std::string_view bytes;
    const char* format;
  };
  using namespace std::string_view_literals;
  constexpr Start kStarts[] = {{"\x89PNG\r\n\x1a\n"sv, "png"},
                               {"\xff\xd8\xff"sv, "jpeg"},
                               {"BM"sv, "bmp"},
                               {"II\x2a\0"sv, "tiff"},
                               {"MM\0\x2a"sv, "tiff"},
                               {"II\x2b\0"sv, "tiff"},
                               {"MM\0\x2b"sv, "tiff"},
                               {"\x76\x2f\x31\x01"sv, "openexr"},
                               {"P2"sv, "pnm"},
                               {"P3"sv, "pnm"},
                               {"P5"sv, "pnm"},
                               {"P6"sv, "pnm"},
                               {"RIFF"sv, "webp"}};
  char bytes[8] = {};
  std::ifstream stream(file, std::ios::binary);
  stream.read(bytes, sizeof bytes);
  const std::string_view begin(bytes, static_cast<std::size_t>(stream.gcount()));
  for (const Start& start : kStarts)
    if (begin.starts_with(start.bytes)) return start.format;
  return nullptr;
}

std::unique_ptr<OIIO::ImageInput> open_image(const Path& file) {
  std::error_code error;
  if (!std::filesystem::exists(file, error))
    throw InputError(file.string(), "does not exist", "check the path and the frame numbers");
  if (!std::filesystem::is_regular_file(file, error))  // reading a pipe might never end
    throw InputError(file.string(), "is not a file", "check the path and the frame numbers");
  if (const std::string damage = damage_of_png(file); !damage.empty())
    throw InputError(file.string(), damage, "write it again");
  if (const std::string damage = damage_of_exr(file); !damage.empty())
    throw InputError(file.string(), damage, "write it again");
  OIIO::ImageSpec options;
  options.attribute("oiio:UnassociatedAlpha", 1);  // keep colors as stored, not multiplied by alpha
  const char* const format = format_of(file);
  auto input = format ? OIIO::ImageInput::create(format) : nullptr;
  OIIO::ImageSpec spec;
  if (!input || !input->open(file.string(), spec, options)) {
    OIIO::geterror();  // discarded, because its text names plugins and internals instead of the user's mistake
    if (input) input->geterror();
    throw InputError(file.string(), "is not a readable image", "write it again as PNG");
  }
  if (spec.width < 1 || spec.height < 1 || spec.depth > 1 || spec.deep || spec.nchannels < 1 ||
      spec.nchannels > kMostChannels || std::max(spec.width, spec.height) > kMostSide ||
      static_cast<std::int64_t>(spec.width) * spec.height > kMostPixels)
    throw InputError(file.string(),
                     "claims " + std::to_string(spec.width) + "x" + std::to_string(spec.height) + "x" +
                         std::to_string(spec.depth) + " pixels of " + std::to_string(spec.nchannels) + " channels",
                     "write it again as PNG of at most " + std::to_string(kMostPixels >> 20) + " million pixels, " +
                         std::to_string(kMostSide) + " a side");
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
  // with the file's own format OpenImageIO reads in place, otherwise through a buffer of 64 MB per image
  if (spec.format == type && spec.nchannels == channels) type = OIIO::TypeDesc::UNKNOWN;
  if (!input.read_image(0, 0, 0, channels, type, pixels.data())) {
    input.geterror();
    throw InputError(file.string(), "is damaged or cut off", "write it again");
  }
  return pixels;
}

// Writes an image under a temporary name and renames it, so that a reader never sees half a file.
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
  // no camera gives the expected size here, so the total is bounded
  if (static_cast<std::int64_t>(spec.width) * spec.height * spec.nchannels > kMostPixels)
    throw InputError(
        file.string(),
        "claims " + size_text(spec.width, spec.height) + " pixels of " + std::to_string(spec.nchannels) + " channels",
        "write it again with fewer");
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
  constexpr double kLargest = 65535.0;  // of 16 bits; depths that do not fit are written as none
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
  spec.channelnames = {"Z"};  // OpenEXR's name of depth
  write_image(file, "openexr", spec, OIIO::TypeDesc::FLOAT, meters.data());
}

// A quality of 1 to 100.
}  // namespace

const ImageLibrary chainsplat_images = {.version = CHAINSPLAT_VERSION,
                                        .read_mask = read_mask,
                                        .read_rgb = read_rgb,
                                        .read_depth = read_depth,
                                        .read_image8 = read_image8,
                                        .write_png = write_png,
                                        .write_depth_png = write_depth_png,
                                        .write_depth_exr = write_depth_exr};

}  // namespace chainsplat::capture::media
