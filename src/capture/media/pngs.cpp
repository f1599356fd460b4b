// Plain PNG files with libpng.
#include <png.h>

#include <csetjmp>
#include <cstdio>
#include <memory>

#include "src/capture/media.h"

namespace chainsplat::capture::media {

namespace {

struct Close {
  void operator()(std::FILE* file) const { std::fclose(file); }
};

// libpng's objects, released on every way out.
struct Reader {
  png_structp png = nullptr;
  png_infop info = nullptr;
  explicit Reader(png_error_ptr error)
      : png(png_create_read_struct(PNG_LIBPNG_VER_STRING, nullptr, error, [](png_structp, png_const_charp) {})) {
    if (png) info = png_create_info_struct(png);
  }
  Reader(const Reader&) = delete;
  Reader& operator=(const Reader&) = delete;
  ~Reader() { png_destroy_read_struct(&png, &info, nullptr); }
};

bool is_plain(png_structp png, png_infop info, const PlainPng& wanted) {
  const int color = wanted.channels == 1 ? PNG_COLOR_TYPE_GRAY : PNG_COLOR_TYPE_RGB;
  return png_get_image_width(png, info) == static_cast<png_uint_32>(wanted.width) &&
         png_get_image_height(png, info) == static_cast<png_uint_32>(wanted.height) &&
         png_get_color_type(png, info) == color && png_get_bit_depth(png, info) == 8 * wanted.bytes &&
         png_get_interlace_type(png, info) == PNG_INTERLACE_NONE && png_get_valid(png, info, PNG_INFO_tRNS) == 0;
}

// An error in libpng jumps back to setjmp: nothing in between may need to be destroyed.
bool decode(Reader& reader, std::FILE* file, const PlainPng& wanted, std::vector<std::uint8_t>& pixels) {
  if (setjmp(png_jmpbuf(reader.png)) != 0) return false;  // NOLINT: libpng's way
  png_init_io(reader.png, file);
  // Every chunk has a checksum of its own, which is compared; the one of all data together adds nothing but time.
  png_set_crc_action(reader.png, PNG_CRC_ERROR_QUIT, PNG_CRC_ERROR_QUIT);
  png_set_option(reader.png, PNG_IGNORE_ADLER32, PNG_OPTION_ON);
  png_read_info(reader.png, reader.info);
  if (!is_plain(reader.png, reader.info, wanted)) return false;
  if (wanted.bytes == 2) png_set_swap(reader.png);  // to this machine's order
  const std::size_t row = static_cast<std::size_t>(wanted.width) * wanted.channels * wanted.bytes;
  pixels.resize(row * wanted.rows);  // not earlier: what a capture claims of its images may be far too large
  for (int y = 0; y < wanted.rows; ++y) png_read_row(reader.png, pixels.data() + y * row, nullptr);
  if (wanted.rows == wanted.height) png_read_end(reader.png, nullptr);  // or a file that is cut off would pass
  return true;
}

bool read(const Path& path, const PlainPng& wanted, std::vector<std::uint8_t>& pixels) {
  std::error_code error;
  if (!std::filesystem::is_regular_file(path, error)) return false;  // reading a pipe might never end
  const std::unique_ptr<std::FILE, Close> file(std::fopen(path.c_str(), "rb"));
  Reader reader([](png_structp png, png_const_charp) { png_longjmp(png, 1); });
  return file && reader.info && decode(reader, file.get(), wanted, pixels);
}

}  // namespace

const PngLibrary chainsplat_pngs = {.version = CHAINSPLAT_VERSION, .read = read};

}  // namespace chainsplat::capture::media
