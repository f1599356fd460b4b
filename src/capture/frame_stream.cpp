#include "src/capture/frame_stream.h"

#include <fcntl.h>
#include <poll.h>
#include <sys/stat.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <charconv>
#include <cmath>
#include <cstring>
#include <limits>
#include <string_view>

#include "src/capture/ycbcr.h"

namespace chainsplat::capture {

namespace {

constexpr std::string_view kMagic = "YUV4MPEG2 ";
constexpr std::string_view kFrame = "FRAME";
constexpr std::size_t kLongestLine = 1024;  // bytes; programs write up to 100

// How a stream's header names its samples.
struct Samples {
  std::string_view name;
  int across, down;  // as YCbCr has them
  bool gray;
};
constexpr Samples kSamples[] = {{"420jpeg", 1, 1, false}, {"420mpeg2", 1, 1, false}, {"420paldv", 1, 1, false},
                                {"420", 1, 1, false},     {"422", 1, 0, false},      {"444", 0, 0, false},
                                {"411", 2, 0, false},     {"mono", 0, 0, true}};
constexpr std::string_view kUnsaid = "420jpeg";  // where the header names none

const Samples* find_samples(std::string_view name) {
  const auto* const found = std::ranges::find(kSamples, name, &Samples::name);
  return found == std::end(kSamples) ? nullptr : found;
}

// Calls use(letter, value) for each parameter of a header, as in "W640 H480 F30:1 C420jpeg".
template <class Use>
void for_each_parameter(std::string_view line, const Use& use) {
  while (!line.empty()) {
    const std::string_view word = line.substr(0, line.find(' '));
    if (!word.empty()) use(word[0], word.substr(1));
    line.remove_prefix(std::min(word.size() + 1, line.size()));
  }
}

// The whole number that a text is; none where it is another text or does not fit.
std::optional<int> whole(std::string_view text) {
  int value = 0;
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), value);
  if (error != std::errc{} || end != text.data() + text.size()) return std::nullopt;
  return value;
}

// "30000:1001" in frames per second; 0 where it says nothing.
double rate_of(std::string_view text) {
  const std::size_t colon = std::min(text.find(':'), text.size());
  const int over = whole(text.substr(0, colon)).value_or(0);
  const int under = colon < text.size() ? whole(text.substr(colon + 1)).value_or(0) : 0;
  return over > 0 && under > 0 ? static_cast<double>(over) / under : 0.0;
}

// The first bytes of a file or pipe, which stay to be read. Of a pipe they are copied into another one.
std::string first_bytes(int file) {
  std::array<char, kLongestLine> bytes{};
  struct stat facts {};
  ssize_t count = -1;
  if (::fstat(file, &facts) == 0 && S_ISFIFO(facts.st_mode)) {
    int ends[2];
    if (::pipe2(ends, O_CLOEXEC) != 0) return {};
    const Descriptor out(ends[0]), in(ends[1]);
    if (::tee(file, in.number(), bytes.size(), 0) > 0) count = ::read(out.number(), bytes.data(), bytes.size());
  } else {
    count = ::pread(file, bytes.data(), bytes.size(), 0);
  }
  return {bytes.data(), static_cast<std::size_t>(std::max<ssize_t>(0, count))};
}

}  // namespace

bool is_y4m(int file) {
  const std::string bytes = first_bytes(file);
  std::string_view line = bytes;
  if (!line.starts_with(kMagic)) return false;
  line = line.substr(0, line.find('\n'));
  std::string_view name = kUnsaid;
  for_each_parameter(line, [&](char letter, std::string_view value) {
    if (letter == 'C') name = value;
  });
  return find_samples(name) != nullptr;
}

FrameStream::FrameStream(Descriptor file, const std::string& where, int width, int height)
    : file_(std::move(file)), where_(where), width_(width), height_(height) {}

// Reads what the stream begins with, once.
void FrameStream::begin() {
  if (begun_) return;
  std::vector<std::uint8_t> bytes;
  bytes.resize(read(bytes, kMagic.size()));
  bare_ = !std::ranges::equal(bytes, kMagic);
  if (!bare_) read_header(read_line(kLongestLine));
  if (bare_ && (width_ <= 0 || height_ <= 0)) refuse("is no Y4M stream", "write it again");
  if (bare_) ahead_ = std::move(bytes);
  begun_ = true;
}

double FrameStream::rate() {
  begin();
  return rate_;
}

double FrameStream::time() const {
  return rate_ > 0.0 && frames_ > 0 ? (frames_ - 1) / rate_ : std::numeric_limits<double>::quiet_NaN();
}

void FrameStream::refuse(const std::string& problem, const std::string& mend) const {
  throw InputError(where_, problem, mend);
}

