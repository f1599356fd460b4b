// Tests of captures: the demo against its truth, small captures made here with every source of images, and every kind
// of problem that a capture can have.
#include <OpenImageIO/imageio.h>
#include <doctest/doctest.h>

#include <sys/stat.h>
#include <unistd.h>
#include <zlib.h>

#include <cmath>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <functional>
#include <mutex>
#include <nlohmann/json.hpp>

#include "chainsplat/capture.h"
#include "chainsplat/encode.h"
#include "chainsplat/in_memory.h"
#include "error_of.h"
#include "src/capture/image_files.h"

using namespace chainsplat;
using capture::Camera;
using capture::Capture;
using capture::Image8;
using capture::LoadOptions;
using capture::PackedView;
using capture::View;
using math::Vector2;
using math::Vector3;
using test::contains;
using test::error_of;
using Json = nlohmann::ordered_json;

namespace {

const Path kDemo = Path(CHAINSPLAT_SOURCE_DIR) / "assets/demo_free_30";

struct Folder {  // a folder of this test, removed at the end
  Path path = std::filesystem::temp_directory_path() / ("chainsplat_capture_test_" + std::to_string(::getpid()));
  Folder() {
    std::filesystem::remove_all(path);
    std::filesystem::create_directories(path);
  }
  ~Folder() { std::filesystem::remove_all(path); }
};

struct Warnings {  // collects the library's warnings
  std::vector<std::string> lines;
  std::mutex mutex;
  Warnings() {
    core::Listener listener;
    listener.warning = [this](const std::string& line) {
      std::lock_guard lock(mutex);
      lines.push_back(line);
    };
    core::set_listener(listener);
  }
  ~Warnings() { core::set_listener({}); }
  bool mention(const std::string& part) const {
    for (const std::string& line : lines)
      if (line.find(part) != std::string::npos) return true;
    return false;
  }
};

bool any_contains(const std::vector<std::string>& lines, const std::string& part) {
  for (const std::string& line : lines)
    if (contains(line, part)) return true;
  return false;
}

constexpr int kWidth = 64, kHeight = 48, kFrames = 4;

Image8 filled(int channels, const std::function<std::array<double, 3>(int, int)>& color, int width = kWidth,
              int height = kHeight) {
  Image8 image{width, height, channels, {}};
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x) {
      const auto value = color(x, y);
      for (int c = 0; c < channels; ++c)
        image.pixels.push_back(static_cast<std::uint8_t>(std::lround(value[std::min(c, 2)])));
    }
  return image;
}

// The object is a disk of radius 8 px around (30 + frame, 22).
bool in_disk(double x, double y, int frame) { return std::hypot(x - 30 - frame, y - 22) <= 8.0; }

Image8 disk_mask(int frame) {
  return filled(1, [&](int x, int y) {
    const double value = in_disk(x + 0.5, y + 0.5, frame) ? 255 : 0;
    return std::array{value, value, value};
  });
}

std::string numbered(const std::string& stem, int k) {
  std::string number = std::to_string(k);
  return stem + "/" + std::string(6 - number.size(), '0') + number + ".png";
}

// A capture of two cameras with 4 frames each at 10 Hz: image folders, mask images and depth. The base is in front of
// them, near (0, 0, 1).
struct Made {
  Folder folder;
  Json json;

  Made() {
    json = {{"format", "chainsplat-capture/1"},
            {"name", "made"},
            {"scenario", "free"},
            {"gravity", {0, 0, -9.81}},
            {"object", {{"length", 0.3}, {"diameter", 0.02}, {"mass", 0.06}}},
            {"grasp", {{"direction", {0, 0, -1}}, {"bending_axis", {0, 1, 0}}}},
            {"base", "base.tum"},
            {"cameras", Json::array()}};
    std::string tum;
    for (int k = 0; k <= 40; ++k)
      tum += core::exact(0.01 * k) + " " + core::exact(0.01 * k / 0.1 / 60.0) + " 0 1 0 0 0 1\n";
    write("base.tum", tum);
    for (const std::string name : {"cam0", "cam1"}) {
      for (const std::string& sub : {name, "masks/" + name, "depth/" + name})
        std::filesystem::create_directories(path() / sub);
      json["cameras"].push_back({{"name", name},
                                 {"width", kWidth},
                                 {"height", kHeight},
                                 {"fx", 60.0},
                                 {"fy", 60.0},
                                 {"cx", 32.0},
                                 {"cy", 24.0},
                                 {"distortion", {0, 0, 0, 0, 0}},
                                 {"world_from_camera", {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1}},
                                 {"images", name + "/%06d.png"},
                                 {"masks", "masks/" + name + "/%06d.png"},
                                 {"depth", "depth/" + name + "/%06d.png"},
                                 {"depth_scale", 0.0001},
                                 {"rate", 10.0},
                                 {"start", 0.0}});
      for (int k = 0; k < kFrames; ++k) {
        capture::write_png(path() / numbered(name, k), filled(3, [&](int x, int y) {
                             return std::array<double, 3>{4.0 * x, 5.0 * y, 20.0 * k};
                           }));
        capture::write_png(path() / numbered("masks/" + name, k), disk_mask(k));
        std::vector<float> depth(kWidth * kHeight, 0.0f);
        for (int i = 0; i < kWidth * kHeight; ++i) depth[i] = 0.9f + 0.001f * (i % kWidth);
        capture::write_depth_png(path() / numbered("depth/" + name, k), kWidth, kHeight, depth, 0.0001);
      }
    }
  }
  const Path& path() const { return folder.path; }
  void write(const std::string& name, const std::string& text) const { std::ofstream(path() / name) << text; }
  Capture load(const LoadOptions& options = {}) const {
    write("capture.json", json.dump(1));
    return capture::load(path(), options);
  }
  std::string refused(const LoadOptions& options = {}) const {
    return error_of([&] { load(options); });
  }
};

const std::uint8_t* pixel(const View& view, int x, int y) {
  return &view.rgba[4 * (static_cast<std::size_t>(y - view.y0) * view.width + x - view.x0)];
}

}  // namespace

// Checks that load_recorded() returns what load() with the same options returns.
void check_recorded(const Made& made, const std::string& camera) {
  LoadOptions options;
  options.camera = camera;
  const Capture found = capture::load_recorded(made.load(options), made.path(), options);
  options.pixels = capture::Pixels::recorded;
  options.depth = true;
  const Capture wanted = made.load(options);
  REQUIRE(found.views.size() == wanted.views.size());
  for (std::size_t k = 0; k < wanted.views.size(); ++k) {
    CHECK(found.views[k].x0 == wanted.views[k].x0);
    CHECK(found.views[k].width == wanted.views[k].width);
    CHECK(found.views[k].rgba == wanted.views[k].rgba);
    CHECK(found.views[k].depth == wanted.views[k].depth);
  }
}

TEST_CASE("lens distortion: OpenCV's formula and its inverse") {
  Camera camera;
  camera.width = 640, camera.height = 480;
  camera.fx = 610, camera.fy = 605, camera.cx = 315, camera.cy = 244;
  camera.distortion = {-0.25, 0.08, 0.001, -0.0007, -0.01};
  CHECK(camera.distorted());
  for (const Vector2& u : {Vector2(5, 7), Vector2(315, 244), Vector2(600.5, 30.25), Vector2(200, 470)}) {
    // OpenCV's formula, written out term by term as in its documentation
    const double x = (u.x() - 315) / 610, y = (u.y() - 244) / 605, r2 = x * x + y * y;
    const double factor = 1 - 0.25 * r2 + 0.08 * r2 * r2 - 0.01 * r2 * r2 * r2;
    const double dx = x * factor + 2 * 0.001 * x * y - 0.0007 * (r2 + 2 * x * x);
    const double dy = y * factor + 0.001 * (r2 + 2 * y * y) - 2 * 0.0007 * x * y;
    CHECK((capture::distort(camera, u) - Vector2(610 * dx + 315, 605 * dy + 244)).norm() < 1e-10);
    CHECK((capture::undistort(camera, capture::distort(camera, u)) - u).norm() < 1e-9);
  }
  CHECK((capture::project(camera, {0.1, -0.2, 2.0}) - Vector2(610 * 0.05 + 315, -605 * 0.1 + 244)).norm() < 1e-12);
}

