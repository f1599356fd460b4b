#include "tube.h"

#include <algorithm>
#include <cmath>
#include <numbers>

#include "parts.h"

namespace chainsplat::exports {

using math::Vector3;

namespace {

constexpr int kSides = 16, kMostRings = 1000;  // 16 bits count the vertices
constexpr double kRingsPerDiameter = 4.0;
constexpr double kBlend = 0.5;   // diameters to either side of a joint in which the skin passes from link to link
constexpr double kSmooth = 0.1;  // diameters: reach of a Gaussian's color on the skin, one deviation

// Colors of the Gaussians around a point, the nearer and the more opaque the more.
Vector3 color_at(const splat::Gaussians& g, const Vector3& point, double reach) {
  Vector3 sum = Vector3::Constant(1e-12 * 0.5);
  double weight = 1e-12;
  for (int i = 0; i < g.count; ++i) {
    const Vector3 away = Vector3(g.mean[3 * i], g.mean[3 * i + 1], g.mean[3 * i + 2]) - point;
    const double near = std::exp(-0.5 * away.squaredNorm() / (reach * reach) - 1e-3 * away.norm() / reach) /
                        (1.0 + std::exp(-static_cast<double>(g.opacity_logit[i])));
    weight += near;
    sum += near * splat::base_color(g, i);
  }
  return sum / weight;
}

// The two links that carry an arclength, and the share of the second.
struct Carried {
  int first = 0, second = 0;
  double share = 0.0;
};
Carried carried(const chain::Chain& chain, double arclength) {
  const int link = chain::link_at(chain, arclength);
  const double reach = kBlend * chain.diameter;
  const auto blend = [&](int before) -> Carried {  // across the joint between `before` and the next link
    const double lengths = std::min(chain.link_end(before) - chain.link_start(before),
                                    chain.link_end(before + 1) - chain.link_start(before + 1));
    const double half = std::min(reach, 0.5 * lengths), past = arclength - chain.link_start(before + 1);
    if (half <= 0.0) return {before, before + 1, past >= 0.0 ? 1.0 : 0.0};
    return {before, before + 1, std::clamp(0.5 + 0.5 * past / half, 0.0, 1.0)};
  };
  const double middle = 0.5 * (chain.link_start(link) + chain.link_end(link));
  if (arclength < middle && link > 0) return blend(link - 1);
  if (link + 1 < chain.links()) return blend(link);
  return {link - 1, link, 1.0};
}

class Builder {
 public:
  Builder(const splat::Gaussians& gaussians, const chain::Chain& chain) : gaussians_(gaussians), chain_(chain) {}

  std::uint16_t vertex(double arclength, const Vector3& arm, const Vector3& normal) {
    const Vector3 point = arclength * chain_.direction + arm;
    const Carried on = carried(chain_, arclength);
    const Vector3 color =
        gaussians_.count > 0 ? color_at(gaussians_, point, kSmooth * chain_.diameter) : Vector3(Vector3::Constant(0.5));
    for (int c = 0; c < 3; ++c) {
      tube.position.push_back(static_cast<float>(point[c]));
      tube.normal.push_back(static_cast<float>(normal[c]));
      tube.color.push_back(static_cast<float>(linear_from_srgb(color[c])));
    }
    tube.color.push_back(1.0f);
    // an unused place names link 0, as glTF asks
    const bool first = on.share < 1.0;
    const bool second = on.share > 0.0;
    for (const int link : {first ? on.first : 0, second ? on.second : 0, 0, 0})
      tube.link.push_back(static_cast<std::uint16_t>(link));
    for (const double weight : {1.0 - on.share, on.share, 0.0, 0.0}) tube.weight.push_back(static_cast<float>(weight));
    return static_cast<std::uint16_t>(tube.position.size() / 3 - 1);
  }
  void triangle(int a, int b, int c) {
    for (const int each : {a, b, c}) tube.triangles.push_back(static_cast<std::uint16_t>(each));
  }
  Tube tube;

 private:
  const splat::Gaussians& gaussians_;
  const chain::Chain& chain_;
};

}  // namespace

Tube make_tube(const splat::Gaussians& gaussians, const chain::Chain& chain) {
  const Vector3 side = chain.bending_axis, other = chain.direction.cross(side);
  const double radius = 0.5 * chain.diameter;
  const int rings =
      std::clamp(static_cast<int>(std::ceil(kRingsPerDiameter * chain.length / chain.diameter)), 2, kMostRings);
  const auto outward = [&](int k) -> Vector3 {
    const double angle = 2.0 * std::numbers::pi * k / kSides;
    return std::cos(angle) * side + std::sin(angle) * other;
  };
  Builder builder(gaussians, chain);
  for (int r = 0; r <= rings; ++r)
    for (int k = 0; k < kSides; ++k) builder.vertex(chain.length * r / rings, radius * outward(k), outward(k));
  for (int r = 0; r < rings; ++r)
    for (int k = 0; k < kSides; ++k) {
      const int a = r * kSides + k, b = r * kSides + (k + 1) % kSides;
      builder.triangle(a, b, b + kSides);
      builder.triangle(a, b + kSides, a + kSides);
    }
  // both ends, flat
  for (const bool far : {false, true}) {
    const double arclength = far ? chain.length : 0.0;
    const Vector3 normal = far ? chain.direction : Vector3(-chain.direction);
    const int center = builder.vertex(arclength, Vector3::Zero(), normal), first = center + 1;
    for (int k = 0; k < kSides; ++k) builder.vertex(arclength, radius * outward(k), normal);
    for (int k = 0; k < kSides; ++k) {
      const int a = first + k, b = first + (k + 1) % kSides;
      far ? builder.triangle(center, a, b) : builder.triangle(center, b, a);
    }
  }
  return std::move(builder.tube);
}

}  // namespace chainsplat::exports
