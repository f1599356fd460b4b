// What no camera saw of a rope: Gaussians there get a place and a color. Truth is a texture that is known everywhere.
#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <functional>
#include <memory>
#include <numbers>
#include <vector>

#include "chainsplat/core.h"
#include "chainsplat/image_model.h"
#include "src/recognition/hold_colors.h"
#include "src/recognition/unseen.h"
#include "tests/straight_rope.h"

using namespace chainsplat;

namespace {

constexpr double kLength = 0.3, kDiameter = 0.02;
constexpr double kDegree = std::numbers::pi / 180.0;

using test::texture;

struct Rope {
  chain::Chain chain = chain::make_chain(kLength, kDiameter, -math::Vector3::UnitZ(), math::Vector3::UnitY(), 8,
                                         chain::Bending::spatial, false);
  splat::Gaussians gaussians;
  std::vector<math::Pose> motions = chain::link_motions(chain, math::VectorX::Zero(chain.angles()), {});
  std::function<math::Vector3(double arclength, double angle)> color;
  // two cameras at 40 degrees to either side of the bending axis, 1 m away, whose masks show the rope everywhere
  std::vector<std::unique_ptr<capture::Camera>> cameras;
  std::vector<std::unique_ptr<capture::PackedView>> pictures;
  std::vector<recognition::Viewpoint> views;

  // Those that a camera could see (nearly) have the texture and lie at 0.85 of the radius, the others are gray at 0.75.
  // `light`: how much brighter the side of the bending axis is.
  explicit Rope(double slope, double light = 0.0)
      : Rope([=](double s, double at) { return math::Vector3((1.0 + light * std::cos(at)) * texture(s, at, slope)); }) {
  }
  explicit Rope(std::function<math::Vector3(double, double)> looks) : color(std::move(looks)) {
    constexpr int kCount = 1500;
    core::Random random(3);
    gaussians.resize(kCount, chain.links(), 1);
    for (int i = 0; i < kCount; ++i) {
      const double s = kLength * (i + random.uniform()) / kCount, at = 2.0 * std::numbers::pi * random.uniform();
      const bool seen = std::cos(at) > std::cos(130.0 * kDegree);
      const math::Vector3 mean = s * chain.direction + (seen ? 0.85 : 0.75) * 0.5 * kDiameter * normal(at);
      for (int c = 0; c < 3; ++c) {
        gaussians.mean[3 * i + c] = static_cast<float>(mean[c]);
        gaussians.log_scale[3 * i + c] = std::log(0.002f);
      }
      splat::set_base_color(gaussians, i, seen ? color(s, at) : math::Vector3(0.5, 0.5, 0.5));
      gaussians.opacity_logit[i] = 2.0f;
      gaussians.link_logits[gaussians.links * i + chain::link_at(chain, s)] = 12.0f;
    }
    for (const double side : {-1.0, 1.0}) look_from(side * 40.0 * kDegree);
  }
  void look_from(double at) {
    cameras.push_back(std::make_unique<capture::Camera>(test::camera_beside(chain, at)));
    pictures.push_back(std::make_unique<capture::PackedView>(
        capture::packed(test::picture_of_straight_rope(chain, *cameras.back(), color))));
    views.push_back({cameras.back().get(), pictures.back().get(), motions});
  }
  math::Vector3 normal(double at) const { return test::side_of(chain, at); }
  double arclength(int i) const {
    return math::Vector3(gaussians.mean[3 * i], gaussians.mean[3 * i + 1], gaussians.mean[3 * i + 2])
        .dot(chain.direction);
  }
  // About the axis, from the bending axis on.
  double angle(int i) const {
    const math::Vector3 mean(gaussians.mean[3 * i], gaussians.mean[3 * i + 1], gaussians.mean[3 * i + 2]);
    return std::atan2(mean.dot(normal(0.5 * std::numbers::pi)), mean.dot(normal(0.0)));
  }
  // RMS error of the colors of those behind, where the texture along the helix was seen at all.
  double error_behind(double slope, double light = 0.0) const {
    double square = 0.0;
    int count = 0;
    for (int i = 0; i < gaussians.count; ++i) {
      const double s = arclength(i);
      if (std::cos(angle(i)) > -0.85 || s < 0.06 || s > kLength - 0.06) continue;
      const math::Vector3 wanted = (1.0 + light * std::cos(angle(i))) * texture(s, angle(i), slope);
      square += (splat::base_color(gaussians, i) - wanted).squaredNorm() / 3.0;
      ++count;
    }
    REQUIRE(count > 50);
    return std::sqrt(square / count);
  }
};

constexpr double kSlope = 0.045 / (2.0 * std::numbers::pi);  // one turn moves it by one period: it is closed

}  // namespace

