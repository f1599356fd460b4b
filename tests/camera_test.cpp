// Cameras by V4L2, played by cli/fake_camera.cpp, which answers the system calls of this program.
#include <doctest/doctest.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <functional>
#include <string>
#include <vector>

#include "chainsplat/capture.h"
#include "chainsplat/core.h"
#include "chainsplat/encode.h"
#include "error_of.h"

namespace chainsplat {
namespace {

using test::contains;
using test::error_of;

constexpr int kWidth = 16, kHeight = 6;

using Bytes = std::vector<std::uint8_t>;

// A camera that is there as long as this lives.
class Fake {
 public:
  Fake() : folder_(std::filesystem::temp_directory_path() / ("chainsplat_camera_" + std::to_string(::getpid()))) {
    std::filesystem::create_directories(folder_);
    set("", "/dev/video97");
    set("_SIZE", std::to_string(kWidth) + "x" + std::to_string(kHeight));
    set("_STRIDE", "1");
  }
  ~Fake() {
    for (const std::string& name : names_) ::unsetenv(name.c_str());
    std::filesystem::remove_all(folder_);
  }
  void set(const std::string& what, const std::string& value) {
    names_.push_back("FAKE_CAMERA" + what);
    ::setenv(names_.back().c_str(), value.c_str(), 1);
  }
  void send(const std::string& format, const std::vector<Bytes>& frames) {
    const Path path = folder_ / format;
    std::ofstream file(path, std::ios::binary);
    for (const Bytes& frame : frames) {
      const auto size = static_cast<std::uint32_t>(frame.size());
      file.write(reinterpret_cast<const char*>(&size), sizeof size);
      file.write(reinterpret_cast<const char*>(frame.data()), size);
    }
    set("_" + format, path);
  }
  capture::VideoReader open(const capture::DeviceFormat& wanted = {kWidth, kHeight, 30.0}) const {
    return capture::VideoReader("/dev/video97", 1, wanted);
  }

