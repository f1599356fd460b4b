// src/capture/media.h - image files and compressed videos are read and written by shared libraries of the program's own,
// loaded at first use: OpenImageIO and libav bring some 330 further libraries, and most commands need none of them.
//
// chainsplat_images.so is src/capture/media/images.cpp, chainsplat_videos.so is src/capture/media/videos.cpp,
// chainsplat_pngs.so src/capture/media/pngs.cpp (src/core/own_library.h). The functions of their tables do what those of
// capture.h and image_files.h do that are named like them.
#pragma once
#include "chainsplat/capture.h"

namespace chainsplat::capture::media {

struct ImageLibrary {
  const char* version;  // of the program that it was built with
  std::vector<std::uint8_t> (*read_mask)(const Path& file, int width, int height);
  std::vector<std::uint8_t> (*read_rgb)(const Path& file, int width, int height);
  std::vector<float> (*read_depth)(const Path& file, int width, int height, double scale);
  Image8 (*read_image8)(const Path& file);
  void (*write_png)(const Path& file, const Image8& image);
  void (*write_depth_png)(const Path& file, int width, int height, const std::vector<float>& meters, double scale);
  void (*write_depth_exr)(const Path& file, int width, int height, const std::vector<float>& meters);
};

// The masks and depths of nearly every capture are PNG files of gray. Loading OpenImageIO for them takes longer (0.25 s)
// than reading all those of a short capture.
struct PlainPng {
  int width, height;
  int channels;  // 1: gray, 3: RGB
  int bytes;     // per channel: 1, or 2 in this machine's order
  int rows;      // the first ones, which are read
};

struct PngLibrary {
  const char* version;
  // False where the file is missing, damaged or anything but such a PNG without transparency or interlacing: the images'
  // library reads it then, or tells what is wrong. `pixels` gets the bytes of the rows.
  bool (*read)(const Path& file, const PlainPng& wanted, std::vector<std::uint8_t>& pixels);
};

struct Decoder;  // an opened video
struct Encoder;  // a video that is being written

struct VideoLibrary {
  const char* version;
  // `pipe`: the descriptor of what is open already, since a pipe cannot be opened again when its writer has ended; else
  // -1. It must stay open as long as the decoder.
  Decoder* (*open)(const Path& file, int pipe, int threads);
  void (*close)(Decoder* decoder);
  bool (*next)(Decoder& decoder, Image8* rgb);  // null: without the conversion to RGB
  int (*frames)(const Decoder& decoder);
  double (*rate)(const Decoder& decoder);
  double (*time)(const Decoder& decoder);
  VideoFacts (*video_facts)(const Path& file);
  Encoder* (*create)(const Path& file, double rate);
  void (*add)(Encoder& encoder, const Image8& frame);
  void (*finish)(Encoder& encoder);
  void (*discard)(Encoder* encoder);  // removes the file where it is not finished
};

extern "C" {
extern const ImageLibrary chainsplat_images;
extern const PngLibrary chainsplat_pngs;
extern const VideoLibrary chainsplat_videos;
}

}  // namespace chainsplat::capture::media