TEST_CASE("a texture that winds about the rope goes on where no camera saw it") {
  Rope rope(kSlope);
  const splat::Gaussians before = rope.gaussians;
  const double gray = rope.error_behind(kSlope);
  CHECK(gray > 0.2);
  const int count = recognition::finish_unseen(rope.chain, rope.views, rope.gaussians);
  CHECK(count > 200);
  CHECK(count < 500);
  CHECK(rope.error_behind(kSlope) < 0.3 * gray);
  // those that were seen well stay, in their order, before the new ones
  int kept = 0;
  for (int i = 0; i < before.count; ++i) {
    const math::Vector3 mean(before.mean[3 * i], before.mean[3 * i + 1], before.mean[3 * i + 2]);
    const double at = std::atan2(mean.dot(rope.normal(0.5 * std::numbers::pi)), mean.dot(rope.normal(0.0)));
    if (std::cos(at) < std::cos(100.0 * kDegree)) continue;
    while (kept < rope.gaussians.count && rope.gaussians.mean[3 * kept] != before.mean[3 * i]) ++kept;
    REQUIRE(kept < rope.gaussians.count);
    CHECK(rope.gaussians.sh[12 * kept] == before.sh[12 * i]);
  }
  CHECK(kept < rope.gaussians.count - count);
  for (int i = rope.gaussians.count - count; i < rope.gaussians.count; ++i) {  // at the radius of the others
    const math::Vector3 mean(rope.gaussians.mean[3 * i], rope.gaussians.mean[3 * i + 1],
                             rope.gaussians.mean[3 * i + 2]);
    const math::Vector3 out = mean - mean.dot(rope.chain.direction) * rope.chain.direction;
    CHECK(out.norm() == doctest::Approx(0.85 * 0.5 * kDiameter).epsilon(0.02));
  }
}

TEST_CASE("a side that hardly any picture shows is guessed as one that none shows") {
  Rope unseen(kSlope), rarely(kSlope), often(kSlope);
  for (Rope* rope : {&unseen, &rarely, &often})
    for (int k = 0; k < 38; ++k) rope->look_from((k % 2 ? -40.0 : 40.0) * kDegree);
  rarely.look_from(180.0 * kDegree);
  for (int k = 0; k < 8; ++k) often.look_from(180.0 * kDegree);
  const int guessed = recognition::finish_unseen(unseen.chain, unseen.views, unseen.gaussians);
  CHECK(guessed > 200);
  CHECK(recognition::finish_unseen(rarely.chain, rarely.views, rarely.gaussians) == guessed);
  CHECK(recognition::finish_unseen(often.chain, often.views, often.gaussians) < guessed / 4);
}

TEST_CASE("a texture of rings goes on as rings, and one color stays one color") {
  Rope rings(0.0);
  const double gray = rings.error_behind(0.0);
  recognition::finish_unseen(rings.chain, rings.views, rings.gaussians);
  CHECK(rings.error_behind(0.0) < 0.3 * gray);

  Rope plain([](double, double) { return math::Vector3(0.8, 0.2, 0.2); });
  for (int i = 0; i < plain.gaussians.count; ++i) splat::set_base_color(plain.gaussians, i, {0.8, 0.2, 0.2});
  recognition::finish_unseen(plain.chain, plain.views, plain.gaussians);
  for (int i = 0; i < plain.gaussians.count; ++i)
    CHECK((splat::base_color(plain.gaussians, i) - math::Vector3(0.8, 0.2, 0.2)).norm() < 1e-4);
}

TEST_CASE("the side that the light does not reach is guessed darker") {
  constexpr double kLight = 0.4;
  Rope rope(kSlope, kLight);
  recognition::finish_unseen(rope.chain, rope.views, rope.gaussians);
  CHECK(rope.error_behind(kSlope, kLight) < 0.08);
  CHECK(rope.error_behind(kSlope) > 0.12);  // of the texture without its light
}

