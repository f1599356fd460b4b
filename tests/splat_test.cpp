// Compares the device's splatting engine (chainsplat/splat.h) with the double-precision renderer of
// reference_renderer.h.
//
// A float device and a double host may decide the discrete rules (1/255 skip, 1e-4 stop, order of two depths)
// differently if a number lies within rounding of its threshold. The reference knows for each pixel whether that can
// happen, and bounds the change (reference::Doubt): pixels beyond doubt are compared strictly, the others within the
// bound, and their share is limited. Gradients are compared where no pixel is in doubt, or without the rules.
#include "chainsplat/splat.h"

#include <doctest/doctest.h>

#include <array>
#include <cstring>
#include <fstream>
#include <nlohmann/json.hpp>
#include <numbers>
#include <numeric>
#include <string>

#include "chainsplat/image_model.h"
#include "reference_renderer.h"
#include "shaders/shared/splat.h"
#include "src/splat/engine.h"

using namespace chainsplat;
using splat::Engine;
using splat::Gaussians;
using splat::LossWeights;
using splat::Settings;
using splat::ViewSpec;

namespace {

// Float rounding (6e-8) of pixel coordinates up to 50 px, through conics up to 1/0.3 px^-2, summed over the entries.
constexpr double kImageTolerance = 2e-5;
// Relative to the largest entry of a kind (design.md, 'Reference vectors'): the same rounding, through quotients and
// cancellation.
constexpr double kGradientTolerance = 1e-3;
// Relative to the largest entry of one Gaussian's row, so that an error of a weak Gaussian does not hide behind a
// strong one; plus kRowFloor of the kind's largest entry, since cancellation leaves much smaller rows no digits.
constexpr double kRowTolerance = 1e-2, kRowFloor = 1e-4;
// Gradients of at most this size come from alphas that are lost when added to 1 in float (as is the sign of
// alpha - mask); losses are of order 1, lengths of order 0.1 m.
constexpr double kNothing = 1e-8;
// For sums of some thousand floats.
constexpr double kLossTolerance = 1e-5;

gpu::Device& device() {
  static const gpu::DevicePtr opened = [] {
    gpu::DeviceOptions options;
    options.validation = true;
    return gpu::open_device(options);
  }();
  return *opened;
}

// One engine per setting in use, because making its pipelines takes most of a test's time.
Engine& engine(bool exact_cutoffs = true) {
  static Engine with(device());
  static Engine without(device(), [] {
    Settings settings;
    settings.exact_cutoffs = false;
    return settings;
  }());
  return exact_cutoffs ? with : without;
}

// Every test case ends with this check.
void check_silent() {
  const std::vector<std::string> texts = gpu::validation_texts(device());
  CHECK(gpu::validation_messages(device()) == 0);
  CHECK_MESSAGE(texts.empty(), (texts.empty() ? std::string() : texts.front()));
}

// --- scenes ----------------------------------------------------------------------------------------------------------

struct Scene {
  Gaussians gaussians;
  std::vector<capture::Camera> cameras;
  std::vector<ViewSpec> views;  // they point into `cameras`
  std::vector<std::vector<std::uint8_t>> targets;

