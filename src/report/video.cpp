// video.cpp - what a camera saw, as small JPEG pictures.
#include <algorithm>

#include "chainsplat/encode.h"
#include "chainsplat/render.h"
#include "chainsplat/report.h"

namespace chainsplat::report {

namespace {

constexpr int kWidth = 480;         // px, at most: a phone's, and half of a usual camera's
constexpr int kMostPictures = 300;  // 10 s at 30 Hz; longer recordings lose frames evenly
constexpr int kQuality = 60;        // of JPEG: about 8 kB for 480 x 360

// A picture with its sides divided by `shrink`, every pixel the mean of what it covers.
capture::Image8 shrunk(const capture::Image8& picture, int shrink) {
  capture::Image8 out{picture.width / shrink, picture.height / shrink, 3, {}};
  out.pixels.resize(3u * out.width * out.height);
  for (int y = 0; y < out.height; ++y)
    for (int x = 0; x < out.width; ++x)
      for (int c = 0; c < 3; ++c) {
        int sum = 0;
        for (int dy = 0; dy < shrink; ++dy)
          for (int dx = 0; dx < shrink; ++dx)
            sum +=
                picture.pixels[3 * (static_cast<std::size_t>(y * shrink + dy) * picture.width + x * shrink + dx) + c];
        out.pixels[3 * (static_cast<std::size_t>(y) * out.width + x) + c] =
            static_cast<std::uint8_t>((sum + shrink * shrink / 2) / (shrink * shrink));
      }
  return out;
}

}  // namespace

Video read_video(const Path& capture, const std::string& camera, const twin::Twin& twin) {
  capture::LoadOptions load;
  load.images = false;
  load.camera = camera;
  capture::Capture facts = capture::load(capture, load);
  capture::apply(twin.corrections, facts);
  const capture::Camera& seen = facts.cameras.front();
  const std::vector<double>& times = facts.times.front();
  const double interval = render::median_interval(times);
  const int frames = static_cast<int>(times.size());
  const int every = (frames + kMostPictures - 1) / kMostPictures, shrink = (seen.width + kWidth - 1) / kWidth;
  Video out;
  out.camera = seen.name;
  capture::FrameReader reader(capture, seen.name, {}, capture::Pixels::undistorted);
  while (const std::optional<capture::Frame> frame = reader.next()) {
    core::stop_if_requested();
    const double time = times[frame->frame];
    if (frame->frame % every != 0 || !render::covered(twin.states, time, interval)) continue;
    out.times.push_back(time);
    out.jpegs.push_back(capture::jpeg(shrunk(frame->picture, shrink), kQuality));
  }
  return out;
}

}  // namespace chainsplat::report
