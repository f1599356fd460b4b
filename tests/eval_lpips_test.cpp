#include "chainsplat/lpips.h"

#include <doctest/doctest.h>

#include <fstream>
#include <nlohmann/json.hpp>

#include "chainsplat/eval.h"
#include "small_twin.h"

using namespace chainsplat;
using Json = nlohmann::json;
using math::Rectangle;

namespace {

const std::string kData = std::string(CHAINSPLAT_SOURCE_DIR) + "/tests/data/lpips/";

struct Example {  // of distances.json, which tests/data/lpips_numbers.py makes
  int width, height;
  std::vector<float> a, b;  // the whole images
  Rectangle object;         // black outside
  double distance;
};

std::vector<float> image(const Json& example, const char* which) {
  const int width = example["width"], height = example["height"];
  const auto factors = example[which].get<std::vector<int>>(), object = example["object"].get<std::vector<int>>();
  std::vector<float> rgb(3u * width * height, 0.0f);
  for (int y = object[1]; y < object[3]; ++y)
    for (int x = object[0]; x < object[2]; ++x)
      for (int c = 0; c < 3; ++c)
        rgb[3u * (static_cast<std::size_t>(width) * y + x) + c] =
            static_cast<float>((factors[0] * x + factors[1] * y + factors[2] * c + factors[3] * x * y) % 256) / 255.0f;
  return rgb;
}

std::vector<Example> examples() {
  std::ifstream file(kData + "distances.json");
  REQUIRE(file.good());
  const Json cases = Json::parse(file)["cases"];
  std::vector<Example> out;
  for (const Json& one : cases) {
    const auto object = one["object"].get<std::vector<int>>();
    out.push_back({one["width"],
                   one["height"],
                   image(one, "a"),
                   image(one, "b"),
                   {object[0], object[1], object[2], object[3]},
                   one["distance"]});
  }
  return out;
}

std::vector<float> cropped(const std::vector<float>& rgb, int width, const Rectangle& crop) {
  std::vector<float> out;
  for (int y = crop.y0; y < crop.y1; ++y) {
    const auto row = rgb.begin() + 3 * (static_cast<std::ptrdiff_t>(width) * y + crop.x0);
    out.insert(out.end(), row, row + 3 * crop.width());
  }
  return out;
}

double whole(const eval::LpipsTrunk& trunk, const Example& e) {
  return eval::lpips(trunk, e.a, e.b, e.width, e.height, e.width, e.height);
}

std::string refusal(const Path& file) {
  try {
    eval::open_lpips_trunk(file);
  } catch (const InputError& error) {
    return error.what();
  }
  return "";
}

}  // namespace

TEST_CASE("LPIPS equals the numbers of NumPy, for images of any size after each other") {
  const eval::LpipsTrunkPtr trunk = eval::open_lpips_trunk(kData + "trunk.onnx");
  const std::vector<Example> all = examples();
  REQUIRE(all.size() >= 4);
  for (int round = 0; round < 2; ++round)
    for (const Example& e : all) {
      CAPTURE(e.width);
      // features are floats
      CHECK(std::abs(whole(*trunk, e) / e.distance - 1.0) < 1e-6);
      CHECK(whole(*trunk, e) == eval::lpips(*trunk, e.b, e.a, e.width, e.height, e.width, e.height));
      CHECK(eval::lpips(*trunk, e.a, e.a, e.width, e.height, e.width, e.height) == 0.0);
    }
}

TEST_CASE("LPIPS of a crop is that of the image around it") {
  const eval::LpipsTrunkPtr trunk = eval::open_lpips_trunk(kData + "trunk.onnx");
  const Example e = examples().back();
  const Rectangle crop = eval::lpips_crop(e.object, e.width, e.height);
  CHECK(crop.x0 > 0);
  CHECK(crop.y1 < e.height);
  const double distance = eval::lpips(*trunk, cropped(e.a, e.width, crop), cropped(e.b, e.width, crop), crop.width(),
                                      crop.height(), e.width, e.height);
  // this trunk sees less far than the crop's margin, so that nothing is lost
  CHECK(std::abs(distance / e.distance - 1.0) < 1e-6);

  // at the image's border, and where the image is hardly larger than the least
  for (const Rectangle& object :
       {Rectangle{0, 0, 1, 1}, {639, 479, 640, 480}, {0, 100, 640, 101}, {300, 7, 309, 480}}) {
    const Rectangle c = eval::lpips_crop(object, 640, 480);
    CHECK(c.x0 % 16 == 0);
    CHECK(c.y0 % 16 == 0);
    CHECK(std::min(c.width(), c.height()) >= eval::kLeastLpipsSide);
    CHECK(math::intersection(object, c).width() == object.width());
    CHECK(math::intersection(c, {0, 0, 640, 480}).height() == c.height());
  }
  CHECK(eval::lpips_crop({63, 63, 64, 65}, 64, 65).height() == 65);
}

