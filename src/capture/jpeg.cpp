#include "src/capture/jpeg.h"

#include <csetjmp>
#include <cstdio>
#include <cstdlib>

#include <jerror.h>
#include <jpeglib.h>

#include "chainsplat/encode.h"

namespace chainsplat::capture {

namespace {

// libjpeg ends a failed call by a function that must not return: it jumps back to where the call began.
struct Errors {
  jpeg_error_mgr manager{};
  std::jmp_buf begin{};
  bool damaged = false;  // there were warnings, and what is missing was filled in
};

void fail(j_common_ptr state) { std::longjmp(reinterpret_cast<Errors*>(state->err)->begin, 1); }

void note(j_common_ptr state, int level) {
  // a negative level is a warning; many cameras fill their frames up with a few bytes more
  if (level < 0 && state->err->msg_code != JWRN_EXTRANEOUS_DATA) reinterpret_cast<Errors*>(state->err)->damaged = true;
}

jpeg_error_mgr* prepare(Errors& errors) {
  jpeg_error_mgr* const manager = jpeg_std_error(&errors.manager);
  manager->error_exit = fail;
  manager->emit_message = note;
  return manager;
}

}  // namespace

bool read_jpeg(std::span<const std::uint8_t> bytes, int width, int height, Image8& rgb) {
  rgb.width = width, rgb.height = height, rgb.channels = 3;
  rgb.pixels.resize(static_cast<std::size_t>(width) * height * 3);
  Errors errors;
  jpeg_decompress_struct state{};
  state.err = prepare(errors);
  if (setjmp(errors.begin) != 0) {
    jpeg_destroy_decompress(&state);
    return false;
  }
  jpeg_create_decompress(&state);
  jpeg_mem_src(&state, bytes.data(), bytes.size());
  jpeg_read_header(&state, TRUE);
  const bool fits =
      state.image_width == static_cast<JDIMENSION>(width) && state.image_height == static_cast<JDIMENSION>(height);
  if (fits) {
    state.out_color_space = JCS_RGB;
    state.do_fancy_upsampling = FALSE;  // chroma as ycbcr.h has it
    jpeg_start_decompress(&state);
    while (state.output_scanline < state.output_height && !errors.damaged) {
      JSAMPROW row = &rgb.pixels[static_cast<std::size_t>(state.output_scanline) * width * 3];
      jpeg_read_scanlines(&state, &row, 1);
    }
  }
  jpeg_destroy_decompress(&state);
  return fits && !errors.damaged;
}

std::string jpeg(const Image8& image, int quality) {
  CHAINSPLAT_CHECK(image.width > 0 && image.height > 0 && (image.channels == 1 || image.channels == 3) &&
                       image.pixels.size() == static_cast<std::size_t>(image.width) * image.height * image.channels,
                   "an RGB or gray picture");
  Errors errors;
  jpeg_compress_struct state{};
  unsigned char* bytes = nullptr;  // libjpeg's, by malloc()
  unsigned long size = 0;
  state.err = prepare(errors);
  if (setjmp(errors.begin) != 0) {
    jpeg_destroy_compress(&state);
    std::free(bytes);  // NOLINT: it is libjpeg's
    throw WorkError("picture", "libjpeg cannot write it", "use a picture of at most 65,500 pixels a side");
  }
  jpeg_create_compress(&state);
  jpeg_mem_dest(&state, &bytes, &size);
  state.image_width = image.width;
  state.image_height = image.height;
  state.input_components = image.channels;
  state.in_color_space = image.channels == 3 ? JCS_RGB : JCS_GRAYSCALE;
  jpeg_set_defaults(&state);
  jpeg_set_quality(&state, quality, TRUE);
  jpeg_start_compress(&state, TRUE);
  const std::size_t row_size = static_cast<std::size_t>(image.width) * image.channels;
  while (state.next_scanline < state.image_height) {
    auto* row = const_cast<JSAMPROW>(&image.pixels[state.next_scanline * row_size]);  // which libjpeg only reads
    jpeg_write_scanlines(&state, &row, 1);
  }
  jpeg_finish_compress(&state);
  std::string out(reinterpret_cast<char*>(bytes), size);
  jpeg_destroy_compress(&state);
  std::free(bytes);  // NOLINT: it is libjpeg's
  return out;
}

}  // namespace chainsplat::capture
