// Tests of masks as a call: another program's masks, what is said of them, and what is refused.
#include "chainsplat/masks.h"

#include <doctest/doctest.h>

#include <unistd.h>

#include <cstdio>

namespace {

using namespace chainsplat;

const Path kDemo = Path(CHAINSPLAT_SOURCE_DIR) / "assets/demo_free_30";

struct Folder {
  Path path = std::filesystem::temp_directory_path() / ("chainsplat-masks-" + std::to_string(::getpid()));
  ~Folder() { std::filesystem::remove_all(path); }
};

TEST_CASE("masks of another program are kept as they are, and compared with the capture's own") {
  const Folder folder;
  pipeline::MaskOptions options;
  options.output = folder.path;
  options.frames = {0, 2};
  options.command = [](const std::string& camera, int frame, const capture::Image8& picture) {
    CHECK(picture.width == 320);
    CHECK(picture.channels == 3);
    char name[64];
    std::snprintf(name, sizeof name, "masks/%s/%06d.png", camera.c_str(), frame);
    return capture::read_image8(kDemo / name);
  };
  const pipeline::MaskResult result = pipeline::make_masks(kDemo, options);
  CHECK(result.folder == folder.path);
  CHECK(result.summary.frames == 6);
  CHECK(result.summary.empty == 0);
  CHECK(result.scores.empty());
  REQUIRE(result.agreement.size() == 3);
  for (const auto& [camera, iou] : result.agreement) CHECK(iou == 1.0);
  CHECK(result.agreement[2].first == "cam2");
  CHECK(std::filesystem::exists(folder.path / "cam2/000001.png"));
}

TEST_CASE("what is no mask is refused with its frame, and wrong options by their names") {
  const Folder folder;
  pipeline::MaskOptions options;
  options.output = folder.path;
  options.command = [](const std::string&, int, const capture::Image8&) {
    return capture::Image8{2, 2, 1, std::vector<std::uint8_t>(4, 255)};
  };
  CHECK_THROWS_WITH_AS(pipeline::make_masks(kDemo, options), doctest::Contains("cam0, frame 0: the command's mask"),
                       WorkError);
  options.hints.points.push_back({"cam0", {}, 1.0, 1.0});
  CHECK_THROWS_WITH_AS(options.check(), doctest::Contains("`command`"), InputError);
  options = {};
  options.frames = {0, 2};
  CHECK_THROWS_WITH_AS(options.check(), doctest::Contains("`frames`"), InputError);
  CHECK_THROWS_WITH_AS(pipeline::make_masks(kDemo, {}), doctest::Contains("has masks already"), InputError);
}

}  // namespace
