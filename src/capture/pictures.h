// src/capture/pictures.h - the pictures of a capture: decoded, of the right size, and without lens distortion.
#pragma once
#include <cstdint>
#include <functional>
#include "chainsplat/capture.h"
#include "src/capture/manifest.h"

namespace chainsplat::capture {

// The center of a pixel.
inline math::Vector2 center(int x, int y) { return {x + 0.5, y + 0.5}; }

// Returns the bilinear sample of a channel at a pixel position (centers at +0.5); outside the image, the value of the
// nearest pixel.
double sample(const std::uint8_t* image, int width, int height, int channels, int channel,
              const math::Vector2& position);
// Sets three numbers to the color of an undistorted pixel. `rgb`: the recorded picture.
void straight_color(const Camera& camera, const std::vector<std::uint8_t>& rgb, int x, int y, std::uint8_t* out);

// The picture and the mask of one frame, 3 and 1 bytes per pixel, from its file or from memory. Throw InputError.
std::vector<std::uint8_t> rgb_of(const CameraSource& source, int frame);
std::vector<std::uint8_t> mask_of(const CameraSource& source, int frame);

// Read the next frame of a video that a camera's images or masks are, or pass over all before `first`. Throw InputError
// where it ends before, and where a picture is not of the camera's size.
void next_frame(const CameraSource& source, const ImageSource& video, int frame, VideoReader& reader, Image8& out);
void skip_frames(const ImageSource& video, int first, VideoReader& reader);

// As core::parallel_for(), but throws the exception of the lowest index, so that messages do not depend on the threads.
void for_each_in_parallel(std::int64_t count, const std::function<void(std::int64_t)>& body);

}  // namespace chainsplat::capture