TEST_CASE("the demo: masks, crops and base agree with the truth of the simulation") {
  const Capture demo = capture::load(kDemo);
  CHECK(demo.cameras.size() == 3);
  CHECK(demo.views.size() == 180);
  CHECK(demo.length == 0.3);
  CHECK(*demo.mass == 0.06);
  CHECK(demo.has_depth);
  const auto truth = capture::load_true_centerline(kDemo);
  REQUIRE(truth);
  REQUIRE(truth->time.size() == 60);
  REQUIRE(truth->points[0].cols() == 49);

  int points = 0, inside = 0, object = 0, bright_outside = 0;
  for (const PackedView& packed : demo.views) {
    const View view = capture::unpacked(packed);
    const Camera& camera = demo.cameras[view.camera];
    CHECK(view.time == doctest::Approx(truth->time[view.frame]).epsilon(1e-6));
    CHECK(view.rgba.size() == static_cast<std::size_t>(4) * view.width * view.height);
    for (std::size_t i = 0; i < view.rgba.size(); i += 4) {
      object += view.rgba[i + 3] == 255;
      bright_outside += view.rgba[i + 3] == 0 && (view.rgba[i] || view.rgba[i + 1] || view.rgba[i + 2]);
    }
    // the rope's axis, away from the gripper and the tip, lies inside the mask
    const math::MatrixX& line = truth->points[view.frame];
    for (int p = 4; p < 46; ++p) {
      const Vector2 u = capture::project(camera, camera.world_from_camera.inverse() * Vector3(line.col(p)));
      const int x = static_cast<int>(std::floor(u.x())), y = static_cast<int>(std::floor(u.y()));
      REQUIRE((x >= view.x0 && y >= view.y0 && x < view.x0 + view.width && y < view.y0 + view.height));
      ++points;
      inside += pixel(view, x, y)[3] == 255;
    }
    // the base at the frame's time is the centerline's first point (written with five digits)
    CHECK((demo.base.pose(view.time).translation - Vector3(line.col(0))).norm() < 2e-5);
  }
  CHECK(bright_outside == 0);
  CHECK(inside > 0.995 * points);
  // the simulation counted 693, 606 and 881 px per mask and camera, the mean over every 7th frame
  CHECK(object / 180.0 == doctest::Approx((693 + 606 + 881) / 3.0).epsilon(0.01));
}

TEST_CASE("videos decode to the pixels of another reader, whatever the number of threads") {
  // OpenImageIO reads a video's first frame with its own libav code
  const auto input = OIIO::ImageInput::open((kDemo / "cam0.mp4").string());
  REQUIRE(input);
  Image8 other{input->spec().width, input->spec().height, 3, {}};
  REQUIRE(other.width == 320);
  other.pixels.resize(static_cast<std::size_t>(3) * other.width * other.height);
  REQUIRE(input->read_image(0, 0, 0, 3, OIIO::TypeDesc::UINT8, other.pixels.data()));
  for (const int threads : {1, 3}) {
    capture::VideoReader reader(kDemo / "cam0.mp4", threads);
    Image8 image;
    REQUIRE(reader.next(image));
    CHECK(image.pixels == other.pixels);
    int count = 1;
    while (reader.skip()) ++count;
    CHECK(count == 60);
  }
  const capture::VideoFacts facts = capture::video_facts(kDemo / "cam0.mp4");
  CHECK(facts.frames == 60);
  CHECK(facts.rate == doctest::Approx(30.0));

  core::set_threads(1);
  const Capture one = capture::load(kDemo);
  core::set_threads(5);
  const Capture five = capture::load(kDemo);
  core::set_threads(0);
  REQUIRE(one.views.size() == five.views.size());
  for (std::size_t i = 0; i < one.views.size(); ++i) CHECK(one.views[i].rgba == five.views[i].rgba);
  CHECK(one.hash == five.hash);
}

TEST_CASE("frames asked for, one camera, no images") {
  const Capture all = capture::load(kDemo);
  LoadOptions options;
  options.first = 10;
  options.last = 13;
  options.camera = "cam1";
  const Capture some = capture::load(kDemo, options);
  REQUIRE(some.cameras.size() == 1);
  REQUIRE(some.views.size() == 3);
  CHECK(some.times[0].size() == 60);
  for (int k = 0; k < 3; ++k) {
    CHECK(some.views[k].frame == 10 + k);
    CHECK(some.views[k].rgba == all.views[60 + 10 + k].rgba);
  }
  options.images = false;
  CHECK(capture::load(kDemo / "capture.json", options).views.empty());
  options.camera = "cam7";
  CHECK(contains(error_of([&] { capture::load(kDemo, options); }), "choose one of cam0, cam1, cam2"));
}

TEST_CASE("image folders, depth, crops") {
  const Made made;
  LoadOptions options;
  options.depth = true;
  options.margin = 3;
  const Capture loaded = made.load(options);
  REQUIRE(loaded.views.size() == 2 * kFrames);
  for (const PackedView& packed : loaded.views) {
    const View view = capture::unpacked(packed);
    CHECK(view.time == doctest::Approx(0.1 * view.frame));
    // the disk covers the pixels whose centers are within 8 px of its center: [22, 38) x [14, 30) in frame 0
    CHECK(view.x0 == 22 + view.frame - 3);
    CHECK(view.y0 == 14 - 3);
    CHECK(view.width == 16 + 6);
    CHECK(view.height == 16 + 6);
    for (int y = view.y0; y < view.y0 + view.height; ++y)
      for (int x = view.x0; x < view.x0 + view.width; ++x) {
        const std::uint8_t* const p = pixel(view, x, y);
        const bool inside = in_disk(x + 0.5, y + 0.5, view.frame);
        CHECK(p[3] == (inside ? 255 : 0));
        CHECK(p[0] == (inside ? 4 * x : 0));
        CHECK(p[1] == (inside ? 5 * y : 0));
        CHECK(p[2] == (inside ? 20 * view.frame : 0));
        CHECK(view.depth[static_cast<std::size_t>(y - view.y0) * view.width + x - view.x0] ==
              doctest::Approx(inside ? 0.9 + 0.001 * x : 0.0).epsilon(1e-4));
      }
  }
  capture::FrameReader reader(made.path(), "cam0", {}, capture::Pixels::recorded);
  const capture::Image8 whole = reader.next()->picture;
  CHECK(whole.width == kWidth);
  CHECK(whole.pixels[3 * (kWidth + 1)] == 4);
}

