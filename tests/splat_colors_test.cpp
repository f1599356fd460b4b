// Compares the device's normal equations of the colors inside a mask with those of the host in double
// (reference_colors.h) and with differences of the drawn loss, and tests their use: a step that finds a small motion.
#include <doctest/doctest.h>

#include <array>
#include <cmath>
#include <cstring>
#include <string>

#include "chainsplat/splat.h"
#include "gpu/device.h"
#include "reference_colors.h"
#include "src/math/decompositions.h"

using namespace chainsplat;
using math::MatrixX;
using math::Pose;
using math::Vector3;
using math::Vector6;
using math::VectorX;
using splat::ColorSums;

namespace {

gpu::Device& compared_device(bool least = false) {
  static const auto open = [](bool with) {
    gpu::DeviceOptions options;
    options.validation = true;
    options.least = with;
    return gpu::open_device(options);
  };
  static const gpu::DevicePtr best = open(false), poor = open(true);
  return least ? *poor : *best;
}

// Every test case ends with this check.
void check_devices_silent() {
  for (const bool least : {false, true}) {
    const std::vector<std::string> texts = gpu::validation_texts(compared_device(least));
    CHECK_MESSAGE(texts.empty(), (texts.empty() ? std::string() : texts.front()));
  }
}

// A bent rope, 0.3 m long and 2 cm thick, with colors that vary along and around it, in front of cameras on three
// sides. They observe it at slightly different angles, with another exposure and noise; hide_middle() covers its
// middle.
struct ColorScene {
  chain::Chain chain;
  splat::Gaussians gaussians;
  std::vector<capture::Camera> cameras;
  VectorX theta;
  Pose base;
  std::vector<splat::ViewSpec> views;  // with the twin's motions; they point into `cameras`
  std::vector<std::vector<std::uint8_t>> observed;