  std::vector<const std::vector<std::uint8_t>*> target_pointers() const {
    std::vector<const std::vector<std::uint8_t>*> out;
    for (const auto& t : targets) out.push_back(&t);
    return out;
  }
  mutable std::vector<capture::PackedView> packed_targets;  // as packed_pointers() made them
  std::vector<const capture::PackedView*> packed_pointers() const {
    packed_targets.clear();
    for (std::size_t v = 0; v < views.size(); ++v) {
      capture::View whole;
      whole.width = views[v].width, whole.height = views[v].height;
      whole.rgba = targets[v];
      packed_targets.push_back(capture::packed(whole));
    }
    std::vector<const capture::PackedView*> out;
    for (const capture::PackedView& target : packed_targets) out.push_back(&target);
    return out;
  }
  std::vector<reference::Target> reference_targets() const {
    std::vector<reference::Target> out;
    for (const auto& t : targets) out.push_back(reference::target(t));
    return out;
  }
};

capture::Camera make_camera(int width, int height, double focal, const math::Pose& world_from_camera) {
  capture::Camera camera;
  camera.width = width;
  camera.height = height;
  camera.fx = focal;
  camera.fy = 1.03 * focal;
  camera.cx = 0.5 * width + 0.7;
  camera.cy = 0.5 * height - 0.4;
  camera.world_from_camera = world_from_camera;
  return camera;
}

math::Pose pose(double wx, double wy, double wz, double x, double y, double z) {
  return {math::exp_so3({wx, wy, wz}), {x, y, z}};
}

enum class Logits { soft, sharp };

// Gaussians along a rope of 0.2 m, 0.35 m in front of a camera that looks along world z.
Gaussians random_gaussians(core::Random& random, int count, int links, int degree, Logits logits, double size = 0.006) {
  Gaussians g;
  g.resize(count, links, degree);
  for (int i = 0; i < count; ++i) {
    const double along = random.uniform(0.0, 0.2);
    const double mean[3] = {along - 0.1, 0.012 * random.normal(), 0.012 * random.normal()};
    for (int k = 0; k < 3; ++k) {
      g.mean[3 * i + k] = static_cast<float>(mean[k]);
      g.log_scale[3 * i + k] = static_cast<float>(std::log(size) + 0.5 * random.normal());
    }
    for (int k = 0; k < 4; ++k) g.rotation[4 * i + k] = static_cast<float>(random.normal());
    g.opacity_logit[i] = static_cast<float>(0.5 + 1.5 * random.normal());
    const int owner = std::min(links - 1, static_cast<int>(along / 0.2 * links));
    for (int j = 0; j < links; ++j)
      g.link_logits[links * i + j] =
          static_cast<float>(random.normal() + (logits == Logits::sharp && j == owner ? 9.0 : 0.0));
  }
  for (float& c : g.sh) c = static_cast<float>((degree > 0 ? 0.25 : 0.6) * random.normal());
  return g;
}

// Link motions of a bent chain that place the rope in front of the cameras.
std::vector<math::Pose> random_motions(core::Random& random, int links) {
  std::vector<math::Pose> motions{pose(0.2 * random.normal(), 0.2 * random.normal(), 0.3 * random.normal(),
                                       0.01 * random.normal(), 0.01 * random.normal(), 0.35)};
  for (int j = 1; j < links; ++j) {
    const math::Vector3 joint(0.2 * j / links - 0.1, 0.0, 0.0);
    const math::Matrix3 bend =
        math::exp_so3(0.25 * math::Vector3(0.3 * random.normal(), random.normal(), random.normal()));
    motions.push_back(motions.back() * math::Pose{bend, joint - bend * joint});
  }
  return motions;
}

// Patches of noise with partial masks; RGB is 0 where the mask is 0.
std::vector<std::uint8_t> random_target(core::Random& random, int width, int height) {
  std::vector<std::uint8_t> rgba(4 * static_cast<std::size_t>(width) * height, 0);
  for (int y = 0; y < height; ++y) {
    for (int x = 0; x < width; ++x) {
      if (std::abs(y - 0.5 * height) > 0.3 * height) continue;
      std::uint8_t* p = &rgba[4 * (static_cast<std::size_t>(y) * width + x)];
      for (int c = 0; c < 3; ++c) p[c] = static_cast<std::uint8_t>(255.0 * random.uniform());
      p[3] = static_cast<std::uint8_t>(x % 5 == 0 ? 1.0 + 254.0 * random.uniform() : 255.0);
    }
  }
  return rgba;
}

math::Matrix3 quadratic_light() {
  math::Matrix3 q;
  q << 0.1, -0.04, 0.06, -0.04, 0.12, 0.05, 0.06, 0.05, -0.15;
  return q;
}

// Three views with different sizes and cameras, of two poses of the rope: a whole image, a crop, and a tall image.
Scene random_scene(std::uint64_t seed, int count, int links, int degree, Logits logits, double size = 0.006) {
  core::Random random(seed);
  Scene s;
  s.gaussians = random_gaussians(random, count, links, degree, logits, size);
  if (seed % 2) s.gaussians.light = {math::Vector3::UnitX(), 0.7, {0.1, -0.2, 0.15}, quadratic_light()};
  if (seed % 3 == 0) s.gaussians.pixel_footprint = 0.006;  // between those of the nearest and the farthest splats
  s.cameras = {make_camera(52, 36, 70.0, {}), make_camera(60, 41, 66.0, pose(0.05, -0.2, 0.3, 0.06, 0.01, -0.02)),
               make_camera(21, 45, 60.0, pose(0.0, 0.1, 1.4, -0.02, 0.0, 0.03))};
  // one whose pictures are otherwise exposed, so that some colors are cut off at black and at white
  s.cameras[1].gain = {0.8, 1.1, 1.3};
  s.cameras[1].bias = {0.05, -0.1, 0.02};
  const std::vector<math::Pose> first = random_motions(random, links), second = random_motions(random, links);
  s.views = {{&s.cameras[0], 0, 0, 52, 36, first},
             {&s.cameras[1], 9, 5, 37, 23, second},
             {&s.cameras[2], 0, 0, 21, 45, first}};
  for (const ViewSpec& view : s.views) s.targets.push_back(random_target(random, view.width, view.height));
  return s;
}

// --- comparisons -----------------------------------------------------------------------------------------------------

// Returns the share of pixels where rounding may decide a rule.
double check_picture(const splat::Picture& got, const reference::Picture& wanted, double tolerance = kImageTolerance) {
  REQUIRE(got.width == wanted.width);
  REQUIRE(got.height == wanted.height);
  REQUIRE(got.rgba.size() == wanted.rgba.size());
  double worst = 0.0, worst_excess = 0.0;
  for (std::size_t k = 0; k < got.rgba.size(); ++k) {
    double error = std::abs(got.rgba[k] - wanted.rgba[k]);
    if (!std::isfinite(got.rgba[k])) error = INFINITY;
    if (!wanted.doubtful[k / 4]) worst = std::max(worst, error);
    // the bound is of first order; the hundredth is for its own error
    worst_excess = std::max(worst_excess, error - 1.01 * wanted.change[k / 4]);
  }
  CHECK(worst <= tolerance);
  CHECK(worst_excess <= tolerance);
  return wanted.rgba.empty() ? 0.0 : wanted.doubtful_count() / (0.25 * static_cast<double>(wanted.rgba.size()));
}

template <class Got>
void check_kind(const std::string& name, const Got& got, const std::vector<double>& wanted, std::size_t row,
                double tolerance) {
  REQUIRE(got.size() == wanted.size());
  double largest = 0.0, worst = 0.0, worst_row = 0.0;
  for (const double x : wanted) largest = std::max(largest, std::abs(x));
  for (std::size_t first = 0; first < wanted.size(); first += row) {
    double row_largest = 0.0, row_error = 0.0;
    for (std::size_t k = first; k < first + row; ++k) {
      row_largest = std::max(row_largest, std::abs(wanted[k]));
      row_error = std::max(row_error, std::isfinite(got[k]) ? std::abs(got[k] - wanted[k]) : INFINITY);
    }
    worst = std::max(worst, row_error);
    worst_row = std::max(worst_row, row_error - kRowTolerance * row_largest);
  }
  INFO(name, ": error ", worst, " of ", largest);
  CHECK(worst <= tolerance * largest + kNothing);
  CHECK(worst_row <= kRowFloor * largest + kNothing);
}

void check_gradients(const splat::Gradients& got, const reference::Evaluation& wanted,
                     double tolerance = kGradientTolerance) {
  const reference::Parameters<double> g = reference::parameters(got.gaussians);
  const std::size_t rows[6] = {3, 4, 3, 1, 3u * g.coefficients(), static_cast<std::size_t>(g.links)};
  for (int kind = 0; kind < 6; ++kind)
    check_kind(reference::kKindNames[kind], *g.kinds()[kind], *wanted.gradient.kinds()[kind], rows[kind], tolerance);
  REQUIRE(got.link_twists.size() == wanted.link_twists.size());
  for (std::size_t v = 0; v < wanted.link_twists.size(); ++v) {
    // moments and forces are two kinds, because their units differ
    for (const int half : {0, 1}) {
      const math::MatrixX a = got.link_twists[v].middleRows(3 * half, 3),
                          b = wanted.link_twists[v].middleRows(3 * half, 3);
      REQUIRE(a.cols() == b.cols());
      check_kind(half == 0 ? "link moment" : "link force", std::vector<double>(a.data(), a.data() + a.size()),
                 {b.data(), b.data() + b.size()}, 3, tolerance);
    }
  }
}

void check_losses(const splat::LossValues& got, const Scene& scene, const reference::Evaluation& wanted) {
  REQUIRE(got.l1.size() == wanted.losses.size());
  for (std::size_t v = 0; v < wanted.losses.size(); ++v) {
    CHECK(std::abs(got.l1[v] - wanted.losses[v].l1) <= kLossTolerance);
    CHECK(std::abs(got.ssim[v] - wanted.losses[v].ssim) <= kLossTolerance);
    CHECK(std::abs(got.mask[v] - wanted.losses[v].mask) <= kLossTolerance);
    constexpr double kDecibels = 1e-3;  // a relative error of 2e-4 of the squared error
    CHECK(std::abs(got.psnr_object[v] -
                   reference::psnr_object(wanted.pictures[v], reference::target(scene.targets[v]))) <= kDecibels);
  }
  CHECK(std::abs(got.total - wanted.total) <= kLossTolerance * static_cast<double>(wanted.losses.size()));
}

int doubtful(const reference::Evaluation& evaluation) {
  int sum = 0;
  for (const auto& p : evaluation.pictures) sum += p.doubtful_count();
  return sum;
}

// A random scene whose pixels are all beyond doubt, with its gradients.
template <class Make>
std::pair<Scene, reference::Evaluation> clear_scene(Make make, const LossWeights& weights, double normalizer) {
  constexpr std::uint64_t kTries = 40;
  for (std::uint64_t seed = 1; seed <= kTries; ++seed) {
    Scene scene = make(seed);
    int doubts = 0;
    for (const ViewSpec& view : scene.views)
      doubts += reference::draw(reference::parameters(scene.gaussians), view).doubtful_count();
    if (doubts > 0) continue;
    auto wanted = reference::evaluate(reference::parameters(scene.gaussians), scene.views, scene.reference_targets(),
                                      weights, normalizer);
    return {std::move(scene), std::move(wanted)};
  }
  FAIL("no scene of the family keeps away from the thresholds");
  return {};
}

bool same_bits(const std::vector<float>& a, const std::vector<float>& b) {
  return a.size() == b.size() && std::memcmp(a.data(), b.data(), a.size() * sizeof(float)) == 0;
}
bool same_bits(const Gaussians& a, const Gaussians& b) {
  return same_bits(a.mean, b.mean) && same_bits(a.rotation, b.rotation) && same_bits(a.log_scale, b.log_scale) &&
         same_bits(a.opacity_logit, b.opacity_logit) && same_bits(a.sh, b.sh) &&
         same_bits(a.link_logits, b.link_logits);
}

constexpr LossWeights kAllTerms{0.8f, 0.2f, 0.3f}, kOnGray{0.8f, 0.2f, 0.1f, 0.7f};

}  // namespace

TEST_CASE("the device equals the splat vectors") {
  std::ifstream stream(std::string(CHAINSPLAT_SOURCE_DIR) + "/tests/data/vectors/splat.json");
  REQUIRE(stream.good());
  const auto file = nlohmann::json::parse(stream);
  const auto put = [](const nlohmann::json& rows, std::vector<float>& out) {
    std::size_t k = 0;
    const auto walk = [&](const auto& self, const nlohmann::json& item) -> void {
      if (item.is_number()) {
        out.at(k++) = item.get<float>();
      } else {
        for (const auto& inner : item) self(self, inner);
      }
    };
    walk(walk, rows);
    REQUIRE(k == out.size());
  };
  Scene scene;
  Gaussians& g = scene.gaussians;
  g.resize(12, 4, file["sh_degree"]);
  put(file["gaussians"]["mean"], g.mean);
  put(file["gaussians"]["quat"], g.rotation);
  put(file["gaussians"]["log_scale"], g.log_scale);
  put(file["gaussians"]["opacity_logit"], g.opacity_logit);
  put(file["gaussians"]["sh"], g.sh);
  put(file["gaussians"]["link_logits"], g.link_logits);
  const auto& c = file["camera"];
  math::Pose camera_from_world;
  for (int r = 0; r < 3; ++r) {
    for (int k = 0; k < 3; ++k) camera_from_world.rotation(r, k) = c["R_cs"][r][k];
    camera_from_world.translation[r] = c["p_cs"][r];
  }
  capture::Camera camera;
  camera.width = file["width"];
  camera.height = file["height"];
  camera.fx = c["fx"];
  camera.fy = c["fy"];
  camera.cx = c["cx"];
  camera.cy = c["cy"];
  camera.world_from_camera = camera_from_world.inverse();
  scene.cameras = {camera};
  ViewSpec view{&scene.cameras[0], 0, 0, camera.width, camera.height, {}};
  for (const auto& m : file["chain"]["link_motions"]) {
    math::Pose motion;
    for (int r = 0; r < 3; ++r) {
      for (int k = 0; k < 3; ++k) motion.rotation(r, k) = m[r][k];
      motion.translation[r] = m[r][3];
    }
    view.motions.push_back(motion);
  }
  scene.views = {view};
  // the vectors were computed without a clamp in the projection
  Settings settings;
  settings.projection_clamp = false;
  Engine unclamped(device(), settings);
  reference::Rules rules;
  rules.clamp = false;

  const splat::Picture drawn = unclamped.draw(g, scene.views)[0];
  double worst = 0.0;
  for (int y = 0; y < camera.height; ++y) {
    for (int x = 0; x < camera.width; ++x) {
      const float* p = &drawn.rgba[4 * (static_cast<std::size_t>(y) * camera.width + x)];
      for (int k = 0; k < 3; ++k) worst = std::max(worst, std::abs(p[k] - file["image"][y][x][k].get<double>()));
      worst = std::max(worst, std::abs(p[3] - file["alpha"][y][x].get<double>()));
    }
  }
  CHECK(worst <= kImageTolerance);

  // Targets on the device have 8 bits, those of the vectors do not. The expected gradient is therefore the reference's
  // for the rounded target; splat_reference_test.cpp compares the reference with the vectors.
  std::vector<std::uint8_t> target;
  for (int y = 0; y < camera.height; ++y) {
    for (int x = 0; x < camera.width; ++x) {
      for (int k = 0; k < 3; ++k)
        target.push_back(static_cast<std::uint8_t>(std::lround(255.0 * file["target"][y][x][k].get<double>())));
      target.push_back(255);
    }
  }
  scene.targets = {target};
  const LossWeights weights;
  const auto wanted =
      reference::evaluate(reference::parameters(g), scene.views, scene.reference_targets(), weights, 0.0, rules);
  CHECK(doubtful(wanted) == 0);
  splat::Gradients gradients;
  const auto losses = unclamped.loss(g, scene.views, scene.target_pointers(), weights, 0.0, &gradients);
  check_losses(losses, scene, wanted);
  check_gradients(gradients, wanted);
  check_silent();
}

