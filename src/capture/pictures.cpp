#include "src/capture/pictures.h"

#include <algorithm>
#include <cmath>
#include <exception>

#include "src/capture/image_files.h"

namespace chainsplat::capture {

using math::Vector2;

namespace {

void require_frame(const ImageSource& video, bool got, int frame) {
  if (!got)
    throw InputError(video.file.string(),
                     "ends before frame " + std::to_string(frame) + " of " + std::to_string(video.frames),
                     "write the video again");
}

}  // namespace

double sample(const std::uint8_t* image, int width, int height, int channels, int channel, const Vector2& position) {
  const double x = std::clamp(position.x() - 0.5, 0.0, width - 1.0),
               y = std::clamp(position.y() - 0.5, 0.0, height - 1.0);
  const int x0 = static_cast<int>(x), y0 = static_cast<int>(y);
  const int x1 = std::min(x0 + 1, width - 1), y1 = std::min(y0 + 1, height - 1);
  const double fx = x - x0, fy = y - y0;
  const auto at = [&](int column, int row) {
    return static_cast<double>(image[(static_cast<std::size_t>(row) * width + column) * channels + channel]);
  };
  return (1 - fy) * ((1 - fx) * at(x0, y0) + fx * at(x1, y0)) + fy * ((1 - fx) * at(x0, y1) + fx * at(x1, y1));
}

void straight_color(const Camera& camera, const std::vector<std::uint8_t>& rgb, int x, int y, std::uint8_t* out) {
  const Vector2 position = distort(camera, center(x, y));
  for (int c = 0; c < 3; ++c)
    out[c] = static_cast<std::uint8_t>(std::lround(sample(rgb.data(), camera.width, camera.height, 3, c, position)));
}

std::vector<std::uint8_t> rgb_of(const CameraSource& source, int frame) {
  if (source.images.pictures) return (*source.images.pictures)[frame].pixels;
  return read_rgb(source.images.frame_file(frame), source.camera.width, source.camera.height);
}

std::vector<std::uint8_t> mask_of(const CameraSource& source, int frame) {
  if (source.masks->pictures) return (*source.masks->pictures)[frame].pixels;
  return read_mask(source.masks->frame_file(frame), source.camera.width, source.camera.height);
}

void next_frame(const CameraSource& source, const ImageSource& video, int frame, VideoReader& reader, Image8& out) {
  require_frame(video, reader.next(out), frame);
  if (out.width != source.camera.width || out.height != source.camera.height)
    throw InputError(video.file.string(),
                     "is " + std::to_string(out.width) + "x" + std::to_string(out.height) +
                         " pixels, the camera has " + std::to_string(source.camera.width) + "x" +
                         std::to_string(source.camera.height),
                     "correct width and height in capture.json or the video");
}

void skip_frames(const ImageSource& video, int first, VideoReader& reader) {
  for (int k = 0; k < first; ++k) require_frame(video, reader.skip(), k);
}

void for_each_in_parallel(std::int64_t count, const std::function<void(std::int64_t)>& body) {
  std::vector<std::exception_ptr> failures(static_cast<std::size_t>(count));
  core::parallel_for(count, [&](std::int64_t i) {
    try {
      body(i);
    } catch (...) {
      failures[i] = std::current_exception();
    }
  });
  for (const std::exception_ptr& failure : failures)
    if (failure) std::rethrow_exception(failure);
}

}  // namespace chainsplat::capture