TEST_CASE("undistortion: straight pixels, masks, and edges that are not darkened") {
  Made made;
  Json& json = made.json["cameras"][0];
  json["distortion"] = {-0.2, 0.05, 0.002, -0.001, 0.01};
  Camera camera;
  camera.width = kWidth, camera.height = kHeight;
  camera.fx = camera.fy = 60, camera.cx = 32, camera.cy = 24;
  camera.distortion = {-0.2, 0.05, 0.002, -0.001, 0.01};
  // record, as through a lens, a scene that is linear in undistorted pixels, and the disk as mask
  for (int k = 0; k < kFrames; ++k) {
    const auto scene = [&](int x, int y) { return capture::undistort(camera, {x + 0.5, y + 0.5}); };
    capture::write_png(made.path() / numbered("cam0", k), filled(3, [&](int x, int y) {
                         const Vector2 u = scene(x, y);
                         return std::array<double, 3>{std::clamp(20 + 3 * u.x(), 0.0, 255.0),
                                                      std::clamp(230 - 4 * u.y(), 0.0, 255.0), 200.0};
                       }));
    capture::write_png(made.path() / numbered("masks/cam0", k), filled(1, [&](int x, int y) {
                         const Vector2 u = scene(x, y);
                         return std::array<double, 3>{in_disk(u.x(), u.y(), k) ? 255.0 : 0.0, 0, 0};
                       }));
  }
  LoadOptions options;
  options.camera = "cam0";
  options.depth = true;
  for (const PackedView& packed : made.load(options).views) {
    const View view = capture::unpacked(packed);
    int wrong = 0, object = 0;
    for (int y = view.y0; y < view.y0 + view.height; ++y)
      for (int x = view.x0; x < view.x0 + view.width; ++x) {
        const std::uint8_t* const p = pixel(view, x, y);
        const bool inside = in_disk(x + 0.5, y + 0.5, view.frame);
        wrong += inside != (p[3] == 255);
        object += inside;
        if (p[3] == 0) continue;
        CHECK(std::abs(p[0] - (20 + 3 * (x + 0.5))) < 1.6);
        CHECK(std::abs(p[1] - (230 - 4 * (y + 0.5))) < 1.6);
        CHECK(p[2] == 200);
      }
    CHECK(wrong < 0.06 * object);  // only edge pixels may differ
  }
  // a frame that is in memory gives the same view
  const Capture straight = made.load(options);
  const Image8 picture = capture::read_image8(made.path() / numbered("cam0", 1));
  const Image8 coverage = capture::read_image8(made.path() / numbered("masks/cam0", 1));
  const View from_memory = capture::view_of(straight.cameras[0], picture, coverage);
  CHECK(from_memory.rgba == capture::unpacked(straight.views[1]).rgba);
  CHECK(from_memory.x0 == straight.views[1].x0);
  CHECK(from_memory.y0 == straight.views[1].y0);
  CHECK(capture::view_of(straight.cameras[0], picture, filled(1, [](int, int) { return std::array<double, 3>{}; }))
            .width == 0);
  CHECK_THROWS_AS(capture::view_of(straight.cameras[0], coverage, coverage), InputError);
  // without undistortion the pixels are those of the files
  options.pixels = capture::Pixels::recorded;
  const Capture recorded = made.load(options);
  const Image8 image = capture::read_image8(made.path() / numbered("cam0", 1));
  const View view = capture::unpacked(recorded.views[1]);
  for (int y = view.y0; y < view.y0 + view.height; ++y)
    for (int x = view.x0; x < view.x0 + view.width; ++x)
      if (pixel(view, x, y)[3] == 255) CHECK(pixel(view, x, y)[0] == image.pixels[3 * (y * kWidth + x)]);
  check_recorded(made, "cam0");
  // which of them a capture has is known where they are used
  capture::require_pixels(straight, capture::Pixels::undistorted);
  CHECK(contains(error_of([&] { capture::require_pixels(straight, capture::Pixels::recorded); }), "Pixels::recorded"));
  CHECK(contains(error_of([&] { capture::require_pixels(recorded, capture::Pixels::undistorted); }),
                 "Pixels::undistorted"));
  // whole frames have the same colors
  capture::FrameReader whole(made.path(), "cam0", {1, -1}, capture::Pixels::undistorted);
  const std::optional<capture::Frame> frame = whole.next();
  REQUIRE(frame);
  CHECK(frame->frame == 1);
  const View seen = capture::unpacked(straight.views[1]);
  for (int y = seen.y0; y < seen.y0 + seen.height; ++y)
    for (int x = seen.x0; x < seen.x0 + seen.width; ++x)
      if (pixel(seen, x, y)[3] == 255)
        CHECK(std::equal(pixel(seen, x, y), pixel(seen, x, y) + 3, &frame->picture.pixels[3 * (y * kWidth + x)]));
  capture::FrameReader as_recorded(made.path(), "cam0", {1, 2}, capture::Pixels::recorded);
  CHECK(as_recorded.next()->picture.pixels == image.pixels);
  CHECK_FALSE(as_recorded.next());
}

TEST_CASE("a recording in memory is the same capture as its files") {
  Made made;
  made.json["cameras"][0]["distortion"] = {-0.2, 0.05, 0.002, -0.001, 0.01};
  const Capture from_files = made.load();
  capture::InMemory recording;
  Json document = made.json;
  document.erase("base");
  for (std::size_t c = 0; c < 2; ++c) {
    const std::string name = from_files.cameras[c].name;
    for (const char* const key : {"images", "masks", "depth", "depth_scale", "rate", "start"})
      document["cameras"][c].erase(key);
    capture::CameraFrames frames{from_files.times[c], {}, {}};
    for (int k = 0; k < kFrames; ++k) {
      frames.images.push_back(capture::read_image8(made.path() / numbered(name, k)));
      frames.masks.push_back(capture::read_image8(made.path() / numbered("masks/" + name, k)));
    }
    recording.cameras.push_back(std::move(frames));
  }
  recording.document = document.dump();
  recording.base = from_files.base.samples();
  const auto check_same = [](const Capture& a, const Capture& b) {
    REQUIRE(a.views.size() == b.views.size());
    for (std::size_t v = 0; v < a.views.size(); ++v) {
      CHECK(a.views[v].rgba == b.views[v].rgba);
      CHECK(a.views[v].x0 == b.views[v].x0);
      CHECK(a.views[v].time == b.views[v].time);
    }
    CHECK(a.length == b.length);
    CHECK(a.base.pose(0.1).translation == b.base.pose(0.1).translation);
  };
  const Capture loaded = capture::load(recording);
  check_same(loaded, from_files);
  check_same(capture::load_recorded(loaded, recording), capture::load_recorded(from_files, made.path()));
  CHECK_FALSE(capture::load_true_centerline(loaded.folder));
  // other pixels, another capture
  capture::InMemory other = recording;
  other.cameras[1].images[2].pixels[5] ^= 1;
  CHECK(capture::load(other).hash != loaded.hash);
  CHECK(capture::load(recording).hash == loaded.hash);

  const auto refused = [&](const std::function<void(capture::InMemory&)>& change) {
    capture::InMemory wrong = recording;
    change(wrong);
    return error_of([&] { capture::load(wrong); });
  };
  CHECK(contains(refused([](auto& r) { r.cameras.pop_back(); }), "cameras: are 2, and frames are there of 1"));
  CHECK(contains(refused([](auto& r) { r.cameras[1].times[2] = r.cameras[1].times[1]; }), "`times` of frame 2"));
  CHECK(contains(refused([](auto& r) { r.cameras[0].times.clear(); }), "has no frames"));
  CHECK(contains(refused([](auto& r) { r.cameras[0].images.pop_back(); }), "`images` are not RGB"));
  CHECK(contains(refused([](auto& r) { r.cameras[0].masks[1].width = 1; }), "`masks` do not have one channel"));
  CHECK(contains(refused([](auto& r) { r.base.resize(1); }), "base"));
  CHECK(contains(refused([&](auto& r) {
                   Json named = document;
                   named["cameras"][0]["images"] = "cam0.mp4";
                   r.document = named.dump();
                 }),
                 "images: does not go with frames that are in memory"));
  CHECK(contains(refused([](auto& r) { r.document = "{"; }), "`document`"));
}

TEST_CASE("what evaluation compares with is loaded but once where no lens distorts") {
  Made made;
  check_recorded(made, "");
}