TEST_CASE("pictures of random scenes equal the reference's with all rules on") {
  struct Case {
    int count, links, degree;
    Logits logits;
    double size;  // m
    // factor by which one axis is longer and the others are thinner: rectangles hold many tiles that the ellipse misses
    double needle = 1.0;
  };
  int number = 0;
  for (const Case& c : {Case{60, 4, 0, Logits::soft, 0.006}, Case{150, 9, 0, Logits::sharp, 0.004},
                        Case{40, 2, 1, Logits::soft, 0.012}, Case{30, 3, 2, Logits::sharp, 0.008},
                        Case{80, 1, 3, Logits::soft, 0.005}, Case{60, 3, 0, Logits::sharp, 0.008, 5.0}}) {
    CAPTURE(number);
    Scene scene = random_scene(100 + number++, c.count, c.links, c.degree, c.logits, c.size);
    for (std::size_t k = 0; k < scene.gaussians.log_scale.size(); ++k)
      scene.gaussians.log_scale[k] += static_cast<float>((k % 3 == 0 ? 1.0 : -1.0) * std::log(c.needle));
    const auto pictures = engine().draw(scene.gaussians, scene.views, true);
    REQUIRE(pictures.size() == 3);
    for (int v = 0; v < 3; ++v) {
      const auto wanted = reference::draw(reference::parameters(scene.gaussians), scene.views[v]);
      // the bands of 2e-4 around 1/255 are crossed by the rims of some dozens of splats
      constexpr double kDoubtfulShare = 0.05;
      CHECK(check_picture(pictures[v], wanted) <= kDoubtfulShare);
      REQUIRE(pictures[v].depth.size() == wanted.depth.size());
      double worst = 0.0;
      for (std::size_t k = 0; k < wanted.depth.size(); ++k) {
        constexpr double kRim = 1e-3;  // alpha this close to 1/2 may decide differently whether there is a depth
        if (wanted.doubtful[k] || std::abs(wanted.rgba[4 * k + 3] - 0.5) < kRim) continue;
        worst = std::max(worst, std::abs(pictures[v].depth[k] - wanted.depth[k]));
      }
      // a quotient of two sums, each within the image tolerance, of depths below 1 m
      CHECK(worst <= 2.0 * kImageTolerance);
    }
  }
  check_silent();
}

TEST_CASE("gradients equal the reference's, all rules on, in scenes away from the thresholds") {
  struct Case {
    int count, links, degree;
    Logits logits;
  };
  for (const Case& c : {Case{20, 4, 0, Logits::soft}, Case{30, 3, 1, Logits::sharp}, Case{14, 2, 2, Logits::soft},
                        Case{14, 1, 3, Logits::sharp}}) {
    CAPTURE(c.degree);
    constexpr double kNormalizer = 3000.0;
    const auto [scene, wanted] = clear_scene(
        [&](std::uint64_t seed) { return random_scene(1000 * c.degree + seed, c.count, c.links, c.degree, c.logits); },
        kAllTerms, kNormalizer);
    splat::Gradients gradients;
    std::vector<splat::Picture> pictures;
    const auto losses = engine().loss(scene.gaussians, scene.views, scene.target_pointers(), kAllTerms, kNormalizer,
                                      &gradients, &pictures);
    check_losses(losses, scene, wanted);
    REQUIRE(pictures.size() == wanted.pictures.size());
    for (std::size_t v = 0; v < pictures.size(); ++v) check_picture(pictures[v], wanted.pictures[v]);
    check_gradients(gradients, wanted);
  }
  check_silent();
}

TEST_CASE("gradients and pictures equal the reference's without the rules") {
  for (const int degree : {0, 1, 3}) {
    CAPTURE(degree);
    const Scene scene = random_scene(50 + degree, 40, 3, degree, Logits::soft);
    for (const LossWeights& weights :
         {LossWeights{1, 0, 0}, LossWeights{0, 1, 0}, LossWeights{0, 0, 1}, kAllTerms, kOnGray}) {
      if (degree != 0 && weights.l1 != kAllTerms.l1) continue;  // single terms are tested for one degree only
      const auto wanted = reference::evaluate(reference::parameters(scene.gaussians), scene.views,
                                              scene.reference_targets(), weights, 0.0, reference::kNoCutoffs);
      splat::Gradients gradients;
      std::vector<splat::Picture> pictures;
      const auto losses = engine(false).loss(scene.gaussians, scene.views, scene.target_pointers(), weights, 0.0,
                                             &gradients, &pictures);
      if (weights.dssim > 0.0f) check_losses(losses, scene, wanted);
      for (std::size_t v = 0; v < pictures.size(); ++v) check_picture(pictures[v], wanted.pictures[v]);
      check_gradients(gradients, wanted);
    }
  }
  check_silent();
}