 private:
  Path folder_;
  std::vector<std::string> names_;
};

Bytes noise(std::size_t size, std::uint64_t seed) {
  core::Random random(seed);
  Bytes out(size);
  for (std::uint8_t& byte : out) byte = static_cast<std::uint8_t>(random.next());
  return out;
}

// BT.601 in full precision.
std::array<double, 3> color(double luma, double cb, double cr, bool full) {
  const double y = full ? luma : (luma - 16.0) * 255.0 / 219.0, scale = full ? 1.0 : 255.0 / 224.0;
  const double u = scale * (cb - 128.0), v = scale * (cr - 128.0);
  const double kr = 0.299, kb = 0.114, kg = 1.0 - kr - kb;
  const double red = y + 2.0 * (1.0 - kr) * v, blue = y + 2.0 * (1.0 - kb) * u;
  return {red, (y - kr * red - kb * blue) / kg, blue};
}

// The largest difference to the samples of a frame, in levels.
template <class Samples>
double error(const capture::Image8& rgb, bool full, const Samples& samples) {
  REQUIRE((rgb.width == kWidth && rgb.height == kHeight && rgb.channels == 3));
  double most = 0.0;
  for (int y = 0; y < kHeight; ++y)
    for (int x = 0; x < kWidth; ++x) {
      const auto [luma, cb, cr] = samples(x, y);
      const auto wanted = color(luma, cb, cr, full);
      for (int c = 0; c < 3; ++c)
        most = std::max(most, std::abs(rgb.pixels[3 * (y * kWidth + x) + c] - std::clamp(wanted[c], 0.0, 255.0)));
    }
  return most;
}

// The next moment of the camera's clock.
void tick() { std::fflush(stdout); }

}  // namespace

TEST_CASE("raw frames become the colors that BT.601 says, whatever the order and the rows") {
  struct Case {
    const char* format;
    int row;  // bytes
    std::function<std::array<double, 3>(const Bytes&, int, int, int)> samples;
  };
  const std::vector<Case> cases = {
      {"YUYV", 2 * kWidth,
       [](const Bytes& b, int row, int x, int y) {
         const std::uint8_t* const pair = &b[y * row + x / 2 * 4];
         return std::array<double, 3>{1.0 * pair[x % 2 * 2], 1.0 * pair[1], 1.0 * pair[3]};
       }},
      {"UYVY", 2 * kWidth,
       [](const Bytes& b, int row, int x, int y) {
         const std::uint8_t* const pair = &b[y * row + x / 2 * 4];
         return std::array<double, 3>{1.0 * pair[1 + x % 2 * 2], 1.0 * pair[0], 1.0 * pair[2]};
       }},
      {"NV12", kWidth,
       [](const Bytes& b, int row, int x, int y) {
         const std::uint8_t* const chroma = &b[(kHeight + y / 2) * row + x / 2 * 2];
         return std::array<double, 3>{1.0 * b[y * row + x], 1.0 * chroma[0], 1.0 * chroma[1]};
       }},
      {"YU12", kWidth,
       [](const Bytes& b, int row, int x, int y) {
         const std::size_t cb = kHeight * row + y / 2 * (row / 2) + x / 2;
         return std::array<double, 3>{1.0 * b[y * row + x], 1.0 * b[cb], 1.0 * b[cb + kHeight / 2 * (row / 2)]};
       }},
  };
  constexpr double kMost = 0.51;  // levels: rounding, and a hundredth of fixed point
  for (const Case& c : cases)
    for (const int padding : {0, 8})
      for (const bool full : {false, true}) {
        INFO(c.format, " padded by ", padding, full ? ", full range" : "");
        Fake fake;
        const int row = c.row + padding;
        const Bytes frame = noise(static_cast<std::size_t>(2) * row * kHeight, 3);
        fake.send(c.format, {frame});
        if (padding > 0) fake.set("_ROW", std::to_string(row));
        if (full) fake.set("_FULL", "1");
        capture::VideoReader reader = fake.open();
        capture::Image8 rgb;
        CHECK(reader.device());
        REQUIRE(reader.next(rgb));
        CHECK(error(rgb, full, [&](int x, int y) { return c.samples(frame, row, x, y); }) < kMost);
      }
}

TEST_CASE("RGB, BGR and gray frames come as they are") {
  const Bytes frame = noise(3 * kWidth * kHeight, 5);
  for (const char* const format : {"RGB3", "BGR3", "GREY"}) {
    INFO(format);
    Fake fake;
    fake.send(format, {frame});
    capture::Image8 rgb;
    REQUIRE(fake.open().next(rgb));
    for (int i = 0; i < 3 * kWidth * kHeight; ++i) {
      const int other = std::string(format) == "GREY"   ? i / 3
                        : std::string(format) == "BGR3" ? i / 3 * 3 + 2 - i % 3
                                                        : i;
      REQUIRE(rgb.pixels[i] == frame[other]);
    }
  }
}

TEST_CASE("JPEG frames: as written, without tables, and damaged ones passed over") {
  capture::Image8 picture{kWidth, kHeight, 3, {}};
  for (int y = 0; y < kHeight; ++y)
    for (int x = 0; x < kWidth; ++x)
      for (const int level : {10 * x, 20 * y, 128}) picture.pixels.push_back(static_cast<std::uint8_t>(level));
  const std::string written = capture::jpeg(picture, 95);
  const Bytes whole(written.begin(), written.end());
  const auto is_it = [&](const capture::Image8& rgb) {
    REQUIRE((rgb.width == kWidth && rgb.height == kHeight && rgb.channels == 3));
    double squares = 0.0;
    for (std::size_t i = 0; i < rgb.pixels.size(); ++i) squares += std::pow(rgb.pixels[i] - picture.pixels[i], 2);
    return std::sqrt(squares / static_cast<double>(rgb.pixels.size())) < 8.0;  // chroma of the ramps is in steps
  };
  Fake fake;
  capture::Image8 rgb;
  SUBCASE("whole, or with bytes behind the end or before a marker") {
    Bytes longer = whole, filled = whole;
    longer.insert(longer.end(), 100, 0);
    filled.insert(filled.end() - 2, 5, 0);  // before the end's marker, as many cameras do
    fake.send("MJPG", {whole, longer, filled});
    capture::VideoReader reader = fake.open();
    for (int k = 0; k < 3; ++k, tick()) {
      REQUIRE(reader.next(rgb));
      CHECK(reader.frames() == k + 1);
      CHECK(is_it(rgb));
    }
  }
  SUBCASE("without Huffman tables, which are the standard's then") {
    Bytes bare;
    for (std::size_t at = 0; at < whole.size();) {
      const bool table = whole[at] == 0xff && whole[at + 1] == 0xc4;
      const std::size_t size = at == 0 ? 2
                               : whole[at + 1] == 0xda
                                   ? whole.size() - at
                                   : 2 + static_cast<std::size_t>(whole[at + 2]) * 256 + whole[at + 3];
      if (!table) bare.insert(bare.end(), whole.begin() + at, whole.begin() + at + size);
      at += size;
    }
    REQUIRE(bare.size() + 400 < whole.size());
    fake.send("MJPG", {bare});
    REQUIRE(fake.open().next(rgb));
    CHECK(is_it(rgb));
  }
  SUBCASE("torn, empty, noise, of another size") {
    Bytes broken = whole, other = whole;
    for (std::size_t i = broken.size() / 2; i < broken.size(); ++i) broken[i] = 0xff;
    const std::string small = capture::jpeg({8, 8, 3, Bytes(3 * 8 * 8, 99)}, 95);
    fake.send("MJPG", {whole,
                       broken,
                       Bytes(whole.begin(), whole.end() - 30),
                       noise(500, 1),
                       {0xff, 0xd8},
                       Bytes(small.begin(), small.end()),
                       whole});
    fake.set("_STRIDE", "0");  // in real time: nobody prints a line about a damaged frame
    fake.set("_RATE", "100");
    capture::VideoReader reader = fake.open();
    for (int k = 0; k < 4; ++k) {
      REQUIRE(reader.next(rgb));
      CHECK(is_it(rgb));
    }
  }
}

TEST_CASE("what the camera has is taken: raw where it serves, else JPEG, and the driver's size") {
  const Bytes raw = noise(2 * kWidth * kHeight, 2);
  const std::string bytes = capture::jpeg({kWidth, kHeight, 3, Bytes(3 * kWidth * kHeight, 200)}, 90);
  const Bytes compressed(bytes.begin(), bytes.end());
  const auto is_jpeg = [](capture::VideoReader reader) {
    capture::Image8 rgb;
    reader.next(rgb);
    return std::abs(rgb.pixels[0] - 200) < 3 && std::abs(rgb.pixels[3 * kWidth * kHeight - 1] - 200) < 3;
  };
  Fake fake;
  fake.send("MJPG", {compressed});
  CHECK(is_jpeg(fake.open()));
  fake.send("YUYV", {raw});
  CHECK_FALSE(is_jpeg(fake.open()));
  CHECK(fake.open().rate() == 30.0);
  fake.set("_YUYV_RATE", "10");
  CHECK(is_jpeg(fake.open()));
  CHECK_FALSE(is_jpeg(fake.open({kWidth, kHeight, 10.0})));
  CHECK_FALSE(is_jpeg(fake.open({})));
  capture::VideoReader reader = fake.open({640, 480, 30.0});  // neither has it
  capture::Image8 rgb;
  reader.next(rgb);
  CHECK(rgb.width == kWidth);
}

TEST_CASE("frames are counted and stamped by the driver, and the newest is handed out") {
  Fake fake;
  fake.send("YUYV", std::vector<Bytes>(1, noise(2 * kWidth * kHeight, 2)));
  capture::Image8 rgb;
  SUBCASE("each") {
    capture::VideoReader reader = fake.open();
    double first = 0.0;
    for (int k = 0; k < 40; ++k, tick()) {
      REQUIRE((k % 2 == 0 ? reader.next(rgb) : reader.skip()));
      if (k == 0) first = reader.first_time();
      CHECK(reader.frames() == k + 1);
      CHECK(reader.time() - first == doctest::Approx(k / 30.0).epsilon(1e-4));
    }
  }
  SUBCASE("passed over: damaged, torn, without a buffer") {
    for (const char* const what : {"_DAMAGED", "_TORN", "_LOST"}) {
      INFO(what);
      fake.set("_DAMAGED", "-1"), fake.set("_TORN", "-1"), fake.set("_LOST", "-1");
      fake.set(what, "2");
      capture::VideoReader reader = fake.open();
      for (const int frame : {0, 1, 3, 4}) {
        REQUIRE(reader.next(rgb));
        CHECK(reader.frames() == frame + 1);
        CHECK(reader.time() - reader.first_time() == doctest::Approx(frame / 30.0).epsilon(1e-4));
        tick();
      }
    }
  }
  SUBCASE("slower than the camera") {
    fake.set("_STRIDE", "3");
    capture::VideoReader reader = fake.open();
    for (int k = 0; k < 10; ++k, tick()) {
      REQUIRE(reader.next(rgb));
      CHECK(reader.frames() == 3 * k + 1);
    }
  }
  SUBCASE("gone") {
    fake.set("_GONE", "2");
    capture::VideoReader reader = fake.open();
    reader.next(rgb), tick(), reader.next(rgb), tick();
    CHECK_THROWS_WITH_AS(reader.next(rgb),
                         doctest::Contains("/dev/video97: gives no more frames after 2 (No such device); "), WorkError);
  }
  SUBCASE("asked to stop") {
    fake.set("_SILENT", "1");
    capture::VideoReader reader = fake.open();
    reader.next(rgb), tick();
    core::request_stop(15);
    CHECK_THROWS_AS(reader.next(rgb), Interrupted);
    core::clear_stop();
  }
}

TEST_CASE("what is no camera, is busy or sends what cannot be read is refused with a line") {
  Fake fake;
  fake.send("H264", {noise(100, 1)});
  const auto refused = [&] { return error_of([&] { fake.open(); }); };
  CHECK(contains(refused(), "/dev/video97: sends H264, which is not read; set it to raw frames"));
  fake.send("YUYV", {noise(2 * kWidth * kHeight, 1)});
  CHECK(refused().empty());
  fake.set("_CAN", "1");  // V4L2_CAP_VIDEO_CAPTURE, for read() only
  CHECK(contains(refused(), "is no camera that V4L2 can read in this format (No such device); 'v4l2-ctl"));
  fake.set("_CAN", "67108865");
  fake.set("_BUSY", "1");
  CHECK(contains(refused(), "is no camera that V4L2 can read in this format (Device or resource busy); "));
  CHECK(contains(error_of([] { capture::VideoReader reader("/dev/null"); }), "/dev/null: is no camera that V4L2"));
}

}  // namespace chainsplat