// Reads until there are `size` bytes or the input ends, and returns how many there are. The memory grows with what
// comes, because a header may claim any size.
std::size_t FrameStream::read(std::vector<std::uint8_t>& bytes, std::size_t size) {
  constexpr int kAttention = 50;                        // ms, to a request to stop
  constexpr std::size_t kChunk = std::size_t{1} << 20;  // bytes by which the memory grows
  const std::size_t known = std::min(ahead_.size(), size);
  if (known > 0) {
    const auto end = ahead_.begin() + static_cast<std::ptrdiff_t>(known);
    bytes.assign(ahead_.begin(), end);
    ahead_.erase(ahead_.begin(), end);
  }
  std::size_t got = known;
  while (got < size) {
    core::stop_if_requested();
    pollfd input{file_.number(), POLLIN, 0};
    if (::poll(&input, 1, kAttention) <= 0) continue;
    if (bytes.size() < size) bytes.resize(std::min(size, got + kChunk));
    const ssize_t count = ::read(file_.number(), &bytes[got], std::min(bytes.size(), size) - got);
    if (count < 0 && errno != EINTR && errno != EAGAIN)
      throw WorkError(where_, std::string("cannot be read (") + std::strerror(errno) + ")",
                      "check where it comes from");
    if (count == 0) break;
    got += static_cast<std::size_t>(std::max<ssize_t>(0, count));
  }
  return got;
}

// Reads up to the end of a line, which is not a part of it.
std::string FrameStream::read_line(std::size_t most) {
  std::string line;
  std::vector<std::uint8_t> byte;
  while (line.size() < most && read(byte, 1) == 1) {
    if (byte[0] == '\n') return line;
    line += static_cast<char>(byte[0]);
  }
  refuse("has a Y4M header without an end", "write the stream again");
}

void FrameStream::read_header(const std::string& line) {
  width_ = height_ = 0;
  std::string_view name = kUnsaid;
  for_each_parameter(line, [&](char letter, std::string_view value) {
    if (letter == 'W') width_ = whole(value).value_or(0);
    if (letter == 'H') height_ = whole(value).value_or(0);
    if (letter == 'F') rate_ = rate_of(value);
    if (letter == 'C') name = value;
    if (letter == 'X' && value == "COLORRANGE=FULL") full_ = true;
  });
  if (width_ <= 0 || height_ <= 0) refuse("has a Y4M header without width and height", "write the stream again");
  if (static_cast<std::int64_t>(width_) * height_ > kMostPixels)
    refuse("claims frames of " + std::to_string(width_) + "x" + std::to_string(height_) + " pixels",
           "write the stream again");
  const Samples* const samples = find_samples(name);
  if (!samples)
    refuse("has Y4M samples of the kind '" + std::string(name) + "'",
           "send 8 bits, for example by 'ffmpeg -i VIDEO -pix_fmt yuv420p -f yuv4mpegpipe -'");
  across_ = samples->across, down_ = samples->down, gray_ = samples->gray;
}

// Reads the line before a frame's samples. Returns false at the end of the stream.
bool FrameStream::begin_frame() {
  std::vector<std::uint8_t> begin;
  const std::size_t got = read(begin, kFrame.size() + 1);
  if (got == 0) return false;
  const bool whole_word = got > kFrame.size() && std::memcmp(begin.data(), kFrame.data(), kFrame.size()) == 0;
  const bool ends = whole_word && begin.back() == '\n';
  if (!ends && !(whole_word && begin.back() == ' '))
    refuse("frame " + std::to_string(frames_) + " does not begin as one of Y4M does", "write the stream again");
  if (!ends) read_line(kLongestLine);  // parameters of a frame, which nothing here depends on
  return true;
}

bool FrameStream::next(Image8* rgb) {
  begin();
  if (!bare_ && !begin_frame()) return false;
  const auto shrunk = [](int size, int by) { return static_cast<std::size_t>((size + (1 << by) - 1) >> by); };
  const std::size_t pixels = static_cast<std::size_t>(width_) * height_;
  const std::size_t chroma_row = gray_ ? 0 : shrunk(width_, across_);
  const std::size_t chroma = chroma_row * shrunk(height_, down_);
  const std::size_t size = bare_ ? 3 * pixels : pixels + 2 * chroma;
  std::vector<std::uint8_t>& bytes = bare_ && rgb ? rgb->pixels : samples_;
  const std::size_t got = read(bytes, size);
  if (bare_ && got == 0) return false;
  if (got < size)
    refuse("ends within a frame", bare_ ? "send whole frames of the calibration's size" : "write the stream again");
  ++frames_;
  if (!rgb) return true;
  if (bare_) {
    rgb->width = width_, rgb->height = height_, rgb->channels = 3;
    rgb->pixels.resize(size);
    return true;
  }
  YCbCr from;
  from.luma = samples_.data();
  if (!gray_) from.cb = from.luma + pixels, from.cr = from.cb + chroma;
  from.luma_row = width_, from.chroma_row = chroma_row;
  from.across = across_, from.down = down_;
  from.full = full_;
  to_rgb(from, width_, height_, *rgb);
  return true;
}

}  // namespace chainsplat::capture