TEST_CASE(
    "odd Gaussians: behind, at the border, beyond the clamp, tiny, huge, saturated, degenerate quaternion sizes") {
  core::Random random(5);
  Scene scene;
  scene.cameras = {make_camera(52, 36, 60.0, {})};
  const std::vector<math::Pose> motions{pose(0.1, 0.0, 0.2, 0, 0, 0), pose(-0.1, 0.1, 0.0, 0.01, 0, 0)};
  scene.views = {{&scene.cameras[0], 0, 0, 52, 36, motions}, {&scene.cameras[0], 13, 3, 19, 30, motions}};
  for (const ViewSpec& view : scene.views) scene.targets.push_back(random_target(random, view.width, view.height));
  struct Odd {
    std::string what;
    double x, y, z, size, opacity;
  };
  const std::vector<Odd> odd{
      {"behind the camera", 0.02, 0.01, -0.4, 0.02, 2.0},
      {"nearer than 1 cm", 0.0, 0.0, 0.008, 0.001, 2.0},
      {"left border", -0.215, 0.0, 0.5, 0.01, 2.0},
      {"bottom right corner", 0.21, 0.155, 0.5, 0.02, 2.0},
      {"beyond the clamp, reaching in", 0.33, 0.02, 0.5, 0.08, 1.1},
      {"beyond the clamp in y", 0.03, -0.24, 0.45, 0.06, 1.2},
      {"a hundredth of a millimeter", 0.03, 0.02, 0.5, 1e-5, 3.0},
      {"larger than the image", 0.0, 0.0, 0.6, 0.5, -1.0},
      {"a needle", -0.05, 0.03, 0.5, 1e-5, 2.0},
      {"saturated", -0.06, -0.03, 0.4, 0.05, 8.0},
      {"saturated, before it", -0.05, -0.035, 0.35, 0.04, 8.0},
      {"saturated, behind both", -0.055, -0.03, 0.45, 0.06, 8.0},
      {"hardly visible", 0.05, -0.05, 0.5, 0.02, -4.6},
      {"invisible", 0.05, -0.05, 0.4, 0.02, -8.0},
  };
  Gaussians& g = scene.gaussians;
  g.resize(static_cast<int>(odd.size()), 2, 1);
  for (float& c : g.sh) c = static_cast<float>(0.4 * random.normal());
  for (int i = 0; i < g.count; ++i) {
    const Odd& o = odd[i];
    const double mean[3] = {o.x, o.y, o.z};
    for (int k = 0; k < 3; ++k) {
      g.mean[3 * i + k] = static_cast<float>(mean[k]);
      g.log_scale[3 * i + k] = static_cast<float>(std::log(o.size) + 0.2 * random.normal());
    }
    if (o.what == "a needle") g.log_scale[3 * i] = static_cast<float>(std::log(0.05));
    const double size = i % 3 == 0 ? 1e-2 : i % 3 == 1 ? 1.0 : 30.0;  // normalized before use
    for (int k = 0; k < 4; ++k) g.rotation[4 * i + k] = static_cast<float>(size * random.normal());
    g.opacity_logit[i] = static_cast<float>(o.opacity);
    g.link_logits[2 * i] = static_cast<float>(o.opacity == 8.0 ? 12.0 : i % 2 == 0 ? 6.0 : 0.5);
  }
  const auto plain = reference::parameters(g);
  for (const bool cutoffs : {true, false}) {
    CAPTURE(cutoffs);
    const reference::Rules rules = cutoffs ? reference::Rules{} : reference::kNoCutoffs;
    // pictures of all of them together
    const auto pictures = engine(cutoffs).draw(g, scene.views);
    for (std::size_t v = 0; v < pictures.size(); ++v)
      CHECK(check_picture(pictures[v], reference::draw(plain, scene.views[v], rules)) <= 0.02);
    // gradients of each alone, so that none hides behind the others
    for (int i = 0; i < g.count; ++i) {
      CAPTURE(odd[i].what);
      Gaussians one;
      one.resize(1, 2, 1);
      std::copy_n(g.mean.begin() + 3 * i, 3, one.mean.begin());
      std::copy_n(g.rotation.begin() + 4 * i, 4, one.rotation.begin());
      std::copy_n(g.log_scale.begin() + 3 * i, 3, one.log_scale.begin());
      one.opacity_logit[0] = g.opacity_logit[i];
      std::copy_n(g.sh.begin() + 12 * i, 12, one.sh.begin());
      std::copy_n(g.link_logits.begin() + 2 * i, 2, one.link_logits.begin());
      const auto wanted = reference::evaluate(reference::parameters(one), scene.views, scene.reference_targets(),
                                              kAllTerms, 0.0, rules);
      CHECK(doubtful(wanted) == 0);
      splat::Gradients gradients;
      std::vector<splat::Picture> alone;
      engine(cutoffs).loss(one, scene.views, scene.target_pointers(), kAllTerms, 0.0, &gradients, &alone);
      for (std::size_t v = 0; v < alone.size(); ++v) check_picture(alone[v], wanted.pictures[v]);
      check_gradients(gradients, wanted);
    }
  }
  check_silent();
}

TEST_CASE("spherical harmonics turn with the link and reach the position: Gaussians so large that only color varies") {
  for (const int degree : {1, 2, 3}) {
    CAPTURE(degree);
    for (std::uint64_t seed = 1; seed <= 4; ++seed) {
      core::Random random(seed);
      Scene scene;
      scene.cameras = {make_camera(24, 18, 30.0, pose(0.0, 0.0, 0.4, 0.02, 0.01, 0.0)), make_camera(18, 22, 30.0, {})};
      const auto turned = [&] {
        return math::Pose{math::exp_so3({2.0 * random.normal(), 2.0 * random.normal(), 2.0 * random.normal()}),
                          {0.05 * random.normal(), 0.05 * random.normal(), 0.4}};
      };
      scene.views = {{&scene.cameras[0], 0, 0, 24, 18, {turned(), turned()}},
                     {&scene.cameras[1], 2, 1, 13, 20, {turned(), turned()}}};
      for (const ViewSpec& view : scene.views) scene.targets.push_back(random_target(random, view.width, view.height));
      Gaussians& g = scene.gaussians;
      g.resize(1, 2, degree);
      for (float& x : g.mean) x = static_cast<float>(0.05 * random.normal());
      for (float& s : g.log_scale) s = std::log(2.0f);
      for (float& c : g.sh) c = static_cast<float>(random.normal());
      for (int c = 0; c < 3; ++c) g.sh[c] = 9.0f;  // away from the max(0, .)
      g.opacity_logit[0] = 0.3f;
      g.link_logits[0] = 0.4f;
      // D-SSIM alone, whose gradient is smooth, unlike L1's
      const LossWeights weights{0.0f, 1.0f, 0.0f};
      const auto wanted =
          reference::evaluate(reference::parameters(g), scene.views, scene.reference_targets(), weights, 0.0);
      CHECK(doubtful(wanted) == 0);
      splat::Gradients gradients;
      engine().loss(g, scene.views, scene.target_pointers(), weights, 0.0, &gradients);
      check_gradients(gradients, wanted);
    }
  }
  check_silent();
}

TEST_CASE("lists longer than any fast path: 700, 1500, 5000 entries in one tile, and the longest that is let through") {
  for (const int count : {700, 1500, 5000, static_cast<int>(shared::kLongestList)}) {
    CAPTURE(count);
    core::Random random(count);
    Scene scene;
    // every pixel has the whole list, so that fewer of them show as much of the longest ones
    const int width = count < 5000 ? 11 : 6, height = count < 5000 ? 7 : 4;
    scene.cameras = {make_camera(width, height, 30.0 * width / 11.0, {})};
    scene.views = {{&scene.cameras[0], 0, 0, width, height, {math::Pose{}}}};
    scene.targets = {random_target(random, width, height)};
    Gaussians& g = scene.gaussians;
    g.resize(count, 1, 0);
    // depths on a shuffled grid, so that float and double agree on their order
    std::vector<int> slot(count);
    std::iota(slot.begin(), slot.end(), 0);
    for (int i = count - 1; i > 0; --i) std::swap(slot[i], slot[random.next() % (i + 1)]);
    for (int i = 0; i < count; ++i) {
      const double z = 0.4 + 0.4 * slot[i] / count;
      g.mean[3 * i] = static_cast<float>(0.04 * z * random.normal());
      g.mean[3 * i + 1] = static_cast<float>(0.04 * z * random.normal());
      g.mean[3 * i + 2] = static_cast<float>(z);
      for (int k = 0; k < 3; ++k)
        g.log_scale[3 * i + k] = static_cast<float>(std::log(0.15 * z) + 0.1 * random.normal());
      g.opacity_logit[i] = static_cast<float>(std::log(random.uniform(1.0, 3.0) / count));  // the last one still shows
    }
    for (float& c : g.sh) c = static_cast<float>(random.normal());
    const auto plain = reference::parameters(g);
    const auto wanted =
        reference::evaluate(plain, scene.views, scene.reference_targets(), kAllTerms, 0.0, reference::kNoCutoffs);
    splat::Gradients gradients;
    std::vector<splat::Picture> pictures;
    engine(false).loss(g, scene.views, scene.target_pointers(), kAllTerms, 0.0, &gradients, &pictures);
    // the transmittance and the sums are rounded thousands of times instead of dozens
    constexpr double kLongImage = 5e-5;
    check_picture(pictures[0], wanted.pictures[0], kLongImage);
    check_gradients(gradients, wanted);
    // with the rules and every alpha just above 1/255 (0.0039): nearly every pixel has an entry in doubt, which changes
    // it by 1/255 of a small transmittance
    for (float& logit : g.opacity_logit) logit = static_cast<float>(std::log(random.uniform(0.0045, 0.012)));
    constexpr double kLongWithRules = 1e-3;
    check_picture(engine().draw(g, scene.views)[0], reference::draw(reference::parameters(g), scene.views[0]),
                  kLongWithRules);
  }
  check_silent();
}

TEST_CASE("a tile's list beyond the limit is an error, and the engine goes on afterwards") {
  Scene scene;
  scene.cameras = {make_camera(8, 8, 30.0, {})};
  scene.views = {{&scene.cameras[0], 0, 0, 8, 8, {math::Pose{}}}};
  Gaussians& g = scene.gaussians;
  g.resize(static_cast<int>(shared::kLongestList) + 1, 1, 0);
  for (int i = 0; i < g.count; ++i) g.mean[3 * i + 2] = 0.5f;
  std::fill(g.log_scale.begin(), g.log_scale.end(), std::log(0.1f));
  CHECK_THROWS_AS(engine().draw(g, scene.views), WorkError);
  g.resize(40, 1, 0);
  check_picture(engine().draw(g, scene.views)[0], reference::draw(reference::parameters(g), scene.views[0]));
  check_silent();
}

