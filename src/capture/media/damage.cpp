#include "src/capture/media/damage.h"

#include <zlib.h>

#include <cstdint>
#include <filesystem>
#include <fstream>
#include <string_view>
#include <vector>

namespace chainsplat::capture::media {

namespace {

constexpr std::size_t kExrChannelLength = 16;  // bytes of a channel in an EXR's list of them, after its name

std::uint32_t little_endian(std::string_view bytes) {
  std::uint32_t value = 0;
  for (int i = 3; i >= 0; --i) value = value << 8u | static_cast<unsigned char>(bytes[static_cast<std::size_t>(i)]);
  return value;
}

// Returns whether OpenEXR reads exactly `bytes` as an attribute of this type. Of most types it reads what the type has,
// whatever length the file gives, and goes on behind that; texts and previews are as long as they say themselves.
bool is_sound_attribute(const std::string& type, std::string_view bytes) {
  struct Fixed {
    std::size_t length;  // bytes
    std::string_view types;
  };
  static constexpr Fixed kFixed[] = {{1, " compression deepImageState envmap lineOrder "},
                                     {4, " float int "},
                                     {8, " double rational timecode v2f v2i "},
                                     {9, " tiledesc "},
                                     {12, " v3f v3i "},
                                     {16, " box2f box2i v2d "},
                                     {24, " v3d "},
                                     {28, " keycode "},
                                     {32, " chromaticities "},
                                     {36, " m33f "},
                                     {64, " m44f "},
                                     {72, " m33d "},
                                     {128, " m44d "}};
  for (const Fixed& fixed : kFixed)
    if (fixed.types.find(" " + type + " ") != std::string_view::npos) return bytes.size() == fixed.length;
  if (type == "chlist") {
    // the list ends with an empty name
    while (!bytes.empty() && bytes[0] != '\0') {
      const std::size_t end = bytes.find('\0');
      if (end == std::string_view::npos || bytes.size() - end <= kExrChannelLength) return false;
      bytes.remove_prefix(end + 1 + kExrChannelLength);
    }
    return bytes.size() == 1;
  }
  if (type == "preview") {  // width, height, four bytes a pixel
    if (bytes.size() < 8) return false;
    return 8 + 4 * std::uint64_t{little_endian(bytes)} * little_endian(bytes.substr(4)) == bytes.size();
  }
  if (type == "stringvector") {
    while (bytes.size() >= 4 && little_endian(bytes) <= bytes.size() - 4) bytes.remove_prefix(4 + little_endian(bytes));
    return bytes.empty();
  }
  return true;
}

// Returns what in a sound attribute would make OpenEXR ask for more memory than any image here needs, or an empty text.
std::string excess_of_attribute(const std::string& name, const std::string& type, std::string_view bytes) {
  const auto number = [&](std::size_t at) {
    return std::int64_t{static_cast<std::int32_t>(little_endian(bytes.substr(at)))};
  };
  const auto excess = [](const char* what, std::int64_t width, std::int64_t height) {
    const bool small =
        width >= 1 && height >= 1 && width <= kMostSide && height <= kMostSide && width * height <= kMostPixels;
    return small ? ""
                 : "claims " + std::string(what) + " of " + std::to_string(width) + "x" + std::to_string(height) +
                       " pixels";
  };
  if (name == "dataWindow" && type == "box2i")  // first and last column and row
    return excess("an image", number(8) - number(0) + 1, number(12) - number(4) + 1);
  if (type == "tiledesc") return excess("tiles", number(0), number(4));
  if (type == "chlist") {
    std::size_t channels = 0;
    for (std::size_t at = 0; bytes[at] != '\0'; at = bytes.find('\0', at) + 1 + kExrChannelLength) ++channels;
    if (channels > kMostChannels) return "claims " + std::to_string(channels) + " channels";
  }
  return "";
}

}  // namespace

// libpng would print a line of its own.
std::string damage_of_png(const Path& file) {
  std::ifstream stream(file, std::ios::binary);
  constexpr std::string_view kSignature = "\x89PNG\r\n\x1a\n";
  constexpr std::uint32_t kLargestSide = 1u << 15;  // px, the same as for capture.json
  constexpr const char* kCutOff = "is cut off";
  char start[8] = {};
  if (!stream.read(start, sizeof start) || std::string_view(start, sizeof start) != kSignature) return "";
  const auto number = [&stream] {
    unsigned char b[4] = {};
    stream.read(reinterpret_cast<char*>(b), sizeof b);
    return std::uint32_t{b[0]} << 24u | std::uint32_t{b[1]} << 16u | std::uint32_t{b[2]} << 8u | b[3];
  };
  constexpr std::uint64_t kMostInflated = 1032;  // bytes that one byte of deflate's can become
  std::error_code error;
  const std::uintmax_t at_most = std::filesystem::file_size(file, error);
  std::uint64_t needed = 0, compressed = 0;  // bytes of the rows, and of what they are to be made from
  for (std::vector<char> chunk;;) {  // each chunk has its length, name, data and the checksum of name and data
    const std::uint32_t length = number();
    if (!stream || length > at_most) return kCutOff;
    chunk.resize(length + 4);
    if (!stream.read(chunk.data(), static_cast<std::streamsize>(chunk.size()))) return kCutOff;
    const std::uint32_t sum = number();
    if (!stream) return kCutOff;
    if (::crc32(0, reinterpret_cast<const Bytef*>(chunk.data()), static_cast<uInt>(chunk.size())) != sum)
      return "is damaged";
    const std::string_view name(chunk.data(), 4);
    if (name == "IHDR" && length >= 10) {
      const auto byte = [&](std::size_t at) { return std::uint32_t{static_cast<unsigned char>(chunk[at])}; };
      const auto side = [&](std::size_t at) {
        return byte(at) << 24u | byte(at + 1) << 16u | byte(at + 2) << 8u | byte(at + 3);
      };
      const std::uint32_t width = side(4), height = side(8), bits = byte(12), color = byte(13);
      for (const std::uint32_t one : {width, height})
        if (one == 0 || one > kLargestSide) return "claims a side of " + std::to_string(one) + " pixels";
      const std::uint64_t channels = (color & 1u) != 0 ? 1 : 1 + (color & 2u) + (color >> 2u & 1u);
      needed = height * ((width * channels * bits + 7) / 8);
    }
    if (name == "IDAT") compressed += length;
    if (name == "IEND") return compressed * kMostInflated < needed ? "has less data than pixels" : "";
  }
}

std::string damage_of_exr(const Path& file) {
  std::ifstream stream(file, std::ios::binary);
  constexpr std::string_view kSignature = "\x76\x2f\x31\x01";
  constexpr unsigned kManyParts = 0x10;  // in the version's second byte: headers follow each other up to an empty one
  const std::string damaged = "is damaged";
  char start[8] = {};  // signature and version
  if (!stream.read(start, sizeof start) || !std::string_view(start, sizeof start).starts_with(kSignature)) return "";
  const bool many_parts = static_cast<unsigned char>(start[5]) & kManyParts;
  std::error_code error;
  const std::uintmax_t at_most = std::filesystem::file_size(file, error);
  bool empty = false;
  do {
    empty = true;
    for (std::string name, type; std::getline(stream, name, '\0') && !name.empty();) {
      empty = false;
      char b[4] = {};
      if (!std::getline(stream, type, '\0') || !stream.read(b, sizeof b)) return damaged;
      const std::uint32_t length = little_endian({b, sizeof b});
      if (length > at_most) return damaged;
      std::string bytes(length, '\0');
      if (!stream.read(bytes.data(), length) || !is_sound_attribute(type, bytes)) return damaged;
      if (const std::string excess = excess_of_attribute(name, type, bytes); !excess.empty()) return excess;
    }
  } while (many_parts && !empty && stream);
  return stream ? "" : damaged;  // the file ends before its header does
}

}  // namespace chainsplat::capture::media