TEST_CASE("LPIPS does not depend on threads") {
  const eval::LpipsTrunkPtr trunk = eval::open_lpips_trunk(kData + "trunk.onnx");
  const std::vector<Example> all = examples();
  core::set_threads(1);
  std::vector<double> alone, together(4 * all.size());
  for (const Example& e : all) alone.push_back(whole(*trunk, e));
  core::set_threads(4);
  core::parallel_for(static_cast<std::int64_t>(together.size()),
                     [&](std::int64_t k) { together[k] = whole(*trunk, all[k % all.size()]); });
  core::set_threads(0);
  for (std::size_t k = 0; k < together.size(); ++k) CHECK(together[k] == alone[k % all.size()]);
}

TEST_CASE("LPIPS of a frame is that of the whole masked pictures") {
  const eval::LpipsTrunkPtr trunk = eval::open_lpips_trunk(kData + "trunk.onnx");
  const Example e = examples().back();
  capture::Camera camera;
  camera.width = e.width;
  camera.height = e.height;
  camera.fx = camera.fy = 300;
  capture::View view;  // the recorded one has a margin that the drawn one has not
  const Rectangle recorded = math::grown(e.object, 9), drawn = e.object;
  view.x0 = recorded.x0, view.y0 = recorded.y0, view.width = recorded.width(), view.height = recorded.height();
  const std::vector<float> b = cropped(e.b, e.width, recorded), a = cropped(e.a, e.width, drawn);
  for (std::size_t k = 0; k < b.size(); k += 3) {
    for (int c = 0; c < 3; ++c) view.rgba.push_back(static_cast<std::uint8_t>(std::lround(255 * b[k + c])));
    view.rgba.push_back(255);
  }
  render::Frame frame;
  frame.x0 = drawn.x0, frame.y0 = drawn.y0;
  frame.picture.width = drawn.width(), frame.picture.height = drawn.height();
  for (std::size_t k = 0; k < a.size(); k += 3)
    frame.picture.rgba.insert(frame.picture.rgba.end(), {a[k], a[k + 1], a[k + 2], 1.0f});

  CHECK(eval::compare(frame, view, camera, trunk.get()).lpips == doctest::Approx(e.distance).epsilon(1e-6));
  CHECK(std::isnan(eval::compare(frame, view, camera).lpips));
  CHECK(eval::compare({}, {}, camera, trunk.get()).lpips == 0.0);  // nothing drawn, nothing recorded

  eval::Metrics metrics;
  metrics.mean = eval::compare(frame, view, camera, trunk.get());
  CHECK(Json::parse(eval::to_json(metrics))["mean"]["lpips"] == metrics.mean.lpips);
}

TEST_CASE("what is no trunk is refused in one line") {
  const test::TemporaryFolder folder("trunk");
  const Path file = folder.path / "bad.onnx";
  const std::string bytes = core::read_file(kData + "trunk.onnx");
  const auto says = [](const Path& name, const std::string& what) {
    const std::string line = refusal(name);
    CAPTURE(line);
    CHECK(line.find(name.string() + ": ") == 0);
    CHECK(line.find(what) != std::string::npos);
    CHECK(line.find('\n') == std::string::npos);
    CHECK(line.find("; ") != std::string::npos);
  };
  says(folder.path / "missing.onnx", "No such file");
  says(folder.path, "is a folder");
  for (const std::string& other : {std::string(), std::string("no network\n"), bytes.substr(0, bytes.size() / 2),
                                   std::string("\x89PNG\r\n\x1a\n"), std::string(1000, '\0')}) {
    core::write_file(file, other);
    says(file, "is no network");
  }
  says(kData + "one_output.onnx", "has 1 output, not");
  says(kData + "channels.onnx", "3, 3, 3, 3, 3 channels");
  // weights so large that sums of them are infinite; the last time that a name is written its numbers follow
  std::string spoiled = bytes;
  const std::size_t at = spoiled.rfind("weights1");
  REQUIRE(at != std::string::npos);
  std::fill_n(spoiled.begin() + static_cast<std::ptrdiff_t>(at) + 16, 88, '\x7f');
  core::write_file(file, spoiled);
  says(file, "not finite");
}

TEST_CASE("a damaged trunk is refused or read, and never ends the program") {
  const test::TemporaryFolder folder("damaged");
  const Path file = folder.path / "damaged.onnx";
  const std::string whole = core::read_file(kData + "channels.onnx");  // small, so that most damage is to its frame
  core::Random random(5);
  constexpr int kTries = 400;
  int refused = 0;
  for (int i = 0; i < kTries; ++i) {
    std::string bytes = whole;
    const int changes = 1 + static_cast<int>(4.0 * random.uniform());
    for (int k = 0; k < changes; ++k) {
      const auto at = static_cast<std::size_t>(random.uniform() * static_cast<double>(bytes.size()));
      const double what = random.uniform();
      if (what < 0.6)
        bytes[at] = static_cast<char>(static_cast<std::uint8_t>(256.0 * random.uniform()));
      else if (what < 0.8)
        bytes.erase(at, 1 + static_cast<std::size_t>(8.0 * random.uniform()));
      else
        bytes.insert(at, bytes.substr(at, static_cast<std::size_t>(8.0 * random.uniform())));
    }
    core::write_file(file, bytes);
    const std::string line = refusal(file);
    CAPTURE(line);
    CHECK(line.find('\n') == std::string::npos);
    refused += line.find("can take (") != std::string::npos;
  }
  CHECK(refused > kTries / 2);
}