TEST_CASE("equal depths are blended in the order of the replica index") {
  // eight coincident Gaussians of two links that move alike: 16 equal depths, colors apart
  Scene scene;
  scene.cameras = {make_camera(17, 13, 30.0, {})};
  const math::Pose motion = pose(0.3, -0.2, 0.1, 0.01, 0.0, 0.4);
  scene.views = {{&scene.cameras[0], 0, 0, 17, 13, {motion, motion}}};
  core::Random random(3);
  Gaussians& g = scene.gaussians;
  g.resize(8, 2, 0);
  for (int i = 0; i < 8; ++i) {
    for (int k = 0; k < 3; ++k) g.log_scale[3 * i + k] = static_cast<float>(std::log(0.03));
    g.opacity_logit[i] = 0.7f;
    for (int c = 0; c < 3; ++c) g.sh[3 * i + c] = static_cast<float>(random.normal());
  }
  const auto wanted = reference::draw(reference::parameters(g), scene.views[0]);
  CHECK(check_picture(engine().draw(g, scene.views)[0], wanted) <= 0.05);
  // the order matters: reversing it changes the picture
  Gaussians reversed = g;
  for (int i = 0; i < 8; ++i) std::copy_n(g.sh.begin() + 3 * (7 - i), 3, reversed.sh.begin() + 3 * i);
  const auto other = reference::draw(reference::parameters(reversed), scene.views[0]);
  double difference = 0.0;
  for (std::size_t k = 0; k < other.rgba.size(); ++k)
    difference = std::max(difference, std::abs(other.rgba[k] - wanted.rgba[k]));
  CHECK(difference > 0.05);
  check_silent();
}

TEST_CASE("600 Gaussians in one tile among others") {
  core::Random random(77);
  Scene scene;
  scene.cameras = {make_camera(44, 29, 60.0, {})};
  scene.views = {{&scene.cameras[0], 0, 0, 44, 29, {pose(0, 0, 0.3, 0, 0, 0.4), pose(0, 0.05, 0.3, 0, 0, 0.4)}}};
  scene.targets = {random_target(random, 44, 29)};
  scene.gaussians = random_gaussians(random, 640, 2, 0, Logits::sharp, 0.0015);
  Gaussians& g = scene.gaussians;
  for (int i = 0; i < g.count; ++i) {
    for (int k = 0; k < 2; ++k) g.mean[3 * i + k] = static_cast<float>(0.012 * random.normal());
    g.mean[3 * i + 2] = static_cast<float>(2e-4 * (i - 320));
    g.opacity_logit[i] -= 1.5f;
  }
  const auto plain = reference::parameters(g);
  CHECK(check_picture(engine().draw(g, scene.views)[0], reference::draw(plain, scene.views[0])) <= 0.2);
  const auto wanted =
      reference::evaluate(plain, scene.views, scene.reference_targets(), kAllTerms, 0.0, reference::kNoCutoffs);
  splat::Gradients gradients;
  std::vector<splat::Picture> pictures;
  engine(false).loss(g, scene.views, scene.target_pointers(), kAllTerms, 0.0, &gradients, &pictures);
  check_picture(pictures[0], wanted.pictures[0]);
  check_gradients(gradients, wanted);
  check_silent();
}

TEST_CASE("gradients of splats over 12, 35 and 130 tiles: few instances, more than have places, and than ever have") {
  static_assert(12 < splat::kSplatCapacity && 35 > splat::kSplatCapacity && 130 > splat::kMostSplatCapacity);
  Engine fresh(device(), {.exact_cutoffs = false});  // its splats reach every tile
  core::Random random(78);
  Scene scene;
  scene.cameras = {make_camera(104, 80, 70.0, {})};
  scene.gaussians = random_gaussians(random, 12, 2, 1, Logits::soft);
  const std::vector<math::Pose> motions = random_motions(random, 2);
  const auto plain = reference::parameters(scene.gaussians);
  for (const auto& [width, height] : {std::pair{30, 21}, {52, 36}, {104, 80}, {30, 21}}) {
    const int columns = width;  // clang 14 lets no lambda of doctest take a structured binding
    CAPTURE(columns);
    scene.views = {{&scene.cameras[0], (104 - width) / 2, (80 - height) / 2, width, height, motions}};
    scene.targets = {random_target(random, width, height)};
    const auto wanted =
        reference::evaluate(plain, scene.views, scene.reference_targets(), kAllTerms, 0.0, reference::kNoCutoffs);
    splat::Gradients gradients;
    fresh.loss(scene.gaussians, scene.views, scene.target_pointers(), kAllTerms, 0.0, &gradients);
    check_gradients(gradients, wanted);
  }
  check_silent();
}

TEST_CASE("a crop is the cut-out of the whole image, and its loss is the whole image's") {
  core::Random random(21);
  Scene scene;
  scene.gaussians = random_gaussians(random, 30, 2, 1, Logits::soft, 0.003);
  for (int i = 0; i < 30; ++i) scene.gaussians.mean[3 * i] *= 0.3f;
  scene.cameras = {make_camera(75, 58, 70.0, {})};
  const std::vector<math::Pose> motions{pose(0.1, 0.2, 0.5, 0, 0, 0.4), pose(0.1, 0.1, 0.6, 0.003, 0, 0.4)};
  ViewSpec whole{&scene.cameras[0], 0, 0, 75, 58, motions};
  const splat::Picture full = engine().draw(scene.gaussians, std::span(&whole, 1))[0];
  const auto wanted = reference::draw(reference::parameters(scene.gaussians), whole);
  check_picture(full, wanted);
  // the bounds of the drawn pixels, and a target inside them
  int x0 = 75, y0 = 58, x1 = 0, y1 = 0;
  for (int y = 0; y < 58; ++y) {
    for (int x = 0; x < 75; ++x) {
      if (full.rgba[4 * (75 * y + x) + 3] == 0.0f) continue;
      x0 = std::min(x0, x);
      y0 = std::min(y0, y);
      x1 = std::max(x1, x + 1);
      y1 = std::max(y1, y + 1);
    }
  }
  constexpr int kMargin = 5;  // px; reach of SSIM's window (mathematics.md 2.7)
  REQUIRE(x0 > kMargin);
  REQUIRE(y0 > kMargin);
  REQUIRE(x1 + kMargin < 75);
  REQUIRE(y1 + kMargin < 58);
  std::vector<std::uint8_t> full_target(4 * 75 * 58, 0);
  for (int y = y0; y < y1; ++y)
    for (int x = x0; x < x1; ++x)
      for (int c = 0; c < 4; ++c) full_target[4 * (75 * y + x) + c] = static_cast<std::uint8_t>(random.next() % 256);
  const auto cut = [&](int left, int top, int right, int bottom) {
    ViewSpec view{&scene.cameras[0], left, top, right - left, bottom - top, motions};
    std::vector<std::uint8_t> target;
    for (int y = top; y < bottom; ++y)
      target.insert(target.end(), full_target.begin() + 4 * (75 * y + left),
                    full_target.begin() + 4 * (75 * y + right));
    return std::pair{view, target};
  };
  // corners at odd pixels, inside and at the border of the drawn pixels
  for (const auto& [left, top, right, bottom] : {std::array{x0 - 5, y0 - 5, x1 + 5, y1 + 5},
                                                 {x0 + 3, y0 + 1, x1 - 2, y1 - 4},
                                                 {0, 0, 9, 58},
                                                 {37, 29, 38, 30}}) {
    const ViewSpec view = cut(left, top, right, bottom).first;
    const splat::Picture part = engine().draw(scene.gaussians, std::span(&view, 1))[0];
    double worst = 0.0;
    for (int y = top; y < bottom; ++y) {
      for (int x = left; x < right; ++x) {
        if (wanted.doubtful[75 * y + x]) continue;
        for (int c = 0; c < 4; ++c)
          worst =
              std::max(worst, std::abs(static_cast<double>(part.rgba[4 * ((y - top) * (right - left) + x - left) + c]) -
                                       full.rgba[4 * (75 * y + x) + c]));
      }
    }
    CHECK(worst <= kImageTolerance);  // center coordinates relative to the crop round differently
  }
  const auto evaluate = [&](const ViewSpec& view, const std::vector<std::uint8_t>& target,
                            splat::Gradients& gradients) {
    const std::vector<std::uint8_t>* pointer = &target;
    return engine().loss(scene.gaussians, std::span(&view, 1), std::span(&pointer, 1), kAllTerms, 75.0 * 58.0,
                         &gradients);
  };
  splat::Gradients of_whole, of_crop, of_tight;
  const auto [crop, crop_target] = cut(x0 - kMargin, y0 - kMargin, x1 + kMargin, y1 + kMargin);
  const auto [tight, tight_target] = cut(x0, y0, x1, y1);
  const auto a = evaluate(whole, full_target, of_whole), b = evaluate(crop, crop_target, of_crop);
  const auto c = evaluate(tight, tight_target, of_tight);
  constexpr double kSame = 1e-6;  // float sums of the same numbers in another order
  CHECK(std::abs(a.total - b.total) <= kSame);
  CHECK(std::abs(a.ssim[0] - b.ssim[0]) <= kSame);
  CHECK(std::abs(a.l1[0] - b.l1[0]) <= kSame);
  CHECK(std::abs(a.mask[0] - b.mask[0]) <= kSame);
  CHECK(a.psnr_object[0] == doctest::Approx(b.psnr_object[0]).epsilon(1e-5));
  check_kind("mean", std::vector<double>(of_crop.gaussians.mean.begin(), of_crop.gaussians.mean.end()),
             {of_whole.gaussians.mean.begin(), of_whole.gaussians.mean.end()}, 3, kGradientTolerance);
  // without the margin the SSIM term differs: the rule is needed
  CHECK(std::abs(a.ssim[0] - c.ssim[0]) > 10.0 * kSame);
  check_silent();
}

