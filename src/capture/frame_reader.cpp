// Whole frames of one camera, from a video or from image files, one after the other.
#include <algorithm>
#include <utility>

#include "src/capture/manifest.h"
#include "src/capture/pictures.h"

namespace chainsplat::capture {

struct FrameReader::Implementation {
  CameraSource source;
  bool undistorting = false;
  int following = 0, last = 0;  // frames that are still to be read
  std::optional<VideoReader> video;
  std::vector<Frame> ready;  // the last is the next
  void read_some();
  void straighten(Image8& picture) const;
};

void FrameReader::Implementation::straighten(Image8& picture) const {
  const std::vector<std::uint8_t> recorded = std::exchange(picture.pixels, std::vector<std::uint8_t>(picture.pixels.size()));
  for (int y = 0; y < picture.height; ++y)
    for (int x = 0; x < picture.width; ++x)
      straight_color(source.camera, recorded, x, y,
                     &picture.pixels[3 * (static_cast<std::size_t>(y) * picture.width + x)]);
}

// As many frames as there are threads: image files are decoded, and all are undistorted, in parallel.
void FrameReader::Implementation::read_some() {
  const int count = std::min(core::threads(), last - following);
  ready.resize(count);
  for (int k = 0; k < count; ++k) {
    Frame& frame = ready[count - 1 - k];
    frame.frame = following + k;
    frame.time = source.times[frame.frame];
    if (video) next_frame(source, source.images, frame.frame, *video, frame.picture);
  }
  if (!video || undistorting)
    for_each_in_parallel(count, [&](std::int64_t k) {
      Frame& frame = ready[count - 1 - k];
      if (!video)
        frame.picture = {source.camera.width, source.camera.height, 3, rgb_of(source, frame.frame)};
      if (undistorting) straighten(frame.picture);
    });
  following += count;
}

FrameReader::FrameReader(const Path& capture, const std::string& camera, const FrameRange& frames, Pixels pixels)
    : implementation_(std::make_unique<Implementation>()) {
  Implementation& i = *implementation_;
  constexpr bool kMasked = false;
  Findings findings;
  Manifest manifest = read_manifest(capture, camera, kMasked, findings);
  throw_first(findings);  // doubts are told by load(), from which the caller knows the camera
  i.source = std::move(manifest.cameras.front());
  i.undistorting = pixels == Pixels::undistorted && i.source.camera.distorted();
  i.last = frames.last < 0 ? i.source.images.frames : std::min(frames.last, i.source.images.frames);
  i.following = std::clamp(frames.first, 0, i.last);
  if (!i.source.images.video || i.following == i.last) return;
  i.video.emplace(i.source.images.file, core::threads());
  skip_frames(i.source.images, i.following, *i.video);
}

FrameReader::~FrameReader() = default;
FrameReader::FrameReader(FrameReader&&) noexcept = default;
FrameReader& FrameReader::operator=(FrameReader&&) noexcept = default;

std::optional<Frame> FrameReader::next() {
  std::vector<Frame>& ready = implementation_->ready;
  if (ready.empty()) implementation_->read_some();
  if (ready.empty()) return std::nullopt;
  Frame frame = std::move(ready.back());
  ready.pop_back();
  return frame;
}

}  // namespace chainsplat::capture
