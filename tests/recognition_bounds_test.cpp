// Gaussians stay within their links and colors within what a picture can show. Covariances are multiplied out here.
#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>

#include "chainsplat/core.h"
#include "src/recognition/place_gaussians.h"

using namespace chainsplat;

namespace {

math::Matrix3 covariance_of(const splat::Gaussians& g, int i) {
  const float* q = &g.rotation[4 * i];
  const double norm = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  const double w = q[0] / norm, x = q[1] / norm, y = q[2] / norm, z = q[3] / norm;
  math::Matrix3 r;
  r << 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),  //
      2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),   //
      2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y);
  math::Matrix3 variances = math::Matrix3::Zero();
  for (int c = 0; c < 3; ++c) variances(c, c) = std::exp(2.0 * g.log_scale[3 * i + c]);
  return r * variances * r.transpose();
}

}  // namespace

TEST_CASE("Gaussians are compressed to reach no farther than asked past their joints, and keep their sides") {
  constexpr double kLength = 0.3, kDiameter = 0.02, kPast = 0.002;
  constexpr int kCount = 400;
  const chain::Chain chain = chain::make_chain(kLength, kDiameter, -math::Vector3::UnitZ(), math::Vector3::UnitY(), 8,
                                               chain::Bending::planar, false);
  core::Random random(5);
  splat::Gaussians before;
  before.resize(kCount, chain.links(), 1);
  for (int i = 0; i < kCount; ++i) {
    const double s = random.uniform(-0.005, kLength + 0.005);
    const math::Vector3 mean = s * chain.direction + math::Vector3(0.005, -0.003, 0.0);
    for (int c = 0; c < 3; ++c) {
      before.mean[3 * i + c] = static_cast<float>(mean[c]);
      before.log_scale[3 * i + c] = static_cast<float>(std::log(random.uniform(0.0003, 0.02)));
    }
    for (int c = 0; c < 4; ++c) before.rotation[4 * i + c] = static_cast<float>(random.uniform(-1.0, 1.0));
    splat::set_base_color(before, i, {random.uniform(-0.5, 1.5), random.uniform(-0.5, 1.5), random.uniform(-0.5, 1.5)});
    // on some link near by, as where a Gaussian has moved across a joint
    const int link = std::clamp(chain::link_at(chain, s + random.uniform(-0.01, 0.01)), 1, chain.links() - 1);
    before.link_logits[static_cast<std::size_t>(before.links) * i + link] = 12.0f;
  }
  splat::Gaussians after = before;
  recognition::bound_gaussians(chain, after, kPast);

  const math::Vector3 along = chain.direction;
  const math::Matrix3 across = math::Matrix3::Identity() - along * along.transpose();
  int compressed = 0, same = 0;
  for (int i = 0; i < kCount; ++i) {
    const math::Vector3 mean(after.mean[3 * i], after.mean[3 * i + 1], after.mean[3 * i + 2]);
    const double s = mean.dot(along);
    const auto first = after.link_logits.begin() + static_cast<std::ptrdiff_t>(after.links) * i;
    const int link = static_cast<int>(std::max_element(first, first + after.links) - first);
    CHECK(*std::max_element(first, first + after.links) == 12.0f);
    CHECK(std::count(first, first + after.links, 0.0f) == after.links - 1);
    CHECK(link >= 1);
    if (link > 1) CHECK(s >= chain.link_start(link) - 1e-9);
    if (link + 1 < after.links) CHECK(s <= chain.link_end(link) + 1e-9);

    const math::Matrix3 was = covariance_of(before, i), is = covariance_of(after, i);
    const double reach = 2.0 * std::sqrt(along.dot(is * along));
    if (link > 1) CHECK(s - reach >= chain.link_start(link) - kPast - 1e-6);
    if (link + 1 < after.links) CHECK(s + reach <= chain.link_end(link) + kPast + 1e-6);
    // what it covers across the rope stays
    CHECK((across * (is - was) * across).norm() < 1e-4 * was.norm());
    const double shrink = std::sqrt(along.dot(is * along) / along.dot(was * along));
    compressed += shrink < 0.999;
    if (std::equal(&after.log_scale[3 * i], &after.log_scale[3 * i] + 3, &before.log_scale[3 * i])) ++same;
    CHECK((across * is * along - shrink * across * was * along).norm() < 1e-4 * was.norm());

    const math::Vector3 color = splat::base_color(after, i), wanted = splat::base_color(before, i);
    for (int c = 0; c < 3; ++c) CHECK(color[c] == doctest::Approx(std::clamp(wanted[c], 0.0, 1.0)).epsilon(1e-5));
  }
  CHECK(compressed > 100);
  CHECK(same > 50);
  CHECK(compressed + same == kCount);
  CHECK(after.mean == before.mean);
}