TEST_CASE("a batch of views is the sum of its views") {
  const Scene scene = random_scene(31, 50, 4, 1, Logits::soft);
  constexpr double kNormalizer = 1500.0;
  splat::Gradients together;
  const auto all =
      engine().loss(scene.gaussians, scene.views, scene.target_pointers(), kAllTerms, kNormalizer, &together);
  std::array<std::vector<double>, 6> sums;
  double total = 0.0;
  for (std::size_t v = 0; v < scene.views.size(); ++v) {
    splat::Gradients alone;
    const std::vector<std::uint8_t>* target = &scene.targets[v];
    const auto one = engine().loss(scene.gaussians, std::span(&scene.views[v], 1), std::span(&target, 1), kAllTerms,
                                   kNormalizer, &alone);
    CHECK(one.l1[0] == all.l1[v]);  // the same additions in the same order
    CHECK(one.ssim[0] == all.ssim[v]);
    CHECK(one.mask[0] == all.mask[v]);
    CHECK((alone.link_twists[0].array() == together.link_twists[v].array()).all());
    total += one.total;
    const auto g = reference::parameters(alone.gaussians);
    for (int kind = 0; kind < 6; ++kind) {
      sums[kind].resize(g.kinds()[kind]->size(), 0.0);
      for (std::size_t k = 0; k < sums[kind].size(); ++k) sums[kind][k] += (*g.kinds()[kind])[k];
    }
  }
  CHECK(all.total == doctest::Approx(total).epsilon(1e-12));
  const auto g = reference::parameters(together.gaussians);
  constexpr double kRounding = 1e-6;  // of sums of three floats
  for (int kind = 0; kind < 6; ++kind)
    check_kind(reference::kKindNames[kind], *g.kinds()[kind], sums[kind], 1, kRounding);
  // a normalizer of 0 means the pixels of each crop
  const auto own = engine().loss(scene.gaussians, scene.views, scene.target_pointers(), kAllTerms, 0.0, nullptr);
  for (std::size_t v = 0; v < scene.views.size(); ++v)
    CHECK(own.l1[v] ==
          doctest::Approx(all.l1[v] * kNormalizer / (scene.views[v].width * scene.views[v].height)).epsilon(1e-9));
  check_silent();
}

TEST_CASE("the same input gives the same bits: loss, gradients, 20 steps, and on from a snapshot") {
  const Scene scene = random_scene(41, 80, 4, 1, Logits::soft);
  const splat::AdamRates rates{2e-4f, 1e-3f, 5e-3f, 2e-2f, 3e-3f, 2e-4f, 2e-2f};
  const std::array<std::vector<int>, 3> batches{std::vector<int>{0, 1, 2}, {1}, {2, 0}};
  struct Run {
    splat::LossValues losses;
    splat::Gradients gradients;
    Gaussians after;
  };
  std::vector<Run> runs;
  Engine::Snapshot middle;
  constexpr int kSteps = 20, kMiddle = 11;
  for (int repeat = 0; repeat < 2; ++repeat) {
    Run run;
    run.losses = engine().loss(scene.gaussians, scene.views, scene.target_pointers(), kAllTerms, 0.0, &run.gradients);
    engine().set_views(scene.views, scene.packed_pointers());
    engine().set_gaussians(scene.gaussians);
    for (int step = 0; step < kSteps; ++step) {
      if (step == kMiddle) middle = engine().snapshot();
      engine().step(batches[step % 3], kAllTerms, rates, false);
    }
    run.after = engine().gaussians();
    runs.push_back(std::move(run));
  }
  CHECK(runs[0].losses.total == runs[1].losses.total);
  CHECK(runs[0].losses.ssim == runs[1].losses.ssim);
  CHECK(same_bits(runs[0].gradients.gaussians, runs[1].gradients.gaussians));
  for (std::size_t v = 0; v < scene.views.size(); ++v)
    CHECK((runs[0].gradients.link_twists[v].array() == runs[1].gradients.link_twists[v].array()).all());
  CHECK(same_bits(runs[0].after, runs[1].after));
  CHECK_FALSE(same_bits(runs[0].after, scene.gaussians));
  // resume where the second run was after kMiddle steps
  CHECK(middle.step == kMiddle);
  engine().restore(middle);
  for (int step = kMiddle; step < kSteps; ++step) engine().step(batches[step % 3], kAllTerms, rates, false);
  CHECK(same_bits(engine().gaussians(), runs[0].after));
  check_silent();
}

TEST_CASE("held links change nothing but that their logits stay: Gaussians that become visible are drawn") {
  Scene scene = random_scene(47, 40, 4, 1, Logits::sharp);
  // too faint to be drawn, until the moments that they have raise them
  constexpr int kFaint = 20;
  const float least = std::log(static_cast<float>(image_model::kLeastAlpha / (1.0 - image_model::kLeastAlpha)));
  for (int i = 0; i < kFaint; ++i) scene.gaussians.opacity_logit[i] = least - 0.05f;
  engine().set_views(scene.views, scene.packed_pointers());
  engine().set_gaussians(scene.gaussians);
  Engine::Snapshot start = engine().snapshot();
  const std::size_t opacities =
      scene.gaussians.mean.size() + scene.gaussians.rotation.size() + scene.gaussians.log_scale.size();
  for (int i = 0; i < kFaint; ++i) {
    start.first_moment[opacities + i] = -1.0f;
    start.second_moment[opacities + i] = 1.0f;
  }
  start.step = 1000;
  const std::array batch{0, 1, 2};
  std::vector<Gaussians> after;
  for (const float link_rate : {0.0f, 1e-30f}) {  // held; free, and too slow to change anything
    engine().restore(start);
    for (int step = 0; step < 6; ++step)
      engine().step(batch, kAllTerms, {2e-4f, 1e-3f, 5e-3f, 5e-2f, 3e-3f, 2e-4f, link_rate}, false);
    after.push_back(engine().gaussians());
  }
  CHECK(same_bits(after[0], after[1]));
  int raised = 0, moved = 0;
  for (int i = 0; i < kFaint; ++i) {
    raised += after[0].opacity_logit[i] > least;
    moved += after[0].mean[3 * i] != scene.gaussians.mean[3 * i];
  }
  CHECK(raised == kFaint);
  CHECK(moved > kFaint / 4);  // those that others do not cover
  check_silent();
}

TEST_CASE("Gaussians that change keep their moments, those that are added begin without") {
  const Scene scene = random_scene(43, 30, 3, 0, Logits::soft);
  const splat::AdamRates rates{2e-4f, 1e-3f, 5e-3f, 2e-2f, 3e-3f, 2e-4f, 2e-2f};
  const std::array<int, 2> batch{0, 1};
  engine().set_views(scene.views, scene.packed_pointers());
  engine().set_gaussians(scene.gaussians);
  for (int step = 0; step < 5; ++step) engine().step(batch, kAllTerms, rates, false);
  const Engine::Snapshot before = engine().snapshot();
  engine().step(batch, kAllTerms, rates, false);
  const Gaussians wanted = engine().gaussians(), gradient = engine().gradient();

  // the same Gaussians in the same order, so that the picture is the same; the last one has lost its moments
  std::vector<int> kept(before.gaussians.count - 1), last{before.gaussians.count - 1};
  std::iota(kept.begin(), kept.end(), 0);
  engine().restore(before);
  engine().change_gaussians(kept, splat::rows_of(before.gaussians, last, 0));
  CHECK(same_bits(engine().gaussians(), before.gaussians));
  engine().step(batch, kAllTerms, rates, false);
  CHECK(same_bits(engine().gradient(), gradient));
  const Gaussians after = engine().gaussians();
  CHECK(same_bits(splat::rows_of(after, kept, 0), splat::rows_of(wanted, kept, 0)));
  CHECK_FALSE(same_bits(splat::rows_of(after, last, 0), splat::rows_of(wanted, last, 0)));
  check_silent();
}