TEST_CASE("videos of images and masks, missing masks, timestamps, empty views") {
  Made made;
  Warnings warnings;
  std::vector<Image8> images, masks;
  for (int k = 0; k < kFrames; ++k) {
    images.push_back(filled(3, [&](int, int) { return std::array<double, 3>{200, 60, 30}; }));
    Image8 mask = disk_mask(k), rgb{kWidth, kHeight, 3, {}};
    for (const std::uint8_t value : mask.pixels) rgb.pixels.insert(rgb.pixels.end(), 3, value);
    masks.push_back(rgb);
  }
  capture::write_video(made.path() / "cam0.mp4", 10.0, images);
  capture::write_video(made.path() / "mask0.mp4", 10.0, masks);
  const Capture by_file = made.load();

  SUBCASE("images and masks by video: colors of BT.601, edges of the threshold") {
    for (const bool video_images : {true, false}) {
      if (video_images)
        made.json["cameras"][0]["images"] = "cam0.mp4";
      else
        made.json["cameras"][0]["images"] = "cam0/%06d.png";
      made.json["cameras"][0]["masks"] = "mask0.mp4";
      const Capture loaded = made.load();
      for (int k = 0; k < kFrames; ++k) {
        const View view = capture::unpacked(loaded.views[k]), reference = capture::unpacked(by_file.views[k]);
        int object = 0, different = 0;
        for (int y = 14; y < 30; ++y)
          for (int x = 22 + k; x < 38 + k; ++x) {
            object += pixel(reference, x, y)[3] == 255;
            different += pixel(reference, x, y)[3] != pixel(view, x, y)[3];
            if (!video_images || pixel(view, x, y)[3] == 0) continue;
            CHECK(std::abs(pixel(view, x, y)[0] - 200) <= 3);
            CHECK(std::abs(pixel(view, x, y)[1] - 60) <= 3);
            CHECK(std::abs(pixel(view, x, y)[2] - 30) <= 3);
          }
        CHECK(different <= 0.03 * object);
      }
      // whole frames from the middle on, one after the other
      capture::FrameReader reader(made.path(), "cam0", {1, 3}, capture::Pixels::recorded);
      for (int k = 1; k < 3; ++k) {
        const std::optional<capture::Frame> frame = reader.next();
        REQUIRE(frame);
        CHECK(frame->frame == k);
        CHECK(frame->time == loaded.times[0][k]);
        REQUIRE(frame->picture.pixels.size() == 3u * kWidth * kHeight);
        const View view = capture::unpacked(loaded.views[k]);
        for (int y = 14; y < 30; ++y)
          for (int x = 22 + k; x < 38 + k; ++x)
            if (const std::uint8_t* const p = pixel(view, x, y); p[3] == 255)
              CHECK(std::equal(p, p + 3, &frame->picture.pixels[3 * (y * kWidth + x)]));
      }
      CHECK_FALSE(reader.next());
    }
  }
  SUBCASE("masked already: what is not black is the object, with a warning; a background is refused") {
    made.json["cameras"][0].erase("masks");
    CHECK(contains(made.refused(), "background of the images is not black"));
    for (int k = 0; k < kFrames; ++k) {
      Image8 image = filled(3, [&](int x, int y) {
        return in_disk(x + 0.5, y + 0.5, k) ? std::array<double, 3>{1, 0, 0} : std::array<double, 3>{0, 0, 0};
      });
      capture::write_png(made.path() / numbered("cam0", k), image);
    }
    const Capture loaded = made.load();
    CHECK(warnings.mention("taken as masked already"));
    for (int k = 0; k < kFrames; ++k) {
      CHECK(loaded.views[k].x0 == by_file.views[k].x0);
      CHECK(loaded.views[k].width == by_file.views[k].width);
    }
  }
  SUBCASE("timestamps replace start and rate") {
    made.write("cam1.txt", "# seconds\n0.01\n0.02\n0.15\n\n0.35\n");
    made.json["cameras"][1]["timestamps"] = "cam1.txt";
    CHECK(made.load().times[1] == std::vector<double>{0.01, 0.02, 0.15, 0.35});
    const std::uint64_t before = capture::stamp(made.path());
    made.write("cam1.txt", "0.01\n0.02\n0.15\n0.36\n");
    CHECK(capture::stamp(made.path()) != before);
    made.write("cam1.txt", "0.01\n0.02\n0.15\n");
    CHECK(contains(made.refused(), "3 times for 4 frames"));
    made.write("cam1.txt", "0.01\n0.02\n0.02\n0.3\n");
    CHECK(contains(made.refused(), "cam1.txt:3"));
    made.write("cam1.txt", "0.01\nnan\n0.02\n0.3\n");
    CHECK(contains(made.refused(), "cam1.txt:2"));
  }
  SUBCASE("cameras of different start and rate") {
    made.json["cameras"][1]["start"] = 0.05;
    made.json["cameras"][1]["rate"] = 20.0;
    CHECK(made.load().times[1][3] == doctest::Approx(0.2));
  }
  SUBCASE("an empty mask keeps its place; a camera that sees nothing is refused") {
    const Image8 empty = filled(1, [](int, int) { return std::array<double, 3>{0, 0, 0}; });
    capture::write_png(made.path() / numbered("masks/cam1", 2), empty);
    const Capture loaded = made.load();
    REQUIRE(loaded.views.size() == 2 * kFrames);
    CHECK(loaded.views[kFrames + 2].width == 0);
    CHECK(loaded.views[kFrames + 2].height == 0);
    CHECK(loaded.views[kFrames + 3].width > 0);
    for (int k = 0; k < kFrames; ++k) capture::write_png(made.path() / numbered("masks/cam1", k), empty);
    CHECK(contains(made.refused(), "cam1 never sees the object"));
  }
}

TEST_CASE("everything that can be wrong with capture.json is refused in one line that names the place") {
  Made made;
  const auto with = [&](const std::string& pointer, const Json& value) {
    const Json before = made.json;
    made.json[Json::json_pointer(pointer)] = value;
    const std::string message = made.refused();
    made.json = before;
    CHECK(contains(message, made.path().string()));
    CHECK(message.find('\n') == std::string::npos);
    return message;
  };
  const auto without = [&](const std::string& parent, const std::string& key) {
    const Json before = made.json;
    made.json[Json::json_pointer(parent)].erase(key);
    const std::string message = made.refused();
    made.json = before;
    return message;
  };
  const double infinity = std::numeric_limits<double>::infinity();  // the JSON library writes it as null
  CHECK(made.refused() == "");
  CHECK(contains(with("/format", "chainsplat-capture/2"), "format"));
  CHECK(contains(with("/scenario", "sea"), "scenario: 'sea' is unknown"));
  CHECK(contains(with("/gravity", {0, 0, nullptr}), "gravity[2]"));
  CHECK(contains(with("/gravity", {0, 0}), "gravity: has 2 entries instead of 3"));
  CHECK(contains(with("/object/length", 0), "object.length: 0 is not positive"));
  CHECK(contains(with("/object/length", infinity), "object.length: is not a number"));
  CHECK(contains(with("/object/diameter", 0.5), "object.diameter"));
  CHECK(contains(with("/object/mass", -1), "object.mass"));
  CHECK(contains(with("/object/tip_mass", -1), "object.tip_mass: is no mass"));
  CHECK(contains(with("/object/tip_length", 0.05), "object.tip_length: says nothing without a payload's mass"));
  CHECK(contains(with("/object/tip_mass", {{"value", 0.1}, {"sigma", "x"}}), "object.tip_mass"));
  CHECK(contains(with("/grasp/direction", {0, 0, 0}), "grasp.direction: has no length"));
  CHECK(contains(with("/grasp/bending_axis", {0, 0, 0}), "grasp.bending_axis: has no length"));
  CHECK(contains(with("/grasp/bending_axis", {0, 1, 0.2}), "not perpendicular"));
  CHECK(contains(with("/scenario", "tabletop"), "table: is missing"));
  CHECK(contains(with("/cameras", Json::array()), "cameras"));
  CHECK(contains(with("/cameras/1/name", "cam0"), "used twice"));
  CHECK(contains(with("/cameras/1/name", "../x"), "cannot name a folder"));
  CHECK(contains(with("/cameras/0/width", 64.5), "cameras[0].width"));
  CHECK(contains(with("/cameras/0/width", 65), "000000.png: is 64x48 pixels, the camera has 65x48"));
  CHECK(contains(with("/cameras/0/fx", 0), "cameras[0].fx"));
  CHECK(contains(with("/cameras/0/fy", 1e300), "cameras[0].fy: 1e+300 is beyond every camera"));
  CHECK(contains(with("/cameras/0/cx", "left"), "cameras[0].cx: is not a number"));
  CHECK(contains(with("/cameras/0/distortion", {0, 0, 0, 0}), "4 entries instead of 5"));
  CHECK(contains(with("/cameras/0/distortion", {-30, 0, 0, 0, 0}), "cannot be undone"));
  CHECK(contains(with("/cameras/0/world_from_camera/0", 1.1), "not a rotation"));
  CHECK(contains(with("/cameras/0/world_from_camera/0", -1), "reflection"));
  CHECK(contains(with("/cameras/0/world_from_camera/3", nullptr), "world_from_camera[3]"));
  CHECK(contains(with("/cameras/0/world_from_camera", {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 0, 0, 1}), "by columns"));
  CHECK(contains(with("/cameras/0/rate", 0), "cameras[0].rate"));
  CHECK(contains(with("/cameras/0/depth_scale", 0), "depth_scale"));
  CHECK(contains(with("/cameras/0/images", "../cam0/%06d.png"), "not a path inside"));
  CHECK(contains(with("/cameras/0/images", "/etc/%06d.png"), "not a path inside"));
  CHECK(contains(with("/cameras/0/images", "cam0/../../x.mp4"), "not a path inside"));
  CHECK(contains(with("/cameras/0/images", "cam0/%s.png"), "not a frame pattern"));
  CHECK(contains(with("/cameras/0/images", "cam0/%06d%06d.png"), "not a frame pattern"));
  CHECK(contains(with("/cameras/0/images", "missing.mp4"), "missing.mp4: does not exist"));
  CHECK(contains(with("/cameras/0/images", "base.tum"), "base.tum"));
  CHECK(contains(with("/base", "../base.tum"), "not a path inside"));
  CHECK(contains(with("/base", "missing.tum"), "missing.tum"));
  CHECK(contains(with("/cameras/0/start", 0.2), "covers 0 to 0.4 s, but the frames of cam0 are at 0.2 to 0.5 s"));
  CHECK(contains(without("", "format"), "format: is missing"));
  CHECK(contains(without("", "grasp"), "grasp: is missing"));
  CHECK(contains(without("/object", "length"), "object.length: is missing"));
  CHECK(contains(without("/cameras/0", "world_from_camera"), "world_from_camera: is missing"));
  CHECK(contains(without("/cameras/1", "rate"), "cameras[1].rate: is missing"));

  // frames may lie up to half a frame interval beyond the base
  made.json["cameras"][0]["start"] = 0.149;
  CHECK(made.refused() == "");
}

