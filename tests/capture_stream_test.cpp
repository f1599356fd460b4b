// Frames that are not compressed: Y4M against what libav makes of it, and streams that are not what they claim.
#include <doctest/doctest.h>
#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <fstream>
#include <string>
#include <thread>
#include <vector>

#include "chainsplat/capture.h"
#include "error_of.h"
#include "src/capture/frame_stream.h"
#include "src/capture/media.h"
#include "src/core/own_library.h"

namespace chainsplat {
namespace {

using capture::Image8;
using test::contains;
using test::error_of;

struct StreamFolder {  // a folder of this test, removed at the end
  Path path = std::filesystem::temp_directory_path() / ("chainsplat_stream_test_" + std::to_string(::getpid()));
  StreamFolder() { std::filesystem::create_directories(path); }
  ~StreamFolder() { std::filesystem::remove_all(path); }
  Path write(const std::string& name, const std::string& bytes) const {
    std::ofstream(path / name, std::ios::binary) << bytes;
    return path / name;
  }
};

// Frames of noise whose chroma is the same in blocks of 4 x 4 pixels, because libav takes no more than every second row
// of 4:2:2. Far from all colors that there are it wraps around.
std::string y4m(const std::string& header, int width, int height, int across, int down, bool gray, int frames) {
  core::Random random(7);
  std::string out = "YUV4MPEG2 " + header + "\n";
  for (int k = 0; k < frames; ++k) {
    out += k == 1 ? "FRAME Ixyz\n" : "FRAME\n";
    for (int i = 0; i < width * height; ++i) out += static_cast<char>(static_cast<int>(random.uniform(0.0, 256.0)));
    for (int plane = 0; plane < 2 && !gray; ++plane) {
      std::string block(static_cast<std::size_t>(width) * height, '\0');  // wider than needed
      for (char& level : block) level = static_cast<char>(static_cast<int>(random.uniform(64.0, 192.0)));
      for (int y = 0; y < (height + down - 1) / down; ++y)
        for (int x = 0; x < (width + across - 1) / across; ++x) out += block[y * down / 4 * width + x * across / 4];
    }
  }
  return out;
}

std::vector<Image8> read_all(const Path& file) {
  capture::VideoReader reader(file);
  std::vector<Image8> out(1);
  while (reader.next(out.back())) out.emplace_back();
  out.pop_back();
  CHECK(reader.frames() == static_cast<int>(out.size()));
  return out;
}

std::vector<Image8> read_by_libav(const Path& file) {
  const auto& videos = core::own_library<capture::media::VideoLibrary>("chainsplat_videos", "build it");
  capture::media::Decoder* const decoder = videos.open(file, -1, 1);
  std::vector<Image8> out(1);
  while (videos.next(*decoder, &out.back())) out.emplace_back();
  out.pop_back();
  videos.close(decoder);
  return out;
}

}  // namespace

TEST_CASE("Y4M has the colors that libav makes of it") {
  struct Case {
    std::string samples;  // in the header
    int across, down;
    bool gray;
    double most;  // levels; libav's fast path for 4:2:0 and 4:2:2 is itself up to 2.5 off
  };
  const StreamFolder folder;
  for (const Case& c :
       {Case{"", 2, 2, false, 3.0}, Case{" C420jpeg", 2, 2, false, 3.0}, Case{" C420mpeg2", 2, 2, false, 3.0},
        Case{" C420paldv", 2, 2, false, 3.0}, Case{" C422", 2, 1, false, 3.0}, Case{" C444", 1, 1, false, 1.0},
        Case{" Cmono", 1, 1, true, 0.0}})
    for (const std::string range : {"", " XCOLORRANGE=LIMITED", " XCOLORRANGE=FULL"})
      for (const std::pair<int, int>& size : {std::pair{32, 16}, std::pair{36, 10}}) {
        const int width = size.first, height = size.second;
        INFO("'", c.samples, range, "' ", width, "x", height);
        const std::string header =
            "W" + std::to_string(width) + " H" + std::to_string(height) + " F30000:1001 Ip A1:1" + c.samples + range;
        const Path file = folder.write("a.y4m", y4m(header, width, height, c.across, c.down, c.gray, 3));
        const std::vector<Image8> ours = read_all(file), libavs = read_by_libav(file);
        REQUIRE((ours.size() == 3 && libavs.size() == 3));
        double most = 0.0, sum = 0.0;
        for (std::size_t k = 0; k < ours.size(); ++k) {
          REQUIRE((ours[k].width == width && ours[k].height == height && ours[k].channels == 3));
          REQUIRE(ours[k].pixels.size() == libavs[k].pixels.size());
          for (std::size_t i = 0; i < ours[k].pixels.size(); ++i) {
            const double difference = std::abs(ours[k].pixels[i] - libavs[k].pixels[i]);
            most = std::max(most, difference), sum += difference;
          }
        }
        CHECK(most <= c.most);
        CHECK(sum / static_cast<double>(3 * ours[0].pixels.size()) <= 0.3 * c.most);
      }
}

TEST_CASE("odd sizes, rates, frames passed over, and what a header says of a recording") {
  const StreamFolder folder;
  const Path file = folder.write("a.y4m", y4m("H5 W7 F25:2 C420", 7, 5, 2, 2, false, 4));
  capture::VideoReader reader(file);
  Image8 rgb;
  CHECK(reader.rate() == 12.5);
  CHECK_FALSE(reader.device());
  REQUIRE((reader.skip() && reader.next(rgb)));
  CHECK(reader.time() == doctest::Approx(0.08));
  CHECK((rgb.width == 7 && rgb.height == 5));
  REQUIRE((reader.skip() && reader.next(rgb)));
  CHECK_FALSE(reader.next(rgb));
  const std::vector<Image8> all = read_all(file);
  CHECK(all[3].pixels == rgb.pixels);
  const capture::VideoFacts facts = capture::video_facts(file);
  CHECK((facts.width == 7 && facts.height == 5 && facts.frames == 4 && facts.rate == 12.5));
  const Path unsaid = folder.write("b.y4m", y4m("W8 H4 F0:0", 8, 4, 2, 2, false, 1));
  CHECK(capture::VideoReader(unsaid).rate() == 0.0);
  CHECK(std::isnan(capture::VideoReader(unsaid).time()));
}

TEST_CASE("a pipe is read as what it holds") {
  const StreamFolder folder;
  const std::string stream = y4m("W8 H4 F30:1 C444", 8, 4, 1, 1, false, 3);
  capture::write_video(folder.path / "a.mkv.mp4", 30.0, {Image8{8, 4, 3, std::vector<std::uint8_t>(96, 70)}});
  const Path pipe = folder.path / "pipe";
  REQUIRE(::mkfifo(pipe.c_str(), 0600) == 0);
  const auto send = [&](const std::string& bytes, std::size_t piece) {
    return std::thread([&pipe, bytes, piece] {
      const int file = ::open(pipe.c_str(), O_WRONLY);
      for (std::size_t at = 0; at < bytes.size(); at += piece) {
        [[maybe_unused]] const ssize_t sent = ::write(file, &bytes[at], std::min(piece, bytes.size() - at));
        if (piece < bytes.size()) std::this_thread::sleep_for(std::chrono::milliseconds(1));
      }
      ::close(file);
    });
  };
  std::thread writer = send(stream, 50);
  const std::vector<Image8> piped = read_all(pipe);
  writer.join();
  REQUIRE(piped.size() == 3);
  CHECK(piped[2].pixels == read_all(folder.write("a.y4m", stream))[2].pixels);
  // 10 bits a sample are libav's
  std::string deep = "YUV4MPEG2 W8 H4 F30:1 C420p10 XYSCSS=420P10\nFRAME\n";
  for (int i = 0; i < 8 * 4 * 3 / 2; ++i) deep += std::string("\0\2", 2);  // 512 of 1023
  // and a writer that has ended before libav begins leaves all in the pipe
  for (const std::size_t piece : {std::size_t{50}, deep.size()}) {
    writer = send(deep, piece);
    const std::vector<Image8> left = read_all(pipe);
    writer.join();
    REQUIRE(left.size() == 1);
    CHECK(std::abs(left[0].pixels[0] - 130) <= 1);
  }
}

TEST_CASE("streams that are not what they claim are refused with a line") {
  const StreamFolder folder;
  const std::string good = "W8 H4 F30:1 C420jpeg";
  struct Case {
    std::string stream, line;
  };
  const std::string begin = "YUV4MPEG2 ";
  const Case cases[] = {
      {begin + "F30:1\nFRAME\n", "has a Y4M header without width and height; write the stream again"},
      {begin + "W8 F30:1\nFRAME\n", "has a Y4M header without width and height"},
      {begin + "W0 H4\n", "has a Y4M header without width and height"},
      {begin + "W-8 H4\n", "has a Y4M header without width and height"},
      {begin + "W8x H4\n", "has a Y4M header without width and height"},
      {begin + "W99999999999999999999 H4\n", "has a Y4M header without width and height"},
      {begin + "W99999 H99999\n", "claims frames of 99999x99999 pixels; write the stream again"},
      {begin + "W2147483647 H2147483647\n", "claims frames of 2147483647x2147483647 pixels"},
      {begin + "W8 H4 F30:1", "has a Y4M header without an end"},
      {begin + std::string(100000, ' ') + "W8 H4\n", "has a Y4M header without an end"},
      {begin, "has a Y4M header without an end"},
      {begin + good + "\nFRAMES\n", "frame 0 does not begin as one of Y4M does"},
      {begin + good + "\nframe\n", "frame 0 does not begin as one of Y4M does"},
      {begin + good + "\nFRA", "frame 0 does not begin as one of Y4M does"},
      {begin + good + "\nFRAME " + std::string(5000, 'x'), "has a Y4M header without an end"},
      {begin + good + "\nFRAME\n" + std::string(47, 'x'), "ends within a frame; write the stream again"},
      {begin + good + "\nFRAME\n" + std::string(48, 'x') + "x", "frame 1 does not begin as one of Y4M does"},
      {begin + "W16384 H8192 C444\nFRAME\nxyz", "ends within a frame"},
  };
  for (const Case& c : cases) {
    INFO(c.stream.substr(0, 80));
    const Path file = folder.write("a.y4m", c.stream);
    CHECK(contains(error_of([&] { read_all(file); }), "a.y4m: " + c.line));
    CHECK(contains(error_of([&] { capture::video_facts(file); }), "a.y4m: " + c.line));
  }
  // without libav
  for (const auto& [stream, line] :
       {std::pair<std::string, std::string>{begin + "W8 H4 C420p10\n",
                                            "has Y4M samples of the kind '420p10'; send 8 bits"},
        {begin + "W8 H4 C\x1b[31m\n", "has Y4M samples of the kind '\\x1b[31m'"},
        {"", "is no Y4M stream"},
        {"RIFF", "is no Y4M stream"}}) {
    const Path file = folder.write("a.y4m", stream);
    CHECK(contains(
        error_of([&] { capture::FrameStream(capture::Descriptor(::open(file.c_str(), O_RDONLY)), "a.y4m").rate(); }),
        "a.y4m: " + line));
  }
  CHECK(read_all(folder.write("a.y4m", begin + good + "\n")).empty());
}

TEST_CASE("bare frames have the size that is asked for, however small") {
  const StreamFolder folder;
  std::string bytes;
  for (int i = 0; i < 30; ++i) bytes += static_cast<char>(i);
  const Path file = folder.write("a.rgb", bytes);
  const auto open = [&](int width, int height) {
    return capture::FrameStream(capture::Descriptor(::open(file.c_str(), O_RDONLY)), "bare", width, height);
  };
  for (const auto& [width, height] : {std::pair{1, 1}, std::pair{1, 2}, std::pair{5, 1}, std::pair{5, 2}}) {
    capture::FrameStream stream = open(width, height);
    Image8 rgb;
    const std::size_t size = static_cast<std::size_t>(3) * width * height;
    std::string together;
    for (bool use = true; use ? stream.next(&rgb) : stream.next(nullptr); use = !use) {
      if (!use) continue;
      REQUIRE(rgb.pixels.size() == size);
      CHECK(std::equal(rgb.pixels.begin(), rgb.pixels.end(),
                       bytes.begin() + (stream.frames() - 1) * static_cast<std::ptrdiff_t>(size)));
    }
    CHECK(stream.frames() == static_cast<int>(bytes.size() / size));
  }
  capture::FrameStream stream = open(4, 2);
  Image8 rgb;
  REQUIRE(stream.next(&rgb));
  CHECK(contains(error_of([&] { stream.next(&rgb); }),
                 "bare: ends within a frame; send whole frames of the calibration's size"));
}

}  // namespace chainsplat
