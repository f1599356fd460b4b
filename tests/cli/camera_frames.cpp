// camera_frames CAPTURE CAMERA FOLDER: the frames of a capture's camera, the rope on black, as a live camera would send
// them: FOLDER/rgb (raw RGB24, one after another), FOLDER/y4m (the same in 4:2:2), FOLDER/yuyv and FOLDER/mjpg (each
// frame behind its length in bytes).
#include <OpenImageIO/filesystem.h>
#include <OpenImageIO/imageio.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <fstream>
#include <string>
#include <vector>

#include "chainsplat/capture.h"

using namespace chainsplat;

namespace {

void add_frame(std::ofstream& file, const std::vector<std::uint8_t>& bytes) {
  const auto size = static_cast<std::uint32_t>(bytes.size());
  file.write(reinterpret_cast<const char*>(&size), sizeof size);
  file.write(reinterpret_cast<const char*>(bytes.data()), size);
}

// BT.601, limited range; two neighbors share their chroma.
std::vector<std::uint8_t> yuyv(const capture::Image8& rgb) {
  const auto level = [](double value) { return static_cast<std::uint8_t>(std::lround(std::clamp(value, 0.0, 255.0))); };
  std::vector<std::uint8_t> out;
  for (std::size_t i = 0; i < rgb.pixels.size(); i += 6) {
    const std::uint8_t* const p = &rgb.pixels[i];
    const double red = 0.5 * (p[0] + p[3]), green = 0.5 * (p[1] + p[4]), blue = 0.5 * (p[2] + p[5]);
    const auto luma = [&](int at) { return level(16.0 + 0.25679 * p[at] + 0.50413 * p[at + 1] + 0.09791 * p[at + 2]); };
    out.insert(out.end(), {luma(0), level(128.0 - 0.14822 * red - 0.29099 * green + 0.43922 * blue), luma(3),
                           level(128.0 + 0.43922 * red - 0.36779 * green - 0.07143 * blue)});
  }
  return out;
}

// A frame of Y4M with the samples of `packed`.
std::string y4m(const std::vector<std::uint8_t>& packed) {
  std::string out = "FRAME\n";
  for (const auto& [first, step] : {std::pair<std::size_t, std::size_t>{0, 2}, {1, 4}, {3, 4}})
    for (std::size_t at = first; at < packed.size(); at += step) out += static_cast<char>(packed[at]);
  return out;
}

std::vector<std::uint8_t> jpeg(const capture::Image8& rgb) {
  std::vector<unsigned char> bytes;
  OIIO::Filesystem::IOVecOutput memory(bytes);
  const auto writer = OIIO::ImageOutput::create("jpg", &memory);
  OIIO::ImageSpec spec(rgb.width, rgb.height, 3, OIIO::TypeDesc::UINT8);
  spec["Compression"] = "jpeg:95";
  if (!writer->open("frame.jpg", spec) || !writer->write_image(OIIO::TypeDesc::UINT8, rgb.pixels.data()) ||
      !writer->close())
    throw WorkError("frame.jpg", writer->geterror(), "check OpenImageIO");
  return {bytes.begin(), bytes.end()};
}

}  // namespace

int main(int, char** argv) {
  capture::LoadOptions options;
  options.camera = argv[2];
  options.pixels = capture::Pixels::recorded;
  const capture::Capture recorded = capture::load(argv[1], options);
  const Path folder = argv[3];
  std::ofstream raw(folder / "rgb", std::ios::binary), packed(folder / "yuyv", std::ios::binary),
      compressed(folder / "mjpg", std::ios::binary), stream(folder / "y4m", std::ios::binary);
  stream << "YUV4MPEG2 W" << recorded.cameras[0].width << " H" << recorded.cameras[0].height << " F30:1 C422\n";
  for (const capture::PackedView& stored : recorded.views) {
    const capture::View view = capture::unpacked(stored);
    capture::Image8 whole{recorded.cameras[0].width, recorded.cameras[0].height, 3, {}};
    whole.pixels.assign(static_cast<std::size_t>(3) * whole.width * whole.height, 0);
    for (int y = 0; y < view.height; ++y)
      for (int x = 0; x < view.width; ++x)
        std::copy_n(&view.rgba[4 * (static_cast<std::size_t>(y) * view.width + x)], 3,
                    &whole.pixels[3 * (static_cast<std::size_t>(view.y0 + y) * whole.width + view.x0 + x)]);
    raw.write(reinterpret_cast<const char*>(whole.pixels.data()), static_cast<std::streamsize>(whole.pixels.size()));
    const std::vector<std::uint8_t> samples = yuyv(whole);
    add_frame(packed, samples);
    stream << y4m(samples);
    add_frame(compressed, jpeg(whole));
  }
  return raw && packed && compressed && stream ? 0 : 1;
}
