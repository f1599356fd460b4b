// What no camera saw of a rope: Gaussians there get a place and a color. Truth is a texture that is known everywhere.
#include <doctest/doctest.h>

#include <cmath>
#include <numbers>
#include <vector>

#include "chainsplat/core.h"
#include "chainsplat/image_model.h"
#include "src/recognition/unseen.h"

using namespace chainsplat;

namespace {

constexpr double kLength = 0.3, kDiameter = 0.02;

// Red, white and blue bands that wind about the rope, m of arclength per radian; 0: rings.
math::Vector3 texture(double arclength, double angle, double slope) {
  const double phase = 2.0 * std::numbers::pi * (arclength - slope * angle) / 0.045;
  const double third = 2.0 * std::numbers::pi / 3.0;
  return {0.5 + 0.3 * std::cos(phase), 0.5 + 0.3 * std::cos(phase - third), 0.5 + 0.3 * std::cos(phase + third)};
}

struct Rope {
  chain::Chain chain = chain::make_chain(kLength, kDiameter, -math::Vector3::UnitZ(), math::Vector3::UnitY(), 8,
                                         chain::Bending::spatial, false);
  splat::Gaussians gaussians;
  std::vector<double> angle;  // of every Gaussian, from the bending axis on
  std::vector<math::Pose> motions = chain::link_motions(chain, math::VectorX::Zero(chain.angles()), {});
  std::vector<recognition::Viewpoint> views;  // two cameras at 40 degrees to either side of the bending axis, 1 m away

  // Those that a camera could see (nearly) have the texture and lie at 0.85 of the radius, the others are gray at 0.75.
  explicit Rope(double slope) {
    constexpr int kCount = 1500;
    core::Random random(3);
    gaussians.resize(kCount, chain.links(), 1);
    for (int i = 0; i < kCount; ++i) {
      const double s = kLength * (i + random.uniform()) / kCount, at = 2.0 * std::numbers::pi * random.uniform();
      angle.push_back(at);
      const bool seen = std::cos(at) > std::cos(130.0 * std::numbers::pi / 180.0);
      const math::Vector3 color = seen ? texture(s, at, slope) : math::Vector3(0.5, 0.5, 0.5);
      const math::Vector3 mean = s * chain.direction + (seen ? 0.85 : 0.75) * 0.5 * kDiameter * normal(at);
      for (int c = 0; c < 3; ++c) {
        gaussians.mean[3 * i + c] = static_cast<float>(mean[c]);
        gaussians.log_scale[3 * i + c] = std::log(0.002f);
        gaussians.sh[12 * i + c] = static_cast<float>((color[c] - 0.5) / image_model::kSh0);
      }
      gaussians.opacity_logit[i] = 2.0f;
      gaussians.link_logits[gaussians.links * i + chain::link_at(chain, s)] = 12.0f;
    }
    for (const double side : {-1.0, 1.0}) {
      const double at = side * 40.0 * std::numbers::pi / 180.0;
      views.push_back({normal(at) + 0.5 * kLength * chain.direction, motions});
    }
  }
  math::Vector3 normal(double at) const {
    return std::cos(at) * chain.bending_axis + std::sin(at) * chain.direction.cross(chain.bending_axis);
  }
  double arclength(int i) const {
    return math::Vector3(gaussians.mean[3 * i], gaussians.mean[3 * i + 1], gaussians.mean[3 * i + 2])
        .dot(chain.direction);
  }
  // RMS error of the colors of those behind, where the texture along the helix was seen at all.
  double error_behind(double slope) const {
    double square = 0.0;
    int count = 0;
    for (int i = 0; i < gaussians.count; ++i) {
      const double s = arclength(i);
      if (std::cos(angle[i]) > -0.85 || s < 0.06 || s > kLength - 0.06) continue;
      const math::Vector3 wanted = texture(s, angle[i], slope);
      for (int c = 0; c < 3; ++c)
        square += std::pow(0.5 + image_model::kSh0 * gaussians.sh[12 * i + c] - wanted[c], 2) / 3.0;
      ++count;
    }
    REQUIRE(count > 50);
    return std::sqrt(square / count);
  }
};

}  // namespace

TEST_CASE("a texture that winds about the rope goes on where no camera saw it") {
  constexpr double kSlope = 0.045 / (2.0 * std::numbers::pi);  // one turn moves it by one period: it is closed
  Rope rope(kSlope);
  const splat::Gaussians before = rope.gaussians;
  const double gray = rope.error_behind(kSlope);
  CHECK(gray > 0.2);
  const int count = recognition::finish_unseen(rope.chain, rope.views, rope.gaussians);
  CHECK(count > 200);
  CHECK(count < 500);
  CHECK(rope.error_behind(kSlope) < 0.3 * gray);
  for (int i = 0; i < before.count; ++i) {
    const bool seen = std::cos(rope.angle[i]) > std::cos(120.0 * std::numbers::pi / 180.0);
    const bool same =
        before.mean[3 * i] == rope.gaussians.mean[3 * i] && before.sh[12 * i] == rope.gaussians.sh[12 * i];
    if (seen) CHECK(same);
    if (std::cos(rope.angle[i]) > -0.9) continue;
    // on the surface, at the radius of the others
    const math::Vector3 mean(rope.gaussians.mean[3 * i], rope.gaussians.mean[3 * i + 1],
                             rope.gaussians.mean[3 * i + 2]);
    const math::Vector3 out = mean - mean.dot(rope.chain.direction) * rope.chain.direction;
    if (rope.arclength(i) < 0.29) CHECK(out.norm() == doctest::Approx(0.85 * 0.5 * kDiameter).epsilon(0.02));
  }
}

TEST_CASE("a texture of rings goes on as rings, and one color stays one color") {
  Rope rings(0.0);
  const double gray = rings.error_behind(0.0);
  recognition::finish_unseen(rings.chain, rings.views, rings.gaussians);
  CHECK(rings.error_behind(0.0) < 0.3 * gray);

  Rope plain(0.0);
  for (int i = 0; i < plain.gaussians.count; ++i)
    for (int c = 0; c < 3; ++c) plain.gaussians.sh[12 * i + c] = c == 0 ? 1.0f : -1.0f;
  recognition::finish_unseen(plain.chain, plain.views, plain.gaussians);
  for (int i = 0; i < plain.gaussians.count; ++i)
    for (int c = 0; c < 3; ++c) CHECK(std::abs(plain.gaussians.sh[12 * i + c] - (c == 0 ? 1.0f : -1.0f)) < 1e-4f);
}

TEST_CASE("nothing is guessed of a rope that was seen from all around") {
  Rope rope(0.0);
  const double half = std::numbers::pi;
  for (const double at : {half - 0.6, half + 0.6}) rope.views.push_back({rope.normal(at), rope.motions});
  const splat::Gaussians before = rope.gaussians;
  CHECK(recognition::finish_unseen(rope.chain, rope.views, rope.gaussians) == 0);
  CHECK(rope.gaussians.mean == before.mean);
  CHECK(rope.gaussians.sh == before.sh);
}