TEST_CASE("what was seen only at a slant stays in place and gets the texture's color") {
  Rope rope(kSlope, 0.2);
  const auto slanted = [&](int i) { return std::abs(std::abs(rope.angle(i)) - 126.5 * kDegree) < 3.0 * kDegree; };
  const auto error = [&] {
    double square = 0.0;
    int count = 0;
    for (int i = 0; i < rope.gaussians.count; ++i)
      if (const double s = rope.arclength(i); slanted(i) && s > 0.06 && s < kLength - 0.06)
        square += (splat::base_color(rope.gaussians, i) - rope.color(s, rope.angle(i))).squaredNorm() / 3.0, ++count;
    REQUIRE(count > 20);
    return std::sqrt(square / count);
  };
  // as bright as the texture in the mean, but without its bands, and from the side in another color
  for (int i = 0; i < rope.gaussians.count; ++i) {
    if (!slanted(i)) continue;
    const double gray = (1.0 + 0.2 * std::cos(rope.angle(i))) * 0.5;
    splat::set_base_color(rope.gaussians, i, {gray, gray, gray});
    rope.gaussians.sh[12 * i + 3] = 0.3f;
  }
  const splat::Gaussians before = rope.gaussians;
  const double gray = error();
  CHECK(gray > 0.15);
  recognition::finish_unseen(rope.chain, rope.views, rope.gaussians);
  CHECK(error() < 0.6 * gray);
  int moved = 0, colored = 0;
  for (int i = 0, k = 0; i < before.count; ++i) {  // in their order, before the new ones
    const bool there = k < rope.gaussians.count && rope.gaussians.mean[3 * k] == before.mean[3 * i];
    if (before.sh[12 * i + 3] > 0.0f) {
      moved += !there;
      const bool side = rope.arclength(k) < kLength - 0.5 * kDiameter;  // and not the tip's face
      colored += there && side && std::abs(rope.gaussians.sh[12 * k + 3]) > 0.2f;
    }
    k += there;
  }
  CHECK(moved == 0);
  CHECK(colored == 0);
}

TEST_CASE("where masks show that something else is in front, nothing is guessed") {
  Rope rope(kSlope);
  const splat::Gaussians before = rope.gaussians;
  for (const auto& picture : rope.pictures)
    for (int i = 0; i < 91 * picture->width; ++i)
      picture->rgba[4 * i + 3] = 0;  // the upper part, down to 0.04 m of the rope
  const int count = recognition::finish_unseen(rope.chain, rope.views, rope.gaussians);
  CHECK(count > 100);
  int above = 0, above_before = 0;
  for (int i = 0; i < rope.gaussians.count; ++i) above += rope.arclength(i) < 0.03;
  for (int i = 0; i < before.count; ++i) above_before += -before.mean[3 * i + 2] < 0.03f;
  CHECK(above == above_before);
  for (int i = rope.gaussians.count - count; i < rope.gaussians.count; ++i) CHECK(rope.arclength(i) > 0.03);
}

TEST_CASE("nothing is guessed of a rope that was seen from all around") {
  Rope rope(0.0);
  const double half = std::numbers::pi;
  for (const double at : {half - 0.6, half + 0.6}) rope.look_from(at);
  const splat::Gaussians before = rope.gaussians;
  CHECK(recognition::finish_unseen(rope.chain, rope.views, rope.gaussians) == 0);
  CHECK(rope.gaussians.mean == before.mean);
  CHECK(rope.gaussians.sh == before.sh);
}

TEST_CASE("more training leaves what was guessed, and the colors of what was seen at a slant") {
  Rope rope(kSlope);
  const int count = recognition::finish_unseen(rope.chain, rope.views, rope.gaussians);
  const splat::Gaussians& before = rope.gaussians;
  REQUIRE(count > 0);
  CHECK(std::count(before.guessed.begin(), before.guessed.end(), recognition::kGuessed) == count);
  CHECK(std::count(before.guessed.begin(), before.guessed.end(), recognition::kSlanted) > 50);
  splat::Gaussians trained = before;
  for (float& value : trained.mean) value += 1e-3f;
  for (float& value : trained.sh) value += 0.1f;
  std::fill(trained.guessed.begin(), trained.guessed.end(), 0);  // as the device gives them back
  recognition::keep_guessed(before, trained);
  const int size = 3 * before.sh_coefficients();
  for (int i = 0; i < before.count; ++i) {
    const bool guessed = before.guessed[i] == recognition::kGuessed,
               slanted = before.guessed[i] == recognition::kSlanted;
    CHECK((trained.guessed[i] == 1) == guessed);
    CHECK((trained.guessed[i] == 0) == !guessed);
    CHECK((trained.mean[3 * i] == before.mean[3 * i]) == guessed);
    CHECK((trained.sh[size * i] == before.sh[size * i]) == (guessed || slanted));
  }
}