TEST_CASE("step is Adam on the mean loss of the batch") {
  // every pixel is within 16 px of the targets' masks, so that all tiles of the crops are active
  Scene scene = random_scene(61, 16, 3, 1, Logits::soft);
  scene.views = {{&scene.cameras[0], 11, 9, 30, 19, scene.views[0].motions},
                 {&scene.cameras[1], 13, 8, 27, 22, scene.views[1].motions}};
  scene.targets.clear();
  core::Random random(62);
  double object_pixels = 0.0;
  for (const ViewSpec& view : scene.views) {
    scene.targets.push_back(random_target(random, view.width, view.height));
    for (std::size_t k = 3; k < scene.targets.back().size(); k += 4)
      object_pixels += scene.targets.back()[k] >= 128 ? 1 : 0;
  }
  const double normalizer = object_pixels / 2.0;  // training takes means over the views' mean number of object pixels
  const std::array<float, 7> rate{3e-4f, 2e-3f, 4e-3f, 1e-2f, 5e-3f, 1e-3f, 3e-2f};
  const splat::AdamRates rates{rate[0], rate[1], rate[2], rate[3], rate[4], rate[5], rate[6]};
  engine(false).set_views(scene.views, scene.packed_pointers());
  engine(false).set_gaussians(scene.gaussians);

  auto g = reference::parameters(scene.gaussians);
  auto first = g, second = g;
  for (auto* moments : {&first, &second})
    for (auto* kind : moments->kinds()) std::fill(kind->begin(), kind->end(), 0.0);
  std::array<std::vector<bool>, 6> weak;  // entries whose gradient was once near zero, where Adam amplifies rounding
  for (int kind = 0; kind < 6; ++kind) weak[kind].assign(g.kinds()[kind]->size(), false);
  const std::vector<reference::Target> targets = scene.reference_targets();
  const std::array<std::vector<int>, 2> batches{std::vector<int>{0, 1}, {1}};
  constexpr int kSteps = 4;
  for (int step = 1; step <= kSteps; ++step) {
    const std::vector<int>& batch = batches[step % 2];
    std::vector<ViewSpec> views;
    std::vector<reference::Target> wanted_targets;
    for (const int v : batch) {
      views.push_back(scene.views[v]);
      wanted_targets.push_back(targets[v]);
    }
    const auto wanted = reference::evaluate(g, views, wanted_targets, kAllTerms,
                                            normalizer * static_cast<double>(batch.size()), reference::kNoCutoffs);
    std::vector<math::MatrixX> twists;
    const auto losses = engine(false).step(batch, kAllTerms, rates, true, &twists);
    // losses are those before the step, means over `normalizer` pixels
    REQUIRE(losses.l1.size() == batch.size());
    for (std::size_t v = 0; v < batch.size(); ++v)
      CHECK(losses.l1[v] == doctest::Approx(wanted.losses[v].l1 * static_cast<double>(batch.size())).epsilon(1e-3));
    REQUIRE(twists.size() == batch.size());
    for (std::size_t v = 0; v < batch.size(); ++v)
      CHECK((twists[v] - wanted.link_twists[v]).cwiseAbs().maxCoeff() <=
            4.0 * kGradientTolerance * wanted.link_twists[v].cwiseAbs().maxCoeff());
    for (int kind = 0; kind < 6; ++kind) {
      const std::vector<double>& gradient = *wanted.gradient.kinds()[kind];
      double largest = 0.0;
      for (const double x : gradient) largest = std::max(largest, std::abs(x));
      for (std::size_t k = 0; k < gradient.size(); ++k) {
        constexpr double kWeak = 0.02;
        if (std::abs(gradient[k]) < kWeak * largest) weak[kind][k] = true;
        double& m = (*first.kinds()[kind])[k];
        double& s = (*second.kinds()[kind])[k];
        m = 0.9 * m + 0.1 * gradient[k];
        s = 0.999 * s + 0.001 * gradient[k] * gradient[k];
        const int section = kind < 4 ? kind : kind == 5 ? 6 : k % (3u * g.coefficients()) < 3 ? 4 : 5;
        (*g.kinds()[kind])[k] -=
            rate[section] * (m / (1 - std::pow(0.9, step))) / (std::sqrt(s / (1 - std::pow(0.999, step))) + 1e-15);
      }
    }
  }
  const auto got = reference::parameters(engine(false).gaussians()), before = reference::parameters(scene.gaussians);
  for (int kind = 0; kind < 6; ++kind) {
    INFO(reference::kKindNames[kind]);
    double worst = 0.0;
    int compared = 0;
    const std::vector<double>& start = *before.kinds()[kind];
    for (std::size_t k = 0; k < g.kinds()[kind]->size(); ++k) {
      if (weak[kind][k]) continue;
      ++compared;
      const double moved = (*g.kinds()[kind])[k] - start[k];
      const double rounding = 4.0 * 6e-8 * std::abs(start[k]);  // of the float parameter itself, once per step
      worst = std::max(worst, (std::abs((*got.kinds()[kind])[k] - (*g.kinds()[kind])[k]) - rounding) / std::abs(moved));
    }
    CHECK(compared >= 5);
    CHECK(worst <= 0.02);  // an error of 1e-3 of the largest gradient is 5 % of a gradient of kWeak, but rarely occurs
  }
  check_silent();
}

TEST_CASE("host and device agree on where each kind of parameter stands: a rate moves those of its kind only") {
  const Scene scene = random_scene(63, 21, 3, 2, Logits::soft);
  engine().set_views(scene.views, scene.packed_pointers());
  const auto before = reference::parameters(scene.gaussians);
  const std::array batch{0, 1, 2};
  for (int rated = 0; rated < 7; ++rated) {
    CAPTURE(rated);
    std::array<float, 7> rate{};
    rate[rated] = 1e-3f;
    engine().set_gaussians(scene.gaussians);
    engine().step(batch, kAllTerms, {rate[0], rate[1], rate[2], rate[3], rate[4], rate[5], rate[6]}, false);
    const auto after = reference::parameters(engine().gaussians());
    std::array<std::size_t, 7> moved{};
    for (int kind = 0; kind < 6; ++kind) {
      for (std::size_t k = 0; k < before.kinds()[kind]->size(); ++k) {
        const int section = kind < 4 ? kind : kind == 5 ? 6 : k % (3u * before.coefficients()) < 3 ? 4 : 5;
        moved[section] += (*after.kinds()[kind])[k] != (*before.kinds()[kind])[k];
      }
    }
    for (int section = 0; section < 7; ++section) CHECK((moved[section] > 0) == (section == rated));
  }
  check_silent();
}

TEST_CASE("the numbers of the image model are what defines them") {
  CHECK(image_model::kSh0 == doctest::Approx(0.5 / std::sqrt(std::numbers::pi)).epsilon(1e-15));
  double sum = 0.0;
  for (int t = -image_model::kSsimReach; t <= image_model::kSsimReach; ++t) sum += std::exp(-0.5 * t * t / (1.5 * 1.5));
  for (int t = 0; t <= image_model::kSsimReach; ++t)
    CHECK(image_model::kSsimWindow[t] == doctest::Approx(std::exp(-0.5 * t * t / (1.5 * 1.5)) / sum).epsilon(1e-14));
}

TEST_CASE("resets cap the opacity, even the links out, and forget their moments only") {
  const Scene scene = random_scene(71, 20, 3, 0, Logits::soft);
  engine().set_views(scene.views, scene.packed_pointers());
  engine().set_gaussians(scene.gaussians);
  const splat::AdamRates rates{1e-4f, 1e-3f, 1e-3f, 1e-2f, 1e-3f, 1e-3f, 1e-2f};
  const std::array batch{0, 1, 2};
  for (int step = 0; step < 3; ++step) engine().step(batch, kAllTerms, rates, false);
  const Engine::Snapshot before = engine().snapshot();
  engine().reset_opacity(0.01f);
  engine().reset_links();
  const Engine::Snapshot after = engine().snapshot();
  const float least_logit = std::log(0.01f / 0.99f);
  for (int i = 0; i < 20; ++i)
    CHECK(after.gaussians.opacity_logit[i] ==
          doctest::Approx(std::min(before.gaussians.opacity_logit[i], least_logit)));
  // uniform probabilities: equal logits
  for (int i = 0; i < 20; ++i)
    for (int j = 1; j < 3; ++j) CHECK(after.gaussians.link_logits[3 * i + j] == after.gaussians.link_logits[3 * i]);
  CHECK(same_bits(after.gaussians.mean, before.gaussians.mean));
  CHECK(same_bits(after.gaussians.sh, before.gaussians.sh));
  CHECK(after.step == before.step);
  // exactly the nonzero moments of the two sections are reset
  const auto zeros = [](const std::vector<float>& x) { return std::count(x.begin(), x.end(), 0.0f); };
  REQUIRE(before.first_moment.size() == 20u * (3 + 4 + 3 + 1 + 3 + 3));
  for (const auto& [now, then] :
       {std::pair{&after.first_moment, &before.first_moment}, std::pair{&after.second_moment, &before.second_moment}}) {
    CHECK(zeros(*now) >= 20 * 4);
    CHECK(zeros(*now) - zeros(*then) <= 20 * 4);
    for (std::size_t k = 0; k < now->size(); ++k) CHECK(((*now)[k] == (*then)[k] || (*now)[k] == 0.0f));
  }
  check_silent();
}