TEST_CASE("numbers that memory and time follow are bounded, each with its reason") {
  Made made;
  const auto with = [&](const std::string& pointer, const Json& value) {
    const Json before = made.json;
    made.json[Json::json_pointer(pointer)] = value;
    const std::string message = made.refused();
    made.json = before;
    return message;
  };
  CHECK(
      contains(with("/cameras/0/rate", 1e-7), "cameras[0].rate: 1e-07 is not between 0.1 and 1000000 frames a second"));
  CHECK(contains(with("/cameras/0/rate", 1e300), "cameras[0].rate: 1e+300 is not between"));
  Json wide = made.json["cameras"][0];
  wide["width"] = wide["height"] = 32768;
  CHECK(contains(with("/cameras/0", wide), "32768x32768 are more than 128 million pixels"));
  CHECK(contains(with("/cameras/0/fx", 0.9), "0.9 is less than a pixel"));
  CHECK(contains(with("/cameras/0/world_from_camera/3", 1e200), "world_from_camera: lies more than"));
  CHECK(contains(with("/object/length", 1e9), "object.length: 1e+09 is more than 100 m"));
  CHECK(contains(with("/object/diameter", 1e-6), "object.diameter: is less than 1/10000 of the length"));
  CHECK(contains(with("/object/mass", 1e300), "object.mass"));
  CHECK(contains(with("/gravity/2", -1e300), "gravity: is more than 1000 m/s^2"));
  CHECK(contains(with("/base", std::string(5000, 'x')), "is longer than a path can be"));
  Json crowd = Json::array();
  for (int c = 0; c < 10000; ++c) {
    crowd.push_back(made.json["cameras"][0]);
    crowd.back()["name"] = "cam" + std::to_string(c);
  }
  CHECK(contains(with("/cameras", crowd), "capture.json: "));  // the bound of 4 MiB is exceeded first
  crowd.erase(crowd.begin() + 600, crowd.end());
  CHECK(contains(with("/cameras", crowd), "cameras: 600 are more than 512"));
  Json keys = made.json["object"];
  for (int k = 0; k < 1001; ++k) keys[std::to_string(k)] = k;
  CHECK(contains(with("/object", keys), "an object has more than 1000 keys"));

  made.write("times.txt", "0\n0.1\n0.2\n1e7\n");
  CHECK(contains(with("/cameras/0/timestamps", "times.txt"), "timestamps: the frames span 10000000 s"));

  std::string text = made.json.dump(1);
  text.replace(text.find("\"length\""), 8, "\"length\": 0.2, \"length\"");
  made.write("capture.json", text);
  CHECK(contains(error_of([&] { capture::load(made.path()); }), "the key 'length' stands twice in one object"));

  Warnings warnings;
  for (int k = 0; k < 900; ++k) made.json["object"]["key" + std::to_string(k) + std::string(1000, 'x')] = k;
  CHECK(made.refused() == "");
  CHECK(warnings.mention("object: 900 unknown keys, all ignored"));
  CHECK(warnings.lines.size() < 10);
  for (const std::string& line : warnings.lines) CHECK(line.size() < 300);
}

TEST_CASE("nothing that a capture names is outside its folder, whatever the links") {
  namespace fs = std::filesystem;
  Made made;
  const Path outside = made.path().string() + "_outside";
  fs::remove_all(outside);
  fs::create_directories(outside);
  const auto link = [&](const Path& to, const std::string& name) {
    fs::remove_all(made.path() / name);
    fs::create_symlink(to, made.path() / name);
  };
  const std::vector<Image8> frames(kFrames, filled(3, [](int x, int y) {
                                     return std::array<double, 3>{3.0 * x, 4.0 * y, 90};
                                   }));
  SUBCASE("a folder that is reached by a link, and links inside") {
    made.load();
    fs::create_directory_symlink(made.path(), outside / "way");
    CHECK(error_of([&] { capture::load(outside / "way"); }) == "");
    CHECK(error_of([&] { capture::load((outside / "way/").string() + "/capture.json"); }) == "");
    fs::rename(made.path() / "base.tum", made.path() / "real.tum");
    link("real.tum", "base.tum");
    fs::rename(made.path() / "cam0", made.path() / "real");
    link(made.path() / "real", "cam0");
    fs::rename(made.path() / numbered("cam1", 2), made.path() / "one.png");
    link("../one.png", numbered("cam1", 2));
    CHECK(made.refused() == "");
  }
  SUBCASE("the base") {
    fs::rename(made.path() / "base.tum", outside / "base.tum");
    link(outside / "base.tum", "base.tum");
    const std::string message = made.refused();
    CHECK(contains(message, "base.tum: is a link out of "));
    CHECK(contains(message, ", to " + fs::canonical(outside / "base.tum").string() + "; copy the file"));
  }
  SUBCASE("a video") {
    capture::write_video(outside / "a.mp4", 10.0, frames);
    link(outside / "a.mp4", "a.mp4");
    made.json["cameras"][0]["images"] = "a.mp4";
    CHECK(contains(made.refused(), "a.mp4: is a link out of "));
    made.json["cameras"][0]["images"] = "cam0/%06d.png";
    made.json["cameras"][0]["masks"] = "a.mp4";
    CHECK(contains(made.refused(), "cameras[0].masks"));
  }
  SUBCASE("a folder of images, or one image of it, or a masks' or depth's") {
    for (const std::string name : {"cam0", "masks/cam0", "depth/cam0"}) {
      const std::string one = numbered(name, 2);
      fs::rename(made.path() / one, outside / "one.png");
      link(outside / "one.png", one);
      CHECK(contains(made.refused(), one + ": is a link out of "));
      fs::remove(made.path() / one);
      fs::rename(outside / "one.png", made.path() / one);
      fs::rename(made.path() / name, outside / "all");
      link(outside / "all", name);
      CHECK(contains(made.refused(), (made.path() / name).string() + ": is a link out of "));
      CHECK_FALSE(capture::check(made.path()).problems.empty());
      fs::remove(made.path() / name);
      fs::rename(outside / "all", made.path() / name);
      CHECK(made.refused() == "");
    }
  }
  SUBCASE("timestamps, and a way out through a link inside") {
    std::ofstream(outside / "times.txt") << "0\n0.1\n0.2\n0.3\n";
    link(outside / "times.txt", "times.txt");
    made.json["cameras"][0]["timestamps"] = "times.txt";
    CHECK(contains(made.refused(), "times.txt: is a link out of "));
    link(".", "here");
    made.json["cameras"][0]["timestamps"] = "here/../" + outside.filename().string() + "/times.txt";
    CHECK(contains(made.refused(), "leads out of "));
  }
  fs::remove_all(outside);
}

TEST_CASE("a file that names other files is neither video nor image, whatever it is called") {
  Made made;
  const std::vector<Image8> frames(kFrames, filled(3, [](int x, int y) {
                                     return std::array<double, 3>{3.0 * x, 4.0 * y, 90};
                                   }));
  capture::write_video(made.path() / "real.mp4", 10.0, frames);
  const std::string real = (made.path() / "real.mp4").string();
  made.json["cameras"][0]["images"] = "cam0.mp4";
  const std::string playlist =
      "#EXTM3U\n#EXT-X-VERSION:3\n#EXT-X-TARGETDURATION:1\n#EXTINF:0.4,\nreal.mp4\n#EXT-X-ENDLIST\n";
  made.write("cam0.mp4", playlist);
  CHECK(contains(made.refused(), "cam0.mp4: is not a readable video"));
  made.write("cam0.mp4", "ffconcat version 1.0\nfile 'real.mp4'\n");
  CHECK(contains(made.refused(), "cam0.mp4: is not a readable video"));
  // a file name that looks like an address is a file name
  std::filesystem::rename(made.path() / "real.mp4", made.path() / "concat:x.mp4");
  const Path before = std::filesystem::current_path();
  std::filesystem::current_path(made.path());
  CHECK(error_of([] { capture::VideoReader reader("concat:x.mp4"); }) == "");
  std::filesystem::current_path(before);
  std::filesystem::rename(made.path() / "concat:x.mp4", made.path() / "real.mp4");
  // OpenImageIO could read videos, but must not
  made.json["cameras"][0]["images"] = "cam0/%06d.png";
  made.write(numbered("cam0", 1), playlist);
  CHECK(contains(made.refused(), "cam0/000001.png: is not a readable image"));
  made.write(numbered("cam0", 1), core::read_file(real));
  CHECK(contains(made.refused(), "cam0/000001.png: is not a readable image"));
}