TEST_CASE("colors stay beyond the directions from which they were seen, and are what they were at these") {
  constexpr double kPerDirection = 0.4;  // of a color per unit of direction
  constexpr int kWidest = 30;            // degrees to either side of the bending axis, from which cameras look
  Rope rope(0.0);
  rope.views.clear();
  for (int at = -kWidest; at <= kWidest; at += 5) rope.look_from(at * kDegree);
  splat::Gaussians& g = rope.gaussians;
  for (int i = 0; i < g.count; ++i)
    for (int c = 0; c < 3; ++c)
      g.sh[12 * i + 3 + c] = static_cast<float>(kPerDirection / 0.4886025);  // with -y of the direction
  g.guessed[0] = 1;
  const splat::Gaussians before = g;
  recognition::hold_colors(rope.chain, rope.views, g);
  REQUIRE(g.degree == 2);
  CHECK(splat::sh_color(g, 0, -rope.normal(1.0)) == splat::sh_color(before, 0, -rope.normal(1.0)));
  // the bending axis is y: seen from `at` the color has kPerDirection cos(at) more, and the held ones those of 30
  // degrees
  double seen = 0.0, held = 0.0, went_on = 0.0;
  int count = 0;
  for (int i = 1; i < g.count; ++i) {
    if (std::cos(rope.angle(i)) < std::cos(40.0 * kDegree) || rope.arclength(i) > kLength - kDiameter) continue;
    ++count;
    for (int at = -90; at <= 90; at += 5) {
      const math::Vector3 direction = -rope.normal(at * kDegree);
      if (-direction.dot(rope.normal(rope.angle(i))) < 0.2) continue;
      const math::Vector3 nearest = -rope.normal(std::clamp(at, -kWidest, kWidest) * kDegree);
      const double wanted = splat::sh_color(before, i, nearest).x();
      double& worst = std::abs(at) <= kWidest ? seen : held;
      worst = std::max(worst, std::abs(splat::sh_color(g, i, direction).x() - wanted));
      went_on = std::max(went_on, std::abs(splat::sh_color(before, i, direction).x() - wanted));
    }
  }
  REQUIRE(count > 100);
  MESSAGE("at most off: seen " << seen << ", held " << held << ", of those that would go on " << went_on);
  CHECK(went_on > 0.3);
  CHECK(seen < 0.05 * kPerDirection);
  CHECK(held < 0.3 * went_on);
}

TEST_CASE("what was seen flatly has the texture's color from where no camera was") {
  Rope rope(kSlope);
  // seen at 60 to 70 degrees from the normal by the nearer camera, and as bright as the texture but without its bands
  const auto flat = [&](int i) { return std::abs(std::abs(rope.angle(i)) - 105.0 * kDegree) < 5.0 * kDegree; };
  splat::Gaussians& g = rope.gaussians;
  for (int i = 0; i < g.count; ++i)
    if (flat(i)) splat::set_base_color(g, i, {0.5, 0.5, 0.5});
  const splat::Gaussians before = g;
  recognition::hold_colors(rope.chain, rope.views, g);
  double error = 0.0, error_before = 0.0, changed = 0.0;
  int count = 0;
  for (int i = 0; i < g.count; ++i) {
    const double s = rope.arclength(i), at = rope.angle(i);
    if (!flat(i) || s < 0.06 || s > kLength - 0.06) continue;
    const math::Vector3 wanted = texture(s, at, kSlope), from = -rope.normal(at);
    error += (splat::sh_color(g, i, from) - wanted).squaredNorm();
    error_before += (splat::sh_color(before, i, from) - wanted).squaredNorm();
    const math::Vector3 seen = -rope.normal(std::copysign(40.0 * kDegree, at));
    changed = std::max(changed, (splat::sh_color(g, i, seen) - splat::sh_color(before, i, seen)).cwiseAbs().maxCoeff());
    ++count;
  }
  REQUIRE(count > 30);
  MESSAGE("of the error " << std::sqrt(error / error_before) << " are left, seen colors change by " << changed);
  CHECK(error < 0.25 * error_before);
  CHECK(changed < 0.03);
}