TEST_CASE("training draws and charges near the mask, or everywhere when asked") {
  core::Random random(81);
  Scene scene;
  scene.cameras = {make_camera(96, 40, 60.0, {})};
  scene.views = {{&scene.cameras[0], 0, 0, 96, 40, {pose(0, 0, 0, 0, 0, 0.5)}}};
  // a mask at the left, with one Gaussian on it and one far to the right
  std::vector<std::uint8_t> target(4 * 96 * 40, 0);
  for (int y = 14; y < 26; ++y)
    for (int x = 6; x < 18; ++x)
      for (int c = 0; c < 4; ++c)
        target[4 * (96 * y + x) + c] = c == 3 ? 255 : static_cast<std::uint8_t>(random.next() % 256);
  scene.targets = {target};
  Gaussians& g = scene.gaussians;
  g.resize(2, 1, 0);
  g.mean[0] = -0.3f;
  g.mean[3] = 0.3f;
  for (float& s : g.log_scale) s = std::log(0.02f);
  g.opacity_logit = {1.0f, 1.0f};
  const auto wanted = reference::draw(reference::parameters(g), scene.views[0]);
  const std::array batch{0};
  const splat::AdamRates rates{0, 0, 0, 0, 1e-3f, 0, 0};
  for (const bool everywhere : {false, true}) {
    CAPTURE(everywhere);
    engine().set_views(scene.views, scene.packed_pointers(), everywhere);
    engine().set_gaussians(g);
    const splat::Picture drawn = engine().draw_views(batch)[0];
    double left = 0.0, right = 0.0, left_wanted = 0.0, right_wanted = 0.0;
    for (int y = 0; y < 40; ++y) {
      for (int x = 0; x < 96; ++x) {
        (x < 48 ? left : right) += drawn.rgba[4 * (96 * y + x) + 3];
        (x < 48 ? left_wanted : right_wanted) += wanted.rgba[4 * (96 * y + x) + 3];
      }
    }
    CHECK(left == doctest::Approx(left_wanted).epsilon(1e-4));
    CHECK(right == doctest::Approx(everywhere ? right_wanted : 0.0).epsilon(1e-4));
    engine().step(batch, kAllTerms, rates, false);
    const Gaussians after = engine().gaussians();
    CHECK(after.sh[0] != 0.0f);
    CHECK((after.sh[3] != 0.0f) == everywhere);
  }
  // other motions change the picture
  engine().set_gaussians(g);
  scene.views[0].motions = {pose(0, 0, 0.1, 0.02, 0.01, 0.5)};
  engine().set_motions(0, scene.views[0].motions);
  const auto moved = engine().draw_views(batch, true);
  check_picture(moved[0], reference::draw(reference::parameters(g), scene.views[0]));
  CHECK(moved[0].depth.size() == 96u * 40u);
  check_silent();
}

TEST_CASE("tile sizes and pixels a lane do not change the result") {
  const Scene scene = random_scene(91, 60, 4, 1, Logits::soft);
  const auto wanted = engine().draw(scene.gaussians, scene.views, true);
  splat::Gradients wanted_gradients;
  engine().loss(scene.gaussians, scene.views, scene.target_pointers(), kAllTerms, 0.0, &wanted_gradients);
  struct Variant {
    int tile, pixels_per_lane;
  };
  for (const Variant& variant : {Variant{8, 1}, Variant{8, 2}, Variant{8, 8}, Variant{16, 4}, Variant{16, 16}}) {
    CAPTURE(variant.tile);
    CAPTURE(variant.pixels_per_lane);
    Settings settings;
    settings.tile = variant.tile;
    settings.pixels_per_lane = variant.pixels_per_lane;
    Engine other(device(), settings);
    const auto got = other.draw(scene.gaussians, scene.views, true);
    REQUIRE(got.size() == wanted.size());
    constexpr double kRounding = 2e-6;  // the compiler may contract products differently
    for (std::size_t v = 0; v < got.size(); ++v) {
      double worst = 0.0;
      int flipped = 0;
      for (std::size_t k = 0; k < got[v].rgba.size(); ++k) {
        const double error = std::abs(static_cast<double>(got[v].rgba[k]) - wanted[v].rgba[k]);
        if (error > kRounding) ++flipped;
        worst = std::max(worst, error);
      }
      // a skip that such rounding decides changes a pixel by at most 1/255 of its transmittance
      CHECK(flipped <= 8);
      CHECK(worst <= 1.5 / 255.0);
    }
    splat::Gradients gradients;
    other.loss(scene.gaussians, scene.views, scene.target_pointers(), kAllTerms, 0.0, &gradients);
    const auto a = reference::parameters(gradients.gaussians), b = reference::parameters(wanted_gradients.gaussians);
    for (int kind = 0; kind < 6; ++kind)
      check_kind(reference::kKindNames[kind], *a.kinds()[kind], *b.kinds()[kind], 1, kGradientTolerance);
  }
  check_silent();
}

TEST_CASE("nothing to draw: no views, no Gaussians, views of size 0, everything behind the camera") {
  const Scene scene = random_scene(95, 12, 2, 0, Logits::soft);
  splat::Gradients gradients;
  std::vector<splat::Picture> pictures;

  // no views
  CHECK(engine().draw(scene.gaussians, {}).empty());
  const auto none = engine().loss(scene.gaussians, {}, {}, kAllTerms, 0.0, &gradients, &pictures);
  CHECK(none.total == 0.0);
  CHECK(none.l1.empty());
  CHECK(pictures.empty());
  CHECK(gradients.gaussians.mean == std::vector<float>(36, 0.0f));
  CHECK(gradients.link_twists.empty());

  // no Gaussians: black, loss of black
  Gaussians empty;
  empty.resize(0, 2, 0);
  const auto black = engine().loss(empty, scene.views, scene.target_pointers(), kAllTerms, 0.0, &gradients, &pictures);
  const auto wanted =
      reference::evaluate(reference::parameters(empty), scene.views, scene.reference_targets(), kAllTerms, 0.0);
  check_losses(black, scene, wanted);
  REQUIRE(pictures.size() == 3);
  for (const auto& p : pictures) CHECK(std::all_of(p.rgba.begin(), p.rgba.end(), [](float x) { return x == 0.0f; }));
  CHECK(gradients.gaussians.count == 0);
  REQUIRE(gradients.link_twists.size() == 3);
  CHECK(gradients.link_twists[0].isZero(0.0));

  // an empty view between two others
  Scene gap = scene;
  gap.views[1].width = 0;
  gap.targets[1].clear();
  const auto with_gap =
      engine().loss(gap.gaussians, gap.views, gap.target_pointers(), kAllTerms, 1000.0, &gradients, &pictures);
  const auto plain = engine().loss(scene.gaussians, scene.views, scene.target_pointers(), kAllTerms, 1000.0, nullptr);
  CHECK(with_gap.l1[0] == plain.l1[0]);
  CHECK(with_gap.l1[1] == 0.0);
  CHECK(with_gap.ssim[1] == 1.0);
  CHECK(with_gap.l1[2] == plain.l1[2]);
  CHECK(pictures[1].rgba.empty());
  CHECK(gradients.link_twists[1].isZero(0.0));
  CHECK_FALSE(gradients.link_twists[2].isZero(0.0));
  // and alone
  const ViewSpec nothing{&scene.cameras[0], 4, 4, 0, 0, scene.views[0].motions};
  const auto drawn = engine().draw(scene.gaussians, std::span(&nothing, 1), true);
  REQUIRE(drawn.size() == 1);
  CHECK(drawn[0].rgba.empty());

  // everything behind the camera
  Scene behind = scene;
  for (ViewSpec& view : behind.views)
    for (math::Pose& motion : view.motions) motion.translation.z() -= 5.0;
  for (const bool cutoffs : {true, false}) {
    const auto lost = engine(cutoffs).loss(behind.gaussians, behind.views, behind.target_pointers(), kAllTerms, 0.0,
                                           &gradients, &pictures);
    CHECK(lost.total == doctest::Approx(black.total).epsilon(1e-6));
    for (const auto* kind :
         {&gradients.gaussians.mean, &gradients.gaussians.rotation, &gradients.gaussians.log_scale,
          &gradients.gaussians.opacity_logit, &gradients.gaussians.sh, &gradients.gaussians.link_logits})
      CHECK(std::all_of(kind->begin(), kind->end(), [](float x) { return x == 0.0f; }));
    for (const auto& p : pictures) CHECK(std::all_of(p.rgba.begin(), p.rgba.end(), [](float x) { return x == 0.0f; }));
  }

  // a step on black moves nothing
  engine().set_views(behind.views, behind.packed_pointers());
  engine().set_gaussians(behind.gaussians);
  const std::array batch{0, 1, 2};
  const splat::AdamRates rates{1, 1, 1, 1, 1, 1, 1};
  engine().step(batch, kAllTerms, rates, true);
  CHECK(same_bits(engine().gaussians(), behind.gaussians));
  check_silent();
}