TEST_CASE("pipes and folders in place of files end in an error, not in waiting") {
  Made made;
  made.load();
  const auto pipe = [&](const std::string& name) {
    std::filesystem::remove_all(made.path() / name);
    REQUIRE(::mkfifo((made.path() / name).c_str(), 0600) == 0);
  };
  SUBCASE("the capture") {
    pipe("capture.json");
    CHECK(contains(error_of([&] { capture::load(made.path()); }), "capture.json: is a pipe or device, not a file"));
    CHECK_FALSE(capture::check(made.path()).problems.empty());
  }
  SUBCASE("the base") {
    pipe("base.tum");
    CHECK(contains(made.refused(), "base.tum: is a pipe or device"));
    std::filesystem::remove(made.path() / "base.tum");
    std::filesystem::create_directory(made.path() / "base.tum");
    CHECK(contains(made.refused(), "base.tum: is a folder"));
  }
  SUBCASE("videos and times") {
    pipe("a.mp4");
    made.json["cameras"][0]["images"] = "a.mp4";
    CHECK(contains(made.refused(), "a.mp4: is a pipe or device"));
    made.json["cameras"][0]["images"] = "cam0";
    CHECK(contains(made.refused(), "cam0: is a folder"));
    made.json["cameras"][0]["images"] = "cam0/%06d.png";
    pipe("times.txt");
    made.json["cameras"][0]["timestamps"] = "times.txt";
    CHECK(contains(made.refused(), "times.txt: is a pipe or device"));
  }
  SUBCASE("an image") {
    pipe(numbered("cam0", 0));
    CHECK(contains(made.refused(), "cam0/000000.png: is missing"));
    CHECK(contains(error_of([&] { capture::read_image8(made.path() / numbered("cam0", 0)); }), "is not a file"));
  }
}

TEST_CASE("files that are missing, cut off or of another kind") {
  Made made;
  const auto spoil = [&](const std::string& name, std::size_t keep) {
    const std::string bytes = core::read_file(made.path() / name);
    std::ofstream(made.path() / name, std::ios::binary) << bytes.substr(0, keep);
  };
  SUBCASE("a mask of another size") {
    capture::write_png(made.path() / numbered("masks/cam1", 3), filled(
                                                                    1,
                                                                    [](int, int) {
                                                                      return std::array<double, 3>{255, 255, 255};
                                                                    },
                                                                    32, 48));
    CHECK(contains(made.refused(), "masks/cam1/000003.png: is 32x48 pixels"));
  }
  SUBCASE("fewer masks than images") {
    std::filesystem::remove(made.path() / numbered("masks/cam1", 3));
    CHECK(contains(made.refused(), "cameras[1].masks: 3 frames, but images has 4"));
  }
  SUBCASE("a gap") {
    std::filesystem::remove(made.path() / numbered("cam0", 1));
    CHECK(contains(made.refused(), "cam0/000001.png: is missing, though later frames exist"));
  }
  SUBCASE("nothing") {
    std::filesystem::remove_all(made.path() / "cam0");
    CHECK(contains(made.refused(), "cam0/000000.png: is missing"));
  }
  SUBCASE("a cut-off image, an empty one, a text, one with a bit turned in each of its parts") {
    const std::string whole = core::read_file(made.path() / numbered("cam0", 2));
    for (std::size_t at = 8; at < whole.size(); at += 5) {
      std::string damaged = whole;
      damaged[at] ^= 4;
      made.write(numbered("cam0", 2), damaged);
      const std::string error = made.refused();
      CHECK_MESSAGE((contains(error, "000002.png: is damaged; ") || contains(error, "000002.png: is cut off; ")), at);
    }
    spoil(numbered("cam0", 2), 60);
    CHECK(contains(made.refused(), "cam0/000002.png"));
    spoil(numbered("cam0", 2), 0);
    CHECK(contains(made.refused(), "cam0/000002.png"));
    made.write(numbered("cam0", 2), "not an image");
    CHECK(contains(made.refused(), "cam0/000002.png: is not a readable image"));
  }
  SUBCASE("a sound PNG of too little data, of which libpng would print a line") {
    const std::string whole = core::read_file(made.path() / numbered("masks/cam1", 2));
    const auto number = [](std::uint32_t value) {
      std::string bytes;
      for (const int shift : {24, 16, 8, 0}) bytes += static_cast<char>(value >> shift & 0xff);
      return bytes;
    };
    const auto chunk = [&](const std::string& content) {  // name and data
      const auto sum = ::crc32(0, reinterpret_cast<const Bytef*>(content.data()), static_cast<uInt>(content.size()));
      return number(static_cast<std::uint32_t>(content.size() - 4)) + content + number(static_cast<std::uint32_t>(sum));
    };
    const std::string deflated = "\x78\x9c";  // of nothing
    const std::string head = "IHDR" + number(kWidth) + number(kHeight) + std::string("\x08\x00\x00\x00\x00", 5);
    made.write(numbered("masks/cam1", 2), whole.substr(0, 8) + chunk(head) + chunk("IDAT" + deflated) + chunk("IEND"));
    CHECK(contains(made.refused(), "000002.png: has less data than pixels"));
  }
  SUBCASE("a depth image of 8 bits") {
    capture::write_png(made.path() / numbered("depth/cam0", 0), disk_mask(0));
    LoadOptions options;
    options.depth = true;
    CHECK(contains(made.refused(options), "does not have 16 bits"));
  }
  SUBCASE("a video that is cut off, of another size, or too short for the masks") {
    std::vector<Image8> frames(3, filled(3, [](int x, int y) { return std::array<double, 3>{3.0 * x, 4.0 * y, 90}; }));
    capture::write_video(made.path() / "short.mp4", 10.0, frames);
    made.json["cameras"][0]["images"] = "short.mp4";
    Warnings warnings;
    CHECK(made.refused() == "");
    CHECK(warnings.mention("cameras[0].masks: 4 frames, but images has 3"));
    made.json["cameras"][0]["masks"] = "short.mp4";
    made.json["cameras"][0]["images"] = "cam0/%06d.png";
    CHECK(contains(made.refused(), "3 frames, but images has 4"));
    made.json["cameras"][0]["images"] = "short.mp4";
    made.json["cameras"][0]["width"] = 66;
    CHECK(contains(made.refused(), "short.mp4: is 64x48 pixels, the camera has 66x48"));
    made.json["cameras"][0]["width"] = 64;
    spoil("short.mp4", 900);
    CHECK(contains(made.refused(), "short.mp4"));
  }
  SUBCASE("a base with holes in its numbers") {
    made.write("base.tum", "0 0 0 0 0 0 0 1\n0.1 0 inf 0 0 0 0 1\n");
    CHECK(contains(made.refused(), "base.tum:2"));
  }
  SUBCASE("no capture at all") {
    CHECK(contains(error_of([&] { capture::load(made.path() / "nothing"); }), "nothing"));
  }
}

TEST_CASE("warnings name unknown keys, missing numbers and single cameras") {
  Made made;
  Warnings warnings;
  made.json["cameras"][0]["distorsion"] = {0, 0, 0, 0, 0};
  made.json["weather"] = "fine";
  made.json["sigma"] = {{"cameras", {{"rotation", 0.01}}}};  // of which camera?
  made.json.erase("gravity");
  made.load();
  CHECK(warnings.mention("cameras[0].distorsion: unknown key, ignored; is 'distortion' meant?"));
  CHECK(warnings.mention("weather: unknown key"));
  CHECK(warnings.mention("sigma.cameras.rotation: unknown key"));
  CHECK(warnings.mention("gravity: is missing"));
  made.json["cameras"].erase(1);
  made.load();
  CHECK(warnings.mention("only one"));
}