  std::vector<const std::vector<std::uint8_t>*> observed_pointers() const {
    std::vector<const std::vector<std::uint8_t>*> out;
    for (const auto& s : observed) out.push_back(&s);
    return out;
  }
};

struct Exposure {
  double gain = 1.0, bias = 0.0, noise = 0.0;
};

std::vector<std::uint8_t> looked_at(const splat::Picture& picture, const Exposure& exposure, core::Random& random) {
  std::vector<std::uint8_t> rgba(picture.rgba.size());
  for (std::size_t k = 0; k < rgba.size(); ++k) {
    const double alpha = picture.rgba[k / 4 * 4 + 3];
    const double value = k % 4 == 3
                             ? (alpha >= 0.5 ? 1.0 : 0.0)
                             : exposure.gain * picture.rgba[k] + exposure.bias + exposure.noise * random.normal();
    rgba[k] = static_cast<std::uint8_t>(std::lround(255.0 * std::clamp(value, 0.0, 1.0)));
  }
  return rgba;
}

ColorScene make_scene() {
  ColorScene scene;
  scene.chain =
      chain::make_chain(0.3, 0.02, -Vector3::UnitZ(), Vector3::UnitY(), 6, chain::Bending::spatial, false, 0.02);
  const int rows = 75, around = 8, links = scene.chain.links();
  constexpr float kSh0 = 0.28209479f;
  scene.gaussians.resize(rows * around, links, 0);
  for (int i = 0; i < scene.gaussians.count; ++i) {
    const double s = (i / around + 0.5) / rows * scene.chain.length, angle = 2.0 * M_PI * (i % around) / around;
    const double place[3] = {0.008 * std::cos(angle), 0.008 * std::sin(angle), -s};
    for (int c = 0; c < 3; ++c) {
      scene.gaussians.mean[3 * i + c] = static_cast<float>(place[c]);
      scene.gaussians.log_scale[3 * i + c] = std::log(0.0035f);
      const double color = 0.5 + 0.2 * std::sin((110.0 + 30.0 * c) * s + c) + 0.12 * std::sin(angle + 40.0 * s + c);
      scene.gaussians.sh[3 * i + c] = static_cast<float>(color - 0.5) / kSh0;
    }
    scene.gaussians.opacity_logit[i] = 3.0f;
    scene.gaussians.link_logits[links * i + chain::link_at(scene.chain, s)] = 12.0f;
  }
  scene.theta = VectorX::Zero(scene.chain.angles());
  for (int k = 0; k < scene.theta.size(); ++k) scene.theta[k] = 0.25 * std::sin(1.3 * k + 0.4);
  scene.base.translation = Vector3(0.3, -0.2, 0.6);  // away from the world origin
  for (const double side : {-0.9, 0.0, 1.1}) {
    capture::Camera c;
    c.width = 200;
    c.height = 240;
    c.fx = 420.0;
    c.fy = 425.0;
    c.cx = 101.0;
    c.cy = 118.0;
    const Vector3 middle = scene.base * Vector3(0, 0, -0.14);
    const Vector3 forward = Vector3(std::sin(side), std::cos(side), 0.1).normalized();
    const Vector3 right = forward.cross(Vector3::UnitZ()).normalized();
    c.world_from_camera.rotation << right, forward.cross(right), forward;
    c.world_from_camera.translation = middle - 0.6 * forward;
    scene.cameras.push_back(c);
  }
  return scene;
}

// Draws what the cameras observe at `theta_seen`. The crops have different sizes; the third is small and cuts the rope.
void observe(ColorScene& scene, splat::Engine& engine, const VectorX& theta_seen, const Exposure& exposure) {
  const std::array<std::array<int, 4>, 3> crops{{{0, 0, 200, 240}, {30, 5, 141, 223}, {60, 60, 77, 101}}};
  core::Random random(5);
  scene.views.clear();
  scene.observed.clear();
  for (std::size_t v = 0; v < crops.size(); ++v) {
    const auto [x0, y0, width, height] = crops[v];
    splat::ViewSpec spec{
        &scene.cameras[v], x0, y0, width, height, chain::link_motions(scene.chain, theta_seen, scene.base)};
    scene.observed.push_back(looked_at(engine.draw(scene.gaussians, {&spec, 1})[0], exposure, random));
    spec.motions = chain::link_motions(scene.chain, scene.theta, scene.base);
    scene.views.push_back(spec);
  }
}

void hide_middle(ColorScene& scene) {
  for (std::size_t v = 0; v < scene.views.size(); ++v)
    for (int y = scene.views[v].height / 2; y < scene.views[v].height / 2 + 25; ++y)
      for (int x = 0; x < scene.views[v].width; ++x) scene.observed[v][4 * (y * scene.views[v].width + x) + 3] = 0;
}

// Largest difference of two sums, relative to the largest wanted entry of its kind. Twists are taken about the links'
// starts, where all moments are of one size and all forces of another.
double worst_difference(const ColorScene& scene, const splat::ViewSpec& view, const ColorSums& got,
                        const ColorSums& wanted) {
  double worst = 0.0;
  std::array<double, 9> scales{};
  const auto each = [&](const auto& use) {
    for (int j = 0; j < scene.chain.links(); ++j) {
      ColorSums::Matrix8 local = ColorSums::Matrix8::Identity();
      local.block<3, 3>(0, 3) =
          -math::hat(view.motions[j] * Vector3(scene.chain.link_start(j) * scene.chain.direction));
      const ColorSums::Matrix8 a = local * got.normal[j] * local.transpose();
      const ColorSums::Matrix8 b = local * wanted.normal[j] * local.transpose();
      const ColorSums::Vector8 c = local * got.right[j], d = local * wanted.right[j];
      const auto kind = [](int row) { return row < 3 ? 0 : row < 6 ? 1 : 2; };
      for (int r = 0; r < 8; ++r) {
        use(kind(r) * 3, 0.0, 0.0);
        for (int k = r; k < 8; ++k) use(kind(r) * 3 + kind(k), a(r, k), b(r, k));
        use(kind(r) == 0 ? 3 : kind(r) == 1 ? 6 : 7, c[r], d[r]);
      }
    }
  };
  each([&](int kind, double, double b) { scales[kind] = std::max(scales[kind], std::abs(b)); });
  each([&](int kind, double a, double b) { worst = std::max(worst, std::abs(a - b) / std::max(scales[kind], 1e-12)); });
  return worst;
}

void check_sums(const ColorScene& scene, const splat::ViewSpec& view, const ColorSums& got, const ColorSums& wanted) {
  constexpr double kSums = 2e-5;  // for sums of some thousand floats, and an exposure computed from such sums
  CHECK(got.pixels == wanted.pixels);
  CHECK(got.gain == doctest::Approx(wanted.gain).epsilon(kSums));
  CHECK(std::abs(got.bias - wanted.bias) <= kSums);
  CHECK(got.weight == doctest::Approx(wanted.weight).epsilon(kSums));
  CHECK(got.square == doctest::Approx(wanted.square).epsilon(10 * kSums));
  CHECK(got.covariance == doctest::Approx(wanted.covariance).epsilon(10 * kSums));
  CHECK(got.drawn_variance == doctest::Approx(wanted.drawn_variance).epsilon(10 * kSums));
  CHECK(got.seen_variance == doctest::Approx(wanted.seen_variance).epsilon(10 * kSums));
  REQUIRE(got.normal.size() == wanted.normal.size());
  REQUIRE(got.right.size() == wanted.right.size());
  CHECK(worst_difference(scene, view, got, wanted) <= 1e-4);
}

bool same_bits(const ColorSums& a, const ColorSums& b) {
  return a.normal == b.normal && a.right == b.right && a.weight == b.weight && a.square == b.square &&
         a.gain == b.gain && a.bias == b.bias && a.pixels == b.pixels && a.covariance == b.covariance &&
         a.drawn_variance == b.drawn_variance && a.seen_variance == b.seen_variance;
}

TEST_CASE("the device's color sums are those of a host in double") {
  ColorScene scene = make_scene();
  splat::Engine engine(compared_device());
  VectorX moved = scene.theta;
  for (int k = 0; k < moved.size(); ++k) moved[k] += 0.01 * std::sin(2.1 * k);
  observe(scene, engine, moved, {1.2, -0.04, 0.02});
  hide_middle(scene);
  const auto pictures = engine.draw(scene.gaussians, scene.views, true);
  std::vector<ColorSums> wanted;
  for (std::size_t v = 0; v < scene.views.size(); ++v) {
    wanted.push_back(reference::color_sums(scene.chain, scene.views[v], scene.observed[v], pictures[v]));
    REQUIRE(wanted[v].pixels > 300);
    CHECK(wanted[v].gain == doctest::Approx(1.2).epsilon(0.1));
  }
  struct Variant {
    int tile, pixels_per_lane;
    bool least;
  };
  for (const Variant& variant :
       {Variant{0, 0, false}, Variant{0, 0, true}, Variant{8, 2, false}, Variant{16, 8, false}}) {
    CAPTURE(variant.tile);
    CAPTURE(variant.least);
    splat::Settings settings;
    settings.tile = variant.tile;
    settings.pixels_per_lane = variant.pixels_per_lane;
    splat::Engine other(compared_device(variant.least), settings);
    other.set_gaussians(scene.gaussians);
    const auto got = other.color_sums(scene.chain, scene.views, scene.observed_pointers());
    REQUIRE(got.size() == scene.views.size());
    for (std::size_t v = 0; v < got.size(); ++v) {
      CAPTURE(v);
      check_sums(scene, scene.views[v], got[v], wanted[v]);
    }
    // the same device gives the same bits, also after other pictures
    other.draw(scene.gaussians, {&scene.views[1], 1});
    const auto again = other.color_sums(scene.chain, scene.views, scene.observed_pointers());
    for (std::size_t v = 0; v < got.size(); ++v) CHECK(same_bits(got[v], again[v]));
  }
  check_devices_silent();
}

TEST_CASE("tiles with more Gaussians than their lists first have room for") {
  ColorScene scene = make_scene();
  splat::Engine engine(compared_device());
  observe(scene, engine, scene.theta, {1.1, 0.02, 0.02});
  // replace every Gaussian by twenty fainter ones, slightly apart
  const splat::Gaussians once = scene.gaussians;
  constexpr int kTimes = 20;
  scene.gaussians = {};
  scene.gaussians.resize(kTimes * once.count, once.links, 0);
  for (int i = 0; i < scene.gaussians.count; ++i) {
    const int from = i / kTimes;
    for (int c = 0; c < 3; ++c) {
      scene.gaussians.mean[3 * i + c] = once.mean[3 * from + c] + 1e-5f * static_cast<float>(i % kTimes);
      scene.gaussians.log_scale[3 * i + c] = once.log_scale[3 * from + c];
      scene.gaussians.sh[3 * i + c] = once.sh[3 * from + c];
    }
    scene.gaussians.opacity_logit[i] = -1.5f;
    for (int j = 0; j < once.links; ++j)
      scene.gaussians.link_logits[once.links * i + j] = once.link_logits[once.links * from + j];
  }
  engine.set_gaussians(scene.gaussians);
  const std::uint64_t submitted = compared_device().submitted;
  const auto got = engine.color_sums(scene.chain, scene.views, scene.observed_pointers());
  CHECK(compared_device().submitted > submitted + 1);  // the first submission overflowed and was run again
  const auto pictures = engine.draw(scene.gaussians, scene.views, true);
  for (std::size_t v = 0; v < got.size(); ++v) {
    CAPTURE(v);
    check_sums(scene, scene.views[v], got[v],
               reference::color_sums(scene.chain, scene.views[v], scene.observed[v], pictures[v]));
    CHECK(got[v].pixels > 300);
  }
  check_devices_silent();
}

TEST_CASE("the right side is the slope of the drawn loss") {
  ColorScene scene = make_scene();
  splat::Engine engine(compared_device());
  VectorX moved = scene.theta;
  for (int k = 0; k < moved.size(); ++k) moved[k] += 0.004 * std::sin(2.1 * k);
  observe(scene, engine, moved, {});
  engine.set_gaussians(scene.gaussians);
  const auto sums = engine.color_sums(scene.chain, scene.views, scene.observed_pointers());
  for (std::size_t v = 0; v < 2; ++v) {
    CAPTURE(v);
    const splat::ViewSpec& view = scene.views[v];
    const auto pictures = engine.draw(scene.gaussians, {&view, 1}, true);
    // Huber's loss over the same pixels at the same exposure
    std::vector<bool> counts(static_cast<std::size_t>(view.width) * view.height, false);
    for (int y = 2; y < view.height - 2; ++y)
      for (int x = 2; x < view.width - 2; ++x) {
        bool all = pictures[0].rgba[4 * (y * view.width + x) + 3] >= 0.95f;
        for (int i = 0; all && i < 25; ++i)
          all = scene.observed[v][4 * ((y + i / 5 - 2) * view.width + x + i % 5 - 2) + 3] >= 128;
        counts[y * view.width + x] = all;
      }
    const auto loss = [&](const Vector6& twist) {
      splat::ViewSpec other = view;
      for (Pose& motion : other.motions) motion = math::exp_se3(twist) * motion;
      const splat::Picture picture = engine.draw(scene.gaussians, {&other, 1})[0];
      double sum = 0.0;
      for (std::size_t k = 0; k < picture.rgba.size(); ++k) {
        if (k % 4 == 3 || !counts[k / 4]) continue;
        const double r = std::abs(sums[v].gain * picture.rgba[k] + sums[v].bias - scene.observed[v][k] / 255.0);
        sum += r <= 0.05 ? 0.5 * r * r : 0.05 * (r - 0.025);
      }
      return sum;
    };
    Vector6 right = Vector6::Zero();
    for (const auto& part : sums[v].right) right += part.head<6>();
    // Motions in the picture's plane, about the rope's middle. The effect of others depends on the depths of all
    // Gaussians that a pixel's color is blended from, not on the one point that it stands for.
    const Pose about{view.camera->world_from_camera.rotation, scene.base * Vector3(0, 0, -0.14)};
    const Vector6 found = math::adjoint(about).transpose() * right;
    Vector3 slope, looked_up;  // rotations with a lever of 10 cm, so that all entries are of one size
    for (const int k : {2, 3, 4}) {
      const double lever = k < 3 ? 10.0 : 1.0, step = 2e-4 * lever;  // a fifth of a pixel
      const Vector6 twist = math::transform_twist(about, step * Vector6::Unit(k));
      slope[k - 2] = lever * (loss(twist) - loss(-twist)) / (2.0 * step);
      looked_up[k - 2] = lever * found[k];
    }
    CHECK((looked_up - slope).norm() <= 0.05 * slope.norm());
  }
  check_devices_silent();
}

TEST_CASE("a step on the colors finds a small motion of the rope") {
  ColorScene scene = make_scene();
  splat::Engine engine(compared_device());
  VectorX moved = scene.theta;
  for (int k = 0; k < moved.size(); ++k) moved[k] += 0.006 * std::sin(1.7 * k + 0.5);  // up to 2 px
  observe(scene, engine, moved, {0.9, 0.05, 0.0});
  engine.set_gaussians(scene.gaussians);
  const int n = scene.chain.angles();
  std::vector<double> errors{(scene.theta - moved).norm()};
  for (int step = 0; step < 2; ++step) {
    for (splat::ViewSpec& view : scene.views) view.motions = chain::link_motions(scene.chain, scene.theta, scene.base);
    const MatrixX axes = chain::world_axes(scene.chain, scene.theta, scene.base);
    MatrixX normal = MatrixX::Zero(n + 2, n + 2);
    VectorX right = VectorX::Zero(n + 2);
    for (const ColorSums& sums : engine.color_sums(scene.chain, scene.views, scene.observed_pointers()))
      for (int j = 0; j < scene.chain.links(); ++j) {
        MatrixX columns = MatrixX::Zero(8, n + 2);
        const int count = scene.chain.last_angle(j) + 1;
        columns.topLeftCorner(6, count) = axes.leftCols(count);
        columns(6, n) = columns(7, n + 1) = 1.0;
        normal += columns.transpose() * sums.normal[j] * columns;
        right += columns.transpose() * sums.right[j];
      }
    scene.theta -= normal.ldlt().solve(right).head(n);
    errors.push_back((scene.theta - moved).norm());
  }
  CHECK(errors[1] < 0.3 * errors[0]);
  CHECK(errors[2] < 0.12 * errors[0]);
  check_devices_silent();
}

TEST_CASE("following needs no new memory, whatever the crops' sizes, and nothing shown gives nothing") {
  ColorScene scene = make_scene();
  for (const bool least : {false, true}) {
    splat::Engine engine(compared_device(least));
    observe(scene, engine, scene.theta, {});
    engine.set_gaussians(scene.gaussians);
    engine.color_sums(scene.chain, {scene.views.data(), 1}, {scene.observed_pointers().data(), 1});  // the largest crop
    const std::uint64_t bytes = compared_device(least).buffer_bytes, submitted = compared_device(least).submitted;
    int calls = 0;
    for (int cut = 0; cut < 60; cut += 7, ++calls) {
      splat::ViewSpec view = scene.views[0];
      view.width -= cut;
      view.height -= 2 * cut;
      std::vector<std::uint8_t> part;
      for (int y = 0; y < view.height; ++y)
        part.insert(part.end(), scene.observed[0].begin() + 4 * y * 200,
                    scene.observed[0].begin() + 4 * (y * 200 + view.width));
      const std::vector<std::uint8_t>* const one = &part;
      CHECK(engine.color_sums(scene.chain, {&view, 1}, {&one, 1})[0].pixels > 100);
      CHECK(compared_device(least).buffer_bytes == bytes);
    }
    CHECK(compared_device(least).submitted == submitted + calls);  // one submission per frame, transfers included

    std::vector<std::uint8_t> no_mask(4u * 200 * 240, 0);
    const splat::ViewSpec empty{&scene.cameras[0], 3, 4, 0, 0, scene.views[0].motions};
    const std::vector<std::uint8_t> no_pixels;
    const std::array views{scene.views[0], empty};
    const std::array<const std::vector<std::uint8_t>*, 2> observed{&no_mask, &no_pixels};
    for (const ColorSums& sums : engine.color_sums(scene.chain, views, observed)) {
      CHECK(sums.pixels == 0);
      CHECK(sums.weight == 0.0);
      CHECK(sums.gain == 1.0);
      CHECK(sums.bias == 0.0);
      for (const auto& normal : sums.normal) CHECK(normal.isZero(0.0));
    }
    CHECK(engine.color_sums(scene.chain, {}, {}).empty());
  }
  check_devices_silent();
}

}  // namespace