TEST_CASE("the radius that masks show: a connector is wider, what hides the rope is not the rope's width") {
  constexpr double kLength = 0.3, kDiameter = 0.02, kFocal = 1500.0;
  constexpr double kConnector = 0.016, kConnectorLength = 0.04;  // m: its radius, at the tip
  constexpr int kWidth = 200, kHeight = 512;
  const chain::Chain chain = chain::make_chain(kLength, kDiameter, -math::Vector3::UnitZ(), math::Vector3::UnitY(), 8,
                                               chain::Bending::planar, false);
  const std::vector<math::Pose> motions = chain::link_motions(chain, math::VectorX::Zero(8), {});
  capture::Camera camera;
  camera.width = kWidth, camera.height = kHeight;
  camera.fx = camera.fy = kFocal, camera.cx = 0.5 * kWidth, camera.cy = 0.5 * kHeight;
  // from 1 m away along y, at the middle of the rope
  camera.world_from_camera.rotation << -1, 0, 0, 0, 0, -1, 0, -1, 0;
  camera.world_from_camera.translation = math::Vector3(0, 1, -0.5 * kLength);
  const auto picture = [&](double shown_to) {
    capture::View view;
    view.width = kWidth, view.height = kHeight;
    view.rgba.assign(std::size_t{4} * kWidth * kHeight, 0);
    for (int v = 0; v < kHeight; ++v)
      for (int u = 0; u < kWidth; ++u) {
        const double s = 0.5 * kLength + (v + 0.5 - camera.cy) / kFocal, off = std::abs(u + 0.5 - camera.cx) / kFocal;
        const bool rope = s >= 0.0 && s <= shown_to;
        if (rope && off <= (s > kLength - kConnectorLength ? kConnector : 0.5 * kDiameter))
          view.rgba[4 * (static_cast<std::size_t>(v) * kWidth + u) + 3] = 255;
      }
    return capture::packed(view);
  };
  const capture::PackedView whole = picture(kLength), half = picture(0.5 * kLength);
  const std::vector<recognition::Viewpoint> views{{&camera, &whole, motions}, {&camera, &half, motions}};
  const recognition::Radii radii = recognition::radii_in(chain, views);
  CHECK(radii.at(0.1) == doctest::Approx(0.5 * kDiameter).epsilon(0.08));
  CHECK(radii.at(kLength - 0.5 * kConnectorLength) == doctest::Approx(kConnector).epsilon(0.08));
  // what the mask does not show of the rope is hidden
  const std::vector<double> along{0.1 * kLength, 0.45 * kLength, 0.55 * kLength, 0.9 * kLength};
  const auto shown = [&](const capture::PackedView& packed) {
    return recognition::shown(chain, camera, capture::unpacked(packed), motions, along);
  };
  CHECK(shown(whole) == std::vector<char>{1, 1, 1, 1});
  CHECK(shown(half) == std::vector<char>{1, 1, 0, 0});
  // of masks that show nothing the given radius is left
  const capture::PackedView none = picture(-1.0);
  const recognition::Radii unknown =
      recognition::radii_in(chain, std::vector<recognition::Viewpoint>{{&camera, &none, motions}});
  for (const double radius : unknown.radius) CHECK(radius == 0.5 * kDiameter);

  // Gaussians at 0.5 to 3 times the radius, on the rope and on the connector
  splat::Gaussians before;
  core::Random random(7);
  before.resize(300, chain.links(), 0);
  for (int i = 0; i < before.count; ++i) {
    const double s = random.uniform(0.01, kLength - 0.001), at = random.uniform(0.0, 6.28),
                 r = kDiameter * random.uniform(0.25, 1.5);
    const math::Vector3 mean = s * chain.direction + r * math::Vector3(std::cos(at), std::sin(at), 0.0);
    for (int c = 0; c < 3; ++c) {
      before.mean[3 * i + c] = static_cast<float>(mean[c]);
      before.log_scale[3 * i + c] = static_cast<float>(std::log(random.uniform(0.0003, 0.004)));
    }
    for (int c = 0; c < 4; ++c) before.rotation[4 * i + c] = static_cast<float>(random.uniform(-1.0, 1.0));
    before.link_logits[static_cast<std::size_t>(before.links) * i + chain::link_at(chain, s)] = 12.0f;
  }
  splat::Gaussians after = before;
  recognition::bound_gaussians(chain, after, 1.0, &radii);
  int moved = 0, same = 0;
  for (int i = 0; i < before.count; ++i) {
    const math::Vector3 mean(after.mean[3 * i], after.mean[3 * i + 1], after.mean[3 * i + 2]);
    const double s = mean.dot(chain.direction);
    const math::Vector3 off = mean - s * chain.direction, outward = off.normalized();
    CHECK(off.norm() + std::sqrt(outward.dot(covariance_of(after, i) * outward)) < 1.1 * radii.at(s) + 1e-6);
    const bool stays = std::equal(&after.mean[3 * i], &after.mean[3 * i] + 3, &before.mean[3 * i]);
    (stays ? same : moved) += 1;
    // inward, to no other side and arclength
    const math::Vector3 was(before.mean[3 * i], before.mean[3 * i + 1], before.mean[3 * i + 2]);
    CHECK((was - s * chain.direction).normalized().dot(outward) == doctest::Approx(1.0).epsilon(1e-4));
    CHECK(was.dot(chain.direction) == doctest::Approx(s).epsilon(1e-5));
  }
  CHECK(moved > 100);
  CHECK(same > 30);
}