TEST_CASE("a calibration is checked as a camera of a capture is") {
  Made made;
  Warnings warnings;
  const Json good = made.json["cameras"][0];
  const auto read = [&](const Json& camera) {
    made.write("camera.json", camera.dump());
    return capture::read_calibration(made.path() / "camera.json");
  };
  const auto refused = [&](const std::string& key, const Json& value) {
    Json camera = good;
    camera[key] = value;
    try {
      read(camera);
      return std::string();
    } catch (const InputError& error) {
      return std::string(error.what());
    }
  };
  Json camera = good;
  camera.erase("name");
  camera["start"] = 2.5;
  const capture::Calibration calibration = read(camera);
  CHECK(calibration.camera.fx == good["fx"].get<double>());
  CHECK(calibration.rate == good["rate"].get<double>());
  CHECK(calibration.start == 2.5);
  CHECK(read(Json{{"cameras", {good}}}).camera.name == "cam0");  // the same in a whole capture.json
  CHECK(refused("fx", 600.0).empty());
  CHECK(contains(refused("width", 64.5), "camera.json: width"));
  CHECK(contains(refused("fx", 1e300), "camera.json: fx"));
  CHECK(contains(refused("rate", -30), "camera.json: rate"));
  CHECK(contains(refused("rate", 1e-7), "camera.json: rate: 1e-07 is not between 0.1 and 1000000"));
  CHECK(contains(refused("world_from_camera", std::vector<double>(16, 0.0)), "world_from_camera"));
  Json mirrored = good["world_from_camera"];
  for (int c = 0; c < 3; ++c) mirrored[c] = -mirrored[c].get<double>();
  CHECK(contains(refused("world_from_camera", mirrored), "reflection"));
  refused("distorsion", {0.1, 0, 0, 0, 0});
  CHECK(warnings.mention("distorsion: unknown key, ignored; is 'distortion' meant?"));
}

TEST_CASE("truncated and garbled capture.json never do worse than an error") {
  Made made;
  made.load();
  const std::string good = core::read_file(made.path() / "capture.json");
  LoadOptions options;
  options.images = false;
  const auto attempt = [&](const std::string& text) {
    made.write("capture.json", text);
    try {
      capture::load(made.path(), options);
      return std::string();
    } catch (const InputError& error) {
      return std::string(error.what());
    }
  };
  const std::string cut = attempt(good.substr(0, good.size() / 2));
  const std::string line = std::to_string(1 + std::count(good.begin(), good.begin() + good.size() / 2, '\n'));
  CHECK(contains(cut, "capture.json:" + line + ": is not JSON"));
  for (std::size_t size = 0; size < good.size() - 2; size += 13) CHECK(attempt(good.substr(0, size)) != "");
  core::Random random(5);
  int refused = 0;
  constexpr int kTries = 400;
  for (int i = 0; i < kTries; ++i) {
    std::string text = good;
    const int changes = 1 + static_cast<int>(random.uniform(0, 4));
    for (int c = 0; c < changes; ++c) {
      const auto where = static_cast<std::size_t>(random.uniform() * static_cast<double>(text.size()));
      switch (static_cast<int>(random.uniform(0, 4))) {
        case 0:
          text[where] = static_cast<char>(random.next());
          break;
        case 1:
          text.erase(where, static_cast<std::size_t>(random.uniform(1, 40)));
          break;
        case 2:
          text.insert(where, text.substr(where / 2, 20));
          break;
        default:
          text.replace(where, 1, "1e999");
          break;
      }
    }
    refused += attempt(text) != "";
  }
  CHECK(refused > kTries / 2);
  for (const char* text : {"", "[]", "null", "1", "{}", "\"x\"", "{\"format\":1}", "[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[",
                           "{\"format\":\"chainsplat-capture/1\",\"cameras\":[1,null,{}]}"})
    CHECK(attempt(text) != "");
}

TEST_CASE("check: nothing to complain about in the demo; wrong poses, clocks and scales are found") {
  const capture::CheckReport good = capture::check(kDemo);
  CHECK(good.problems.empty());
  CHECK(good.doubts.empty());
  CHECK(any_contains(good.facts, "cam2: 320x240, 60 frames"));

  const Folder folder;
  const Path copy = folder.path / "demo";
  std::filesystem::copy(kDemo, copy, std::filesystem::copy_options::recursive);
  const auto json = nlohmann::ordered_json::parse(core::read_file(kDemo / "capture.json"));
  const auto checked = [&](const nlohmann::ordered_json& changed) {
    core::write_file(copy / "capture.json", changed.dump());
    return capture::check(copy);
  };
  SUBCASE("cameras 20 cm off, across the rope and along it; a rope that leaves the other way") {
    auto changed = json;
    const auto shift = [&](int camera, int element) {
      auto& value = changed["cameras"][camera]["world_from_camera"][element];
      value = value.get<double>() + 0.2;
    };
    shift(0, 3);
    shift(1, 11);
    const capture::CheckReport report = checked(changed);
    CHECK(any_contains(report.doubts, "cam0: the grasp projects"));
    CHECK(any_contains(report.doubts, "of the mask lies behind the grasp"));
    CHECK_FALSE(any_contains(report.doubts, "cam2"));
    changed = json;
    changed["grasp"]["direction"] = {0, 0, 1};
    CHECK(any_contains(checked(changed).doubts, "cam2: 9"));
  }
  SUBCASE("OpenGL axes") {
    auto changed = json;
    for (const int i : {1, 2, 5, 6, 9, 10})
      changed["cameras"][0]["world_from_camera"][i] = -json["cameras"][0]["world_from_camera"][i].get<double>();
    CHECK(any_contains(checked(changed).doubts, "cam0: the grasp is behind the camera"));
  }
  SUBCASE("a clock three frames off") {
    std::vector<trajectory::Sample> samples = trajectory::read_tum(kDemo / "base.tum");
    for (trajectory::Sample& sample : samples) sample.time += 0.1;
    samples.insert(samples.begin(), {0.0, samples.front().pose});
    core::write_file(copy / "base.tum", trajectory::write_tum(samples));
    CHECK(any_contains(checked(json).doubts, "fit the base better 3 frames later"));
  }
  SUBCASE("depth in millimeters, a rate that is not the video's, a mass left out") {
    auto changed = json;
    changed["cameras"][2]["depth_scale"] = 0.001;
    changed["cameras"][1]["rate"] = 31.0;
    changed["object"].erase("mass");
    const capture::CheckReport report = checked(changed);
    CHECK(any_contains(report.doubts, "cam2: the depth images say"));
    CHECK(any_contains(report.doubts, "cam1: the video says 30 frames a second, the capture 31"));
    CHECK(any_contains(report.doubts, "object.mass"));
    CHECK(report.problems.empty());
  }
  SUBCASE("several problems are all named") {
    auto changed = json;
    changed["object"]["length"] = -0.3;
    changed["cameras"][0]["masks"] = "masks/none/%06d.png";
    changed["cameras"][2]["images"] = "cam9.mp4";
    const capture::CheckReport report = checked(changed);
    CHECK(report.problems.size() == 3);
    CHECK(any_contains(report.problems, "object.length"));
    CHECK(any_contains(report.problems, "masks/none/000000.png"));
    CHECK(any_contains(report.problems, "cam9.mp4"));
    CHECK(any_contains(report.facts, "cam1: 320x240"));  // the camera without problems is still described
    CHECK(contains(error_of([&] { capture::load(copy); }), "and 2 more"));
  }
}

