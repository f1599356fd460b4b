// src/capture/frame_stream.h - frames that are not compressed, from a file or a pipe: Y4M (YUV4MPEG2), or bare RGB24.
#pragma once
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "chainsplat/capture.h"
#include "src/capture/descriptor.h"

namespace chainsplat::capture {

// Whether an opened file or pipe begins as Y4M with samples that FrameStream knows, all of 8 bits. Nothing of it is
// consumed; waits until a pipe has some bytes.
bool is_y4m(int file);

class FrameStream {
 public:
  // `where`: for messages. A stream that does not begin as Y4M has RGB24 frames of `width` x `height`, where these are
  // not 0. Nothing is read yet, since who sends may wait until this program is ready.
  FrameStream(Descriptor file, const std::string& where, int width = 0, int height = 0);
  // Both throw InputError, and Interrupted where a stop is requested while they wait.
  bool next(Image8* rgb);  // false at the end; null: without the conversion to RGB
  double rate();           // frames per second by the stream's header, 0 when unknown
  int frames() const { return frames_; }
  double time() const;                  // s, of the last frame by the stream's rate; NaN when unknown
  int width() const { return width_; }  // once a frame was read, as the height
  int height() const { return height_; }

 private:
  std::size_t read(std::vector<std::uint8_t>& bytes, std::size_t size);
  std::string read_line(std::size_t most);
  void begin();
  void read_header(const std::string& line);
  bool begin_frame();
  [[noreturn]] void refuse(const std::string& problem, const std::string& mend) const;

  Descriptor file_;
  std::string where_;
  std::vector<std::uint8_t> ahead_;  // bytes that are read and still to be handed out
  std::vector<std::uint8_t> samples_;
  bool begun_ = false, bare_ = false, gray_ = false, full_ = false;
  int across_ = 0, down_ = 0;  // of chroma, as YCbCr has them
  int width_ = 0, height_ = 0, frames_ = 0;
  double rate_ = 0.0;
};

}  // namespace chainsplat::capture
