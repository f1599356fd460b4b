// The paper's procedure: what it takes from others, growth of Gaussians, and going on after a stop.
#include <doctest/doctest.h>
#include <unistd.h>

#include <algorithm>
#include <cmath>
#include <filesystem>

#include "chainsplat/recognition.h"
#include "src/recognition/growth.h"

using namespace chainsplat;
using namespace chainsplat::recognition;

namespace {

const Path kDemo = Path(CHAINSPLAT_SOURCE_DIR) / "assets/demo_free_30";

float logit(double p) { return static_cast<float>(std::log(p / (1.0 - p))); }

// Isotropic Gaussians of these deviations (m) and opacities, one after the other along x.
splat::Gaussians row(const std::vector<std::pair<double, double>>& deviations_and_opacities) {
  splat::Gaussians g;
  g.resize(static_cast<int>(deviations_and_opacities.size()), 2, 0);
  for (int i = 0; i < g.count; ++i) {
    const auto [deviation, opacity] = deviations_and_opacities[i];
    g.mean[3 * i] = static_cast<float>(i);
    for (int c = 0; c < 3; ++c) g.log_scale[3 * i + c] = static_cast<float>(std::log(deviation));
    g.opacity_logit[i] = logit(opacity);
    g.link_logits[2 * i] = static_cast<float>(i);
  }
  return g;
}

// So that Gaussian i is pulled by `pulls[i]` in every step in which it is seen.
Pull pulled(const std::vector<double>& pulls) {
  constexpr double kPerMeter = 2.0, kScale = 0.5;
  splat::Gaussians gradient;
  gradient.resize(static_cast<int>(pulls.size()), 2, 0);
  Pull pull;
  for (int step = 0; step < 3; ++step) {
    for (int i = 0; i < gradient.count; ++i) {
      const double along = pulls[i] * kPerMeter / kScale;
      gradient.mean[3 * i] = static_cast<float>(0.6 * along);
      gradient.mean[3 * i + 1] = static_cast<float>((step % 2 == 0 ? 0.8 : -0.8) * along);  // to and fro counts, too
    }
    add_step(gradient, kScale, kPerMeter, pull);
  }
  return pull;
}

}  // namespace

TEST_CASE("what is pulled becomes two, what is not seen goes") {
  constexpr double kSmall = 0.005, kLarge = 0.05, kStrong = 0.0007, kWeak = 0.0005;  // m; of half an image
  const splat::Gaussians before =
      row({{kSmall, 0.5}, {kSmall, 0.5}, {kLarge, 0.5}, {kLarge, 0.5}, {kSmall, 0.004}, {0.2, 0.5}});
  const Pull pull = pulled({kWeak, kStrong, kWeak, kStrong, kStrong, kWeak});
  CHECK(pull.steps == std::vector<int>(6, 3));
  CHECK(pull.sum[1] / 3.0 == doctest::Approx(kStrong).epsilon(1e-6));
  GrowthLimits limits;
  limits.extent = 1.0;
  limits.pixels_per_meter = 100.0;
  limits.most = 100;
  core::Random random(3);
  const Grown grown = grow(before, pull, limits, random);
  CHECK(grown.kept == std::vector{0, 1, 2, 5});  // 3 is split, 4 is transparent
  REQUIRE(grown.added.count == 3);
  CHECK(grown.added.mean[0] == before.mean[3]);  // a copy of 1
  CHECK(grown.added.log_scale[0] == before.log_scale[3]);
  CHECK(grown.added.link_logits[0] == 1.0f);
  for (const int half : {1, 2}) {
    CHECK(std::exp(grown.added.log_scale[3 * half]) == doctest::Approx(kLarge / 1.6).epsilon(1e-5));
    const double off = std::hypot(grown.added.mean[3 * half] - 3.0, grown.added.mean[3 * half + 1]);
    CHECK(off > 0.0);
    CHECK(off < 4.0 * kLarge);
  }
  CHECK(grown.added.mean[3] != grown.added.mean[6]);

  limits.prune_large = true;  // 5 covers 60 px, 2 and 3 cover 15
  core::Random other(3);
  CHECK(grow(before, pull, limits, other).kept == std::vector{0, 1, 2});
  limits.most = 6;
  const Grown full = grow(before, pull, limits, other);
  CHECK(full.kept == std::vector{0, 1, 2, 3});
  CHECK(full.added.count == 0);
}

TEST_CASE("choices of the paper's mode are read as they are written") {
  CHECK(text_of({}) == "");
  CHECK(text_of(read_paper_choices("", "a")) == "");
  const std::string all = "background=white,growth=no,resets=opacity,gaussians=100,iterations=700";
  const PaperChoices read = read_paper_choices(all, "a");
  CHECK(text_of(read) == all);
  CHECK(read.background == Background::white);
  CHECK(read.opacity_resets);
  CHECK_FALSE(read.link_resets);
  CHECK(text_of(read_paper_choices("background=random,growth=yes,resets=both", "a")) == "");
  for (const char* wrong : {"white", "background=", "background=gray", "growth=maybe", "gaussians=0", "iterations=1.5",
                            "iterations=99999999999", "=", "rate=1"})
    CHECK_THROWS_WITH_AS(read_paper_choices(wrong, "jobs.toml: x"), doctest::Contains("jobs.toml: x: "), InputError);
}

// A recording is recognized twice by all of the procedure, so this is of the suite "whole".
TEST_CASE("the paper's procedure goes on after a stop with the same bits, growth included" *
          doctest::test_suite("whole")) {
  const Path folder = std::filesystem::temp_directory_path() / ("chainsplat_paper_" + std::to_string(getpid()));
  std::filesystem::remove_all(folder);
  const gpu::DevicePtr device = gpu::open_device();
  capture::LoadOptions load;
  load.last = 6;
  const capture::Capture capture = capture::load(kDemo, load);
  Options options;
  options.mode = Mode::paper;
  options.every = 2;
  options.paper.gaussians = 400;
  options.paper.iterations = 730;  // Gaussians change after 600 and 700
  const Result whole = recognize(*device, capture, options);
  CHECK(whole.gaussians.count != 400);
  CHECK(whole.states.theta.size() == 6);

  options.checkpoint = folder;
  core::Listener impatient;
  impatient.progress = [](const core::Progress& p) {
    if (p.step == 650) core::request_stop(15);
  };
  core::set_listener(impatient);
  CHECK_THROWS_AS(recognize(*device, capture, options), Interrupted);
  core::set_listener({});
  core::request_stop(0);
  options.resume = true;
  const Result resumed = recognize(*device, capture, options);
  CHECK(resumed.gaussians.mean == whole.gaussians.mean);
  CHECK(resumed.gaussians.link_logits == whole.gaussians.link_logits);
  CHECK(resumed.states.theta == whole.states.theta);
  std::filesystem::remove_all(folder);
}