TEST_CASE("the truth of a capture: refused when it is not one, absent without it") {
  const Made made;
  made.load();  // writes capture.json
  CHECK_FALSE(capture::load_true_centerline(made.path()).has_value());
  std::filesystem::create_directories(made.path() / "truth");
  made.write("truth/centreline.csv", "frame,time,x0,y0,z0\n0,0.0,1,2,3\n1,0.1,1,2,oops\n");
  CHECK(contains(error_of([&] { capture::load_true_centerline(made.path()); }), "centreline.csv:3: column 5"));
  const std::pair<const char*, const char*> wrong[] = {
      {"", "centreline.csv: has no row"},
      {"frame,time,x0,y0,z0\n", "centreline.csv: has no row"},
      {"t,x,y,z\n0,1,2,3\n", "centreline.csv:1: is not the header"},
      {"frame,time,x0,y0,z0,x1,y1\n0,0,1,2,3,4,5\n", "centreline.csv:1: is not the header"},
      {"frame,time,x0,y0,z0,z1,y1,x1\n0,0,1,2,3,4,5,6\n", "centreline.csv:1: is not the header"},
      {"frame,time,x0,y0,z0\n0,0,1,2,inf\n", "centreline.csv:2: column 5"},
      {"frame,time,x0,y0,z0\n0,0,1,2\n", "centreline.csv:2: 4 columns"},
      {"frame,time,x0,y0,z0\n0,0.1,1,2,3\n1,0.1,1,2,3\n", "centreline.csv:3: its time does not come after"},
  };
  for (const auto& [text, expected] : wrong) {
    made.write("truth/centreline.csv", text);
    const std::string file_text = text;
    INFO(file_text);
    CHECK(contains(error_of([&] { capture::load_true_centerline(made.path()); }), expected));
    CHECK(any_contains(capture::check(made.path()).problems, expected));
    CHECK(error_of([&] { capture::load(made.path()); }).empty());  // training never opens the truth
  }
  made.write("truth/centreline.csv", "frame,time,x0,y0,z0\n0,77,1,2,3\n1,78,1,2,3\n");
  CHECK(any_contains(capture::check(made.path()).doubts, "says nothing of the times of"));
  CHECK(capture::check(made.path()).problems.empty());
}

TEST_CASE("PNG files of every kind are read as OpenImageIO reads them, damaged ones are refused") {
  const Folder folder;
  core::Random random(3);
  constexpr int kWide = 37, kHigh = 23;
  const Path file = folder.path / "a.png";
  const auto write = [&](int channels, OIIO::TypeDesc type, bool interlaced) {
    const std::size_t size = std::size_t{kWide} * kHigh * channels * type.size();
    std::vector<std::uint8_t> pixels(size);
    for (std::uint8_t& p : pixels) p = static_cast<std::uint8_t>(random.next());
    const auto output = OIIO::ImageOutput::create("png");
    OIIO::ImageSpec spec(kWide, kHigh, channels, type);
    spec.attribute("oiio:UnassociatedAlpha", 1);
    if (interlaced) spec.attribute("png:interlaced", 1);
    REQUIRE(output->open(file.string(), spec));
    REQUIRE(output->write_image(type, pixels.data()));
    REQUIRE(output->close());
  };
  const auto other = [&](int channels, OIIO::TypeDesc type) {
    OIIO::ImageSpec options;
    options.attribute("oiio:UnassociatedAlpha", 1);
    const auto input = OIIO::ImageInput::open(file.string(), &options);
    std::vector<std::uint8_t> pixels(std::size_t{kWide} * kHigh * channels * type.size());
    REQUIRE(input->read_image(0, 0, 0, channels, type, pixels.data()));
    return pixels;
  };
  for (const OIIO::TypeDesc& type : {OIIO::TypeDesc(OIIO::TypeDesc::UINT8), OIIO::TypeDesc(OIIO::TypeDesc::UINT16)})
    for (const int channels : {1, 2, 3, 4})
      for (const bool interlaced : {false, true}) {
        CAPTURE(channels);
        write(channels, type, interlaced);
        CHECK(capture::read_mask(file, kWide, kHigh) == other(1, OIIO::TypeDesc::UINT8));
        if (channels >= 3) CHECK(capture::read_rgb(file, kWide, kHigh) == other(3, OIIO::TypeDesc::UINT8));
        if (type.basetype == OIIO::TypeDesc::UINT16) {
          const std::vector<std::uint8_t> bytes = other(1, type);
          const std::vector<float> all = capture::read_depth(file, kWide, kHigh, kHigh, 0.5),
                                   top = capture::read_depth(file, kWide, kHigh, 5, 0.5);
          for (int i = 0; i < kWide * kHigh; ++i) {
            std::uint16_t raw = 0;
            std::memcpy(&raw, &bytes[2 * static_cast<std::size_t>(i)], 2);
            CHECK(all[i] == 0.5f * raw);
            if (i < 5 * kWide) CHECK(top[i] == all[i]);
          }
        } else {
          CHECK_THROWS_WITH_AS(capture::read_depth(file, kWide, kHigh, kHigh, 1.0),
                               doctest::Contains("does not have 16 bits a pixel"), InputError);
        }
      }
  write(1, OIIO::TypeDesc::UINT8, false);
  const std::string whole = core::read_file(file);
  CHECK_THROWS_WITH_AS(capture::read_mask(file, kHigh, kWide), doctest::Contains("is 37x23 pixels"), InputError);
  for (std::size_t i = 8; i < whole.size(); i += 7) {  // behind the signature every byte is under a checksum
    std::string damaged = whole;
    damaged[i] = static_cast<char>(damaged[i] ^ 0x10);
    core::write_file(file, damaged);
    CHECK_THROWS_AS(capture::read_mask(file, kWide, kHigh), InputError);
    core::write_file(file, whole.substr(0, i));
    CHECK_THROWS_AS(capture::read_mask(file, kWide, kHigh), InputError);
  }
}

TEST_CASE("written images and videos come back") {
  const Folder folder;
  core::Random random(1);
  for (const int channels : {1, 3, 4}) {
    Image8 image{13, 7, channels, {}};
    for (int i = 0; i < 13 * 7 * channels; ++i) image.pixels.push_back(static_cast<std::uint8_t>(random.next()));
    capture::write_png(folder.path / "a.png", image);
    const Image8 back = capture::read_image8(folder.path / "a.png");
    CHECK(back.channels == channels);
    CHECK(back.pixels == image.pixels);
  }
  std::vector<float> depth;
  for (int i = 0; i < 13 * 7; ++i) depth.push_back(static_cast<float>(random.uniform(0, 3)));
  capture::write_depth_exr(folder.path / "a.depth.exr", 13, 7, depth);
  CHECK(capture::read_image8(folder.path / "a.depth.exr").width == 13);
  std::string bytes = core::read_file(folder.path / "a.depth.exr");
  const std::string window = std::string("dataWindow") + '\0' + "box2i" + '\0';
  bytes[bytes.find(window) + window.size()] = 15;  // bytes of the attribute, which are 16 always
  core::write_file(folder.path / "short.exr", bytes);
  CHECK_THROWS_WITH_AS(capture::read_image8(folder.path / "short.exr"), doctest::Contains("is damaged"), InputError);
  std::filesystem::remove(folder.path / "short.exr");

  for (const auto& [width, height] : {std::pair{64, 48}, std::pair{33, 21}}) {
    std::vector<Image8> frames;
    for (int k = 0; k < 12; ++k)
      frames.push_back(filled(
          3,
          [&](int x, int y) {
            return std::array<double, 3>{3.0 * x + k, 250.0 - 4 * y, 40.0 + 10 * k};
          },
          width, height));
    capture::write_video(folder.path / "a.mp4", 29.97, frames);
    capture::write_video(folder.path / "b.mp4", 29.97, frames);
    CHECK(core::read_file(folder.path / "a.mp4") == core::read_file(folder.path / "b.mp4"));
    CHECK(capture::video_facts(folder.path / "a.mp4").rate == doctest::Approx(29.97).epsilon(1e-3));
    capture::VideoReader reader(folder.path / "a.mp4");
    Image8 back;
    double squares = 0.0, count = 0.0;
    for (const Image8& frame : frames) {
      REQUIRE(reader.next(back));
      REQUIRE(back.width == width);
      for (std::size_t i = 0; i < back.pixels.size(); ++i, ++count)
        squares += std::pow(back.pixels[i] - frame.pixels[i], 2);
    }
    CHECK_FALSE(reader.next(back));
    CHECK(std::sqrt(squares / count) < 3.0);
  }
  const Image8 small = filled(3, [](int, int) { return std::array<double, 3>{1, 2, 3}; });
  CHECK_THROWS_AS(capture::write_png(folder.path / "missing" / "a.png", small), WorkError);
  CHECK_THROWS_AS(capture::write_video(folder.path / "missing" / "a.mp4", 30.0, {small}), WorkError);
  {
    capture::VideoWriter writer(folder.path / "left.mp4", 30.0);
    writer.add(small);
  }
  for (const auto& entry : std::filesystem::directory_iterator(folder.path))
    CHECK_FALSE(contains(entry.path().string(), "left.mp4"));  // nor its temporary file
}
